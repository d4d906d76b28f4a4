"""Kernels of the factorisation, front by front, and of the triangular solves.

They run on the CPU and call LAPACK. Fronts are stored by columns, and only their lower triangles are used.
"""

from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Fronts:
    """The fronts of an elimination and their places in memory; see :class:`omtwarp.solvers.cholesky.Dissection`."""

    block: wp.int32  # unknowns per vertex
    first: wp.array[wp.int32]
    owned: wp.array[wp.int32]
    negative: wp.array[wp.int32]  # how many of a front's own columns, the last ones, have negative pivots
    starts: wp.array[wp.int64]
    rows: wp.array[wp.int32]
    upward: wp.array[wp.int32]
    family_starts: wp.array[wp.int32]
    families: wp.array[wp.int32]
    order: wp.array[wp.int32]
    edge_starts: wp.array[wp.int32]
    edges: wp.array[wp.int32]
    edge_rows: wp.array[wp.int32]
    edge_columns: wp.array[wp.int32]
    turned: wp.array[wp.bool]
    offsets: wp.array[wp.int64]  # of a front in the workspace
    factor_offsets: wp.array[wp.int64]  # of its columns in the factor
    routines: wp.array[wp.uint64]  # addresses of LAPACK's and BLAS's
    single: wp.bool  # whether fronts and factor are of float32, two in the place of one float64
    factor: wp.array[wp.float64]


def of_numbers(text: str) -> str:
    """Return the text of a function whose fronts are of float32 or float64, called Real there."""
    return (
        "auto run = [&](auto zero) {\n    typedef decltype(zero) Real;" + text + "};\n"
        "return tree.single ? run(0.0f) : run(0.0);"
    )


# Raw pointers, because the compiler vectorises loops over them but not over Warp's arrays: three times as fast. The
# pragmas prevent unrolling, which is no faster and takes about half of the time to compile this file. LAPACK and BLAS
# are called by address (see multifrontal.py), so that no front passes through Python.
ASSEMBLE = """
    const int block = tree.block;
    const int rows_count = tree.starts.data[f + 1] - tree.starts.data[f];
    const int size = block * rows_count, width = block * block;
    Real* __restrict__ front = (Real*)workspace.data + tree.offsets.data[f];
    for (int j = 0; j < size; ++j)
        #pragma clang loop interleave(disable) unroll(disable)
        for (long long i = j; i < size; ++i) front[i + (long long)j * size] = 0.0;
    for (int k = 0; k < tree.owned.data[f]; ++k) {
        const double* value = diagonal.data + (long long)width * tree.order.data[tree.first.data[f] + k];
        Real* into = front + (long long)block * k * size + block * k;
        #pragma clang loop vectorize(disable) unroll(disable)
        for (int v = 0; v < block; ++v)
            #pragma clang loop vectorize(disable) unroll(disable)
            for (int u = v; u < block; ++u) into[(long long)v * size + u] = (Real)value[block * u + v];
    }
    for (int e = tree.edge_starts.data[f]; e < tree.edge_starts.data[f + 1]; ++e) {
        const double* value = off_diagonal.data + (long long)width * tree.edges.data[e];
        Real* into = front + (long long)block * tree.edge_columns.data[e] * size + block * tree.edge_rows.data[e];
        const bool transposed = tree.turned.data[e];
        #pragma clang loop vectorize(disable) unroll(disable)
        for (int v = 0; v < block; ++v)
            #pragma clang loop vectorize(disable) unroll(disable)
            for (int u = 0; u < block; ++u)
                into[(long long)v * size + u] = (Real)(transposed ? value[block * v + u] : value[block * u + v]);
    }
    for (int k = tree.family_starts.data[f]; k < tree.family_starts.data[f + 1]; ++k) {
        const int c = tree.families.data[k];
        const int child_rows = tree.starts.data[c + 1] - tree.starts.data[c], child_size = block * child_rows;
        const int* __restrict__ to = tree.upward.data + tree.starts.data[c];
        const Real* __restrict__ column = (const Real*)workspace.data + tree.offsets.data[c];
        for (int j = block * tree.owned.data[c]; j < child_size; ++j) {
            const int row = j / block;
            const Real* source = column + (long long)j * child_size;
            Real* into = front + (long long)(block * to[row] + j % block) * size;
            if (block == 1) {
                #pragma clang loop interleave(disable) unroll(disable)
                for (int i = row; i < child_rows; ++i) into[to[i]] += source[i];
            } else {
                #pragma clang loop interleave(disable) unroll(disable)
                for (int i = row; i < child_rows; ++i) {
                    into[2 * to[i]] += source[2 * i];
                    into[2 * to[i] + 1] += source[2 * i + 1];
                }
            }
        }
    }
"""

