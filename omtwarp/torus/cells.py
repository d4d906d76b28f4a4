"""The optimal map of a quartered mesh to a flat torus, in which every triangle of the mesh keeps its area.

The method is that of :mod:`omtwarp.optimal.cells` on the sphere: the cells whose areas are kept are the triangles of
the mesh, hexagons in the image, each the sum of four parts; their masses lie on their six vertices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.quarter import PARTS, QuarteredSurface
from omtwarp.optimal.cells import CORNER_SHARE, MAX_CELL_ERROR, MAX_CELL_RMS, MIDDLE_SHARE
from omtwarp.solvers.mesh_factor import SaddlePointFactor, cell_saddle_factor
from omtwarp.torus.energy import PlaneTerms, TorusEnergy
from omtwarp.torus.harmonic import FlatTorus, quantised

Floats = NDArray[np.float64]

_SHARES = np.repeat([CORNER_SHARE, MIDDLE_SHARE], 3)


def quartered_torus(
    quartered: QuarteredSurface, faces: NDArray[np.integer], wraps: NDArray[np.int64], *maps: Floats
) -> tuple[NDArray[np.int64], list[Floats]]:
    """Extend maps to a torus to the quartered mesh, with new vertices at the midpoints of the edges' images.

    Args:
        quartered: the mesh's triangles in four parts each.
        faces: those of the mesh itself, shape [F, 3].
        wraps: at the corners of those, shape [F, 3, 2].
        maps: coordinates of the mesh's vertices, shape [V, 2] each.

    Returns:
        The wraps at the corners of the parts, shape [4 F, 3, 2], and the coordinates of all vertices.
    """
    count, edges = len(maps[0]), len(quartered.ends)
    # A middle has the wraps of the first end of its edge.
    first = quartered.ends[quartered.middles - count, 0]
    own = np.where((faces == first)[..., None], wraps, np.roll(wraps, -1, axis=1))
    step = np.zeros((edges, 2), dtype=np.int64)
    after = np.roll(wraps, -1, axis=1) - wraps
    step[quartered.middles - count] = np.where((faces == first)[..., None], after, -after)
    parts = np.empty((len(faces), PARTS, 3, 2), dtype=np.int64)
    for k in range(3):
        parts[:, k] = np.stack([wraps[:, k], own[:, k], own[:, k - 1]], axis=1)
    parts[:, 3] = own
    found = []
    for places in maps:
        one, other = places[quartered.ends[:, 0]], places[quartered.ends[:, 1]]
        found.append(np.concatenate([places, quantised(0.5 * (one + other + step))]))
    return parts.reshape(-1, 3, 2), found


class TorusCellEnergy(TorusEnergy):
    """Evaluates maps of a quartered surface: as its base, with triangles made of four parts in place of rings.

    Args:
        quartered: the mesh's triangles in four parts each.
        torus: a map of the quartered surface, for its wraps and lattice.
        start: x in the plane, shape [V, 2].
        shape_weight: of the distortion of the parts.
    """

    area_tolerances = (MAX_CELL_RMS, MAX_CELL_ERROR)

    def __init__(self, quartered: QuarteredSurface, torus: FlatTorus, start: Floats, shape_weight: float):
        super().__init__(quartered.surface, torus, start, shape_weight)
        self._quartered = quartered
        parts = quartered.surface.faces.reshape(-1, PARTS, 3)
        self._cells = np.ascontiguousarray(np.concatenate([parts[:, :3, 0], quartered.middles], axis=1))
        shift = (torus.wraps @ torus.lattice).reshape(-1, PARTS, 3, 2)
        self._cell_shift = np.concatenate([shift[:, :3, 0], shift[:, 3]], axis=1)
        self.wanted = quartered.sum_of_parts(quartered.surface.face_areas)
        self._factor: SaddlePointFactor | None = None

    def saddle_factor(self) -> SaddlePointFactor:
        """Factorise the matrices that :meth:`blocks` gives; the same object at every call."""
        if self._factor is None:
            self._factor = cell_saddle_factor(self.surface, self._cells)
        return self._factor

    def cells_of(self, triangles: Floats) -> Floats:
        """Return the areas of the mesh's triangles, shape [F], from those of their parts."""
        return self._quartered.sum_of_parts(triangles)

    def means(self, terms: PlaneTerms) -> Floats:
        """Return the mean of |y - x|² over the mass of every triangle, shape [F]."""
        return terms.square[self._cells] @ _SHARES

    def masses(self, terms: PlaneTerms) -> Floats:
        """Return every vertex's share of the torus, times 4π, shape [V]."""
        shares = terms.cells[:, None] * _SHARES
        return np.bincount(self._cells.ravel(), shares.ravel(), self.surface.vertex_count).astype(np.float64)

    def on_triangles(self, potential: Floats) -> Floats:
        """Return the potential of every part, shape [4 F], from that of the triangles."""
        return np.repeat(potential, PARTS)

    def area_derivatives(self, points: Floats) -> Floats:
        """Return the derivatives of the area of every triangle by its six vertices, corners first, shape [F, 6, 2]."""
        places = points[self._cells] + self._cell_shift
        ring = places[:, [0, 3, 1, 4, 2, 5]]  # of the hexagon, in order
        across = np.roll(ring, 1, axis=1) - np.roll(ring, -1, axis=1)
        by_ring = 0.5 * np.stack([-across[..., 1], across[..., 0]], axis=2)
        return np.ascontiguousarray(by_ring[:, [0, 2, 4, 1, 3, 5]])


__all__ = ["TorusCellEnergy", "quartered_torus"]
