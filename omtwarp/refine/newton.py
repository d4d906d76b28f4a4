"""The Newton matrix of the distortion energy: gathered from triangles and factorised in an order kept for the mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import wp
from omtwarp.cholesky import MultifrontalCholesky, NotPositiveDefinite
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import Surface
from omtwarp.refine.newton_kernels import gather_edge_blocks, gather_vertex_blocks

REGULARISATION = 1e-8  # of the mean diagonal: holds the three rotations and triangles cut off entirely
# Where rounding still leaves a pivot that is not positive, the diagonal grows by these parts of itself.
STIFFER = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


class NewtonMatrix:
    """Sums per-triangle blocks into a sparse matrix over two tangent coordinates per vertex, and solves with it.

    The order of elimination and all storage are kept from one factorisation to the next.
    """

    def __init__(self, surface: Surface):
        self._factor = MultifrontalCholesky(surface.dissection, block=2)
        self._rows = [wp.array(array, dtype=wp.int32, device="cpu", copy=False) for array in surface.vertex_corners]
        self._sides = [
            wp.array(surface.edges, dtype=wp.vec2i, device="cpu", copy=False),
            wp.array(surface.faces, dtype=wp.vec3i, device="cpu", copy=False),
            wp.array(surface.edge_corners, dtype=wp.vec2i, device="cpu", copy=False),
        ]
        self._diagonal = wp.empty((surface.vertex_count, 4), dtype=wp.float64, device="cpu")
        self._off_diagonal = wp.empty((len(surface.edges), 4), dtype=wp.float64, device="cpu")

    def assemble(self, blocks: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The matrix as blocks of vertices, [V, 2, 2], and of edges, [E, 2, 2], from blocks of triangles, [F, 36]."""
        source = wp.array(np.ascontiguousarray(blocks), dtype=wp.float64, device="cpu", copy=False)
        for kernel, where, out in (
            (gather_vertex_blocks, self._rows, self._diagonal),
            (gather_edge_blocks, self._sides, self._off_diagonal),
        ):
            wp.launch(kernel, dim=out.shape[0], inputs=[*where, source], outputs=[out], device="cpu")
        return self._diagonal.numpy().reshape(-1, 2, 2), self._off_diagonal.numpy().reshape(-1, 2, 2)

    def factorise(self, blocks: NDArray[np.float64]) -> None:
        """Assemble and factorise.

        Raises:
            OmtwarpError: the blocks are not finite.
        """
        diagonal, off_diagonal = self.assemble(blocks)
        own = diagonal[:, [0, 1], [0, 1]]
        shift = REGULARISATION * own.mean()
        for part in STIFFER:
            diagonal[:, [0, 1], [0, 1]] = own * (1.0 + part) + shift
            try:
                self._factor.factorise(diagonal, off_diagonal)
                return
            except NotPositiveDefinite:
                continue
        raise OmtwarpError("the map cannot be refined: its distortion is not finite")

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for tangent coordinates, shape [V, 2]."""
        return self._factor.solve(right)
