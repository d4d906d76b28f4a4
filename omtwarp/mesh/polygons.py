"""Polygons and strips of triangles, as files list them, cut into triangles, and triangles cut evenly."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import marked, whole_numbers

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Points [V, 3] and triangles [F, 3]."""

Triangles = tuple[NDArray[np.generic], NDArray[np.generic], list[str]]
"""Points [V, 3], triangles [F, 3], and notes about what was decided."""


def fans(flat: NDArray[np.generic], corners: NDArray[np.int64]) -> tuple[NDArray[np.generic], list[str]]:
    """Cut polygons into fans of triangles.

    Args:
        flat: all corners, one polygon after another.
        corners: how many each polygon has, shape [P].

    Returns:
        The triangles' corners, shape [F, 3], and notes about what was cut.

    Raises:
        OmtwarpError: no polygons, or one with fewer than three corners.
    """
    if not len(corners):
        raise OmtwarpError("not a triangle mesh: no faces in it")
    if (corners < 3).any():
        raise OmtwarpError(f"not a triangle mesh: face {int(np.argmax(corners < 3))} has fewer than three corners")
    if (corners == 3).all():
        return flat.reshape(-1, 3), []
    larger = int((corners != 3).sum())
    # A fan from every polygon's first corner.
    fans = corners - 2
    first = np.repeat(np.cumsum(corners) - corners, fans)
    step = np.arange(len(first)) - np.repeat(np.cumsum(fans) - fans, fans)
    note = f"cut {larger} face{'s' if larger > 1 else ''} with more than three corners into triangles"
    return flat[np.stack([first, first + step + 1, first + step + 2], axis=1)], [note]


def taken_together(meshes: Sequence[Mesh]) -> Mesh:
    """Return the vertices and triangles of several meshes as those of one."""
    starts = np.cumsum([0, *(len(points) for points, _ in meshes)])
    triangles = [faces + start for (_, faces), start in zip(meshes, starts[:-1], strict=True)]
    return np.concatenate([points for points, _ in meshes]), np.concatenate(triangles)


