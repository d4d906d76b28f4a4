"""Optimal maps to a density on the sphere.

A map that reaches the density ρ puts a triangle of mass m on the area m / ρ, which depends on where it lies. With the
areas wanted at the present image the map is a minimum of the same energy, whose cost counts by area in the image, so
that its displacement is the gradient of a potential there: the condition of the optimal map to any density. Rounds of a
few steps, each with the areas of where the last one ended, come to rest at that map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from omtwarp.measures import TargetDensity
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.optimal.nested import shape_term
from omtwarp.optimal.solver import OptimalMap
from omtwarp.options import Record

# Rounds at most, and steps of each: with more steps a round lasts longer, and the next begins as far away.
ROUNDS, STEPS = 10, 3
# Share of the areas wanted at the present image in those of a round, as logarithms; the rest is that of the round
# before. With all of it, areas go back and forth at the edges of a picture.
SHARE = 0.5
# Root mean square change of the areas wanted, relative, at which rounds end: a smooth density halves it in every round,
# and at the edges of a picture, which triangles cross, a tenth stays.
SETTLED = 0.01


def map_to_density(
    surface: Surface,
    sphere: Floats,
    target: TargetDensity,
    solve: Callable[..., OptimalMap],
    *,
    start: Floats,
    shape_share: float = 1.0,
    device: str | None = "auto",
) -> OptimalMap:
    """Find the optimal map to a density, from a map near it.

    Args:
        surface: its areas are the mass, V vertices.
        sphere: the map to begin with, without flips, shape [V, 3].
        target: the density.
        solve: :func:`omtwarp.optimal_map` from the points x; called with the surface with areas
            in proportion to those wanted, the map, and options.
        start: the points x that are moved, shape [V, 3].
        shape_share: factor of the shape term's weight.
        device: where the shape term is measured.

    Returns:
        The map whose areas are nearest to those wanted where it lies, of all rounds, with the history of all of them.
    """
    wanted = _wanted(surface, sphere, target)
    multipliers = None
    tried: list[tuple[float, OptimalMap]] = []  # how far the areas of a map are from those wanted where it lies
    history: list[Record] = []
    for _ in range(ROUNDS):
        goal = surface.with_areas(wanted)
        term = shape_term(goal, sphere, start, device)
        weights = {"shape_weight": shape_share * term.weight, "area_weight": term.area}
        optimal = solve(goal, sphere, multipliers=multipliers, iterations=STEPS, **weights)
        sphere, multipliers = optimal.sphere, optimal.multipliers
        history += optimal.history[bool(history) :]
        there = _wanted(surface, sphere, target)
        tried.append((_change(there, _shares(triangle_areas(sphere, surface.faces))), optimal))
        moved = _change(there, wanted)
        if moved <= SETTLED:
            break
        wanted = _shares(np.exp(SHARE * np.log(there) + (1.0 - SHARE) * np.log(wanted)))
    best = min(tried, key=lambda one: one[0])[1]
    settled = moved <= SETTLED
    ended = best.ended if settled else f"areas wanted still change by {100.0 * moved:.2g} %"
    return replace(best, history=tuple(history), converged=best.converged and settled, ended=ended)


def _shares(areas: Floats) -> Floats:
    return areas / areas.sum()


def _wanted(surface: Surface, sphere: Floats, target: TargetDensity) -> Floats:
    """Return the shares of the sphere that triangles are to have where a map puts them, shape [F]."""
    return _shares(target.goal(surface, sphere).face_areas)


def _change(areas: Floats, before: Floats) -> float:
    """Return the root mean square of the relative differences, weighted by area."""
    return float(np.sqrt(before @ (areas / before - 1.0) ** 2))
