"""Sparse symmetric positive definite systems, factorised once and solved many times.

Matrices on the edges of a surface are factorised as :mod:`omtwarp.solvers.mesh_factor` chooses.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.operators import cotangent_edge_weights
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.factor import MeshMatrix, NotPositiveDefinite
from omtwarp.solvers.mesh_factor import surface_factor


class Factorization:
    """A direct factorisation of a symmetric positive definite matrix by SuperLU, which SciPy brings.

    Raises:
        OmtwarpError: the matrix is singular.
    """

    def __init__(self, matrix: sparse.spmatrix):
        from scipy.sparse.linalg import splu  # takes a hundredth of a second to import

        matrix = sparse.csc_matrix(matrix)
        self.size: int = matrix.shape[0]
        # Minimum degree on A + A' halves the fill of SuperLU's default column ordering, but is pathologically slow on
        # regularly numbered meshes; a fixed random numbering first makes it fast on every mesh. Pivoting on the
        # diagonal is safe for positive definite matrices and keeps that ordering.
        self._order: NDArray[np.intp] = np.random.default_rng(0).permutation(self.size)
        shuffled = matrix[self._order][:, self._order].tocsc()
        try:
            self._lu = splu(
                shuffled, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as error:
            raise OmtwarpError(f"a sparse system of {self.size} unknowns is singular") from error

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for one right-hand side, shape [N], or several, shape [N, K]."""
        out = np.empty_like(right, dtype=np.float64)
        out[self._order] = self._lu.solve(np.ascontiguousarray(right[self._order]))
        return out


def edge_laplacian(edges: NDArray[np.integer], weights: NDArray[np.float64], count: int) -> sparse.csr_matrix:
    """Return the matrix L with (L u)_i the sum of w_ij (u_i - u_j) over the edges (i, j) at vertex i, shape [V, V].

    Args:
        edges: shape [E, 2]; several may join the same vertices, and one that joins a vertex to itself does not count.
        weights: of the edges, shape [E].
        count: number of vertices V.
    """
    i, j = edges.T
    diagonal = np.bincount(i, weights, count) + np.bincount(j, weights, count)
    off = sparse.coo_matrix((np.r_[weights, weights], (np.r_[i, j], np.r_[j, i])), shape=(count, count))
    return sparse.diags(diagonal) - off.tocsr()


class LaplacianSolver:
    """Solves L u = b for a Laplacian whose null space is the constants.

    The right-hand side is projected onto sum zero, one vertex is pinned to make the matrix definite, and the solution
    is returned with mean zero.

    Args:
        laplacian: symmetric positive semidefinite, shape [V, V], rows summing to zero.
        pinned: the vertex held at zero while solving.
    """

    def __init__(self, laplacian: sparse.spmatrix, pinned: int = 0):
        matrix = sparse.csr_matrix(laplacian)
        self._free = np.flatnonzero(np.arange(matrix.shape[0]) != pinned)
        self._factorization = Factorization(matrix[self._free][:, self._free])

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for one right-hand side, shape [V], or several, shape [V, K]."""
        right = right - right.mean(axis=0)
        out = np.zeros_like(right)
        out[self._free] = self._factorization.solve(right[self._free])
        return out - out.mean(axis=0)


def cotangent_solver(surface: Surface, points: NDArray[np.float64] | wp.array, pinned: int = 0) -> EdgeLaplacianSolver:
    """Factorise the cotangent Laplacian of a surface at its own or other positions of its vertices.

    Equal to :class:`LaplacianSolver` of :func:`omtwarp.geometry.cotangent_laplacian` to round-off. The order of
    elimination is computed once for a surface and all positions, and the factorisation is several times faster than
    SuperLU's.

    Args:
        surface: a closed surface, V vertices.
        points: positions, shape [V, 3], or a Warp array of vec3d.
        pinned: the vertex held at zero while solving.
    """
    on_host = points.numpy() if isinstance(points, wp.array) else points
    return EdgeLaplacianSolver(surface, cotangent_edge_weights(surface, on_host), pinned)


class EdgeLaplacianSolver:
    """Solves L u = b directly for the Laplacian of any weights of a surface's edges.

    (L u)_i is the sum of w_ij (u_i - u_j) over the edges (i, j) at vertex i.

    Args:
        surface: a closed surface, V vertices and E edges; it keeps the order of elimination.
        weights: of its edges, float64, shape [E].
        pinned: the vertex held at zero while solving.
        edges: those of its intrinsic Delaunay triangulation, shape [E, 2], where the weights are theirs.
    """

    def __init__(
        self, surface: Surface, weights: NDArray[np.float64], pinned: int = 0, edges: NDArray[np.int32] | None = None
    ):
        edges = surface.edges if edges is None else edges
        count = surface.vertex_count
        diagonal = np.bincount(edges[:, 0], weights, count) + np.bincount(edges[:, 1], weights, count)
        # The pinned vertex stays in the matrix without couplings: its unknown is its right-hand side, zero.
        joined = (edges[:, 0] != pinned) & (edges[:, 1] != pinned)
        self._edges, self._weights, self._count = edges, weights, count
        self._pinned, self._equal = pinned, np.full(count, 1.0 / count)  # weights of a mean
        self._fallback: LaplacianSolver | None = None
        self._factor = surface_factor(surface, edges=edges)
        try:
            typical = float(np.median(diagonal))
            own = np.where(np.arange(count) == pinned, typical, diagonal)
            self._factor.factorise(MeshMatrix(own, np.where(joined, -weights, 0.0)))
        except NotPositiveDefinite:  # to round-off, on very thin triangles: without square roots it goes on
            self._fallback = LaplacianSolver(edge_laplacian(edges, weights, count), pinned)

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for one right-hand side, shape [V], or several, shape [V, K]."""
        if self._fallback is not None:
            return self._fallback.solve(right)
        right = right - self._equal @ right
        right[self._pinned] = 0.0
        out = self._factor.solve(right)
        return out - self._equal @ out

    def fit(self, differences: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values at vertices, shape [V], whose differences u_j - u_i along edges (i, j) fit those given [E].

        They are the least squares under the weights.
        """
        edges, flow = self._edges, self._weights * differences
        right = np.bincount(edges[:, 1], flow, self._count) - np.bincount(edges[:, 0], flow, self._count)
        return self.solve(right.astype(np.float64))
