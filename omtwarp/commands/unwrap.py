"""``omtwarp unwrap``: texture coordinates for a mesh's own triangles, without a texture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import (
    DeviceOption,
    FrontOption,
    JsonOption,
    MapOption,
    OptionalMeshes,
    QuietOption,
    RefineOption,
    RepairOption,
    UpOption,
    VerboseOption,
    output_option,
)
from omtwarp.commands._painted import standing
from omtwarp.commands._work import map_from, require_bijective, show_each, start_device, targets_of, with_files
from omtwarp.files.output import check_output
from omtwarp.options import MapOptions, Refinement


def unwrap_mesh(
    output: Annotated[
        Path,
        output_option(".glb or .obj; a directory of .glb for several meshes.", ".glb"),
    ],
    meshes: OptionalMeshes = None,
    finished: MapOption = None,
    aspect: Annotated[
        float, typer.Option(min=0.1, max=10.0, help="Width of the picture over its height; 1.5 wastes no space.")
    ] = 1.0,
    margin: Annotated[
        float, typer.Option(min=0.0, max=0.1, help="Margin around each chart, in heights of the picture.")
    ] = 1.0 / 128.0,
    up: UpOption = None,
    front: FrontOption = None,
    refine: RefineOption = str(Refinement.NONE),
    repair: RepairOption = False,
    device: DeviceOption = MapOptions.device,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Give a mesh texture coordinates through its map, for programs that paint or bake: no cuts, no texture."""
    from omtwarp.painting.unwrap import laid_out

    given = meshes or []
    targets = targets_of(given, finished, output, ".glb")
    for target in targets:
        check_output(target, (".glb", ".obj"), *given, finished)
    start_device(device)

    def unwrap_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        result = map_from(
            mesh, finished, repair=repair, quiet=quiet, device=device, torus=True, refine=refine, verbose=verbose
        )
        require_bijective(result, finished)
        result = standing(result, finished or mesh, up, front)
        made, charts = laid_out(result, aspect=aspect, margin=margin)
        files = made.export(target, keep=(mesh, finished))
        facts = {"output": str(target), "files": [str(file) for file in files], "vertices": len(made.vertices)}
        facts |= {"faces": len(made.faces), "charts": charts}
        line = f"{target}: {len(made.vertices)} vertices, {len(made.faces)} faces, "
        return facts, line + f"{charts} chart{'s' if charts > 1 else ''}{with_files(files)}"

    show_each(given, targets, unwrap_one, as_json=as_json, quiet=quiet)
