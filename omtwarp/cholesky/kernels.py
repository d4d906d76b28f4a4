"""Kernels around the dense eliminations: fronts added to the fronts above them, and triangular solves.

They run on the CPU, beside the dense eliminations of LAPACK. Fronts are stored by columns, one after another.
"""

from omtwarp._warp import wp

wp.set_module_options({"enable_backward": False})


# Raw pointers, because the compiler turns loops over them into vector instructions and loops over Warp's arrays not:
# three times as fast.
ADD = """
    const int rows_count = starts.data[c + 1] - starts.data[c];
    const int size = block * rows_count, p = parent.data[c];
    const int parent_size = block * (starts.data[p + 1] - starts.data[p]);
    const int* __restrict__ to = upward.data + starts.data[c];
    const double* __restrict__ column = below.data + offsets.data[c];
    double* __restrict__ target = above.data + offsets.data[p];
    for (int j = block * owned.data[c]; j < size; ++j) {
        const int row = j / block;
        const double* source = column + (long long)j * size;
        double* into = target + (long long)(block * to[row] + j % block) * parent_size;
        if (block == 1) {
            for (int i = row; i < rows_count; ++i) into[to[i]] += source[i];
        } else {
            for (int i = row; i < rows_count; ++i) {
                into[2 * to[i]] += source[2 * i];
                into[2 * to[i] + 1] += source[2 * i + 1];
            }
        }
    }
"""


@wp.func_native(ADD)
def add_front(
    c: int,
    block: int,
    owned: wp.array[wp.int32],
    starts: wp.array[wp.int64],
    upward: wp.array[wp.int32],
    parent: wp.array[wp.int32],
    offsets: wp.array[wp.int64],
    below: wp.array[wp.float64],
    above: wp.array[wp.float64],
): ...


@wp.kernel
def add_fronts(
    fronts: wp.array[wp.int32],
    block: int,
    owned: wp.array[wp.int32],
    starts: wp.array[wp.int64],
    upward: wp.array[wp.int32],
    parent: wp.array[wp.int32],
    offsets: wp.array[wp.int64],
    below: wp.array[wp.float64],
    # Data in and out:
    above: wp.array[wp.float64],
):
    """Add what is left of fronts to their parents, lower triangles only; siblings are added by the same thread."""
    t = wp.tid()
    for c in range(fronts[t], fronts[t + 1]):
        add_front(c, block, owned, starts, upward, parent, offsets, below, above)


ENTER = """
    const int width = block * block, length = lengths.data[t];
    const double* value = values.data + (long long)width * source.data[t];
    double* into = room.data + first.data[t];
    for (int v = 0; v < block; ++v)
        for (int u = 0; u < block; ++u)
            into[(long long)v * length + u] = turned.data[t] ? value[block * v + u] : value[block * u + v];
"""


@wp.func_native(ENTER)
def enter_block(
    t: int,
    block: int,
    first: wp.array[wp.int64],
    lengths: wp.array[wp.int32],
    source: wp.array[wp.int32],
    turned: wp.array[wp.uint8],
    values: wp.array[wp.float64],
    room: wp.array[wp.float64],
): ...


@wp.kernel
def enter_blocks(
    block: int,
    first: wp.array[wp.int64],
    lengths: wp.array[wp.int32],
    source: wp.array[wp.int32],
    turned: wp.array[wp.uint8],
    values: wp.array[wp.float64],
    # Data in and out:
    room: wp.array[wp.float64],
):
    """Put blocks of the matrix, or their transposes, at their places in the fronts."""
    t = wp.tid()
    enter_block(t, block, first, lengths, source, turned, values, room)


