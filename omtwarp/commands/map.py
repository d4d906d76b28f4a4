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
from omtwarp.errors import OmtwarpError
from omtwarp.files import check_output, staged
from omtwarp.options import MapOptions, Method

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from omtwarp.commands._work import Input
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
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Numbers per vertex or triangle (.npy, .txt, .csv): twice the weight, twice the area."
        ),
    ] = None,
    density: Annotated[
        Path | None,
        typer.Option(
            "--target",
            metavar="IMAGE",
            help="An equirectangular picture as the density to reach: bright regions get more mass.",
        ),
    ] = None,
    target_floor: Annotated[
        float, typer.Option(metavar="SHARE", help="Raise the target's dark parts to this share of its mean.")
    ] = 0.0,
    report: Annotated[
        Path | None, typer.Option(metavar="JSON", help="Write what was done and how good the map is.")
    ] = None,
    repair: RepairOption = False,
    quiet: QuietOption = False,
) -> None:
    """Map a closed genus-0 mesh to the unit sphere, with its area preserved.

    OUTPUT.npz holds vertices, faces, sphere, conformal and density (float64, in the input's order). A mesh suffix
    (.ply, .obj, .off, .stl, .glb) holds the sphere with the input's faces.

    With --weights parts of the surface cover more of the sphere than their area; with --target the sphere is not filled
    evenly but as a picture says. Example: omtwarp map head.ply -o head.npz --weights face.npy --target importance.png
    """
    from omtwarp.commands._work import make_map, read_sound_mesh, report_text, require_no_flips, start_device
    from omtwarp.mesh.write import SUFFIXES
    from omtwarp.texturing.density import as_target

    check_output(output, (".npz", *SUFFIXES), mesh)
    if report is not None:
        check_output(report, (".json",), mesh, output)
    sound = read_sound_mesh(mesh, repair)
    per_part = None if weights is None else weights_of(weights, sound)
    start_device(device)
    goal = None if density is None else as_target(density, target_floor)
    result = make_map(
        sound.surface,
        quiet=quiet,
        method=method,
        until=until,
        cost=cost,
        scheme=scheme,
        refine=refine,
        weights=per_part,
        target=goal,
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


def weights_of(path: Path, sound: Input) -> NDArray[np.float64]:
    """Read weights, and bring them in the order of a mesh that was mended.

    Raises:
        OmtwarpError: no numbers, or the mended mesh has parts that the weights do not speak of.
    """
    from omtwarp.measures.weights import read_numbers

    weights = read_numbers(path)
    for size, origin in zip(sound.sizes, sound.origins.values(), strict=False):
        if len(weights) == size:
            added = int((origin < 0).sum())
            if added:
                raise OmtwarpError(f"'{path}' has no weights for the {added} parts that --repair added to the mesh")
            return weights[origin]
    return weights


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
    line = f"{output}: {size}; flips {flips}, degree {last['degree']:.6f}, area {area:.4f}, angle {angle:.4f}"
    gap = result.report.get("optimality", {}).get("gap")
    return line if gap is None else f"{line}, cost within {gap:.3%} of the least"
