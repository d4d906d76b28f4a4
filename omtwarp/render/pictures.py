"""Pictures of surfaces, maps and fields, offscreen: the public functions ``preview``, ``sheet`` and ``comparison``."""

from __future__ import annotations

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from omtwarp.errors import OmtwarpError
from omtwarp.limits import FRAMES_PER_SECOND, LARGEST_VIEW, MOST_FILM_PIXELS, MOST_FRAMES
from omtwarp.render import annotate, gl_client, output
from omtwarp.render.arrows import arrow_part
from omtwarp.render.camera import VIEWS, Camera, as_views, frame, turntable
from omtwarp.render.colors import backdrop
from omtwarp.render.light import Light, as_light
from omtwarp.render.scene import (
    Arrows,
    RenderJob,
    ScalarField,
    SurfaceView,
    Wireframe,
    build_part,
    normalised_points,
)
from omtwarp.render.subject import as_surface_view, map_view

logger = logging.getLogger("omtwarp.render")
BACKENDS = ("auto", "pyrender", "warp")
_told: set[str] = set()


def preview(
    subject: Any,
    path: str | os.PathLike[str] | None = None,
    *,
    size: tuple[int, int] = (1024, 1024),
    views: Any = None,
    camera: Camera | None = None,
    up: str | None = None,
    front: str | None = None,
    light: str | Light | None = None,
    background: Any = "white",
    transparent: bool = False,
    wireframe: bool | Wireframe = False,
    image: Any = None,
    scalar: Any = None,
    colormap: str = "viridis",
    scalar_range: tuple[float, float] | None = None,
    scalar_label: str = "",
    color_bar: bool = True,
    arrows: Any = None,
    frames: int | None = None,
    fps: float = 20.0,
    captions: bool | Sequence[str] = True,
    samples: int | None = None,
    backend: str = "auto",
    device: str = "auto",
) -> Image.Image | list[Image.Image]:
    """Draw a surface and, if a path is given, write the picture there.

    Args:
        subject: a mesh file, a ``trimesh.Trimesh``, a ``MapResult`` or its .npz file, a ``TexturedSurface``,
            (vertices, faces), or a :class:`SurfaceView`. Textures and colours of files and meshes are kept.
        path: .png, .jpg, .webp, .tif, .gif or .mp4; the file appears whole or not at all.
        size: width and height of a view in pixels.
        views: a name (front, back, left, right, top, bottom, three-quarter), ``"AZ,EL"`` or (azimuth, elevation) in
            degrees, a :class:`Camera`, a list of these, or ``"six"``. Several views make one sheet, all at one scale.
        camera: field of view, projection, zoom, roll and, without ``views``, the direction.
        up: axis that points upwards (``"y"``, ``"z"``, ``"-x"``, ...); None takes the subject's: y, and z for a sphere.
        front: axis that points at the viewer in the front view; None takes +z, or -y where z is up.
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
        samples: supersampling along each side of a pixel, 1 to 4, beside multisampling and filtered textures, which
            leave little to do but for edges: 2 where they are drawn and 1 elsewhere by default.
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
    if path is not None and frames is None and os.fspath(path).lower().endswith((".gif", ".mp4")):
        frames = 36
    film = frames is not None
    target = None if path is None else output.check_target(path, film=film, transparent=transparent)
    slowest, fastest = FRAMES_PER_SECOND
    if film and not slowest <= fps <= fastest:
        raise OmtwarpError(f"{fps} frames per second asked for: use {slowest:g} to {fastest:g}")
    options = _Options(
        size=size,
        views=views,
        camera=camera,
        up=up,
        front=front,
        light=light,
        background=background,
        transparent=transparent,
        wireframe=wireframe,
        image=image,
        scalar=scalar,
        colormap=colormap,
        scalar_range=scalar_range,
        scalar_label=scalar_label,
        color_bar=color_bar,
        arrows=arrows,
        frames=frames,
        samples=samples,
        backend=backend,
        device=device,
    )
    options.check()
    cameras = options.cameras()
    several = len(cameras) > 1 and not film
    names: list[str] = [""] * len(cameras)
    if several and captions is True:
        names = [_view_name(camera) for camera in cameras]
    elif several and captions is not False:
        names = [str(caption) for caption in captions]  # type: ignore[union-attr]
        if len(names) != len(cameras):
            raise OmtwarpError(f"{len(names)} captions given for {len(cameras)} views")
    images = _draw(subject, options, cameras, clear=transparent or several)
    if film:
        if target is not None:
            output.save_film(images, target, fps)
        return images
    result = images[0]
    if several:
        result = annotate.grid(images, names, background=background, transparent=transparent)
        result.info["backend"] = images[0].info["backend"]
    if target is not None:
        output.save_still(result, target)
    return result


def sheet(
    panels: Sequence[Any],
    path: str | os.PathLike[str] | None = None,
    *,
    captions: Sequence[str] | None = None,
    columns: int | None = None,
    title: str = "",
    size: tuple[int, int] = (512, 512),
    background: Any = "white",
    transparent: bool = False,
    **options: Any,
) -> Image.Image:
    """Put several subjects into one picture, each over its caption.

    Args:
        panels: subjects of :func:`preview` (each framed to fill its panel) or finished PIL images.
        path: where to write the sheet; None writes nothing.
        captions: one text per panel; None takes the ``caption`` of each :class:`SurfaceView`.
        columns: panels in a row; None chooses.
        title: text above all.
        size: width and height of a panel in pixels.
        background: see :func:`preview`.
        transparent: leave the background out.
        **options: passed on to :func:`preview` for every panel (one view per panel).

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
    if unknown := sorted(set(options) - {field.name for field in fields(_Options)} | {"frames"} & set(options)):
        raise OmtwarpError(f"a sheet takes no option '{unknown[0]}': see preview for those of its panels")
    chosen = _Options(size=size, background=background, transparent=transparent, **options)
    chosen.check()
    cameras = chosen.cameras()
    if len(cameras) > 1:
        raise OmtwarpError(f"a sheet draws each panel from one view, but {len(cameras)} were given")
    target = None if path is None else output.check_target(path, film=False, transparent=transparent)
    images, names, note = [], [], ""
    for panel in panels:
        if isinstance(panel, Image.Image):
            images.append(panel)
            names.append("")
            continue
        images.extend(_draw(panel, chosen, cameras, clear=True))
        names.append(getattr(panel, "caption", ""))
        note = images[-1].info["backend"]
    result = annotate.grid(
        images, list(captions or names), columns=columns, background=background, transparent=transparent, title=title
    )
    result.info["backend"] = note
    if target is not None:
        output.save_still(result, target)
    return result