# A front's own rows are consecutive in x; its other rows are gathered once for all its columns.
DOWN = """
    for (int f = 0; f < fronts; ++f) {
        const int rows_count = starts.data[f + 1] - starts.data[f];
        const int size = block * rows_count, own = block * owned.data[f], rest = size - own;
        double* __restrict__ y = x.data + (long long)r * unknowns + block * first.data[f];
        double* __restrict__ w = gathered.data + (long long)r * room;
        for (int i = 0; i < rest; ++i) w[i] = 0.0;
        const double* column = factor.data + offsets.data[f];
        int j = 0;
        for (; j + 1 < own; j += 2) {
            const double* __restrict__ a = column + (long long)j * size;
            const double* __restrict__ b = a + size;
            const double u = y[j] / a[j];
            const double v = (y[j + 1] - a[j + 1] * u) / b[j + 1];
            y[j] = u;
            y[j + 1] = v;
            for (int i = j + 2; i < own; ++i) y[i] -= a[i] * u + b[i] * v;
            a += own;
            b += own;
            for (int i = 0; i < rest; ++i) w[i] += a[i] * u + b[i] * v;
        }
        for (; j < own; ++j) {
            const double* __restrict__ a = column + (long long)j * size;
            const double u = y[j] / a[j];
            y[j] = u;
            for (int i = j + 1; i < own; ++i) y[i] -= a[i] * u;
            a += own;
            for (int i = 0; i < rest; ++i) w[i] += a[i] * u;
        }
        const int* row = rows.data + starts.data[f] + owned.data[f];
        double* all = x.data + (long long)r * unknowns;
        for (int i = 0; i < rest; ++i) all[block * row[i / block] + i % block] -= w[i];
    }
"""

UP = """
    for (int f = fronts - 1; f >= 0; --f) {
        const int rows_count = starts.data[f + 1] - starts.data[f];
        const int size = block * rows_count, own = block * owned.data[f], rest = size - own;
        double* __restrict__ w = gathered.data + (long long)r * room;
        double* all = x.data + (long long)r * unknowns;
        const int* row = rows.data + starts.data[f] + owned.data[f];
        // Own rows come first in w, so that a column meets one stretch of numbers.
        for (int i = 0; i < rest; ++i) w[own + i] = all[block * row[i / block] + i % block];
        double* y = all + block * first.data[f];
        const double* column = factor.data + offsets.data[f];
        for (int j = own - 1; j >= 0; --j) {
            const double* __restrict__ a = column + (long long)j * size;
            double s[8] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
            int i = j + 1;
            for (; i + 7 < size; i += 8)
                for (int k = 0; k < 8; ++k) s[k] += a[i + k] * w[i + k];
            double total = ((s[0] + s[1]) + (s[2] + s[3])) + ((s[4] + s[5]) + (s[6] + s[7]));
            for (; i < size; ++i) total += a[i] * w[i];
            w[j] = (y[j] - total) / a[j];
        }
        for (int j = 0; j < own; ++j) y[j] = w[j];
    }
"""


@wp.func_native(DOWN)
def substitute_down(
    r: int,
    unknowns: int,
    room: int,
    fronts: int,
    block: int,
    first: wp.array[wp.int32],
    owned: wp.array[wp.int32],
    starts: wp.array[wp.int64],
    rows: wp.array[wp.int32],
    factor: wp.array[wp.float64],
    offsets: wp.array[wp.int64],
    gathered: wp.array[wp.float64],
    x: wp.array[wp.float64],
): ...


@wp.func_native(UP)
def substitute_up(
    r: int,
    unknowns: int,
    room: int,
    fronts: int,
    block: int,
    first: wp.array[wp.int32],
    owned: wp.array[wp.int32],
    starts: wp.array[wp.int64],
    rows: wp.array[wp.int32],
    factor: wp.array[wp.float64],
    offsets: wp.array[wp.int64],
    gathered: wp.array[wp.float64],
    x: wp.array[wp.float64],
): ...


@wp.kernel
def solve_triangular(
    upward: int,
    unknowns: int,
    room: int,
    fronts: int,
    block: int,
    first: wp.array[wp.int32],
    owned: wp.array[wp.int32],
    starts: wp.array[wp.int64],
    rows: wp.array[wp.int32],
    factor: wp.array[wp.float64],
    offsets: wp.array[wp.int64],
    gathered: wp.array[wp.float64],
    # Data in and out, one thread per right-hand side:
    x: wp.array[wp.float64],
):
    """x <- L^-T x if ``upward`` is 1, else x <- L^-1 x."""
    r = wp.tid()
    if upward == 1:
        substitute_up(
            r, unknowns, room, fronts, block, first, owned, starts, rows, factor, offsets, gathered, x
        )
    else:
        substitute_down(
            r, unknowns, room, fronts, block, first, owned, starts, rows, factor, offsets, gathered, x
        )
