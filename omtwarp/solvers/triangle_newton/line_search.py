"""Line search by halving until the energy falls as predicted by its slope (Armijo's condition)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp

SUFFICIENT_DECREASE = 1e-4  # share of the decrease that the slope predicts (Nocedal and Wright 2006, chapter 3)


def search_patches(
    move: Callable[[NDArray[np.float64]], wp.array],
    energies_of: Callable[[wp.array], NDArray[np.float64]],
    energies: NDArray[np.float64],
    slopes: NDArray[np.float64],
    longest: NDArray[np.float64],
    halvings: int,
) -> tuple[wp.array, NDArray[np.float64]]:
    """Step lengths of independent patches, each halved until its own energy falls; what never falls stays.

    Args:
        move: the points after steps of given lengths, one per patch.
        energies_of: the energy of every patch at such points.
        energies, slopes: of every patch before the step.
        longest: lengths to begin with; patches with 0 stay.
        halvings: most of them.

    Returns:
        The points moved, and the lengths.
    """
    length = longest.copy()
    for _ in range(halvings):
        moved = move(length)
        worse = ~(energies_of(moved) <= energies + SUFFICIENT_DECREASE * length * slopes) & (length > 0.0)
        if not worse.any():
            return moved, length
        length[worse] *= 0.5
    length[worse] = 0.0
    return move(length), length
