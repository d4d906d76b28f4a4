"""Colours, colour maps and the sRGB transfer curve that the pictures use."""

from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError

Number = TypeVar("Number", np.float32, np.float64)


def to_linear(color: NDArray[Number]) -> NDArray[Number]:
    """Convert sRGB colours of any shape to linear light, in their own precision (IEC 61966-2-1)."""
    light = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return light.astype(color.dtype)


def to_srgb(light: NDArray[Number]) -> NDArray[Number]:
    """Convert linear light of any shape to sRGB colours, in its own precision; values are clipped to 0 to 1."""
    clipped = np.clip(light, 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1.0 / 2.4) - 0.055).astype(light.dtype)


# Control colours at equal steps from 0 to 1; linear between them, within 6/255 of the originals.
# viridis, magma and cividis: van der Walt & Smith and Nunez et al. (CC0); coolwarm: Moreland (2009);
# turbo: Mikhailov (Apache-2.0).
_CONTROL_COLORS = {
    "gray": "000000 ffffff",
    "viridis": (
        "440154 470d60 48186a 482374 472d7b 453781 424086 3e4989 3b528b 375b8d 33638d "
        "2f6b8e 2c728e 297a8e 26828e 23898e 21918c 1f988b 1fa088 22a785 28ae80 32b67a "
        "3fbc73 4ec36b 5ec962 70cf57 84d44b 98d83e addc30 c2df23 d8e219 ece51b fde725"
    ),
    "magma": (
        "000004 030312 0a0822 130d34 1d1147 29115a 36106b 440f76 51127c 5d177f 6a1c81 "
        "762181 832681 902a81 9c2e7f aa337d b73779 c43c75 d0416f dc4869 e75263 ef5d5e "
        "f56b5c f9795d fc8961 fd9869 fea772 feb67c fec488 fed395 fde2a3 fcf0b2 fcfdbf"
    ),
    "cividis": (
        "00224e 00285b 002e6a 053371 1a386f 273e6e 32436d 3b496c 434e6c 4b546c 535a6d "
        "5a5f6e 61656f 686a71 6f7073 767676 7d7c78 848279 8c8878 938e78 9b9476 a39a74 "
        "aba072 b4a76f bcae6c c4b468 cdbb63 d5c25e dec958 e7d150 f0d846 f9e03a fee838"
    ),
    "coolwarm": (
        "3b4cc0 445acc 4e68d8 5875e1 6282ea 6c8ff1 779af7 82a6fb 8db0fe 98b9ff a3c2fe "
        "aec9fc b9d0f9 c3d5f4 ccd9ed d5dbe5 dddcdc e5d8d1 ecd3c5 f1ccb8 f5c4ac f7ba9f "
        "f7b093 f6a586 f4987a f08b6e eb7d62 e46e56 dd5f4b d44e41 ca3b37 be242e b40426"
    ),
    "turbo": (
        "30123b 392a73 4040a2 4456c7 466be3 4680f6 4294ff 37a8fa 28bceb 1ccdd8 18ddc2 "
        "1fe9af 32f298 4ef97d 6dfe62 8bff4b a4fc3c b9f635 cdec34 dfdf37 eecf3a f8be39 "
        "fdac34 fe962b fb7e21 f46617 eb500e df3f08 d02f05 be2102 a91601 920b01 7a0403"
    ),
}
COLORMAPS = tuple(_CONTROL_COLORS)


def parse_color(color: str | ArrayLike, what: str = "colour") -> NDArray[np.float64]:
    """Turn a CSS colour name, ``#rrggbb`` or three numbers (0 to 1, or integers 0 to 255) into RGB in [0, 1].

    Raises:
        OmtwarpError: the text is no colour, or there are not three numbers.
    """
    if isinstance(color, str):
        from PIL import ImageColor

        try:
            return np.array(ImageColor.getrgb(color)[:3]) / 255.0
        except ValueError:
            raise OmtwarpError(f"'{color}' is not a {what}: use a CSS name such as 'white' or '#rrggbb'") from None
    values = np.asarray(color)
    if values.shape not in ((3,), (4,)) or not np.issubdtype(values.dtype, np.number):
        raise OmtwarpError(f"{color!r} is not a {what}: use a CSS name, '#rrggbb' or three numbers in [0, 1]")
    scale = 255.0 if np.issubdtype(values.dtype, np.integer) and values.max(initial=0) > 1 else 1.0
    return np.clip(values[:3] / scale, 0.0, 1.0)


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
        table = np.column_stack([np.interp(at, steps, control[:, k]) for k in range(3)])
        table = np.rint(table).astype(np.uint8)
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
    if isinstance(background, (tuple, list)) and len(background) == 2:
        top, bottom = parse_color(background[0], "background"), parse_color(background[1], "background")
        t = np.linspace(0.0, 1.0, height)[:, None, None]
        return (1.0 - t) * top + t * bottom
    return np.broadcast_to(parse_color(background, "background"), (height, 1, 3))  # type: ignore[arg-type]
