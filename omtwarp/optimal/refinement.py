"""Refinement of the optimal map towards less distortion of shape, with areas around vertices kept.

Up to a weight λ of 10 the energy is the mean angle distortion plus λ times the mean area distortion of the triangles. A
larger λ on triangles would lock the mesh: 2V - 5 areas leave its 2V - 3 coordinates no freedom to be smooth, and it
buckles. The part of λ above 10 is therefore the weight of the areas around vertices, of which there are half as many:

    angle + min(λ, 10) · area + max(λ - 10, 0) · Σ_v m_v (a_v / 3m_v - 1)² / 4π.

On limbs of few vertices a weight of 10 can leave the areas of triangles worse than the optimal map has them. The named
weight ``area``, whose promise is area, then gives them more: 30, 100 or 300. A weight whose map has a
wanted area distortion is found by bisection.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces
from omtwarp.measures import mass_distortion
from omtwarp.mesh.arrays import Floats, InOneLine, real_number, whole_number
from omtwarp.mesh.surface import MeshLike, Surface, as_sphere, as_surface
from omtwarp.optimal.cells import RingCells
from omtwarp.optimal.energy import Shape
from omtwarp.optimal.solver import minimise
from omtwarp.optimal.sphere import ShapeEnergy
from omtwarp.options import AreaMatch, Progress, Record, Refinement, parse_refinement
from omtwarp.solvers.triangle import AREA_WEIGHT

LEAST_WEIGHT, MOST_WEIGHT = 1e-3, 1000.0  # between which the weight is looked for, by bisection of its logarithm
# match:AREA looks for λ until the area distortion is within the tolerance below the one asked for, or for that many
# trials.
MATCH_TOLERANCE, MATCH_TRIALS = 1e-4, 16

Map = TypeVar("Map")


def match_area(
    first: Map,
    area: float,
    refine: Callable[[Map, float], Map],
    area_of: Callable[[Map], float],
    *,
    tolerance: float = MATCH_TOLERANCE,
    trials: int = MATCH_TRIALS,
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
        >>> from omtwarp.optimal.refinement import match_area
        >>> found, weight = match_area(
        ...     2.001, 2.01, lambda _, weight: 2.0 + 1.0 / weight, float, tolerance=1e-4, trials=16
        ... )
        >>> 2.0099 <= found <= 2.01, 100.0 <= weight <= 101.0
        (True, True)
    """
    best = current = first
    reached, weight = area_of(first), MOST_WEIGHT
    low, high = np.log(least), np.log(MOST_WEIGHT)
    for _ in range(trials):
        if not area - tolerance > reached:
            break
        middle = 0.5 * (low + high)
        current = refine(current, float(np.exp(middle)))
        here = area_of(current)
        if here <= area:
            best, reached, weight, high = current, here, float(np.exp(middle)), middle
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


# λ, the weight of area against angle, of each named refinement
WEIGHTS = {Refinement.AREA: 1000.0, Refinement.BALANCED: AREA_WEIGHT, Refinement.ANGLE: 2.0}
# Where ``area`` leaves more than the first times the area distortion above 2 of the map given, as on limbs of few
# vertices, the areas of triangles count more, up to the first of the others that does not. An octopus goes from 2.038
# to 2.26 with 10 and to 2.020 with 100, at six tenths of the angle distortion of the map given; a person from 2.031 to
# 2.052 and, with 30, to 2.017. Areas around vertices are kept as well with all of them.
LOST_AREA, RAISED_WEIGHTS = 1.05, (30.0, 100.0, 300.0)


@dataclass(frozen=True, repr=False)
class RefineResult(InOneLine):
    """A refined map.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3]; no triangle is flipped.
        weight: λ, the weight of area against angle that was minimised.
        history: one record per step, as of :class:`omtwarp.optimal.solver.OptimalMap`; ``energy`` is what is
            minimised, less its least possible value. The first record is the start.
        converged: whether the tolerance was reached.
        factorisations: how many sparse matrices were factorised.
    """

    sphere: Floats
    weight: float
    history: list[Record] = field(default_factory=list)
    converged: bool = False
    factorisations: int = 0


