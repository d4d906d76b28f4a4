"""``omtwarp texture``, ``unwrap`` and ``transfer``: texture coordinates, pictures and materials through maps."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import omtwarp
from omtwarp import options
from omtwarp.commands import _work
from omtwarp.commands._options import Argument, Only, Printing, RouteOptions, Source, Typed, output_option
from omtwarp.commands._streams import input_file, step_times, warnings_as_lines
from omtwarp.errors import OmtwarpError, naming
from omtwarp.files.output import check_output
from omtwarp.options import Coordinates, Device, Domain, MapOptions

if TYPE_CHECKING:
    from omtwarp.maps.result import MapResult


def read_sound_painted(path: Path, repair: bool) -> tuple[omtwarp.PaintedMesh, omtwarp.Surface]:
    """Read a mesh with its coordinates and materials, and make sure that it can be mapped.

    Raises:
        OmtwarpError: the file cannot be read, or its mesh cannot be mapped.
    """
    mesh = omtwarp.read_painted_mesh(path)
    surface, repaired = _work.sound_surface(path, mesh.vertices, mesh.faces, list(mesh.notes), repair)
    if repaired is not None:
        surface.origins = repaired
        mesh = mesh.on(repaired.vertices, repaired.faces, repaired.face_origin)
    return mesh, surface


def objects_of(path: Path | None, result: MapResult) -> dict:
    """Return the names of objects in the file that a map is from, and whose each face is, as fields of meshes.

    Faces that the file has not get its first name.

    Args:
        path: the file; one that is no OBJ has no names.
        result: the map that was made of it.
    """
    import numpy as np

    from omtwarp.texturing.read import read_objects

    names, numbers = ((), None) if path is None else read_objects(path)
    if numbers is None:
        return {}
    origin = np.arange(len(result.faces)) if result.origins is None else result.origins.face_origin
    return {"objects": names, "face_object": np.where(origin < 0, 0, numbers[origin])}


def painted_with_map(
    path: Path, of_map: Path | None, repair: bool
) -> tuple[omtwarp.PaintedMesh, MapResult | omtwarp.Surface]:
    """Return a mesh with its materials and its map, or the surface to be mapped where there is no file of a map.

    Raises:
        OmtwarpError: the mesh or the map cannot be used, or the map is of another mesh.
    """
    if of_map is None:
        return read_sound_painted(path, repair)
    result = omtwarp.MapResult.load(of_map)
    _work.require_bijective(result, of_map)
    mesh = omtwarp.read_painted_mesh(path)
    if repair and len(mesh.faces) != len(result.faces):
        mesh, _ = read_sound_painted(path, repair)
    else:
        _work.say_notes(path, mesh.notes)
    with naming(f"{of_map} and {path}"):
        mesh.on(result.vertices, result.faces, origins=result.origins)
    return mesh, result


def mapped(given: MapResult | omtwarp.Surface, path: Path, mapping: MapOptions, printing: Printing) -> MapResult:
    """Return the map of a file; that of a surface is made, and it is said how well."""
    if not isinstance(given, omtwarp.Surface):
        return given
    made = _work.map_on_the_way(given, path, mapping, printing)
    _work.require_bijective(made)
    return made


def standing(result: MapResult, source: Path | None, up: str | None, front: str | None) -> MapResult:
    """Turn a map so that pictures on its sphere stand upright on the surface, with their middle in front.

    The sphere is turned as near as it can be to the directions that points have from the surface's centre, with the
    upward axis at the north pole, where the upper border of a picture is, and the front axis at longitude 0.

    Args:
        result: a map; one that is not to a single whole sphere is returned as it is.
        source: the file of the mesh, or of the map: this keeps its poles, which may be aligned, unless axes are given.
        up: the axis upwards, guessed from the shape by default.
        front: the axis towards the viewer, guessed in the same way.

    Raises:
        OmtwarpError: an axis has another name, the two are parallel, or axes are given for another domain.
    """
    import numpy as np

    from omtwarp.geometry.axes import rotation_onto_axes
    from omtwarp.render.camera import Camera, camera_axes
    from omtwarp.render.scene import SurfaceView
    from omtwarp.render.subject import posed

    given = up is not None or front is not None
    if source is not None and source.suffix.lower() == ".npz" and not given:
        return result
    if result.domain != Domain.SPHERE or result.part is not None:
        if given:
            raise OmtwarpError("--up and --front are for maps of one surface to the whole sphere: leave them out")
        return result
    pose = posed(SurfaceView(result.vertices, result.faces), up, front)
    right, above, ahead = camera_axes(Camera(azimuth=0.0, elevation=0.0), pose.up or "y", pose.front).T
    surface = omtwarp.Surface(result.vertices, result.faces)
    turn, certain = rotation_onto_axes(surface, result.sphere, np.stack([ahead, right, above]))
    return result.turned(turn.T) if certain else result


def texture_width(given: object) -> str:
    """Check what --size is given: one or two whole numbers, or auto; return it unchanged.

    Raises:
        OmtwarpError: it is none of these.
    """
    text = str(given)
    sides = [] if text == "auto" else text.split("x")
    if not all(side.isascii() and side.isdigit() and 0 < int(side[:9]) for side in sides) or len(sides) > 2:
        raise OmtwarpError(f"'{text}' is not a size: use a width in texels, 4096x2048 for both sides, or auto")
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

    pattern: options.PatternName | None = None
    projection: options.ProjectionName = options.ProjectionName.EQUIRECTANGULAR
    atlas: options.AtlasName = options.AtlasName.CUBE
    rotate: str = ""


@dataclass(frozen=True)
class Painting:
    """The options that :func:`omtwarp.paint` has in addition.

    Options:
        uv: Texture coordinates; own are the mesh's, with a picture for each material.
        keep_materials: Lay the pattern over the mesh's materials, or under them.
        opacity: Opacity of the upper layer, times its own, with --keep-materials; 0.5 by default.
        bake (normal|ao|curvature|area|FILE): What to bake: ao into the occlusion, normals of --detail into the normal
            map, others as the colour.
        detail (MESH): A finer mesh of the surface, for --bake normal.
    """

    uv: Coordinates = Coordinates.ATLAS
    keep_materials: options.Keep | None = None
    opacity: Annotated[float | None, Typed(bounds=(0.0, 1.0))] = None
    bake: list[str] | None = None
    detail: Path | None = None

    @property
    def by_materials(self) -> str:
        """The given options by which each material gets pictures of its own, in words; empty without any."""
        own, keep = self.uv is Coordinates.OWN, self.keep_materials is not None
        given = {"--uv own": own, "--keep-materials": keep, "--bake": bool(self.bake)}
        return " and ".join(name for name, there in given.items() if there)

    @property
    def bakes_alone(self) -> bool:
        """Whether materials get nothing but bakes, on their own coordinates."""
        return self.uv is Coordinates.OWN and self.keep_materials is None and bool(self.bake)


@dataclass(frozen=True)
class Picture:
    """The options of the pictures that are written, and how the surface stands.

    Options:
        seam (LONGITUDE|auto): Where an equirectangular texture is cut, in degrees.
        size (TEXELS|WxH|auto): Width; auto: no texel shows at 1024 pixels, up to 8192; the default for patterns, up to
            4096.
        texture_format: Encoding of the pictures of a .glb; webp is smaller, and fewer viewers read it.
        image (PICTURE): An equirectangular picture to put on the surface.
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
        front (AXIS): The axis that points at the viewer in the front view.
    """

    image: Path | None = None
    seam: str = "180"
    size: Annotated[str | None, Typed(read=texture_width)] = None
    texture_format: options.TextureFormat = options.TextureFormat.PNG
    up: str | None = None
    front: str | None = None

    def cut(self) -> float | str:
        """Return the longitude of the seam in degrees, or ``auto``.

        Raises:
            OmtwarpError: it is no number.
        """
        return self.seam if self.seam == "auto" else one_number(self.seam, "--seam")


def _width_for(targets: list[Path], look: Look, painting: Painting, picture: Picture) -> int | None:
    """Return the width of the pictures of a mesh's materials, None for the usual one and for an atlas by itself.

    Raises:
        OmtwarpError: options that do not go together.
    """
    from omtwarp.texturing.atlas import check_size
    from omtwarp.texturing.painter import check_options, color_among
    from omtwarp.texturing.textured import check_projection

    if picture.image is not None and look.pattern is not None:
        raise OmtwarpError("both --image and --pattern: give one")
    check_options(painting.uv, painting.keep_materials, painting.opacity, look.atlas)
    check_projection(look.projection, picture.image)
    if painting.bakes_alone and picture.image is None and look.pattern is None:
        turns = {"--rotate": look.rotate, "--up": picture.up, "--front": picture.front}
        words = "turns pictures and patterns, and none is drawn with --uv own"
        _work.refuse({f"{name} {words}": given for name, given in turns.items()})
    sides = sides_of(picture.size)
    if sides is not None:
        check_size(sides)
    if picture.seam != "180" and (painting.by_materials or look.atlas is not options.AtlasName.EQUIRECTANGULAR):
        raise OmtwarpError("--seam is for --atlas equirectangular without --uv own, --keep-materials and --bake")
    if not painting.by_materials:
        if painting.detail is not None:
            raise OmtwarpError("--detail is for --bake normal: add that")
        return None
    if isinstance(sides, tuple) or picture.size == "auto":
        raise OmtwarpError(f"--size {picture.size} is for an atlas, without --uv own, --keep-materials and --bake")
    if ply := [target for target in targets if target.suffix.lower() == ".ply"]:
        raise OmtwarpError(f"{ply[0]}: PLY holds no materials: use .glb or .obj, or leave out {painting.by_materials}")
    color_among(painting.bake or (), bool(painting.detail), look.pattern, picture.image, painting.keep_materials)
    return sides


def run_texture(
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
    from omtwarp.texturing import read_image
    from omtwarp.texturing.export import SUFFIXES, format_for

    inputs = (*source.files, picture.image, painting.detail)
    targets = _work.targets_of(source, output, ".glb", SUFFIXES, *inputs)
    by_materials = painting.by_materials
    for target in targets:
        format_for(target.suffix.lower(), picture.texture_format)
    width = _width_for(targets, look, painting, picture)
    # What cannot be read is refused before the work
    looks, seam = vars(look) | {"rotate": rotation(look.rotate), "device": mapping.device}, picture.cut()
    paints = looks | vars(painting) | {"size": width, "bake": painting.bake or ()}
    paints["keep"] = paints.pop("keep_materials")
    if painting.detail is not None:
        paints["detail"] = omtwarp.read_mesh(painting.detail, together=True)
    _work.start_device(mapping.device)
    image = None if picture.image is None else read_image(picture.image)

    def texture_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        painted, result = _mapped(mesh, source, painting, mapping, printing)
        result = standing(result, source.finished or mesh, picture.up, picture.front)
        with step_times(printing.verbose) as done:
            if by_materials:
                painted = painted or omtwarp.PaintedMesh(result.vertices, result.faces, **objects_of(mesh, result))
                with warnings_as_lines():
                    made = omtwarp.paint(result, painted, image, **paints)
                pictures, words = _drawn(made, width)
            else:
                size, blurred = _size_of(result, picture, look.atlas)
                made = omtwarp.texture(result, image, seam_longitude=seam, size=size, **looks)
                names = objects_of(mesh, result)
                if names and made.layout is not None:
                    names["face_object"] = names["face_object"][made.layout.cut.source_face]
                made, (rows, columns) = replace(made, **names), made.image.shape[:2]
                pictures = [{"what": "colour", "width": columns, "height": rows}]
                words = f"textured, {columns} x {rows} texels{blurred}"
            done("paint" if by_materials else "texture")
        files = made.export(target, keep=inputs, texture_format=picture.texture_format)
        facts: dict[str, object] = {"output": str(target), "files": [str(file) for file in files]}
        facts |= {"vertices": len(result.vertices), "faces": len(result.faces), "pictures": pictures}
        return facts, f"{target}: {_work.sizes(_work.counts_of(result))}, {words}{_work.with_files(files)}"

    _work.show_each(source.meshes, targets, texture_one, printing)


def _mapped(
    mesh: Path | None, source: Source, painting: Painting, mapping: MapOptions, printing: Printing
) -> tuple[omtwarp.PaintedMesh | None, MapResult]:
    """Return the mesh's own coordinates and materials where they are needed, and the map.

    Raises:
        OmtwarpError: a mesh is missing, or stands beside its map where nothing of the mesh's own is needed.
    """
    own_coordinates = painting.uv is Coordinates.OWN
    if not own_coordinates and painting.keep_materials is None:
        if mesh is not None and source.finished is not None:
            raise OmtwarpError(
                "a mesh beside --map is for --uv own or --keep-materials: add one of them, or leave the mesh out"
            )
        result = _work.map_from(mesh, source, mapping, printing)
        _work.require_bijective(result, source.finished)
        return None, result
    if mesh is None or mesh.suffix.lower() == ".npz":
        raise OmtwarpError("--uv own and --keep-materials need the mesh itself: give it together with the map")
    painted, surface = painted_with_map(mesh, source.finished, source.repair)
    if own_coordinates:
        painted.require_uv(str(mesh))
    return painted, mapped(surface, mesh, mapping, printing)


def _size_of(result: MapResult, picture: Picture, atlas: str) -> tuple[int | tuple[int, int] | None, str]:
    """Return the size of an atlas, None for the usual one, and words about what even the largest leaves blurred.

    Raises:
        OmtwarpError: ``auto`` for a map to a torus.
    """
    from omtwarp.texturing.atlas import LARGEST_SIZE, LARGEST_UNASKED, sharp_size

    asked = picture.size == "auto"
    if not asked and (picture.size is not None or picture.image is not None or result.domain == Domain.TORUS):
        return sides_of(picture.size), ""
    if result.domain == Domain.TORUS:
        raise OmtwarpError("--size auto is for maps to the sphere: give texels for a map to a torus")
    limit = LARGEST_SIZE if asked else LARGEST_UNASKED
    chosen, coarse = sharp_size(result.vertices, result.faces, result.sphere, atlas, limit)
    share = f"; on {100.0 * coarse:.2g} % of the surface texels cover more than 1.5 pixels at 1024"
    share += "" if asked else " (--size auto goes up to 8192)"
    return chosen, share if coarse else ""


def _drawn(made: omtwarp.PaintedMesh, size: int | None) -> tuple[list[dict[str, str | int]], str]:
    """List the pictures of a mesh's materials, with what each shows and its size, and return words on them."""
    from omtwarp.texturing.bakes import MOST_RAYS

    pictures: list[dict[str, str | int]] = []
    for material in made.materials:
        shown = (material.picture, material.occlusion_picture, material.normal_picture)
        for name, picture in zip(("colour", "occlusion", "normals"), shown, strict=True):
            if picture is not None:
                height, width = picture.shape[:2]
                pictures.append({"material": material.name, "what": name, "width": width, "height": height})
    wanted = size or max((int(one["width"]) for one in pictures), default=0)
    drawn = [f"{one['material']} {one['what']} {one['width']} x {one['height']}" for one in pictures]
    if any(one["what"] == "occlusion" and int(one["width"]) < wanted for one in pictures):
        drawn.append(f"occlusion by {MOST_RAYS / 1e6:.3g} million rays at most")
    return pictures, ", ".join(dict.fromkeys(drawn)) or "no picture"


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


