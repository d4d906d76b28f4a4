"""``omtwarp film``: the map flowing from conformal to optimal, and the surface turning into its sphere."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import ROUTE, Only, Printing, Shown, Source, as_size, output_option, picture_size
from omtwarp.commands._streams import progress_bar
from omtwarp.commands._work import map_from, show_each, start_device, targets_of
from omtwarp.options import Backend, MapOptions

FILMS = (".mp4", ".gif", ".webp")


@dataclass(frozen=True)
class Look:
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
    captions: Annotated[bool, typer.Option()] = True
    backend: Backend = Backend.AUTO


def run(
    *,
    output: Annotated[Path, output_option(".gif")],
    source: Source,
    shown: Shown,
    size: Annotated[str | None, typer.Option(metavar="WIDTHxHEIGHT", callback=picture_size)] = None,
    look: Look,
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
        size: Size in pixels; 1920x1080 by default, 640x360 for .gif and .webp.
    """
    from omtwarp.render.films import film
    from omtwarp.render.output import check_target

    targets = targets_of(source, output, ".gif", FILMS, shown.image)
    for target in targets:
        check_target(target, film=True, transparent=False)
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
                if progress is not None:
                    progress(stage, done, total, facts)

            film(
                result,
                target,
                size=None if size is None else as_size(size),
                device=mapping.device,
                progress=notify,
                **picture,
                **vars(look),
            )
        length = target.stat().st_size
        drawn = time.perf_counter() - begun
        facts: dict[str, object] = {"output": str(target), "frames": frames, "bytes": length}
        return facts, f"{target}: a film of {frames} frames, {length / 1e6:.1f} MB, drawn in {drawn:.1f} s"

    show_each(source.meshes, targets, film_one, printing)
