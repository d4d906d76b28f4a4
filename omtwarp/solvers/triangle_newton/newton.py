"""Newton matrices of patches, gathered from triangles and factorised in an order that is kept."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import Workspace, sent
from omtwarp.device.start import wp
from omtwarp.device.threads import Arguments, cut, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.patches import Patches
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.cholesky import NotPositiveDefinite, part_dissection
from omtwarp.solvers.mesh_factor import mesh_factor
from omtwarp.solvers.triangle_newton.newton_kernels import gather_edge_blocks, gather_vertex_blocks

# Where rounding still leaves a pivot that is not positive, the diagonal grows by these parts of itself.
DIAGONAL_SHIFTS = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


class PatchMatrix:
    """The Newton matrix of the freed vertices of patches; order of elimination and storage are kept.

    Args:
        patches: what may move.
        surface: the surface that they are part of.
        growth: what is added to the diagonal, relative to its mean at each vertex.
    """

    def __init__(self, patches: Patches, surface: Surface, growth: float):
        count = patches.free
        own = np.where(patches.faces < count, patches.faces, -1)
        flat = own.ravel()
        corners = np.argsort(flat, kind="stable").astype(np.int32)[int((flat < 0).sum()) :]
        offsets = np.zeros(count + 1, dtype=np.int32)
        np.cumsum(np.bincount(flat[flat >= 0], minlength=count), out=offsets[1:])
        one, other = np.roll(own, -1, axis=1).ravel(), np.roll(own, -2, axis=1).ravel()
        inner = np.flatnonzero((one >= 0) & (other >= 0))
        low, high = np.minimum(one, other)[inner], np.maximum(one, other)[inner]
        order = np.argsort(low.astype(np.int64) * count + high, kind="stable")
        edges = np.stack([low[order[0::2]], high[order[0::2]]], axis=1)
        edge_corners = inner[order].astype(np.int32).reshape(-1, 2)

        self._sides = [sent(edges, wp.vec2i), sent(own, wp.vec3i), sent(edge_corners, wp.vec2i)]
        self._rows = [sent(offsets, wp.int32), sent(corners, wp.int32)]
        self._blocks = [wp.empty((n, 4), dtype=wp.float64, device="cpu") for n in (count, len(edges))]
        factor = mesh_factor(
            count, edges, lambda: part_dissection(surface, patches.vertices[:count], edges), 2, Workspace()
        )
        self._growth, self._factor = growth, factor

    def factorise(self, blocks: NDArray[np.float64]) -> None:
        """Factorise the matrix of the given blocks of triangles, with a diagonal that grows until it is definite.

        What is added is relative to each vertex, which does not depend on the basis of its tangent plane.

        Raises:
            OmtwarpError: the blocks are not finite, or far from semidefinite.
        """
        diagonal, off_diagonal = self._assembled(blocks)
        own = diagonal[:, [0, 1], [0, 1]]
        of_vertices = own.mean(axis=1, keepdims=True)
        for part in DIAGONAL_SHIFTS:
            self.diagonal = own + (self._growth + part) * of_vertices
            diagonal[:, [0, 1], [0, 1]] = self.diagonal
            try:
                self._factor.factorise(diagonal, off_diagonal)
                return
            except NotPositiveDefinite:
                continue
        raise OmtwarpError("the distortion of the map is not finite")

    def _assembled(self, blocks: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sum blocks of triangles, [F, 21], to those of vertices, [V, 2, 2], and of edges, [E, 2, 2]."""
        source = sent(blocks, wp.float64)
        of_vertices, of_edges = self._blocks
        (offsets, corners), (edges, faces, edge_corners) = self._rows, self._sides

        def at_vertices(part: slice) -> Arguments:
            rows = cut(offsets, slice(part.start, part.stop + 1))
            return [rows, corners, source], [cut(of_vertices, part)]

        def at_edges(part: slice) -> Arguments:
            inputs = [cut(edges, part), faces, cut(edge_corners, part), source, wp.float64(1.0)]
            return inputs, [cut(of_edges, part)]

        launch_parts(gather_vertex_blocks, len(of_vertices), at_vertices, "cpu")
        launch_parts(gather_edge_blocks, len(of_edges), at_edges, "cpu")
        return of_vertices.numpy().reshape(-1, 2, 2), of_edges.numpy().reshape(-1, 2, 2)

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for tangent coordinates, shape [V, 2]."""
        return self._factor.solve(right)
