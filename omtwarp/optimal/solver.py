"""The discrete optimal map by Newton's method, with the areas around vertices as constraints.

Every step solves the saddle-point system of :mod:`omtwarp.optimal.energy`,

    [H, Bᵀ; B, -C] [u; q] = -[∂L/∂y; a - 3m],      B = ∂a/∂y,  C = diag(12π · 3m_v / μ),

whose last block makes it a step of the augmented Lagrangian method with penalty μ (Nocedal and Wright, "Numerical
Optimization", chapter 17): q is added to the multipliers, and u lowers L + μ / 24π Σ (a_v - 3m_v)² / 3m_v. A step that
does not is corrected where areas alone keep it from that, or else halved; areas that a whole step leaves in error are
corrected too. After each step the few vertices that have the most to gain take steps of their own
(:mod:`omtwarp.optimal.local`). The minimisation ends with the step that was expected to gain next to nothing, or with
the one before, where that is foreseen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import empty
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import combine, scaled
from omtwarp.device.threads import blas_threads, computed, each
from omtwarp.errors import OmtwarpError, choose
from omtwarp.mesh.arrays import Floats, norms, real_number, real_numbers, whole_number
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, as_surface, as_unit_vectors
from omtwarp.optimal.energy import SHAPE_WEIGHT, MapTerms, TransportEnergy
from omtwarp.optimal.kernels import single_gains
from omtwarp.optimal.local import local_steps
from omtwarp.optimal.sphere import Sphere, energy_on_sphere
from omtwarp.optimal.steps import FlipFreeSteps
from omtwarp.options import Cost, CostLike, Progress, Record, tell
from omtwarp.solvers.cholesky.saddle import COORDINATES
from omtwarp.solvers.newton import SUFFICIENT_DECREASE
from omtwarp.solvers.triangle import AREA_WEIGHT

# μ: weight of the remaining area errors beside the cost. 60 made surfaces end with the same areas and angles with 300
# and 3,000: less allows longer steps, and corrects areas later.
PENALTY = 1000.0
LEAST_PENALTY = 1e-12  # in place of 0, by which saddle-point systems divide
MIN_COST = 1e-6  # radians²: gains are compared with the cost, or with this where the cost is smaller
MAX_HALVINGS = 6  # of a step: smaller ones lower the merit of drawn parts, and tear their triangles
CORRECTED = 0.1  # share of the squared errors of areas that a correction may leave: after one that leaves more, none
# Share of the squared errors of areas that a step has to take away to be worth taking for that alone.
LEAST_AREA_GAIN = 0.1
# Local steps end where the next is expected to gain less than this share of the gain that ends the minimisation.
LOCAL_GAIN_SHARE = 0.1
# δ of the soft distance relative to the root mean squared distance: with 0.3, 0.1 and 0.03 the mean distance of a
# gargoyle's map is 0.4144, 0.4137 and 0.4135 radians, in 3 steps each.
SOFTNESS = 0.03
# A map is optimal after a step that was expected to gain less than this share of the cost, where its areas are within
# the energy's tolerances. Cost and shape have long flat valleys: less takes more steps for the same map.
GAIN = 1e-4


@dataclass(frozen=True)
class _Step:
    """A map that a step led to.

    Attributes:
        points: shape [V], on the device.
        terms: of the map.
        corrected: vertices held back.
        length: share of the direction that was taken.
        multipliers: after the step, float64, shape [N], on the device.
    """

    points: wp.array
    terms: MapTerms
    corrected: int
    length: float
    multipliers: wp.array


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
            (expected gain), ``length`` (share of the Newton step taken), ``corrected`` (number of vertices held back),
            ``settled`` (number moved by local steps).
        converged: whether the expected gain and the areas reached their tolerances.
        ended: why the minimisation ended, in words.
        factorisations: number of sparse matrices that were factorised.
    """

    points: Floats
    multipliers: Floats
    history: tuple[Record, ...]
    converged: bool
    ended: str
    factorisations: int

    @property
    def sphere(self) -> Floats:
        """The images of the vertices, of a map to the sphere: unit vectors, shape [V, 3]."""
        return self.points


