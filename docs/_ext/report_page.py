"""A report page made during the build and shown in a frame: ``{report-page}``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.application import Sphinx

NAME = "example_report.html"


class ReportPage(Directive):
    """The frame; its page is written at the end of the build."""

    def run(self) -> list[nodes.Node]:
        frame = (
            f'<iframe class="report-page" src="{NAME}" title="A report page" loading="lazy"></iframe>'
            f'<p><a href="{NAME}">Open the page by itself</a></p>'
        )
        return [nodes.raw("", frame, format="html")]


def write(app: Sphinx, error: Exception | None) -> None:
    if error is not None or app.builder.format != "html":
        return
    import omtwarp
    from omtwarp.reporting import write_report

    target = Path(app.outdir) / NAME
    if target.exists():
        return
    mesh = omtwarp.shapes.limbs(length=1.2, sharpness=9.0, sphere=3920)
    write_report(omtwarp.map_to_sphere(mesh), target, title="A ball with limbs")


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("report-page", ReportPage)
    app.connect("build-finished", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
