"""Reading and writing of pictures, with one clear line for a file that is none, and their projections to the sphere.

Image coordinates are (u, v) in 0..1 with u growing to the east (to the right) and v growing to the **north** (up), as
texture coordinates do: (0, 0) is the bottom left corner of the picture, and row 0 of the array is v = 1, the north.
Longitude is ``atan2(y, x)`` in (-π, π], latitude is ``asin(z)``.
"""

from __future__ import annotations

import io
import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError, brief, check_word
from omtwarp.files.inputs import FORMATS, open_input, open_picture
from omtwarp.files.limits import LARGEST_PICTURE_FILE, LONGEST_SIDE, MOST_TEXELS
from omtwarp.mesh.arrays import Bytes, Floats, real_numbers
from omtwarp.options import ProjectionName

if TYPE_CHECKING:
    from PIL.Image import Image


Number = TypeVar("Number", bound=np.generic)
PictureLike: TypeAlias = "str | os.PathLike[str] | Image | ArrayLike"
"""A picture in any of the forms that public functions take: a path, a PIL image, or an array [H, W] or [H, W, C]."""


def read_image(source: PictureLike) -> NDArray[np.generic]:
    """Read a picture as an array whose row 0 is at the top.

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
            return decoded(stream, str(path))
    return _from_pil(source, "image") if isinstance(source, pil.Image) else _from_array(source)


def decoded(stream: BinaryIO, name: str) -> NDArray[np.generic]:
    """Decode a picture.

    Args:
        stream: the file, of one of :data:`omtwarp.files.inputs.FORMATS`.
        name: what messages call it.

    Raises:
        OmtwarpError: it is damaged, too large, or of another format.
    """
    from PIL import Image as pil

    try:
        # Pillow warns of damage that it tolerates.
        with warnings.catch_warnings(action="ignore"), open_picture(stream) as opened:
            return _from_pil(opened, name)
    except (OmtwarpError, MemoryError):
        raise
    except pil.UnidentifiedImageError:
        raise OmtwarpError(f"{name}: not a picture in a format that can be read ({', '.join(FORMATS)})") from None
    except Exception as error:  # damaged files end in many kinds of error inside the decoders
        raise OmtwarpError(f"{name}: cannot be read as a picture: {brief(error)}") from None


def _from_pil(image: Image, name: str) -> NDArray[np.generic]:
    from PIL import ImageOps

    if max(image.size) > LONGEST_SIDE:
        raise OmtwarpError(f"{name}: {image.width}x{image.height} texels; no side may be longer than {LONGEST_SIDE}")
    if image.width * image.height > MOST_TEXELS:
        most = f"{MOST_TEXELS / 1e6:.0f} million"
        raise OmtwarpError(f"{name}: {image.width}x{image.height} texels; a picture may have {most} at most")
    turned = ImageOps.exif_transpose(image)
    if image.mode in ("I;16", "I;16L", "I;16B", "I", "F"):  # more than 8 bits: Pillow's own conversion would clip
        values = np.asarray(turned, dtype=np.float32)
        top = 65535.0 if image.mode != "F" else 1.0
        if image.format == "TIFF" and image.mode == "I" and values.max() <= 255.0:  # bytes in 32 bits
            top = 255.0
        return np.repeat(np.clip(values / top, 0.0, 1.0)[..., None], 3, axis=2)
    alpha = turned.mode in ("RGBA", "LA", "PA") or "transparency" in turned.info
    return np.asarray(turned.convert("RGBA" if alpha else "RGB"))


def _from_array(source: ArrayLike) -> NDArray[np.generic]:
    try:
        array = np.asarray(source)
    except Exception as error:
        raise OmtwarpError(f"image of type {type(source).__name__}: give a path, a PIL image or an array") from error
    if array.dtype.kind == "c":
        raise OmtwarpError("image array of complex numbers: give floats in 0..1, or uint8")
    if array.dtype == object or array.dtype.kind not in "uifb":
        raise OmtwarpError(f"image of type {type(source).__name__}: give a path, a PIL image or an array")
    array = array[..., None] if array.ndim == 2 else array
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4) or 0 in array.shape:
        raise OmtwarpError(f"image array of shape {list(np.shape(source))}: give [H, W], [H, W, 3] or [H, W, 4]")
    array = np.repeat(array, 3, axis=2) if array.shape[2] == 1 else array
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
    """Convert a picture to float32 from 0 to 1."""
    values = image.astype(np.float32, copy=False)
    return values / np.float32(255.0) if image.dtype == np.uint8 else values


def as_bytes(image: NDArray[np.generic]) -> Bytes:
    """Convert a picture to uint8, rounded to the nearest number and clipped."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    return np.clip(np.multiply(image, np.float32(255.0)) + np.float32(0.5), 0.0, 255.0).astype(np.uint8)


def resized(image: Bytes, width: int, height: int) -> Bytes:
    """Return a picture in another size."""
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.LANCZOS))


