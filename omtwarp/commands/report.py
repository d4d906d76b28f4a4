"""``omtwarp report``: a page about a map, to be opened in a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import (
    CostOption,
    DeviceOption,
    ImageOption,
    JsonOption,
    MapOption,
    MethodOption,
    OptionalMeshes,
    QuietOption,
    RefineOption,
    RepairOption,
    SchemeOption,
    SolverOption,
    UntilOption,
    UpOption,
    VerboseOption,
    output_option,
)
from omtwarp.commands._work import map_from, show_each, start_device, targets_of
from omtwarp.commands.texture import PatternOption
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_output
from omtwarp.options import MapOptions, Refinement


def report_on_map(
    output: Annotated[
        Path,
        output_option("The page (.html), with everything in it; a directory for several meshes.", ".html"),
    ],
    meshes: OptionalMeshes = None,
    finished: MapOption = None,
    image: ImageOption = None,
    pattern: PatternOption = None,
    title: Annotated[str | None, typer.Option(help="Heading of the page; the mesh's name by default.")] = None,
    up: UpOption = None,
    method: MethodOption = MapOptions.method,
    until: UntilOption = MapOptions.until,
    cost: CostOption = MapOptions.cost,
    scheme: SchemeOption = MapOptions.scheme,
    refine: RefineOption = str(Refinement.NONE),
    device: DeviceOption = MapOptions.device,
    solver: SolverOption = MapOptions.solver,
    repair: RepairOption = False,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write a page about a map: 3D view, pictures, distortion, cost, stages and certificate in one HTML file."""
    from omtwarp.render import gl_client

    gl_client.prepare()  # its process starts while others are imported and the map is read
    from omtwarp.render.camera import axis_vector
    from omtwarp.reporting import write_report
    from omtwarp.texturing import read_image

    given = meshes or []
    targets = targets_of(given, finished, output, ".html")
    for target in targets:
        check_output(target, (".html", ".htm"), *given, finished, image)
    if image is not None and pattern is not None:
        raise OmtwarpError("both --image and --pattern: give one")
    if up is not None:
        axis_vector(up)
    start_device(device)
    picture = read_image(image) if image is not None else None

    def report_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        result = map_from(
            mesh,
            finished,
            repair=repair,
            quiet=quiet,
            device=device,
            torus=True,
            verbose=verbose,
            method=method,
            until=until,
            cost=cost,
            scheme=scheme,
            refine=refine,
            solver=solver,
        )
        source = mesh or finished
        write_report(
            result,
            target,
            title=title or (source.stem if source is not None else None),
            image=picture,
            pattern=pattern.value if pattern else "circles",
            up=up,
            device=device,
        )
        length = target.stat().st_size
        facts: dict[str, object] = {
            "output": str(target),
            "bytes": length,
            "vertices": len(result.vertices),
            "faces": len(result.faces),
        }
        return facts, f"{target}: a report of {length / 1e6:.1f} MB, to be opened in a browser"

    show_each(given, targets, report_one, as_json=as_json, quiet=quiet)
