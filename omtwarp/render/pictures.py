"""Pictures of surfaces, maps and fields, offscreen: the public functions ``preview``, ``sheet`` and ``comparison``."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import TypeVar, Unpack

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import as_path
from omtwarp.render import annotate, gl_client, output
from omtwarp.render.arrows import arrow_part
from omtwarp.render.camera import VIEWS, Camera, as_light, frame
from omtwarp.render.options import (
    PANEL_DEFAULTS,
    PREVIEW_DEFAULTS,
    SMALLEST_VIEW,
    PanelOptions,
    PreviewOptions,
    cameras_of,
    complete,
    takes,
    view_of,
)
from omtwarp.render.scene import RenderJob, Wireframe, build_parts, normalised_points
from omtwarp.render.subject import FinishedMap, Subject, map_view

Result = TypeVar("Result")

logger = logging.getLogger("omtwarp.render")
PANEL_SIZE = (512, 512)  # pixels of a panel of a sheet, so that four are as large as one preview
_told: set[str] = set()


@takes(PreviewOptions, PREVIEW_DEFAULTS)
def preview(
    subject: Subject, path: str | os.PathLike[str] | None = None, **options: Unpack[PreviewOptions]
) -> Image.Image | list[Image.Image]:
    """Draw a surface and, if a path is given, write the picture there.

    Args:
        subject: a mesh file, a ``trimesh.Trimesh``, a ``MapResult`` or its .npz file, a ``TexturedSurface``,
            (vertices, faces), or a :class:`SurfaceView`. Textures and colours of files and meshes are kept.
        path: .png, .jpg, .webp, .tif, .gif or .mp4; the file appears whole or not at all. With ``frames`` a .webp is
            a film, too.
        size: width and height of a view in pixels.
        views: a name (front, back, left, right, top, bottom, three-quarter), ``"AZ,EL"`` or (azimuth, elevation) in
            degrees, a :class:`Camera`, a list of these, or ``"six"``. Several views make one sheet, all at one scale.
        camera: field of view, projection, zoom, roll and, without ``views``, the direction.
        up: axis that points upwards (``"y"``, ``"z"``, ``"-x"``, ...); None guesses from the shape, by its plane of
            symmetry and by how it stands; z for a sphere.
        front: axis that points at the viewer in the front view; None guesses on which side the face is, and otherwise
            takes +z, or -y where z is up.
        light: ``"studio"``, ``"soft"``, ``"flat"`` (the colours themselves) or a :class:`Light`; None takes the
            first, and the second where a scalar is to be read.
        background: a colour, (top, bottom) colours, or ``"studio"``.
        transparent: leave the background out.
        wireframe: draw the triangles' edges.
        image: equirectangular picture for a subject that has points on the sphere.
        scalar: a number per vertex [V] or face [F], or a :class:`ScalarField`; replaces the subject's own colours.
        colormap: viridis, magma, cividis, coolwarm, turbo, gray, their ``_r`` reversals, or any of Matplotlib's.
        scalar_range: values at the ends of the colour map; None takes the smallest and largest.
        scalar_label: text above the colour bar.
        color_bar: draw it where there is a scalar.
        arrows: a vector per vertex [V, 3] or face [F, 3], or :class:`Arrows`.
        frames: draw a turntable of so many frames instead; a .gif or .mp4 path implies 36.
        fps: frames per second of the film.
        captions: name the views in a sheet; or the captions themselves.
        samples: supersampling along each side of a pixel, 1 to 4, in addition to multisampling and filtered textures;
            by default 2 where edges are drawn and 1 elsewhere.
        backend: ``"pyrender"`` (OpenGL), ``"warp"`` (ray caster) or ``"auto"``: OpenGL where it works.
        device: where the ray caster runs: ``auto``, ``cpu`` or ``cuda:N``.

    Returns:
        A PIL image (RGB, or RGBA if transparent), or the list of frames. ``image.info["backend"]`` says what drew it.

    Raises:
        OmtwarpError: a subject that cannot be read or drawn, an option that makes no sense, an output that cannot be
            written, or OpenGL asked for where there is none.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> omtwarp.preview((surface.vertices, surface.faces), "blob.png", size=(120, 90), backend="warp").size
        (120, 90)
    """
    frames = options.get("frames")
    if path is not None and frames is None and str(as_path(path)).lower().endswith((".gif", ".mp4")):
        # Turntable frames: 10 degrees each
        options["frames"] = 36
    film = options.get("frames") is not None
    target = (
        None if path is None else output.check_target(path, film=film, transparent=options.get("transparent", False))
    )
    chosen = complete(options, "preview")
    cameras = cameras_of(chosen)
    if film:
        images = _draw(subject, chosen, cameras, clear=chosen["transparent"])
        if target is not None:
            output.save_film(images, target, chosen["fps"])
        return images
    several = len(cameras) > 1
    names = _captions(chosen["captions"], cameras) if several else []
    images = _draw(subject, chosen, cameras, clear=chosen["transparent"] or several)
    return _finished(images, names, target, chosen) if several else _written(images[0], target)


@takes(PanelOptions, PANEL_DEFAULTS | {"size": PANEL_SIZE})
def sheet(
    panels: Sequence[Subject | Image.Image],
    path: str | os.PathLike[str] | None = None,
    *,
    captions: Sequence[str] | None = None,
    columns: int | None = None,
    title: str = "",
    **options: Unpack[PanelOptions],
) -> Image.Image:
    """Put several subjects into one picture, each over its caption.

    Args:
        panels: subjects of :func:`preview` (each framed to fill its panel) or finished PIL images.
        path: where to write the sheet; None writes nothing.
        captions: one text per panel; None takes the ``caption`` of each :class:`SurfaceView`.
        columns: panels in a row; None chooses.
        title: text above all.
        **options: those of :func:`preview` for every panel, with one view; ``size`` is that of a panel in pixels.

    Returns:
        A PIL image, RGB or RGBA if transparent.

    Raises:
        OmtwarpError: as :func:`preview`; no panels; or as many captions as panels are not given.
    """
    panels = list(panels)
    if not panels:
        raise OmtwarpError("a sheet needs at least one panel")
    if captions is not None and len(captions) != len(panels):
        raise OmtwarpError(f"{len(captions)} captions given for {len(panels)} panels")
    if unknown := sorted(set(options) - PANEL_DEFAULTS.keys()):
        raise OmtwarpError(f"a sheet takes no option '{unknown[0]}': see preview for those of its panels")
    chosen = complete({"size": PANEL_SIZE, **options}, "sheet")
    cameras = cameras_of(chosen)
    if len(cameras) > 1:
        raise OmtwarpError(f"a sheet draws each panel from one view, but {len(cameras)} were given")
    target = None if path is None else output.check_target(path, film=False, transparent=chosen["transparent"])
    images, names = [], []
    for panel in panels:
        if isinstance(panel, Image.Image):
            images.append(panel)
            names.append("")
            continue
        images.extend(_draw(panel, chosen, cameras, clear=True))
        names.append(str(getattr(panel, "caption", "")))
    return _finished(images, list(captions or names), target, chosen, columns=columns, title=title)


@takes(PanelOptions, PANEL_DEFAULTS | {"size": PANEL_SIZE})
def comparison(
    result: FinishedMap, path: str | os.PathLike[str] | None = None, **options: Unpack[PanelOptions]
) -> Image.Image:
    """Draw a sheet of a map: the surface textured by the conformal and the optimal map, and the sphere with both.

    Args:
        result: a ``MapResult`` with ``vertices``, ``faces``, ``sphere`` and ``conformal``.
        path: where to write the sheet; None writes nothing.
        **options: as :func:`sheet`; ``image`` is the picture on all four (a checker by default), ``up`` the surface's
            upward axis.

    Returns:
        A PIL image of two rows: the surface above, the sphere with the mesh's edges below.

    Raises:
        OmtwarpError: as :func:`sheet`, or the map has no conformal stage.
    """
    image, up = options.pop("image", None), options.pop("up", None)
    above = [
        map_view(result, image, which="conformal", caption="conformal"),
        map_view(result, image, which="optimal", caption="optimal transport"),
    ]
    if up is not None:
        above = [replace(view, up=up) for view in above]
    below = [
        replace(map_view(result, image, which=which, on="sphere", caption=f"sphere, {name}"), edges=True)
        for which, name in (("conformal", "conformal"), ("optimal", "optimal transport"))
    ]
    return sheet([*above, *below], path, columns=2, **options)


def _captions(given: bool | Sequence[str], cameras: list[Camera]) -> list[str]:
    """Return the caption of each view of a sheet: none, the view's name, or the given text."""
    if given is False:
        return [""] * len(cameras)
    if given is True:
        return [_view_name(camera) for camera in cameras]
    names = [str(caption) for caption in given]
    if len(names) != len(cameras):
        raise OmtwarpError(f"{len(names)} captions given for {len(cameras)} views")
    return names


