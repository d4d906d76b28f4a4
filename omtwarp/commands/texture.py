"""``omtwarp texture``: a picture or pattern on the sphere, pulled back to the surface."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import Printing, RouteOptions, Source, output_option
from omtwarp.commands._painted import painted_map, standing, with_objects
from omtwarp.commands._streams import step_times, warnings_as_lines
from omtwarp.commands._work import map_from, require_bijective, show_each, sizes, start_device, targets_of, with_files
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_output
from omtwarp.options import AtlasName, Coordinates, Keep, PatternName, ProjectionName, TextureFormat

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from omtwarp.maps.result import MapResult
    from omtwarp.maps.torus_map import TorusMap
    from omtwarp.options import MapOptions
    from omtwarp.texturing import PaintedMesh, TexturedSurface


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


@dataclass(frozen=True)
class Look:
    """The options that :func:`omtwarp.texture` and :func:`omtwarp.paint` share, by their names there.

    Options:
        pattern: A pattern instead of a picture.
        projection: How the picture covers the sphere; sinusoidal for pictures not made for one.
        atlas: Layout of the texture; equirectangular for tools that expect one.
        rotate (YAW[,PITCH,ROLL]|auto): Turn the texture on the sphere, in degrees.
    """

    pattern: PatternName | None = None
    projection: ProjectionName = ProjectionName.EQUIRECTANGULAR
    atlas: AtlasName = AtlasName.CUBE
    rotate: str = ""


@dataclass(frozen=True)
class Painting:
    """The options that :func:`omtwarp.paint` has in addition.

    Options:
        uv: Texture coordinates; own are the mesh's, with a picture for each material.
        keep_materials: Lay the pattern over the mesh's materials, or under them.
        opacity: Opacity of the upper layer, times its own, with --keep-materials.
        bake (normal|ao|curvature|area|FILE): What to bake: ao into the occlusion, normals of --detail into the normal
            map, others as the colour.
        detail (MESH): A finer mesh of the surface, for --bake normal.
    """

    uv: Annotated[Coordinates, typer.Option("--uv")] = Coordinates.ATLAS
    keep_materials: Keep | None = None
    opacity: Annotated[float, typer.Option(min=0.0, max=1.0)] = 0.5
    bake: list[str] | None = None
    detail: Path | None = None

    @property
    def of_the_mesh(self) -> bool:
        """Whether the mesh's own coordinates or materials are needed."""
        return self.uv is Coordinates.OWN or self.keep_materials is not None


@dataclass(frozen=True)
class Picture:
    """The options of the pictures that are written, and how the surface stands.

    Options:
        seam (LONGITUDE|auto): Where an equirectangular texture is cut, in degrees.
        size: Width; auto: no texel shows at 1024 pixels, up to 8192; the default for patterns, up to 4096.
        texture_format: Encoding of the pictures of a .glb; webp is smaller, and fewer viewers read it.
        image (PICTURE): An equirectangular picture to put on the surface.
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
        front (AXIS): The axis that points at the viewer in the front view.
    """

    image: Path | None = None
    seam: str = "180"
    size: Annotated[str | None, typer.Option(metavar="TEXELS|WxH|auto", callback=texture_width)] = None
    texture_format: TextureFormat = TextureFormat.PNG
    up: str | None = None
    front: str | None = None

    def cut(self) -> float | str:
        """Return the longitude of the seam in degrees, or ``auto``.

        Raises:
            OmtwarpError: it is no number.
        """
        return self.seam if self.seam == "auto" else one_number(self.seam, "--seam")

    def width(self) -> int | None:
        """Return the width of the pictures of a mesh's materials, None for the usual one.

        Raises:
            OmtwarpError: options are given that only an atlas by itself has.
        """
        if self.size == "auto":
            raise OmtwarpError("--size auto is for an atlas only, without --uv own, --keep-materials and --bake")
        sides = sides_of(self.size)
        if isinstance(sides, tuple):
            raise OmtwarpError(
                "--size WIDTHxHEIGHT is for an atlas only, without --uv own, --keep-materials and --bake"
            )
        if self.seam != "180":
            raise OmtwarpError("--seam is for an equirectangular atlas only, without --keep-materials and --bake")
        return sides


