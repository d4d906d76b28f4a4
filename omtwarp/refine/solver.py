"""Minimise the distortion of a sphere map without ever flipping a triangle.

A projected Newton method. The Hessian of every triangle is made positive semidefinite in closed form, the sparse system
is factorised, and between factorisations limited-memory BFGS corrects the last one (:mod:`omtwarp.refine.steps`). The
few triangles that a step flips are untangled after the step, so that the whole map keeps its step; where that fails,
the corners of these triangles are held back, and finally the step is shortened.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.mesh.surface import Surface
from omtwarp.options import Progress, Record
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.relaxation import relax, stiff_vertices
from omtwarp.refine.steps import Direction, Steps
from omtwarp.refine.vertex_term import VertexTerm
from omtwarp.solvers.triangle_newton.line_search import SUFFICIENT_DECREASE
from omtwarp.untangling.steps import FlipFreeSteps
from omtwarp.untangling.untangle import RepairBudget

MAX_HALVINGS = 25  # of the whole step, in a line search
# After a shortened step the next is at most so many times as long: longer ones were tried just before, in vain.
LENGTH_GROWTH = 4.0
MAX_HALVINGS_CORRECTED = 2  # of a step with an older matrix: after that a new matrix gains more
MAX_REPAIR_TRIALS = 3  # step lengths that are tried with repair of the triangles they flip
MIN_CURVATURE_SHARE = 0.03  # of the curvature of D, see omtwarp.refine.kernels.triangle_hessian
MAX_TRUSTED_REPAIRS = 0.01  # of the vertices: a step after which fewer are repaired counts as a full step
# Of the vertices: near the minimum the matrix is used again after fewer took steps of their own. If any such step
# renews it, scans of 7,000 to 35,000 vertices take 11 to 20 factorisations in place of 7 to 13. Used again from the
# beginning, it lets noise of 1e-12 move a vertex of a skull's map by 0.1 radians, in place of 5e-6.
MAX_TRUSTED_RELAXED = 0.06
MIN_GAIN_SHARE = 0.15  # of the gain of the last new matrix: where a corrected step gains less, the matrix is renewed

# With a small weight of area, the energy of a nearly conformal map is a few hundredths above its least value, and an
# absolute tolerance would leave a tenth of that. Above an energy of 0.2, where all named weights are, the absolute
# tolerance decides.
RELATIVE_TOLERANCE = 0.01

# Share of the gain that the quadratic model promised: above the first, more of the matrix's negative curvature is
# kept, and below the second less (Nocedal & Wright, Numerical Optimization, algorithm 4.1, has 3/4 and 1/4).
TRUSTED, DISTRUSTED = 0.75, 0.5


@dataclass(frozen=True)
class RefineResult:
    """A refined map.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3]; no triangle is flipped.
        weight: λ, the weight of area against angle that was minimised.
        history: one record per iteration: ``energy`` (angle + λ area, less 2 + 2λ), ``area`` and ``angle`` (means
            weighted by original area), ``decrement``, ``length`` of the step, vertices ``corrected`` (untangled after
            the step, or held back), vertices ``relaxed`` by steps of their own after it, whether the matrix was
            ``factorised``. The first record is the start.
        converged: whether the tolerance was reached.
        factorisations: how many sparse matrices were factorised.
    """

    sphere: NDArray[np.float64]
    weight: float
    history: list[Record] = field(default_factory=list)
    converged: bool = False
    factorisations: int = 0


@dataclass(frozen=True)
class _Iterate:
    """A map with its energy and the derivative of it."""

    points: wp.array[wp.vec3d]
    terms: Terms
    gradient: wp.array[wp.vec3d]


@dataclass(frozen=True)
class _Step:
    """A step that lowers the energy: where it leads, its length, and how many vertices it repaired or held back."""

    points: wp.array[wp.vec3d]
    terms: Terms
    length: float
    corrected: int


class _MatrixPolicy:
    """Decides when the matrix is factorised again, and which share of the curvature of D it keeps.

    Attributes:
        curvature_share: of the curvature of D that is in the next matrix, MIN_CURVATURE_SHARE to 1.
        renew: whether the next step wants a new matrix; otherwise L-BFGS corrects the last one.
        factorisations: how many matrices were factorised.
    """

    def __init__(self, vertex_count: int) -> None:
        self.curvature_share, self.renew, self.factorisations = 1.0, True, 0
        self._trusted_repairs = MAX_TRUSTED_REPAIRS * vertex_count
        self._trusted_relaxed = MAX_TRUSTED_RELAXED * vertex_count
        self._last_gain = 0.0  # of a step with a new matrix

    @property
    def halvings(self) -> int:
        """How often a line search may halve its step."""
        return MAX_HALVINGS if self.renew else MAX_HALVINGS_CORRECTED

    def is_exhausted(self) -> bool:
        """Return, after a failed search, whether no better matrix is left to try; if one is, the next step uses it."""
        if self.renew and self.curvature_share == 1.0:
            return True
        if self.renew:
            self.curvature_share = 1.0
        self.renew = True
        return False

    def judge(self, step: _Step, gain: float, decrement: float, relaxed: int) -> None:
        """Choose the next matrix by the gain of a step relative to the quadratic model's, half the decrement."""
        fresh, trust = self.renew, 2.0 * gain / decrement
        if fresh:
            if step.length == 1.0 and step.corrected <= self._trusted_repairs and TRUSTED < trust:
                self.curvature_share = max(self.curvature_share / 3.0, MIN_CURVATURE_SHARE)
            elif step.length < 1.0 or trust < DISTRUSTED:
                self.curvature_share = min(1.0, 3.0 * self.curvature_share)
            self._last_gain = gain
        too_little = gain < MIN_GAIN_SHARE * self._last_gain
        near = self.curvature_share == MIN_CURVATURE_SHARE
        outdated = step.corrected > 0 or relaxed > (self._trusted_relaxed if near else 0)
        self.renew = outdated or too_little or (fresh and step.length < 1.0)


