"""Exact areas: the correction of those that a minimisation leaves, and the optimal map that keeps every triangle's.

The correction is Newton's method on the areas themselves. Every step is the smallest, in the metric of the second
derivative of cost and shape, that corrects the areas to first order, so that the map stays optimal up to the square of
the correction. Where parts of a mesh are slivers, the multipliers of neighbouring cells differ strongly, and a
minimisation that leaves the curvature of the areas out of its matrix ends there with relative errors of some 1e-3.
Newton's method on the areas alone reaches round-off in a few steps.

The optimal map of a quartered mesh keeps the area of every triangle of the original mesh: these are its cells
(:class:`omtwarp.optimal.cells.TriangleCells`). After the minimum was found their remaining errors are corrected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import sent
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats, real_number
from omtwarp.mesh.quarter import QuarteredSurface
from omtwarp.mesh.surface import Surface, as_unit_vectors
from omtwarp.optimal.cells import TriangleCells
from omtwarp.optimal.energy import SHAPE_WEIGHT, MapTerms, TransportEnergy
from omtwarp.optimal.nested import turned_onto
from omtwarp.optimal.refinement import least_distortion
from omtwarp.optimal.solver import GAIN, OptimalMap, minimise, softness
from omtwarp.optimal.sphere import Sphere, energy_on_sphere
from omtwarp.optimal.steps import FlipFreeSteps
from omtwarp.options import Cost, CostLike, Progress, tell

ROUNDS = 30  # largest number of steps
STIFFNESS = 1e7  # weight of areas relative to cost and shape, which only choose among the steps that correct areas
MAX_HALVINGS = 12  # of a step, down to 1/4096
SUFFICIENT = 0.1  # a step is taken where it lowers the area errors by this share of what the first derivative predicts


@blas_threads(1)
def restore_areas(
    energy: TransportEnergy,
    given: Floats,
    *,
    rounds: int = ROUNDS,
    notify: Callable[[int, MapTerms], None] | None = None,
) -> tuple[Floats, bool]:
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
    steps = FlipFreeSteps(energy)
    compliance = sent(energy.wanted * energy.wanted.sum() / STIFFNESS, wp.float64, energy.device)
    for number in range(rounds):
        if _right(energy, terms):
            return points.numpy().copy(), True
        try:
            energy.factorise(points, terms, compliance)
        except OmtwarpError:
            break
        moved = _step(energy, steps, points, terms)
        if moved is None:
            break
        points, terms = moved
        if notify is not None:
            notify(number + 1, terms)
    return points.numpy().copy(), _right(energy, terms)


def _step(
    energy: TransportEnergy, steps: FlipFreeSteps, points: wp.array, terms: MapTerms
) -> tuple[wp.array, MapTerms] | None:
    """Return the map and its terms after the longest share of a Newton step that reduces area errors, or None."""
    _, solution = energy.newton_step(None, terms.missing)
    direction = energy.direction(solution)
    before, length = np.sqrt(terms.squares), 1.0
    for _ in range(MAX_HALVINGS):
        reached = steps.tried(points, direction, terms.shape.d_volume, length, None)[1]()
        if reached is not None and np.sqrt(reached[1].squares) <= (1.0 - SUFFICIENT * length) * before:
            return reached[:2]
        length *= 0.5
    return None


def _right(energy: TransportEnergy, terms: MapTerms) -> bool:
    """Return whether all areas are within the tolerance."""
    return max(energy.area_rms(terms), terms.largest) <= energy.exact_tolerance


# Weights of areas against angle, of triangles and around vertices, and tolerance and most steps, of smoothing.
SMOOTHING_WEIGHT, SMOOTHING_RINGS, SMOOTHING_TOLERANCE, SMOOTHING_STEPS = 30.0, 100.0, 0.02, 10


def smoothed(surface: Surface, sphere: Floats, *, device: str | None = "auto") -> Floats:
    """Return a map without its slivers, turned onto the one given; as found where turning flips.

    Triangles whose areas are far off stop the minimisation of exact maps: without smoothing the areas of 4 of 30 made
    surfaces are not reached, with it all are, and long limbs take 34 steps for 193, 25 for 160, 10 for 200. The areas
    around vertices count in it, as most are right already: of 8 surfaces with long limbs 2, 0, 0 and 1 fail with a
    weight of 0, 100, 300 and 1000, and the second takes the fewest steps.

    Args:
        surface: V vertices.
        sphere: the map, no triangle flipped, shape [V, 3].
        device: where the kernels run.
    """
    least = partial(least_distortion, iterations=SMOOTHING_STEPS, tolerance=SMOOTHING_TOLERANCE, device=device)
    smooth = least(surface, sphere, SMOOTHING_WEIGHT, of_rings=SMOOTHING_RINGS).sphere
    return turned_onto(surface, smooth, sphere, device)


ITERATIONS = 200  # largest number of steps; a map that needs more reports that it has not converged
EXACT = 1e-6  # largest relative error after the remaining errors were corrected


def exact_map(
    quartered: QuarteredSurface,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    shape_weight: float = SHAPE_WEIGHT,
    cost: CostLike = Cost.SQUARED,
    domain: Sphere | None = None,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> OptimalMap:
    """Minimise the transport cost over the maps of a quartered mesh that keep the area of every original triangle.

    Args:
        quartered: the F triangles of a mesh in four parts each, V vertices in all.
        sphere: a map without flips to begin with, unit vectors, shape [V, 3].
        start: the points x that are transported, unit vectors, shape [V, 3].
        shape_weight: weight of angle and area distortion of the parts relative to the mean squared distance.
        cost, domain: as of :func:`omtwarp.optimal_map`.
        device: where the kernels run.
        progress: called after every step as ``progress("omt", step, most, record)``.

    Returns:
        The map, whose energy is at most that of the one given; its multipliers belong to the triangles, shape [F].

    Raises:
        OmtwarpError: the map given has flipped triangles.
    """
    where, shape_weight = resolve_device(device), real_number(shape_weight, "shape_weight", least=0.0)
    given, x = (as_unit_vectors(points, quartered.surface.vertex_count) for points in (sphere, start))
    soft = softness(quartered.surface.vertex_areas, given, x, cost)
    cells = TriangleCells(quartered, where)
    energy = energy_on_sphere(quartered.surface, x, where, shape_weight, domain=domain, cells=cells, softness=soft)
    return minimise_cells(energy, given, progress)


def minimise_cells(energy: TransportEnergy, points: Floats, progress: Progress | None) -> OptimalMap:
    """Minimise an energy of cells, then correct their areas to 1e-6; arguments and result as of :func:`exact_map`."""
    optimal = minimise(energy, points, gain=GAIN, iterations=ITERATIONS, progress=progress)
    history = list(optimal.history)

    def notify(number: int, terms: MapTerms) -> None:
        errors = {"ring_rms": energy.area_rms(terms), "ring_largest": terms.largest}
        history.append({**history[-1], "cost": energy.cost(terms), **errors})
        tell(progress, "omt", min(len(history) - 1, ITERATIONS), ITERATIONS, history[-1])

    restored, right = restore_areas(energy, optimal.points, notify=notify)
    ended = optimal.ended if right else f"{optimal.ended}; areas are not right to {EXACT:g}"
    return replace(optimal, points=restored, history=tuple(history), converged=optimal.converged and right, ended=ended)


def largest_error(exact: OptimalMap) -> float:
    """Return the largest relative error of a cell's area in an exact map.

    Raises:
        OmtwarpError: it is above 1e-6.
    """
    largest = float(exact.history[-1]["ring_largest"])
    if largest > EXACT:
        raise OmtwarpError(
            f"exact areas were not reached: a triangle's area is off by {largest:.2g} of it; remesh with more "
            "triangles, evenly shaped, or leave exact out"
        )
    return largest
