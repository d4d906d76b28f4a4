"""The discrete optimal map by Newton's method, with the areas around vertices as constraints.

Every step solves the saddle-point system of :mod:`omtwarp.optimal.energy`,

    [H, Bᵀ; B, -C] [u; q] = -[∂L/∂y; a - 3m],      B = ∂a/∂y,  C = diag(12π · 3m_v / μ),

whose last block makes it a step of the augmented Lagrangian method with penalty μ (Nocedal and Wright, "Numerical
Optimization", chapter 17): q is added to the multipliers, and u lowers L + μ / 24π Σ (a_v - 3m_v)² / 3m_v. A
factorisation is used again as long as the steps made with it gain enough. After each step the few vertices that have
the most to gain take steps of their own (:mod:`omtwarp.optimal.local`).

A full step leaves errors of the areas of second order in u, which the penalty may count for more than the step gains,
so that steps would be shortened however near the optimum is (Maratos 1978). Before a step is shortened it is therefore
corrected: a second solve with the same matrix gives the smallest step that removes these errors to first order (Nocedal
and Wright, section 15.6). What is still in the way then are a few vertices, which take steps of their own.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError, choose
from omtwarp.mesh.arrays import TINY, real_number, real_numbers, whole_number
from omtwarp.mesh.checks import MeshLike, as_surface, as_unit_vectors
from omtwarp.mesh.patches import Patches
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.cells import MIN_CURVATURE_SHARE
from omtwarp.optimal.energy import AREA_WEIGHT, MapTerms, TransportEnergy
from omtwarp.optimal.local import GAIN_SHARE, LEAST_DAMPING, MAX_STEPS, LocalSteps, freed_vertices
from omtwarp.optimal.small_local import SmallLocalSteps
from omtwarp.optimal.sphere import energy_on_sphere
from omtwarp.options import Cost, Progress, Record
from omtwarp.solvers.triangle_newton.line_search import SUFFICIENT_DECREASE

Numbers = NDArray[np.float64]

SHAPE_WEIGHT = 0.01  # β: on scans the optimal cost rises by some 0.04 %, and the map is smooth
PENALTY = 1000.0  # μ: weight of the remaining area errors beside the cost
MIN_COST = 1e-6  # radians²: gains are compared with the cost, or with this where the cost is smaller
# Of a creature of 2,000 vertices the cost is the same to 3e-5, in 15 or 16 steps, with half and twice each of REACH and
# MIN_GAIN_SHARE, and with MAX_CORRECTED from 0.0005 to 0.01.
REACH = 0.5  # radians: the farthest that a vertex moves in one step
MAX_HALVINGS = 20  # of a step with a fresh matrix, down to a millionth
# After a shortened step the next is at most so many times as long: longer ones were tried just before, in vain.
LENGTH_GROWTH = 4.0
MAX_HALVINGS_OLD = 1  # of a step with an older one: beyond that a fresh matrix gains more
UNTANGLED = 3  # lengths tried with flipped triangles untangled, the longest first; others only hold vertices back
# So many of the lengths tried are corrected to second order where they do not gain enough. With two, a body with thin
# arms takes 30 steps in place of more than 40, and ends at the optimum.
SECOND_ORDER = 2
# Root mean square error of the areas up to which steps are corrected to second order. With larger errors these
# corrections reach so far that slivers are left, which later steps get stuck at.
MAX_SECOND_ORDER_RMS = 5e-3
MAX_CORRECTED = 0.002  # share of the vertices: the matrix is used again while no more are untangled or held back
MIN_GAIN_SHARE = 0.2  # share by which a step with an older matrix has to lower the expected gain
# Eigenvalues of the inverse map's derivative are raised to the damping. Where the conformal map has shrunk a limb the
# cost hardly depends on the image, and a step would leave the region where the second derivative is accurate: the
# damping grows after short steps and shrinks after full ones.
MOST_DAMPING = 1.0
DAMPING_GROWTH, DAMPING_DECAY = 4.0, 0.5
# Share of the gains of single vertices that local steps free under a light penalty, where whole steps are short: less
# takes more steps of the whole map.
LIGHT_GAIN_SHARE = 0.95
# Gain over decrement, which is 1/2 where the function is quadratic. Above the first, more of the matrix's negative
# curvature is kept; below the second, less; below the third, the next step has a fresh matrix. Conventions of trust
# regions: with 0.1 to 0.48, 0.05 to 0.35 and 0.1 to 0.45 scans took as many steps, a body with thin arms 38 to 41.
TRUSTED, DISTRUSTED, RENEWED = 0.4, 0.2, 0.3

# Most local steps times the share of the vertices that they move: a local step takes about that share of the time of a
# whole one. With 1.4 in place of 1, local steps of three scans take 1.1 to 1.7 times as long, and save one step of the
# whole map or none; with 0.7 the angle distortion of one of them is 0.001 larger. Under a light penalty, where whole
# steps are short, there is no limit: a box with needles ends at an area distortion of 2.012 to 2.021 with one, of 2.010
# to 2.016 without.
MAX_LOCAL_WORK = 1.0

# Areas around vertices that are off by more than this (root mean square) and came right by less than this share in so
# many steps will not come right: on a box with triangles of 0.001 degrees, where they are off by 0.86, the error falls
# by 1 % in five steps and by 2 % in 25.
STALLED_RMS, STALLED_SHARE, STALLED_STEPS = 0.5, 0.02, 5
# Share of the squared errors of areas that a step has to take away to be worth taking for that alone.
LEAST_AREA_GAIN = 0.1

# Local steps end where the next is expected to gain less than this share of the gain that ends the minimisation.
LOCAL_GAIN_SHARE = 0.1
# δ of the soft distance relative to the root mean squared distance: with 0.3, 0.1 and 0.03 the mean distance of a
# gargoyle's map is 0.4144, 0.4137 and 0.4135 radians, in 3 steps each.
SOFTNESS = 0.03
# A map is optimal where a further step would gain less than this share of the cost and its areas are within the
# energy's tolerances. Cost and shape have long flat valleys: with 2e-5 scans of 40,000 and 70,000 triangles take three
# steps more and have 0.1 % less angle distortion, but noise of 1e-12 moves a vertex of the first by 0.008 radians in
# place of 4e-5.
GAIN = 5e-5
# A full step that was expected to gain less than so many times that is the last one, as it gains nearly all of it: to
# find that the next would gain less takes another matrix. With 4 a skull takes 4 steps in place of 6, but coarse meshes
# end at area distortions of up to 2.052 in place of 2.05.
LAST_GAIN = 2.0
# After so many steps so many times that ends the minimisation. Scans take at most nine with one weight of the shape
# term; a sphere with 50 spines took 31, of which the last ten lowered its energy by 1e-3 of the cost.
LATE_STEPS, LATE_GAIN = 15, 5.0


@dataclass(frozen=True)
class _Step:
    """A map that a step led to.

    Attributes:
        points: shape [V], on the device.
        terms: of the map.
        length: share of the direction that was taken.
        corrected: vertices untangled or held back.
        merit: of the map, with the multipliers before the step.
        multipliers: after the step, shape [V].
        settled: vertices moved by local steps.
    """

    points: wp.array
    terms: MapTerms
    length: float
    corrected: int
    merit: float
    multipliers: Numbers
    settled: int = 0


@dataclass(frozen=True)
class OptimalMap:
    """A discrete optimal map, with how the minimisation reached it.

    Attributes:
        points: images of the vertices, no triangle flipped: unit vectors, float64, shape [V, 3], or places in the
            plane of a torus, shape [V, 2].
        multipliers: p_c of :mod:`omtwarp.optimal.energy`, one for every area that is kept; for those around vertices
            -1/6π times Kantorovich's potential at the points x_v, shape [V].
        history: one record per step, the first for the start: ``cost`` (Σ m d², or of soft distances; masses 4π in
            all), ``energy`` (cost, shape and area errors in one number), ``ring_rms`` and ``ring_largest`` (relative
            errors of the areas around vertices), ``area`` and ``angle`` (mean distortions of triangles), ``decrement``
            (expected gain), ``length`` (share of the Newton step taken), ``factorised`` (whether the matrix is of this
            step), ``corrected`` (number of vertices untangled or held back) and ``settled`` (number moved by local
            steps).
        converged: whether the expected gain and the areas reached their tolerances.
        ended: why the minimisation ended, in words.
        factorisations: number of sparse matrices that were factorised.
        gave_up: what was given up because it took too much work, in words; mostly empty.
    """

    points: Numbers
    multipliers: Numbers
    history: tuple[Record, ...]
    converged: bool
    ended: str
    factorisations: int
    gave_up: str = ""

    @property
    def sphere(self) -> Numbers:
        """The images of the vertices, of a map to the sphere: unit vectors, shape [V, 3]."""
        return self.points


def optimal_map(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    shape_weight: float = SHAPE_WEIGHT,
    area_weight: float = AREA_WEIGHT,
    area_penalty: float = PENALTY,
    multipliers: ArrayLike | None = None,
    iterations: int = 40,
    gain: float = GAIN,
    cost: str = Cost.SQUARED,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> OptimalMap:
    """Minimise the transport cost over all maps that keep the areas around vertices (section 4.3).

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices; its vertex areas, total 4π,
            are the masses.
        sphere: a map without flips to begin with, unit vectors, shape [V, 3].
        start: the points x that are transported, unit vectors, shape [V, 3]; triangles may be flipped there.
        shape_weight: β, the weight of angle and area distortion of triangles relative to the mean squared distance.
        area_weight: λ, how much area distortion counts there against angle distortion.
        area_penalty: μ, the weight of area errors beside the cost during the minimisation. It does not change the
            result: a smaller one allows longer steps while a map is far from optimal, and corrects areas later.
        multipliers: initial multipliers, shape [V], such as those of a map with another shape weight.
        iterations: largest number of steps.
        gain: end where the expected gain of a step falls below this share of the cost.
        cost: ``squared`` geodesic distance, or the ``geodesic`` distance d as sqrt(d² + δ²) - δ, where δ is 3 % of the
            root mean squared distance of the map given: d itself has no curvature along the geodesic, and its least
            cost many maps.
        device: where the kernels run; the saddle-point systems are solved on the host.
        progress: called after every step as ``progress("omt", step, most, record)``, the record being that of
            ``history``.

    Returns:
        The map, whose energy is at most that of the one given, its history, and whether it converged.

    Raises:
        OmtwarpError: the mesh or a map cannot be used, or the map given has flipped triangles.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(sphere=320)
        >>> x = omtwarp.conformal_map(surface).sphere
        >>> found = omtwarp.optimal_map(surface, omtwarp.moser_map(surface, x).sphere, start=x)
        >>> found.converged, found.history[-1]["ring_rms"] < 1e-3
        (True, True)
    """
    where = resolve_device(device)
    mesh = as_surface(surface)
    given, x = (as_unit_vectors(points, mesh.vertex_count) for points in (sphere, start))
    weight = real_number(shape_weight, "shape_weight", least=0.0)
    area_weight = real_number(area_weight, "area_weight", least=0.0)
    area_penalty = real_number(area_penalty, "area_penalty", above=0.0)
    gain = real_number(gain, "gain", least=0.0)
    iterations = whole_number(iterations, "iterations")
    if multipliers is not None:
        multipliers = real_numbers(multipliers, "multipliers", (mesh.vertex_count,))
    soft = softness(mesh.vertex_areas, given, x, cost)
    energy = energy_on_sphere(mesh, vectors(x, where), where, weight, area_weight=area_weight, softness=soft)
    return minimise(
        energy,
        given,
        area_penalty=area_penalty,
        multipliers=multipliers,
        gain=gain,
        iterations=iterations,
        progress=progress,
    )


def softness(masses: Numbers, sphere: Numbers, start: Numbers, cost: str) -> float:
    """Return δ of the soft distance sqrt(d² + δ²) - δ that stands for a cost, in radians; 0 for the squared distance.

    Args:
        masses: of the vertices, shape [V].
        sphere, start: a map and the points that it moves, unit vectors, shape [V, 3].
        cost: ``squared`` or ``geodesic``.

    Raises:
        OmtwarpError: the cost is unknown.
    """
    if choose(Cost, cost) is Cost.SQUARED:
        return 0.0
    chords = np.linalg.norm(sphere - start, axis=1)
    angles = 2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))
    return SOFTNESS * float(np.sqrt(masses @ angles**2 / masses.sum()))


@blas_threads(1)
def minimise(
    energy: TransportEnergy,
    points: Numbers,
    *,
    area_penalty: float = PENALTY,
    multipliers: ArrayLike | None = None,
    gain: float,
    iterations: int,
    progress: Progress | None,
    penalty: float | None = None,
) -> OptimalMap:
    """Minimise an energy under its area constraints, or with a penalty in their place; :func:`optimal_map` calls this.

    Args:
        energy: what is minimised.
        points: a map without flips to begin with, shape [V, 3], or [V, 2] in the plane.
        area_penalty, multipliers, iterations, progress: as of :func:`optimal_map`.
        gain: end where a step is expected to gain less than this share of the cost; with a penalty, less than this
            number.
        penalty: μ; μ / 24π Σ (a_v - 3m_v)² / 3m_v is added to the energy in place of the constraints. ``progress`` is
            then called with the stage ``refine``.

    Returns:
        The map as :func:`optimal_map` returns it.

    Raises:
        OmtwarpError: the map given has flipped triangles.
    """
    given = np.array(points, dtype=np.float64)
    flipped = energy.domain.flipped(given)
    if flipped.any():
        raise OmtwarpError(f"the map to optimise has {int(flipped.sum())} flipped triangles: untangle it first")
    known = None if multipliers is None else np.array(multipliers, dtype=np.float64)
    return _Newton(energy, gain, area_penalty, penalty).run(given, known, iterations, progress)


class _Newton:
    """State of one minimisation: the multipliers, and the factorised matrix of this or an earlier map.

    Args:
        energy, gain, area_penalty, penalty: as of :func:`minimise`.
    """

    def __init__(
        self,
        energy: TransportEnergy,
        gain: float,
        area_penalty: float = PENALTY,
        penalty: float | None = None,
    ):
        self.constrained, self.stage = penalty is None, "omt" if penalty is None else "refine"
        self.energy, self.device, self.gain = energy, energy.device, gain
        self.surface, self.domain = energy.surface, energy.domain
        self.steps = energy.flip_free_steps()
        self.factor = energy.saddle_factor()
        # Weights of the squared area errors in the augmented Lagrangian: μ over the wanted areas, which sum to 12π for
        # rings.
        self.stiffness = (area_penalty if penalty is None else penalty) / energy.wanted.sum() / energy.wanted
        # With a light penalty steps may lower cost at the expense of areas; the map at the end must not be worse than
        # the one given by the usual penalty.
        self.strictness = max(1.0, PENALTY / area_penalty) if self.constrained else 1.0
        self.multipliers = np.zeros(len(energy.wanted))
        self.max_rms, self.max_error = energy.cells.tolerances
        self.curvature_share, self.damping = energy.first_curvature_share, LEAST_DAMPING
        self.factorisations = 0
        self.longest = 1.0  # of the next step
        self.taken = 0  # steps
        self.expected = np.inf  # gain of the last direction

    def run(
        self,
        given: Numbers,
        multipliers: Numbers | None,
        iterations: int,
        progress: Progress | None,
    ) -> OptimalMap:
        """Take Newton steps until the map reaches the tolerances, or no step lowers the energy.

        One function, as every decision on how to continue depends on the same matrix, step and map.
        """
        energy = self.energy
        points = self.domain.sent(given)
        terms = energy.terms(points)
        if multipliers is not None:
            self.multipliers = multipliers
        elif self.constrained:  # estimated from a potential of zero
            self.multipliers = -energy.potential(terms, self.multipliers)
        first = self._penalised_energy(terms, self.strictness)
        history = [self._record(terms, 0.0, 0.0, False, 0)]
        ended, converged = "most steps taken", False
        renew, last = True, np.inf
        for number in range(iterations):
            fresh = renew
            if renew:
                self._factorise(points, terms)
                if number == 0 and multipliers is None and self.constrained:
                    self._estimate(points, terms)
            direction, q, decrement = self._direction(points, terms)
            if self._reached(terms, decrement) or (fresh and self._helpless(terms, q, decrement)):
                ended, converged = "optimal", True
                break
            if not fresh and decrement > (1.0 - MIN_GAIN_SHARE) * last:
                renew = True
                continue
            step = None
            if decrement > 0.0:
                halvings = MAX_HALVINGS if fresh else MAX_HALVINGS_OLD
                step = self._search(points, terms, direction, q, decrement, halvings)
            if step is None:
                if fresh and self.curvature_share == 1.0:
                    ended = "no step lowers the cost"
                    break
                self.curvature_share = 1.0 if fresh else self.curvature_share
                renew = True
                continue
            length, corrected = step.length, step.corrected
            self.longest = min(1.0, LENGTH_GROWTH * length)
            trust = (self._merit(terms) - step.merit) / (length * decrement)
            self.multipliers = step.multipliers
            points, terms, settled = step.points, step.terms, step.settled
            final = length == 1.0 and corrected == 0 and self._reached(terms, decrement, LAST_GAIN)
            if settled == 0 and not final:
                points, terms, settled = self._settled(points, terms)
            last, self.taken = decrement, self.taken + 1
            history.append(self._record(terms, decrement, length, fresh, corrected, settled))
            if progress is not None:
                progress(self.stage, number + 1, iterations, history[-1])
            if final:
                ended, converged = "optimal", True
                break
            if self.constrained and _stalled(history):
                ended = "areas no longer come right"
                break
            if fresh and length == 1.0 and corrected == 0 and trust > TRUSTED:
                self.curvature_share = max(self.curvature_share / 3.0, MIN_CURVATURE_SHARE)
            elif fresh and (length < 1.0 or trust < DISTRUSTED):
                self.curvature_share = min(1.0, 3.0 * self.curvature_share)
            if fresh:
                # With a heavy penalty a damping that decays after steps of little gain lets the next ones oscillate.
                gaining = trust > TRUSTED or self.strictness > 1.0
                lost = not gaining and trust < DISTRUSTED and self.damping > LEAST_DAMPING
                growing, decaying = length < 0.5 or lost, length == 1.0 and gaining
                change = DAMPING_GROWTH if growing else DAMPING_DECAY if decaying else 1.0
                self.damping = min(max(change * self.damping, LEAST_DAMPING), MOST_DAMPING)
            renew = length < 1.0 or corrected > MAX_CORRECTED * self.surface.vertex_count or trust < RENEWED
        last_energy = self._penalised_energy(terms, self.strictness)
        better, as_good = last_energy <= first, last_energy <= first + MIN_COST
        return OptimalMap(
            points.numpy().copy() if better else given,
            self.multipliers,
            tuple(history),
            converged and as_good,
            ended if as_good else f"{ended}; the map given was better",
            self.factorisations,
            self.steps.gave_up,
        )

    def _settled(self, points: wp.array, terms: MapTerms) -> tuple[wp.array, MapTerms, int]:
        """Move the few vertices that have the most to gain; return the map, its terms, and the number of them."""
        energy = self.energy
        if not energy.has_local_steps:
            return points, terms, 0
        gradient = self.domain.coordinates(self.base, energy.gradient(points, terms, self.multipliers))
        (g0, g1), (h00, h01, h11) = gradient.T, self.own.reshape(-1, 4)[:, [0, 1, 3]].T
        alone = (g0**2 * h11 - 2.0 * g0 * g1 * h01 + g1**2 * h00) / (h00 * h11 - h01**2)
        gains = alone + self.stiffness * energy.missing(terms) ** 2
        share = LIGHT_GAIN_SHARE if self.strictness > 1.0 else GAIN_SHARE
        freed = freed_vertices(self.surface.faces, gains, self.expected, share)
        if freed is None:
            return points, terms, 0
        patches = Patches.of_vertices(self.surface.faces, freed)
        setting = energy, patches, points, terms, self.multipliers, self.stiffness, self.constrained
        small = SmallLocalSteps(*setting)
        steps = small if small.worthwhile else LocalSteps(*setting)
        most = MAX_STEPS
        if self.strictness == 1.0:
            most = min(most, max(int(MAX_LOCAL_WORK / float(freed.mean())), 1))
        moved, vertices, of_patches = steps.run(LOCAL_GAIN_SHARE * self._enough(terms), most)
        multipliers = self.multipliers.copy()
        multipliers[vertices] = of_patches
        after = energy.terms(moved)
        if not self._penalised_energy(after) < self._penalised_energy(terms):
            return points, terms, 0
        self.multipliers = multipliers
        return moved, after, int(freed.sum())

    def _enough(self, terms: MapTerms) -> float:
        """Return the expected gain below which no further step is taken."""
        if not self.constrained:
            return 2.0 * self.gain
        gain = self.gain * (LATE_GAIN if self.taken >= LATE_STEPS else 1.0)
        return gain * max(self.energy.cost(terms) / SPHERE_AREA, MIN_COST)

    def _reached(self, terms: MapTerms, decrement: float, looser: float = 1.0) -> bool:
        """Return whether the expected gain, and under constraints the areas, are within their tolerances.

        The tolerance of the gain is multiplied by ``looser``.
        """
        enough = decrement <= looser * self._enough(terms)
        if not self.constrained:
            return enough
        rms, largest = self.energy.area_errors(terms)
        return enough and rms <= self.max_rms and largest <= self.max_error

    def _helpless(self, terms: MapTerms, q: Numbers, decrement: float) -> bool:
        """Return whether a step that gains nothing leaves small errors of the areas nearly as they are.

        So it is where symmetry holds every vertex, as on a sphere of 80 triangles, whose areas are flat.
        """
        if not self.constrained or decrement > self._enough(terms):
            return False
        missing = self.energy.missing(terms)
        left = float(self.stiffness @ (q / self.stiffness) ** 2)  # B u = C q - missing
        small = self.energy.area_errors(terms)[1] <= self.max_error
        return small and left > (1.0 - LEAST_AREA_GAIN) * float(self.stiffness @ missing**2)

    def _penalised_energy(self, terms: MapTerms, strictness: float = 1.0) -> float:
        """Return cost plus shape plus penalty on area errors, times strictness; it needs no multipliers."""
        energy, missing = self.energy, self.energy.missing(terms)
        cost = energy.cost_weight * energy.cost(terms) / SPHERE_AREA
        penalty = 0.5 * strictness * float(self.stiffness @ missing**2)
        return cost + energy.shape_weight * terms.shape.total(energy.area_weight) + penalty

    def _merit(self, terms: MapTerms) -> float:
        """Return the augmented Lagrangian of a map, which steps have to lower."""
        missing = self.energy.missing(terms)
        return self.energy.lagrangian(terms, self.multipliers) + 0.5 * float(self.stiffness @ missing**2)

    def _factorise(self, points: wp.array, terms: MapTerms) -> None:
        """Factorise the matrix of a map."""
        weights = self.curvature_share, self.damping, 1.0 / self.stiffness
        self.base, self.own = points, self.energy.factorise(self.factor, points, terms, *weights)
        self.factorisations += 1

    def _estimate(self, points: wp.array, terms: MapTerms) -> None:
        """Add to the multipliers what makes the gradient of the Lagrangian smallest in the metric of the matrix."""
        gradient = self.energy.gradient(points, terms, self.multipliers)
        _, q = self.factor.solve(-self.domain.coordinates(self.base, gradient), np.zeros(len(self.multipliers)))
        self.multipliers = self.multipliers + q

    def _direction(self, points: wp.array, terms: MapTerms) -> tuple[wp.array, Numbers, float]:
        """Return the Newton step (vectors on the device), the multipliers' change, and the expected gain."""
        missing = self.energy.missing(terms)
        gradient = self.energy.gradient(points, terms, self.multipliers)
        u, q = self.factor.solve(-self.domain.coordinates(self.base, gradient), -missing)
        step = self.domain.vectors(self.base, points, u)
        # The slope of the penalty along u is that of B u = C q - missing.
        slope = float((gradient * step).sum()) + float(missing @ q) - float(self.stiffness @ missing**2)
        self.expected = -slope
        return self.domain.sent(step), q, -slope

    def _search(
        self, points: wp.array, terms: MapTerms, direction: wp.array, q: Numbers, decrement: float, halvings: int
    ) -> _Step | None:
        """Halve a step until it lowers the merit without flipping a triangle; return None where none does."""
        before = self._merit(terms)
        reach = float(np.sqrt((direction.numpy() ** 2).sum(axis=1).max()))
        length = min(self.longest, REACH / max(reach, TINY))
        correctable = SECOND_ORDER if self.energy.area_errors(terms)[0] <= MAX_SECOND_ORDER_RMS else 0
        for attempt in range(halvings + 1):
            enough = before - SUFFICIENT_DECREASE * length * decrement
            best, reached = _first_of(self._moved(points, terms, direction, q, length, attempt < UNTANGLED), enough)
            if best is not None and not reached and attempt < correctable:
                best = self._second_order(best, points, terms, direction, q, enough)
                reached = best is not None
            if reached:
                return best
            length *= 0.5
        return None

    def _moved(
        self, points: wp.array, terms: MapTerms, direction: wp.array, q: Numbers, length: float, untangling: bool
    ) -> Iterator[_Step]:
        """Yield the flip-free maps at a share of the direction: with untangling, with vertices held back, or both."""
        volume = terms.shape.d_volume
        multipliers = self.multipliers + length * q if self.constrained else self.multipliers

        def step_to(there: wp.array, corrected: int) -> _Step:
            after = self.energy.terms(there)
            return _Step(there, after, length, corrected, self._merit(after), multipliers)

        if untangling:
            found = self.steps.untangled(points, direction, volume, length, self.energy.area_weight)
            if found is not None:
                yield step_to(*found)
                if found[1] == 0:
                    return
        held = self.steps.held_back(points, direction, volume, length)
        if held is not None:
            yield step_to(held[0], int((held[1].numpy() < 1.0).sum()))

    def _second_order(
        self, step: _Step, points: wp.array, terms: MapTerms, direction: wp.array, q: Numbers, enough: float
    ) -> _Step | None:
        """Correct a step by what is missing of areas where it leads, and if need be by local steps.

        Args:
            step: what was tried.
            points, terms, direction, q: as of :meth:`_search`.
            enough: the merit to reach.

        Returns:
            The step that reaches it, or None.
        """
        expected = (1.0 - step.length) * self.energy.missing(terms) + step.length * q / self.stiffness
        u, _ = self.factor.solve(np.zeros((len(points), 2)), expected - self.energy.missing(step.terms))
        correction = self.domain.vectors(self.base, points, u)
        there = self.domain.sent(direction.numpy() + correction / step.length)
        best, reached = _first_of(self._moved(points, terms, there, q, step.length, True), enough)
        if best is None or reached:
            return best
        before, self.multipliers = self.multipliers, best.multipliers
        moved, after, settled = self._settled(best.points, best.terms)
        multipliers, self.multipliers = self.multipliers, before
        merit = self._merit(after)
        if settled == 0 or merit > enough:
            return None
        return replace(best, points=moved, terms=after, merit=merit, multipliers=multipliers, settled=settled)

    def _record(
        self, terms: MapTerms, decrement: float, length: float, factorised: bool, corrected: int, settled: int = 0
    ) -> Record:
        """Return the entry of the history for a step, as :class:`OptimalMap` describes it."""
        rms, largest = self.energy.area_errors(terms)
        return {
            "cost": self.energy.cost(terms),
            "energy": self._penalised_energy(terms),
            "ring_rms": rms,
            "ring_largest": largest,
            "area": terms.shape.area + 2.0,
            "angle": terms.shape.angle + 2.0,
            "decrement": decrement,
            "length": length,
            "factorised": factorised,
            "corrected": corrected,
            "settled": settled,
        }


def _first_of(steps: Iterator[_Step], enough: float) -> tuple[_Step | None, bool]:
    """Return the first step whose merit is low enough, and True; or the one with the lowest, if any, and False."""
    best = None
    for step in steps:
        if step.merit <= enough:
            return step, True
        if best is None or step.merit < best.merit:
            best = step
    return best, False


def _stalled(history: list[Record]) -> bool:
    """Return whether areas around vertices are far off and no longer come right, by the records of the steps so far."""
    if len(history) <= STALLED_STEPS:
        return False
    before, now = (float(history[k]["ring_rms"]) for k in (-1 - STALLED_STEPS, -1))
    return now > STALLED_RMS and now > (1.0 - STALLED_SHARE) * before
