"""Writing of pictures and films; a file is written completely or not at all."""

import contextlib
import itertools
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Sequence
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import as_path, check_output, staged

STILL_FORMATS = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WEBP", ".tif": "TIFF", ".tiff": "TIFF"}
FILM_FORMATS = (".gif", ".mp4", ".webp")
# Encoders of H.264 by what they are preferred for, each at a quality at which edges of a pattern stay clean: x264's
# constant rate factor (0 to 51, smaller is better), for others a rate in bits per second.
ENCODERS = {
    "libx264": ["-c:v", "libx264", "-crf", "18", "-preset", "medium"],
    "libopenh264": ["-c:v", "libopenh264", "-b:v", "8M"],
    "h264_videotoolbox": ["-c:v", "h264_videotoolbox", "-b:v", "8M"],
    "h264_mf": ["-c:v", "h264_mf", "-b:v", "8M"],
}
MPEG4 = ["-c:v", "mpeg4", "-q:v", "3"]
# Players take films of this size for BT.709; ffmpeg itself would convert by BT.601, which shifts the colours.
BT709 = (
    "scale=out_color_matrix=bt709:out_range=tv,"
    "setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709:range=tv"
)
OPAQUE_FORMATS = (".jpg", ".jpeg", ".mp4")


def check_target(path: str | os.PathLike[str], *, film: bool, transparent: bool) -> Path:
    """Check before the work that its result can be written.

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


def save_still(image: Image.Image, path: str | os.PathLike[str]) -> None:
    """Write one picture.

    Raises:
        OmtwarpError: the file cannot be written.
    """
    target = as_path(path)
    kind = STILL_FORMATS.get(target.suffix.lower(), "GIF")
    # A PNG is a twentieth larger than at Pillow's level, in half the time
    options = {"JPEG": {"quality": 93, "subsampling": 0}, "PNG": {"compress_level": 4}}.get(kind, {})
    with staged(target) as file:
        (image.convert("RGB") if kind == "JPEG" else image).save(file, kind, **options)


def save_film(frames: Iterable[Image.Image], path: str | os.PathLike[str], fps: float) -> None:
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
            # A third of the size at Pillow's 80, and edges of a pattern stay clean
            first.save(file, "WEBP", save_all=True, append_images=others, duration=duration, loop=0, quality=60)
        else:
            _mp4(frames, file, fps)


def _gif(frames: Sequence[Image.Image], file: Path, fps: float) -> None:
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
    palette.putpalette(colors + list(cast(tuple[int, int, int], corner)) * (256 - len(colors) // 3))
    pages = []
    for shown in frames:
        opaque = shown.convert("RGB")
        page = opaque.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
        # Pillow's search for the nearest colour is not exact.
        page.paste(254, mask=Image.fromarray((np.asarray(opaque) == corner).all(axis=2)))
        if clear:  # GIF knows no half-transparent pixel
            page.paste(255, mask=shown.getchannel("A").point(lambda alpha: 255 if alpha < 128 else 0))
        pages.append(page)
    extra = {"transparency": 255, "disposal": 2} if clear else {}
    duration = max(20, round(100 / fps) * 10)  # GIF counts hundredths of a second
    pages[0].save(
        file, "GIF", save_all=True, append_images=pages[1:], duration=duration, loop=0, optimize=False, **extra
    )


def _ffmpeg() -> str:
    """Find the program ffmpeg: on the PATH, or the one that the package imageio-ffmpeg brings.

    Raises:
        OmtwarpError: neither is installed.
    """
    program = shutil.which("ffmpeg")
    if program is not None:
        return program
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise OmtwarpError(
            "an .mp4 needs the program ffmpeg, and none is found: install it (apt, brew or winget install ffmpeg, "
            "or the package imageio-ffmpeg), or write a .gif or .webp"
        ) from None


@cache
def _encoder(program: str) -> list[str]:
    """Return the options of an ffmpeg's first encoder for H.264, or of MPEG-4, which every build has."""
    listed = subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, text=True, check=False).stdout
    return next((options for name, options in ENCODERS.items() if f" {name} " in listed), MPEG4)


def video_size(width: int, height: int) -> tuple[int, int]:
    """Return the even numbers of pixels that an MP4 has along its sides: H.264 halves the resolution of colours."""
    return width // 2 * 2, height // 2 * 2


def _mp4(frames: Iterable[Image.Image], file: Path, fps: float) -> None:
    shown_in_turn = iter(frames)
    first = next(shown_in_turn)
    width, height = video_size(first.width, first.height)
    program = _ffmpeg()
    command = [
        program, "-hide_banner", "-loglevel", "error", "-nostdin", "-y",
        "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(Fraction(fps).limit_denominator()),
        "-i", "-", "-vf", BT709, *_encoder(program), "-pix_fmt", "yuv420p", "-movflags", "+faststart",
        str(file),
    ]  # fmt: skip
    with tempfile.TemporaryFile() as words:
        # An interruption of this process ends the writing, not ffmpeg, which would print its own messages: elsewhere
        # than on Windows by a session of its own, there by a group.
        encoder = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=words, start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )  # fmt: skip
        try:
            assert encoder.stdin is not None
            for shown in itertools.chain([first], shown_in_turn):
                try:
                    encoder.stdin.write(shown.convert("RGB").crop((0, 0, width, height)).tobytes())
                except OSError:  # it has ended: its status and last message say why
                    break
            with contextlib.suppress(OSError):
                encoder.stdin.close()
            status = encoder.wait()
        except BaseException:
            encoder.kill()
            encoder.wait()
            raise
        words.seek(0)
        said = words.read().decode("utf-8", "replace").replace(str(file), file.name).splitlines()
    if status != 0 or not file.is_file() or file.stat().st_size == 0:
        # Least free, bytes: a failure of ffmpeg on a disk with less is reported as a full disk
        full = shutil.disk_usage(file.parent).free < 65536
        reason = next((line.strip() for line in reversed(said) if line.strip()), f"ffmpeg ended with status {status}")
        raise OSError("No space left on device" if full else f"ffmpeg could not write it: {reason}")
