"""The first map of a surface: its conformal map, repaired, or a coarse-to-fine embedding where float64 has none."""

from __future__ import annotations

from dataclasses import dataclass

from omtwarp.conformal import conformal_map
from omtwarp.conformal.maps import covers_once, harmonic_points
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import examine, is_bijective
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.options import Progress
from omtwarp.untangling.untangle import RepairBudget, untangle

# Unit vectors in float64 are known to about 1e-16, and so are triple products of them: below this area, in steradians,
# a triangle's orientation depends on rounding.
SMALLEST_AREA = 1e-15


@dataclass(frozen=True)
class Start:
    """A flip-free map to start from, and the points that transport is measured from.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        route: ``conformal``, ``conformal, repaired`` or ``hierarchical``; ``given`` in place of ``conformal`` for
            points that the user gave.
        reason: why the conformal map was not taken, or its points are not harmonic; or empty.
        points: those of the conformal map before repair, shape [V, 3]; None if it could not be computed.
        repaired_flips: flips of the conformal map that were repaired.
        repair_given_up: whether repair of the conformal map was given up, as it had taken the work that it may take.
    """

    sphere: Floats
    route: str
    reason: str
    points: Floats | None
    repaired_flips: int
    repair_given_up: bool = False


def bijective_start(
    surface: Surface,
    *,
    published: bool = False,
    given: Floats | None = None,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> Start:
    """Find a map to the sphere without flips.

    The conformal map is tried first, with its flips repaired. On long thin limbs conformal maps shrink areas
    exponentially, below what float64 resolves; the map is then a coarse-to-fine embedding, which always exists. From
    there the harmonic points are found, too, where section 4.1's map is not of degree 1.

    Args:
        surface: a valid closed mesh.
        published: take section 4.1's map as the paper has it, in place of the discrete harmonic map.
        given: points of the user's in place of either, unit vectors, shape [V, 3]; triangles may be flipped there.
        device: where kernels run.
        progress: called with a stage name, done, total and details.

    Raises:
        OmtwarpError: no start was found; even the coarse-to-fine embedding failed.
    """
    budget, name = RepairBudget(surface), "conformal" if given is None else "given"
    reason, embedding = "", None
    try:
        if given is not None:
            points = given
        elif published:
            points = conformal_map(surface, device=device, progress=progress).sphere
        else:
            points, reason, embedding = _harmonic(surface, device, progress)
    except OmtwarpError as error:
        return Start(_embedded(surface, device, progress), "hierarchical", str(error), None, 0)
    if embedding is not None:
        return Start(embedding, "hierarchical", reason, points, 0)
    small = int((triangle_areas(points, surface.faces) < SMALLEST_AREA).sum())  # rounding decides how they turn
    if small:
        why = f"the {name} map shrinks {small} triangles below an area of {SMALLEST_AREA:g} on the unit sphere"
    else:
        examined = examine(points, surface.on(device).faces, device=device)
        if examined.bijective:
            return Start(points, name, reason, points, 0)
        repaired = untangle(surface, points, keep_scale=True, budget=budget, device=device)
        if repaired.bijective:
            return Start(repaired.sphere, f"{name}, repaired", reason, points, examined.flips)
        why = (
            f"the {name} map flips {examined.flips} of {surface.face_count} triangles, and {repaired.flips_after} "
            "could not be repaired"
        )
    reasons, embedding = "; ".join(filter(None, [reason, why])), _embedded(surface, device, progress)
    return Start(embedding, "hierarchical", reasons, points, 0, budget.exhausted)


def _harmonic(surface: Surface, device: str | None, progress: Progress | None) -> tuple[Floats, str, Floats | None]:
    """Return the harmonic points, or the best in their place with the reason, and the embedding if it was needed.

    Raises:
        OmtwarpError: the mesh cannot be mapped.
    """
    found = harmonic_points(surface, device=device, progress=progress)
    if not found.collapsed:
        return found.sphere, "", None
    if covers_once(found.sphere, surface.faces):
        return found.sphere, "the harmonic map collapses, and section 4.1's is taken", None
    embedding = _embedded(surface, device, progress)
    found = harmonic_points(surface, start=embedding, device=device, progress=progress)
    instead = "the coarse-to-fine embedding" if found.collapsed else "a harmonic map made from an embedding"
    return found.sphere, f"section 4.1's map does not cover the sphere once, and {instead} is taken", embedding


def _embedded(surface: Surface, device: str | None, progress: Progress | None) -> Floats:
    """Return the coarse-to-fine embedding of a surface.

    Raises:
        OmtwarpError: there is none in float64.
    """
    from omtwarp.start.hierarchical import hierarchical_embedding  # its kernels are read for few surfaces

    sphere = hierarchical_embedding(surface, device=device, progress=progress).sphere
    if not is_bijective(sphere, surface.faces, device=device):
        raise OmtwarpError("no start was found: the coarse-to-fine embedding covers the sphere more than once")
    return sphere
