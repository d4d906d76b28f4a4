"""The facts about a finished map, as JSON and as a line for readers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, cast

from omtwarp.options import Domain

if TYPE_CHECKING:
    from omtwarp.maps.result import MapReport, MapResult
    from omtwarp.maps.torus_map import TorusMap


class MapFacts(TypedDict):
    """A finished map, its files and its figures, ready for JSON.

    ``degree`` is of the whole map: the total signed solid angle over 4π, so that parts with a sphere each are added up.
    ``degree_of_parts`` has one for each of these parts, in their order, and is None for all other maps. Of a disk, a
    degree is the signed area over the unsigned one.
    """

    output: str
    report: str | None
    vertices: int
    faces: int
    copied_vertices: int
    new_vertices: int
    input_faces: int
    bijective: bool
    flips: int
    degree: float
    degree_of_parts: list[float] | None
    domain: str
    area: float
    angle: float
    largest_area_error: float | None
    gap: float | None
    seconds: float


def facts_of(result: MapResult | TorusMap, output: Path, report: Path | None = None) -> MapFacts:
    """Sum up a finished map and where it was written, ready for JSON."""
    stages, certificate = result.report["stages"], result.certificate
    last = stages[-1]
    # Of parts mapped each by itself, the figure of the part that has the largest is told.
    whole = cast("MapReport", result.report)
    parts = whole.get("parts", [])
    reports = [whole, *parts]
    errors = [
        stage["largest_area_error"] for each in reports for stage in each["stages"] if "largest_area_error" in stage
    ]
    apart = getattr(result, "cap_centres", None) is None  # not side by side on one sphere
    gaps = [each.get("optimality", {}).get("gap") for each in reports]  # the bound is on squared distances only
    return {
        "output": str(output),
        "report": None if report is None else str(report),
        "vertices": len(result.vertices),
        "faces": len(result.faces),
        **_counts(result),
        "bijective": certificate.bijective,
        "flips": certificate.flips,
        "degree": last["degree"],
        "degree_of_parts": [part["stages"][-1]["degree"] for part in parts] if parts and apart else None,
        "domain": str(getattr(result, "domain", Domain.SPHERE)),
        "area": last["area"]["surface"],
        "angle": last["angle"]["surface"],
        "largest_area_error": max(errors, default=None),
        "gap": max((gap for gap in gaps if gap is not None), default=None),
        "seconds": result.report["seconds"],
    }


class _Counts(TypedDict):
    """Vertices of a map that the input does not have, and the number of the input's faces."""

    copied_vertices: int
    new_vertices: int
    input_faces: int


def _counts(result: MapResult | TorusMap) -> _Counts:
    """Count the copies of vertices along cuts, new vertices, and the faces that triangles are parts of."""
    import numpy as np

    of_vertices, of_faces = result.vertex_origin, result.face_origin
    copied = new = 0
    if of_vertices is not None:
        known = of_vertices[of_vertices >= 0]
        copied, new = len(known) - len(np.unique(known)), len(of_vertices) - len(known)
    faces = len(result.faces)
    if of_faces is not None:
        faces = len(np.unique(of_faces[of_faces >= 0])) + int((of_faces < 0).sum())
    return {"copied_vertices": copied, "new_vertices": new, "input_faces": faces}


def sizes(result: MapResult | TorusMap) -> str:
    """Return the sizes of a map's mesh in words: those of the input, and what cuts and new vertices added."""
    return _sizes(len(result.vertices), len(result.faces), **_counts(result))


def _sizes(vertices: int, faces: int, copied_vertices: int, new_vertices: int, input_faces: int) -> str:
    more = [f"{copied_vertices} copies along cuts"] * bool(copied_vertices)
    more += [f"{new_vertices} new ones"] * bool(new_vertices)
    line = " and ".join([f"{vertices - copied_vertices - new_vertices} vertices", *more])
    return f"{line}, {input_faces} faces" + (f" in {faces} parts" if faces > input_faces else "")


def summary(facts: MapFacts) -> str:
    """Return a line for readers about a finished map and its files."""
    added = facts["copied_vertices"], facts["new_vertices"], facts["input_faces"]
    line = f"{facts['output']}: {_sizes(facts['vertices'], facts['faces'], *added)}; {quality(facts)}"
    return line if facts["report"] is None else f"{line}; report {facts['report']}"


def quality(facts: MapFacts) -> str:
    """Return the figures of a map's quality: flips, degree, area, angle, and the gap where it was computed.

    Of a map to a part of the sphere, the degree is the share that is covered; of parts with a sphere each, it is told
    for each of them.
    """
    line = f"flips {facts['flips']}, {_covered(facts)}"
    of_parts = "" if facts["largest_area_error"] is None else " (of the quarters)"
    line += f", area {facts['area']:.4f}{of_parts}, angle {facts['angle']:.4f}"
    if facts["largest_area_error"] is not None:
        line += f", areas of all triangles right to {facts['largest_area_error']:.1e}"
    if facts["gap"] is not None:
        within = f"within {facts['gap']:.3%} of the least"
        # Above this gap the bound says little of the least cost: on a bracket, two fifths of whose conformal map are
        # flipped, it is less than a ten-thousandth of the cost of the map.
        line += f", cost {within if facts['gap'] <= 1.0 else 'more than twice its lower bound'}"
    return line


def _covered(facts: MapFacts) -> str:
    """Return the degree of a map or of its parts in words, or the share of the sphere that is covered."""
    degrees = facts["degree_of_parts"] or [facts["degree"]]
    where = f" each of {len(degrees)} {'disks' if facts['domain'] == Domain.DISK else 'spheres'}"
    several, low, high = len(degrees) > 1, min(degrees), max(degrees)
    # Degrees are whole numbers but for the round-off of a million solid angles, as in omtwarp.spheres.
    if all(abs(degree - round(low)) < 1e-6 for degree in degrees):
        return f"degree {low:.6f}" + (f" on{where}" if several else "")
    share = f"{low:.2%}" if f"{low:.2%}" == f"{high:.2%}" else f"{low:.2%} to {high:.2%}"
    return f"{share} of{where if several else ' the sphere'} covered"
