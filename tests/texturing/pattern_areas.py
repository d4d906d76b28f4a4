"""The areas of a pattern's cells on a surface, the measure of the paper's figure 10."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from omtwarp.mesh.surface import triangle_areas
from omtwarp.texturing.patterns.checker import Checker
from omtwarp.texturing.patterns.circles import Circles

POINTS_AT_ONCE = 1 << 20  # bounds memory: the directions of a million points are 24 MB


def cells(pattern: Circles | Checker, directions: ArrayLike) -> NDArray[np.int64]:
    """Return the circle of every direction, -1 between the circles, or the field, row by row from the north-west."""
    d = np.asarray(directions, dtype=np.float64)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    if isinstance(pattern, Circles):
        distance, index = cKDTree(pattern.centres).query(d)
        return np.where(distance <= 2.0 * np.sin(0.5 * pattern.radius), index, -1)
    u, v = 0.5 + np.arctan2(d[:, 1], d[:, 0]) / (2.0 * np.pi), 0.5 - np.arcsin(d[:, 2]) / np.pi
    column = np.clip(np.floor(u * pattern.columns), 0, pattern.columns - 1)
    return (np.clip(np.floor(v * pattern.rows), 0, pattern.rows - 1) * pattern.columns + column).astype(np.int64)


def cell_areas(
    pattern: Circles | Checker, vertices: ArrayLike, faces: ArrayLike, sphere: ArrayLike, *, subdivision: int = 6
) -> NDArray[np.float64]:
    """Return the area that each cell of a pattern covers on a surface.

    With an area-preserving map equal circles on the sphere cover equal areas of the surface; with a conformal map they
    do not.

    Args:
        pattern: for instance ``omtwarp.texturing.pattern("circles")``.
        vertices: shape [V, 3].
        faces: shape [F, 3].
        sphere: the map, unit vectors, shape [V, 3].
        subdivision: every triangle is divided into this number squared of equal parts, each of which counts for the
            cell in which its middle lies.

    Returns:
        Areas in the units of ``vertices`` squared, shape [C].
    """
    vertices, sphere = np.asarray(vertices, dtype=np.float64), np.asarray(sphere, dtype=np.float64)
    faces = np.asarray(faces, dtype=np.int32)
    bary = part_middles(subdivision)
    area = triangle_areas(vertices, faces) / len(bary)
    count = pattern.count if isinstance(pattern, Circles) else pattern.columns * pattern.rows
    total = np.zeros(count)
    step = max(1, POINTS_AT_ONCE // len(bary))
    for start in range(0, len(faces), step):
        part = slice(start, start + step)
        cell = cells(pattern, np.einsum("bk,fkj->fbj", bary, sphere[faces[part]]).reshape(-1, 3))
        inside = cell >= 0
        weight = np.repeat(area[part], len(bary))
        total += np.bincount(cell[inside], weight[inside], minlength=count)
    return total


def part_middles(subdivision: int) -> NDArray[np.float64]:
    """Return the barycentric coordinates of the middles of the n² equal parts of a triangle, shape [n², 3]."""
    n = subdivision
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    upright = np.stack([i, j], axis=1)[i + j < n] + 1.0 / 3.0
    turned = np.stack([i, j], axis=1)[i + j < n - 1] + 2.0 / 3.0
    uv = np.concatenate([upright, turned]) / n
    return np.column_stack([uv, 1.0 - uv.sum(axis=1)])