def refinement_weight(weight: str | float | AreaMatch) -> float:
    """Return the weight λ of a refinement that is given as a name or a number.

    Raises:
        OmtwarpError: the weight is neither one of the names nor a positive number.
    """
    parsed = parse_refinement(weight)
    if parsed is None or isinstance(parsed, AreaMatch):
        raise OmtwarpError(f"the refinement '{weight}' has no weight of its own: use area, balanced, angle or a number")
    return WEIGHTS[parsed] if isinstance(parsed, Refinement) else parsed


@blas_threads(1)
def refine_map(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    weight: str | float | AreaMatch = Refinement.AREA,
    own: NDArray[np.bool_] | None = None,
    iterations: int = 200,
    tolerance: float = 2e-3,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> RefineResult:
    """Move the vertices of a flip-free map to a minimum of angle distortion plus λ times area distortion.

    Angle distortion is the mean over triangles, weighted by original area, of s1/s2 + s2/s1, exactly as
    :func:`omtwarp.metrics.distortion.distortion` measures it. Area distortion is that of the triangles up to a weight
    of 10, and beyond that of the rings of triangles around vertices: see :mod:`omtwarp.optimal.refinement`.

    Args:
        surface: the original surface in any form that :func:`omtwarp.map_to_sphere` takes, V vertices.
        sphere: images of its vertices, unit vectors, shape [V, 3], no triangle flipped.
        weight: λ; ``area``, ``balanced`` or ``angle`` for 1000, 10 or 2; or ``match:AREA``, the least λ whose map has
            at most this mean area distortion of triangles, such as ``match:2.02``. With ``area``, more than 10 of λ
            goes to the areas of triangles where they would become worse otherwise. An area that is out of reach with
            areas kept around vertices is matched by a λ of the areas of triangles alone, for which the map may buckle.
        own: the triangles whose area distortion is matched or watched, where others fill holes, shape [F]; all by
            default.
        iterations: largest number of steps.
        tolerance: stop when the expected decrease falls below this and below a hundredth of the difference between the
            energy and its least possible value.
        device: where the kernels run.
        progress: called as ``progress("refine", step, most, details)`` after every step; the details are ``area`` and
            ``angle``, the distortions reached.

    Returns:
        The refined map, the history of its steps, and whether it converged.

    Raises:
        OmtwarpError: the mesh or the map cannot be used, the map has flipped triangles, or the weight is unknown.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> start = omtwarp.conformal_map(surface, device="cpu").sphere
        >>> refined = omtwarp.refine_map(surface, start, weight="balanced", device="cpu")
        >>> refined.converged, refined.weight
        (True, 10.0)
        >>> measured = omtwarp.distortion(surface, refined.sphere, device="cpu")
        >>> measured.flips, measured.area["mean"] < 2.01
        (0, True)
    """
    parsed = parse_refinement(weight)
    iterations = whole_number(iterations, "iterations")
    tolerance = real_number(tolerance, "tolerance", least=0.0)
    surface = as_surface(surface)
    start = np.array(as_sphere(sphere, surface))
    if own is not None:
        mask = np.asarray(own, dtype=object)  # which rows of unequal length are, too
        if mask.shape != (surface.face_count,) or not {*map(type, mask)} <= {bool, np.bool_} or not mask.any():
            raise OmtwarpError(f"own: must be a mask of the {surface.face_count} triangles, true for one or more")
        own = mask.astype(bool)
    flipped = flipped_faces(start, surface.faces)
    if flipped.any():
        first = f"the first is face {np.argmax(flipped)}: untangle it first"
        raise OmtwarpError(f"the map to refine has {flipped.sum()} flipped triangles, {first}")
    minimised = partial(
        least_distortion, surface, iterations=iterations, tolerance=tolerance, device=device, progress=progress
    )
    refinement = _Refinement(lambda points: mass_distortion(surface, points, own)["mean"], tolerance, minimised)
    if isinstance(parsed, AreaMatch):
        return refinement.match(start, parsed.area)
    if parsed is Refinement.AREA:
        return refinement.towards_area(start)
    return refinement.run(start, refinement_weight(weight))


def least_distortion(
    surface: Surface,
    sphere: Floats,
    weight: float,
    *,
    of_rings: float = 0.0,
    shape: Shape | None = None,
    iterations: int,
    tolerance: float,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> RefineResult:
    """Minimise angle distortion plus λ times the area distortion of triangles.

    Args:
        surface: V vertices.
        sphere: a map without flips to begin with, shape [V, 3].
        weight: λ.
        of_rings: the weight of Σ_v m_v (a_v / 3m_v - 1)² / 4π, the areas around vertices.
        shape: what is minimised in place of the distortion of triangles alone.
        iterations, tolerance, device, progress: as of :func:`refine_map`.
    """
    where = resolve_device(device)
    cells = RingCells(surface, where) if of_rings > 0.0 else None
    energy = ShapeEnergy(surface, where, weight, shape=shape, cells=cells)
    # Σ m (a / 3m - 1)² / 4π equals Σ (a - 3m)² / 3m over 12π; the penalty is half of that.
    penalty = 2.0 * of_rings
    least = minimise(energy, sphere, gain=tolerance, iterations=iterations, progress=progress, penalty=penalty)
    return RefineResult(least.sphere, weight + of_rings, list(least.history), least.converged, least.factorisations)


@dataclass(frozen=True)
class _Refinement:
    """Refines maps of one surface at one weight after another.

    Attributes:
        area_of: returns the mean area distortion of the triangles of a map, shape [V, 3].
        tolerance: as of :func:`refine_map`.
        minimised: :func:`least_distortion` of the surface, which takes a map and a weight.
    """

    area_of: Callable[[Floats], float]
    tolerance: float
    minimised: Callable[..., RefineResult]

    def run(self, sphere: Floats, weight: float, of_triangles: float = AREA_WEIGHT) -> RefineResult:
        """Minimise the distortion at a weight, beginning with a flip-free map, shape [V, 3].

        Up to ``of_triangles`` the weight is that of the areas of triangles, the rest that of those around vertices.
        """
        least = min(weight, of_triangles)
        return self.minimised(sphere, least, of_rings=weight - least)

    def towards_area(self, sphere: Floats) -> RefineResult:
        """Refine at the weight of ``area``, with more of it on triangles where their areas would become worse."""
        largest = LOST_AREA * (self.area_of(sphere) - 2.0)
        refined = self.run(sphere, WEIGHTS[Refinement.AREA])
        for of_triangles in RAISED_WEIGHTS:
            if self.area(refined) - 2.0 <= largest:
                break
            refined = self.run(refined.sphere, WEIGHTS[Refinement.AREA], of_triangles)
        return refined

    def match(self, sphere: Floats, area: float) -> RefineResult:
        """Find the weight whose refined map has the wanted area distortion, or the nearest map where none has.

        The nearest map is not converged.
        """
        refine: Callable[[Floats, float], RefineResult] = self.run
        least = LEAST_WEIGHT
        best = refine(sphere, MOST_WEIGHT)
        if self.area(best) > area:
            refine, least = self.minimised, AREA_WEIGHT  # none of the weight on areas around vertices
            best = refine(best.sphere, MOST_WEIGHT)
            if self.area(best) > area:
                return replace(best, converged=False)
        best = match_area(best, area, lambda before, weight: refine(before.sphere, weight), self.area, least=least)[0]
        missed = self.area(best) < area - max(self.tolerance, MATCH_TOLERANCE)  # maps are known to the first
        return replace(best, converged=False) if missed else best

    def area(self, refined: RefineResult) -> float:
        """Return the mean area distortion of the triangles of a refined map."""
        return self.area_of(refined.sphere)
