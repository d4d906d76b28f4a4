"""Colours, colour maps and the sRGB transfer curve that the pictures use."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError

Number = TypeVar("Number", np.float32, np.float64)


def to_linear(color: NDArray[Number]) -> NDArray[Number]:
    """Convert sRGB colours of any shape to linear light, in their own precision (IEC 61966-2-1)."""
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4).astype(color.dtype)


def to_srgb(light: NDArray[Number]) -> NDArray[Number]:
    """Convert linear light of any shape to sRGB colours, in its own precision; values are clipped to 0 to 1."""
    clipped = np.clip(light, 0.0, 1.0)
    curve = np.where(clipped < 1.0, 1.055 * clipped ** (1.0 / 2.4) - 0.055, 1.0)  # which is less by rounding at 1
    return np.where(clipped <= 0.0031308, 12.92 * clipped, curve).astype(light.dtype)


_CONTROL_COLORS: dict[str, str] = tomllib.loads((files("omtwarp") / "colormaps.toml").read_text("utf-8"))
COLORMAPS = tuple(_CONTROL_COLORS)


def parse_color(color: str | ArrayLike, what: str = "colour") -> NDArray[np.float64]:
    """Turn a CSS colour name, ``#rrggbb`` or three numbers (0 to 1, or integers 0 to 255) into RGB in [0, 1].

    Raises:
        OmtwarpError: the text is no colour, or there are not three numbers in the range.
    """
    if isinstance(color, str):
        from PIL import ImageColor

        try:
            return np.array(ImageColor.getrgb(color)[:3]) / 255.0
        except ValueError:
            raise OmtwarpError(f"'{color}' is not a {what}: use a CSS name such as 'white' or '#rrggbb'") from None
    values = np.asarray(color)
    if values.shape in ((3,), (4,)) and values.dtype.kind in "iuf":
        scaled = values[:3] / (255.0 if values.dtype.kind != "f" and values.max() > 1 else 1.0)
        rounded = np.clip(scaled, 0.0, 1.0)
        if (np.abs(scaled - rounded) <= np.finfo(np.float32).eps).all():  # not so of NaN
            return rounded
    raise OmtwarpError(f"{color!r} is not a {what}: use a CSS name, '#rrggbb' or three numbers in [0, 1]")


@cache
def colormap_table(name: str, size: int = 256) -> NDArray[np.uint8]:
    """Return the colours of a colour map, shape [size, 3] sRGB bytes; a trailing ``_r`` reverses it.

    The built-in maps are ``viridis``, ``magma``, ``cividis``, ``coolwarm``, ``turbo`` and ``gray``; any other name is
    looked up in Matplotlib where that is installed.

    Raises:
        OmtwarpError: no colour map has this name.
    """
    base = name.removesuffix("_r")
    if base in _CONTROL_COLORS:
        control = np.array([list(bytes.fromhex(color)) for color in _CONTROL_COLORS[base].split()], dtype=float)
        at = np.linspace(0.0, 1.0, size)
        steps = np.linspace(0.0, 1.0, len(control))
        table = np.rint(np.column_stack([np.interp(at, steps, control[:, k]) for k in range(3)])).astype(np.uint8)
        return table[::-1].copy() if name.endswith("_r") else table
    try:
        from matplotlib import colormaps

        return np.rint(colormaps[name](np.linspace(0.0, 1.0, size))[:, :3] * 255).astype(np.uint8)
    except (ImportError, KeyError):
        raise OmtwarpError(f"unknown colour map '{name}': use one of {', '.join(COLORMAPS)}") from None


def backdrop(background: object, width: int, height: int) -> NDArray[np.float64]:
    """Return the picture behind the surface: RGB in [0, 1], shape [height, width or 1, 3].

    ``background`` is a colour, a pair of colours (top, bottom) blended downwards, or ``"studio"``.

    Raises:
        OmtwarpError: the background is no colour, pair of colours or ``studio``.
    """
    if isinstance(background, str) and background == "studio":
        background = ("#fbfcfe", "#d3dae3")
    if isinstance(background, (tuple, list)) and len(background) == 2 and not isinstance(background[0], int | float):
        top, bottom = parse_color(background[0], "background"), parse_color(background[1], "background")
        t = np.linspace(0.0, 1.0, height)[:, None, None]
        return (1.0 - t) * top + t * bottom
    return np.broadcast_to(parse_color(background, "background"), (height, 1, 3))  # type: ignore[arg-type]
