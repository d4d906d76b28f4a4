"""``omtwarp demo``: every step, on a generated shape."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from omtwarp.commands._options import Printing, output_option
from omtwarp.commands._work import facts_of, make_map, report_text, say_stages, start_device, summary
from omtwarp.commands.map import save
from omtwarp.files.output import check_output, folder_of_results, make_folder, staged
from omtwarp.options import Device, MapOptions

if TYPE_CHECKING:
    from omtwarp.maps.result import MapResult

UP, FRONT, VIEW = "z", "-y", (40.0, 15.0)
"""The creature stands on its feet and looks past the viewer's right shoulder."""


NAMES = ("creature.ply", "map.npz", "report.json", "globe.glb", "globe.png", "circles.png", "comparison.png")


def run(
    *,
    output: Annotated[Path, output_option(metavar="DIRECTORY")] = Path("out"),
    faces: Annotated[int, typer.Option(min=2000, max=2000000)] = 20000,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Make a shape, map it, texture it and draw it: mesh, map, report, textured model and pictures.

    Examples:
        omtwarp demo -o out

    Options:
        output: Folder of the results.
        faces: Roughly how many faces the shape has.
    """
    start_device(device)
    make_folder(output)
    with folder_of_results(output, *NAMES):
        _make(output, faces, device, printing)


def _make(output: Path, faces: int, device: str, printing: Printing) -> None:
    """Make the files of the demo; arguments are those of the command."""
    from omtwarp.mesh.shapes import demo_shape
    from omtwarp.mesh.write import write_mesh
    from omtwarp.render import comparison, preview
    from omtwarp.texturing import rasterize, texture

    files = [check_output(output / name) for name in NAMES]
    mesh_file, map_file, report_file, model_file, globe_file, circles_file, comparison_file = files
    start = time.perf_counter()

    def notify(text: str) -> None:
        if not printing.quiet and not printing.as_json:
            print(f"{time.perf_counter() - start:6.1f} s  {text}", flush=True)

    surface = demo_shape(faces)
    write_mesh(mesh_file, surface.vertices, surface.faces)
    notify(f"{mesh_file}: a creature of {surface.face_count} faces")
    result = cast("MapResult", make_map(surface, MapOptions(device=device), quiet=printing.quiet))
    with staged(map_file) as file:
        save(result, file)
    with staged(report_file) as file:
        file.write_text(report_text({**result.report, "history": result.history}), "utf-8")
    if printing.verbose:
        say_stages(result)
    facts = facts_of(result, map_file, report_file)
    notify(summary(facts_of(result, map_file)))
    globe = texture(result, pattern="globe", rotate=[0.0, -90.0, 0.0], device=device)  # Africa on its flank
    globe.export(model_file)
    notify(f"{model_file}: a globe pulled back to it")
    circles = texture(result, pattern="circles", device=device)
    for file_to_be, textured in ((globe_file, globe), (circles_file, circles)):
        preview(textured.trimesh(), file_to_be, up=UP, front=FRONT, views=VIEW, device=device)
        notify(f"{file_to_be}")
    circles_picture = rasterize("circles", 2048, device=device)
    comparison(result, comparison_file, image=circles_picture, up=UP, front=FRONT, views=VIEW, device=device)
    notify(f"{comparison_file}: the conformal and the area-preserving map")
    if printing.as_json:
        print(report_text(facts | {"output": str(output), "files": [str(file) for file in files]}), end="")