ELIMINATE = """
    const int block = tree.block;
    typedef void (*Potrf)(const char*, const int*, Real*, const int*, int*);
    typedef void (*Trsm)(const char*, const char*, const char*, const char*, const int*, const int*, const Real*,
                         const Real*, const int*, Real*, const int*);
    typedef void (*Syrk)(const char*, const char*, const int*, const int*, const Real*, const Real*, const int*,
                         const Real*, Real*, const int*);
    const char lower = 'L', right = 'R', transposed = 'T', plain = 'N';
    const Real one = 1.0, minus = -1.0;
    const int size = block * (tree.starts.data[f + 1] - tree.starts.data[f]), own = block * tree.owned.data[f];
    Real* front = (Real*)workspace.data + tree.offsets.data[f];
    int info = 0;
    // First the columns with positive pivots, then, with their sign turned, those with negative ones.
    for (int sign = 1; sign >= -1 && info == 0; sign -= 2) {
        const int positive = own - tree.negative.data[f];
        const int begin = sign > 0 ? 0 : positive, end = sign > 0 ? positive : own;
        const int count = end - begin, rest = size - end;
        if (count == 0) continue;
        Real* corner = front + begin + (long long)begin * size;
        if (sign < 0)
            for (int j = 0; j < count; ++j)
                #pragma clang loop interleave(disable) unroll(disable)
                for (long long i = j; i < size - begin; ++i) corner[i + (long long)j * size] *= -1.0;
        ((Potrf)tree.routines.data[0])(&lower, &count, corner, &size, &info);
        if (info == 0 && rest > 0) {
            Real* side = corner + count;
            ((Trsm)tree.routines.data[1])(&right, &lower, &transposed, &plain, &rest, &count, &one, corner, &size, side,
                                     &size);
            ((Syrk)tree.routines.data[2])(&lower, &plain, &rest, &count, sign > 0 ? &minus : &one, side, &size, &one,
                                     front + end + (long long)end * size, &size);
        }
    }
    if (own > 0) {
        Real* __restrict__ kept = (Real*)tree.factor.data + tree.factor_offsets.data[f];
        for (int j = 0; j < own; ++j)
            #pragma clang loop interleave(disable) unroll(disable)
            for (long long i = j; i < size; ++i) kept[i + (long long)j * size] = front[i + (long long)j * size];
    }
    return info;
"""


@wp.func_native(of_numbers(ASSEMBLE))
def assemble_front(
    f: int,
    tree: Fronts,
    diagonal: wp.array[wp.float64],
    off_diagonal: wp.array[wp.float64],
    workspace: wp.array[wp.float64],
): ...


@wp.func_native(of_numbers(ELIMINATE))
def eliminate_front(f: int, tree: Fronts, workspace: wp.array[wp.float64]) -> int: ...  # type: ignore[empty-body]


@wp.kernel
def factorise_fronts(
    fronts: wp.array[wp.int32],
    diagonal: wp.array[wp.float64],
    off_diagonal: wp.array[wp.float64],
    # Data in and out:
    workspace: wp.array[wp.float64],
    # Data out, the factor among the fronts' arrays:
    tree: Fronts,
    failed: wp.array[wp.int32],
):
    """Assemble fronts, each from the matrix and its children, and eliminate them in order.

    One thread does all of them, since a front may depend on the one before; ``failed`` is the first whose pivots have
    the wrong sign, or -1. With L the columns as they are kept, the matrix is L S Lᵀ, S diagonal with entries 1 and -1.
    """
    failed[0] = wp.int32(-1)
    for k in range(fronts.shape[0]):
        f = fronts[k]
        assemble_front(f, tree, diagonal, off_diagonal, workspace)
        if eliminate_front(f, tree, workspace) != 0:
            failed[0] = f
            return


