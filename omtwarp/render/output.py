"""Writing pictures and films: whole or not at all."""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from omtwarp.errors import OmtwarpError
from omtwarp.files import as_path, check_output, staged

STILL_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP", ".tif": "TIFF", ".tiff": "TIFF"}
FILM_FORMATS = (".gif", ".mp4", ".webp")
WEBP = 60  # of Pillow's 100: a third of the size at 80, and edges of a pattern stay clean
LEAST_FREE = 65536  # bytes: ffmpeg's failure on a disk with less is taken for a full disk
OPAQUE_FORMATS = (".jpg", ".jpeg", ".mp4")


def check_target(path: str | os.PathLike[str], *, film: bool, transparent: bool) -> Path:
    """Find out before the work whether its result can be written.

    Raises:
        OmtwarpError: unknown suffix, a suffix that cannot hold the picture, or a directory that cannot be written to.
    """
    target = as_path(path)
    suffix = target.suffix.lower()
    if suffix not in STILL_FORMATS and suffix not in FILM_FORMATS:
        raise OmtwarpError(
            f"unknown picture format '{suffix}' of '{target}': "
            "use .png, .jpg, .webp or .tif; .gif, .webp or .mp4 for films"
        )
    if film and suffix not in FILM_FORMATS:
        raise OmtwarpError(f"'{target}' cannot hold a film: use .gif, .webp or .mp4")
    if not film and suffix == ".mp4":
        raise OmtwarpError(f"'{target}' is a film: ask for turntable frames, or use .png")
    if transparent and suffix in OPAQUE_FORMATS:
        raise OmtwarpError(f"'{target}' cannot be transparent: use .png, .webp or .gif")
    check_output(target)
    if suffix == ".mp4":
        _ffmpeg()
    return target


def save_still(image: Any, path: str | os.PathLike[str]) -> None:
    """Write one picture.

    Raises:
        OmtwarpError: the file cannot be written.
    """
    target = as_path(path)
    kind = STILL_FORMATS.get(target.suffix.lower(), "GIF")
    with staged(target) as file:
        if kind == "JPEG":
            image.convert("RGB").save(file, kind, quality=93, subsampling=0)
        elif kind == "PNG":  # a twentieth larger than at Pillow's level, in half the time
            image.save(file, kind, compress_level=4)
        else:
            image.save(file, kind)


def save_film(frames: Iterable[Any], path: str | os.PathLike[str], fps: float) -> None:
    """Write frames as an endless GIF or WebP, or as an MP4 (H.264), for which they are not kept.

    Raises:
        OmtwarpError: the file cannot be written, or an MP4 is asked for without ffmpeg.
    """
    target = as_path(path)
    with staged(target) as file:
        if target.suffix.lower() == ".gif":
            _gif(list(frames), file, fps)
        elif target.suffix.lower() == ".webp":
            first, *others = frames
            duration = max(1, round(1000 / fps))
            first.save(file, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=WEBP)
        else:
            _mp4(frames, file, fps)


def _gif(frames: Sequence[Any], file: Path, fps: float) -> None:
    from PIL import Image

    # One palette for all frames, or colours would flicker as the surface turns; made from a strip of small copies.
    clear = frames[0].mode == "RGBA"
    width = 128
    height = max(1, round(width * frames[0].height / frames[0].width))
    some = frames[:: max(1, len(frames) // 16)]
    strip = Image.new("RGB", (width * len(some), height))
    for k, shown in enumerate(some):
        strip.paste(shown.convert("RGB").resize((width, height)), (k * width, 0))
    colors = (strip.quantize(254, method=Image.Quantize.MEDIANCUT).getpalette() or [])[: 3 * 254]
    # The corner's colour exactly, since a background a shade off shows on a page of that colour. 255 stays for holes.
    corner = frames[0].convert("RGB").getpixel((0, 0))
    palette = Image.new("P", (1, 1))
    palette.putpalette(colors + list(corner) * (256 - len(colors) // 3))
    pages = []
    for shown in frames:
        opaque = shown.convert("RGB")
        page = opaque.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
        same = (np.asarray(opaque) == corner).all(axis=2)  # Pillow's search for the nearest colour is not exact
        page.paste(254, mask=Image.fromarray(same))
        if clear:  # GIF knows no half-transparent pixel
            page.paste(255, mask=shown.getchannel("A").point(lambda alpha: 255 if alpha < 128 else 0))
        pages.append(page)
    extra = {"transparency": 255, "disposal": 2} if clear else {}
    duration = max(20, round(100 / fps) * 10)  # GIF counts hundredths of a second
    pages[0].save(
        file, "GIF", save_all=True, append_images=pages[1:], duration=duration, loop=0, optimize=False, **extra
    )


def _ffmpeg() -> Any:
    try:
        import imageio_ffmpeg

        imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise OmtwarpError("an .mp4 needs ffmpeg: pip install 'omtwarp[film]', or write a .gif") from None
    return imageio_ffmpeg


def _mp4(frames: Iterable[Any], file: Path, fps: float) -> None:
    shown_in_turn = iter(frames)
    first = next(shown_in_turn)
    width, height = (first.width // 2 * 2, first.height // 2 * 2)  # H.264 halves the colours' resolution
    writer = _ffmpeg().write_frames(
        str(file), (width, height), fps=fps, codec="libx264", quality=8, macro_block_size=2, ffmpeg_log_level="error"
    )
    try:
        writer.send(None)
        for shown in itertools.chain([first], shown_in_turn):
            writer.send(shown.convert("RGB").crop((0, 0, width, height)).tobytes())
        writer.close()
        written = file.is_file() and file.stat().st_size > 0
    except OSError:  # whose text is ffmpeg's command and all that it said
        written = False
    finally:
        writer.close()
    if not written:
        full = shutil.disk_usage(file.parent).free < LEAST_FREE
        raise OSError("No space left on device" if full else "ffmpeg could not write it")
