"""The areas of a pattern's cells on a surface, the measure of the paper's figure 10."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.mesh.surface import triangle_areas

POINTS_AT_ONCE = 1 << 20  # bounds memory: the directions of a million points are 24 MB


class Cells(Protocol):
    """A pattern made of numbered cells, such as circles or the fields of a checker."""

    @property
    def count(self) -> int:
        """The number of cells."""

    def cells(self, directions: ArrayLike) -> NDArray[np.int64]:
        """Return the number of the cell of every direction, -1 for none, shape [N]."""


def cell_areas(
    pattern: Cells, vertices: ArrayLike, faces: ArrayLike, sphere: ArrayLike, *, subdivision: int = 6
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
        Areas in the units of ``vertices`` squared, shape [pattern.count].
    """
    vertices, sphere = np.asarray(vertices, dtype=np.float64), np.asarray(sphere, dtype=np.float64)
    faces = np.asarray(faces, dtype=np.int32)
    bary = part_middles(subdivision)
    area = triangle_areas(vertices, faces) / len(bary)
    total = np.zeros(pattern.count)
    step = max(1, POINTS_AT_ONCE // len(bary))
    for start in range(0, len(faces), step):
        part = slice(start, start + step)
        cell = pattern.cells(np.einsum("bk,fkj->fbj", bary, sphere[faces[part]]).reshape(-1, 3))
        inside = cell >= 0
        weight = np.repeat(area[part], len(bary))
        total += np.bincount(cell[inside], weight[inside], minlength=pattern.count)
    return total


def part_middles(subdivision: int) -> NDArray[np.float64]:
    """Return the barycentric coordinates of the middles of the n² equal parts of a triangle, shape [n², 3]."""
    n = subdivision
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    upright = np.stack([i, j], axis=1)[i + j < n] + 1.0 / 3.0
    turned = np.stack([i, j], axis=1)[i + j < n - 1] + 2.0 / 3.0
    uv = np.concatenate([upright, turned]) / n
    return np.column_stack([uv, 1.0 - uv.sum(axis=1)])
