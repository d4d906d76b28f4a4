"""Factors of many small saddle-point matrices at once within their envelopes: order, storage, and Warp functions.

A matrix is shared by lanes, which are the threads of a block on a GPU, or one thread. Lanes divide the rows of every
column, so that the bits do not depend on their number.

A vertex has three unknowns: two coordinates and its multiplier. Row by row, all entries from the first that is not
zero to the diagonal are kept, which are the ones that elimination can fill (George and Liu, "Computer Solution of Large
Sparse Positive Definite Systems", 1981, chapter 4). The blocks of vertex i with itself are ``diagonal[i]``; those
with the vertices before it are in ``left``, by groups of four columns j that share j // 4: the groups from that of
first[i] on follow one another from rows[i] on. A group holds the first entry of its four blocks, then the second, and
so on, so that four products are summed in one instruction; what it holds besides is zero. Sums are assigned, as Warp
adds atomically to an array's element by `+=`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from omtwarp.device.arrays import sent
from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)

COLUMNS = wp.constant(4)  # vertices whose blocks a row stores entry by entry, as a group


@wp.struct
class Envelope:
    """Matrices one after another, as :class:`Envelopes` has them."""

    starts: wp.array[wp.int32]
    first: wp.array[wp.int32]
    last: wp.array[wp.int32]
    rows: wp.array[wp.int64]
    left: wp.array[wp.float64]  # their blocks left of the diagonal
    right: wp.array[wp.float64]  # right-hand sides, as rows of one unknown, each matrix from a group of its own on


@dataclass(frozen=True, eq=False)
class Envelopes:
    """Independent matrices whose patterns are the edges between vertices, three unknowns to a vertex.

    Attributes:
        order: the vertices in the order of elimination, those of each matrix together, shape [N].
        starts: where each matrix begins in that order, and N, int32, shape [count + 1].
        first: the first place in the order that is joined to each place, or the place itself, int32, shape [N].
        last: the last place whose row, from its first on, reaches each place, int32, shape [N].
        rows: where the groups of blocks of each place begin among all groups, int64, shape [N].
        size: number of groups of all matrices.
        operations: multiplications of a factorisation of each matrix, shape [count].
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
        """Order the vertices from one end of every graph to the other, so that envelopes are narrow.

        Args:
            edges: pairs of vertices in the same matrix, in any order and any number of times, shape [E, 2]; the graph
                of a matrix is connected.
            matrix: which matrix each vertex is in, 0 to count - 1, shape [N].
            count: number of matrices.
        """
        vertices = len(matrix)
        ends = np.concatenate([edges, edges[:, ::-1]]).T
        graph = sparse.coo_matrix((np.ones(ends.shape[1]), ends), shape=(vertices, vertices)).tocsr()
        order = np.lexsort([_lengthwise(graph, matrix), matrix])
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
        operations = np.bincount(matrix[order], 13.5 * widths**2, count).astype(np.float64, copy=False)
        groups = (places + COLUMNS - 1) // COLUMNS - first // COLUMNS
        return cls(order, starts, first, last, np.cumsum(groups) - groups, int(groups.sum()), operations)

    def upload(self, device: wp.Device | str = "cpu") -> Envelope:
        """Return what kernels on a device read of the matrices, with memory for their blocks."""
        matrices = Envelope()
        matrices.starts, matrices.first, matrices.last = (
            sent(values, wp.int32, device) for values in (self.starts, self.first, self.last)
        )
        matrices.rows = sent(self.rows, wp.int64, device)
        matrices.left = wp.empty(9 * COLUMNS * self.size, dtype=wp.float64, device=device)
        groups = len(self.first) // COLUMNS + len(self.starts)
        matrices.right = wp.zeros(3 * COLUMNS * groups, dtype=wp.float64, device=device)
        return matrices