# Four columns at a time meet a stretch of four rows: one instruction for each column, and few loads of the rows. Every
# stretch asks for as much of the factor, 8 KiB further on, as it reads: with 2 to 64 KiB solves take about the same
# time, and up to twice as long without, since columns are too short for the processor to foresee.
STRETCHES = """
    #pragma clang fp contract(fast)
    typedef double Four __attribute__((vector_size(32), aligned(8)));
    typedef Real Kept __attribute__((vector_size(4 * sizeof(Real)), aligned(sizeof(Real))));
    auto four = [](const Real* from) { return __builtin_convertvector(*(const Kept*)from, Four); };
    auto soon = [](const Real* from) {
        __builtin_prefetch(from);
        if (sizeof(Real) > 4) __builtin_prefetch(from + 8);
    };
    const int block = tree.block, ahead = 8192 / sizeof(Real);
"""

# A front's own rows are consecutive in x. Contributions to the rows above go from child to parent, as in the
# factorisation: branches can run in parallel, and the order of every sum does not depend on the threads.
DOWN = """
    for (int k = 0; k < fronts.shape[0]; ++k) {
        const int f = fronts.data[k];
        const int rows_count = tree.starts.data[f + 1] - tree.starts.data[f];
        const int size = block * rows_count, own = block * tree.owned.data[f];
        double* y = x.data + (long long)r * unknowns + block * tree.first.data[f];
        double* mine = carried.data + (long long)r * stride;
        double* w = mine + block * tree.starts.data[f];
        for (int i = 0; i < size; ++i) w[i] = i < own ? y[i] : 0.0;
        for (int n = tree.family_starts.data[f]; n < tree.family_starts.data[f + 1]; ++n) {
            const int c = tree.families.data[n];
            const int child_rows = tree.starts.data[c + 1] - tree.starts.data[c];
            const int* to = tree.upward.data + tree.starts.data[c];
            const double* source = mine + block * tree.starts.data[c];
            for (int i = tree.owned.data[c]; i < child_rows; ++i)
                #pragma clang loop vectorize(disable) unroll(disable)
                for (int u = 0; u < block; ++u) w[block * to[i] + u] += source[block * i + u];
        }
        const Real* column = (const Real*)tree.factor.data + tree.factor_offsets.data[f];
        for (int j = 0; j < own; j += 4) {
            const int many = own - j < 4 ? own - j : 4;
            const Real* a[4];
            double u[4] = {};
            for (int c = 0; c < 4; ++c) a[c] = column + (long long)(c < many ? j + c : j) * size;
            for (int c = 0; c < many; ++c) {
                double left = w[j + c];
                for (int b = 0; b < c; ++b) left -= a[b][j + c] * u[b];
                w[j + c] = u[c] = left / a[c][j + c];
            }
            int i = j + many;
            for (; i + 3 < size; i += 4) {
                soon(a[0] + 4 * (i - j) + ahead);
                Four left = *(const Four*)(w + i);
                for (int c = 0; c < 4; ++c) left -= four(a[c] + i) * u[c];
                *(Four*)(w + i) = left;
            }
            #pragma clang loop vectorize(disable) unroll(disable)
            for (; i < size; ++i)
                for (int c = 0; c < 4; ++c) w[i] -= a[c][i] * u[c];
        }
        for (int i = 0; i < own; ++i) y[i] = w[i];
    }
"""

