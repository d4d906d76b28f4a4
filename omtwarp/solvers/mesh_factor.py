"""Direct factorisations of matrices whose pattern is the edges of a mesh: SciPy's, the built-in one, or cuDSS.

The functions at the end make one of them, chosen by :mod:`omtwarp.device.policy`. SciPy's takes the same blocks, makes
an ordinary sparse matrix of them and passes it to SuperLU.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import TYPE_CHECKING, Protocol

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from omtwarp.device.memory import Workspace
from omtwarp.device.policy import solves_with_cudss, solves_with_scipy
from omtwarp.device.threads import pool
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.cholesky import (
    Dissection,
    MultifrontalCholesky,
    NotPositiveDefinite,
    part_dissection,
    surface_dissection,
)
from omtwarp.solvers.cholesky.cell_saddle import CellSaddleFactor
from omtwarp.solvers.cholesky.multifrontal import SymmetricFactor
from omtwarp.solvers.cholesky.saddle import SaddleFactor, expand
from omtwarp.solvers.cudss import CudssFactor

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU

BEGUN_ORDER = "saddle-point order, begun"  # name under which a surface keeps it while it is computed


class MeshFactor(Protocol):
    """A factorisation of matrices with one or two unknowns per vertex, made again for every matrix."""

    def factorise(self, diagonal: NDArray[np.float64], off_diagonal: NDArray[np.float64]) -> None:
        """Factorise the matrix with these blocks of vertices, [V, b, b], and edges, [E, b, b]."""

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides, shape [V, b] or [V, b, K]; [V] or [V, K] for one unknown per vertex."""


