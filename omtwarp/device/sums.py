"""Sums on the device, in an order that depends on nothing but the number of terms; and their like on the host."""

from __future__ import annotations

from typing import Any

from omtwarp.device.policy import adds_on_device
from omtwarp.device.start import wp
from omtwarp.device.sum_kernels import GROUP, LANES, finish_sum, remove_mean, sum_products, sum_rows

# This few rows are left to the thread that needs their sum.
FEW = 64


def partial_count(rows: int) -> int:
    """Threads that sum so many rows, GROUP each."""
    return LANES * -(-rows // (LANES * GROUP))


class RowSums:
    """Sums of the columns of an array, down to a few rows of partial sums.

    Args:
        rows, columns: shape of the arrays to be summed.
        device: a Warp device.
    """

    def __init__(self, rows: int, columns: int, device: Any):
        self._device = device
        self._levels: list[Any] = []
        while rows > FEW:
            rows = partial_count(rows)
            self._levels.append(wp.empty((rows, columns), dtype=wp.float64, device=device))

    def __call__(self, values: Any) -> Any:
        """Partial sums of a float64 array [rows, columns]: at most FEW rows, which hold until the next call."""
        for level in self._levels:
            wp.launch(sum_rows, dim=level.shape, inputs=[values], outputs=[level], device=self._device)
            values = level
        return values


class DeviceSum:
    """Sums over float64 arrays of one dimension, without leaving the device.

    Args:
        device: a Warp device.
        length: of arrays that are to be summed while a graph is recorded, when it is too late to make room for them.
    """

    def __init__(self, device: Any, length: int | None = None):
        self.device = device
        self._room: dict[int, tuple[Any, RowSums, RowSums]] = {}
        if length is not None:
            self._room_for(length)

    def products(self, a: Any, b: Any) -> Any:
        """Partial sums of a · b, at most FEW rows of one: what the kernels that need the sum finish themselves."""
        partial, _, sums = self._room_for(a.size)
        wp.launch(sum_products, dim=len(partial), inputs=[a, b], outputs=[partial], device=self.device)
        return sums(partial)

    def dot(self, a: Any, b: Any, out: Any) -> None:
        """a · b as the first element of ``out``."""
        wp.launch(finish_sum, dim=1, inputs=[self.products(a, b)], outputs=[out], device=self.device)

    def total(self, a: Any, out: Any) -> None:
        """The sum of all elements as the first element of ``out``."""
        _, sums, _ = self._room_for(a.size)
        inputs = [sums(a.reshape((a.size, 1)))]
        wp.launch(finish_sum, dim=1, inputs=inputs, outputs=[out], device=self.device)

    def remove_mean(self, a: Any, room: Any) -> None:
        """Take the mean off every element; ``room`` is for one number."""
        self.total(a, room)
        wp.launch(remove_mean, dim=a.size, inputs=[room], outputs=[a], device=self.device)

    def _room_for(self, length: int) -> tuple[Any, RowSums, RowSums]:
        """Where products are summed first; sums of values, and of those products."""
        if length not in self._room:
            rows = partial_count(length)
            partial = wp.empty((rows, 1), dtype=wp.float64, device=self.device)
            self._room[length] = partial, RowSums(length, 1, self.device), RowSums(rows, 1, self.device)
        return self._room[length]


class HostSum:
    """The same by NumPy, in its order: for arrays that the host reads anyway."""

    def dot(self, a: Any, b: Any, out: Any) -> None:
        """a · b as the first element of ``out``."""
        out[:1].fill_(float(a.numpy() @ b.numpy()))

    def total(self, a: Any, out: Any) -> None:
        """The sum of all elements as the first element of ``out``."""
        out[:1].fill_(float(a.numpy().sum()))


def sums_for(device: wp.Device, vertices: int) -> DeviceSum | HostSum:
    """What adds for systems on a surface: the device where they are solved there, or where the host cannot read."""
    return DeviceSum(device) if adds_on_device(device, vertices) else HostSum()


__all__ = ["FEW", "DeviceSum", "HostSum", "RowSums", "partial_count", "sums_for"]
