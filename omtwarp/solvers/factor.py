"""What factorises sparse matrices on a mesh: one interface for SciPy's factorisation, the built-in one and cuDSS's."""

from abc import ABC, abstractmethod
from typing import Generic, NamedTuple, TypeVar

from omtwarp.mesh.arrays import Floats


class NotPositiveDefinite(ArithmeticError):
    """A matrix has a pivot of the wrong sign, to round-off."""


class MeshMatrix(NamedTuple):
    """A symmetric matrix whose pattern is the edges of a mesh, with b unknowns per vertex.

    Attributes:
        diagonal: of every vertex, shape [V], or its block, shape [V, b, b].
        off_diagonal: of every edge (i, j), shape [E], or its block with rows of i and columns of j, shape [E, b, b].
    """

    diagonal: Floats
    off_diagonal: Floats


Matrix = TypeVar("Matrix")
Vector = TypeVar("Vector")


class Factor(ABC, Generic[Matrix, Vector]):
    """A factorisation of matrices of one pattern, made again for every matrix."""

    @abstractmethod
    def factorise(self, matrix: Matrix) -> None:
        """Factorise one matrix.

        Raises:
            NotPositiveDefinite: it is not positive definite, or not quasi-definite with multipliers, to round-off.
        """

    @abstractmethod
    def solve(self, right: Vector) -> Vector:
        """Solve for right-hand sides with the matrix that was factorised last."""


MeshFactor = Factor[MeshMatrix, Floats]
"""Right-hand sides have the shape [V, b] or [V, b, K]; [V] or [V, K] for one unknown per vertex."""
