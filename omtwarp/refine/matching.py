"""The weight of area against angle whose refined map has a wanted area distortion, found by bisection."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

LEAST_WEIGHT, MOST_WEIGHT = 1e-3, 1000.0  # between which the weight is looked for, by bisection of its logarithm

Map = TypeVar("Map")


def match_area(
    first: Map,
    area: float,
    refine: Callable[[Map, float], Map],
    area_of: Callable[[Map], float],
    *,
    tolerance: float,
    trials: int,
    least: float = LEAST_WEIGHT,
) -> tuple[Map, float]:
    """Find the least weight whose refined map has at most an area distortion.

    Args:
        first: the map refined with ``MOST_WEIGHT``.
        area: the mean of r + 1/r, r being the ratio of areas.
        refine: refines a map with a weight.
        area_of: measures a map; what is not less than infinity is never taken.
        tolerance: how far below ``area`` the map may be.
        trials: weights that are tried at most.
        least: the least of them.

    Returns:
        The map and its weight: the first one where no other has less distortion than ``area``, or where it is within
        the tolerance or above.

    Example:
        >>> from omtwarp.refine.matching import match_area
        >>> found, weight = match_area(
        ...     2.001, 2.01, lambda _, weight: 2.0 + 1.0 / weight, float, tolerance=1e-4, trials=16
        ... )
        >>> 2.0099 <= found <= 2.01, 100.0 <= weight <= 101.0
        (True, True)
    """
    best = found = first
    reached, weight = area_of(first), MOST_WEIGHT
    low, high = np.log(least), np.log(MOST_WEIGHT)
    for _ in range(trials):
        if not area - tolerance > reached:
            break
        middle = 0.5 * (low + high)
        found = refine(found, float(np.exp(middle)))
        here = area_of(found)
        if here <= area:
            best, reached, weight, high = found, here, float(np.exp(middle)), middle
        else:
            low = middle
    return best, weight


def not_matched(area: float, reached: float) -> tuple[str, str] | None:
    """Say that a map has another area distortion than it was to match, and what would help; None where it has it.

    Args:
        area: the mean of r + 1/r that was asked for.
        reached: that of the map.
    """
    # How far below the one asked for that of a map may be: refinement ends within it.
    missed = 2e-3
    if -missed <= reached - area <= 0.0:
        return None
    text = f"no map with the area distortion {area:.9g} was found: this one has {reached:.9g}"
    return text, "remesh with more triangles, or ask for more" if reached > area else "ask for less"
