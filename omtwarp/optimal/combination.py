"""Linear combinations of numbers on the device."""

from __future__ import annotations

from omtwarp.device.arrays import empty
from omtwarp.device.start import wp
from omtwarp.optimal.kernels import linear_combination


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
