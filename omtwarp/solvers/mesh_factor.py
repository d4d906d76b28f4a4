"""Direct factorisations of matrices whose pattern is the edges of a mesh: SciPy's, the built-in one, or cuDSS.

The functions at the end make one of them, chosen by :mod:`omtwarp.device.policy`. SciPy's takes the same blocks, makes
an ordinary sparse matrix of them and passes it to SuperLU.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from omtwarp.device.arrays import Workspace
from omtwarp.device.policy import solves_with_cudss, solves_with_scipy
from omtwarp.device.start import wp
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.cholesky import Dissection, MultifrontalCholesky, part_dissection, surface_dissection
from omtwarp.solvers.cholesky.saddle import COORDINATES, SaddleMatrix, expand, expand_with_cells
from omtwarp.solvers.cudss import CudssFactor
from omtwarp.solvers.factor import Factor, MeshFactor, MeshMatrix, NotPositiveDefinite

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU

SaddleOrder: TypeAlias = tuple[Dissection, NDArray[np.int32]]


SaddlePointFactor = Factor[SaddleMatrix, wp.array]
"""Of matrices of Newton steps. Right-hand sides and solutions, on one device: coordinates, then multipliers, float64,
shape [2 V + N]; the multipliers of a matrix that has none are 0.
"""


class OrderedSaddleFactor(SaddlePointFactor):
    """A factorisation in the order of a dissection, by the built-in solver or by cuDSS.

    Args:
        order: of the unknowns, and how many of every front's are multipliers
            (:func:`omtwarp.solvers.cholesky.saddle.expand`).
        workspace: see :class:`MultifrontalCholesky`.
    """

    def __init__(self, order: SaddleOrder, workspace: Workspace | None = None):
        unknowns, multipliers = order
        negative = multipliers if multipliers.any() else None
        self._size = unknowns.vertex_count
        self._factor: CudssFactor | MultifrontalCholesky
        if solves_with_cudss():
            self._factor = CudssFactor(unknowns, workspace=workspace, negative=negative)
        else:
            self._factor = MultifrontalCholesky(unknowns, workspace=workspace, negative=negative, single=True)

    def factorise(self, matrix: SaddleMatrix) -> None:
        """Factorise one matrix; see :class:`SaddlePointFactor`."""
        self._factor.factorise_entries(matrix.entries)

    def solve(self, right: wp.array) -> wp.array:
        """Solve for a right-hand side; see :class:`SaddlePointFactor`."""
        if right.size == self._size:
            return self._factor.solve_entries(right)
        whole = wp.zeros(right.size, dtype=wp.float64, device=right.device)
        wp.copy(whole, self._factor.solve_entries(right[: self._size]), count=self._size)
        return whole


class SparseFactor(MeshFactor):
    """Factorises symmetric positive definite matrices on a mesh by SuperLU.

    Args:
        count: number of vertices V.
        edges: every edge (i, j) once, shape [E, 2].
        block: unknowns per vertex, b.
    """

    def __init__(self, count: int, edges: NDArray[np.int32], block: int = 1):
        self._count, self._edges, self._block = count, edges, block
        self._lu: SuperLU | None = None

    def factorise(self, matrix: MeshMatrix) -> None:
        """Factorise one matrix.

        Raises:
            NotPositiveDefinite: it is not positive definite, to round-off.
        """
        from scipy.sparse.linalg import splu  # takes a hundredth of a second to import

        whole = block_matrix(self._count, self._edges, *matrix, self._block)
        try:
            # Without pivoting the signs of the pivots are those of the eigenvalues.
            self._lu = splu(whole, permc_spec="COLAMD", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:
            raise NotPositiveDefinite("the matrix is singular") from error
        in_place = np.array_equal(self._lu.perm_r, self._lu.perm_c)
        pivots = self._lu.U.diagonal()
        if not (in_place and np.isfinite(pivots).all() and pivots.min() > 0.0):
            raise NotPositiveDefinite(f"{int((~(pivots > 0.0)).sum())} pivots are not positive")

    def solve(self, right: Floats) -> Floats:
        """Solve for right-hand sides, shape [V, b] or [V, b, K]; [V] or [V, K] for one unknown per vertex."""
        flat = np.ascontiguousarray(right, dtype=np.float64).reshape(self._count * self._block, -1)
        assert self._lu is not None, "factorise first"
        solved: Floats = self._lu.solve(flat)
        return solved.reshape(np.shape(right))


class SparseSaddleFactor(SaddlePointFactor):
    """Factorises matrices [A, Bᵀ; B, -C] on a mesh by SuperLU, with its own pivoting.

    Args:
        count: number of vertices V.
        edges: every edge (i, j) once, shape [E, 2].
        multipliers: of every pair of entries of B, in the order of the matrix's slopes: its row, shape [J].
        vertices: the vertex of every pair, shape [J].
    """

    def __init__(
        self,
        count: int,
        edges: NDArray[np.int32],
        multipliers: NDArray[np.int64] | NDArray[np.int32],
        vertices: NDArray[np.int64] | NDArray[np.int32],
    ):
        self._count, self._edges = count, edges
        self._rows = np.repeat(multipliers, 2)
        self._columns = (2 * np.asarray(vertices, dtype=np.int64)[:, None] + np.arange(2)).ravel()
        self._lu: SuperLU | None = None

    def factorise(self, matrix: SaddleMatrix) -> None:
        """Factorise one matrix.

        Raises:
            NotPositiveDefinite: it is singular.
        """
        from scipy.sparse.linalg import splu  # takes a hundredth of a second to import

        own, others, slopes, compliance = matrix.on_host()
        whole = block_matrix(self._count, self._edges, own, others, 2)
        if len(compliance):
            shape = (len(compliance), 2 * self._count)
            coupling = sparse.coo_matrix((slopes, (self._rows, self._columns)), shape=shape)
            whole = sparse.bmat([[whole, coupling.T], [coupling, sparse.diags(-compliance)]], format="csc")
        try:
            self._lu = splu(whole)
        except RuntimeError as error:
            raise NotPositiveDefinite("the matrix is singular") from error

    def solve(self, right: wp.array) -> wp.array:
        """Solve for a right-hand side; see :class:`SaddlePointFactor`."""
        assert self._lu is not None, "factorise first"
        numbers = right.numpy()
        solved = np.zeros_like(numbers)
        solved[: self._lu.shape[0]] = self._lu.solve(numbers[: self._lu.shape[0]])
        return wp.array(solved, dtype=wp.float64, device=right.device)


def solve_parts(factor: SaddlePointFactor, first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Solve on the host for coordinates, shape [V, 2], and multipliers, shape [N]."""
    right = np.concatenate([first.ravel(), second])
    solved = factor.solve(wp.array(right, dtype=wp.float64, device="cpu", copy=False)).numpy()
    return solved[: first.size].reshape(first.shape), solved[first.size :]


