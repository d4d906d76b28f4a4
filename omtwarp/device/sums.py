"""Sums on the device in an order that depends only on the terms, sums by NumPy, combinations and sparse products."""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from omtwarp.device.arrays import empty
from omtwarp.device.policy import shares_host_memory
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.device.threads import FIRST_THREAD, launch_parts

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


@wp.kernel
def raise_to_largest(
    values: wp.array[wp.float64],
    # Data in and out:
    largest: wp.array[wp.float64],
):
    """Raise a number to the largest absolute value; what is no number does not count."""
    size = wp.abs(values[wp.tid()])
    if size > largest[0]:
        wp.atomic_max(largest, 0, size)


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
        wp.launch(finish_sum, dim=1, inputs=[sums(a.reshape((a.size, 1)))], outputs=[out], device=self.device)

    def largest(self, a: wp.array, out: wp.array) -> None:
        """Write the largest absolute value to the first element of ``out``; what is no number does not count."""
        out.zero_()
        wp.launch(raise_to_largest, dim=a.size, inputs=[a], outputs=[out], device=self.device)

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
        out.numpy()[0] = a.numpy() @ b.numpy()

    def total(self, a: wp.array, out: wp.array) -> None:
        """Write the sum of all elements to the first element of ``out``."""
        out.numpy()[0] = a.numpy().sum()

    def largest(self, a: wp.array, out: wp.array) -> None:
        """Write the largest absolute value to the first element of ``out``."""
        out.numpy()[0] = np.abs(a.numpy()).max()


class Reading:
    """Numbers that a device computes one after another, and the host reads at once.

    Args:
        device: a Warp device.

    Example:
        >>> from omtwarp.device.start import wp
        >>> from omtwarp.device.sums import Reading
        >>> reading, ones = Reading(wp.get_device("cpu")), wp.full(5, 1.0, dtype=wp.float64, device="cpu")
        >>> total, largest = reading.dot(ones, ones), reading.largest(ones)
        >>> numbers = reading.read()
        >>> float(numbers[total]), float(numbers[largest])
        (5.0, 1.0)
    """

    MOST = 32  # numbers between two reads

    def __init__(self, device: wp.Device):
        self._adder = sums_for(device)
        self._numbers = wp.zeros(self.MOST, dtype=wp.float64, device=device)
        self._places: list[wp.array] = []
        self._used = 0

    def place(self) -> tuple[int, wp.array]:
        """Return the place of the next number, which is 0, and the array of one element that is read there."""
        place = self._used
        self._used += 1
        if place == len(self._places):
            self._places.append(self._numbers[place : place + 1])
        return place, self._places[place]

    def add(self, a: wp.array, b: wp.array, out: wp.array) -> None:
        """Write a · b to the first element of ``out``, for kernels that need it before the host."""
        self._adder.dot(a, b, out)

    def dot(self, a: wp.array, b: wp.array) -> int:
        """Compute a · b; return its place among the numbers read."""
        place, out = self.place()
        self.add(a, b, out)
        return place

    def largest(self, a: wp.array) -> int:
        """Compute the largest absolute value; return its place among the numbers read."""
        place, out = self.place()
        self._adder.largest(a, out)
        return place

    def read(self) -> NDArray[np.float64]:
        """Return all numbers since the last call, and begin anew."""
        numbers: NDArray[np.float64] = self._numbers.numpy().copy()
        self._numbers.zero_()
        self._used = 0
        return numbers


def sums_for(device: wp.Device) -> DeviceSum | HostSum:
    """Choose where sums are computed: on CUDA by kernels, else by NumPy."""
    return HostSum() if shares_host_memory(device) else DeviceSum(device)


@wp.kernel
def linear_combination(
    factor: wp.float64,
    one: wp.array[wp.float64],
    other_factor: wp.float64,
    other: wp.array[wp.float64],
    # Data out:
    sums: wp.array[wp.float64],
):
    """Compute factor times one plus other_factor times the other."""
    i = wp.tid()
    sums[i] = factor * one[i] + other_factor * other[i]


def combine(
    factor: float, one: wp.array, other_factor: float, other: wp.array, out: wp.array | None = None
) -> wp.array:
    """Return factor times one plus other_factor times other, float64, shape [N], in ``out`` where it is given."""
    sums = empty(one.size, wp.float64, one.device) if out is None else out
    inputs = [wp.float64(factor), one, wp.float64(other_factor), other]
    wp.launch(linear_combination, dim=one.size, inputs=inputs, outputs=[sums], device=one.device)
    return sums


def scaled(values: wp.array, factor: float, out: wp.array | None = None) -> wp.array:
    """Return a multiple of numbers, float64, shape [N], in ``out`` where it is given."""
    return combine(factor, values, 0.0, values, out)


@wp.kernel
def add_product(
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    source: wp.array[wp.float64],
    factor: wp.float64,
    first: int,
    # Data in and out:
    target: wp.array[wp.float64],
):
    """Add (factor) x (the product of a sparse matrix, row by row, with ``source``)."""
    i = first + wp.tid()
    total = wp.float64(0.0)
    for n in range(offsets[i], offsets[i + 1]):
        total += weights[n] * source[columns[n]]
    target[i] = target[i] + factor * total  # spelt out: += on an array is an atomic addition in Warp


class SparseProduct:
    """A sparse matrix on a device, and its products with arrays.

    Args:
        matrix: shape [M, N].
        device: a Warp device.
    """

    def __init__(self, matrix: sparse.spmatrix | NDArray[np.float64], device: wp.Device) -> None:
        rows = sparse.csr_matrix(matrix)
        kinds = ((rows.indptr, wp.int32), (rows.indices, wp.int32), (rows.data, wp.float64))
        self._count, self._device = rows.shape[0], device
        self._rows = [wp.array(numbers, dtype=kind, device=device) for numbers, kind in kinds]

    def add(self, source: wp.array, target: wp.array, factor: float = 1.0) -> None:
        """Add (factor) x (the product with ``source``, shape [N]) to ``target``, shape [M]."""
        launch_parts(add_product, self._count, [*self._rows, source, factor, FIRST_THREAD], [target], self._device)

    def __call__(self, source: wp.array, factor: float = 1.0) -> wp.array:
        """Return (factor) x (the product with ``source``, shape [N]), shape [M]."""
        product = empty(self._count, wp.float64, self._device)
        product.zero_()
        self.add(source, product, factor)
        return product
