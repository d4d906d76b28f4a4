"""The optimal map to a flat torus: least squared distance among the maps that keep the areas around vertices.

Newton's method on the saddle point of the Lagrangian, each step one of the augmented Lagrangian method, as
:mod:`omtwarp.optimal.solver` does it on the sphere: the same matrices on the same edges, in the plane. Steps are held
back, vertex by vertex, where a triangle would turn over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import TINY
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.refinement import MATCH_TOLERANCE, MATCH_TRIALS, TRIANGLE_WEIGHT, refinement_weight
from omtwarp.optimal.solver import (
    DAMPING_DECAY,
    DAMPING_GROWTH,
    GAIN,
    LEAST_DAMPING,
    MIN_COST,
    MIN_GAIN_SHARE,
    MOST_DAMPING,
    PENALTY,
    REGULARISATION,
    RENEWED,
    SHAPE_WEIGHT,
    STIFFER,
)
from omtwarp.options import AreaMatch, Record, parse_refinement
from omtwarp.refine.matching import MOST_WEIGHT, match_area
from omtwarp.solvers.cholesky import NotPositiveDefinite
from omtwarp.solvers.mesh_factor import SaddlePointFactor
from omtwarp.solvers.triangle_newton.line_search import SUFFICIENT_DECREASE
from omtwarp.solvers.triangle_newton.motion_kernels import hold_back
from omtwarp.torus.cells import TorusCellEnergy
from omtwarp.torus.energy import PlaneTerms, TorusEnergy
from omtwarp.torus.harmonic import FlatTorus

Floats = NDArray[np.float64]
Report: TypeAlias = Callable[[int, int, Record], None]
"""How a minimisation reports on itself: ``report(done, most, record)``."""

ITERATIONS = 100  # largest number of steps; a map that needs more reports that it has not converged
# β is this times the root mean squared distance of the start where that is less than the sphere's: see
# omtwarp.mapping.pipeline. The least one is for surfaces whose conformal map already keeps areas.
SHAPE_BY_DISTANCE, LEAST_SHAPE_WEIGHT = 0.036, 1e-6
REACH = 0.5  # the farthest that a vertex goes in one step; the torus has the area 4π
HALVINGS = 20  # of a step with a fresh matrix, down to a millionth
HALVINGS_OLD = 1  # of a step with an older matrix
HOLDS = 30  # halvings of the shares of single vertices
# With half and twice the first, and 0.0005 and 0.01 for the second, a mug's map has the same bits.
LEAST_AREA = 0.1  # of a triangle's area, that a step has to leave
MOST_HELD = 0.002  # of the vertices: with so few held back the matrix still serves
RESTORATIONS, EXACT_RESTORATIONS = 10, 30  # most steps that make areas right after a minimum was found
STIFFNESS = 1e7  # of the areas relative to cost and shape, which only choose among the steps
# With half and twice as much a mug's area distortion of 2.0744 changes by 0.0002, angle by 0.003.
REFINED = 1e-4  # least expected gain of a step of a refinement
REFINEMENTS = 100  # most steps of a refinement
NO_PENALTY = 1e-9  # in place of zero, so that the matrix keeps its form
# Weights of areas relative to angles, one after the other, where areas are wrong by more than UNEVEN, rms.
EASING_WEIGHTS, UNEVEN = (1.0, 100.0), 0.05
EXACT = 1e-6  # largest relative error of the areas, with which they count as right

AREA_DECREASE = 0.1  # share of the areas' errors that a full step towards right areas has to take away


@dataclass(frozen=True)
class TorusTransport:
    """A minimum on the torus and how it was found.

    Attributes:
        points: the map in the plane, shape [V, 2].
        multipliers: of the areas, as of :class:`omtwarp.optimal.OptimalMap`.
        history: one record per step, the first of the start: ``cost`` (Σ m |y - x|², masses 4π in all), ``energy``,
            ``ring_rms`` and ``ring_largest`` (relative errors of the areas), ``area`` and ``angle`` (distortions of
            triangles), ``decrement`` (what the step was expected to gain), ``length``, ``factorised``, ``corrected``
            (vertices held back).
        converged: whether gain and areas reached their tolerances.
        ended: how it ended, in words.
        shape_weight: weight of the triangles' distortion.
    """

    points: Floats
    multipliers: Floats
    history: list[Record]
    converged: bool
    ended: str
    shape_weight: float


def transport_on_torus(
    surface: Surface,
    torus: FlatTorus,
    start: FlatTorus | None = None,
    *,
    shape_weight: float | None = None,
    iterations: int = ITERATIONS,
    progress: Report | None = None,
) -> TorusTransport:
    """Find the optimal map of a surface to a flat torus.

    Args:
        surface: of genus 1; its vertex areas, total 4π, are the masses.
        torus: the conformal map, from which distances are measured; triangles may be turned over there.
        start: a map without flips to begin with; the conformal map by default.
        shape_weight: weight of the triangles' distortion relative to the mean squared distance; by default as on the
            sphere, less for maps that move little.
        iterations: most steps.
        progress: called as ``progress(done, most, record)``.

    Raises:
        OmtwarpError: a triangle of the start is turned over.
    """
    x = torus.coordinates @ torus.lattice
    y = x if start is None else start.coordinates @ start.lattice
    masses = surface.vertex_areas / SPHERE_AREA
    y = y - masses @ (y - x)
    if shape_weight is None:
        shape_weight = min(SHAPE_WEIGHT, SHAPE_BY_DISTANCE * float(np.sqrt(masses @ ((y - x) ** 2).sum(axis=1))))
    energy = TorusEnergy(surface, torus, x, max(shape_weight, LEAST_SHAPE_WEIGHT))
    found = minimise(energy, y, gain=GAIN, iterations=iterations, progress=progress)
    return _with_right_areas(energy, found, RESTORATIONS)


def eased_on_torus(surface: Surface, torus: FlatTorus, start: FlatTorus) -> Floats:
    """Move an embedding whose areas are wrong to one of well-shaped triangles, where the optimal map is near.

    Limbs that the conformal map shrinks to nothing have long thin triangles of wrong areas in the embedding. From
    these, steps of the transport are short and depend on the last bit. Angles and areas alone have a minimum that is
    found from anywhere near: with little weight on areas first, then with much.

    Args:
        surface: of genus 1.
        torus: its conformal map.
        start: a map without flips.

    Returns:
        Points in the plane, shape [V, 2]; those of the start where its areas are nearly right.
    """
    points = start.coordinates @ start.lattice
    energy = TorusEnergy(surface, torus, torus.coordinates @ torus.lattice, 1.0)
    if energy.area_errors(energy.terms(points))[0] > UNEVEN:
        for weight in EASING_WEIGHTS:
            points = refine_on_torus(surface, torus, points, weight)[0].points
    return points


def exact_on_torus(energy: TorusCellEnergy, points: Floats, *, progress: Report | None = None) -> TorusTransport:
    """Find the optimal map of a quartered surface, in which every triangle of the mesh keeps its area.

    Args:
        energy: of the quartered surface.
        points: a map without flips to begin with, shape [V, 2].
        progress: called as ``progress(done, most, record)``.
    """
    found = minimise(energy, points, gain=GAIN, progress=progress)
    found = _with_right_areas(energy, found, EXACT_RESTORATIONS)
    if found.history[-1]["ring_largest"] <= EXACT:
        return found
    return replace(found, converged=False, ended=f"{found.ended}; areas are not right to {EXACT:g}")


def refine_on_torus(
    surface: Surface,
    torus: FlatTorus,
    points: Floats,
    weight: AreaMatch | str | float,
    *,
    progress: Report | None = None,
) -> tuple[TorusTransport, float]:
    """Move a map to a minimum of angle plus λ times area distortion: see :mod:`omtwarp.optimal.refinement`.

    Args:
        surface: of genus 1.
        torus: the conformal map, whose distances are shown.
        points: a map without flips, shape [V, 2].
        weight: λ, a name of one, or an area distortion to match.
        progress: called as ``progress(done, most, record)``.

    Returns:
        The minimum, and λ.
    """

    def run(at: Floats, value: float) -> TorusTransport:
        start = torus.coordinates @ torus.lattice
        energy = TorusEnergy(surface, torus, start, 1.0, cost_weight=0.0, area_weight=min(value, TRIANGLE_WEIGHT))
        penalty = 2.0 * max(value - TRIANGLE_WEIGHT, NO_PENALTY)
        return minimise(energy, at, gain=REFINED, iterations=REFINEMENTS, penalty=penalty, progress=progress)

    parsed = parse_refinement(weight)
    if not isinstance(parsed, AreaMatch):
        value = refinement_weight(weight)
        return run(points, value), value
    return match_area(
        run(points, MOST_WEIGHT),
        parsed.area,
        lambda found, value: run(found.points, value),
        lambda found: found.history[-1]["area"],
        tolerance=MATCH_TOLERANCE,
        trials=MATCH_TRIALS,
    )


def _with_right_areas(energy: TorusEnergy, found: TorusTransport, rounds: int) -> TorusTransport:
    """Restore the areas of a minimum exactly, as one more record of its history."""
    points, terms = restore_areas(energy, found.points, rounds)
    rms, largest = energy.area_errors(terms)
    last = found.history[-1] | {"cost": energy.cost(terms), "ring_rms": rms, "ring_largest": largest}
    last |= {"area": terms.area, "angle": terms.angle}
    return replace(found, points=points, history=[*found.history, last])


@blas_threads(1)
def minimise(
    energy: TorusEnergy,
    points: Floats,
    *,
    multipliers: Floats | None = None,
    gain: float,
    iterations: int = ITERATIONS,
    penalty: float | None = None,
    progress: Report | None = None,
) -> TorusTransport:
    """Minimise an energy under its constraints.

    Args:
        energy: what is minimised.
        points: a map without flips to begin with, shape [V, 2].
        multipliers: of a map nearby, to begin with.
        gain: end where a step is expected to gain less than this share of the cost; with a penalty, less than this.
        iterations: most steps.
        penalty: μ, with which Σ (a_v - 3m_v)² / 3m_v, over 24π, is added to the energy in place of the constraints.
        progress: called as ``progress(done, most, record)``.

    Raises:
        OmtwarpError: a triangle of the map is turned over.
    """
    flipped = int((~(energy.terms(points).triangles > 0.0)).sum())
    if flipped:
        raise OmtwarpError(f"the map to the torus has {flipped} flipped triangles before transport")
    return _Newton(energy, gain, penalty, multipliers).run(points, iterations, progress)


class _Newton:
    """One minimisation: the map, its multipliers, and the matrix of some earlier map."""

    def __init__(self, energy: TorusEnergy, gain: float, penalty: float | None, multipliers: Floats | None):
        self.energy, self.gain, self.constrained = energy, gain, penalty is None
        self.factor = energy.saddle_factor()
        self.stiffness = (PENALTY if penalty is None else penalty) / energy.wanted.sum() / energy.wanted
        self.known = multipliers is not None
        self.multipliers = np.zeros(len(energy.wanted)) if multipliers is None else multipliers
        self.damping = LEAST_DAMPING

    def run(self, points: Floats, iterations: int, progress: Report | None) -> TorusTransport:
        """Take steps until the map reaches the tolerances.

        One function, as every decision on how to go on rests on the same matrix, step and map.
        """
        energy = self.energy
        terms = energy.terms(points)
        if self.constrained and not self.known:
            self.multipliers = -energy.potential(terms, self.multipliers)
        history = [self._record(terms)]
        ended, converged, renew, last = "most steps taken", False, True, np.inf
        for number in range(iterations):
            fresh = renew
            if renew:
                _factorise(self.energy, self.factor, points, terms, self.damping, 1.0 / self.stiffness)
                if number == 0:
                    self._choose_multipliers(points, terms)
            missing = energy.missing(terms)
            gradient = energy.gradient(points, terms, self.multipliers)
            step, q = self._solve(-gradient, -missing)
            # The slope of the penalty along the step is that of B u = C q - missing.
            slope = float((gradient * step).sum()) + float(missing @ q) - float(self.stiffness @ missing**2)
            decrement = -slope
            if self._reached(terms, decrement):
                ended, converged = "optimal", True
                break
            moved = None
            if decrement > 0.0 and (fresh or decrement <= (1.0 - MIN_GAIN_SHARE) * last):
                moved = self._search(points, terms, step, decrement, HALVINGS if fresh else HALVINGS_OLD)
            if moved is None:
                if fresh:
                    ended = "no step lowers the cost"
                    break
                renew = True
                continue
            points, terms, length, held, gained = moved
            if self.constrained:
                self.multipliers = self.multipliers + length * q
            last = decrement
            history.append(self._record(terms, decrement, length, fresh, held))
            if progress is not None:
                progress(number + 1, iterations, history[-1])
            if fresh:
                self._adapt_damping(length)
            renew = bool(length < 1.0 or held > MOST_HELD * len(points) or gained < RENEWED * length * decrement)
        return TorusTransport(points, self.multipliers, history, converged, ended, self.energy.shape_weight)

    def _choose_multipliers(self, points: Floats, terms: PlaneTerms) -> None:
        """Take the multipliers with which the energy is least steep, where none are known and areas are constrained."""
        if self.constrained and not self.known:
            gradient = self.energy.gradient(points, terms, self.multipliers)
            self.multipliers = self.multipliers + self._solve(-gradient, np.zeros_like(self.multipliers))[1]

    def _adapt_damping(self, length: float) -> None:
        """Lower the damping after a full step, and raise it after one of less than half."""
        change = DAMPING_DECAY if length == 1.0 else DAMPING_GROWTH if length < 0.5 else 1.0
        self.damping = min(max(change * self.damping, LEAST_DAMPING), MOST_DAMPING)

    def _reached(self, terms: PlaneTerms, decrement: float) -> bool:
        if not self.constrained:
            return 0.5 * decrement <= self.gain
        rms, largest = self.energy.area_errors(terms)
        gain = self.gain * max(self.energy.cost(terms) / SPHERE_AREA, MIN_COST)
        return decrement <= gain and rms <= self.energy.area_tolerances[0] and largest <= self.energy.area_tolerances[1]

    def _merit(self, terms: PlaneTerms) -> float:
        if not (terms.triangles > 0.0).all():
            return float(np.inf)
        missing = self.energy.missing(terms)
        return self.energy.lagrangian(terms, self.multipliers) + 0.5 * float(self.stiffness @ missing**2)

    def _solve(self, first: Floats, second: Floats) -> tuple[Floats, Floats]:
        return self.factor.solve(first, second)

    def _search(
        self, points: Floats, terms: PlaneTerms, step: Floats, decrement: float, halvings: int
    ) -> tuple[Floats, PlaneTerms, float, int, float] | None:
        """Search for a step that lowers the merit and flips nothing.

        Returns:
            The map, its terms, the step's length, how many vertices were held back, and what the step gained; None
            where no step was found.
        """
        before = self._merit(terms)
        length = min(1.0, REACH / max(float(np.linalg.norm(step, axis=1).max()), TINY))
        for _ in range(halvings + 1):
            found = _held_back(self.energy, points, terms, length * step)
            if found is not None:
                moved, after, held = found
                value = self._merit(after)
                if value <= before - SUFFICIENT_DECREASE * length * decrement:
                    return moved, after, length, held, before - value
            length *= 0.5
        return None

    def _record(
        self, terms: PlaneTerms, decrement: float = 0.0, length: float = 0.0, factorised: bool = False, held: int = 0
    ) -> Record:
        rms, largest = self.energy.area_errors(terms)
        missing = self.energy.missing(terms)
        cost = self.energy.cost_weight * self.energy.cost(terms) / SPHERE_AREA
        return {
            "cost": self.energy.cost(terms),
            "energy": cost + self.energy.shape(terms) + 0.5 * float(self.stiffness @ missing**2),
            "ring_rms": rms,
            "ring_largest": largest,
            "area": terms.area,
            "angle": terms.angle,
            "decrement": decrement,
            "length": length,
            "factorised": factorised,
            "corrected": held,
        }


def restore_areas(energy: TorusEnergy, points: Floats, rounds: int = RESTORATIONS) -> tuple[Floats, PlaneTerms]:
    """Move a map without flips to the nearest one whose areas are right: see :mod:`omtwarp.optimal.restoration`.

    Args:
        energy: says which areas are wanted, and what near means.
        points: the map, shape [V, 2].
        rounds: most steps.

    Returns:
        The map of the last step that made areas better, and its terms.
    """
    factor, terms = energy.saddle_factor(), energy.terms(points)
    compliance = energy.wanted * energy.wanted.sum() / STIFFNESS
    for _ in range(rounds):
        if max(energy.area_errors(terms)) <= EXACT:
            break
        _factorise(energy, factor, points, terms, LEAST_DAMPING, compliance)
        step, _ = factor.solve(np.zeros_like(points), -energy.missing(terms))
        before, length = _error(energy, terms), 1.0
        for _ in range(HALVINGS):
            found = _held_back(energy, points, terms, length * step)
            if found is not None and _error(energy, found[1]) <= (1.0 - AREA_DECREASE * length) * before:
                points, terms = found[0], found[1]
                break
            length *= 0.5
        else:
            break
    return points, terms


def _error(energy: TorusEnergy, terms: PlaneTerms) -> float:
    return float(np.sqrt((energy.missing(terms) ** 2 / energy.wanted).sum()))


def _factorise(
    energy: TorusEnergy,
    factor: SaddlePointFactor,
    points: Floats,
    terms: PlaneTerms,
    damping: float,
    compliance: Floats,
) -> None:
    diagonal, off_diagonal, gradients = energy.blocks(points, terms, damping)
    own = diagonal[:, [0, 1], [0, 1]]
    for part in STIFFER:
        diagonal[:, [0, 1], [0, 1]] = own * (1.0 + part) + REGULARISATION * own.mean()
        try:
            factor.factorise(diagonal, off_diagonal, gradients, compliance)
            return
        except NotPositiveDefinite:
            continue
    raise OmtwarpError("the second derivative of the transport cost on the torus is not finite")


def _held_back(
    energy: TorusEnergy, points: Floats, terms: PlaneTerms, step: Floats
) -> tuple[Floats, PlaneTerms, int] | None:
    """Move points by the largest shares of a step, halved corner by corner, that keep every triangle.

    Returns:
        The map, its terms, and how many vertices were held back; None where no shares were found.
    """
    count = len(points)
    share = np.ones(count)
    for _ in range(HOLDS):
        moved = points + share[:, None] * step
        after = energy.terms(moved)
        trouble = ~(after.triangles > LEAST_AREA * terms.triangles)
        if not trouble.any():
            return moved, after, int((share < 1.0).sum())
        marks = wp.array(trouble.astype(np.int32), dtype=wp.int32, device="cpu")
        held = wp.empty(count, dtype=wp.float64, device="cpu")
        shares = wp.array(share, dtype=wp.float64, device="cpu")
        wp.launch(hold_back, dim=count, inputs=[*energy.rows, marks, shares], outputs=[held], device="cpu")
        share = held.numpy()
    return None


__all__ = [
    "TorusTransport",
    "eased_on_torus",
    "exact_on_torus",
    "minimise",
    "refine_on_torus",
    "restore_areas",
    "transport_on_torus",
]
