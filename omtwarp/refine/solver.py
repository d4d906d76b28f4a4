"""Minimise the distortion of a sphere map without ever flipping a triangle.

A projected Newton method. The Hessian of every triangle is made positive semidefinite in closed form, the sparse system
is factorised, and between factorisations limited-memory BFGS corrects the last one (:mod:`omtwarp.refine.steps`). The
few triangles that a step flips are untangled where they have moved to, so that the whole map keeps its step; where that
fails, the corners of the triangles in trouble are held back, and last of all the step is shortened.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.mesh.surface import Surface
from omtwarp.options import Progress
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.relaxation import relax, stiff_vertices
from omtwarp.refine.steps import Direction, steps_for
from omtwarp.triangle_newton.line_search import SUFFICIENT_DECREASE
from omtwarp.untangling.steps import FlipFreeSteps
from omtwarp.untangling.untangle import RepairBudget

MAX_HALVINGS = 25  # of the whole step, in a line search
MAX_HALVINGS_CORRECTED = 2  # of a step with an older matrix: after that a new matrix gains more
MAX_REPAIR_TRIALS = 3  # step lengths that are tried with repair of the triangles they flip
MIN_CURVATURE_SHARE = 0.03  # of the curvature of D, see omtwarp.refine.kernels.triangle_hessian
MAX_TRUSTED_REPAIRS = 0.01  # of the vertices: a step after which fewer are repaired counts as a full step
MIN_GAIN_SHARE = 0.15  # of the gain of the last new matrix: where a corrected step gains less, the matrix is renewed

# With a small weight of area, angle + λ area of a nearly conformal map is a few hundredths above its least value, of
# which an absolute tolerance would leave a tenth. Above an energy of 0.2, where all named weights are, it decides.
RELATIVE_TOLERANCE = 0.01


@dataclass(frozen=True)
class RefineResult:
    """A refined map.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3]; no triangle is flipped.
        weight: λ, the weight of area against angle that was minimised.
        history: one record per iteration: ``energy`` (angle + λ area, less 2 + 2λ), ``area`` and ``angle`` (means
            weighted by original area), ``decrement``, ``length`` of the step, vertices ``mended`` (untangled after
            the step, or held back), vertices ``relaxed`` by steps of their own after it, whether the matrix was
            ``factorised``. The first record is the start.
        converged: whether the tolerance was reached.
        factorisations: how many sparse matrices were factorised.
    """

    sphere: NDArray[np.float64]
    weight: float
    history: list[dict[str, Any]] = field(default_factory=list)
    converged: bool = False
    factorisations: int = 0


class Refiner:
    """Minimises the distortion of maps of one surface; keeps what does not depend on the map or on λ.

    Args:
        surface: the original surface.
        device: a Warp device.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self.surface = surface
        self.device = device
        self.energy = DistortionEnergy(surface, device)
        self._steps = steps_for(self.energy)
        self._flip_free = FlipFreeSteps(surface, device)

    @property
    def budget(self) -> RepairBudget:
        """How much more may be untangled after steps."""
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
        """Minimise angle + λ area from a flip-free map, shape [V, 3]."""
        energy = self.energy
        points = energy.upload(sphere)
        terms = energy.terms(points)
        gradient = energy.gradient(points, terms, weight)
        history = [_record(terms, weight, 0.0, 0.0, 0, 0, False)]
        factorisations, ended = 0, False
        curvature_share, renew = 1.0, True
        last_gain = 0.0
        self._steps.assemble(points, terms, weight, curvature_share)
        gain = terms.total(weight)  # at most
        points, terms, gradient, relaxed = self._relaxed(
            points, terms, gradient, weight, curvature_share, gain, tolerance
        )
        for step in range(iterations):
            if renew:
                if step > 0 or relaxed:
                    self._steps.assemble(points, terms, weight, curvature_share)
                self._steps.factorise()
                factorisations += 1
            direction = self._steps.direction(points, gradient)
            decrement = -direction.slope
            moved = None
            if decrement > 0.0:
                halvings = MAX_HALVINGS if renew else MAX_HALVINGS_CORRECTED
                moved = self._search(points, terms, direction, weight, halvings)
            if moved is None:
                if renew and curvature_share == 1.0:
                    break
                curvature_share = 1.0 if renew else curvature_share
                renew = True
                continue
            fresh = renew
            new_points, new_terms, length, mended = moved
            new_gradient = energy.gradient(new_points, new_terms, weight)
            gain = terms.total(weight) - new_terms.total(weight)
            self._steps.update(points, gradient, new_points, new_gradient)
            points, terms, gradient = new_points, new_terms, new_gradient
            enough = min(tolerance, RELATIVE_TOLERANCE * terms.total(weight))
            ended = decrement < 2.0 * enough and length >= (0.5 if fresh else 1.0)
            if not ended:
                points, terms, gradient, relaxed = self._relaxed(
                    points, terms, gradient, weight, curvature_share, decrement, enough
                )
            history.append(_record(terms, weight, decrement, length, mended, relaxed, fresh))
            if progress is not None:
                progress("refine", step + 1, iterations, {"area": terms.area + 2.0, "angle": terms.angle + 2.0})
            if ended:
                break
            trust = 2.0 * gain / decrement
            if fresh:
                if length == 1.0 and mended <= MAX_TRUSTED_REPAIRS * self.surface.vertex_count and 0.75 < trust:
                    curvature_share = max(curvature_share / 3.0, MIN_CURVATURE_SHARE)
                elif length < 1.0 or trust < 0.5:
                    curvature_share = min(1.0, 3.0 * curvature_share)
            if fresh:
                last_gain = gain
            renew = mended > 0 or relaxed > 0 or gain < MIN_GAIN_SHARE * last_gain or (fresh and length < 1.0)
        return RefineResult(points.numpy().copy(), weight, history, ended, factorisations)

    def _relaxed(
        self, points, terms: Terms, gradient, weight: float, curvature_share: float, gain: float, tolerance: float
    ):
        """Points, terms and gradient after the stiffest vertices have had steps of their own, and how many had."""
        decrements = self._steps.decrements(gradient)
        if decrements.sum() > tolerance:
            moved = relax(self.energy, points, terms, weight, curvature_share, stiff_vertices(decrements, gain))
            if moved is not None:
                points, terms, count = moved
                return points, terms, self.energy.gradient(points, terms, weight), count
        return points, terms, gradient, 0

    def _search(self, points, terms: Terms, direction: Direction, weight: float, halvings: int):
        """A step along the direction that lowers the energy and flips nothing: points, terms, length, vertices held."""
        before = terms.total(weight)
        length = 1.0 / max(1.0, 2.0 * direction.reach)  # no vertex may swing farther than half a radian
        for attempt in range(halvings):
            if attempt < MAX_REPAIR_TRIALS:
                untangled = self._flip_free.untangled(points, direction.vectors, terms.d_volume, length, weight)
                if untangled is not None:
                    moved, mended = untangled
                    after = self.energy.terms(moved)
                    if after.total(weight) <= before + SUFFICIENT_DECREASE * length * direction.slope:
                        return moved, after, length, mended
            held = self._flip_free.held_back(points, direction.vectors, terms.d_volume, length)
            if held is not None:
                moved, share = held
                slope = length * direction.slope_of(share)
                after = self.energy.terms(moved)
                if slope < 0.0 and after.total(weight) <= before + SUFFICIENT_DECREASE * slope:
                    return moved, after, length, int((share.numpy() < 1.0).sum())
            length *= 0.5
        return None


def _record(
    terms: Terms, weight: float, decrement: float, length: float, mended: int, relaxed: int, fresh: bool
) -> dict[str, Any]:
    return {
        "energy": terms.total(weight),
        "area": terms.area + 2.0,
        "angle": terms.angle + 2.0,
        "decrement": decrement,
        "length": length,
        "mended": mended,
        "relaxed": relaxed,
        "factorised": fresh,
    }
