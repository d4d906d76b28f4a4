"""The options of pictures: their names, types and defaults, and the messages for invalid values.

:func:`omtwarp.preview` and :func:`omtwarp.render.sheet` take them as keywords and read them here alone. Their meaning
is in the docstring of :func:`omtwarp.preview`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias, TypedDict, TypeVar

from numpy.typing import ArrayLike

from omtwarp.colors import backdrop
from omtwarp.errors import OmtwarpError, choose
from omtwarp.files.limits import FRAMES_PER_SECOND, LARGEST_VIEW, MOST_FILM_PIXELS, MOST_FRAMES
from omtwarp.mesh.arrays import real_number, whole_number
from omtwarp.options import BACKGROUND, FILM_RATE, PICTURE_SIZE, Backend, BackendLike
from omtwarp.render import gl_client
from omtwarp.render.camera import Camera, Light, as_light, as_views, turntable
from omtwarp.render.scene import Arrows, ScalarField, SurfaceView, Wireframe
from omtwarp.render.subject import Picture, Subject, as_surface_view
from omtwarp.render.upright import posed

View: TypeAlias = str | tuple[float, float] | Camera
Function = TypeVar("Function", bound=Callable[..., object])

SMALLEST_VIEW = 16  # pixels along a side, below which neither captions nor a colour bar can be drawn


class PanelOptions(TypedDict, total=False):
    """Options of one still picture."""

    size: tuple[int, int]
    views: View | Sequence[View] | None
    camera: Camera | None
    up: str | None
    front: str | None
    light: str | Light | None
    background: str | ArrayLike
    transparent: bool
    wireframe: bool | Wireframe
    image: Picture | None
    scalar: ScalarField | ArrayLike | None
    colormap: str
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


PANEL_DEFAULTS: PanelOptions = {
    "size": PICTURE_SIZE,
    "views": None,
    "camera": None,
    "up": None,
    "front": None,
    "light": None,
    "background": BACKGROUND,
    "transparent": False,
    "wireframe": False,
    "image": None,
    "scalar": None,
    "colormap": "viridis",
    "scalar_range": None,
    "scalar_label": "",
    "color_bar": True,
    "arrows": None,
    "samples": None,
    "backend": Backend.AUTO,
    "device": "auto",
}
PREVIEW_DEFAULTS: PreviewOptions = {**PANEL_DEFAULTS, "frames": None, "fps": FILM_RATE, "captions": True}


def takes(kind: type, defaults: PanelOptions | PreviewOptions) -> Callable[[Function], Function]:
    """Give a function that ends in ``**options`` the signature with every option and its default, for ``help``.

    Args:
        kind: the TypedDict of the options.
        defaults: a value for each of them.
    """
    types = {name: getattr(given, "__forward_arg__", given) for name, given in _annotations(kind).items()}

    def signed(function: Function) -> Function:
        signature = inspect.signature(function)
        own = [given for given in signature.parameters.values() if given.kind is not inspect.Parameter.VAR_KEYWORD]
        known = {given.name for given in own}
        options = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=value, annotation=types[name])
            for name, value in defaults.items()
            if name not in known
        ]
        function.__signature__ = signature.replace(parameters=[*own, *options])  # type: ignore[attr-defined]
        return function

    return signed


def _annotations(kind: type) -> dict[str, object]:
    """Return the annotations of a TypedDict and of those that it extends, in their order."""
    return {name: given for base in reversed(kind.__mro__) for name, given in inspect.get_annotations(base).items()}


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
    options["size"] = _size(options["size"])
    _check_film(options)
    samples = options["samples"]
    if samples is not None and not 1 <= int(samples) <= most_samples:
        raise OmtwarpError(f"{samples} samples along a pixel's side asked for: use 1 to {most_samples}")
    if options["light"] is not None:
        as_light(options["light"])
    backdrop(options["background"], 1, 2)
    if options["device"] != "auto":
        from omtwarp.device.policy import resolve_device  # starts Warp

        resolve_device(options["device"])
    if options["backend"] != Backend.WARP:
        gl_client.prepare()
    return options


def _size(given: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = (int(length) for length in given)
    except (TypeError, ValueError):
        raise OmtwarpError(f"{given!r} is not a size: use (width, height) in pixels") from None
    if not (SMALLEST_VIEW <= width <= LARGEST_VIEW and SMALLEST_VIEW <= height <= LARGEST_VIEW):
        raise OmtwarpError(
            f"cannot draw a picture of {width} x {height} pixels: use {SMALLEST_VIEW} to {LARGEST_VIEW} along each side"
        )
    return width, height


def _check_film(options: PreviewOptions) -> None:
    if options["frames"] is None:
        return
    slowest, fastest = FRAMES_PER_SECOND
    if not slowest <= real_number(options["fps"], "frames per second") <= fastest:
        raise OmtwarpError(f"{options['fps']} frames per second asked for: use {slowest:g} to {fastest:g}")
    width, height = options["size"]
    if whole_number(options["frames"], "frames", least=1) > min(MOST_FRAMES, MOST_FILM_PIXELS // (width * height)):
        raise OmtwarpError(
            f"a film of {options['frames']} frames of {width} x {height} pixels: {MOST_FRAMES} frames and "
            f"{MOST_FILM_PIXELS / 1e6:.0f} million pixels in all is the most"
        )


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
