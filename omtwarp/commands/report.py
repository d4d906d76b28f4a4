"""``omtwarp report``: a page about a map, to be opened in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from omtwarp.commands._options import Printing, RouteOptions, Shown, Source, output_option
from omtwarp.commands._work import map_from, show_each, start_device, targets_of


def run(
    *,
    output: Annotated[Path, output_option(".html")],
    source: Source,
    picture: Shown,
    title: str | None = None,
    up: str | None = None,
    mapping: RouteOptions,
    printing: Printing,
) -> None:
    """Write a page about a map: 3D view, pictures, distortion, cost, stages and certificate in one HTML file.

    Examples:
        omtwarp report --map bunny.npz -o bunny.html

    Options:
        output: The page (.html), with everything in it; a directory for several meshes.
        title: Heading of the page; the mesh's name by default.
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
    """
    from omtwarp.render import gl_client

    gl_client.prepare()  # its process starts while others are imported and the map is read
    from omtwarp.render.camera import axis_vector
    from omtwarp.reporting import write_report

    targets = targets_of(source, output, ".html", (".html", ".htm"), picture.image)
    if up is not None:
        axis_vector(up)
    start_device(mapping.device)
    keywords = picture.read()

    def report_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        result, shown = map_from(mesh, source, mapping, printing), mesh or source.finished
        write_report(
            result,
            target,
            title=title or (shown.stem if shown is not None else None),
            up=up,
            device=mapping.device,
            **keywords,
        )
        length = target.stat().st_size
        facts: dict[str, object] = {"output": str(target), "bytes": length}
        facts |= {"vertices": len(result.vertices), "faces": len(result.faces)}
        return facts, f"{target}: a report of {length / 1e6:.1f} MB, to be opened in a browser"

    show_each(source.meshes, targets, report_one, printing)
