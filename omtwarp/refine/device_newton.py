"""The Newton matrix of the distortion energy on the device, solved there by conjugate gradients and multigrid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum
from omtwarp.refine.energy import DistortionEnergy
from omtwarp.refine.step_kernels import add_to_diagonal, block_traces, gather_rows, rotation_blocks
from omtwarp.solvers.mesh_factor import MeshFactor, surface_factor
from omtwarp.solvers.multigrid import STRONG_BLOCKS, MultigridSolver, positioned_hierarchy, release_hierarchy
from omtwarp.solvers.triangle_newton.newton import GROWTH, REGULARISATION, factorise_stiffened

# Relative, in the energy's norm. Refinement ends where a step gains a thousandth; with this tolerance its steps do not
# change.
TOLERANCE = 1e-9


class DeviceNewtonMatrix:
    """The matrix of :class:`omtwarp.solvers.triangle_newton.newton.NewtonMatrix` over all vertices of a surface.

    The levels are those of the image's cotangent Laplacian at the first map; later maps are not far from it.

    Args:
        energy: of the surface's maps, on the device.
    """

    def __init__(self, energy: DistortionEnergy):
        surface, device = energy.surface, energy.device
        self._surface, self._device = surface, device
        mesh = surface.on(device)
        self._inputs = [*mesh.vertex_corners, mesh.edges, mesh.faces, mesh.edge_corners]
        self._rotations = wp.empty(6 * surface.vertex_count, dtype=wp.float64, device=device)
        self._sum, self._trace = DeviceSum(device), wp.empty(1, dtype=wp.float64, device=device)
        self._solver: MultigridSolver | None = None
        self._factor: MeshFactor | None = None

    def assemble(self, points: wp.array, hessian: Callable[[], wp.array]) -> None:
        """Assemble the matrix at a map.

        Args:
            points: the map, vec3d, shape [V].
            hessian: makes the Hessians of triangles, shape [F, 21]; they are freed before the levels are made.
        """
        surface, device, count = self._surface, self._device, self._surface.vertex_count
        if self._solver is None:
            release_hierarchy(surface, device)  # the Laplacians of a map are solved before its refinement
            levels = positioned_hierarchy(surface, points.numpy(), device, STRONG_BLOCKS)
            self._solver = MultigridSolver(levels, block=2)
        solver = self._solver
        source, values, own = solver.hierarchy.source, solver.matrix.values, solver.matrix.level.diagonal
        inputs = [source, *self._inputs, hessian()]
        wp.launch(gather_rows, dim=source.size, inputs=inputs, outputs=[values], device=device)
        del inputs
        trace = wp.empty(count, dtype=wp.float64, device=device)
        wp.launch(block_traces, dim=count, inputs=[own, values], outputs=[trace], device=device)
        self._sum.total(trace, self._trace)
        inputs = [own, self._trace, wp.float64(REGULARISATION), wp.float64(GROWTH)]
        wp.launch(add_to_diagonal, dim=count, inputs=inputs, outputs=[values], device=device)
        self._factor = None

    @property
    def diagonal_blocks(self) -> tuple[wp.array, wp.array]:
        """Where the blocks of the vertices are, shape [V], among all that were assembled last, shape [4 N]."""
        assert self._solver is not None
        return self._solver.matrix.level.diagonal, self._solver.matrix.values

    def make_levels(self, points: wp.array) -> None:
        """Make the coarser levels' matrices for what was assembled last, at the map ``points``."""
        assert self._solver is not None
        count = self._surface.vertex_count
        wp.launch(rotation_blocks, dim=count, inputs=[points], outputs=[self._rotations], device=self._device)
        self._solver.refresh_levels(self._rotations)

    def solve(self, coordinates: wp.array) -> None:
        """Solve for tangent coordinates, shape [V, 2], in place.

        Where the iteration does not converge the host factorises the matrix.

        Raises:
            OmtwarpError: the matrix is not finite, or far from semidefinite.
        """
        assert self._solver is not None
        if self._factor is None:
            solved = wp.empty(coordinates.size, dtype=wp.float64, device=self._device)
            if self._solver.solve(coordinates.flatten(), solved, TOLERANCE).converged:
                wp.copy(coordinates.flatten(), solved)
                return
            self._factor = self._factorised(self._solver)
        coordinates.assign(self._factor.solve(coordinates.numpy()))

    def _factorised(self, solver: MultigridSolver) -> MeshFactor:
        source = solver.hierarchy.source.numpy()
        blocks = solver.matrix.values.numpy().reshape(-1, 2, 2)
        diagonal, off_diagonal = (
            blocks[np.flatnonzero(kind)[np.argsort(source[kind])]] for kind in (source % 3 == 0, source % 3 == 1)
        )
        factor = surface_factor(self._surface, block=2)
        factorise_stiffened(factor, diagonal, off_diagonal, 0.0, 0.0)
        return factor


__all__ = ["DeviceNewtonMatrix"]