# The rows above are gathered once for all columns of a front, behind its own, so that a column meets one stretch.
UP = """
    for (int k = (int)fronts.shape[0] - 1; k >= 0; --k) {
        const int f = fronts.data[k];
        const int rows_count = tree.starts.data[f + 1] - tree.starts.data[f];
        const int size = block * rows_count, owned = tree.owned.data[f], own = block * owned;
        double* w = carried.data + (long long)r * stride + block * tree.starts.data[f];
        double* all = x.data + (long long)r * unknowns;
        const int* row = tree.rows.data + tree.starts.data[f];
        for (int i = owned; i < rows_count; ++i)
            #pragma clang loop vectorize(disable) unroll(disable)
            for (int u = 0; u < block; ++u) w[block * i + u] = all[block * row[i] + u];
        double* y = all + block * tree.first.data[f];
        const Real* column = (const Real*)tree.factor.data + tree.factor_offsets.data[f];
        for (int j = own - 1; j >= 0; j -= 4) {
            const Real* a[4];
            Four sums[4] = {};
            for (int c = 0; c < 4; ++c) a[c] = column + (long long)(j > c ? j - c : 0) * size;
            int i = j + 1;
            for (; i + 3 < size; i += 4) {
                soon(a[0] - 4 * (i - j) - ahead);
                const Four z = *(const Four*)(w + i);
                for (int c = 0; c < 4; ++c) sums[c] += four(a[c] + i) * z;
            }
            for (int c = 0; c < 4 && c <= j; ++c) {
                double total = (sums[c][0] + sums[c][1]) + (sums[c][2] + sums[c][3]);
                #pragma clang loop vectorize(disable) unroll(disable)
                for (int n = i; n < size; ++n) total += a[c][n] * w[n];
                for (int n = j; n > j - c; --n) total += a[c][n] * w[n];
                w[j - c] = (y[j - c] - total) / a[c][j - c];
            }
        }
        for (int j = 0; j < own; ++j) y[j] = w[j];
    }
"""


SUBSTITUTE = of_numbers(f"if (transposed == 1) {{{STRETCHES + UP}}} else {{{STRETCHES + DOWN}}}")


@wp.func_native(f"\n#ifndef __CUDA_ARCH__\n{SUBSTITUTE}\n#endif\n")  # a GPU has no such vectors
def substitute(
    r: int,
    fronts: wp.array[wp.int32],
    transposed: int,
    unknowns: int,
    stride: int,
    tree: Fronts,
    carried: wp.array[wp.float64],
    x: wp.array[wp.float64],
): ...


@wp.kernel
def solve_triangular(
    fronts: wp.array[wp.int32],
    transposed: int,
    unknowns: int,
    stride: int,
    tree: Fronts,
    # Data in and out, one thread per right-hand side:
    carried: wp.array[wp.float64],
    x: wp.array[wp.float64],
):
    """Compute the part of x <- L^-1 x, or x <- L^-T x where ``transposed`` is 1, of some fronts in order.

    Their children have to be done before, or their parents; ``carried`` holds ``stride`` numbers for each right-hand
    side, one for every row of every front.
    """
    r, _compiled_once = wp.tid()
    substitute(r, fronts, transposed, unknowns, stride, tree, carried, x)


PRODUCT = """
    const double* __restrict__ z = x.data + (long long)r * unknowns;
    double* __restrict__ y = rest.data + (long long)r * unknowns;
    for (int i = 0; i < unknowns; ++i) y[i] -= diagonal.data[tree.order.data[i]] * z[i];
    for (int f = 0; f < tree.first.shape[0]; ++f) {
        const int* row = tree.rows.data + tree.starts.data[f];
        for (int e = tree.edge_starts.data[f]; e < tree.edge_starts.data[f + 1]; ++e) {
            const double value = off_diagonal.data[tree.edges.data[e]];
            const int i = row[tree.edge_rows.data[e]], j = row[tree.edge_columns.data[e]];
            y[i] -= value * z[j];
            y[j] -= value * z[i];
        }
    }
"""


@wp.func_native(PRODUCT)
def subtract_row_products(
    r: int,
    unknowns: int,
    tree: Fronts,
    diagonal: wp.array[wp.float64],
    off_diagonal: wp.array[wp.float64],
    x: wp.array[wp.float64],
    rest: wp.array[wp.float64],
): ...


@wp.kernel
def subtract_product(
    unknowns: int,
    tree: Fronts,
    diagonal: wp.array[wp.float64],
    off_diagonal: wp.array[wp.float64],
    x: wp.array[wp.float64],
    # Data in and out, one thread per right-hand side:
    rest: wp.array[wp.float64],
):
    """Compute what a solution of a matrix with one unknown per vertex leaves of the right-hand side, in the order."""
    r, _compiled_once = wp.tid()
    subtract_row_products(r, unknowns, tree, diagonal, off_diagonal, x, rest)
