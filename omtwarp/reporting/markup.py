"""HTML that is escaped by construction: every value in a template is text, unless it is HTML made by this module.

A template is a literal (the linter checks it), so that nothing of a file's or a user's can become an element, an
attribute or a script. Pieces are joined by :func:`join`; plain text that ends up in the page is escaped there.
"""

from __future__ import annotations

import io
import re
from base64 import b64encode
from collections.abc import Iterable, Sequence
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

from markupsafe import Markup

from omtwarp.files.output import write_text

if TYPE_CHECKING:
    from PIL.Image import Image


def html(template: str, /, *values: object, **named: object) -> Markup:
    """Fill a literal template as :meth:`str.format` does, with every value escaped that is no HTML.

    >>> html("<b>{}</b>", "1 < 2")
    Markup('<b>1 &lt; 2</b>')
    """
    return Markup(template).format(*values, **named)  # noqa: S704 (callers give literals, which the linter checks)


def element(name: str, *content: str | float, **attributes: object) -> Markup:
    """Make an element whose attributes and content are escaped where they are not HTML.

    Args:
        name: of the element, a literal.
        content: pieces of HTML or text.
        attributes: by name; underscores stand for hyphens, and one at the end is left out (``class_``). Of fractions
            there is one digit.

    >>> element("text", "a < b", class_="tick", text_anchor="end")
    Markup('<text class="tick" text-anchor="end">a &lt; b</text>')
    """
    values = {key: f"{value:.1f}" if isinstance(value, float) else value for key, value in attributes.items()}
    given = join(html(' {}="{}"', key.rstrip("_").replace("_", "-"), value) for key, value in values.items())
    return html("<{}{}>{}</{}>", name, given, join(content), name)


def join(pieces: Iterable[str | float], between: str = "") -> Markup:
    """Join several pieces to one of HTML; plain text is escaped."""
    return Markup(between).join(html("{}", piece) for piece in pieces)  # noqa: S704


def asset(name: str) -> Markup:
    """Read a file of the package that goes into the page unchanged."""
    return Markup((files("omtwarp.reporting") / "assets" / name).read_text("utf-8"))  # noqa: S704


def script(name: str) -> Markup:
    """Read a script of the package, in a form in which no part of it ends or nests the script element."""
    return Markup(str(asset(name)).replace("</script", "<\\/script").replace("<!--", "<\\!--"))  # noqa: S704


def data_block(text: str) -> Markup:
    """Make a script element that holds JSON, or base64, and is not executed.

    It has no ``<``, which JSON has only inside of texts.
    """
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704


def source_hash(text: str) -> Markup:
    """Return the hash that allows this script in a page's policy (Content Security Policy level 3, section 6.7.3.3)."""
    return html("'sha256-{}'", b64encode(sha256(text.encode()).digest()).decode())


def data_uri(image: Image | list[Image], kind: str) -> str:
    """Encode a PIL image as a data URI: ``png``, ``webp`` or ``jpeg``."""
    assert not isinstance(image, list)  # which a preview is of several frames alone
    stream = io.BytesIO()
    image.save(stream, kind.upper(), quality=88)  # which a PNG has not
    return f"data:image/{kind};base64,{b64encode(stream.getvalue()).decode()}"


def fill_page(name: str, /, **values: object) -> Markup:
    """Put values in place of {{name}} in a file of the package, once and not within values; plain text is escaped."""
    return Markup(re.sub(r"{{(\w+)}}", lambda place: Markup.escape(values[place[1]]), asset(name)))  # noqa: S704


def write_plain_page(path: Path, title: str, body: Sequence[str]) -> Path:
    """Write a page that loads nothing and runs nothing.

    Args:
        path: the file; it appears whole or not at all.
        title: of the page, its first heading too.
        body: pieces of HTML, or text, below the heading.
    """
    write_text(path, str(fill_page("plain.html", title=title, body=join(body))))
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
