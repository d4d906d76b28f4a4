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
from scipy.sparse.csgraph import reverse_cuthill_mckee

from omtwarp.device.arrays import sent
from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp

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
        return matrices


# With Warp's own vectors, of which the compiler makes no vectors of the processor, a factorisation of 1,000 vertices
# takes 2.7 times as long. Where there are none, as on a GPU, the four columns are summed one after another.
PRODUCT = """
#ifdef __CUDA_ARCH__
    typedef double Columns;
#else
    typedef double Columns __attribute__((vector_size(32), aligned(8)));
#endif
    const int in_one = sizeof(Columns) / sizeof(double), parts = 4 / in_one;
    Columns sums[3][3] = {};
    const Columns* x = (const Columns*)left.data + (long long)9 * parts * u;
    const Columns* y = (const Columns*)left.data + (long long)9 * parts * v;
    for (int k = 0; k < count * parts; ++k) {
        const Columns* one = x + k / parts * 9 * parts + k % parts;
        const Columns* other = y + k / parts * 9 * parts + k % parts;
        for (int c = 0; c < 3; ++c)
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) {
                    const Columns product = one[(3 * a + c) * parts] * other[(3 * b + c) * parts];
                    if (c < 2) sums[a][b] += product;
                    else sums[a][b] -= product;
                }
    }
    wp::mat_t<3, 3, wp::float64> out;
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) {
            const double* sum = (const double*)&sums[a][b];
            double total = 0.0;
            for (int n = 0; n < in_one; ++n) total += sum[n];
            out.data[a][b] = total;
        }
    return out;
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

# Pointers, because the compiler computes the place of every entry of Warp's arrays anew: 2.5 times as fast. Every lane
# computes the unknowns of column j from what it reads; the first writes them when all have read.
SUBSTITUTE = """
    const int width = 36;
    double* y = (double*)x.data;
    double s[3];
    for (int j = begin; j < end; ++j) {
        const double* own = (const double*)(diagonal.data + j);
        for (int a = 0; a < 3; ++a) {
            s[a] = y[3 * j + a];
            for (int b = 0; b < a; ++b) s[a] -= own[3 * a + b] * s[b];
            s[a] *= own[3 * a + a];
        }
        for (int i = j + 1 + lane; i <= m.last.data[j]; i += lanes) {
            if (m.first.data[i] > j) continue;
            const long long group = m.rows.data[i] - m.first.data[i] / 4 + j / 4;
            const double* block = m.left.data + width * group + j % 4;
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) y[3 * i + a] -= block[4 * (3 * a + b)] * s[b];
        }
        MEET
        if (lane == 0)
            for (int a = 0; a < 3; ++a) y[3 * j + a] = a < 2 ? s[a] : -s[a];
    }
    MEET
    for (int i = end - 1; i >= begin; --i) {
        const double* own = (const double*)(diagonal.data + i);
        const double* row = m.left.data + (long long)width * (m.rows.data[i] - m.first.data[i] / 4);
        for (int a = 3 - 1; a >= 0; --a) {
            s[a] = y[3 * i + a];
            for (int b = a + 1; b < 3; ++b) s[a] -= own[3 * b + a] * s[b];
            s[a] *= own[3 * a + a];
        }
        for (int j = m.first.data[i] + lane; j < i; j += lanes) {
            const double* block = row + (long long)width * (j / 4) + j % 4;
            for (int b = 0; b < 3; ++b) {
                double sum = 0.0;
                for (int a = 0; a < 3; ++a) sum += block[4 * (3 * a + b)] * s[a];
                y[3 * j + b] -= sum;
            }
        }
        MEET
        if (lane == 0)
            for (int a = 0; a < 3; ++a) y[3 * i + a] = s[a];
    }
    MEET
