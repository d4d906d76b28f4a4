"""``omtwarp transfer``: the texture of one mesh on another, through their maps to the sphere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import Printing, output_option
from omtwarp.commands._painted import painted_maps
from omtwarp.commands._streams import input_file, warnings_as_lines
from omtwarp.commands._work import show_facts, sizes, with_files
from omtwarp.files.output import check_output
from omtwarp.options import AtlasName, Coordinates, Device, MapOptions


@dataclass(frozen=True)
class How:
    """Options of :func:`omtwarp.transfer_texture`, by their names there.

    Options:
        aligned: The maps are aligned already; do not rotate them.
        mirror: Also try TO's mirror image, and take it if it fits better.
        uv: Texture coordinates; own are those of TO.
        atlas: Layout of the texture, where --uv is not own.
        size: Width of the texture in texels.
    """

    aligned: bool = False
    mirror: bool = False
    uv: Annotated[Coordinates, typer.Option("--uv")] = Coordinates.ATLAS
    atlas: AtlasName = AtlasName.CUBE
    size: Annotated[int | None, typer.Option(min=16)] = None


def run(
    *,
    source: Annotated[Path, typer.Argument(metavar="FROM", callback=input_file)],
    target: Annotated[Path, typer.Argument(metavar="TO", callback=input_file)],
    output: Annotated[Path, output_option(".glb")],
    printing: Printing,
    map_of_source: Annotated[Path | None, typer.Option("--map-from", metavar="NPZ", callback=input_file)] = None,
    map_of_target: Annotated[Path | None, typer.Option("--map-to", metavar="NPZ", callback=input_file)] = None,
    how: How,
    repair: bool = False,
    device: Device = MapOptions.device,
) -> None:
    """Carry the texture of one mesh over to another, each mapped to the sphere and the two aligned.

    Examples:
        omtwarp transfer scan.glb template.ply -o painted.glb

    Options:
        source: A mesh with a texture or colours, or -.
        target: The mesh that gets the texture, or -.
        output: .glb or .obj.
        map_of_source: A finished map of FROM.
        map_of_target: A finished map of TO.
        repair: Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.
    """
    from omtwarp.transfer import transfer_texture

    check_output(output, (".glb", ".obj"), source, target, map_of_source, map_of_target)
    (painted, result), (plain, other) = painted_maps(
        [(source, map_of_source), (target, map_of_target)], repair=repair, device=device, printing=printing
    )
    with warnings_as_lines():
        made = transfer_texture(painted, result, other, onto=plain, device=device, **vars(how))
    files = made.export(output, keep=(source, target, map_of_source, map_of_target))
    facts: dict[str, object] = {"output": str(output), "files": [str(file) for file in files], "from": str(source)}
    facts |= {"vertices": len(other.vertices), "faces": len(other.faces)}
    show_facts(facts, f"{output}: {sizes(other)}, with the texture of {source}{with_files(files)}", printing)