def run(
    *,
    output: Annotated[Path, output_option(".glb")],
    source: Source,
    look: Look,
    painting: Painting,
    picture: Picture,
    mapping: RouteOptions,
    printing: Printing,
) -> None:
    """Texture a surface through its map to the sphere, with a picture or a pattern.

    Of a map to a torus the texture closes up both ways: a picture that repeats, circles or a checker.

    Examples:
        omtwarp texture bunny.ply -o bunny.glb --pattern circles
        omtwarp texture left.ply right.ply -o textured --pattern globe
        omtwarp texture --map bunny.npz -o earth.obj --image earth.png
        omtwarp texture shoe.obj -o shoe.glb --uv own --keep-materials over --bake ao

    Options:
        output: .glb, .obj (with .mtl and .png) or .ply; a directory of .glb for several meshes.
    """
    from omtwarp.texturing import read_image, texture
    from omtwarp.texturing.atlas import check_size
    from omtwarp.texturing.export import SUFFIXES, format_for

    inputs = (*source.files, picture.image, painting.detail)
    targets = targets_of(source, output, ".glb", SUFFIXES, *inputs)
    by_materials = painting.of_the_mesh or bool(painting.bake)
    for target in targets:
        format_for(target.suffix.lower(), picture.texture_format)
    if picture.image is not None and look.pattern is not None:
        raise OmtwarpError("both --image and --pattern: give one")
    sides = sides_of(picture.size)
    if sides is not None:
        check_size(sides)
    width = None
    if by_materials:
        width = picture.width()
        for target in targets:
            check_output(target, (".glb", ".obj"))
    elif painting.detail is not None:
        raise OmtwarpError("--detail is for --bake normal: add that")
    # What cannot be read is refused before the work
    looks, seam = vars(look) | {"rotate": rotation(look.rotate)}, picture.cut()
    start_device(mapping.device)
    image = None if picture.image is None else read_image(picture.image)

    def texture_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        painted, result = _mapped(mesh, source, painting, mapping, printing)
        result = standing(result, source.finished or mesh, picture.up, picture.front)
        made: PaintedMesh | TexturedSurface
        with step_times(printing.verbose) as done:
            if by_materials:
                painted = painted or with_objects(mesh, result)
                made, pictures, words = _painted(result, painted, image, painting, width, mapping.device, look)
            else:
                size, blurred = _size_of(result, picture, look.atlas)
                made = textured = texture(result, image, seam_longitude=seam, size=size, device=mapping.device, **looks)
                named = with_objects(mesh, result)
                textured.objects, textured.face_object = named.objects, named.face_object
                rows, columns = textured.image.shape[:2]
                pictures = [{"what": "colour", "width": columns, "height": rows}]
                words = f"textured, {columns} x {rows} texels{blurred}"
            done("paint" if by_materials else "texture")
        files = made.export(target, keep=inputs, texture_format=picture.texture_format)
        facts: dict[str, object] = {"output": str(target), "files": [str(file) for file in files]}
        facts |= {"vertices": len(result.vertices), "faces": len(result.faces), "pictures": pictures}
        return facts, f"{target}: {sizes(result)}, {words}{with_files(files)}"

    show_each(source.meshes, targets, texture_one, printing)


