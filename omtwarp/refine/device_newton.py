"""The Newton matrix of the distortion energy on the device, solved there by conjugate gradients and multigrid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from omtwarp._warp import wp
from omtwarp.cholesky import MultifrontalCholesky
from omtwarp.mesh.surface import Surface
from omtwarp.multigrid import DeviceSum, MultigridSolver, positioned_hierarchy
from omtwarp.refine.newton import REGULARISATION, factorise_stiffened
from omtwarp.refine.newton_kernels import gather_edge_blocks, gather_vertex_blocks
from omtwarp.refine.step_kernels import add_to_diagonal, rotation_blocks, traces

# Of the energy's norm, the one in which steps count. Refinement ends where a step gains a thousandth; this leaves the
# path of its steps as it is.
TOLERANCE = 1e-9


class DeviceNewtonMatrix:
    """The matrix of :class:`omtwarp.refine.newton.NewtonMatrix` over all vertices of a surface.

    The levels are those of the image's cotangent Laplacian at the first map; later maps are not far from it.

    Args:
        surface: a closed connected surface, V vertices.
        device: a Warp device.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self._surface, self._device = surface, device
        self._rows = [wp.array(array, dtype=wp.int32, device=device) for array in surface.vertex_corners]
        self._sides = [
            wp.array(surface.edges, dtype=wp.vec2i, device=device),
            wp.array(surface.faces, dtype=wp.vec3i, device=device),
            wp.array(surface.edge_corners, dtype=wp.vec2i, device=device),
        ]
        self._rotations = wp.empty(6 * surface.vertex_count, dtype=wp.float64, device=device)
        self._sum, self._trace = DeviceSum(device), wp.empty(1, dtype=wp.float64, device=device)
        self._solver: MultigridSolver | None = None
        self._factor: MultifrontalCholesky | None = None

    def refresh(self, points: wp.array, hessian: Callable[[], wp.array]) -> None:
        """Take the values at a map.

        Args:
            points: the map, vec3d, shape [V].
            hessian: makes the Hessians of triangles, shape [F, 36]; they are let go of before the levels are made.
        """
        device, surface = self._device, self._surface
        diagonal = wp.empty((surface.vertex_count, 4), dtype=wp.float64, device=device)
        off_diagonal = wp.empty((len(surface.edges), 4), dtype=wp.float64, device=device)
        self._assemble(hessian(), diagonal, off_diagonal)
        inputs, outputs = [points], [self._rotations]
        wp.launch(rotation_blocks, dim=surface.vertex_count, inputs=inputs, outputs=outputs, device=device)
        if self._solver is None:
            self._solver = MultigridSolver(positioned_hierarchy(surface, points.numpy(), device), block=2)
        self._solver.refresh(diagonal.flatten(), off_diagonal.flatten(), self._rotations)
        self._factor = None

    def _assemble(self, blocks: wp.array, diagonal: wp.array, off_diagonal: wp.array) -> None:
        count, device = self._surface.vertex_count, self._device
        for kernel, where, out in (
            (gather_vertex_blocks, self._rows, diagonal),
            (gather_edge_blocks, self._sides, off_diagonal),
        ):
            wp.launch(kernel, dim=out.shape[0], inputs=[*where, blocks], outputs=[out], device=device)
        trace = wp.empty(count, dtype=wp.float64, device=device)
        wp.launch(traces, dim=count, inputs=[diagonal], outputs=[trace], device=device)
        self._sum.total(trace, self._trace)
        inputs = [self._trace, wp.float64(REGULARISATION)]
        wp.launch(add_to_diagonal, dim=count, inputs=inputs, outputs=[diagonal], device=device)

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

    def _factorised(self, solver: MultigridSolver) -> MultifrontalCholesky:
        source = solver.hierarchy.source.numpy()
        blocks = solver.matrix.values.numpy().reshape(-1, 2, 2)
        diagonal, off_diagonal = (
            blocks[np.flatnonzero(kind)[np.argsort(source[kind])]] for kind in (source % 3 == 0, source % 3 == 1)
        )
        factor = MultifrontalCholesky(self._surface.dissection, block=2)
        factorise_stiffened(factor, diagonal, off_diagonal, 0.0, 0.0)
        return factor


__all__ = ["DeviceNewtonMatrix"]
