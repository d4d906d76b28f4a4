"""Formulae as MathML, which browsers draw themselves: no script and no fonts to be fetched."""

from __future__ import annotations

import re
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util.math import get_node_equation_number


def _mathml(latex: str, display: str) -> str:
    return convert(_plain(latex), display=display)


def _plain(latex: str) -> str:
    """What the converter does not know in what it knows."""
    latex = re.sub(r"\\(?:d|t)frac", r"\\frac", latex)
    return re.sub(r"\\operatorname\{(\w+)\}", r"\\mathrm{\1}", latex)


def visit_inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def visit_block(writer: Any, node: nodes.math_block) -> None:
    latex = node.astext()
    tag = re.search(r"\\tag\{([^}]*)\}", latex)  # the number that an equation has in the paper
    number = tag[1] if tag else get_node_equation_number(writer, node) if node["number"] else ""
    writer.body.append(writer.starttag(node, "div", CLASS="math-block"))
    writer.body.append(_mathml(latex.replace(tag[0], "") if tag else latex, "block"))
    if number:
        writer.body.append(f'<span class="eqno">({number})</span>')
    writer.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
