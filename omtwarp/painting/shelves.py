"""Boxes of different sizes on one picture, at the largest scale that rows of them allow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import TINY

Floats = NDArray[np.float64]

HALVINGS = 40  # of the interval of scales, which is then known to rounding


def on_shelves(sizes: Floats, width: float, margin: float, least: Floats | float = 0.0) -> tuple[Floats, float]:
    """Place boxes on a picture of height 1, as large as rows of them allow, all at one scale.

    The highest come first, each in the first row in which there is room for it [1]_; the scale is bisected.

    Args:
        sizes: width and height of the boxes, shape [N, 2].
        width: of the picture.
        margin: free space around every box, in heights of the picture.
        least: width and height that no box falls below, in the same unit, shape [2].

    Returns:
        Lower left corners of the boxes, without their margins, shape [N, 2], and the scale.

    Raises:
        OmtwarpError: the margins alone do not fit.

    >>> import numpy as np
    >>> corners, scale = on_shelves(np.array([[2.0, 1.0], [2.0, 1.0]]), 1.0, 0.0)
    >>> corners.tolist(), round(scale, 6)
    ([[0.0, 0.5], [0.0, 0.0]], 0.5)

    .. [1] E. G. Coffman, M. R. Garey, D. S. Johnson and R. E. Tarjan, "Performance bounds for level-oriented
       two-dimensional packing algorithms", SIAM J. Comput. 9 (1980).
    """
    if _rows(np.maximum(0.0 * sizes, least), width, margin) is None:
        raise OmtwarpError(f"a margin of {margin} leaves no room for {len(sizes)} charts")
    low, high = 0.0, float((np.array([width, 1.0]) / np.maximum(sizes.max(axis=0), TINY)).min())
    found = _rows(np.maximum(high * sizes, least), width, margin)
    low = high if found is not None else low
    for _ in range(HALVINGS if found is None else 0):
        middle = 0.5 * (low + high)
        placed = _rows(np.maximum(middle * sizes, least), width, margin)
        if placed is None:
            high = middle
        else:
            low, found = middle, placed
    if found is None or low == 0.0:
        raise OmtwarpError(f"a margin of {margin} leaves no room for {len(sizes)} charts")
    placed_sizes = np.maximum(low * sizes, least)
    used = (found + placed_sizes + margin).max(axis=0)
    found = found + 0.5 * (np.array([width, 1.0]) - used)
    return np.stack([found[:, 0], 1.0 - found[:, 1] - placed_sizes[:, 1]], axis=1), low


def _rows(sizes: Floats, width: float, margin: float) -> Floats | None:
    """Return the upper left corners of boxes in rows, y downwards, shape [N, 2]; None where they do not fit."""
    places = np.empty((len(sizes), 2))
    ends: list[float] = []  # of the rows, to the right
    tops: list[float] = []
    below = 0.0
    for k in np.lexsort((-sizes[:, 0], -sizes[:, 1])):
        wide, high = sizes[k] + 2.0 * margin
        row = next((r for r, end in enumerate(ends) if end + wide <= width), None)
        if row is None:
            if wide > width or below + high > 1.0:
                return None
            row = len(ends)
            ends.append(0.0)
            tops.append(below)
            below += float(high)
        places[k] = ends[row] + margin, tops[row] + margin
        ends[row] += float(wide)
    return places


__all__ = ["on_shelves"]