class SaddlePointFactor(Protocol):
    """A factorisation of saddle-point matrices, see :class:`omtwarp.solvers.cholesky.saddle.SaddleFactor`."""

    def factorise(
        self,
        diagonal: NDArray[np.float64],
        off_diagonal: NDArray[np.float64],
        gradients: NDArray[np.float64],
        compliance: NDArray[np.float64],
    ) -> None:
        """Factorise one matrix."""

    def solve(
        self, first: NDArray[np.float64], second: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Solve for coordinates, shape [V, 2], and multipliers, shape [N]."""


class VertexFactor:
    """A factorisation of the coordinates alone in place of one of saddle-point matrices; multipliers stay 0.

    Args:
        factor: of two unknowns per vertex.
    """

    def __init__(self, factor: MeshFactor):
        self._factor = factor

    def factorise(
        self,
        diagonal: NDArray[np.float64],
        off_diagonal: NDArray[np.float64],
        gradients: NDArray[np.float64],
        compliance: NDArray[np.float64],
    ) -> None:
        """Factorise the matrix of the coordinates; derivatives of areas do not count."""
        self._factor.factorise(diagonal, off_diagonal)

    def solve(
        self, first: NDArray[np.float64], second: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Solve for coordinates, shape [V, 2]; multipliers are 0, shape [N]."""
        return self._factor.solve(first), np.zeros_like(second)


class SparseFactor:
    """Factorises symmetric positive definite matrices on a mesh by SuperLU.

    Args:
        count: number of vertices V.
        edges: every edge (i, j) once, shape [E, 2].
        block: unknowns per vertex, b.
    """

    def __init__(self, count: int, edges: NDArray[np.int32], block: int = 1):
        self._count, self._edges, self._block = count, edges, block
        self._lu: SuperLU | None = None

    def factorise(self, diagonal: NDArray[np.float64], off_diagonal: NDArray[np.float64]) -> None:
        """Factorise a matrix; see :meth:`omtwarp.solvers.cholesky.MultifrontalCholesky.factorise`.

        Raises:
            NotPositiveDefinite: it is not positive definite, to round-off.
        """
        from scipy.sparse.linalg import splu  # takes a hundredth of a second to import

        matrix = _block_matrix(self._count, self._edges, diagonal, off_diagonal, self._block)
        try:
            # Without pivoting the signs of the pivots are those of the eigenvalues.
            self._lu = splu(matrix, permc_spec="COLAMD", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:
            raise NotPositiveDefinite("the matrix is singular") from error
        in_place = np.array_equal(self._lu.perm_r, self._lu.perm_c)
        pivots = self._lu.U.diagonal()
        if not (in_place and np.isfinite(pivots).all() and pivots.min() > 0.0):
            raise NotPositiveDefinite(f"{int((~(pivots > 0.0)).sum())} pivots are not positive")

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides, shape [V, b] or [V, b, K]; [V] or [V, K] for one unknown per vertex."""
        flat = np.ascontiguousarray(right, dtype=np.float64).reshape(self._count * self._block, -1)
        assert self._lu is not None, "factorise first"
        solved: NDArray[np.float64] = self._lu.solve(flat)
        return solved.reshape(np.shape(right))


class SparseSaddleFactor:
    """Factorises saddle-point matrices [A, Bᵀ; B, -C] on a mesh by SuperLU, with its own pivoting.

    Args:
        count: number of vertices V.
        edges: every edge (i, j) once, shape [E, 2].
        multipliers: of every entry of B, in the order of ``gradients``: its row, shape [J].
        vertices: the vertex of every entry, shape [J].
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

    def factorise(
        self,
        diagonal: NDArray[np.float64],
        off_diagonal: NDArray[np.float64],
        gradients: NDArray[np.float64],
        compliance: NDArray[np.float64],
    ) -> None:
        """Factorise one matrix; arguments as of :meth:`omtwarp.solvers.cholesky.saddle.SaddleFactor.factorise`.

        Raises:
            NotPositiveDefinite: the matrix is singular.
        """
        from scipy.sparse.linalg import splu  # takes a hundredth of a second to import

        first = _block_matrix(self._count, self._edges, diagonal, off_diagonal, 2)
        shape = (len(compliance), 2 * self._count)
        coupling = sparse.coo_matrix((gradients.ravel(), (self._rows, self._columns)), shape=shape)
        matrix = sparse.bmat([[first, coupling.T], [coupling, sparse.diags(-compliance)]], format="csc")
        try:
            self._lu = splu(matrix)
        except RuntimeError as error:
            raise NotPositiveDefinite("the matrix is singular") from error

    def solve(
        self, first: NDArray[np.float64], second: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Solve [A, Bᵀ; B, -C] [u; q] = [first; second]: coordinates u, shape [V, 2], and multipliers q, shape [N]."""
        assert self._lu is not None, "factorise first"
        solved = self._lu.solve(np.concatenate([np.ravel(first), np.ravel(second)]))
        return solved[: 2 * self._count].reshape(-1, 2), solved[2 * self._count :]


def _block_matrix(
    count: int,
    edges: NDArray[np.int32],
    diagonal: NDArray[np.float64],
    off_diagonal: NDArray[np.float64],
    block: int,
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


def surface_factor(
    surface: Surface,
    block: int = 1,
    workspace: Workspace | None = None,
    edges: NDArray[np.int32] | None = None,
) -> MeshFactor:
    """Factorise a matrix on the edges of a surface, which keeps the order of elimination.

    Args:
        surface: closed, V vertices.
        block, workspace: as of :func:`mesh_factor`.
        edges: those of its intrinsic Delaunay triangulation, in place of its own.
    """

    def order() -> Dissection:
        if edges is None or edges is surface.edges:
            return surface_dissection(surface)
        return part_dissection(surface, np.arange(surface.vertex_count), edges)

    if solves_with_cudss():
        return CudssFactor(order(), block)
    return mesh_factor(surface.vertex_count, surface.edges if edges is None else edges, order, block, workspace)


def surface_saddle_factor(surface: Surface, workspace: Workspace | None = None) -> SaddlePointFactor:
    """Create the chosen factorisation of a surface's saddle-point matrices; ``workspace`` as of :func:`mesh_factor`."""
    if solves_with_scipy():
        i, j = surface.edges.T
        return SparseSaddleFactor(surface.vertex_count, surface.edges, np.r_[i, j], np.r_[j, i])
    order = surface.cached("saddle-point order", lambda: begin_saddle_order(surface).result())
    surface.let_go(BEGUN_ORDER)
    return SaddleFactor(surface_dissection(surface), workspace, order, _surface_factor_maker())


def _surface_factor_maker() -> SymmetricFactor:
    """Return what makes factorisations of whole surfaces: cuDSS where it is asked for, and the built-in one."""
    return CudssFactor if solves_with_cudss() else MultifrontalCholesky


def begin_saddle_order(surface: Surface) -> Future[Dissection]:
    """Begin to compute the order of a surface's saddle-point systems on another thread.

    It takes 0.04 seconds for 12,000 vertices, most of them beside parts of Moser's flow that run on one thread.
    """

    def begin() -> Future[Dissection]:
        order = surface_dissection(surface)
        return pool().submit(expand, order)

    return surface.cached(BEGUN_ORDER, begin)


def saddle_factor(count: int, edges: NDArray[np.int32], dissection: Callable[[], Dissection]) -> SaddlePointFactor:
    """Create the chosen factorisation of saddle-point matrices on the edges of any mesh.

    Args:
        count, edges, dissection: as of :func:`mesh_factor`; edges are pairs (i, j).
    """
    if solves_with_scipy():
        i, j = edges.T
        return SparseSaddleFactor(count, edges, np.r_[i, j], np.r_[j, i])
    return SaddleFactor(dissection())


def cell_saddle_factor(surface: Surface, cells: NDArray[np.int32]) -> SaddlePointFactor:
    """Create the chosen factorisation with a multiplier for every cell, a group of vertices; shape [N, K]."""
    return saddle_factor_of_cells(surface.scaled_vertices, surface.edges, cells)


def saddle_factor_of_cells(
    points: NDArray[np.float64], edges: NDArray[np.int32], cells: NDArray[np.int32]
) -> SaddlePointFactor:
    """Create the chosen factorisation of saddle-point matrices on the edges and cells of any mesh.

    Args:
        points: positions of the vertices, shape [V, 3]; used only for which are near one another.
        edges: every edge (i, j) once, shape [E, 2].
        cells: the vertices of every cell, shape [N, K].
    """
    if solves_with_scipy():
        multipliers = np.repeat(np.arange(len(cells)), cells.shape[1])
        return SparseSaddleFactor(len(points), edges, multipliers, cells.ravel())
    return CellSaddleFactor(points, edges, cells, factor=_surface_factor_maker())


__all__ = [
    "MeshFactor",
    "SaddlePointFactor",
    "SparseFactor",
    "SparseSaddleFactor",
    "VertexFactor",
    "begin_saddle_order",
    "cell_saddle_factor",
    "mesh_factor",
    "saddle_factor",
    "saddle_factor_of_cells",
    "surface_factor",
    "surface_saddle_factor",
]
