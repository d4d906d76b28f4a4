"""``omtwarp texture``: a picture or pattern on the sphere, pulled back to the surface."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import (
    CostOption,
    DeviceOption,
    MapOption,
    MethodOption,
    OptionalMesh,
    QuietOption,
    RefineOption,
    RepairOption,
    SchemeOption,
    SolverOption,
    UntilOption,
)
from omtwarp.commands._streams import output_file
from omtwarp.errors import OmtwarpError
from omtwarp.files import check_output
from omtwarp.options import MapOptions, Refinement


class PatternName(StrEnum):
    CIRCLES = "circles"
    PUZZLE = "puzzle"
    GLOBE = "globe"
    CHECKER = "checker"


class ProjectionName(StrEnum):
    EQUIRECTANGULAR = "equirectangular"
    SINUSOIDAL = "sinusoidal"


class AtlasName(StrEnum):
    EQUIRECTANGULAR = "equirectangular"
    CUBE = "cube"
    OCTAHEDRAL = "octahedral"


def texture_mesh(
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            callback=output_file(".glb"),
            help=".glb, .obj (with .mtl and .png) or .ply.",
        ),
    ],
    mesh: OptionalMesh = None,
    finished: MapOption = None,
    image: Annotated[Path | None, typer.Option(metavar="PICTURE", help="An equirectangular picture.")] = None,
    pattern: Annotated[PatternName | None, typer.Option(help="A pattern instead of a picture.")] = None,
    projection: Annotated[
        ProjectionName, typer.Option(help="How the picture covers the sphere; sinusoidal for those not made for one.")
    ] = ProjectionName.EQUIRECTANGULAR,
    atlas: Annotated[
        AtlasName, typer.Option(help="Layout of the texture; equirectangular for tools that expect one.")
    ] = AtlasName.CUBE,
    rotate: Annotated[
        str, typer.Option(metavar="YAW[,PITCH,ROLL]|auto", help="Turn the texture on the sphere, in degrees.")
    ] = "",
    seam: Annotated[
        str, typer.Option(metavar="LONGITUDE|auto", help="Where an equirectangular texture is cut, in degrees.")
    ] = "180",
    size: Annotated[int | None, typer.Option(min=1, help="Width of the texture in texels.")] = None,
    method: MethodOption = MapOptions.method,
    until: UntilOption = MapOptions.until,
    cost: CostOption = MapOptions.cost,
    scheme: SchemeOption = MapOptions.scheme,
    refine: RefineOption = str(Refinement.NONE),
    device: DeviceOption = MapOptions.device,
    solver: SolverOption = MapOptions.solver,
    repair: RepairOption = False,
    quiet: QuietOption = False,
) -> None:
    """Texture a surface through its map to the sphere, with a picture or a pattern.

    Of a map to a torus the texture closes up both ways: a picture that repeats, circles or a checker.
    """
    from omtwarp.commands._work import map_from, require_bijective, start_device
    from omtwarp.texturing import read_image, texture
    from omtwarp.texturing.export import SUFFIXES

    check_output(output, SUFFIXES, mesh, finished, image)
    if image is not None and pattern is not None:
        raise OmtwarpError("both --image and --pattern: give one")
    turn = rotation(rotate)
    cut = seam if seam == "auto" else one_number(seam, "--seam")
    start_device(device)
    picture = read_image(image) if image is not None else None
    result = map_from(
        mesh,
        finished,
        repair=repair,
        quiet=quiet,
        device=device,
        torus=True,
        method=method,
        until=until,
        cost=cost,
        scheme=scheme,
        refine=refine,
        solver=solver,
    )
    require_bijective(result, finished)
    textured = texture(
        result,
        picture,
        pattern=pattern.value if pattern else None,
        projection=projection.value,
        atlas=atlas.value,
        rotate=turn,
        seam_longitude=cut,
        size=size,
        device=device,
    )
    *beside, _ = textured.export(output, keep=(mesh, finished, image))
    if not quiet:
        print(f"{output}: {len(result.vertices)} vertices, {len(result.faces)} faces, textured")
        if beside:
            print(f"with {' and '.join(str(file) for file in beside)}")


def rotation(text: str) -> str | list[float] | None:
    """Yaw, or yaw, pitch and roll, in degrees, or ``auto``.

    Raises:
        OmtwarpError: anything else.
    """
    if text in ("", "auto"):
        return text or None
    numbers = [one_number(word, "--rotate") for word in text.split(",")]
    if len(numbers) not in (1, 3):
        raise OmtwarpError(f"--rotate '{text}': give one angle, three with commas, or auto")
    return numbers


def one_number(text: str, option: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not abs(number) < float("inf"):
        raise OmtwarpError(f"{option} '{text}': not a number of degrees")
    return number
