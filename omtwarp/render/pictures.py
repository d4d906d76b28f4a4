"""Pictures of surfaces, maps and fields, offscreen: the public functions ``preview``, ``sheet`` and ``comparison``.

Their options, with names, types and defaults, are read here alone; their meaning is in the docstring of
:func:`preview`.
"""

from __future__ import annotations

import inspect
import logging
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeAlias, TypedDict, Unpack, cast

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image

from omtwarp.colors import backdrop
from omtwarp.errors import DrawingFailed, OmtwarpError, choose, shown, truth
from omtwarp.files.limits import FRAMES_PER_SECOND, LARGEST_VIEW, MOST_FILM_PIXELS, MOST_FRAMES
from omtwarp.files.output import as_path
from omtwarp.mesh.arrays import Bytes, FinishedMap, listed, real_number, whole_number, whole_numbers
from omtwarp.options import BACKGROUND, FILM_RATE, PICTURE_SIZE, Backend, BackendLike, takes
from omtwarp.render import annotate, gl_client, output, scene
from omtwarp.render.camera import VIEWS, Camera, Light, as_light, as_views, frame, turntable
from omtwarp.render.scene import Arrows, RenderJob, ScalarField, SurfaceView, Wireframe
from omtwarp.render.subject import Picture, Subject, as_surface_view, map_view, posed

logger = logging.getLogger("omtwarp.render")
PANEL_SIZE = (512, 512)  # pixels of a panel of a sheet, so that four are as large as one preview
_told: set[str] = set()


LightName: TypeAlias = Literal["studio", "soft", "flat"]
ColormapName: TypeAlias = Literal["viridis", "magma", "cividis", "coolwarm", "turbo", "gray"]  # Matplotlib has others
View: TypeAlias = str | tuple[float, float] | Camera

SMALLEST_VIEW = 16  # pixels along a side, below which neither captions nor a colour bar can be drawn


class PanelOptions(TypedDict, total=False):
    """Options of one still picture."""

    size: tuple[int, int]
    views: View | Sequence[View] | None
    camera: Camera | None
    up: str | None
    front: str | None
    light: LightName | Light | None
    background: str | ArrayLike
    transparent: bool
    wireframe: bool | Wireframe
    image: Picture | None
    scalar: ScalarField | ArrayLike | None
    colormap: ColormapName | str
    scalar_range: tuple[float, float] | None
    scalar_label: str
    color_bar: bool
    arrows: Arrows | ArrayLike | None
    samples: int | None
    backend: BackendLike
    device: str


class PreviewOptions(PanelOptions, total=False):
    """Options of :func:`omtwarp.preview`: one picture, a sheet of several views, or a film."""

    frames: int | None
    fps: float
    captions: bool | Sequence[str]


PANEL_DEFAULTS = cast(
    PanelOptions,
    dict.fromkeys(inspect.get_annotations(PanelOptions))
    | {
        "size": PICTURE_SIZE,
        "background": BACKGROUND,
        "transparent": False,
        "wireframe": False,
        "colormap": "viridis",
        "scalar_label": "",
        "color_bar": True,
        "backend": Backend.AUTO,
        "device": "auto",
    },
)
"""Values of the options that are not None."""
PREVIEW_DEFAULTS: PreviewOptions = {**PANEL_DEFAULTS, "frames": None, "fps": FILM_RATE, "captions": True}


