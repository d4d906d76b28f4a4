"""Pictures in and out, with one clear line when a file is not one."""

from __future__ import annotations

import io
import os
import threading
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import MARK
from omtwarp.inputs import open_input
from omtwarp.limits import LARGEST_PICTURE_FILE, LONGEST_SIDE, MOST_TEXELS

# Bytes of pixels: above, a tenth more bytes than at Pillow's level 6 save two thirds of the time.
LARGE_PICTURE = 30_000_000

if TYPE_CHECKING:
    from PIL.Image import Image

PictureLike: TypeAlias = "str | os.PathLike[str] | Image | ArrayLike"
"""A picture in any of the forms that public functions take: a path, a PIL image, or an array [H, W] or [H, W, C]."""
# Formats that Pillow decodes itself; it would pass others, such as EPS, to programs of the system.
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "GIF", "PPM", "TGA", "JPEG2000")

_pillow = threading.Lock()  # over Pillow's own limit, which is one number for the whole process


def read_image(source: PictureLike) -> NDArray[np.generic]:
    """Return a picture as an array, row 0 on top.

    Args:
        source: a path, a PIL image, or an array of shape [H, W], [H, W, 1], [H, W, 3] or [H, W, 4]: uint8, or floats
            in 0..1.

    Returns:
        uint8, or float32 for float input, shape [H, W, 3] or [H, W, 4].

    Raises:
        OmtwarpError: the file is missing, empty, not readable or not a picture; the array has another shape or type.
    """
    from PIL import Image as pil

    if isinstance(source, (str, os.PathLike)):
        path = Path(source)
        with open_input(path, LARGEST_PICTURE_FILE, "picture") as stream:
            try:
                # Pillow warns of damage that it tolerates.
                with warnings.catch_warnings(action="ignore"), _open(stream) as opened:
                    return _from_pil(opened, str(path))
            except (OmtwarpError, MemoryError):
                raise
            except pil.UnidentifiedImageError:
                raise OmtwarpError(
                    f"{path}: not a picture in a format that can be read ({', '.join(FORMATS)})"
                ) from None
            except Exception as error:  # damaged files end in many kinds of error inside the decoders
                raise OmtwarpError(f"{path}: cannot be read as a picture: {_first_line(error)}") from None
    if isinstance(source, pil.Image):
        return _from_pil(source, "image")
    return _from_array(source)


def _open(stream: BinaryIO) -> Image:
    """Return a picture of which the header has been read, without Pillow's own limit.

    :func:`_from_pil` has one that fits.
    """
    from PIL import Image as pil

    with _pillow:
        limit = pil.MAX_IMAGE_PIXELS
        pil.MAX_IMAGE_PIXELS = None
        try:
            return pil.open(stream, formats=FORMATS)
        finally:
            pil.MAX_IMAGE_PIXELS = limit


def _from_pil(image: Image, name: str) -> NDArray[np.generic]:
    from PIL import ImageOps

    if max(image.size) > LONGEST_SIDE:
        raise OmtwarpError(f"{name}: {image.width}x{image.height} texels; no side may be longer than {LONGEST_SIDE}")
    if image.width * image.height > MOST_TEXELS:
        raise OmtwarpError(
            f"{name}: {image.width}x{image.height} texels; a picture may have {MOST_TEXELS / 1e6:.0f} million at most"
        )
    if image.mode in ("I;16", "I;16L", "I;16B", "I", "F"):  # more than 8 bits: Pillow's own conversion would clip
        values = np.asarray(image, dtype=np.float32)
        top = 65535.0 if image.mode != "F" else 1.0
        return np.repeat(np.clip(values / top, 0.0, 1.0)[..., None], 3, axis=2)
    turned = ImageOps.exif_transpose(image)
    alpha = turned.mode in ("RGBA", "LA", "PA") or "transparency" in turned.info
    return np.asarray(turned.convert("RGBA" if alpha else "RGB"))


def _from_array(source: ArrayLike) -> NDArray[np.generic]:
    try:
        array = np.asarray(source)
    except Exception as error:
        raise OmtwarpError(f"image of type {type(source).__name__}: give a path, a PIL image or an array") from error
    if array.dtype == object or array.dtype.kind not in "uifb":
        raise OmtwarpError(f"image of type {type(source).__name__}: give a path, a PIL image or an array")
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape:
        raise OmtwarpError(f"image array of shape {list(np.shape(source))}: give [H, W], [H, W, 3] or [H, W, 4]")
    if array.shape[2] == 1:
        array = np.repeat(array, 3, axis=2)
    if array.dtype == np.uint8:
        return np.ascontiguousarray(array)
    if array.dtype.kind in "ui":
        if array.min() < 0 or array.max() > 255:
            raise OmtwarpError(
                f"image array of {array.dtype} from {array.min()} to {array.max()}: give 0..255, or floats in 0..1"
            )
        return array.astype(np.uint8)
    values = array.astype(np.float32)
    if not np.all(np.isfinite(values)):
        raise OmtwarpError(f"image array has {np.count_nonzero(~np.isfinite(values))} values that are not finite")
    if values.min() < 0 or values.max() > 1:
        raise OmtwarpError(f"image array of floats from {values.min():g} to {values.max():g}: give 0..1, or uint8")
    return values


def as_floats(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return a picture as float32 in 0..1."""
    return (
        image.astype(np.float32) / np.float32(255.0)
        if image.dtype == np.uint8
        else image.astype(np.float32, copy=False)
    )


def as_bytes(image: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Return a picture as uint8, rounded to the nearest and clipped."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    return np.clip(np.multiply(image, np.float32(255.0)) + np.float32(0.5), 0.0, 255.0).astype(np.uint8)


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """Return an image as a PNG file."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    stream = io.BytesIO()
    level = 4 if image.size < LARGE_PICTURE else 3
    origin = PngInfo()
    origin.add_text("Software", MARK.decode())  # marks the file as one that a later run may replace
    Image.fromarray(image).save(stream, format="PNG", compress_level=level, pnginfo=origin)
    return stream.getvalue()


def _first_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