def optimal_map(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    shape_weight: float = SHAPE_WEIGHT,
    area_weight: float = AREA_WEIGHT,
    multipliers: ArrayLike | None = None,
    iterations: int = 40,
    gain: float = GAIN,
    cost: CostLike = Cost.SQUARED,
    domain: Sphere | None = None,
    foresee: bool = False,
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
        multipliers: initial multipliers, shape [V], such as those of a map with another shape weight.
        iterations: largest number of steps.
        gain: end where the expected gain of a step falls below this share of the cost.
        cost: ``squared`` geodesic distance, or the ``geodesic`` distance d as sqrt(d² + δ²) - δ, where δ is 3 % of the
            root mean squared distance of the map given: d itself has no curvature along the geodesic, and its least
            cost many maps.
        domain: that of the symmetric maps of a double (:class:`omtwarp.open_surfaces.symmetric.MirroredSphere`), among
            which the least is found; the whole sphere by default.
        foresee: end a step earlier, where the next is foreseen to gain less than that: it gains less than a whole step
            by as much as that gained less than the one before. For maps from which no other minimisation begins.
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
    gain = real_number(gain, "gain", least=0.0)
    iterations = whole_number(iterations, "iterations")
    if multipliers is not None:
        multipliers = real_numbers(multipliers, "multipliers", (mesh.vertex_count,))
    soft = softness(mesh.vertex_areas, given, x, cost)
    energy = energy_on_sphere(mesh, x, where, weight, domain=domain, area_weight=area_weight, softness=soft)
    return minimise(
        energy, given, multipliers=multipliers, gain=gain, iterations=iterations, foresee=foresee, progress=progress
    )


def softness(masses: Floats, sphere: Floats, start: Floats, cost: str) -> float:
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
    chords = norms(sphere - start)
    angles = 2.0 * np.arcsin(np.minimum(0.5 * chords, 1.0))
    return SOFTNESS * float(np.sqrt(masses @ angles**2 / masses.sum()))


@blas_threads(1)
def minimise(
    energy: TransportEnergy,
    points: Floats,
    *,
    multipliers: Floats | None = None,
    gain: float,
    iterations: int,
    progress: Progress | None,
    penalty: float | None = None,
    foresee: bool = False,
) -> OptimalMap:
    """Minimise an energy under its area constraints, or with a penalty in their place; :func:`optimal_map` calls this.

    Args:
        energy: what is minimised.
        points: a map without flips to begin with, shape [V, 3], or [V, 2] in the plane.
        multipliers, iterations, progress, foresee: as of :func:`optimal_map`.
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
    return _Newton(energy, gain, penalty, foresee).run(given, multipliers, iterations, progress)


class _Newton:
    """State of one minimisation: the multipliers, and the factorised matrix of the map at hand.

    Maps, terms and systems stay on the device. For every step the host reads the numbers of each length tried, once,
    and where single vertices go on alone what these read of the map.

    Args:
        energy, gain, penalty, foresee: as of :func:`minimise`.
    """

    def __init__(self, energy: TransportEnergy, gain: float, penalty: float | None, foresee: bool):
        self.constrained, self.stage = penalty is None, "omt" if penalty is None else "refine"
        self.energy, self.device, self.gain, self.foresees = energy, energy.device, gain, foresee
        self.surface, self.domain = energy.surface, energy.domain
        self.steps = FlipFreeSteps(energy)
        # Weights of the squared area errors in the augmented Lagrangian: μ over the wanted areas, which sum to 12π for
        # rings.
        weight = PENALTY if penalty is None else max(penalty, LEAST_PENALTY)
        self.stiffness = weight / float(energy.wanted.sum())  # of squares over wanted areas
        self.compliance = wp.array(energy.wanted / self.stiffness, dtype=wp.float64, device=self.device)
        self.multipliers = wp.zeros(len(energy.wanted), dtype=wp.float64, device=self.device)
        self.max_rms, self.max_error = energy.cells.tolerances

    def run(self, given: Floats, multipliers: Floats | None, iterations: int, progress: Progress | None) -> OptimalMap:
        """Take Newton steps until one was expected to gain next to nothing, or none lowers the energy."""
        energy = self.energy
        points = self.domain.sent(given)
        terms = energy.terms(points)
        if multipliers is not None:
            self.multipliers = wp.array(multipliers, dtype=wp.float64, device=self.device)
        elif self.constrained:  # estimated from a potential of zero
            self.multipliers = scaled(energy.potential(terms, self.multipliers), -1.0)
        history = [self._record(terms, 0.0, 0.0, 0, 0)]
        ended, converged, factorisations = "most steps taken", False, 0
        for number in range(iterations):
            energy.factorise(points, terms, self.compliance)
            factorisations += 1
            if number == 0 and multipliers is None and self.constrained:
                self._estimate(points, terms)
            step, q, decrement = self._search(points, terms)
            if step is None:
                converged = self._reached(terms, decrement) or self._helpless(terms, q, decrement)
                ended = "optimal" if converged else "no step lowers the cost"
                break
            points, terms, self.multipliers, settled = step.points, step.terms, step.multipliers, 0
            converged, ahead = self._reached(terms, decrement), self._ahead(decrement, step, history[-1]["decrement"])
            if energy.has_local_steps and not converged:
                points, terms, settled = self._settled(points, terms, max(ahead, min(decrement, self._enough(terms))))
                converged = ahead < decrement and self._reached(terms, ahead)
            history.append(self._record(terms, decrement, step.length, step.corrected, settled))
            tell(progress, self.stage, number + 1, iterations, history[-1])
            if converged:
                ended = "optimal"
                break
        first, last = (history[k]["energy"] for k in (0, -1))
        better, as_good = last <= first, last <= first + MIN_COST
        return OptimalMap(
            points.numpy().copy() if better else given,
            self.multipliers.numpy().copy(),
            tuple(history),
            converged and as_good,
            ended if as_good else f"{ended}; the map given was better",
            factorisations,
        )

    def _ahead(self, decrement: float, step: _Step, before: float) -> float:
        """Return what the next step is expected to gain: as much as the last, where nothing is known of it.

        Where the end is foreseen, that is less than a whole step by as much as this gained less than that ``before``.
        """
        known = self.foresees and before > 0.0 and step.length == 1.0
        return decrement * min(decrement / before, 1.0) if known else decrement

    def _settled(self, points: wp.array, terms: MapTerms, expected: float) -> tuple[wp.array, MapTerms, int]:
        """Move the few vertices that have the most to gain; return the map, its terms, and the number of them.

        The gain that is ``expected`` of the next step limits that of single vertices.
        """
        energy, matrix, count = self.energy, self.energy.matrix, self.surface.vertex_count
        gradient = self.domain.coordinates(matrix.points, energy.gradient(points, terms, self.multipliers))
        blocks = each(gradient, matrix.diagonal.reshape((-1, COORDINATES)), matrix.inner)
        inputs = [*each(terms.relative, terms.missing), wp.float64(self.stiffness), *blocks]
        gains = computed(single_gains, inputs, empty(count, wp.float64, self.device))
        stiffness = self.stiffness / energy.wanted
        chosen = local_steps(energy, gains.numpy(), expected, stiffness, constrained=self.constrained)
        if chosen is None:
            return points, terms, 0
        steps, freed = chosen
        moved, multipliers = steps.run(points, terms, self.multipliers, LOCAL_GAIN_SHARE * self._enough(terms))
        after = energy.terms(moved)
        if not self._penalised_energy(after) < self._penalised_energy(terms):
            return points, terms, 0
        self.multipliers = multipliers
        return moved, after, freed

    def _enough(self, terms: MapTerms) -> float:
        """Return the expected gain below which no further step is taken."""
        return self.gain * (max(self.energy.cost(terms) / SPHERE_AREA, MIN_COST) if self.constrained else 2.0)

    def _reached(self, terms: MapTerms, decrement: float) -> bool:
        """Return whether the expected gain, and under constraints the areas, are within their tolerances."""
        right = self.energy.area_rms(terms) <= self.max_rms and terms.largest <= self.max_error
        return decrement <= self._enough(terms) and (right or not self.constrained)

    def _helpless(self, terms: MapTerms, q: wp.array, decrement: float) -> bool:
        """Return whether a step that gains nothing leaves small errors of the areas nearly as they are.

        So it is where symmetry holds every vertex, as on a sphere of 80 triangles, whose areas are flat.
        """
        near = self.constrained and decrement <= self._enough(terms) and terms.largest <= self.max_error
        least_left = (1.0 - LEAST_AREA_GAIN) * self.stiffness * terms.squares
        return near and float(self.compliance.numpy() @ q.numpy() ** 2) > least_left  # B u = C q - missing

    def _penalised_energy(self, terms: MapTerms) -> float:
        """Return cost plus shape plus penalty on area errors; it needs no multipliers."""
        energy = self.energy
        cost = energy.cost_weight * energy.cost(terms) / SPHERE_AREA
        penalty = 0.5 * self.stiffness * terms.squares
        return cost + energy.shape_weight * terms.shape.total(energy.area_weight) + penalty

    def _merit(self, terms: MapTerms) -> float:
        """Return the augmented Lagrangian of a map, which steps have to lower."""
        return self.energy.lagrangian(terms) + 0.5 * self.stiffness * terms.squares

    def _estimate(self, points: wp.array, terms: MapTerms) -> None:
        """Add to the multipliers what makes the gradient of the Lagrangian smallest in the metric of the matrix."""
        gradient = self.energy.gradient(points, terms, self.multipliers)
        _, solution = self.energy.newton_step(gradient, None)
        self.multipliers = combine(1.0, self.multipliers, 1.0, solution[-self.multipliers.size :])

    def _search(self, points: wp.array, terms: MapTerms) -> tuple[_Step | None, wp.array, float]:
        """Halve the Newton step until it lowers the merit without flipping a triangle.

        Returns:
            The step, None where no length does; the change of the multipliers; and the gain expected.
        """
        energy, reading = self.energy, self.energy.reading
        gradient = energy.gradient(points, terms, self.multipliers)
        right, solution = energy.newton_step(gradient, terms.missing)
        direction, q = energy.direction(solution), solution[-self.multipliers.size :]
        # The slope of the penalty along u is that of B u = C q - missing.
        slope, pressed = reading.dot(right, solution), reading.dot(self.multipliers, terms.missing)
        volume, length, decrement, merit = terms.shape.d_volume, 1.0, 0.0, 0.0
        for halvings in range(MAX_HALVINGS + 1):
            numbers, taken = self.steps.tried(points, direction, volume, length, self.multipliers)
            if halvings == 0:
                decrement = float(numbers[slope]) + self.stiffness * terms.squares
                merit = self._merit(replace(terms, pressed=float(numbers[pressed])))
                if not decrement > 0.0:
                    break
            enough = merit - SUFFICIENT_DECREASE * length * decrement
            reached = taken()
            if reached is not None:
                step = _Step(*reached, length, self._changed(self.multipliers, length, q))
                corrected = self._corrected(terms, step, enough)
                if corrected is not None:
                    return corrected, q, decrement
            length *= 0.5
        return None, q, decrement

    def _corrected(self, terms: MapTerms, step: _Step, enough: float) -> _Step | None:
        """Return a step whose merit is low enough, with its areas corrected; None without one.

        Steps are straight, and vertices that turn around a point move on circles: what turns by an angle grows by half
        of its square. This second-order error of the areas is taken back with the factor at hand (Nocedal and Wright,
        "Numerical Optimization", section 15.6), again and again while that takes most of it away: where areas alone
        keep the merit from falling, and where a whole step leaves more to gain from them than ends the minimisation.

        Args:
            terms: of the map that the step began from.
            step: as taken, without flips.
            enough: what the merit has to fall to.
        """
        energy, volume, before = self.energy, terms.shape.d_volume, terms.squares
        while True:
            squares, low = step.terms.squares, self._merit(step.terms) <= enough
            worthwhile = self.constrained and step.length == 1.0 and squares <= CORRECTED * before
            if low and not (worthwhile and self.stiffness * squares > self._enough(step.terms)):
                return step
            if not low and energy.lagrangian(step.terms) > enough:
                return None
            # Of the errors of before, a step of this length was to leave the rest.
            missing = combine(1.0, step.terms.missing, step.length - 1.0, terms.missing)
            _, solution = energy.newton_step(None, missing)
            direction, q = energy.direction(solution), solution[-self.multipliers.size :]
            reached = self.steps.tried(step.points, direction, volume, 1.0, self.multipliers)[1]()
            if reached is None:
                return step if low else None
            points, after, held = reached
            if after.squares > CORRECTED * squares or not self._merit(after) < self._merit(step.terms):
                return step if low else None
            multipliers = self._changed(step.multipliers, 1.0, q)
            before, step = squares, _Step(points, after, step.corrected + held, step.length, multipliers)

    def _changed(self, multipliers: wp.array, length: float, q: wp.array) -> wp.array:
        """Return multipliers after a share of their change; with a penalty in place of constraints they stay."""
        return combine(1.0, multipliers, length, q) if self.constrained else multipliers

    def _record(self, terms: MapTerms, decrement: float, length: float, corrected: int, settled: int) -> Record:
        """Return the entry of the history for a step, as :class:`OptimalMap` describes it."""
        return {
            "cost": self.energy.cost(terms),
            "energy": self._penalised_energy(terms),
            "ring_rms": self.energy.area_rms(terms),
            "ring_largest": terms.largest,
            "area": terms.shape.area + 2.0,
            "angle": terms.shape.angle + 2.0,
            "decrement": decrement,
            "length": length,
            "corrected": corrected,
            "settled": settled,
        }