def with_opacity(picture: NDArray[Number]) -> NDArray[Number]:
    """Add full opacity to colours that have none, shape [..., 3] to [..., 4]; bytes, or floats from 0 to 1."""
    if picture.shape[-1] == 4:
        return picture
    return np.concatenate([picture, np.full_like(picture[..., :1], 255 if picture.dtype == np.uint8 else 1.0)], axis=-1)


def without_full_opacity(picture: Bytes) -> Bytes:
    """Drop the opacity of a picture [H, W, 4] that is opaque."""
    opaque = picture.shape[2] == 4 and picture[..., 3].min() == 255
    return np.ascontiguousarray(picture[..., :3]) if opaque else picture


def png_bytes(image: Bytes) -> bytes:
    """Encode an image as a PNG file."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    stream = io.BytesIO()
    origin = PngInfo()
    origin.add_text("Software", "omtwarp")
    # A tenth more bytes than at Pillow's 6, in a third of the time: half a second for 4096 x 4096 texels.
    Image.fromarray(image).save(stream, format="PNG", compress_level=4, pnginfo=origin)
    return stream.getvalue()


def webp_bytes(image: Bytes) -> bytes:
    """Encode an image as a WebP file without loss: the same texels in a third to a half fewer bytes than a PNG.

    Raises:
        OmtwarpError: a side is longer than the format allows.
    """
    longest_webp = 16383  # texels: a side has 14 bits in the format
    from PIL import Image

    if max(image.shape[:2]) > longest_webp:
        height, width = image.shape[:2]
        raise OmtwarpError(f"WebP holds {longest_webp} texels a side, the texture has {width} x {height}: write PNG")
    stream = io.BytesIO()
    # More effort saves a tenth of the bytes and takes twice as long.
    Image.fromarray(image).save(stream, format="WEBP", lossless=True, exact=True, method=0)
    return stream.getvalue()


def longitude_latitude(directions: ArrayLike) -> tuple[Floats, Floats]:
    """Return longitudes in (-π, π] and latitudes in [-π/2, π/2], in radians, of directions [..., 3] of any length."""
    d = np.asarray(directions, dtype=np.float64)
    # atan2 keeps full accuracy next to the poles, where asin(z) loses half of the digits.
    return np.arctan2(d[..., 1], d[..., 0]), np.arctan2(d[..., 2], np.hypot(d[..., 0], d[..., 1]))


def direction_to_image(directions: ArrayLike, projection: str = "equirectangular") -> Floats:
    """Return the image coordinates of directions.

    ``sinusoidal`` is the correction of section 5 of the paper: the longitude is scaled by the cosine of the latitude,
    so that the picture is not stretched sideways next to the poles. It uses the part of the picture between the two
    curves u = (1 ± cos(latitude)) / 2.

    Args:
        directions: vectors of any length, shape [..., 3].
        projection: ``equirectangular`` or ``sinusoidal``.

    Returns:
        (u, v) in 0..1, float64, shape [..., 2]; v points up.
    """
    check_word("projection", projection, ProjectionName)
    lon, lat = longitude_latitude(directions)
    if projection == "sinusoidal":
        lon = lon * np.cos(lat)
    return np.stack([0.5 + lon / (2.0 * np.pi), 0.5 + lat / np.pi], axis=-1)


def rotation_matrix(rotate: ArrayLike | None) -> Floats:
    """Convert a rotation from any accepted form to a matrix, shape [3, 3].

    Args:
        rotate: None (no rotation), a 3x3 rotation matrix, one number (yaw), or yaw, pitch and roll in **degrees**.
            Yaw turns about z (the poles' axis, to the east), then pitch about the new y (positive: down), then roll
            about the new x.

    Raises:
        OmtwarpError: the argument has none of these forms, or the matrix is no rotation.
    """
    from scipy.spatial.transform import Rotation  # takes a tenth of a second to import

    if rotate is None:
        return np.eye(3)
    given = real_numbers(rotate, "rotate", None, finite=False)
    if given.shape == (3, 3):
        # Orthonormal, of a rotation's entries: matrices written with seven digits pass
        if not np.allclose(given @ given.T, np.eye(3), atol=1e-6) or np.linalg.det(given) < 0:
            raise OmtwarpError("rotate: the 3x3 matrix is no rotation: its rows must be orthonormal, its determinant 1")
        return Rotation.from_matrix(given).as_matrix()  # exact: the 1e-6 above must not reach the texture
    angles = np.atleast_1d(given)
    if angles.shape not in ((1,), (3,)) or not np.all(np.isfinite(angles)):
        raise OmtwarpError("rotate: give yaw, or yaw, pitch and roll in degrees, or a 3x3 rotation matrix")
    return Rotation.from_euler("ZYX", np.pad(angles, (0, 3 - len(angles))), degrees=True).as_matrix()