def block_matrix(
    count: int, edges: NDArray[np.int32], diagonal: Floats, off_diagonal: Floats, block: int
) -> sparse.csc_matrix:
    """Assemble the symmetric matrix with these blocks of vertices and edges."""
    vertices = np.arange(count)
    own, other = (np.reshape(values, (-1, block, block)) for values in (diagonal, off_diagonal))
    rows = np.concatenate([vertices, edges[:, 0], edges[:, 1]])
    columns = np.concatenate([vertices, edges[:, 1], edges[:, 0]])
    values = np.concatenate([own, other, other.transpose(0, 2, 1)])
    inside = np.arange(block)
    flat_rows = np.broadcast_to((block * rows)[:, None, None] + inside[:, None], values.shape)
    flat_columns = np.broadcast_to((block * columns)[:, None, None] + inside, values.shape)
    size = block * count
    return sparse.csc_matrix((values.ravel(), (flat_rows.ravel(), flat_columns.ravel())), shape=(size, size))


def mesh_factor(
    count: int,
    edges: NDArray[np.int32],
    dissection: Callable[[], Dissection],
    block: int = 1,
    workspace: Workspace | None = None,
) -> MeshFactor:
    """Create the chosen factorisation of matrices on the edges of a mesh.

    Args:
        count: number of vertices V.
        edges: every edge once, shape [E, 2].
        dissection: makes the order of elimination, where the built-in factorisation needs it.
        block: unknowns per vertex, 1 or 2.
        workspace: see :class:`omtwarp.solvers.cholesky.MultifrontalCholesky`.
    """
    if solves_with_scipy():
        return SparseFactor(count, edges, block)
    return MultifrontalCholesky(dissection(), block, workspace=workspace)