def _lengthwise(graph: sparse.csr_matrix, matrix: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return numbers that grow from one end of every graph to the other, shape [N].

    Smoothed by means of neighbours, the difference of the distances to the two ends is nearly the eigenvector by which
    Barnard, Pothen and Simon ("A spectral algorithm for envelope reduction of sparse matrices", 1995) order vertices:
    factors of patches take a quarter to half of the multiplications that they take in the order of Cuthill and McKee.
    """
    smoothings = 20  # from 10 on the factors change by few per cent
    distances = [np.zeros(len(matrix))]
    for _ in range(3):  # to an end, to one opposite, and to one opposite of that
        farthest = np.lexsort([distances[-1], matrix])
        ends = farthest[np.diff(matrix[farthest], append=-1) != 0]
        distances.append(dijkstra(graph, indices=ends, unweighted=True, min_only=True))
    along, degrees = distances[-1] - distances[-2], np.maximum(graph.sum(axis=1).A1, 1.0)
    for _ in range(smoothings):
        along = 0.5 * (along + graph @ along / degrees)
    return along


# Pointers, because the compiler computes the place of every entry of Warp's arrays anew, and makes no vectors of the
# processor of Warp's: these functions take two to four times as long otherwise. Group j // 4 of row i begins that many
# groups behind ``row(i)``. Where there are no vectors, as on a GPU, four columns are summed one after another.
ROWS = """
    const int width = 36;
    const int *first = m.first.data, *last = m.last.data;
    auto row = [&](int i) { return m.left.data + (long long)width * (m.rows.data[i] - first[i] / 4); };
"""
# ``product``: the sum of X S Yᵀ, S = diag(1, 1, -1), over the blocks X of ``count`` groups from one on, of so many rows
# each, and Y of as many from other on. A product and its sum are one instruction, which Warp's flags leave to be asked
# for: a sixth less time. ``divide``: what is left of a block's row, from its first entry on, by the transposed pivot.
PRODUCT = """
#ifdef __CUDA_ARCH__
    typedef double Columns;
#define INLINED
#else
    typedef double Columns __attribute__((vector_size(32), aligned(8)));
#define INLINED __attribute__((always_inline))
#endif
    const int parts = 4 * sizeof(double) / sizeof(Columns);
    auto product = [](const int rows, const double* one, const double* other, int count, double* total) INLINED {
        #pragma clang fp contract(fast)
        Columns sums[9] = {};
        for (int k = 0; k < count * parts; ++k) {
            const Columns* x = (const Columns*)one + k / parts * 3 * rows * parts + k % parts;
            const Columns* y = (const Columns*)other + k / parts * 9 * parts + k % parts;
            for (int c = 0; c < 3; ++c)
                for (int a = 0; a < rows; ++a)
                    for (int b = 0; b < 3; ++b) {
                        if (c < 2) sums[3 * a + b] += x[(3 * a + c) * parts] * y[(3 * b + c) * parts];
                        else sums[3 * a + b] -= x[(3 * a + c) * parts] * y[(3 * b + c) * parts];
                    }
        }
        for (int e = 0; e < 3 * rows; ++e) {
            const double* sum = (const double*)&sums[e];
            total[e] = 0.0;
            for (int n = 0; n < 4 / parts; ++n) total[e] += sum[n];
        }
    };
    auto divide = [](double* at, const double* total, const double* pivot) {
        const double x = (at[0] - total[0]) * pivot[0], y = (at[4] - total[1] - x * pivot[3]) * pivot[4];
        at[8] = -(at[8] - total[2] - x * pivot[6] - y * pivot[7]) * pivot[8];
        at[0] = x;
        at[4] = y;
    };
"""

# All lanes of matrix p wait until the last is here. On the host every lane counts its own turns.
MEET = """
#ifdef __CUDA_ARCH__
    __syncthreads();
#else
    if (lanes > 1) {
        int* turns = gates.data + p * lanes;
        const int turn = turns[lane] + 1;
        __atomic_store_n(turns + lane, turn, __ATOMIC_RELEASE);
        for (int k = 0; k < lanes; ++k)
            while (__atomic_load_n(turns + k, __ATOMIC_ACQUIRE) < turn) {}
    }
#endif
"""

# The pivot of vertex j is factorised, with its diagonal inverted; then every lane computes the blocks below it of its
# rows, from those left of them. The right-hand side is a row below all: what is in its place then is S L^-1 of it, from
# which the unknowns follow last to first, as every lane takes the columns of its groups.
SOLVE = """
    const int begin = m.starts.data[p], end = m.starts.data[p + 1];
    double *definite = (double*)((char*)numbers.data + p * (long long)numbers.strides[0]), *solved = (double*)x.data;
    double *right = m.right.data + 12 * p, total[9];
    for (int i = begin + lane; i < end; i += lanes)
        for (int c = 0; c < 3; ++c) right[12 * (i / 4) + i % 4 + 4 * c] = solved[3 * i + c];
    MEET
    for (int j = begin; j < end; ++j) {
        double *own = (double*)(diagonal.data + j), *above = row(j);
        if (lane == 0) {
            const int from = first[j] / 4, count = (j + 3) / 4 - from;
            product(3, above + width * from, above + width * from, count, total);
            for (int e = 0; e < 9; ++e) own[e] -= total[e];
            const double l00 = 1.0 / sqrt(own[0]), l10 = own[3] * l00, l20 = own[6] * l00;
            const double second = own[4] - l10 * l10, l11 = 1.0 / sqrt(second), l21 = (own[7] - l20 * l10) * l11;
            const double third = l20 * l20 + l21 * l21 - own[8];
            *definite = own[0] > 0.0 && second > 0.0 && third > 0.0 ? 1.0 : 0.0;
            const double pivot[9] = {l00, 0.0, 0.0, l10, l11, 0.0, l20, l21, 1.0 / sqrt(third)};
            for (int e = 0; e < 9; ++e) own[e] = pivot[e];
            product(1, right + 12 * from, above + width * from, count, total);
            divide(right + 12 * (j / 4) + j % 4, total, own);
        }
        MEET
        if (!(*definite > 0.0)) return;
        for (int i = j + 1 + lane; i <= last[j]; i += lanes) {
            if (first[i] > j) continue;
            const int from = (first[i] > first[j] ? first[i] : first[j]) / 4;
            product(3, row(i) + width * from, above + width * from, (j + 3) / 4 - from, total);
            for (int a = 0; a < 3; ++a) divide(row(i) + width * (j / 4) + j % 4 + 12 * a, total + 3 * a, own);
        }
        MEET
    }
    for (int i = end - 1; i >= begin; --i) {
        const double *own = (const double*)(diagonal.data + i), *left = right + 12 * (i / 4) + i % 4;
        double s[3];
        for (int a = 3 - 1; a >= 0; --a) {
            s[a] = left[4 * a];
            for (int b = a + 1; b < 3; ++b) s[a] -= own[3 * b + a] * s[b];
            s[a] *= own[3 * a + a];
        }
        for (int k = first[i] / 4 * parts + lane; k < (i + 3) / 4 * parts; k += lanes) {
            const Columns* block = (const Columns*)row(i) + k / parts * 9 * parts + k % parts;
            Columns* before = (Columns*)right + k / parts * 3 * parts + k % parts;
            for (int b = 0; b < 3; ++b)
                for (int a = 0; a < 3; ++a) before[b * parts] -= block[(3 * a + b) * parts] * s[a];
        }
        MEET
        if (lane == 0)
            for (int a = 0; a < 3; ++a) solved[3 * i + a] = s[a];
    }
    MEET
"""

CLEAR = """
    for (double* at = row(i) + width * (first[i] / 4); at < row(i) + width * ((i + 3) / 4); ++at) *at = 0.0;
"""

ADD = """
    double* at = row(i) + width * (j / 4) + j % 4;
    for (int e = 0; e < 9; ++e) at[4 * e] += ((const double*)&block)[e];
"""


@wp.func_native(MEET)
def meet(p: int, lane: int, lanes: int, gates: wp.array[wp.int32]):
    """Wait for the other lanes of matrix p; ``gates`` hold a number for each on the host, [count * lanes], zeros."""


@wp.func_native(ROWS + CLEAR)
def clear_row(i: int, m: Envelope):
    """Set the blocks of vertex i with those before it to zero."""


@wp.func_native(ROWS + ADD)
def add_block(i: int, j: int, block: wp.mat33d, m: Envelope):
    """Add a block with rows of vertex i and columns of vertex j < i."""


@wp.func_native(ROWS + PRODUCT + SOLVE.replace("MEET", MEET))
def solve_envelope(
    p: int,
    lane: int,
    lanes: int,
    m: Envelope,
    gates: wp.array[wp.int32],
    # Data in and out:
    diagonal: wp.array[wp.mat33d],
    x: wp.array[wp.vec3d],
    numbers: wp.array2d[wp.float64],
):
    """Replace the right-hand side of quasi-definite matrix p by the solution: two coordinates and a multiplier each.

    The matrix is factorised as L S Lᵀ, S = diag(1, 1, -1) at every vertex, the diagonal of L inverted: the third
    unknown of every vertex is a multiplier (:mod:`omtwarp.solvers.cholesky.saddle`). The first of the numbers of p gets
    1 where all pivots have their signs; otherwise 0, and nothing is solved.
    """
