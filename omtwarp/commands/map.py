"""``omtwarp map``: a mesh in, its map to the sphere out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import (
    CostOption,
    DeviceOption,
    MeshArgument,
    MethodOption,
    QuietOption,
    RefineOption,
    RepairOption,
    SchemeOption,
    UntilOption,
)
from omtwarp.files import check_output, staged
from omtwarp.options import MapOptions, Method

if TYPE_CHECKING:
    from omtwarp.result import MapResult


def map_mesh(
    mesh: MeshArgument,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help=".npz for the whole map, or a mesh suffix for the sphere."),
    ],
    method: MethodOption = MapOptions.method,
    until: UntilOption = MapOptions.until,
    cost: CostOption = MapOptions.cost,
    scheme: SchemeOption = MapOptions.scheme,
    refine: RefineOption = str(MapOptions.refine),
    device: DeviceOption = MapOptions.device,
    report: Annotated[
        Path | None, typer.Option(metavar="JSON", help="Write what was done and how good the map is.")
    ] = None,
    repair: RepairOption = False,
    quiet: QuietOption = False,
) -> None:
    """Map a closed genus-0 mesh to the unit sphere, with its area preserved.

    OUTPUT.npz holds vertices, faces, sphere, conformal and density (float64, in the input's order). A mesh suffix
    (.ply, .obj, .off, .stl, .glb) holds the sphere with the input's faces.
    """
    from omtwarp.commands._work import make_map, read_sound_mesh, report_text, require_no_flips, start_device
    from omtwarp.mesh.write import SUFFIXES

    check_output(output, (".npz", *SUFFIXES), mesh)
    if report is not None:
        check_output(report, (".json",), mesh, output)
    sound = read_sound_mesh(mesh, repair)
    start_device(device)
    result = make_map(
        sound.surface,
        quiet=quiet,
        method=method,
        until=until,
        cost=cost,
        scheme=scheme,
        refine=refine,
        optimality=report is not None,
        device=device,
    )
    if sound.origins:
        vertices, faces = sound.origins["vertex_origin"], sound.origins["face_origin"]
        result = replace(result, vertex_origin=vertices, face_origin=faces)
    with staged(output) as file:
        save(result, file)
    if report is not None:
        source = {"path": str(mesh), "notes": sound.notes}
        with staged(report) as file:
            file.write_text(report_text({"input": source, **result.report, "history": result.history}), "utf-8")
    if not quiet:
        print(summary(result, output))
    if method is Method.OMT:
        require_no_flips(result, output)


def save(result: MapResult, file: Path) -> None:
    """Write a map as .npz, or its sphere as a mesh."""
    from omtwarp.mesh.write import write_mesh

    if file.suffix.lower() == ".npz":
        result.save(file)
    else:
        write_mesh(file, result.sphere, result.faces)


def summary(result: MapResult, output: Path) -> str:
    """One line about a finished map, out of its report."""
    last = result.report["stages"][-1]
    area, angle = last["area"]["surface"], last["angle"]["surface"]
    size = f"{len(result.vertices)} vertices, {len(result.faces)} faces"
    flips = result.report["certificate"]["flips"]
    return f"{output}: {size}; flips {flips}, degree {last['degree']:.6f}, area {area:.4f}, angle {angle:.4f}"
