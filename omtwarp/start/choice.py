"""Choice of the start: the conformal map where float64 can represent it, another bijection elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from omtwarp.conformal import ConformalMap, conformal_map
from omtwarp.errors import OmtwarpError
from omtwarp.flips.rings import Examined, examine, is_bijective
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.metrics.distortion import measure_triangles
from omtwarp.options import Progress
from omtwarp.start.tube import tube_map
from omtwarp.untangling.untangle import RepairBudget, untangle

# Unit vectors in float64 are known to about 1e-16, and so are triple products of them: below this area, in steradians,
# a triangle's orientation depends on rounding.
SMALLEST_AREA = 1e-15
# More flips than this share of the faces are no local defect: parts of the surface are folded, and points lie where
# they mean little. On an ellipsoid of 3,920 long triangles, 8 times as long as wide, 42 % are flipped, and maps ended
# 94 % above the bound on the cost, at an area distortion of 2.08; from the positions of the intrinsic Delaunay
# triangulation, which flips none, they end 0.002 % above it, at 2.0000. As a start that map is too far away: from it a
# plate 120 times as wide as thick ends at an area distortion of 2.48, from a coarse-to-fine map at 2.002. Drawn parts
# with large flat faces end far above any bound with both: a bracket at 2.0154, from the map of its own triangles at
# 2.0147, which they keep.
REPAIRABLE = 0.02
# Above this area distortion a coarse-to-fine map is compared with the conformal map repaired all over. Of fifteen
# shapes whose conformal maps flip 2 to 50 % of the triangles, prisms with caps of long triangles were at 9.1 to 10.1
# coarse to fine and at 2.1 to 2.5 repaired, and a thin disc at 2.9 and 3.1; all others were below 2.2 coarse to fine.
COARSE_AREA = 2.5
# A tube map without flips is taken where its area distortion is below this. Of seventeen shapes whose conformal map
# float64 cannot represent, the four smooth tubes and needles were at 2.02, against 2.08 to 2.47 coarse to fine; of the
# others one had no flip, at 3.99.
TUBE_AREA = 2.1
# Where the largest triangle has more than this many times the mean area, as on drawn parts with large flat faces, a
# second coarse-to-fine map is made, from a simplification by distance and with this weight of area. The quotient is 254
# and 552 on two drawn parts, at most 89 on scans.
UNEVEN, UNEVEN_AREA_WEIGHT = 100.0, 100.0
# Where the conformal map shrinks more than this share of the triangles to points, most of the map depends on the start:
# it is made thoroughly, and with this weight of area. On scans with 9 and 27 % that changes nothing for the better.
MOSTLY_SHRUNKEN, SHRUNKEN_AREA_WEIGHT = 0.4, 30.0
# Repair of a conformal map may take this share of the usual work there: needles hold its flips.
UNEVEN_REPAIR = 0.1


@dataclass(frozen=True)
class Start:
    """A flip-free map to start from.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        route: ``conformal``, ``conformal, repaired``, ``tube`` or ``hierarchical``.
        reason: why the conformal map was not taken, or empty.
        conformal: the conformal map, before repair; None if it could not be computed.
        repaired_flips: flips of the conformal map that were repaired.
        repair_given_up: whether repair of the conformal map was given up, as it had taken the work that it may take.
    """

    sphere: NDArray[np.float64]
    route: str
    reason: str
    conformal: ConformalMap | None
    repaired_flips: int
    repair_given_up: bool = False


def bijective_start(
    surface: Surface,
    *,
    drawn_out_map: Callable[[NDArray[np.float64]], NDArray[np.float64] | None] | None = None,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> Start:
    """Find a map to the sphere without flips.

    The conformal map (section 4.1) is tried first, with its flips repaired. Where it folds parts of the surface, as on
    long triangles, that of the intrinsic Delaunay triangulation says where points lie, but is no start. On long thin
    limbs conformal maps shrink areas exponentially, below what float64 resolves. Then latitude by area and harmonic
    longitude are tried, which suit long smooth tubes, and if that map has flips or does not keep area, a coarse-to-fine
    embedding, which always exists.

    Args:
        surface: a valid closed mesh.
        drawn_out_map: returns a flip-free map in place of the coarse-to-fine one, or None, from the conformal map of a
            surface most of whose triangles that shrinks to points.
        device: where kernels run.
        progress: called with a stage name, done, total and details.

    Raises:
        OmtwarpError: no start was found; even the coarse-to-fine embedding failed.
    """
    mesh = surface.on(device)
    uneven = is_uneven(surface)
    budget = RepairBudget(surface, UNEVEN_REPAIR if uneven else 1.0)
    found = _positions(surface, uneven, device, progress)
    conformal, examined, reason = found.conformal, found.examined, found.defect
    usable = None if reason else conformal
    if found.folded:
        reason = (
            f"the conformal map flips {found.folded} of {surface.face_count} triangles; "
            "points come from that of the intrinsic Delaunay triangulation"
        )
    elif usable is not None and examined is not None:
        if examined.bijective:
            return Start(usable.sphere, "conformal", "", usable, 0)
        reason = f"the conformal map flips {examined.flips} of {surface.face_count} triangles"
        if not found.many:
            repaired = untangle(surface, usable.sphere, budget=budget, device=device)
            if repaired.bijective:
                return Start(repaired.sphere, "conformal, repaired", "", usable, examined.flips)
            reason += f", and {repaired.flips_after} could not be repaired"

    def area(sphere: NDArray[np.float64]) -> float:
        return measure_triangles(mesh.vertices, mesh.faces, sphere, device=device).area["surface"]

    sphere = tube_map(surface)
    if is_bijective(sphere, mesh.faces, device=device) and area(sphere) < TUBE_AREA:
        return Start(sphere, "tube", reason, conformal, 0, budget.exhausted)
    drawn_out = conformal is not None and mostly_shrunken(surface, conformal.sphere)
    made = _made_from(conformal, drawn_out_map) if drawn_out else None
    if made is not None:
        return Start(made, "hierarchical", reason, conformal, 0, budget.exhausted)
    sphere, coarse_area = _coarse_to_fine(surface, uneven, drawn_out, area, device, progress)
    if usable is not None and found.many and coarse_area > COARSE_AREA:
        repaired = untangle(surface, usable.sphere, device=device)
        if repaired.bijective and area(repaired.sphere) < coarse_area:
            return Start(repaired.sphere, "conformal, repaired", "", usable, repaired.flips_before)
    return Start(sphere, "hierarchical", reason, conformal, 0, budget.exhausted)


@dataclass(frozen=True)
class _Positions:
    """Where a conformal map takes the vertices.

    Attributes:
        conformal: the map; None if it could not be computed.
        examined: that of the mesh's own triangles, examined; None without one.
        many: whether that flips more triangles than are repaired.
        folded: triangles flipped by that where ``conformal`` is of the intrinsic Delaunay triangulation; otherwise 0.
        defect: why ``conformal`` is no start even if its flips are repaired; empty where it may be one.
    """

    conformal: ConformalMap | None = None
    examined: Examined | None = None
    many: bool = False
    folded: int = 0
    defect: str = ""


def _positions(surface: Surface, uneven: bool, device: str | None, progress: Progress | None) -> _Positions:
    """Compute the conformal map, or that of the intrinsic Delaunay triangulation where the mesh's own is folded."""
    found = _Positions()
    try:
        conformal = conformal_map(surface, device=device, progress=progress)
        examined = examine(conformal.sphere, surface.on(device).faces, device=device)
        many = examined.flips > REPAIRABLE * surface.face_count
        folded = _folded(surface, conformal.sphere, examined) if many and not uneven else 0
        found = _Positions(conformal, examined, many)
        if folded:
            conformal = conformal_map(surface, intrinsic=True, device=device)  # progress is at its end
        return _Positions(conformal, examined, many, folded, _defect(surface, conformal.sphere))
    except OmtwarpError as error:
        return replace(found, defect=str(error))


