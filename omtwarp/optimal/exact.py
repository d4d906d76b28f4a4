"""The optimal map of a quartered mesh that keeps the area of every triangle of the original mesh.

The cells whose areas are kept are the triangles of the mesh (:class:`omtwarp.optimal.cells.TriangleCells`). After the
minimum was found their remaining errors are corrected.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.mesh.checks import as_unit_vectors
from omtwarp.mesh.quarter import QuarteredSurface
from omtwarp.optimal.cells import TriangleCells
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.optimal.restoration import restore_areas
from omtwarp.optimal.solver import (
    GROWING_PENALTIES,
    PENALTY,
    SHAPE_WEIGHT,
    STEPS_OF_ROUND,
    OptimalMap,
    minimise,
    softness,
)
from omtwarp.optimal.sphere import energy_on_sphere
from omtwarp.options import Cost, Progress, Record

Numbers = NDArray[np.float64]

ITERATIONS = 200  # largest number of steps; a map that needs more reports that it has not converged
# Where the root mean square error of the areas is larger to begin with, penalties on them grow: the first steps would
# ask slivers for several times their area, and those after them are shortened to a sixteenth.
MAX_START_RMS = 0.06
CELL_GAIN = (
    1e-4  # share of the cost that the last step would gain: the valleys of cost and shape are longer than at rings
)
EXACT = 1e-6  # largest relative error after the remaining errors were corrected


def exact_map(
    quartered: QuarteredSurface,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    shape_weight: float = SHAPE_WEIGHT,
    multipliers: ArrayLike | None = None,
    iterations: int = ITERATIONS,
    gain: float = CELL_GAIN,
    cost: str = Cost.SQUARED,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> OptimalMap:
    """Minimise the transport cost over the maps of a quartered mesh that keep the area of every original triangle.

    Args:
        quartered: the F triangles of a mesh in four parts each, V vertices in all.
        sphere: a map without flips to begin with, unit vectors, shape [V, 3].
        start: the points x that are transported, unit vectors, shape [V, 3].
        shape_weight: weight of angle and area distortion of the parts relative to the mean squared distance.
        multipliers: initial multipliers, shape [F], such as those of a map with another shape weight.
        iterations: largest number of steps with each weight of area errors.
        gain: end where the expected gain of a step falls below this share of the cost, and areas are kept to 1e-6.
        cost: as of :func:`omtwarp.optimal_map`.
        device: where the kernels run.
        progress: called after every step as ``progress("omt", step, most, record)``.

    Returns:
        The map, whose energy is at most that of the one given; its multipliers belong to the triangles, shape [F].

    Raises:
        OmtwarpError: the map given has flipped triangles.
    """
    where = resolve_device(device)
    given, x = (as_unit_vectors(points, quartered.surface.vertex_count) for points in (sphere, start))
    soft = softness(quartered.surface.vertex_areas, given, x, cost)
    cells = TriangleCells(quartered, where)
    energy = energy_on_sphere(quartered.surface, vectors(x, where), where, shape_weight, cells=cells, softness=soft)
    return minimise_cells(energy, given, multipliers=multipliers, gain=gain, iterations=iterations, progress=progress)


def minimise_cells(
    energy: TransportEnergy,
    points: Numbers,
    *,
    multipliers: ArrayLike | None = None,
    gain: float,
    iterations: int,
    progress: Progress | None,
) -> OptimalMap:
    """Minimise an energy of cells, then correct their areas to 1e-6; arguments and result as of :func:`exact_map`."""
    history: list[Record] = []
    rms, _ = energy.area_errors(energy.terms(energy.domain.sent(points)))
    far = multipliers is None and rms > MAX_START_RMS
    for penalty in GROWING_PENALTIES if far else GROWING_PENALTIES[-1:]:
        steps = iterations if penalty == PENALTY else STEPS_OF_ROUND
        found = minimise(
            energy,
            points,
            area_penalty=penalty,
            multipliers=multipliers,
            gain=gain,
            iterations=min(steps, iterations),
            progress=progress,
        )
        points, multipliers = found.points, found.multipliers
        history += found.history

    def notify(number: int, terms: MapTerms) -> None:
        rms, largest = energy.area_errors(terms)
        history.append({**history[-1], "cost": energy.cost(terms), "ring_rms": rms, "ring_largest": largest})
        if progress is not None:
            progress("omt", min(len(history) - 1, iterations), iterations, history[-1])

    restored, right = restore_areas(energy, found.points, notify=notify)
    ended = found.ended if right else f"{found.ended}; areas are not right to {EXACT:g}"
    return replace(found, points=restored, history=tuple(history), converged=found.converged and right, ended=ended)
