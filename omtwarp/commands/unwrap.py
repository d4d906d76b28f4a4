"""``omtwarp unwrap``: texture coordinates for a mesh's own triangles, without a texture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import Only, Printing, Source, output_option
from omtwarp.commands._painted import standing, with_objects
from omtwarp.commands._work import map_from, require_bijective, show_each, start_device, targets_of, with_files
from omtwarp.options import MapOptions


def run(
    *,
    output: Annotated[Path, output_option(".glb")],
    source: Source,
    aspect: Annotated[float, typer.Option(min=0.1, max=10.0)] = 1.0,
    margin: Annotated[float, typer.Option(min=0.0, max=0.1)] = 1.0 / 128.0,
    up: str | None = None,
    front: str | None = None,
    mapping: Annotated[MapOptions, Only(("refine", "device"))],
    printing: Printing,
) -> None:
    """Give a mesh texture coordinates through its map, for programs that paint or bake: no cuts, no texture.

    Examples:
        omtwarp unwrap bunny.ply -o bunny.obj
        omtwarp unwrap --map bunny.npz -o bunny.glb

    Options:
        output: .glb or .obj; a directory of .glb for several meshes.
        aspect: Width of the picture over its height; 1.5 wastes no space.
        margin: Margin around each chart, in heights of the picture.
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
        front (AXIS): The axis that points at the viewer in the front view.
    """
    from omtwarp.texturing.unwrap import laid_out

    targets = targets_of(source, output, ".glb", (".glb", ".obj"))
    start_device(mapping.device)

    def unwrap_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        result = map_from(mesh, source, mapping, printing)
        require_bijective(result, source.finished)
        result = standing(result, source.finished or mesh, up, front)
        made, charts = laid_out(result, aspect=aspect, margin=margin)
        named = with_objects(mesh, result)
        made = replace(made, objects=named.objects, face_object=named.face_object)
        files = made.export(target, keep=(mesh, source.finished))
        facts = {"output": str(target), "files": [str(file) for file in files], "vertices": len(made.vertices)}
        facts |= {"faces": len(made.faces), "charts": charts}
        line = f"{target}: {len(made.vertices)} vertices, {len(made.faces)} faces, "
        return facts, line + f"{charts} chart{'s' if charts > 1 else ''}{with_files(files)}"

    show_each(source.meshes, targets, unwrap_one, printing)
