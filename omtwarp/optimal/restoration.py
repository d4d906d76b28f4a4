"""Correction of the area errors that a minimisation leaves, by Newton's method on the areas themselves.

Every step is the smallest, in the metric of the second derivative of cost and shape, that corrects the areas to first
order, so that the map stays optimal up to the square of the correction. Where parts of a mesh are slivers, the
multipliers of neighbouring cells differ strongly, and a minimisation that leaves the curvature of the areas out of its
matrix ends there with relative errors of some 1e-3. Newton's method on the areas alone reaches round-off in a few
steps.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.solvers.mesh_factor import SaddlePointFactor
from omtwarp.untangling.steps import FlipFreeSteps

Numbers = NDArray[np.float64]

ROUNDS = 30  # largest number of steps
STIFFNESS = 1e7  # weight of areas relative to cost and shape, which only choose among the steps that correct areas
MAX_HALVINGS = 12  # of a step, down to 1/4096
SUFFICIENT = 0.1  # a step is taken where it lowers the area errors by this share of what the first derivative predicts


@blas_threads(1)
def restore_areas(
    energy: TransportEnergy,
    given: Numbers,
    *,
    rounds: int = ROUNDS,
    notify: Callable[[int, MapTerms], None] | None = None,
) -> tuple[Numbers, bool]:
    """Move a map without flips to the nearest one with exact areas.

    Args:
        energy: gives the wanted areas, their tolerance, and the metric in which steps are smallest.
        given: the map, no triangle flipped, shape [V, 3], or [V, 2] in the plane.
        rounds: largest number of steps.
        notify: called after each step with its number and the terms of the map.

    Returns:
        The map after the last step that reduced the area errors, without flips, and whether all areas are within the
        tolerance.
    """
    points = energy.domain.sent(given)
    terms = energy.terms(points)
    steps = energy.flip_free_steps()
    factor = energy.saddle_factor()
    numbers = energy.wanted * energy.wanted.sum() / STIFFNESS
    compliance = wp.array(numbers, dtype=wp.float64, device=energy.device)
    for number in range(rounds):
        if _right(energy, terms):
            return points.numpy().copy(), True
        try:
            energy.factorise(factor, points, terms, compliance)
        except OmtwarpError:
            break
        moved = _step(energy, steps, factor, points, terms)
        if moved is None:
            break
        points, terms = moved
        if notify is not None:
            notify(number + 1, terms)
    return points.numpy().copy(), _right(energy, terms)


def _step(
    energy: TransportEnergy, steps: FlipFreeSteps, factor: SaddlePointFactor, points: wp.array, terms: MapTerms
) -> tuple[wp.array, MapTerms] | None:
    """Return the map and its terms after the longest share of a Newton step that reduces area errors, or None."""
    _, solution = energy.newton_step(factor, points, None, terms.missing)
    direction = energy.direction(points, solution)
    before, length = np.sqrt(terms.squares), 1.0
    for _ in range(MAX_HALVINGS):
        held = steps.held_back(points, direction, terms.shape.d_volume, length)
        if held is not None:
            after = energy.terms(held[0])
            if np.sqrt(after.squares) <= (1.0 - SUFFICIENT * length) * before:
                return held[0], after
        length *= 0.5
    return None


def _right(energy: TransportEnergy, terms: MapTerms) -> bool:
    """Return whether all areas are within the tolerance."""
    rms, largest = energy.area_errors(terms)
    return rms <= energy.exact_tolerance and largest <= energy.exact_tolerance
