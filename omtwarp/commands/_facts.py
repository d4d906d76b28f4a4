"""The facts about a finished map, as JSON and as a line for readers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, cast

if TYPE_CHECKING:
    from omtwarp.result import MapReport, MapResult
    from omtwarp.torus.torus_map import TorusMap


class MapFacts(TypedDict):
    """A finished map, its files and its figures, ready for JSON."""

    output: str
    report: str | None
    vertices: int
    faces: int
    bijective: bool
    flips: int
    degree: float
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
    reports = [whole, *whole.get("parts", [])]
    errors = [
        stage["largest_area_error"] for each in reports for stage in each["stages"] if "largest_area_error" in stage
    ]
    gaps = [each["optimality"]["gap"] for each in reports if each.get("optimality")]
    return {
        "output": str(output),
        "report": None if report is None else str(report),
        "vertices": len(result.vertices),
        "faces": len(result.faces),
        "bijective": certificate.bijective,
        "flips": certificate.flips,
        "degree": last["degree"],
        "area": last["area"]["surface"],
        "angle": last["angle"]["surface"],
        "largest_area_error": max(errors, default=None),
        "gap": max((gap for gap in gaps if gap is not None), default=None),
        "seconds": result.report["seconds"],
    }


def summary(facts: MapFacts) -> str:
    """Return a line for readers about a finished map and its files."""
    line = f"{facts['output']}: {facts['vertices']} vertices, {facts['faces']} faces; {quality(facts)}"
    return line if facts["report"] is None else f"{line}; report {facts['report']}"


def quality(facts: MapFacts) -> str:
    """Return the figures of a map's quality: flips, degree, area, angle, and the gap where it was computed."""
    line = f"flips {facts['flips']}, degree {facts['degree']:.6f}"
    of_parts = "" if facts["largest_area_error"] is None else " (of the quarters)"
    line += f", area {facts['area']:.4f}{of_parts}, angle {facts['angle']:.4f}"
    if facts["largest_area_error"] is not None:
        line += f", areas of all triangles right to {facts['largest_area_error']:.1e}"
    if facts["gap"] is not None:
        line += f", cost within {facts['gap']:.3%} of the least"
    return line