def complete(given: PreviewOptions, function: str) -> PreviewOptions:
    """Add the defaults to the options that were given, and reject invalid values before any work is done.

    Where OpenGL is to draw, the process that does so is started: the subject is read meanwhile.

    Raises:
        TypeError: there is no such option.
        OmtwarpError: an option has an invalid value.
    """
    most_samples = 4  # along a pixel's side, in addition to the 4 to 8 samples of OpenGL itself
    if unknown := [name for name in given if name not in PREVIEW_DEFAULTS]:
        raise TypeError(f"{function}() got an unexpected keyword argument '{unknown[0]}'")
    options: PreviewOptions = {**PREVIEW_DEFAULTS, **given}
    options["backend"] = choose(Backend, options["backend"])
    options["size"] = checked_size(options["size"])
    if options["frames"] is not None:
        checked_rate(options["fps"])
        width, height = options["size"]
        frames = whole_number(options["frames"], "frames", least=1)
        if frames > min(MOST_FRAMES, MOST_FILM_PIXELS // (width * height)):
            raise OmtwarpError(
                f"a film of {frames} frames of {width} x {height} pixels: {MOST_FRAMES} frames and "
                f"{MOST_FILM_PIXELS / 1e6:.0f} million pixels in all is the most"
            )
    if (samples := options["samples"]) is not None:
        options["samples"] = whole_number(samples, "samples along a pixel's side", least=1, most=most_samples)
    if not isinstance(options["camera"], Camera | None):
        raise OmtwarpError(f"camera {shown(options['camera'])}: must be an omtwarp.render.Camera")
    _require_effect(options)
    if options["light"] is not None:
        as_light(options["light"])
    backdrop(options["background"], 1, 2)
    if options["device"] != "auto":
        from omtwarp.device.policy import resolve_device  # starts Warp

        resolve_device(options["device"])
    if options["backend"] != Backend.WARP:
        gl_client.prepare()
    return options


def _require_effect(options: PreviewOptions) -> None:
    """Refuse options that change nothing in a picture, but for those that have their default.

    Raises:
        OmtwarpError: an option has no effect.
    """
    alone = options["scalar"] is None or isinstance(options["scalar"], ScalarField)
    uses = dict.fromkeys(("colormap", "scalar_range", "scalar_label"), "numbers given as scalar") if alone else {}
    uses |= {} if options["frames"] else {"fps": "films, with frames"}
    for name, use in uses.items():
        if str(options[name]) != str(PREVIEW_DEFAULTS[name]):  # type: ignore[literal-required]
            raise OmtwarpError(f"{name} is for {use}: leave it out")


def checked_size(given: tuple[int, int], what: str = "picture") -> tuple[int, int]:
    """Return the width and the height of a picture or film, if it can be drawn.

    Raises:
        OmtwarpError: no size, or one that is too small or too large.
    """
    width, height = whole_numbers(given, f"size of the {what}", (2,)).tolist()
    if not (SMALLEST_VIEW <= width <= LARGEST_VIEW and SMALLEST_VIEW <= height <= LARGEST_VIEW):
        raise OmtwarpError(
            f"cannot draw a {what} of {width} x {height} pixels: use {SMALLEST_VIEW} to {LARGEST_VIEW} along each side"
        )
    return width, height


def checked_rate(given: float) -> float:
    """Return the frames per second of a film, if it can have so many.

    Raises:
        OmtwarpError: too few or too many, or no number.
    """
    slowest, fastest = FRAMES_PER_SECOND
    if not slowest <= real_number(given, "frames per second") <= fastest:
        raise OmtwarpError(f"{given} frames per second asked for: use {slowest:g} to {fastest:g}")
    return float(given)


def cameras_of(options: PreviewOptions) -> list[Camera]:
    """Return one camera for each picture that the options ask for.

    Raises:
        OmtwarpError: an unknown view, or several for a film.
    """
    cameras = as_views(options["views"], options["camera"] or Camera())
    if options["frames"] is None:
        return cameras
    if len(cameras) > 1:
        raise OmtwarpError(f"a turntable starts from one view, but {len(cameras)} were given")
    return turntable(cameras[0], int(options["frames"]))


def view_of(subject: Subject, options: PreviewOptions) -> SurfaceView:
    """Convert the subject to a view, with the changes that the options ask for.

    Raises:
        OmtwarpError: the subject cannot be read or drawn.
    """
    view = as_surface_view(subject, options["image"])
    scalar, arrows = options["scalar"], options["arrows"]
    view = posed(view, options["up"], options["front"])
    if scalar is not None:
        if not isinstance(scalar, ScalarField):
            scalar = ScalarField(scalar, options["colormap"], options["scalar_range"], options["scalar_label"])
        view = replace(view, scalar=scalar, image=None, uv=None, colors=None, materials=None)
    if arrows is not None:
        view = replace(view, arrows=arrows if isinstance(arrows, Arrows) else Arrows(arrows))
    return view


@takes(PreviewOptions, PREVIEW_DEFAULTS)
def preview(
    subject: Subject, path: str | os.PathLike[str] | None = None, **options: Unpack[PreviewOptions]
) -> Image.Image | list[Image.Image]:
    """Draw a surface and, if a path is given, write the picture there.

    Args:
        subject: a mesh file, a ``trimesh.Trimesh``, a ``MapResult`` or its .npz file, a ``PaintedMesh``,
            (vertices, faces), or a :class:`SurfaceView`. Textures and colours of files and meshes are kept.
        path: .png, .jpg, .webp, .tif, .gif or .mp4; the file appears whole or not at all. With ``frames`` a .webp is
            a film, too.
        size: width and height of a view in pixels; of an .mp4 the even numbers up to these.
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
    if path is not None and options.get("frames") is None and str(as_path(path)).lower().endswith((".gif", ".mp4")):
        # Turntable frames: 10 degrees each
        options["frames"] = 36
    film, transparent = options.get("frames") is not None, truth(options.get("transparent", False), "transparent")
    target = None if path is None else output.check_target(path, film=film, transparent=transparent)
    chosen = complete(options, "preview")
    if target is not None and target.suffix.lower() == ".mp4":
        chosen["size"] = output.video_size(*chosen["size"])
    cameras = cameras_of(chosen)
    several = not film and len(cameras) > 1
    if not several and not isinstance(chosen["captions"], bool):
        raise OmtwarpError("captions are for a sheet of several views: leave them out")
    names = _captions(chosen["captions"], cameras) if several else []
    images = _draw(subject, chosen, cameras, clear=transparent or several)
    if film:
        if target is not None:
            output.save_film(images, target, chosen["fps"])
        return images
    if several:
        images = [annotate.grid(images, names, chosen["background"], transparent, 0, "")]
    return _written(images[0], target)


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
    images: list[Image.Image] = []
    for panel in panels:
        images += [panel] if isinstance(panel, Image.Image) else _draw(panel, chosen, cameras, clear=True)
    words = list(captions or (str(getattr(panel, "caption", "")) for panel in panels))
    drawn = annotate.grid(images, words, chosen["background"], chosen["transparent"], columns or 0, title)
    return _written(drawn, target)


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
    stages = {"conformal": "conformal", "optimal": "optimal transport"}
    above = [replace(map_view(result, image, which=which, caption=name), up=up) for which, name in stages.items()]
    below = [
        replace(map_view(result, image, which=which, on="sphere", caption=f"sphere, {name}"), edges=True)
        for which, name in stages.items()
    ]
    return sheet([*above, *below], path, columns=2, **options)


def _captions(given: bool | Sequence[str], cameras: list[Camera]) -> list[str]:
    """Return the caption of each view of a sheet: none, the view's name, or the given text."""
    if isinstance(given, bool):
        named = {angles: name for name, angles in VIEWS.items()}
        angles = [(camera.azimuth, camera.elevation) for camera in cameras]
        return [named.get(pair, f"{pair[0]:g}°, {pair[1]:g}°") if given else "" for pair in angles]
    names = [str(caption) for caption in listed(given, "captions", "texts")]
    if len(names) != len(cameras):
        raise OmtwarpError(f"{len(names)} captions given for {len(cameras)} views")
    return names


def _draw(subject: Subject, options: PreviewOptions, cameras: list[Camera], clear: bool) -> list[Image.Image]:
    """Draw a subject once per camera; ``clear`` leaves the background out, for pictures that go into a sheet."""
    view, wireframe, background = view_of(subject, options), options["wireframe"], options["background"]
    width, height = options["size"]
    bar = view.scalar if truth(options["color_bar"], "color_bar") else None
    drawn_width = max(width - annotate.bar_width(options["size"]), SMALLEST_VIEW) if bar is not None else width
    edges = isinstance(wireframe, Wireframe) or truth(wireframe, "wireframe") or view.edges
    parts, points = scene.build_parts(view, edges=edges), scene.drawn_points(view)
    if view.arrows is not None and (field := scene.arrow_part(view, view.arrows)) is not None:
        parts, points = [*parts, field], np.concatenate([points, field.positions.astype(np.float64)])
    shots = frame(points, cameras, drawn_width / height, view.up, view.front, options["frames"] is not None)
    light = as_light(options["light"] or ("studio" if view.scalar is None else "soft"))
    samples = int(options["samples"] or (2 if parts[0].edges else 1))
    lines = wireframe if isinstance(wireframe, Wireframe) else Wireframe()
    job = RenderJob(parts, shots, drawn_width, height, light, samples, lines)
    pictures, renderer = render(job, options["backend"], options["device"])
    color = annotate.ink(background, options["transparent"])
    images = []
    for picture in pictures:
        image = annotate.compose(picture, options["size"], background, clear, color)
        if bar is not None:
            annotate.draw_color_bar(image, bar, color)
        image.info["backend"] = renderer
        images.append(image)
    return images


def _written(picture: Image.Image, target: Path | None) -> Image.Image:
    if target is not None:
        output.save_still(picture, target)
    return picture


def render(job: RenderJob, backend: str, device: str) -> tuple[list[Bytes], str]:
    """Draw with OpenGL or, where that does not work and was not insisted on, with the ray caster."""
    if backend != "warp":
        try:
            pictures, name = gl_client.draw(job)
            return pictures, f"pyrender ({name})"
        except DrawingFailed as failure:
            if backend == "pyrender":
                raise OmtwarpError(f"cannot draw with pyrender: {failure}; backend 'warp' needs no OpenGL") from failure
            if str(failure) not in _told:
                _told.add(str(failure))
                logger.warning("%s; drawing with the Warp ray caster instead", failure)
    from omtwarp.device.policy import resolve_device
    from omtwarp.render import ray_caster

    return ray_caster.draw(job, device), f"warp ({resolve_device(device)})"
