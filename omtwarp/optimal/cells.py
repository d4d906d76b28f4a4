"""The cells whose areas a map keeps: the triangles around every vertex, or every triangle of a mesh that is quartered.

To keep the areas of all triangles of a mesh would leave its map no freedom: 2V - 5 conditions on 2V - 3 coordinates.
To keep the areas around vertices, on which the paper's density is defined, leaves half of it, as in the smooth problem.
In a quartered mesh (:mod:`omtwarp.mesh.quarter`) the triangles c of the mesh, each the sum of four parts, can be kept:
this is the element P1-iso-P2/P0 of incompressible elasticity, which does not lock. A triangle's mass lies on its six
vertices, a twelfth on each corner and a quarter on each middle of an edge, so that the vertices' masses are those of
the quartered mesh.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty
from omtwarp.device.memory import Workspace
from omtwarp.device.start import wp
from omtwarp.device.threads import launch_parts
from omtwarp.mesh.quarter import PARTS, QuarteredSurface
from omtwarp.mesh.surface import Surface
from omtwarp.optimal.domain import Domain
from omtwarp.optimal.kernels import areas_around, edge_slopes
from omtwarp.solvers.mesh_factor import (
    SaddlePointFactor,
    VertexFactor,
    cell_saddle_factor,
    surface_factor,
    surface_saddle_factor,
)

Numbers = NDArray[np.float64]

CORNER_SHARE, MIDDLE_SHARE = 1.0 / 12.0, 1.0 / 4.0  # of a triangle's mass, on each of its six vertices
# Largest root mean square and largest single relative error of areas that count as kept: of those around vertices, and
# of triangles, which are corrected afterwards.
MAX_RING_RMS, MAX_RING_ERROR = 2e-4, 9e-3
MAX_CELL_RMS, MAX_CELL_ERROR = 1e-3, 0.05


class Cells(Protocol):
    """N cells that cover a surface once, or several times.

    Attributes:
        wanted: their areas, shape [N].
        tolerances: root mean square and largest relative error up to which areas count as kept.
    """

    wanted: Numbers
    tolerances: tuple[float, float]

    def areas(self, triangles: wp.array) -> Numbers:
        """Return the areas of the cells, shape [N], from those of the triangles, float64, shape [F]."""

    def means(self, values: Numbers) -> Numbers:
        """Return the mean over every cell's mass, shape [N], of a number per vertex, shape [V]."""

    def masses(self, areas: Numbers) -> Numbers:
        """Divide the areas of the cells among the vertices as their masses are, shape [V]; 4π in all."""

    def on_triangles(self, potential: Numbers) -> Numbers:
        """Return the sum of the potentials of the cells that a triangle belongs to, shape [F]."""

    def slopes(self, domain: Domain, points: wp.array) -> Numbers:
        """Return the derivatives of the areas of a map as the factor takes them."""

    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every cell."""


class RingCells:
    """The triangles around every vertex: N = V cells, which cover the surface three times.

    Args:
        surface: V vertices.
        device: a Warp device.
    """

    tolerances = (MAX_RING_RMS, MAX_RING_ERROR)

    def __init__(self, surface: Surface, device: wp.Device):
        self._surface, self._device, self._mesh = surface, device, surface.on(device)
        self.wanted: Numbers = 3.0 * surface.vertex_areas
        self._forward, self._backward = (empty(len(surface.edges), wp.vec2d, device) for _ in range(2))

    def areas(self, triangles: wp.array) -> Numbers:
        """Return the areas around vertices, shape [V], from those of the triangles, float64, shape [F]."""
        sums = empty(self._surface.vertex_count, wp.float64, self._device)

        def around(part: slice) -> tuple[list[object], list[object]]:
            return [triangles, *self._mesh.vertex_corners, part.start], [sums]

        launch_parts(areas_around, sums.size, around, self._device)
        return sums.numpy()

    def means(self, values: Numbers) -> Numbers:
        """Return the numbers of the vertices themselves, shape [V]."""
        return values

    def masses(self, areas: Numbers) -> Numbers:
        """Return a third of the areas around vertices, shape [V]."""
        return areas / 3.0

    def on_triangles(self, potential: Numbers) -> Numbers:
        """Return the sum of the potentials of every triangle's corners, shape [F]."""
        one, two, three = (potential[self._surface.faces[:, k]] for k in range(3))
        return np.asarray(one + two + three)

    def slopes(self, domain: Domain, points: wp.array) -> Numbers:
        """Return the derivatives across every edge, both ways, shape [2, E, 2]."""
        mesh, of_triangles = self._mesh, domain.area_slopes(points)

        def across(part: slice) -> tuple[list[object], list[object]]:
            inputs = [of_triangles, mesh.faces, mesh.edges[part], mesh.edge_corners[part]]
            return inputs, [self._forward[part], self._backward[part]]

        launch_parts(edge_slopes, self._forward.size, across, self._device)
        return np.stack([self._forward.numpy(), self._backward.numpy()])

    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every vertex."""
        return surface_saddle_factor(self._surface, workspace)


class TriangleCells:
    """The triangles of a mesh, each the sum of four parts in the quartered mesh.

    Args:
        quartered: the mesh's N triangles in four parts each.

    Attributes:
        vertices: of every cell, its corners, then the middles of the edges that begin there, shape [N, 6].
    """

    tolerances = (MAX_CELL_RMS, MAX_CELL_ERROR)

    def __init__(self, quartered: QuarteredSurface):
        self._quartered, self._count = quartered, quartered.surface.vertex_count
        parts = quartered.surface.faces.reshape(-1, PARTS, 3)
        self.vertices: NDArray[np.int32] = np.ascontiguousarray(
            np.concatenate([parts[:, :3, 0], quartered.middles], axis=1)
        )
        self.wanted: Numbers = quartered.sum_of_parts(quartered.surface.face_areas)
        self._shares = np.repeat([CORNER_SHARE, MIDDLE_SHARE], 3)
        self._factor: SaddlePointFactor | None = None

    def areas(self, triangles: wp.array) -> Numbers:
        """Return the areas of the mesh's triangles, shape [N], from those of their parts."""
        return self._quartered.sum_of_parts(triangles.numpy())

    def means(self, values: Numbers) -> Numbers:
        """Return the mean over every triangle's mass, shape [N]."""
        return np.asarray(values[self.vertices] @ self._shares)

    def masses(self, areas: Numbers) -> Numbers:
        """Divide the areas of the triangles among their vertices in the shares of mass, shape [V]."""
        shares = areas[:, None] * self._shares
        return np.bincount(self.vertices.ravel(), shares.ravel(), self._count).astype(np.float64)

    def on_triangles(self, potential: Numbers) -> Numbers:
        """Return every triangle's potential at its parts, shape [4 N]."""
        return np.repeat(potential, PARTS)

    def slopes(self, domain: Domain, points: wp.array) -> Numbers:
        """Return the derivatives by every triangle's six vertices, shape [N, 6, 2]."""
        parts = domain.area_slopes(points).numpy().reshape(-1, PARTS, 3, 2)
        at_corners, own, before = (parts[:, :3, k] for k in range(3))
        return np.concatenate([at_corners, own + np.roll(before, -1, axis=1) + parts[:, 3]], axis=1)

    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every triangle: the same object at every call."""
        if self._factor is None:
            self._factor = cell_saddle_factor(self._quartered.surface, self.vertices)
        return self._factor


class MeasuredRings(RingCells):
    """The triangles around every vertex, whose areas are measured and not kept; vertices count by their own masses."""

    tolerances = (np.inf, np.inf)

    def masses(self, areas: Numbers) -> Numbers:
        """Return the masses of the vertices, shape [V]."""
        return self._surface.vertex_areas

    def on_triangles(self, potential: Numbers) -> Numbers:
        """Return zeros, shape [F], as masses do not depend on areas."""
        return np.zeros(self._surface.face_count)

    def slopes(self, domain: Domain, points: wp.array) -> Numbers:
        """Return nothing: the factor takes no derivatives of areas."""
        return np.empty(0)

    def factor(self, workspace: Workspace | None = None) -> SaddlePointFactor:
        """Return what factorises matrices of the vertices' coordinates alone; multipliers stay 0."""
        return VertexFactor(surface_factor(self._surface, block=2, workspace=workspace))


__all__ = ["Cells", "MeasuredRings", "RingCells", "TriangleCells"]
