"""The stages of a finished map, as the report shows them."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from omtwarp.maps.result import MapReport, MapResult, StageReport
from omtwarp.mesh.arrays import Floats, norms
from omtwarp.mesh.surface import triangle_areas
from omtwarp.metrics.distortion import Distortion
from omtwarp.open_surfaces.caps import disk_to_cap
from omtwarp.options import Domain, Record
from omtwarp.render.camera import Camera, camera_axes
from omtwarp.render.films import domain_name, fits_of, placed_on
from omtwarp.render.scene import SurfaceView
from omtwarp.texturing.textured import domains_of

NUMBER, COUNT, TEXT, FLAG = "number", "count", "text", "flag"

REPORT: dict[str, object] = {
    "seconds": NUMBER,
    **dict.fromkeys(("device", "method", "scheme", "cost"), TEXT),
    "versions": {"*": TEXT},
    "mesh": {"faces": COUNT},
    "start": {"route": TEXT, "reason": TEXT},
    "optimality": {"relative_curl": NUMBER, "lower_bound": NUMBER, "gap": NUMBER},
    "stages": [
        dict.fromkeys(("name", "weight", "route"), TEXT)
        | dict.fromkeys(("seconds", "transport_cost"), NUMBER)
        | dict.fromkeys(("iterations", "repaired"), COUNT)
        | {"converged": FLAG}
    ],
}
"""Fields of a report and their kinds; ``*`` is any name, and a list for any number of entries."""

HISTORY: list[object] = [{"iteration": NUMBER, "cost": NUMBER}]


def shown_report(result: MapResult) -> MapReport:
    """Take from a result's report the fields that a page shows."""
    return cast(MapReport, _fitting(result.report, REPORT) or {})


def shown_history(result: MapResult) -> list[Record]:
    """Take from a result's history the iterations whose cost is known."""
    fitting = cast(list[Record], _fitting(result.history, HISTORY) or [])
    return [entry for entry in fitting if "cost" in entry]


def _fitting(value: object, shape: object) -> object:
    """Keep the parts of a value that have the expected types; return None where the value itself does not."""
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return None
        kept = {str(name): _fitting(value[name], shape.get(name, shape.get("*"))) for name in value}
        return {name: entry for name, entry in kept.items() if entry is not None}
    if isinstance(shape, list):
        entries = [_fitting(entry, shape[0]) for entry in value] if isinstance(value, list | tuple) else []
        return [entry for entry in entries if entry is not None]
    if isinstance(value, bool):
        return value if shape == FLAG else None
    if shape == TEXT and isinstance(value, str | int | float):
        # Longest: characters of a text that is shown
        return str(value)[:2000]
    # Largest, of a number that is shown: sums and squares of roots of more would overflow
    if shape in (NUMBER, COUNT) and isinstance(value, int | float) and abs(value) <= 1e300 and math.isfinite(value):
        return int(value) if shape == COUNT else float(value)
    return None


# Attribute of the result, name of its record in the report, label, and the colours on light and dark paper.
KNOWN = (
    ("conformal", "conformal", "Conformal", "--before"),
    ("moser", "moser", "Moser", "--between"),
    ("transported", "omt", "Optimal transport", "--transport"),
    ("sphere", "refine", "Refined", "--after"),
)
# Labels of the first map by the route that led to it (see :mod:`omtwarp.start.choice`) or by its method.
ROUTES = {
    "conformal": "Conformal",
    "conformal, repaired": "Conformal",
    "hierarchical": "Coarse-to-fine",
    "tutte": "Tutte",
    "mean-value": "Mean value",
}
TORUS = "torus"  # the domain of the stages of a map to a torus
# Domains that a map to the hemisphere is carried to at the end.
OF_HEMISPHERES = (Domain.DISK, Domain.CAP)


