"""The report page of a cohort: how many of each status, the failures, and pictures of what lies furthest out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omtwarp.cohort.item import OK
from omtwarp.files import staged
from omtwarp.render import preview
from omtwarp.reporting.markup import Markup, element, html, join
from omtwarp.reporting.scene import data_uri
from omtwarp.result import MapResult

OUTLIERS = 6  # pictures on the page
MEASURES = {
    "area": "area distortion",
    "angle": "angle distortion",
    "ring": "area around vertices",
    "seconds": "seconds",
}
PICTURE = (360, 270)

STYLE = Markup("""
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; margin: 1rem 0 } th, td { padding: .2rem .8rem .2rem 0; text-align: left }
td.n { text-align: right; font-variant-numeric: tabular-nums } th { border-bottom: 1px solid #999 }
.outliers { display: grid; grid-template-columns: repeat(auto-fill, minmax(20rem, 1fr)); gap: 1rem }
figure { margin: 0 } figure img { width: 100% } figcaption { font-size: .9rem }
""")


def write_page(rows: Sequence[dict[str, Any]], folder: Path) -> Path:
    """Write ``report.html``, which needs no other file.

    Args:
        rows: one per item, see :func:`omtwarp.cohort.table.write_table`.
        folder: of the cohort's results, whose maps are drawn.
    """
    counts = Counter(row["status"] for row in rows)
    done = [row for row in rows if row["status"] == OK]
    failures = [row for row in rows if row["status"] not in (OK, "waiting")]
    body = [
        element("h1", "Cohort report"),
        element("p", f"{len(rows)} surfaces: " + ", ".join(f"{n} {status}" for status, n in sorted(counts.items()))),
    ]
    if done:
        body += [element("h2", "Measures"), _measures(done)]
    if failures:
        listed = [(row["id"], row["status"], row.get("message", "")) for row in failures]
        body += [element("h2", "Failures"), _table(("item", "status", "message"), listed)]
    if done:
        drawn = [_figure(row, why, folder) for row, why in outliers(done)]
        body += [element("h2", "Furthest out"), element("div", *drawn, class_="outliers")]
    page = html(
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Cohort report</title>'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\"><style>{}</style></head><body>{}</body></html>",
        STYLE,
        join(body),
    )
    target = folder / "report.html"
    with staged(target) as file:
        file.write_text(str(page), "utf-8")
    return target


def outliers(done: Sequence[dict[str, Any]], most: int = OUTLIERS) -> list[tuple[dict[str, Any], str]]:
    """The items furthest above the median of a measure, in median absolute deviations, and why.

    Each item is listed once, with the measure in which it lies furthest out.
    """
    found: dict[str, tuple[float, dict[str, Any], str]] = {}
    for name, words in MEASURES.items():
        values = np.array([np.nan if row.get(name) is None else float(row[name]) for row in done])
        if not np.isfinite(values).any():
            continue
        middle = np.nanmedian(values)
        spread = max(np.nanmedian(np.abs(values - middle)), 1e-9 * max(abs(middle), 1e-300))
        for row, value in zip(done, values, strict=True):
            distance = (value - middle) / spread
            if np.isfinite(distance) and distance > found.get(row["id"], (0.0,))[0]:
                found[row["id"]] = (distance, row, f"{words} {value:.4g}, median {middle:.4g}")
    ranked = sorted(found.values(), key=lambda entry: (-entry[0], entry[1]["id"]))
    return [(row, why) for _, row, why in ranked[:most]]


def _measures(done: Sequence[dict[str, Any]]) -> Markup:
    lines = []
    for name in ("vertices", "faces", "flips", "area", "area_p95", "angle", "ring", "gap", "seconds", "memory"):
        values = np.array([row[name] for row in done if row.get(name) is not None], dtype=np.float64)
        if len(values):
            numbers = np.percentile(values, [0, 50, 95, 100]) / (2**20 if name == "memory" else 1)
            lines.append((name + (" (MiB)" if name == "memory" else ""), *(f"{number:.6g}" for number in numbers)))
    return _table(("measure", "least", "median", "95 % below", "largest"), lines)


def _table(names: Sequence[str], lines: Sequence[Sequence[str]]) -> Markup:
    head = element("tr", *(element("th", name) for name in names))
    return element("table", head, *(element("tr", *(element("td", cell) for cell in line)) for line in lines))


def _figure(row: dict[str, Any], why: str, folder: Path) -> Markup:
    """A picture of a surface, its map drawn on it as circles that would be equal on the sphere."""
    caption = element("figcaption", element("b", row["id"]), ": ", why)
    try:
        result = MapResult.load(folder / "maps" / f"{row['id']}.npz")
        picture = preview(result, size=PICTURE, device="cpu")
    except Exception as error:
        return element("figure", caption, element("p", f"no picture: {error}"))
    image = html('<img alt="{}" src="{}">', row["id"], data_uri(picture, "webp"))
    return element("figure", image, caption)


__all__ = ["outliers", "write_page"]
