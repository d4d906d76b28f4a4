"""Kernels that sum in an order that depends only on the number of terms: the same bits on every run and device."""

from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)

# A thread sums GROUP rows, LANES apart: neighbouring threads read neighbouring memory on CUDA, and on a CPU the next
# thread reads from cache.
GROUP = wp.constant(64)
LANES = wp.constant(32)


@wp.func
def first_row(thread: int):
    return (thread // LANES) * (LANES * GROUP) + thread % LANES


@wp.func
def column_sum(rows: wp.array2d[wp.float64], column: int):
    total = wp.float64(0.0)
    for i in range(rows.shape[0]):
        total += rows[i, column]
    return total


@wp.kernel
def sum_rows(
    rows: wp.array2d[wp.float64],
    # Data out:
    sums: wp.array2d[wp.float64],
):
    """Compute the sums of GROUP rows each, column by column."""
    thread, column = wp.tid()
    total = wp.float64(0.0)
    i = first_row(thread)
    for _ in range(GROUP):
        if i < rows.shape[0]:
            total += rows[i, column]
        i += LANES
    sums[thread, column] = total


@wp.kernel
def sum_products(
    a: wp.array[wp.float64],
    b: wp.array[wp.float64],
    # Data out:
    sums: wp.array2d[wp.float64],
):
    """Compute the sums of GROUP products each."""
    thread = wp.tid()
    total = wp.float64(0.0)
    i = first_row(thread)
    for _ in range(GROUP):
        if i < a.shape[0]:
            total += a[i] * b[i]
        i += LANES
    sums[thread, 0] = total


@wp.kernel
def finish_sum(
    rows: wp.array2d[wp.float64],
    # Data out:
    total: wp.array[wp.float64],
):
    total[0] = column_sum(rows, 0)