"""


@wp.func_native(MEET)
def meet(p: int, lane: int, lanes: int, gates: wp.array[wp.int32]):
    """Wait for the other lanes of matrix p; ``gates`` hold a number for each on the host, [count * lanes], zeros."""


@wp.func_native(PRODUCT)
def product_of_rows(u: int, v: int, count: int, left: wp.array[wp.float64]) -> wp.mat33d:  # type: ignore[empty-body]
    """Return the sum of X S Yᵀ, S = diag(1, 1, -1), over the blocks X of ``count`` groups from u on and Y from v on."""


@wp.func
def group_of(i: int, j: int, m: Envelope) -> int:
    """Return which group has the block with rows of vertex i and columns of vertex j, first[i] <= j < i."""
    return int(m.rows[i]) + j // COLUMNS - m.first[i] // COLUMNS


@wp.func
def groups_before(i: int, m: Envelope) -> int:
    """Return how many groups the blocks of vertex i with the vertices before it take."""
    return (i + COLUMNS - 1) // COLUMNS - m.first[i] // COLUMNS


@wp.func
def clear_row(i: int, m: Envelope):
    """Set the blocks of vertex i with those before it to zero."""
    for k in range(9 * COLUMNS * int(m.rows[i]), 9 * COLUMNS * (int(m.rows[i]) + groups_before(i, m))):
        m.left[k] = ZERO


@wp.func
def add_block(i: int, j: int, block: wp.mat33d, m: Envelope):
    """Add a block with rows of vertex i and columns of vertex j < i."""
    at = 9 * COLUMNS * group_of(i, j, m) + j % COLUMNS
    for a in range(3):
        for b in range(3):
            m.left[at] = m.left[at] + block[a, b]
            at += COLUMNS


@wp.func
def saddle_pivot(j: int, rest: wp.mat33d, diagonal: wp.array[wp.mat33d]) -> bool:
    """Replace a block on the diagonal by its factor, with its own diagonal inverted; return whether it has one."""
    if not rest[0, 0] > ZERO:
        return False
    l00 = ONE / wp.sqrt(rest[0, 0])
    l10 = rest[1, 0] * l00
    l20 = rest[2, 0] * l00
    pivot = rest[1, 1] - l10 * l10
    if not pivot > ZERO:
        return False
    l11 = ONE / wp.sqrt(pivot)
    l21 = (rest[2, 1] - l20 * l10) * l11
    pivot = l20 * l20 + l21 * l21 - rest[2, 2]
    if not pivot > ZERO:
        return False
    diagonal[j] = wp.mat33d(l00, ZERO, ZERO, l10, l11, ZERO, l20, l21, ONE / wp.sqrt(pivot))
    return True


@wp.func
def factorise_envelope(
    p: int,
    lane: int,
    lanes: int,
    m: Envelope,
    gates: wp.array[wp.int32],
    # Data in and out:
    diagonal: wp.array[wp.mat33d],
    definite: wp.array2d[wp.float64],
):
    """Factorise quasi-definite matrix p as L S Lᵀ, S = diag(1, 1, -1) at every vertex, the diagonal of L inverted.

    The third unknown of every vertex is a multiplier (:mod:`omtwarp.solvers.cholesky.saddle`). ``definite`` of p gets 1
    where all pivots have their signs, otherwise 0.
    """
    for j in range(m.starts[p], m.starts[p + 1]):
        if lane == 0:
            at = group_of(j, m.first[j], m)
            total = product_of_rows(at, at, groups_before(j, m), m.left)
            definite[p, 0] = ZERO
            if saddle_pivot(j, diagonal[j] - total, diagonal):
                definite[p, 0] = ONE
        meet(p, lane, lanes, gates)
        if not definite[p, 0] > ZERO:
            return
        own = diagonal[j]
        for i in range(j + 1 + lane, m.last[j] + 1, lanes):
            if m.first[i] <= j:
                both = wp.max(m.first[i], m.first[j])
                count = (j + COLUMNS - 1) // COLUMNS - both // COLUMNS
                total = product_of_rows(group_of(i, both, m), group_of(j, both, m), count, m.left)
                at = 9 * COLUMNS * group_of(i, j, m) + j % COLUMNS
                for a in range(3):
                    x = (m.left[at] - total[a, 0]) * own[0, 0]
                    y = (m.left[at + COLUMNS] - total[a, 1] - x * own[1, 0]) * own[1, 1]
                    z = (m.left[at + 2 * COLUMNS] - total[a, 2] - x * own[2, 0] - y * own[2, 1]) * own[2, 2]
                    m.left[at] = x
                    m.left[at + COLUMNS] = y
                    m.left[at + 2 * COLUMNS] = -z
                    at += 3 * COLUMNS
        meet(p, lane, lanes, gates)


@wp.func_native(
    "    const int begin = m.starts.data[p], end = m.starts.data[p + 1];" + SUBSTITUTE.replace("MEET", MEET)
)
def solve_envelope(
    p: int,
    lane: int,
    lanes: int,
    m: Envelope,
    gates: wp.array[wp.int32],
    diagonal: wp.array[wp.mat33d],
    # Data in and out:
    x: wp.array[wp.vec3d],
):
    """Replace the right-hand side of matrix p by the solution: two coordinates and the multiplier of every vertex."""
