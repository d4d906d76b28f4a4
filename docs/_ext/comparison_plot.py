"""Area against angle of all compared maps, drawn during the build from the table of a page: ``{comparison-plot}``.

The argument is the page, a file of this folder, whose table has the columns mesh, program, flips, area, angle, ours,
our flips, our area and our angle.
"""

from __future__ import annotations

import html
import math
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

COLUMNS = ["mesh", "program", "flips", "area", "angle", "ours", "our flips", "our area", "our angle"]
WIDTH, HEIGHT = 720, 430  # in CSS pixels
LEFT, RIGHT, TOP, BOTTOM = 78, 16, 16, 52
# Distortion is at least 2: the axes show how far it is above, on a logarithmic scale.
AREA, ANGLE = (1e-4, 1.0), (1e-2, 10.0)
STYLE = (
    ".comparison-plot{width:100%;height:auto;font-family:sans-serif;font-size:13px}"
    "@media(max-width:600px){.comparison-plot{font-size:20px}}"
    ".comparison-legend{display:flex;flex-wrap:wrap;gap:.2em 1.4em;font-size:.85rem;margin:.6em 0}"
    ".comparison-legend svg{width:12px;height:12px;margin-right:.4em}"
    ".comparison-plot text{fill:var(--color-foreground-primary)}"
    ".comparison-plot .grid{stroke:var(--color-background-border)}"
    ".comparison-plot .other{fill:none;stroke:#c2571a;stroke-width:1.6}"
    ".comparison-plot .flipped{stroke-dasharray:2.5 2}"
    ".comparison-plot .own{fill:var(--color-brand-primary)}"
    ".comparison-plot .pair{stroke:var(--color-foreground-muted);stroke-width:.6;opacity:.55}"
)


class ComparisonPlot(SphinxDirective):
    """The plot of a page's table."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        page = Path(self.env.srcdir) / self.arguments[0]
        self.env.note_dependency(str(page))
        rows = rows_of(page.read_text("utf-8"))
        if not rows:
            raise self.error(f"{page.name} has no table with the columns {', '.join(COLUMNS)}")
        return [nodes.raw("", draw(rows), format="html")]


def rows_of(text: str) -> list[dict[str, str]]:
    """The rows of the table, by column."""
    found, inside = [], False
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if cells[: len(COLUMNS)] == COLUMNS:
            inside = True
        elif inside and line.startswith("|---"):
            continue
        elif inside and line.startswith("|"):
            found.append(dict(zip(COLUMNS, cells, strict=False)))
        else:
            inside = False
    return found


def place(area: float, angle: float) -> tuple[float, float]:
    """Where a pair of distortions lies in the picture; what is outside lies on its border."""

    def part(value: float, low: float, high: float) -> float:
        given = min(max(value - 2.0, low), high)
        return math.log(given / low) / math.log(high / low)

    x = LEFT + part(area, *AREA) * (WIDTH - LEFT - RIGHT)
    y = HEIGHT - BOTTOM - part(angle, *ANGLE) * (HEIGHT - TOP - BOTTOM)
    return round(x, 1), round(y, 1)


def draw(rows: list[dict[str, str]]) -> str:
    """Return the plot as SVG, in the colours of the page's theme."""
    parts = []
    for exponent in range(-4, 1):
        x, _ = place(2.0 + 10.0**exponent, 3.0)
        parts.append(f'<path class="grid" d="M{x} {TOP}V{HEIGHT - BOTTOM}"/>')
        parts.append(f'<text x="{x}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{2 + 10.0**exponent:g}</text>')
    for excess in (0.01, 0.1, 1.0, 10.0):
        _, y = place(3.0, 2.0 + excess)
        parts.append(f'<path class="grid" d="M{LEFT} {y}H{WIDTH - RIGHT}"/>')
        parts.append(f'<text x="{LEFT - 8}" y="{y + 4}" text-anchor="end">{2 + excess:g}</text>')
    for row in rows:
        x, y = place(float(row["area"]), float(row["angle"]))
        own_x, own_y = place(float(row["our area"]), float(row["our angle"]))
        flips = int(row["flips"])
        words = html.escape(f"{row['mesh']}: {row['program']} {row['area']} / {row['angle']}, {flips} flips; ")
        words += html.escape(f"omtwarp {row['ours']} {row['our area']} / {row['our angle']}")
        parts.append(f'<path class="pair" d="M{x} {y}L{own_x} {own_y}"/>')
        kind = "other flipped" if flips else "other"
        parts.append(f'<circle class="{kind}" cx="{x}" cy="{y}" r="4"><title>{words}</title></circle>')
        parts.append(f'<circle class="own" cx="{own_x}" cy="{own_y}" r="3.4"><title>{words}</title></circle>')
    middle = (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 10}" text-anchor="middle">area distortion</text>')
    parts.append(f'<text transform="translate(16 {middle}) rotate(-90)" text-anchor="middle">angle distortion</text>')
    legend = (("other", "another program"), ("other flipped", "the same, with flipped triangles"), ("own", "omtwarp"))
    marks = "".join(
        '<span><svg class="comparison-plot" viewBox="0 0 12 12" aria-hidden="true">'
        f'<circle class="{kind}" cx="6" cy="6" r="4"/></svg>{words}</span>'
        for kind, words in legend
    )
    title = "Area and angle distortion of maps by other programs, each joined to the map of omtwarp compared with it"
    return (
        f'<div><style>{STYLE}</style><div class="comparison-legend">{marks}</div>'
        f'<svg class="comparison-plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" xmlns="http://www.w3.org/2000/svg">'
        f"<title>{title}</title>{''.join(parts)}</svg></div>"
    )


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("comparison-plot", ComparisonPlot)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