class Refiner:
    """Minimises the distortion of maps of one surface; keeps what does not depend on the map or on λ.

    Args:
        surface: the original surface.
        device: a Warp device.
        areas, most_strain, vertex_term: as of :class:`omtwarp.refine.energy.DistortionEnergy`.
    """

    def __init__(
        self,
        surface: Surface,
        device: wp.Device,
        areas: NDArray[np.float64] | None = None,
        *,
        most_strain: float | None = None,
        vertex_term: VertexTerm | None = None,
    ):
        self.surface = surface
        self.device = device
        self.energy = DistortionEnergy(surface, device, areas, most_strain=most_strain, vertex_term=vertex_term)
        self._steps = Steps(self.energy)
        # Half untangled patches made noise of 3e-9 in a bunny's map one of 4e-4. The optimal map of an octopus needs
        # them: without, its area distortion is 2.096 in place of 2.032.
        self._flip_free = FlipFreeSteps(surface, device, partial=False)

    @property
    def budget(self) -> RepairBudget:
        """The remaining budget for untangling after steps."""
        return self._flip_free.budget

    @blas_threads(1)
    def minimise(
        self,
        sphere: NDArray[np.float64],
        weight: float,
        *,
        iterations: int,
        tolerance: float,
        progress: Progress | None = None,
    ) -> RefineResult:
        """Minimise angle + λ area, and what else is in the energy, from a flip-free map, shape [V, 3]."""
        matrix = _MatrixPolicy(self.surface.vertex_count)
        points = self.energy.upload(sphere)
        now = self._at(points, self.energy.terms(points), weight)
        history = [_record(now.terms, weight, 0.0, 0.0, 0, 0, False)]
        self._steps.assemble(now.points, now.terms, weight, matrix.curvature_share)
        now, relaxed = self._relaxed(now, weight, matrix.curvature_share, now.terms.total(weight), tolerance)
        assembled = relaxed == 0
        ended, longest = False, 1.0
        for step in range(iterations):
            if matrix.renew:
                if not assembled:
                    self._steps.assemble(now.points, now.terms, weight, matrix.curvature_share)
                assembled = False
                self._steps.factorise()
                matrix.factorisations += 1
            direction = self._steps.direction(now.points, now.gradient)
            decrement = -direction.slope
            found = self._search(now, direction, weight, matrix.halvings, longest) if decrement > 0.0 else None
            if found is None:
                if matrix.is_exhausted():
                    break
                continue
            before, fresh = now, matrix.renew
            longest = min(1.0, LENGTH_GROWTH * found.length)
            now = self._at(found.points, found.terms, weight)
            gain = before.terms.total(weight) - now.terms.total(weight)
            self._steps.update(before.points, before.gradient, now.points, now.gradient)
            enough = min(tolerance, RELATIVE_TOLERANCE * now.terms.total(weight))
            ended = decrement < 2.0 * enough and found.length >= (0.5 if fresh else 1.0)
            if not ended:
                now, relaxed = self._relaxed(now, weight, matrix.curvature_share, decrement, enough)
            history.append(_record(now.terms, weight, decrement, found.length, found.corrected, relaxed, fresh))
            if progress is not None:
                details = {"area": now.terms.area + 2.0, "angle": now.terms.angle + 2.0}
                progress("refine", step + 1, iterations, details)
            if ended:
                break
            matrix.judge(found, gain, decrement, relaxed)
        return RefineResult(now.points.numpy().copy(), weight, history, ended, matrix.factorisations)

    def _at(self, points: wp.array[wp.vec3d], terms: Terms, weight: float) -> _Iterate:
        return _Iterate(points, terms, self.energy.gradient(points, terms, weight))

    def _relaxed(
        self, now: _Iterate, weight: float, curvature_share: float, gain: float, tolerance: float
    ) -> tuple[_Iterate, int]:
        """Give the stiffest vertices steps of their own; return the map and the number of these vertices.

        ``gain`` is what the other steps are expected to gain, at the most. The kernel that moves them knows no terms
        but the distortion: with others all vertices take the steps of the whole map.
        """
        if self.energy.extended:
            return now, 0
        decrements = self._steps.decrements(now.gradient)
        if decrements.sum() > tolerance:
            stiff = stiff_vertices(decrements, gain)
            moved = relax(self.energy, now.points, now.terms, weight, curvature_share, stiff)
            if moved is not None:
                points, terms, count = moved
                return self._at(points, terms, weight), count
        return now, 0

    def _search(
        self, now: _Iterate, direction: Direction, weight: float, halvings: int, longest: float
    ) -> _Step | None:
        """Search along the direction for a step that lowers the energy and flips nothing; None where there is none."""
        points, d_volume, before = now.points, now.terms.d_volume, now.terms.total(weight)
        length = min(longest, 1.0 / max(1.0, 2.0 * direction.reach))  # no vertex may swing farther than half a radian
        for attempt in range(halvings):
            if attempt < MAX_REPAIR_TRIALS:
                untangled = self._flip_free.untangled(points, direction.vectors, d_volume, length, weight)
                if untangled is not None:
                    moved, corrected = untangled
                    after = self.energy.terms(moved)
                    if after.total(weight) <= before + SUFFICIENT_DECREASE * length * direction.slope:
                        return _Step(moved, after, length, corrected)
            held = self._flip_free.held_back(points, direction.vectors, d_volume, length)
            if held is not None:
                moved, share = held
                slope = length * direction.slope_of(share)
                after = self.energy.terms(moved)
                if slope < 0.0 and after.total(weight) <= before + SUFFICIENT_DECREASE * slope:
                    return _Step(moved, after, length, int((share.numpy() < 1.0).sum()))
            length *= 0.5
        return None


def _record(
    terms: Terms, weight: float, decrement: float, length: float, corrected: int, relaxed: int, fresh: bool
) -> Record:
    return {
        "energy": terms.total(weight),
        "area": terms.area + 2.0,
        "angle": terms.angle + 2.0,
        "decrement": decrement,
        "length": length,
        "corrected": corrected,
        "relaxed": relaxed,
        "factorised": fresh,
    }