def cut_at_middles(
    faces: NDArray[np.integer], middles: NDArray[np.integer], points: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Cut triangles along the lines between new vertices on their edges.

    Args:
        faces: triangles, shape [F, 3].
        middles: the new vertex of the edge from corner k to corner k + 1, or -1, shape [F, 3].
        points: the vertices and new ones, float64, shape [V, 3]: of a triangle with two new vertices they decide
            which diagonal of the quadrilateral is cut along, the shorter one; without them always the one that goes
            from a corner.

    Returns:
        The parts, int32, shape [G, 3], those of triangles with fewer new vertices first, and of which triangle each
        is, shape [G].
    """
    new = middles >= 0
    count = new.sum(axis=1)
    # Turned so that the first edge is the lone one with a new vertex, or the one after the lone one without.
    first = np.where(count == 2, new.argmin(axis=1) + 1, np.where(count == 1, new.argmax(axis=1), 0))
    corners = (np.arange(3) + first[:, None]) % 3
    (a, b, c), (p, q, r) = (np.take_along_axis(rows, corners, axis=1).T for rows in (faces, middles))
    start, end = a, q
    if points is not None:
        short = np.linalg.norm(points[a] - points[q], axis=1) <= np.linalg.norm(points[p] - points[c], axis=1)
        start, end = np.where(short, a, p), np.where(short, q, c)
    pieces = [
        [(a, b, c)],
        [(a, p, c), (p, b, c)],
        [(p, b, q), (a, p, end), (start, q, c)],
        [(a, p, r), (p, b, q), (r, q, c), (p, q, r)],
    ]
    of_count = [np.flatnonzero(count == k) for k in range(len(pieces))]
    cut = [np.stack(piece, axis=1)[of_count[k]] for k, several in enumerate(pieces) for piece in several]
    origin = [of_count[k] for k, several in enumerate(pieces) for _ in several]
    return np.concatenate(cut).astype(np.int32), np.concatenate(origin)


def triangles_of_strips(flat: NDArray[np.generic], lengths: NDArray[np.int64]) -> NDArray[np.generic]:
    """Return the triangles of strips: three corners in a row each, every second one turned.

    Args:
        flat: all corners, one strip after another.
        lengths: how many each strip has, shape [S]; a strip of fewer than three has no triangle.

    Returns:
        Shape [F, 3]. Triangles that repeat a corner, with which a strip goes round a bend, are left out.
    """
    counts = np.maximum(lengths - 2, 0)
    first = np.repeat(np.cumsum(lengths) - lengths, counts)
    step = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    odd = step % 2
    triangles = flat[np.stack([first + step + odd, first + step + 1 - odd, first + step + 2], axis=1)]
    return triangles[~(triangles == np.roll(triangles, -1, axis=1)).any(axis=1)]


def parts_of_strips(flat: NDArray[np.generic], sizes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split strips at negative numbers, with which the Stanford scans' PLY files begin a new strip.

    Args:
        flat: all corners, one strip after another.
        sizes: how many each strip has, shape [S].

    Returns:
        The corners without the negative numbers, and the length of every part.
    """
    corners = whole_numbers(flat, "corners of strips", (None,))
    part = np.repeat(np.arange(len(sizes)), sizes) + np.cumsum(corners < 0)
    kept = corners >= 0
    return corners[kept], np.unique(part[kept], return_counts=True)[1]


def counted_lists(entries: NDArray[np.generic], count: int) -> tuple[NDArray[np.generic], NDArray[np.int64]]:
    """Split numbers in which the length of every list stands before its entries.

    Args:
        entries: the numbers.
        count: how many lists there are.

    Returns:
        The lists' entries one after another, and their lengths, shape [count].

    Raises:
        OmtwarpError: the numbers end before the lists do, or a length is no whole number.
    """
    numbers = whole_numbers(entries, "lengths and corners of faces", (None,))
    starts = np.empty(min(count, len(numbers) + 1), dtype=np.int64)
    place = 0
    for row in range(count):
        if place >= len(numbers) or numbers[place] < 0:
            raise OmtwarpError(f"cut short: {count} faces announced, {row} there")
        starts[row] = place
        place += 1 + int(numbers[place])
    if place > len(numbers):
        raise OmtwarpError(f"cut short: {count} faces announced, the last one with fewer corners than it says")
    return numbers[:place][~marked(place, starts[:count])], numbers[starts[:count]]


@lru_cache(maxsize=8)
def grid_points(parts: int) -> NDArray[np.int64]:
    """Return the steps from corner 0 towards corners 1 and 2 of the points of an evenly divided triangle, shape [K, 2].

    Row i holds the points with i steps towards corner 1; point (i, j) is number i (2 n + 3 - i) / 2 + j.
    """
    steps = np.arange(parts + 1)
    return np.argwhere(np.add.outer(steps, steps) <= parts)


def grid_shares(parts: int) -> NDArray[np.float64]:
    """Return the barycentric coordinates of the points of an evenly divided triangle, shape [K, 3]."""
    points = grid_points(parts)
    return np.column_stack([parts - points.sum(axis=1), points]) / parts


@lru_cache(maxsize=8)
def grid_triangles(parts: int) -> NDArray[np.int64]:
    """Return the corners of the parts of an evenly divided triangle, numbers of its points, shape [parts², 3]."""
    here, steps = np.arange(len(grid_points(parts))), grid_points(parts).sum(axis=1)
    ahead = here + parts + 1 - grid_points(parts)[:, 0]  # one step towards corner 1
    upright, turned = np.stack([here, ahead, here + 1], axis=1), np.stack([ahead, ahead + 1, here + 1], axis=1)
    return np.concatenate([upright[steps < parts], turned[steps < parts - 1]])
