"""``omtwarp preview``, ``film`` and ``report``: what a mesh or a map looks like."""

import time
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import omtwarp
from omtwarp.commands import _options
from omtwarp.commands._options import ROUTE, Argument, Only, PictureOrPattern, Printing, RouteOptions, Source, Typed
from omtwarp.commands._streams import input_file, progress_bar, step_times
from omtwarp.commands._work import map_from, refuse, show_each, start_device, targets_of
from omtwarp.errors import OmtwarpError
from omtwarp.options import BACKGROUND, FILM_RATE, PICTURE_SIZE, Backend, Device, MapOptions, tell

DEFAULT_SIZE = "x".join(map(str, PICTURE_SIZE))
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".gif", ".mp4")


class LightName(StrEnum):
    STUDIO, SOFT, FLAT = "studio", "soft", "flat"


class CameraProjection(StrEnum):
    PERSPECTIVE, ORTHOGRAPHIC = "perspective", "orthographic"


@dataclass(frozen=True)
class Lens:
    """How a camera forms its picture.

    Options:
        zoom: Enlargement; at 1 the surface fills the picture.
        field_of_view: Vertical opening of the camera in degrees.
        projection: Projection of the camera.
    """

    zoom: float = 1.0
    field_of_view: float = 24.0
    projection: CameraProjection = CameraProjection.PERSPECTIVE


@dataclass(frozen=True)
class PictureLook:
    """What a picture shows beside the surface's own colours, and how the surface stands.

    Options:
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
        front (AXIS): The axis that points at the viewer in the front view.
        light: Lights; flat shows the colours themselves.
        transparent: Leave the background out.
        wireframe: Draw the triangles' edges.
        background (COLOUR|studio): Colour behind the surface.
    """

    up: str | None = None
    front: str | None = None
    light: LightName = LightName.STUDIO
    background: str = BACKGROUND
    transparent: bool = False
    wireframe: bool = False


