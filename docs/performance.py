"""Measure what the table of docs/performance.md shows, and write it there: ``python docs/performance.py [MESH ...]``.

Takes ten minutes on two cores, which have nothing else to do meanwhile, and 6 GiB.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from benchmark import markdown, run

PAGE = Path(__file__).with_name("performance.md")
FIGURES = re.compile(r"(?<=<!-- figures -->\n).*(?=<!-- end of figures -->)", re.S)


def measured(meshes: Sequence[str], sizes: Sequence[int] = (5_000, 20_000, 100_000, 1_000_000)) -> str:
    """Return the machine and the table of maps of made shapes and of mesh files, as Markdown."""
    return markdown(run(meshes=meshes, sizes=sizes, repeats=3, progress=print)).split("\n\nExponent")[0].strip()


def with_figures(page: str, text: str) -> str:
    """Return a page with a text in place of the figures that it has."""
    changed, count = FIGURES.subn(lambda _: f"\n{text}\n\n", page)
    assert count == 1, "the page has no place for figures"
    return changed


if __name__ == "__main__":
    PAGE.write_text(with_figures(PAGE.read_text("utf-8"), measured(sys.argv[1:])), "utf-8")
