"""``omtwarp texture``: a picture or pattern on the sphere, pulled back to the surface."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypedDict, Unpack

import typer

from omtwarp.commands._facts import sizes
from omtwarp.commands._options import (
    CostOption,
    DeviceOption,
    FrontOption,
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
from omtwarp.commands._painted import painted_map, standing
from omtwarp.commands._progress import step_times
from omtwarp.commands._streams import say
from omtwarp.commands._work import map_from, require_bijective, show_each, start_device, targets_of, with_files
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files.output import check_output
from omtwarp.options import (
    AtlasName,
    Coordinates,
    Keep,
    MapOptions,
    PatternName,
    ProjectionName,
    Refinement,
    TextureFormat,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from omtwarp.maps.result import MapResult
    from omtwarp.maps.torus_map import TorusMap
    from omtwarp.options import MapChoices
    from omtwarp.texturing import PaintedMesh


PatternOption = Annotated[PatternName | None, typer.Option(help="A pattern in place of a picture; circles by default.")]


def texture_width(text: str | None) -> str | None:
    """Check what --size is given: one or two whole numbers, or auto."""
    sides = [] if text is None or text == "auto" else text.split("x")
    if not all(side.isascii() and side.isdigit() and 0 < int(side[:9]) for side in sides) or len(sides) > 2:
        raise typer.BadParameter(f"'{text}' is not a size: use a width in texels, 4096x2048 for both sides, or auto")
    return text


def sides_of(text: str | None) -> int | tuple[int, int] | None:
    """Return the size that --size names, None where it is to be chosen."""
    if text in (None, "auto"):
        return None
    width, *height = (int(side[:9]) for side in str(text).split("x"))
    return (width, height[0]) if height else width


def texture_mesh(
    output: Annotated[
        Path,
        output_option(".glb, .obj (with .mtl and .png) or .ply; a directory of .glb for several meshes.", ".glb"),
    ],
    meshes: OptionalMeshes = None,
    finished: MapOption = None,
    image: ImageOption = None,
    pattern: Annotated[PatternName | None, typer.Option(help="A pattern instead of a picture.")] = None,
    projection: Annotated[
        ProjectionName,
        typer.Option(help="How the picture covers the sphere; sinusoidal for pictures not made for one."),
    ] = ProjectionName.EQUIRECTANGULAR,
    atlas: Annotated[
        AtlasName, typer.Option(help="Layout of the texture; equirectangular for tools that expect one.")
    ] = AtlasName.CUBE,
    uv: Annotated[
        Coordinates,
        typer.Option("--uv", help="Texture coordinates; own are the mesh's, with a picture for each material."),
    ] = Coordinates.ATLAS,
    keep_materials: Annotated[
        Keep | None, typer.Option(help="Lay the pattern over the mesh's materials, or under them.")
    ] = None,
    opacity: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Opacity of the upper layer, times its own, with --keep-materials.")
    ] = 0.5,
    bake: Annotated[
        list[str] | None,
        typer.Option(
            metavar="normal|ao|curvature|area|FILE",
            help="What to bake: ao into the occlusion, normals of --detail into the normal map, others as the colour.",
        ),
    ] = None,
    detail: Annotated[
        Path | None, typer.Option(metavar="MESH", help="A finer mesh of the surface, for --bake normal.")
    ] = None,
    rotate: Annotated[
        str, typer.Option(metavar="YAW[,PITCH,ROLL]|auto", help="Turn the texture on the sphere, in degrees.")
    ] = "",
    seam: Annotated[
        str, typer.Option(metavar="LONGITUDE|auto", help="Where an equirectangular texture is cut, in degrees.")
    ] = "180",
    size: Annotated[
        str | None,
        typer.Option(
            metavar="TEXELS|WxH|auto",
            callback=texture_width,
            help="Width; auto: no texel shows at 1024 pixels, up to 8192; the default for patterns, up to 4096.",
        ),
    ] = None,
    texture_format: Annotated[
        TextureFormat,
        typer.Option(help="Encoding of the pictures of a .glb; webp is smaller, and fewer viewers read it."),
    ] = TextureFormat.PNG,
    up: UpOption = None,
    front: FrontOption = None,
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
    """Texture a surface through its map to the sphere, with a picture or a pattern.

    Of a map to a torus the texture closes up both ways: a picture that repeats, circles or a checker.
    """
    from omtwarp.texturing import read_image
    from omtwarp.texturing.atlas import check_size
    from omtwarp.texturing.export import SUFFIXES, format_for

    given = meshes or []
    targets = targets_of(given, finished, output, ".glb")
    for target in targets:
        check_output(target, SUFFIXES, *given, finished, image)
        format_for(target.suffix.lower(), texture_format)
    if image is not None and pattern is not None:
        raise OmtwarpError("both --image and --pattern: give one")
    sides = sides_of(size)
    if sides is not None:
        check_size(sides)
    mapping: MapChoices = {
        "method": method,
        "until": until,
        "cost": cost,
        "scheme": scheme,
        "refine": refine,
        "solver": solver,
    }
    looks: LookKeywords = {
        "pattern": pattern,
        "projection": projection,
        "atlas": atlas,
        "rotate": rotation(rotate),
    }
    if uv is Coordinates.OWN or keep_materials is not None or bake:
        if size == "auto":
            raise OmtwarpError("--size auto is for an atlas only, without --uv own, --keep-materials and --bake")
        if isinstance(sides, tuple):
            raise OmtwarpError(
                "--size WIDTHxHEIGHT is for an atlas only, without --uv own, --keep-materials and --bake"
            )
        width = sides
        for target in targets:
            check_output(target, (".glb", ".obj"), *given, finished, image, detail)
        if seam != "180":
            raise OmtwarpError("--seam is for an equirectangular atlas only, without --keep-materials and --bake")

        def paint_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
            return _paint(
                mesh,
                finished,
                target,
                detail,
                bool(repair),
                quiet,
                verbose,
                mapping,
                up=up,
                front=front,
                image=image,
                uv=uv,
                keep=keep_materials,
                opacity=opacity,
                bake=bake or (),
                device=device,
                texture_format=texture_format,
                size=width,
                **looks,
            )

        show_each(given, targets, paint_one, as_json=as_json, quiet=quiet)
        return
    if detail is not None:
        raise OmtwarpError("--detail is for --bake normal: add that")
    cut = seam if seam == "auto" else one_number(seam, "--seam")
    start_device(device)
    picture = read_image(image) if image is not None else None

    def texture_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        _require_one(mesh, finished)
        result = map_from(
            mesh, finished, repair=repair, quiet=quiet, device=device, torus=True, verbose=verbose, **mapping
        )
        require_bijective(result, finished)
        result = standing(result, finished or mesh, up, front)
        with step_times(verbose) as done:
            inputs = mesh, finished, image
            made = _texture(result, target, inputs, picture, looks, size, cut, texture_format, device)
            done("texture")
        return made

    show_each(given, targets, texture_one, as_json=as_json, quiet=quiet)


def _texture(
    result: MapResult | TorusMap,
    output: Path,
    inputs: tuple[Path | None, ...],
    picture: NDArray[np.generic] | None,
    looks: LookKeywords,
    size: str | None,
    seam: float | str,
    texture_format: TextureFormat,
    device: str,
) -> tuple[dict[str, object], str]:
    """Write the surface of a map with an atlas.

    Args:
        result: the map.
        output: the file.
        inputs: files that must not be replaced.
        picture: what to put on it in place of a pattern.
        looks: the texture's options.
        size: as it was asked for.
        seam: longitude of the cut in degrees, or ``auto``.
        texture_format: of the picture in the file.
        device: where kernels run.

    Returns:
        The facts of what was written, and a line about them.
    """
    from omtwarp.maps.result import MapResult
    from omtwarp.texturing import texture

    chosen, blurred = sides_of(size), ""
    if size == "auto" or (size is None and picture is None and isinstance(result, MapResult)):
        chosen, blurred = _sharp_size(result, looks["atlas"], asked=size is not None)
    textured = texture(result, picture, seam_longitude=seam, size=chosen, device=device, **looks)
    files = textured.export(output, keep=inputs, texture_format=texture_format)
    height, width = textured.image.shape[:2]
    facts: dict[str, object] = {"output": str(output), "files": [str(file) for file in files]}
    facts |= {"vertices": len(result.vertices), "faces": len(result.faces)}
    facts |= {"pictures": [{"what": "colour", "width": width, "height": height}]}
    line = f"{output}: {sizes(result)}, textured, "
    line += f"{width} x {height} texels{blurred}{with_files(files)}"
    return facts, line


def _require_one(mesh: Path | None, finished: Path | None) -> None:
    """Refuse a mesh beside its map where nothing of the mesh's own is kept.

    Raises:
        OmtwarpError: both a mesh and a map are given.
    """
    if mesh is not None and finished is not None:
        raise OmtwarpError(
            "a mesh beside --map is for --uv own or --keep-materials: add one of them, or leave the mesh out"
        )


def _sharp_size(result: MapResult | TorusMap, atlas: str, *, asked: bool) -> tuple[int | tuple[int, int], str]:
    """Return the size at which no texel is visible, and a line about what even the largest size leaves blurred.

    Args:
        result: the map.
        atlas: name of the layout.
        asked: whether the size was asked for, which lets it be larger.

    Raises:
        OmtwarpError: the map is one to a torus.
    """
    from omtwarp.maps.result import MapResult
    from omtwarp.texturing.atlas import LARGEST_SIZE, LARGEST_UNASKED, sharp_size

    if not isinstance(result, MapResult):
        raise OmtwarpError("--size auto is for maps to the sphere: give texels for a map to a torus")
    limit = LARGEST_SIZE if asked else LARGEST_UNASKED
    chosen = sharp_size(result.vertices, result.faces, result.sphere, atlas, limit)
    share = f"; on {100.0 * chosen.coarse:.2g} % of the surface texels cover more than 1.5 pixels at 1024"
    share += "" if asked else " (--size auto goes up to 8192)"
    return chosen.size, share if chosen.coarse else ""


class LookKeywords(TypedDict):
    """The options that :func:`omtwarp.texture` and :func:`omtwarp.paint` share."""

    pattern: PatternName | None
    projection: ProjectionName
    atlas: AtlasName
    rotate: str | list[float] | None


class PaintKeywords(LookKeywords):
    """The options of :func:`omtwarp.paint` that the command line passes on."""

    uv: Coordinates
    size: int | None
    keep: Keep | None
    opacity: float
    bake: Sequence[str]


def _paint(
    mesh: Path | None,
    finished: Path | None,
    output: Path,
    detail: Path | None,
    repair: bool,
    quiet: bool,
    verbose: bool,
    mapping: MapChoices,
    *,
    up: str | None,
    front: str | None,
    image: Path | None,
    device: str,
    texture_format: TextureFormat,
    **options: Unpack[PaintKeywords],
) -> tuple[dict[str, object], str]:
    """Texture a mesh in its own coordinates, with its own materials, or with bakes.

    Returns:
        The facts of what was written, and a line about them.
    """
    from omtwarp.mesh.read import read_mesh
    from omtwarp.painting import paint
    from omtwarp.painting.bakes import MOST_RAYS
    from omtwarp.texturing import read_image

    start_device(device)
    picture = read_image(image) if image is not None else None
    fine = None
    if detail is not None:
        finer = read_mesh(detail, together=True)
        fine = (finer.vertices, finer.faces)
    painted = None
    if options["uv"] == "own" or options["keep"] is not None:
        if mesh is None or mesh.suffix.lower() == ".npz":
            raise OmtwarpError("--uv own and --keep-materials need the mesh itself: give it together with the map")
        painted, result = painted_map(
            mesh, finished, repair=repair, quiet=quiet, device=device, torus=True, verbose=verbose, **mapping
        )
        if options["uv"] == "own":
            painted.require_uv(str(mesh))
    else:
        _require_one(mesh, finished)
        result = map_from(
            mesh, finished, repair=repair, quiet=quiet, device=device, torus=True, verbose=verbose, **mapping
        )
        require_bijective(result, finished)
    result = standing(result, finished or mesh, up, front)
    with step_times(verbose) as done, warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", OmtwarpWarning)
        made = paint(result, painted, picture, detail=fine, device=device, **options)
        done("paint")
    for warning in caught:
        say(f"warning: {warning.message}")
    files = made.export(output, keep=(mesh, finished, image, detail), texture_format=texture_format)
    pictures = _pictures(made)
    facts: dict[str, object] = {"output": str(output), "files": [str(file) for file in files]}
    facts |= {"vertices": len(result.vertices)}
    facts |= {"faces": len(result.faces), "pictures": pictures}
    wanted = options["size"] or max((int(one["width"]) for one in pictures), default=0)
    drawn = [f"{one['material']} {one['what']} {one['width']} x {one['height']}" for one in pictures]
    if any(one["what"] == "occlusion" and int(one["width"]) < wanted for one in pictures):
        drawn.append(f"occlusion by {MOST_RAYS // 1_000_000} million rays at most")
    looks = ", ".join(dict.fromkeys(drawn)) or "no picture"
    return facts, f"{output}: {sizes(result)}, {looks}{with_files(files)}"


def _pictures(made: PaintedMesh) -> list[dict[str, str | int]]:
    """List the pictures of a mesh's materials: the material, what the picture shows, and its size."""
    found: list[dict[str, str | int]] = []
    for material in made.materials:
        for slot in ("picture", "occlusion_picture", "normal_picture"):
            picture = getattr(material, slot)
            if picture is not None:
                name = {"picture": "colour", "occlusion_picture": "occlusion", "normal_picture": "normals"}[slot]
                height, width = picture.shape[:2]
                found.append({"material": material.name, "what": name, "width": width, "height": height})
    return found


def rotation(text: str) -> str | list[float] | None:
    """Read the value of --rotate: ``auto``, or one to three angles in degrees (yaw, pitch, roll).

    Raises:
        OmtwarpError: the text has another form.
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