def _mapped(
    mesh: Path | None, source: Source, painting: Painting, mapping: MapOptions, printing: Printing
) -> tuple[PaintedMesh | None, MapResult | TorusMap]:
    """Return the mesh's own coordinates and materials where they are needed, and the map.

    Raises:
        OmtwarpError: a mesh is missing, or stands beside its map where nothing of the mesh's own is needed.
    """
    if not painting.of_the_mesh:
        if mesh is not None and source.finished is not None:
            raise OmtwarpError(
                "a mesh beside --map is for --uv own or --keep-materials: add one of them, or leave the mesh out"
            )
        result = map_from(mesh, source, mapping, printing)
        require_bijective(result, source.finished)
        return None, result
    if mesh is None or mesh.suffix.lower() == ".npz":
        raise OmtwarpError("--uv own and --keep-materials need the mesh itself: give it together with the map")
    painted, result = painted_map(mesh, source, mapping, printing)
    if painting.uv is Coordinates.OWN:
        painted.require_uv(str(mesh))
    return painted, result


def _size_of(result: MapResult | TorusMap, picture: Picture, atlas: str) -> tuple[int | tuple[int, int] | None, str]:
    """Return the size of an atlas, None for the usual one, and words about what even the largest leaves blurred.

    Raises:
        OmtwarpError: ``auto`` for a map to a torus.
    """
    from omtwarp.maps.result import MapResult
    from omtwarp.texturing.atlas import LARGEST_SIZE, LARGEST_UNASKED, sharp_size

    asked = picture.size == "auto"
    if not asked and (picture.size is not None or picture.image is not None or not isinstance(result, MapResult)):
        return sides_of(picture.size), ""
    if not isinstance(result, MapResult):
        raise OmtwarpError("--size auto is for maps to the sphere: give texels for a map to a torus")
    limit = LARGEST_SIZE if asked else LARGEST_UNASKED
    chosen, coarse = sharp_size(result.vertices, result.faces, result.sphere, atlas, limit)
    share = f"; on {100.0 * coarse:.2g} % of the surface texels cover more than 1.5 pixels at 1024"
    share += "" if asked else " (--size auto goes up to 8192)"
    return chosen, share if coarse else ""


def _painted(
    result: MapResult | TorusMap,
    painted: PaintedMesh | None,
    image: NDArray[np.generic] | None,
    painting: Painting,
    size: int | None,
    device: str,
    look: Look,
) -> tuple[PaintedMesh, list[dict[str, str | int]], str]:
    """Return a mesh in its own coordinates, with its own materials, or with bakes; its pictures, and words on them."""
    from omtwarp.mesh.read import read_mesh
    from omtwarp.texturing import paint
    from omtwarp.texturing.bakes import MOST_RAYS

    fine = None
    if painting.detail is not None:
        finer = read_mesh(painting.detail, together=True)
        fine = (finer.vertices, finer.faces)
    with warnings_as_lines():
        made = paint(
            result,
            painted,
            image,
            uv=painting.uv,
            keep=painting.keep_materials,
            opacity=painting.opacity,
            bake=painting.bake or (),
            detail=fine,
            size=size,
            device=device,
            **vars(look) | {"rotate": rotation(look.rotate)},
        )
    pictures = _pictures(made)
    wanted = size or max((int(one["width"]) for one in pictures), default=0)
    drawn = [f"{one['material']} {one['what']} {one['width']} x {one['height']}" for one in pictures]
    if any(one["what"] == "occlusion" and int(one["width"]) < wanted for one in pictures):
        drawn.append(f"occlusion by {MOST_RAYS / 1e6:.3g} million rays at most")
    return made, pictures, ", ".join(dict.fromkeys(drawn)) or "no picture"


def _pictures(made: PaintedMesh) -> list[dict[str, str | int]]:
    """List the pictures of a mesh's materials: the material, what the picture shows, and its size."""
    pictures: list[dict[str, str | int]] = []
    for material in made.materials:
        shown = (material.picture, material.occlusion_picture, material.normal_picture)
        for name, picture in zip(("colour", "occlusion", "normals"), shown, strict=True):
            if picture is not None:
                height, width = picture.shape[:2]
                pictures.append({"material": material.name, "what": name, "width": width, "height": height})
    return pictures


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