def run_unwrap(
    *,
    output: Annotated[Path, output_option(".glb")],
    source: Source,
    aspect: Annotated[float, Typed(bounds=(0.1, 10.0))] = 1.0,
    margin: Annotated[float, Typed(bounds=(0.0, 0.1))] = 1.0 / 128.0,
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

    targets = _work.targets_of(source, output, ".glb", (".glb", ".obj"))
    _work.start_device(mapping.device)

    def unwrap_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        result = _work.map_from(mesh, source, mapping, printing)
        _work.require_bijective(result, source.finished)
        result = standing(result, source.finished or mesh, up, front)
        made, charts = laid_out(result, aspect=aspect, margin=margin)
        made = replace(made, **objects_of(mesh, result))
        files = made.export(target, keep=(mesh, source.finished))
        facts = {"output": str(target), "files": [str(file) for file in files], "vertices": len(made.vertices)}
        facts |= {"faces": len(made.faces), "charts": charts}
        line = f"{target}: {len(made.vertices)} vertices, {len(made.faces)} faces, "
        return facts, line + f"{charts} chart{'s' if charts > 1 else ''}{_work.with_files(files)}"

    _work.show_each(source.meshes, targets, unwrap_one, printing)


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
    uv: Coordinates = Coordinates.ATLAS
    atlas: options.AtlasName = options.AtlasName.CUBE
    size: Annotated[int | None, Typed(bounds=(16, None))] = None


def run_transfer(
    *,
    source: Annotated[Path, Argument(file=input_file)],
    target: Annotated[Path, Argument(file=input_file)],
    output: Annotated[Path, output_option(".glb")],
    printing: Printing,
    map_of_source: Annotated[Path | None, Typed("--map-from", file=input_file)] = None,
    map_of_target: Annotated[Path | None, Typed("--map-to", file=input_file)] = None,
    how: How,
    repair: bool = False,
    device: Device = MapOptions.device,
) -> None:
    """Carry the texture of one mesh over to another, each mapped to the sphere and the two aligned.

    Examples:
        omtwarp transfer scan.glb template.ply -o painted.glb

    Options:
        source (FROM): A mesh with a texture or colours, or -.
        target (TO): The mesh that gets the texture, or -.
        output: .glb or .obj.
        map_of_source (NPZ): A finished map of FROM.
        map_of_target (NPZ): A finished map of TO.
        repair: Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.
    """
    from omtwarp.texturing.painter import check_options

    check_options(how.uv, None, None, how.atlas)
    _work.refuse({"--mirror is for maps that are to be aligned, without --aligned": how.aligned and how.mirror})
    check_output(output, (".glb", ".obj"), source, target, map_of_source, map_of_target)
    given = (source, map_of_source), (target, map_of_target)
    pairs = [painted_with_map(*one, repair) for one in given]  # all are read before the first is mapped
    scan = pairs[0][0]
    if scan.vertex_colors is None and len(scan.materials) == 1 and scan.materials[0].picture is None:
        raise OmtwarpError(f"nothing to transfer: '{source}' has neither a picture nor colours")
    for (_, known), (_, of_map) in zip(pairs, given, strict=True):
        if of_map is not None:
            _work.require_whole(cast("MapResult", known), of_map)
    mapping = MapOptions(device=device)
    maps = [mapped(surface, path, mapping, printing) for (_, surface), (path, _) in zip(pairs, given, strict=True)]
    (painted, plain), (result, other) = (mesh for mesh, _ in pairs), maps
    with warnings_as_lines():
        made = omtwarp.transfer_texture(painted, result, other, onto=plain, device=device, **vars(how))
    files = made.export(output, keep=(source, target, map_of_source, map_of_target))
    facts: dict[str, object] = {"output": str(output), "files": [str(file) for file in files], "from": str(source)}
    facts |= {"vertices": len(other.vertices), "faces": len(other.faces)}
    line = f"{output}: {_work.sizes(_work.counts_of(other))}, with the texture of {source}{_work.with_files(files)}"
    _work.show_facts(facts, line, printing)
