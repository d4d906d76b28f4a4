"""Colours in sRGB and in linear light (IEC 61966-2-1), from 0 to 1; kernels have the same formulas in float32."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Number = TypeVar("Number", np.float32, np.float64)

# The standard's formulas: a power law, and a straight line below a threshold that each direction has its own of.
THRESHOLD, LIGHT_THRESHOLD = 0.04045, 0.0031308
SLOPE, OFFSET, EXPONENT = 12.92, 0.055, 2.4


def to_linear(color: NDArray[Number]) -> NDArray[Number]:
    """Convert sRGB colours of any shape to linear light, in their own precision."""
    light = np.where(color <= THRESHOLD, color / SLOPE, ((color + OFFSET) / (1.0 + OFFSET)) ** EXPONENT)
    return light.astype(color.dtype)


def to_srgb(light: NDArray[Number]) -> NDArray[Number]:
    """Convert linear light of any shape to sRGB colours, in its own precision; values are clipped to 0 to 1."""
    clipped = np.clip(light, 0.0, 1.0)
    power = (1.0 + OFFSET) * clipped ** (1.0 / EXPONENT) - OFFSET
    return np.where(clipped <= LIGHT_THRESHOLD, SLOPE * clipped, power).astype(light.dtype)
