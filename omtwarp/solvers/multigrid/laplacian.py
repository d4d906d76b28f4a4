"""The cotangent Laplacian of a surface, assembled and solved on the device."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum
from omtwarp.geometry.edge_weight_kernels import edge_weights_of_corners
from omtwarp.geometry.edge_weights import cotangent_edge_weights
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.multigrid import kernels
from omtwarp.solvers.multigrid.conjugate_gradient import MultigridSolver, Outcome
from omtwarp.solvers.multigrid.hierarchy import STRONG, MeshHierarchy

# Of the energy's norm: two digits above rounding. Harmonic functions are nearly constant on limbs, where what matters
# are the differences.
TOLERANCE = 1e-13
# Levels of the surface also suit its images, unless these are stretched very differently. Then levels of the image,
# which cost as much as several solves, save a half to nine tenths of the iterations.
MANY_ITERATIONS = 60


def surface_hierarchy(surface: Surface, device: wp.Device) -> MeshHierarchy:
    """Return the levels of a surface on a device, by its own cotangent Laplacian.

    They are computed once and cached with the surface.
    """
    return surface.kept(_name(device), lambda: positioned_hierarchy(surface, surface.scaled_vertices, device))


def release_hierarchy(surface: Surface, device: wp.Device) -> None:
    """Free the cached levels of a surface; they are recomputed identically when needed."""
    surface.let_go(_name(device))


def _name(device: wp.Device) -> str:
    return f"multigrid hierarchy on {device}"


def positioned_hierarchy(
    surface: Surface, points: NDArray[np.float64], device: wp.Device, strong: float = STRONG
) -> MeshHierarchy:
    """Return the levels by the cotangent Laplacian at other positions of the vertices, shape [V, 3].

    Args:
        surface: a closed connected surface.
        points: the positions.
        device: where the levels live.
        strong: see :class:`MeshHierarchy`.
    """
    edges, count = surface.edges, surface.vertex_count
    weights = cotangent_edge_weights(surface, points)
    diagonal = np.bincount(edges[:, 0], weights, count) + np.bincount(edges[:, 1], weights, count)
    return MeshHierarchy(count, edges, diagonal.astype(np.float64, copy=False), -weights, device, strong)


class DeviceLaplacian:
    """Solves L u = b for the cotangent Laplacian of a surface, all on the device.

    The levels are those of the surface at its own positions until a solve takes more than ``MANY_ITERATIONS``.

    Args:
        surface: a closed connected surface, V vertices.
        points: positions of the vertices, vec3d, shape [V], on the device; they are kept, and must not change.
        record: see :class:`omtwarp.device.graphs.Graph`.

    Attributes:
        surface, points, device: what it was made for, and where.
    """

    def __init__(self, surface: Surface, points: wp.array, record: bool | None = None):
        self.device = points.device
        self.surface, self.points, self._record = surface, points, record
        self._sum = DeviceSum(self.device, surface.vertex_count)
        self._total = wp.empty(1, dtype=wp.float64, device=self.device)
        self._centred = wp.empty(surface.vertex_count, dtype=wp.float64, device=self.device)
        self._own_levels = False
        self._solver = self._solver_on(surface_hierarchy(surface, self.device))

    def _solver_on(self, hierarchy: MeshHierarchy) -> MultigridSolver:
        surface, device = self.surface, self.device
        mesh = surface.on(device)
        diagonal = wp.empty(surface.vertex_count, dtype=wp.float64, device=device)
        entries = wp.empty(len(mesh.edge_corners), dtype=wp.float64, device=device)
        inputs = [self.points, mesh.faces, mesh.edge_corners]
        wp.launch(edge_weights_of_corners, dim=entries.size, inputs=inputs, outputs=[entries], device=device)
        inputs = [hierarchy.levels[0].pattern.offsets, hierarchy.source, entries]
        wp.launch(kernels.laplacian_diagonal, dim=diagonal.size, inputs=inputs, outputs=[diagonal], device=device)
        wp.launch(kernels.negate_values, dim=entries.size, outputs=[entries], device=device)
        solver = MultigridSolver(hierarchy, record=self._record, laplacian=True)
        solver.refresh(diagonal, entries)
        return solver

    def solve(self, right: wp.array, out: wp.array) -> Outcome:
        """Solve for b with its mean taken off, float64, shape [V]; u has mean zero."""
        self.enqueue(right, out)
        outcome = self._solver.outcome()
        if outcome.iterations > MANY_ITERATIONS and not self._own_levels:
            self._own_levels = True
            levels = positioned_hierarchy(self.surface, self.points.numpy(), self.device)
            self._solver = self._solver_on(levels)
            if not outcome.converged:
                self.enqueue(right, out)
                outcome = self._solver.outcome()
        return outcome

    def enqueue(self, right: wp.array, out: wp.array) -> None:
        """Start a solve without waiting for its result, and without levels for this matrix."""
        wp.copy(self._centred, right)
        self._sum.remove_mean(self._centred, self._total)
        self._solver.enqueue(self._centred, out, TOLERANCE)
        self._sum.remove_mean(out, self._total)


__all__ = ["DeviceLaplacian", "positioned_hierarchy", "release_hierarchy", "surface_hierarchy"]
