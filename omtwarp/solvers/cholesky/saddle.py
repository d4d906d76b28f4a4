"""Factorise saddle-point matrices [A, Bᵀ; B, -C] on a mesh: two coordinates and one multiplier for every vertex.

With A and C positive definite the matrix is quasi-definite: it has a factorisation L S Lᵀ, S diagonal with entries 1
and -1, in every symmetric order of elimination, without pivoting [1]. The order is the mesh's nested dissection; inside
a front the coordinates come before the multipliers, whose pivots then are Schur complements.

References:
    [1] R. J. Vanderbei, "Symmetric quasi-definite matrices", SIAM Journal on Optimization 5(1), 1995.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.memory import Workspace
from omtwarp.solvers.cholesky.dissection import Dissection, edge_blocks, of_unknowns
from omtwarp.solvers.cholesky.multifrontal import MultifrontalCholesky, SymmetricFactor

UNKNOWNS = 3  # of a vertex: two coordinates, one multiplier


class SaddleFactor:
    """Factorises saddle-point matrices of one mesh; order and storage are kept from one matrix to the next.

    Args:
        dissection: the order of elimination of the mesh's V vertices; E edges.
        workspace: see :class:`MultifrontalCholesky`.
        expanded: the order of the unknowns, where it is known: :func:`expand` of the dissection.
        factor: makes the factorisation of the matrices of all unknowns.
    """

    def __init__(
        self,
        dissection: Dissection,
        workspace: Workspace | None = None,
        expanded: Dissection | None = None,
        factor: SymmetricFactor = MultifrontalCholesky,
    ):
        self._count = dissection.vertex_count
        expanded = expand(dissection) if expanded is None else expanded
        negative = (expanded.owned // UNKNOWNS).astype(np.int32)
        self._factor = factor(expanded, workspace=workspace, negative=negative)
        edges = len(dissection.edges)
        self._diagonal = np.empty((self._count, UNKNOWNS))
        self._couplings = np.empty(8 * edges + self._count)
        self._blocks = self._couplings[: 4 * edges].reshape(edges, 2, 2)
        self._gradients = self._couplings[4 * edges : 8 * edges].reshape(2, edges, 2)
        self._inner = self._couplings[8 * edges :]

    def factorise(
        self,
        diagonal: NDArray[np.float64],
        off_diagonal: NDArray[np.float64],
        gradients: NDArray[np.float64],
        compliance: NDArray[np.float64],
    ) -> None:
        """Factorise one matrix.

        Args:
            diagonal: A's blocks of the vertices, shape [V, 2, 2].
            off_diagonal: A's blocks of the edges (i, j), rows of i, columns of j, shape [E, 2, 2].
            gradients: B's entries of the edges: row i by the coordinates of j, then row j by those of i,
                shape [2, E, 2]. B has none on its diagonal.
            compliance: C's diagonal, positive, shape [V].

        Raises:
            NotPositiveDefinite: A is not positive definite, to round-off.
        """
        self._diagonal[:, 0], self._diagonal[:, 1] = diagonal[:, 0, 0], diagonal[:, 1, 1]
        np.negative(compliance, out=self._diagonal[:, 2])
        self._inner[:] = diagonal[:, 0, 1]
        self._blocks[:] = off_diagonal
        self._gradients[:] = gradients
        self._factor.factorise(self._diagonal.ravel(), self._couplings)

    def solve(
        self, first: NDArray[np.float64], second: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Solve [A, Bᵀ; B, -C] [u; q] = [first; second]: coordinates u, shape [V, 2], and multipliers q, shape [V]."""
        right = np.concatenate([first.reshape(-1, 2), second.reshape(-1, 1)], axis=1)
        solved = self._factor.solve(right.ravel()).reshape(-1, UNKNOWNS)
        return np.ascontiguousarray(solved[:, :2]), np.ascontiguousarray(solved[:, 2])


def expand(d: Dissection) -> Dissection:
    """Return the order of elimination of three unknowns for every vertex, as a dissection of unknowns.

    Unknown 3v + c is coordinate c of vertex v, or its multiplier where c is 2. Couplings are numbered as
    :class:`SaddleFactor` has them: four for each edge's block, two for each of its two gradients, and one for each
    vertex between its coordinates.
    """
    count, total = d.vertex_count, UNKNOWNS * d.vertex_count
    fronts = len(d.owned)
    front_of = np.repeat(np.arange(fronts), d.owned)  # of every place of a vertex
    begin, inside = UNKNOWNS * d.first[front_of], np.arange(count) - d.first[front_of]
    # Places of a vertex's three unknowns, by its own place.
    places = np.stack([begin + 2 * inside, begin + 2 * inside + 1, begin + 2 * d.owned[front_of] + inside], axis=1)
    order = np.empty(total, dtype=np.int64)
    order[places] = UNKNOWNS * d.order[:, None] + np.arange(UNKNOWNS)
    of_row = np.repeat(np.arange(fronts), UNKNOWNS * np.diff(d.starts))
    i, j = (UNKNOWNS * d.edges[:, k].astype(np.int64) for k in range(2))
    gradients = [np.stack([np.stack([p + 2, q + b], axis=1) for b in range(2)], axis=1) for p, q in ((i, j), (j, i))]
    vertices = UNKNOWNS * np.arange(count, dtype=np.int64)
    inner = np.stack([vertices, vertices + 1], axis=1)
    couplings = [edge_blocks(d.edges, UNKNOWNS), *(part.reshape(-1, 2) for part in gradients), inner]
    row_keys = of_row * total + places[d.rows].ravel()
    return of_unknowns(d, order, UNKNOWNS * d.first, UNKNOWNS * d.owned, row_keys, np.concatenate(couplings))