def _made_from(
    conformal: ConformalMap | None, make: Callable[[NDArray[np.float64]], NDArray[np.float64] | None] | None
) -> NDArray[np.float64] | None:
    """Return the map that is made from a conformal map; None without a way or a map."""
    return None if conformal is None or make is None else make(conformal.sphere)


def _coarse_to_fine(
    surface: Surface,
    uneven: bool,
    drawn_out: bool,
    area: Callable[[NDArray[np.float64]], float],
    device: str | None,
    progress: Progress | None,
) -> tuple[NDArray[np.float64], float]:
    """Return a coarse-to-fine map and its area distortion: on uneven surfaces the better one of two."""
    from omtwarp.start.hierarchical import hierarchical_embedding  # its kernels are read for few surfaces

    embed = partial(hierarchical_embedding, surface, device=device, progress=progress)
    sphere = (embed(area_weight=SHRUNKEN_AREA_WEIGHT, thorough=True) if drawn_out else embed()).sphere
    if not is_bijective(sphere, surface.faces, device=device):
        raise OmtwarpError("no start was found: the coarse-to-fine embedding covers the sphere more than once")
    least = area(sphere)
    if not uneven:
        return sphere, least
    try:
        other = embed(area_weight=UNEVEN_AREA_WEIGHT, by_distance=True).sphere
    except OmtwarpError:
        return sphere, least  # only the second could not be made
    other_area = area(other)
    if other_area < least and is_bijective(other, surface.faces, device=device):
        return other, other_area
    return sphere, least


def is_uneven(surface: Surface) -> bool:
    """Return whether the triangles of a surface differ in area by orders of magnitude, as those of drawn parts do."""
    return bool(surface.face_areas.max() > UNEVEN * surface.face_areas.mean())


def shrunken_triangles(surface: Surface, sphere: NDArray[np.float64]) -> int:
    """Count the triangles that a map shrinks so far that rounding decides their orientation; shape [V, 3]."""
    return int((triangle_areas(sphere, surface.faces) < SMALLEST_AREA).sum())


def mostly_shrunken(surface: Surface, sphere: NDArray[np.float64]) -> bool:
    """Return whether a map shrinks so many triangles to points that it says little of the surface; shape [V, 3]."""
    return shrunken_triangles(surface, sphere) > MOSTLY_SHRUNKEN * surface.face_count


def _folded(surface: Surface, sphere: NDArray[np.float64], examined: Examined) -> int:
    """Return how many triangles a conformal map flips, if so many that it folds parts of the surface; 0 otherwise.

    Triangles that it shrinks to points do not count: their orientation says nothing.
    """
    large = triangle_areas(sphere, surface.faces) >= SMALLEST_AREA
    folded = int((large & (examined.signs <= 0)).sum())
    return folded if folded > REPAIRABLE * surface.face_count else 0


def _defect(surface: Surface, sphere: NDArray[np.float64]) -> str:
    """Say why a conformal map cannot be used; empty where it can."""
    if not np.isfinite(sphere).all():
        return "the conformal map is not finite"
    small = shrunken_triangles(surface, sphere)
    if small:
        return f"the conformal map shrinks {small} triangles below an area of {SMALLEST_AREA:g} on the unit sphere"
    return ""
