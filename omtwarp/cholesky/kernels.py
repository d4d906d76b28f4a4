"""Kernels around the dense eliminations: fronts added to the fronts above them, and triangular solves.

They run on the CPU, beside the dense eliminations of LAPACK. Fronts are stored by columns, one after another.
"""

from omtwarp._warp import wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def add_fronts(
    begin: int,
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
    for c in range(fronts[begin + t], fronts[begin + t + 1]):
        p = parent[c]
        size = block * wp.int32(starts[c + 1] - starts[c])
        parent_size = block * wp.int32(starts[p + 1] - starts[p])
        own = block * owned[c]
        rows = starts[c]
        for j in range(own, size):
            row = j // block
            target = block * upward[rows + wp.int64(row)] + (j - block * row)
            source = offsets[c] + wp.int64(j) * wp.int64(size)
            column = offsets[p] + wp.int64(target) * wp.int64(parent_size)
            if block == 1:
                for i in range(j, size):
                    to = column + wp.int64(upward[rows + wp.int64(i)])
                    above[to] = above[to] + below[source + wp.int64(i)]
            else:
                for i in range(row, size // block):
                    to = column + wp.int64(2 * upward[rows + wp.int64(i)])
                    above[to] = above[to] + below[source + wp.int64(2 * i)]
                    above[to + wp.int64(1)] = above[to + wp.int64(1)] + below[source + wp.int64(2 * i + 1)]


# Raw pointers, because the compiler turns loops over them into vector instructions and loops over Warp's arrays not:
# three times as fast. A front's own rows are consecutive in x; its other rows are gathered once for all its columns.
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
