"""Sums on the device in an order that depends only on the number of terms, and sums by NumPy on the host."""

from __future__ import annotations

from omtwarp.device.policy import is_cuda
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


# Partial sums are reduced to at most this many rows; the thread that needs the total adds those.
MAX_PARTIAL_ROWS = 64


def partial_count(rows: int) -> int:
    """Return the number of threads that sum this many rows, GROUP rows each."""
    return LANES * -(-rows // (LANES * GROUP))


class RowSums:
    """Sums the columns of an array, down to a few rows of partial sums.

    Args:
        rows, columns: shape of the arrays to be summed.
        device: a Warp device.
    """

    def __init__(self, rows: int, columns: int, device: wp.Device):
        self._device = device
        self._levels: list[wp.array] = []
        while rows > MAX_PARTIAL_ROWS:
            rows = partial_count(rows)
            self._levels.append(wp.empty((rows, columns), dtype=wp.float64, device=device))

    def __call__(self, values: wp.array) -> wp.array:
        """Return at most MAX_PARTIAL_ROWS partial sums of an array [rows, columns], valid until the next call."""
        for level in self._levels:
            wp.launch(sum_rows, dim=level.shape, inputs=[values], outputs=[level], device=self._device)
            values = level
        return values


class DeviceSum:
    """Sums over float64 arrays of one dimension, without leaving the device.

    Args:
        device: a Warp device.
    """

    def __init__(self, device: wp.Device):
        self.device = device
        self._workspace: dict[int, tuple[wp.array, RowSums, RowSums]] = {}

    def dot(self, a: wp.array, b: wp.array, out: wp.array) -> None:
        """Write a · b to the first element of ``out``."""
        partial, _, sums = self._workspace_for(a.size)
        wp.launch(sum_products, dim=len(partial), inputs=[a, b], outputs=[partial], device=self.device)
        wp.launch(finish_sum, dim=1, inputs=[sums(partial)], outputs=[out], device=self.device)

    def total(self, a: wp.array, out: wp.array) -> None:
        """Write the sum of all elements to the first element of ``out``."""
        _, sums, _ = self._workspace_for(a.size)
        inputs = [sums(a.reshape((a.size, 1)))]
        wp.launch(finish_sum, dim=1, inputs=inputs, outputs=[out], device=self.device)

    def _workspace_for(self, length: int) -> tuple[wp.array, RowSums, RowSums]:
        """Return the workspace of a length: an array of partial products, and the sums of values and of products."""
        if length not in self._workspace:
            rows = partial_count(length)
            partial = wp.empty((rows, 1), dtype=wp.float64, device=self.device)
            self._workspace[length] = partial, RowSums(length, 1, self.device), RowSums(rows, 1, self.device)
        return self._workspace[length]


class HostSum:
    """Sums by NumPy, in its order of summation, for arrays that the host can read."""

    def dot(self, a: wp.array, b: wp.array, out: wp.array) -> None:
        """Write a · b to the first element of ``out``."""
        out[:1].fill_(float(a.numpy() @ b.numpy()))

    def total(self, a: wp.array, out: wp.array) -> None:
        """Write the sum of all elements to the first element of ``out``."""
        out[:1].fill_(float(a.numpy().sum()))


def sums_for(device: wp.Device) -> DeviceSum | HostSum:
    """Choose where sums are computed: on CUDA by kernels, else by NumPy."""
    return DeviceSum(device) if is_cuda(device) else HostSum()
