"""Opening of pictures by Pillow, in one place: by its header alone, and only in formats that Pillow decodes itself."""

from __future__ import annotations

import re
import threading
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.limits import MOST_TEXELS

if TYPE_CHECKING:
    from PIL.Image import Image

# Formats that textures come in and Pillow decodes itself; it would pass others, such as EPS, to programs of the system.
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "TGA")

_pillow = threading.Lock()  # over Pillow's own limit, which is one number for the whole process


def open_picture(stream: BinaryIO, formats: tuple[str, ...] = FORMATS) -> Image:
    """Open a picture and read its header, without Pillow's own limit of size: the caller has one that fits.

    Raises:
        Exception: what Pillow raises on a file of another format.
    """
    from PIL import Image as pil

    with _pillow:
        limit = pil.MAX_IMAGE_PIXELS
        pil.MAX_IMAGE_PIXELS = None
        try:
            return pil.open(stream, formats=formats)
        finally:
            pil.MAX_IMAGE_PIXELS = limit


def read_stack(stream: BinaryIO) -> tuple[NDArray[np.generic], tuple[float, float, float]]:
    """Read the pages of a TIFF file, one above another, as a volume of numbers.

    Returns:
        Numbers of columns, rows and pages, shape [X, Y, Z], and the sides of a voxel: ImageJ's, or 1.

    Raises:
        OmtwarpError: colours, pages of different sizes, several channels or times, or too many numbers.
        Exception: what Pillow raises on a damaged file.
    """
    # Tags of TIFF: the description, and texels per unit of length across and down
    described, across, down = 270, 282, 283
    pages: list[NDArray[np.generic]] = []
    with open_picture(stream, ("TIFF",)) as opened:
        text = str(opened.tag_v2.get(described, ""))  # type: ignore[attr-defined]
        per_unit = [float(opened.tag_v2.get(tag, 1.0)) for tag in (across, down)]  # type: ignore[attr-defined]
        more = re.search(r"^(channels|frames)=([2-9]|\d{2,})", text, re.M)
        if more:
            raise OmtwarpError(f"a volume of several {more.group(1)}: save one of them by itself")
        while True:
            if opened.mode not in ("1", "L", "P", "I", "F", "I;16", "I;16L", "I;16B"):
                raise OmtwarpError(f"pages of colours ({opened.mode}), not of labels")
            if (len(pages) + 1) * opened.width * opened.height > MOST_TEXELS:
                raise OmtwarpError(f"more than {MOST_TEXELS / 1e6:.0f} million voxels, which is the most")
            page = np.asarray(opened)
            if pages and page.shape != pages[0].shape:
                raise OmtwarpError(f"no volume: page {len(pages)} is of another size than the first")
            pages.append(page)
            try:
                opened.seek(len(pages))
            except EOFError:
                break
    thick = re.search(r"^spacing=(\S+)", text, re.M)
    sides = (1.0, 1.0, 1.0)
    if text.startswith("ImageJ=") and thick and min(per_unit) > 0.0:
        sides = (1.0 / per_unit[0], 1.0 / per_unit[1], abs(float(thick.group(1))))
    return np.stack(pages).transpose(2, 1, 0), sides
