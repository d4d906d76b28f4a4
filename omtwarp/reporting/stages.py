"""The stages of a finished map, as the report shows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.surface import triangle_areas
from omtwarp.metrics.distortion import Distortion
from omtwarp.reporting.record import shown_report
from omtwarp.result import MapResult, StageReport

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


@dataclass(frozen=True, eq=False)
class Stage:
    """The map of a stage, and its measures.

    Attributes:
        key: name of the stage's record in the report.
        label: name for readers.
        colour: CSS variable that the stage is drawn in.
        sphere: unit vectors, float64, shape [V, 3].
        distortion: of this map.
        record: the stage's entry of ``report["stages"]``, empty if there is none.
        weights: the part of the surface that every triangle is, float64, shape [F], sum 1.
    """

    key: str
    label: str
    colour: str
    sphere: NDArray[np.float64]
    distortion: Distortion
    record: StageReport
    weights: NDArray[np.float64]


def stages_of(result: MapResult) -> list[Stage]:
    """Return the stages of a :class:`~omtwarp.result.MapResult` in order, each map once; the last is the final map."""
    report = shown_report(result)
    records = {record.get("name"): record for record in report.get("stages", ())}
    route = report.get("start", {}).get("route", "conformal")
    scale = max(float(np.abs(result.vertices).max()), np.finfo(float).tiny)  # squares stay in range at any scale
    areas = triangle_areas(result.vertices / scale, result.faces)
    weights = areas / areas.sum()
    found: list[Stage] = []
    for attribute, key, label, colour in KNOWN:
        sphere = getattr(result, attribute, None)
        if sphere is None or any(np.array_equal(sphere, stage.sphere) for stage in found):
            continue
        if attribute == "conformal":
            label = ROUTES.get(route, str(route).capitalize())
        record = records.get(key) or (records.get(route, {}) if attribute == "conformal" else {})
        found.append(Stage(key, label, colour, sphere, result.distortion(attribute), record, weights))
    return found