def comparison(
    result: Any,
    path: str | os.PathLike[str] | None = None,
    *,
    image: Any = None,
    size: tuple[int, int] = (512, 512),
    up: str | None = None,
    **options: Any,
) -> Image.Image:
    """One sheet of a map: the surface textured by the conformal and by the optimal map, and the sphere with both.

    Args:
        result: a ``MapResult`` with ``vertices``, ``faces``, ``sphere`` and ``conformal``.
        path: where to write the sheet; None writes nothing.
        image: equirectangular picture; None draws a checker.
        size: width and height of a panel in pixels.
        up: the surface's upward axis.
        **options: as :func:`sheet`.

    Returns:
        A PIL image of two rows: the surface above, the sphere with the mesh's edges below.

    Raises:
        OmtwarpError: as :func:`sheet`, or the map has no conformal stage.
    """
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
    return sheet([*above, *below], path, columns=2, size=size, **options)


@dataclass
class _Options:
    """The drawing options of :func:`preview`, whose documentation is theirs."""

    size: tuple[int, int] = (1024, 1024)
    views: Any = None
    camera: Camera | None = None
    up: str | None = None
    front: str | None = None
    light: str | Light | None = None
    background: Any = "white"
    transparent: bool = False
    wireframe: bool | Wireframe = False
    image: Any = None
    scalar: Any = None
    colormap: str = "viridis"
    scalar_range: tuple[float, float] | None = None
    scalar_label: str = ""
    color_bar: bool = True
    arrows: Any = None
    frames: int | None = None
    samples: int | None = None
    backend: str = "auto"
    device: str = "auto"

    def check(self) -> None:
        """Refuse what makes no sense before any work is done, and start what takes time meanwhile."""
        if self.backend not in BACKENDS:
            raise OmtwarpError(f"unknown backend '{self.backend}': use auto, pyrender or warp")
        try:
            width, height = (int(length) for length in self.size)
        except (TypeError, ValueError):
            raise OmtwarpError(f"{self.size!r} is not a size: use (width, height) in pixels") from None
        if not (16 <= width <= LARGEST_VIEW and 16 <= height <= LARGEST_VIEW):
            raise OmtwarpError(
                f"cannot draw a picture of {width} x {height} pixels: use 16 to {LARGEST_VIEW} along each side"
            )
        self.size = (width, height)
        if self.frames is not None and self.frames > min(MOST_FRAMES, MOST_FILM_PIXELS // (width * height)):
            raise OmtwarpError(
                f"a film of {self.frames} frames of {width} x {height} pixels: {MOST_FRAMES} frames and "
                f"{MOST_FILM_PIXELS / 1e6:.0f} million pixels in all is the most"
            )
        if self.samples is not None and not 1 <= int(self.samples) <= 4:
            raise OmtwarpError(f"{self.samples} samples along a pixel's side asked for: use 1 to 4")
        if self.light is not None:
            as_light(self.light)
        backdrop(self.background, 1, 2)
        if self.device != "auto":
            from omtwarp.device.policy import resolve_device

            resolve_device(self.device)
        if self.backend != "warp":
            gl_client.prepare()  # its start passes while the subject is read

    def cameras(self) -> list[Camera]:
        """One camera per picture."""
        cameras = as_views(self.views, self.camera or Camera())
        if self.frames is None:
            return cameras
        if len(cameras) > 1:
            raise OmtwarpError(f"a turntable starts from one view, but {len(cameras)} were given")
        return turntable(cameras[0], int(self.frames))

    def view_of(self, subject: Any) -> SurfaceView:
        """The subject with what the options change about it."""
        view = as_surface_view(subject, self.image)
        changes: dict[str, Any] = {}
        if self.up is not None:
            changes["up"] = self.up
        if self.front is not None:
            changes["front"] = self.front
        elif self.up is not None and self.up != view.up:
            changes["front"] = None  # the subject's own may lie along the new upward axis
        if self.scalar is not None:
            field = self.scalar
            if not isinstance(field, ScalarField):
                field = ScalarField(field, self.colormap, self.scalar_range, self.scalar_label)
            changes |= {"scalar": field, "image": None, "uv": None, "colors": None}
        if self.arrows is not None:
            changes["arrows"] = self.arrows if isinstance(self.arrows, Arrows) else Arrows(self.arrows)
        return replace(view, **changes) if changes else view


def _draw(subject: Any, options: _Options, cameras: list[Camera], clear: bool) -> list[Image.Image]:
    """Draw a subject once per camera; ``clear`` leaves the background out, for pictures that go into a sheet."""
    view = options.view_of(subject)
    width, height = options.size
    bar = view.scalar if options.color_bar else None
    drawn_width = max(width - annotate.bar_width(options.size), 16) if bar is not None else width
    edges = options.wireframe if isinstance(options.wireframe, Wireframe) else Wireframe()
    parts = [build_part(view, edges=bool(options.wireframe) or view.edges)]
    if view.arrows is not None:
        field = arrow_part(view, view.arrows)
        parts += [] if field is None else [field]
    points = np.concatenate([normalised_points(view), *(part.positions.astype(np.float64) for part in parts[1:])])
    job = RenderJob(
        parts=parts,
        shots=frame(
            points, cameras, drawn_width / height, up=view.up, front=view.front, centred=options.frames is not None
        ),
        width=drawn_width,
        height=height,
        light=as_light(options.light or ("studio" if view.scalar is None else "soft")),
        samples=int(options.samples or (2 if parts[0].edges else 1)),
        wireframe=edges,
    )
    pictures, note = _render(job, options.backend, options.device)
    color = annotate.ink(options.background, options.transparent)
    images = []
    for picture in pictures:
        image = annotate.compose(picture, options.size, options.background, clear, color)
        if bar is not None:
            annotate.draw_color_bar(image, bar, color)
        image.info["backend"] = note
        images.append(image)
    return images


def _render(job: RenderJob, backend: str, device: str) -> tuple[list[NDArray[np.uint8]], str]:
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
