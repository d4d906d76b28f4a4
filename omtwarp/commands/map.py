"""``omtwarp map``: a mesh in, its map to the sphere out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from omtwarp.commands._options import (
    Cost,
    CostOption,
    DeviceOption,
    MeshArgument,
    Method,
    MethodOption,
    QuietOption,
    RefineOption,
    RepairOption,
    Scheme,
    SchemeOption,
    Until,
    UntilOption,
)
from omtwarp.files import check_output, staged


def map_mesh(
    mesh: MeshArgument,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", help=".npz for the whole map, or a mesh suffix for the sphere."),
    ],
    method: MethodOption = Method.OMT,
    until: UntilOption = Until.REFINE,
    cost: CostOption = Cost.SQUARED,
    scheme: SchemeOption = Scheme.DEFAULT,
    refine: RefineOption = "area",
    device: DeviceOption = "auto",
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

    target = check_output(output, (".npz", *SUFFIXES), mesh)
    report_target = check_output(report, (".json",), mesh, output) if report is not None else None
    sound = read_sound_mesh(mesh, repair)
    start_device(device)
    result = make_map(
        sound,
        quiet=quiet,
        method=method.value,
        until=until.value,
        cost=cost.value,
        scheme=scheme.value,
        refine=refine,
        optimality=report is not None,
        device=device,
    )
    with staged(target) as file:
        save(result, file, sound.origins)
    if report_target is not None:
        source = {"path": str(mesh), "notes": sound.notes}
        with staged(report_target) as file:
            file.write_text(report_text({"input": source, **result.report, "history": result.history}), "utf-8")
    if not quiet:
        print(summary(result, output))
    if method is Method.OMT:
        require_no_flips(result, output)


def save(result: Any, file: Path, origins: dict[str, Any]) -> None:
    """Write a map as .npz, with where a mended mesh came from, or its sphere as a mesh."""
    if file.suffix.lower() != ".npz":
        from omtwarp.mesh.write import write_mesh

        write_mesh(file, result.sphere, result.faces)
        return
    result.save(file)
    if origins:
        import numpy as np

        with np.load(file) as arrays:
            content = {**arrays, **origins}
        np.savez(file, **content)


def summary(result: Any, output: Path) -> str:
    """One line about a finished map."""
    quality = result.distortion()
    area, angle = quality.area["surface"], quality.angle["surface"]
    size = f"{len(result.vertices)} vertices, {len(result.faces)} faces"
    return f"{output}: {size}; flips {quality.flips}, degree {quality.degree:.6f}, area {area:.4f}, angle {angle:.4f}"
