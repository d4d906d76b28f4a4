"""Cutting of long triangles in strips, for searches through them by trees of boxes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Cut = Callable[[NDArray[np.int64], NDArray[np.intp]], Array]


def in_strips(
    corners: Array, shortest: NDArray[np.intp], counts: NDArray[np.int64], cut: Cut
) -> tuple[NDArray[np.intp], Array]:
    """Cut triangles in strips along one of their edges.

    Args:
        corners: of the triangles, in any coordinates, shape [N, 3, D].
        shortest: the edge (k, k + 1) that strips are parallel to, shape [N].
        counts: of the strips, shape [N].
        cut: returns the share of the way from the corner opposite that edge to it where a strip begins, shape [M], from
            the number of the strip and that of its triangle, shape [M] each; 0 at the corner, 1 at the edge.

    Returns:
        The triangle that every part is of, shape [P], and the parts' corners in the same sense of rotation, shape
        [P, 3, D]; a strip is two parts, and that at the corner one.
    """
    turn = (shortest[:, None] + np.array([2, 0, 1])) % 3
    apex, one, other = np.take_along_axis(corners, turn[:, :, None], axis=1).transpose(1, 0, 2)
    whole = np.repeat(np.arange(len(counts)), counts)
    strip = np.arange(len(whole)) - np.repeat(np.cumsum(counts) - counts, counts)
    above, below = (cut(number, whole)[:, None] for number in (strip, strip + 1))
    (a, b), (c, d) = (
        [(1.0 - share) * apex[whole] + share * end[whole] for end in (one, other)] for share in (above, below)
    )
    inner = strip > 0
    parts = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)[inner]])
    return np.concatenate([whole, whole[inner]]), parts
