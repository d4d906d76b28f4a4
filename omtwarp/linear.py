"""Sparse symmetric positive definite systems, factorised once and solved many times."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from omtwarp.errors import OmtwarpError


class Factorization:
    """A direct factorisation of a symmetric positive definite matrix.

    CHOLMOD (scikit-sparse) does it where it is installed, SuperLU otherwise; both give the same solution to round-off.

    Raises:
        OmtwarpError: the matrix is singular.
    """

    def __init__(self, matrix: sparse.spmatrix):
        matrix = sparse.csc_matrix(matrix)
        self.size: int = matrix.shape[0]
        self._cholmod = _cholmod_factor(matrix)
        if self._cholmod is None:
            # Minimum degree on A + A' halves the fill of SuperLU's default column ordering, but is pathologically slow
            # on regularly numbered meshes; a fixed random numbering first makes it fast on every mesh. Pivoting on the
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
        if self._cholmod is not None:
            return np.asarray(self._cholmod(right))
        out = np.empty_like(right, dtype=np.float64)
        out[self._order] = self._lu.solve(np.ascontiguousarray(right[self._order]))
        return out


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


def _cholmod_factor(matrix: sparse.csc_matrix) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    """CHOLMOD's solution of systems with this matrix, or None where it is not installed or finds it not definite."""
    try:
        from sksparse import cholmod
    except ImportError:
        return None
    try:
        if hasattr(cholmod, "cho_factor"):  # scikit-sparse 0.5; it keeps the given order unless told otherwise
            return cholmod.cho_factor(matrix, order="default").solve
        return cholmod.cholesky(matrix)
    except cholmod.CholmodError:  # semidefinite to round-off: SuperLU goes on where it can
        return None
