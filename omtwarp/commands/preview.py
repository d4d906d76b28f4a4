"""``omtwarp preview``: a picture of a mesh, a textured surface or a map."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import Printing, Source, as_size, output_option, picture_size, size_text
from omtwarp.commands._streams import input_file, step_times
from omtwarp.commands._work import show_each, targets_of
from omtwarp.errors import OmtwarpError
from omtwarp.options import BACKGROUND, FILM_RATE, PICTURE_SIZE, Backend, Device, MapOptions

if TYPE_CHECKING:
    from omtwarp.render import Camera

DEFAULT_SIZE = size_text(PICTURE_SIZE)
PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".gif", ".mp4")


class LightName(StrEnum):
    STUDIO = "studio"
    SOFT = "soft"
    FLAT = "flat"


class CameraProjection(StrEnum):
    PERSPECTIVE = "perspective"
    ORTHOGRAPHIC = "orthographic"


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

    def camera(self) -> Camera:
        """Return a camera with this lens."""
        from omtwarp.render import Camera

        return Camera(zoom=self.zoom, field_of_view=self.field_of_view, projection=self.projection.value)


@dataclass(frozen=True)
class Look:
    """What a picture shows beside the surface's own colours.

    Options:
        light: Lights; flat shows the colours themselves.
        transparent: Leave the background out.
        wireframe: Draw the triangles' edges.
        background (COLOUR|studio): Colour behind the surface.
    """

    light: LightName = LightName.STUDIO
    background: str = BACKGROUND
    transparent: bool = False
    wireframe: bool = False


@dataclass(frozen=True)
class Standing:
    """How the surface stands.

    Options:
        up (AXIS): The axis that points upwards: y, z, -x, ...; guessed by default.
        front (AXIS): The axis that points at the viewer in the front view.
    """

    up: str | None = None
    front: str | None = None


def run(
    *,
    output: Annotated[Path, output_option(".png")],
    subjects: Annotated[list[Path] | None, typer.Argument(metavar="MESH", callback=input_file)] = None,
    finished: Annotated[Path | None, typer.Option("--map", metavar="NPZ", callback=input_file)] = None,
    size: Annotated[str, typer.Option(metavar="WIDTHxHEIGHT", callback=picture_size)] = DEFAULT_SIZE,
    view: list[str] | None = None,
    lens: Lens,
    standing: Standing,
    look: Look,
    image: Path | None = None,
    frames: Annotated[int | None, typer.Option(min=1)] = None,
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
        subjects: Meshes (textures and colours are shown) or maps (.npz), or -.
        finished: A finished map (from 'omtwarp map') to be shown.
        view (NAME|AZIMUTH,ELEVATION): front, back, left, right, top, bottom, three-quarter, six, or degrees; repeat
            for more views.
        image (PICTURE): An equirectangular picture, shown through a map.
        frames: Number of frames of a turntable to draw.
        fps: Frames per second of the turntable.
        size: Size of the picture in pixels.
        backend: What draws: OpenGL or the ray caster.
    """
    from omtwarp.render import preview

    given = subjects or []
    if (not given and finished is None) or (len(given) == 1 and finished is not None):
        raise OmtwarpError("give either a mesh or map to draw, or a map with --map")
    targets = targets_of(Source(subjects, finished), output, ".png", PICTURES, image)

    def draw_one(subject: Path | None, target: Path) -> tuple[dict[str, object], str]:
        shown = subject or finished
        assert shown is not None
        with step_times(printing.verbose) as done:
            drawn = preview(
                shown,
                target,
                size=as_size(size),
                views=(view[0] if len(view) == 1 else view) if view else None,
                camera=lens.camera(),
                image=image,
                frames=frames,
                fps=fps,
                backend=backend,
                device=device,
                **vars(standing),
                **vars(look),
            )
            done("draw")
        first, count = (drawn[0], len(drawn)) if isinstance(drawn, list) else (drawn, 1)
        facts: dict[str, object] = {"output": str(target), "width": first.width, "height": first.height}
        facts |= {"frames": count, "bytes": target.stat().st_size}
        return facts, f"{target}: drawn, {first.width} x {first.height} pixels"

    show_each(given, targets, draw_one, printing)
