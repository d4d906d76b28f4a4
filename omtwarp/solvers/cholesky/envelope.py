"""The order and storage of :mod:`omtwarp.solvers.cholesky.envelope_kernels` for many small matrices at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import reverse_cuthill_mckee

from omtwarp.device.arrays import sent
from omtwarp.device.start import wp

COLUMNS = 4  # vertices whose blocks a row stores entry by entry, as a group


@dataclass(frozen=True, eq=False)
class Envelopes:
    """Independent matrices whose patterns are the edges between vertices, some unknowns to a vertex.

    Attributes:
        order: the vertices in the order of elimination, those of each matrix together, shape [N].
        starts: where each matrix begins in that order, and N, int32, shape [count + 1].
        first: the first place in the order that is joined to each place, or the place itself, int32, shape [N].
        last: the last place whose row, from its first on, reaches each place, int32, shape [N].
        rows: where the groups of blocks of each place begin among all groups, int64, shape [N].
        size: number of groups of all matrices.
        operations: multiplications of a factorisation of each matrix with two unknowns to a vertex, shape [count].
    """

    order: NDArray[np.intp]
    starts: NDArray[np.int32]
    first: NDArray[np.int32]
    last: NDArray[np.int32]
    rows: NDArray[np.int64]
    size: int
    operations: NDArray[np.float64]

    @classmethod
    def of_edges(cls, edges: NDArray[np.integer], matrix: NDArray[np.integer], count: int) -> Envelopes:
        """Order the vertices for a small bandwidth (Cuthill and McKee 1969, reversed).

        Args:
            edges: pairs of vertices in the same matrix, in any order and any number of times, shape [E, 2].
            matrix: which matrix each vertex is in, 0 to count - 1, shape [N].
            count: number of matrices.
        """
        vertices = len(matrix)
        ends = np.concatenate([edges, edges[:, ::-1]]).T
        graph = sparse.coo_matrix((np.ones(ends.shape[1], dtype=np.int8), ends), shape=(vertices, vertices)).tocsr()
        order = reverse_cuthill_mckee(graph, symmetric_mode=True)
        order = order[np.argsort(matrix[order], kind="stable")]
        place = np.empty(vertices, dtype=np.int32)
        place[order] = np.arange(vertices, dtype=np.int32)
        low, high = np.sort(place[edges], axis=1).T
        first = np.arange(vertices, dtype=np.int32)
        np.minimum.at(first, high, low)
        starts = np.zeros(count + 1, dtype=np.int32)
        np.cumsum(np.bincount(matrix, minlength=count), out=starts[1:])
        places = np.arange(vertices, dtype=np.int32)
        last = places.copy()
        np.maximum.at(last, first, places)
        last = np.maximum.accumulate(last)
        widths = places - first + 1
        operations = np.bincount(matrix[order], 4.0 * widths**2, count).astype(np.float64, copy=False)
        groups = (places + COLUMNS - 1) // COLUMNS - first // COLUMNS
        return cls(order, starts, first, last, np.cumsum(groups) - groups, int(groups.sum()), operations)

    def storage(self, unknowns: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return memory for all matrices with so many unknowns to a vertex: for diagonals, and what is left of them."""
        count = len(self.order)
        return np.empty((count, unknowns, unknowns)), np.empty(self.size * COLUMNS * unknowns**2)

    def upload(self, device: wp.Device | str = "cpu") -> list[wp.array]:
        """Return starts, first, last and rows as arrays that kernels on a device read."""
        numbers = [self.starts, self.first, self.last]
        return [*(sent(values, wp.int32, device) for values in numbers), sent(self.rows, wp.int64, device)]


__all__ = ["Envelopes"]
