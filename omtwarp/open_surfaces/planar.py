"""Triangles of a map to the plane: exact orientation, and repair of the few that a projection turns over."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.flips.predicates import flipped_faces

Floats = NDArray[np.float64]
SWEEPS = 50  # of repair; those seen took three at the most


def flipped_in_plane(points: Floats, faces: NDArray) -> NDArray[np.bool_]:
    """Whether every triangle of a plane map is not counter-clockwise, decided exactly, shape [F].

    Twice the area of a triangle is the determinant of its corners (x, y, 1), which the predicate of the sphere decides.

    Args:
        points: shape [V, 2].
        faces: shape [F, 3].
    """
    return flipped_faces(np.concatenate([points, np.ones((len(points), 1))], axis=1), faces)


def mend_in_plane(points: Floats, faces: NDArray, held: NDArray[np.bool_]) -> tuple[Floats, int]:
    """Turn flipped triangles back by moving their corners towards the mean of their neighbours.

    Args:
        points: a map to the plane with few flips, shape [V, 2].
        faces: shape [F, 3].
        held: vertices that stay where they are, shape [V].

    Returns:
        The map, and the number of flips that are left.
    """
    flipped = flipped_in_plane(points, faces)
    if not flipped.any():
        return points, 0
    count = len(points)
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    pairs = np.unique(np.concatenate([np.stack([tail, head], 1), np.stack([head, tail], 1)]), axis=0)
    degree = np.bincount(pairs[:, 0], minlength=count)
    moved = points.copy()
    for _ in range(SWEEPS):
        touched = np.zeros(count, dtype=bool)
        touched[faces[flipped]] = True
        touched &= ~held
        means = np.stack([np.bincount(pairs[:, 0], moved[pairs[:, 1], k], minlength=count) for k in (0, 1)], axis=1)
        moved[touched] = 0.5 * (moved[touched] + means[touched] / degree[touched, None])
        flipped = flipped_in_plane(moved, faces)
        if not flipped.any():
            break
    return moved, int(flipped.sum())


__all__ = ["flipped_in_plane", "mend_in_plane"]
