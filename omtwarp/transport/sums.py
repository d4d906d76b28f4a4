"""Sums on the device, in an order that depends on nothing but the number of terms."""

from __future__ import annotations

from typing import Any

from omtwarp._warp import wp
from omtwarp.transport.descent_kernels import GROUP, LANES, sum_rows

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


__all__ = ["FEW", "RowSums", "partial_count"]
