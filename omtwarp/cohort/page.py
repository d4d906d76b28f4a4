"""The report page of a cohort: how many of each status, the failures, and pictures of outliers."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from omtwarp.cohort.item import OK, Row
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import TINY
from omtwarp.render import preview
from omtwarp.reporting.markup import Markup, element, figure, pictures, table, write_plain_page

MEASURES = {
    "area": "area distortion",
    "angle": "angle distortion",
    "ring": "area around vertices",
    "seconds": "seconds",
}


def write_page(rows: Sequence[Row], folder: Path) -> Path:
    """Write ``report.html``, which needs no other file.

    Args:
        rows: one per item, see :func:`omtwarp.cohort.tables.write_table`.
        folder: of the cohort's results, whose maps are drawn.
    """
    counts = Counter(str(row["status"]) for row in rows)
    done = [row for row in rows if row["status"] == OK]
    failures = [row for row in rows if row["status"] not in (OK, "waiting")]
    summary = ", ".join(f"{count} {status}" for status, count in sorted(counts.items()))
    body = [element("p", f"{len(rows)} surfaces: {summary}")]
    if done:
        body += [element("h2", "Measures"), _measures(done)]
    if failures:
        listed = [(str(row["id"]), str(row["status"]), str(row.get("message", ""))) for row in failures]
        body += [element("h2", "Failures"), table(("item", "status", "message"), listed)]
    if done:
        body += [element("h2", "Furthest out"), pictures([_figure(row, why, folder) for row, why in outliers(done)])]
    return write_plain_page(folder / "report.html", "Cohort report", body)


def outliers(done: Sequence[Row]) -> list[tuple[Row, str]]:
    """Return the items furthest above the median of a measure, in median absolute deviations, and why.

    Each item is listed once, with the measure in which it deviates most.
    """
    farthest: dict[str, tuple[float, Row, str]] = {}
    for name, words in MEASURES.items():
        values = np.array([np.nan if (number := row.get(name)) is None else float(number) for row in done])
        if not np.isfinite(values).any():
            continue
        middle = np.nanmedian(values)
        # Of the median: where most items have the same value, deviations are counted in this, so that a quotient stays
        # finite.
        spread = max(np.nanmedian(np.abs(values - middle)), 1e-9 * max(abs(middle), TINY))
        for row, value in zip(done, values, strict=True):
            distance = (value - middle) / spread
            name_of_item = str(row["id"])
            if np.isfinite(distance) and distance > farthest.get(name_of_item, (0.0,))[0]:
                farthest[name_of_item] = (distance, row, f"{words} {value:.4g}, median {middle:.4g}")
    ranked = sorted(farthest.values(), key=lambda entry: (-entry[0], str(entry[1]["id"])))
    # Outliers: pictures on the page
    return [(row, why) for _, row, why in ranked[:6]]


def _measures(done: Sequence[Row]) -> Markup:
    lines = []
    for name in ("vertices", "faces", "flips", "area", "area_p95", "angle", "ring", "gap", "seconds", "memory"):
        values = np.array([row[name] for row in done if row.get(name) is not None], dtype=np.float64)
        if len(values):
            numbers = np.percentile(values, [0, 50, 95, 100]) / (2**20 if name == "memory" else 1)
            lines.append((name + (" (MiB)" if name == "memory" else ""), *(f"{number:.6g}" for number in numbers)))
    return table(("measure", "least", "median", "95 % below", "largest"), lines)


def _figure(row: Row, why: str, folder: Path) -> Markup:
    """Return a picture of a surface, its map drawn on it as circles that would be equal on the sphere."""
    try:
        picture = preview(MapResult.load(folder / "maps" / f"{row['id']}.npz"), size=(360, 270), device="cpu")
    except Exception as error:
        caption = element("figcaption", element("b", str(row["id"])), ": ", why)
        return element("figure", caption, element("p", f"no picture: {error}"))
    return figure(picture, str(row["id"]), ": ", why)
