"""The Newton matrix of the distortion energy: gathered from triangles and factorised in an order kept for the mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.memory import Workspace
from omtwarp.device.start import wp
from omtwarp.device.threads import Arguments, cut, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.patches import Patches
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.cholesky import NotPositiveDefinite, part_dissection
from omtwarp.solvers.mesh_factor import MeshFactor, mesh_factor, surface_factor
from omtwarp.solvers.triangle_newton.newton_kernels import gather_edge_blocks, gather_vertex_blocks

REGULARISATION = 1e-8  # of the mean diagonal: holds the three rotations and triangles cut off entirely
# Of the diagonal at each vertex: the Hessian is only semidefinite, and steps along directions without curvature are as
# large as rounding makes them. Without it the second step of a skull's smoothing turns noise of 1e-7 into 4e-5, with
# 1e-6 into 2e-5, with this into 3e-8, in as many steps.
GROWTH = 1e-5
# Where rounding still leaves a pivot that is not positive, the diagonal grows by these parts of itself.
DIAGONAL_SHIFTS = (0.0, 1e-12, 1e-9, 1e-6, 1e-3)


class NewtonMatrix:
    """Sums per-triangle blocks into a sparse matrix over two tangent coordinates per vertex, and solves with it.

    The order of elimination and all storage are kept from one factorisation to the next.

    Args:
        faces: triangles by the unknown vertices at their corners, vec3i, shape [F]; -1 for a corner that stays where it
            is. This and what follows is on the host.
        edges: every edge between unknown vertices once, vec2i, shape [E].
        edge_corners: the two corners opposite to every edge, vec2i, shape [E].
        vertex_corners: corners around every unknown vertex as compressed rows, int32.
        factor: the factorisation to use.
        shift: what is added to the diagonal, relative to its mean.
        growth: what is added to the diagonal, relative to its mean at each vertex.
    """

    def __init__(
        self,
        faces: wp.array,
        edges: wp.array,
        edge_corners: wp.array,
        vertex_corners: list[wp.array],
        factor: MeshFactor,
        shift: float = REGULARISATION,
        growth: float = GROWTH,
    ):
        self._shift, self._growth = shift, growth
        self._factor = factor
        self._rows, self._sides = vertex_corners, [edges, faces, edge_corners]
        self._diagonal = wp.empty((len(vertex_corners[0]) - 1, 4), dtype=wp.float64, device="cpu")
        self._off_diagonal = wp.empty((len(edges), 4), dtype=wp.float64, device="cpu")

    @classmethod
    def of_surface(cls, surface: Surface, workspace: Workspace | None = None) -> NewtonMatrix:
        """Return the matrix over all vertices of a surface."""
        mesh = surface.on("cpu")
        arrays = mesh.faces, mesh.edges, mesh.edge_corners, mesh.vertex_corners
        return cls(*arrays, surface_factor(surface, 2, workspace or Workspace()))

    @classmethod
    def of_patches(cls, patches: Patches, surface: Surface, growth: float) -> NewtonMatrix:
        """Return the matrix over the freed vertices of patches.

        Args:
            patches: what may move.
            surface: the surface that they are part of.
            growth: what is added to the diagonal, relative to its mean at each vertex.
        """
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

        def shared(values: NDArray[np.int32], dtype: type) -> wp.array:
            return wp.array(values, dtype=dtype, device="cpu", copy=False)

        sides = shared(own, wp.vec3i), shared(edges, wp.vec2i), shared(edge_corners, wp.vec2i)
        rows = [shared(offsets, wp.int32), shared(corners, wp.int32)]
        factor = mesh_factor(
            count, edges, lambda: part_dissection(surface, patches.vertices[:count], edges), 2, Workspace()
        )
        return cls(*sides, rows, factor, 0.0, growth)

    def assemble(self, blocks: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Sum blocks of triangles, [F, 21], to the matrix as blocks of vertices, [V, 2, 2], and of edges, [E, 2, 2]."""
        source = wp.array(np.ascontiguousarray(blocks), dtype=wp.float64, device="cpu", copy=False)
        (offsets, corners), (edges, faces, edge_corners) = self._rows, self._sides

        def of_vertices(part: slice) -> Arguments:
            rows = cut(offsets, slice(part.start, part.stop + 1))
            return [rows, corners, source], [cut(self._diagonal, part)]

        def of_edges(part: slice) -> Arguments:
            return [cut(edges, part), faces, cut(edge_corners, part), source], [cut(self._off_diagonal, part)]

        launch_parts(gather_vertex_blocks, self._diagonal.shape[0], of_vertices, "cpu")
        launch_parts(gather_edge_blocks, self._off_diagonal.shape[0], of_edges, "cpu")
        return self._diagonal.numpy().reshape(-1, 2, 2), self._off_diagonal.numpy().reshape(-1, 2, 2)

    def factorise(self, blocks: NDArray[np.float64] | None = None) -> None:
        """Factorise the matrix of the given blocks of triangles, or else the one assembled last.

        Raises:
            OmtwarpError: the blocks are not finite, or far from semidefinite.
        """
        if blocks is not None:
            self.assemble(blocks)
        diagonal, off_diagonal = (array.numpy().reshape(-1, 2, 2) for array in (self._diagonal, self._off_diagonal))
        factorise_stiffened(self._factor, diagonal, off_diagonal, self._shift, self._growth)

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for tangent coordinates, shape [V, 2]."""
        return self._factor.solve(right)

    @property
    def vertex_corners(self) -> list[wp.array]:
        """Corners of triangles around every unknown vertex as compressed rows: offsets and corners, on the host."""
        return self._rows

    @property
    def diagonal_blocks(self) -> wp.array:
        """The blocks of the vertices, shape [V, 4], on the host."""
        return self._diagonal

    @property
    def diagonal(self) -> NDArray[np.float64]:
        """The diagonal of the matrix that was factorised last, shape [V, 2]."""
        return self._diagonal.numpy()[:, [0, 3]]


def factorise_stiffened(
    factor: MeshFactor,
    diagonal: NDArray[np.float64],
    off_diagonal: NDArray[np.float64],
    shift: float,
    growth: float,
) -> None:
    """Factorise a matrix whose diagonal grows, in place, by as little as makes it definite.

    Args:
        factor: the factorisation to compute.
        diagonal: blocks of the vertices, shape [V, 2, 2].
        off_diagonal: blocks of the edges, shape [E, 2, 2].
        shift, growth: what is added to the diagonal in any case, relative to its mean and to that of each vertex, which
            does not depend on the basis of its tangent plane.

    Raises:
        OmtwarpError: the blocks are not finite, or far from semidefinite.
    """
    own = diagonal[:, [0, 1], [0, 1]]
    of_vertices = own.mean(axis=1, keepdims=True)
    more = shift * own.mean()
    for part in DIAGONAL_SHIFTS:
        diagonal[:, [0, 1], [0, 1]] = own + (growth + part) * of_vertices + more
        try:
            factor.factorise(diagonal, off_diagonal)
            return
        except NotPositiveDefinite:
            continue
    raise OmtwarpError("the distortion of the map is not finite")