def surface_factor(surface: Surface, block: int = 1, edges: NDArray[np.int32] | None = None) -> MeshFactor:
    """Factorise a matrix on the edges of a surface, which keeps the order of elimination.

    Args:
        surface: closed, V vertices.
        block: as of :func:`mesh_factor`.
        edges: those of its intrinsic Delaunay triangulation, in place of its own.
    """

    def order() -> Dissection:
        if edges is None or edges is surface.edges:
            return surface_dissection(surface)
        return part_dissection(surface, np.arange(surface.vertex_count), edges)

    if solves_with_cudss():
        return CudssFactor(order(), block)
    return mesh_factor(surface.vertex_count, surface.edges if edges is None else edges, order, block)


def surface_saddle_factor(surface: Surface, workspace: Workspace | None = None) -> SaddlePointFactor:
    """Create the chosen factorisation with a multiplier for every vertex; ``workspace`` as of :func:`mesh_factor`."""
    if solves_with_scipy():
        return vertex_saddle_factor(surface.vertex_count, surface.edges, lambda: surface_dissection(surface))
    return OrderedSaddleFactor(saddle_order(surface), workspace)


def saddle_order(surface: Surface) -> SaddleOrder:
    """Return the order of elimination with a multiplier for every vertex, which the surface keeps."""
    return surface.cached("saddle-point order", lambda: expand(surface_dissection(surface)))


def coordinate_factor(surface: Surface, workspace: Workspace | None = None) -> SaddlePointFactor:
    """Create the chosen factorisation without multipliers; ``workspace`` as of :func:`mesh_factor`."""
    if solves_with_scipy():
        none = np.empty(0, dtype=np.int64)
        return SparseSaddleFactor(surface.vertex_count, surface.edges, none, none)

    def order() -> SaddleOrder:
        return expand(surface_dissection(surface), COORDINATES)

    return OrderedSaddleFactor(surface.cached("order of coordinates", order), workspace)


def vertex_saddle_factor(
    count: int, edges: NDArray[np.int32], dissection: Callable[[], Dissection]
) -> SaddlePointFactor:
    """Create the chosen factorisation with a multiplier for every vertex of any mesh.

    Args:
        count, edges, dissection: as of :func:`mesh_factor`; edges are pairs (i, j).
    """
    if solves_with_scipy():
        i, j = edges.T
        return SparseSaddleFactor(count, edges, np.r_[i, j], np.r_[j, i])
    return OrderedSaddleFactor(expand(dissection()))


def cell_saddle_factor(points: Floats, edges: NDArray[np.int32], cells: NDArray[np.int32]) -> SaddlePointFactor:
    """Create the chosen factorisation with a multiplier for every cell of any mesh.

    Args:
        points: positions of the vertices, shape [V, 3]; used only for which are near one another.
        edges: every edge (i, j) once, shape [E, 2].
        cells: the vertices of every cell, shape [N, K].
    """
    if solves_with_scipy():
        multipliers = np.repeat(np.arange(len(cells)), cells.shape[1])
        return SparseSaddleFactor(len(points), edges, multipliers, cells.ravel())
    return OrderedSaddleFactor(expand_with_cells(points, edges, cells))