def run_preview(
    *,
    output: Annotated[Path, _options.output_option(".png")],
    subjects: Annotated[list[Path] | None, Argument(file=input_file)] = None,
    finished: Annotated[Path | None, Typed("--map", file=input_file)] = None,
    size: Annotated[str, Typed(read=_options.picture_size)] = DEFAULT_SIZE,
    view: list[str] | None = None,
    lens: Lens,
    look: PictureLook,
    image: Path | None = None,
    frames: Annotated[int | None, Typed(bounds=(1, None))] = None,
    fps: float = FILM_RATE,
    backend: Backend = Backend.AUTO,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Draw a surface without a display.

    Examples:
        omtwarp preview bunny.glb -o bunny.png --size 800x600
        omtwarp preview bunny.npz -o turning.gif --frames 36 --size 320

    Options:
        output: .png, .jpg, .webp, .tif; .gif or .mp4 for films; a directory for several.
        subjects (MESH): Meshes (textures and colours are shown) or maps (.npz), or -.
        finished (NPZ): A finished map (from 'omtwarp map') to be shown.
        view (NAME|AZIMUTH,ELEVATION): front, back, left, right, top, bottom, three-quarter, six, or degrees; repeat
            for more views.
        image (PICTURE): An equirectangular picture, shown through a map.
        frames: Number of frames of a turntable to draw.
        fps: Frames per second of the turntable.
        size (WIDTHxHEIGHT): Size of the picture in pixels.
        backend: What draws: OpenGL or the ray caster.
    """
    from omtwarp.render import Camera

    given = subjects or []
    if (not given and finished is None) or (len(given) == 1 and finished is not None):
        raise OmtwarpError("give either a mesh or map to draw, or a map with --map")
    targets = targets_of(Source(subjects, finished), output, ".png", PICTURES, image)
    film = frames is not None or output.suffix.lower() in (".gif", ".mp4")
    parallel = lens.projection is CameraProjection.ORTHOGRAPHIC
    refuse({
        "--fps is for films, with --frames": fps != FILM_RATE and not film,
        "--field-of-view is for --projection perspective": parallel and lens.field_of_view != Lens.field_of_view,
        "--background is not seen with --transparent": look.transparent and look.background != BACKGROUND,
    })  # fmt: skip

    def draw_one(subject: Path | None, target: Path) -> tuple[dict[str, object], str]:
        shown = subject or finished
        assert shown is not None
        with step_times(printing.verbose) as done:
            views = (view[0] if len(view) == 1 else view) if view else None
            asked = vars(look) | {"views": views, "frames": frames, "fps": fps, "image": image, "device": device}
            asked |= {"size": _options.as_size(size), "camera": Camera(**vars(lens)), "backend": backend}
            drawn = omtwarp.preview(shown, target, **asked)
            done("draw")
        first, count = (drawn[0], len(drawn)) if isinstance(drawn, list) else (drawn, 1)
        facts: dict[str, object] = {"output": str(target), "width": first.width, "height": first.height}
        facts |= {"frames": count, "bytes": target.stat().st_size}
        return facts, f"{target}: drawn, {first.width} x {first.height} pixels"

    show_each(given, targets, draw_one, printing)


FILMS = (".mp4", ".gif", ".webp")


@dataclass(frozen=True)
class FilmLook:
    """How a film shows a map: options of :func:`omtwarp.film`, by their names there.

    Options:
        view (NAME|AZIMUTH,ELEVATION): Direction of view, as for preview.
        seconds: Length in seconds; by default as long as smooth motion needs.
        fps: Frames per second; 30 by default, 20 for .gif and .webp.
        captions: Name what is seen below the picture.
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
        front (AXIS): The axis that points at the viewer in the front view.
        background (COLOUR|studio): Colour behind the surface.
        backend: What draws: OpenGL or the ray caster.
    """

    view: str = "three-quarter"
    up: str | None = None
    front: str | None = None
    background: str = "white"
    seconds: float | None = None
    fps: float | None = None
    captions: bool = True
    backend: Backend = Backend.AUTO


def run_film(
    *,
    output: Annotated[Path, _options.output_option(".gif")],
    source: Source,
    shown: PictureOrPattern,
    size: Annotated[str | None, Typed(read=_options.picture_size)] = None,
    look: FilmLook,
    mapping: Annotated[MapOptions, Only(name for name in ROUTE if name != "until")],
    printing: Printing,
) -> None:
    """Film a map without a display: it flows from conformal to optimal, then the surface turns into its sphere.

    A map to a torus ends as a ring torus, one to the disk as the disk, one of several parts as their spheres.

    Examples:
        omtwarp film bunny.ply -o flow.mp4
        omtwarp film --map bunny.npz -o flow.gif --size 480x270 --seconds 6

    Options:
        output: .mp4 (needs ffmpeg), .gif or .webp; a directory of .gif for several meshes.
        size (WIDTHxHEIGHT): Size in pixels; 1920x1080 by default, 640x360 for .gif and .webp.
    """
    from omtwarp.colors import backdrop
    from omtwarp.render.camera import Camera, as_view
    from omtwarp.render.output import check_target

    targets = targets_of(source, output, ".gif", FILMS, shown.image)
    for target in targets:
        check_target(target, film=True, transparent=False)
    backdrop(look.background, 1, 2)
    as_view(look.view, Camera())
    start_device(mapping.device)
    picture = shown.read()

    def film_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        result = map_from(mesh, source, mapping, printing)
        begun = time.perf_counter()
        frames = 0
        with progress_bar(printing.quiet) as progress:

            def notify(stage: str, done: int, total: int, facts: dict) -> None:
                nonlocal frames
                frames = total if stage == "film" else frames
                tell(progress, stage, done, total, facts)

            asked = vars(look) | picture | {"size": None if size is None else _options.as_size(size)}
            omtwarp.film(result, target, device=mapping.device, progress=notify, **asked)
        length = target.stat().st_size
        drawn = time.perf_counter() - begun
        facts: dict[str, object] = {"output": str(target), "frames": frames, "bytes": length}
        return facts, f"{target}: a film of {frames} frames, {length / 1e6:.1f} MB, drawn in {drawn:.1f} s"

    show_each(source.meshes, targets, film_one, printing)


def run_report(
    *,
    output: Annotated[Path, _options.output_option(".html")],
    source: Source,
    picture: PictureOrPattern,
    title: str | None = None,
    up: str | None = None,
    mapping: RouteOptions,
    printing: Printing,
) -> None:
    """Write a page about a map: 3D view, pictures, distortion, cost, stages and certificate in one HTML file.

    Examples:
        omtwarp report --map bunny.npz -o bunny.html

    Options:
        output: The page (.html), with everything in it; a directory for several meshes.
        title: Heading of the page; the mesh's name by default.
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
    """
    from omtwarp.render import gl_client

    gl_client.prepare()  # its process starts while others are imported and the map is read
    from omtwarp.render.camera import axis_vector

    targets = targets_of(source, output, ".html", (".html", ".htm"), picture.image)
    if up is not None:
        axis_vector(up)
    start_device(mapping.device)
    keywords = picture.read()

    def report_one(mesh: Path | None, target: Path) -> tuple[dict[str, object], str]:
        result, shown = map_from(mesh, source, mapping, printing), mesh or source.finished
        heading = title or (shown.stem if shown is not None else None)
        omtwarp.write_report(result, target, title=heading, up=up, device=mapping.device, **keywords)
        length = target.stat().st_size
        sizes = {"vertices": len(result.vertices), "faces": len(result.faces)}
        facts: dict[str, object] = {"output": str(target), "bytes": length, **sizes}
        return facts, f"{target}: a report of {length / 1e6:.1f} MB, to be opened in a browser"

    show_each(source.meshes, targets, report_one, printing)
