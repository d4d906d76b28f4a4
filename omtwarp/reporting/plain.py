"""Pages of tables and pictures that need no script and no other file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omtwarp.files.output import staged
from omtwarp.reporting.markup import Markup, element, html, join
from omtwarp.reporting.scene import data_uri

if TYPE_CHECKING:
    from PIL.Image import Image

STYLE = Markup("""
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #222 }
table { border-collapse: collapse; margin: 1rem 0 } th, td { padding: .2rem .8rem .2rem 0; text-align: left }
td.n { text-align: right; font-variant-numeric: tabular-nums } th { border-bottom: 1px solid #999 }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(20rem, 1fr)); gap: 1rem }
figure { margin: 0 } figure img { width: 100% } figcaption { font-size: .9rem }
""")


def write_plain_page(path: Path, title: str, body: Sequence[str]) -> Path:
    """Write a page that loads nothing and runs nothing.

    Args:
        path: the file; it appears whole or not at all.
        title: of the page, its first heading too.
        body: pieces of HTML, or text, below the heading.
    """
    page = html(
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{}</title>'
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; img-src data:; '
        "style-src 'unsafe-inline'\"><style>{}</style></head><body>{}</body></html>",
        title,
        STYLE,
        join([element("h1", title), *body]),
    )
    with staged(path) as file:
        file.write_text(str(page), "utf-8")
    return path


def table(names: Sequence[str], lines: Sequence[Sequence[str | float]]) -> Markup:
    """Make a table with its columns' names in the first line."""
    head = element("tr", *(element("th", name) for name in names))
    return element("table", head, *(element("tr", *(element("td", cell) for cell in line)) for line in lines))


def figure(picture: Image | list[Image], name: str, *words: str) -> Markup:
    """Embed a PIL image in the page, with its name and description below it."""
    image = html('<img alt="{}" src="{}">', name, data_uri(picture, "webp"))
    return element("figure", image, element("figcaption", element("b", name), *words))


def pictures(figures: Sequence[Markup]) -> Markup:
    """Put figures side by side, as many in a row as the window holds."""
    return element("div", *figures, class_="pictures")


__all__ = ["figure", "pictures", "table", "write_plain_page"]