def draw_in_background(
    thread: Executor, subject: Subject, finish: Callable[[Image.Image], Result], **options: Unpack[PreviewOptions]
) -> Callable[[], Result]:
    """Begin to draw a picture of one view by OpenGL, while the caller goes on.

    Args:
        thread: runs what does not need the caller: waiting for the picture, and ``finish``.
        subject: as in :func:`preview`.
        finish: makes of the picture what is wanted.
        **options: those of :func:`preview`.

    Returns:
        A function that waits for the outcome of ``finish``. Without OpenGL it draws with the ray caster.
    """
    chosen = complete({**options}, "preview")
    job, compose = _prepared(subject, chosen, cameras_of(chosen), clear=chosen["transparent"])
    if chosen["backend"] == "warp":
        return lambda: finish(compose(*render(job, "warp", chosen["device"]))[0])

    def draw() -> Result:
        pictures, name = gl_client.draw(job)
        return finish(compose(pictures, f"pyrender ({name})")[0])

    drawn = thread.submit(draw)

    def outcome() -> Result:
        try:
            return drawn.result()
        except gl_client.DrawingFailed:  # kernels are launched by the caller's thread alone
            return finish(compose(*render(job, chosen["backend"], chosen["device"]))[0])

    return outcome


def _draw(subject: Subject, options: PreviewOptions, cameras: list[Camera], clear: bool) -> list[Image.Image]:
    """Draw a subject once per camera; ``clear`` leaves the background out, for pictures that go into a sheet."""
    job, compose = _prepared(subject, options, cameras, clear)
    return compose(*render(job, options["backend"], options["device"]))


