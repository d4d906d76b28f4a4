"""A picture of how data flows, drawn during the build: ``{data-flow}`` with one line for every row of boxes.

A row is ``name/ | words || name/ | words``; a line that starts with ``=`` names what goes from the row above to the one
below. Every name that ends in a slash has to be a folder of the package, so that the picture names only what is there.
"""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

PACKAGE = Path(__file__).parent.parent.parent / "omtwarp"
WIDTH, BOX, GAP, ARROW, SPACE = (760, 56, 56, 10, 14)  # in CSS pixels
STYLE = (
    ".data-flow rect{fill:var(--color-background-secondary);stroke:var(--color-brand-primary)}"
    ".data-flow text{fill:var(--color-foreground-primary);font-family:sans-serif;text-anchor:middle}"
    ".data-flow .name{font-size:15px;font-weight:600}"
    ".data-flow .words,.data-flow .data{font-size:12.5px}"
    ".data-flow .data{text-anchor:start;font-style:italic}"
    ".data-flow path{stroke:var(--color-brand-primary);fill:none;stroke-width:1.5}"
    ".data-flow .head{fill:var(--color-brand-primary);stroke:none}"
)


class DataFlow(SphinxDirective):
    """The picture, and under it its caption."""

    has_content = True
    option_spec = {"caption": directives.unchanged}  # noqa: RUF012 (docutils reads it from the class)

    def run(self) -> list[nodes.Node]:
        for name in re.findall(r"\b([a-z_]+)/", "\n".join(self.content)):
            if not (PACKAGE / name).is_dir():
                raise self.error(f"the package has no folder {name}/")
        figure = nodes.figure()
        figure += nodes.raw("", draw(list(self.content)), format="html")
        if "caption" in self.options:
            figure += nodes.caption(self.options["caption"], self.options["caption"])
        return [figure]


def draw(lines: list[str]) -> str:
    """The picture as SVG, in the colours of the page's theme."""
    parts: list[str] = []
    top, pending = 1.0, None
    for line in filter(str.strip, lines):
        if line.startswith("="):
            pending = line[1:].strip()
            continue
        if pending is not None:
            parts.append(arrow(top, top + GAP, pending))
            top, pending = top + GAP, None
        parts.append(row(line, top))
        top += BOX
    picture = f'<svg class="data-flow" viewBox="0 0 {WIDTH} {top + 1:g}" role="img" xmlns="http://www.w3.org/2000/svg">'
    return f"{picture}<title>How data flows</title><style>{STYLE}</style>{''.join(parts)}</svg>"


def row(line: str, top: float) -> str:
    """Boxes side by side."""
    boxes = [[html.escape(words.strip()) for words in box.split("|")] for box in line.split("||")]
    width = (WIDTH - 2 - SPACE * (len(boxes) - 1)) / len(boxes)
    drawn = []
    for k, (name, words) in enumerate(boxes):
        left = 1 + k * (width + SPACE)
        middle = left + width / 2
        drawn.append(
            f'<rect x="{left:g}" y="{top:g}" width="{width:g}" height="{BOX}" rx="7"/>'
            f'<text class="name" x="{middle:g}" y="{top + 24:g}">{name}</text>'
            f'<text class="words" x="{middle:g}" y="{top + 43:g}">{words}</text>'
        )
    return "".join(drawn)


def arrow(top: float, bottom: float, words: str) -> str:
    """An arrow downwards, and beside it what it carries."""
    x = WIDTH / 2
    head = f"M{x - ARROW / 2:g} {bottom - ARROW:g}L{x + ARROW / 2:g} {bottom - ARROW:g}L{x:g} {bottom - 1:g}Z"
    return (
        f'<path d="M{x:g} {top:g}L{x:g} {bottom - ARROW:g}"/><path class="head" d="{head}"/>'
        f'<text class="data" x="{x + 12:g}" y="{(top + bottom) / 2 + 4:g}">{html.escape(words)}</text>'
    )


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("data-flow", DataFlow)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
