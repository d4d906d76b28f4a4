"""The Newton matrix of the distortion energy: assembled, ordered and factorised."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from omtwarp.mesh.surface import Surface

REGULARISATION = 1e-8  # of the mean diagonal: holds the three rotations and triangles cut off entirely


class NewtonMatrix:
    """Sums per-triangle blocks into a sparse matrix over two tangent coordinates per vertex, and solves with it.

    The pattern, the ordering that keeps the factors sparse, and the way of every block entry into the matrix are worked
    out once per mesh.
    """

    def __init__(self, surface: Surface):
        count = surface.vertex_count
        edges = surface.edges
        self.order = fill_reducing_order(count, edges)  # order[k] is the vertex in place k
        place = np.empty(count, dtype=np.int64)
        place[self.order] = np.arange(count)
        rows = place[np.r_[np.arange(count), edges[:, 0], edges[:, 1]]]
        columns = place[np.r_[np.arange(count), edges[:, 1], edges[:, 0]]]
        keys = np.sort(columns * count + rows)  # block columns, rows ascending inside
        block_rows, block_columns = keys % count, keys // count
        corners = place[surface.faces]
        index = np.searchsorted(keys, (corners[:, None, :] * count + corners[:, :, None]).ravel())
        self._entry_order = np.argsort(index, kind="stable")
        self._starts = np.flatnonzero(np.r_[True, np.diff(index[self._entry_order]) > 0])
        indptr = np.searchsorted(block_columns, np.arange(count + 1))
        # The scalar matrix in compressed columns, as positions in the array of 2x2 blocks.
        block_matrix = sparse.bsr_matrix(
            (np.arange(1.0, 4 * len(keys) + 1).reshape(-1, 2, 2).transpose(0, 2, 1), block_rows, indptr),
            shape=(2 * count, 2 * count),
        )
        pattern = block_matrix.tocsr()  # rows of the transpose are columns of the symmetric matrix
        self._take = pattern.data.astype(np.int64) - 1
        self._indices, self._indptr = pattern.indices, pattern.indptr
        self._size = 2 * count
        self._unknowns = (2 * self.order[:, None] + np.arange(2)).ravel()

    def assemble(self, blocks: NDArray[np.float64]) -> sparse.csc_matrix:
        """The matrix, in the fill-reducing order, of per-triangle blocks [F, 36]."""
        # [F, (i, u), (j, v)] -> entries of 2x2 blocks by corner pairs (i, j)
        pairs = blocks.reshape(-1, 3, 2, 3, 2).transpose(0, 1, 3, 2, 4).reshape(-1, 4)
        summed = np.add.reduceat(pairs[self._entry_order], self._starts, axis=0)
        data = summed.ravel()[self._take]
        return sparse.csc_matrix((data, self._indices, self._indptr), shape=(self._size, self._size))

    def factorise(self, blocks: NDArray[np.float64]) -> None:
        """Assemble and factorise."""
        matrix = self.assemble(blocks)
        diagonal = matrix.diagonal()
        matrix = matrix + sparse.diags(np.full(self._size, REGULARISATION * diagonal.mean()), format="csc")
        # Pivots on the diagonal are safe for a positive definite matrix and keep the ordering.
        self._factor = splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for tangent coordinates, shape [V, 2]."""
        flat = right.ravel()
        out = np.empty_like(flat)
        out[self._unknowns] = self._factor.solve(flat[self._unknowns])
        return out.reshape(right.shape)


def fill_reducing_order(count: int, edges: NDArray[np.int32]) -> NDArray[np.intp]:
    """Vertices in the order of elimination that keeps the factors of a matrix on the mesh's edges sparse, shape [V]."""
    # Minimum degree is pathologically slow on regularly numbered meshes; a random numbering first makes it fast.
    shuffle = np.random.default_rng(0).permutation(count)
    place = np.empty(count, dtype=np.intp)
    place[shuffle] = np.arange(count)
    i, j = place[edges[:, 0]], place[edges[:, 1]]
    off = sparse.coo_matrix((np.full(2 * len(i), -1.0), (np.r_[i, j], np.r_[j, i])), shape=(count, count))
    degree = np.bincount(np.r_[i, j], minlength=count)
    graph = (off + sparse.diags(degree + 1.0)).tocsc()
    factor = splu(graph, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return shuffle[np.argsort(factor.perm_c)]