def _prepared(
    subject: Subject, options: PreviewOptions, cameras: list[Camera], clear: bool
) -> tuple[RenderJob, Callable[[list[NDArray[np.uint8]], str], list[Image.Image]]]:
    """Return what a renderer needs, and the function that makes pictures of what it has drawn and of its name."""
    view, wireframe, background = view_of(subject, options), options["wireframe"], options["background"]
    width, height = options["size"]
    bar = view.scalar if options["color_bar"] else None
    drawn_width = max(width - annotate.bar_width(options["size"]), SMALLEST_VIEW) if bar is not None else width
    parts = build_parts(view, edges=bool(wireframe) or view.edges)
    field = None if view.arrows is None else arrow_part(view, view.arrows)
    arrows = [] if field is None else [field]
    parts += arrows
    points = np.concatenate([normalised_points(view), *(part.positions.astype(np.float64) for part in arrows)])
    centred = options["frames"] is not None
    job = RenderJob(
        parts=parts,
        shots=frame(points, cameras, drawn_width / height, up=view.up, front=view.front, centred=centred),
        width=drawn_width,
        height=height,
        light=as_light(options["light"] or ("studio" if view.scalar is None else "soft")),
        samples=int(options["samples"] or (2 if parts[0].edges else 1)),
        wireframe=wireframe if isinstance(wireframe, Wireframe) else Wireframe(),
    )

    def compose(pictures: list[NDArray[np.uint8]], renderer: str) -> list[Image.Image]:
        color = annotate.ink(background, options["transparent"])
        images = []
        for picture in pictures:
            image = annotate.compose(picture, options["size"], background, clear, color)
            if bar is not None:
                annotate.draw_color_bar(image, bar, color)
            image.info["backend"] = renderer
            images.append(image)
        return images

    return job, compose


def _finished(
    images: list[Image.Image],
    captions: list[str],
    target: Path | None,
    options: PreviewOptions,
    *,
    columns: int | None = None,
    title: str = "",
) -> Image.Image:
    """Join several pictures to a sheet, with the renderer of the last of them."""
    background, transparent = options["background"], options["transparent"]
    result = annotate.grid(
        images, captions, columns=columns, background=background, transparent=transparent, title=title
    )
    result.info["backend"] = next((image.info["backend"] for image in reversed(images) if "backend" in image.info), "")
    return _written(result, target)


def _written(picture: Image.Image, target: Path | None) -> Image.Image:
    if target is not None:
        output.save_still(picture, target)
    return picture


def render(job: RenderJob, backend: str, device: str) -> tuple[list[NDArray[np.uint8]], str]:
    """Draw with OpenGL or, where that does not work and was not insisted on, with the ray caster."""
    if backend != "warp":
        try:
            pictures, name = gl_client.draw(job)
            return pictures, f"pyrender ({name})"
        except gl_client.DrawingFailed as failure:
            if backend == "pyrender":
                raise OmtwarpError(f"cannot draw with pyrender: {failure}; backend 'warp' needs no OpenGL") from failure
            if str(failure) not in _told:
                _told.add(str(failure))
                logger.warning("%s; drawing with the Warp ray caster instead", failure)
    from omtwarp.device.policy import resolve_device
    from omtwarp.render import ray_caster

    return ray_caster.draw(job, device), f"warp ({resolve_device(device)})"


def _view_name(camera: Camera) -> str:
    for name, angles in VIEWS.items():
        if angles == (camera.azimuth, camera.elevation):
            return name
    return f"{camera.azimuth:g}°, {camera.elevation:g}°"