@dataclass(frozen=True, eq=False)
class Stage:
    """The map of a stage, and its measures.

    Attributes:
        key: name of the stage's record in the report.
        label: name for readers.
        colour: CSS variable that the stage is drawn in.
        sphere: unit vectors, float64, shape [V, 3]; or the points of a ring torus, in its unit.
        distortion: of this map.
        record: the stage's entry of ``report["stages"]``, empty if there is none.
        weights: the part of the surface that every triangle is, float64, shape [F], sum 1.
        domain: what the surface is mapped to, in words: ``hemisphere``, ``spheres``.
        number: the domain of every triangle, shape [F]: zeros, but with parts that have one each.
        disk: places on the disk, shape [V, 2], where it is the domain; ``sphere`` is then Lambert's projection of them.
    """

    key: str
    label: str
    colour: str
    sphere: Floats
    distortion: Distortion
    record: StageReport
    weights: Floats
    domain: str
    number: NDArray[np.intp]
    disk: Floats | None = None

    @property
    def count(self) -> int:
        """The number of domains, each for a part of the surface."""
        return int(self.number.max(initial=0)) + 1


def stages_of(result: MapResult) -> list[Stage]:
    """Return the stages of a :class:`~omtwarp.MapResult` in order, each map once; the last is the final map."""
    report = shown_report(result)
    records = {record.get("name"): record for record in report.get("stages", ())}
    route = report.get("start", {}).get("route", "conformal")
    areas = triangle_areas(result.vertices / _extent(result), result.faces)
    weights = areas / areas.sum()
    number, last = domains_of(result, len(result.faces)), domain_name(result)
    carried = getattr(result, "cap_centres", None) is not None or getattr(result, "domain", "sphere") in OF_HEMISPHERES
    part = getattr(result, "part", None)
    apart = number if part is None else np.unique(part, return_inverse=True)[1]
    plural = "s" if apart.any() else ""
    before = "hemisphere" + plural if carried else last
    stages: list[Stage] = []
    for attribute, key, label, colour in KNOWN:
        sphere = getattr(result, attribute, None)
        if sphere is None or any(np.array_equal(sphere, stage.sphere) for stage in stages):
            continue
        domain, own = before, apart
        if attribute == "conformal":
            label = ROUTES.get(route, str(route).capitalize())
        elif attribute == "sphere" and carried and last != before and not last.startswith("disk"):
            key, label, domain, own = "cap", "Caps" if plural else "Cap", last, number
        record = records.get(key) or (records.get(route, {}) if attribute == "conformal" else {})
        stages.append(Stage(key, label, colour, sphere, result.distortion(attribute), record, weights, domain, own))
    disk = getattr(result, "disk", None)
    if disk is not None:
        lifted = disk_to_cap(disk / np.maximum(1.0, norms(disk))[:, None], 0.5)
        measured, record = result.distortion("disk"), records.get("disk", {})
        stages.append(Stage("disk", "Disk", "--flat", lifted, measured, record, weights, "disk" + plural, number, disk))
    return stages


def view_on_domain(result: MapResult, stage: Stage, pose: SurfaceView) -> SurfaceView:
    """Return the triangles where a stage's map has them; where parts have a domain each, none hides another.

    Args:
        result: the map.
        stage: of it.
        pose: the surface's axes, which several domains have too.
    """
    points = stage.sphere if stage.disk is None else np.column_stack([stage.disk, np.zeros(len(stage.disk))])
    if stage.count == 1:
        up, front = ("z", "+x") if stage.disk is None else ("y", "+z")
        return SurfaceView(points, result.faces, up=up, front=front)
    axes = camera_axes(Camera(), pose.up or "y", pose.front)
    surface, kind = result.vertices / _extent(result), stage.domain.rstrip("s")
    fits = fits_of(surface, points, result.faces, stage.number, kind, axes)
    return SurfaceView(placed_on(points, result.faces, stage.number, *fits), result.faces, up=pose.up, front=pose.front)


def _extent(result: MapResult) -> float:
    """Return the largest coordinate of a surface: in its unit, squares stay in range."""
    return max(float(np.abs(result.vertices).max()), np.finfo(float).tiny)
