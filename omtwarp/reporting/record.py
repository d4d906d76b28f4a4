"""The fields of a map's report that a page shows, checked for their types.

A report may come from a file that was edited, damaged or forged. Fields of other types are left out, so that the page's
sections can rely on the rest.
"""

from __future__ import annotations

import math
from typing import cast

from omtwarp.maps.result import MapReport, MapResult
from omtwarp.maps.torus_map import TorusMap
from omtwarp.options import Record

NUMBER, COUNT, TEXT, FLAG = "number", "count", "text", "flag"

REPORT: dict[str, object] = {
    "seconds": NUMBER,
    "device": TEXT,
    "method": TEXT,
    "scheme": TEXT,
    "cost": TEXT,
    "versions": {"*": TEXT},
    "mesh": {"faces": COUNT},
    "start": {"route": TEXT, "reason": TEXT},
    "optimality": {"relative_curl": NUMBER, "lower_bound": NUMBER, "gap": NUMBER},
    "stages": [
        {
            "name": TEXT,
            "seconds": NUMBER,
            "iterations": COUNT,
            "transport_cost": NUMBER,
            "weight": TEXT,
            "repaired": COUNT,
            "route": TEXT,
            "converged": FLAG,
        }
    ],
}
"""Fields of a report and their kinds; ``*`` is any name, and a list for any number of entries."""

HISTORY: list[object] = [{"iteration": NUMBER, "cost": NUMBER}]


def shown_report(result: MapResult | TorusMap) -> MapReport:
    """Take from a result's report the fields that a page shows."""
    return cast(MapReport, _fitting(result.report, REPORT) or {})


def shown_history(result: MapResult | TorusMap) -> list[Record]:
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
