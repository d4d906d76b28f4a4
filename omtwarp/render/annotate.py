"""Annotations of a picture: backdrop, colour bar, captions."""

import math

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from omtwarp.colors import backdrop, colormap_table
from omtwarp.errors import one_line
from omtwarp.mesh.arrays import ROUND_OFF, Bytes
from omtwarp.render.scene import ScalarField


def compose(
    picture: Bytes, size: tuple[int, int], background: object, transparent: bool, hidden: tuple[int, int, int]
) -> Image.Image:
    """Lay a drawn surface (colours multiplied by coverage) over the background, at the left of a canvas.

    ``hidden`` is the colour of fully transparent pixels: that of the text drawn later, whose smooth edges would
    otherwise be blended with black.

    Returns:
        RGB, or RGBA where it is to be transparent.
    """
    width, height = size
    drawn = np.pad(picture, ((0, height - picture.shape[0]), (0, width - picture.shape[1]), (0, 0)))
    colors, coverage = drawn[..., :3], drawn[..., 3:]
    if transparent:
        whole = np.maximum(coverage, 1).astype(np.uint16)
        single = np.minimum((colors * np.uint16(255) + whole // 2) // whole, 255)
        single = np.where(coverage > 0, single, np.asarray(hidden, dtype=np.uint16))
        return Image.fromarray(np.concatenate([single.astype(np.uint8), coverage], axis=2))
    behind = np.rint(backdrop(background, width, height) * 255.0).astype(np.uint16)
    through = behind * (255 - coverage).astype(np.uint16) + np.uint16(127)
    return Image.fromarray(np.minimum(colors + through // np.uint16(255), 255).astype(np.uint8))


def ink(background: object, transparent: bool) -> tuple[int, int, int]:
    """Return dark or light text colour, whichever is legible on the background; mid-grey where that is unknown."""
    if transparent:
        return (110, 116, 124)
    mean = backdrop(background, 1, 16).mean(axis=(0, 1)) @ np.array([0.299, 0.587, 0.114])
    return (38, 44, 52) if mean > 0.5 else (226, 230, 235)


def font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """Return Pillow's built-in font at a size."""
    return ImageFont.load_default(size=max(size, 8.0))


def bar_width(size: tuple[int, int]) -> int:
    """Return the width in pixels of the colour bar at the right of a picture."""
    return max(64, round(0.17 * min(size)))


def draw_color_bar(image: Image.Image, scalar: ScalarField, color: tuple[int, int, int]) -> None:
    """Draw the colour map, its values and its label into the right end of a picture."""
    width, height = image.size
    bar = bar_width(image.size)
    text = font(min(image.size) / 44.0)
    left, right = width - bar + round(0.12 * bar), width - bar + round(0.30 * bar)
    top, bottom = round(0.16 * height), round(0.84 * height)
    strip = np.repeat(colormap_table(scalar.colormap, max(2, bottom - top))[::-1, None], right - left, axis=1)
    image.paste(Image.fromarray(np.ascontiguousarray(strip)).convert(image.mode), (left, top))
    draw = ImageDraw.Draw(image)
    draw.rectangle((left - 1, top - 1, right, bottom), outline=color)
    low, high = scalar.limits()
    for value in ticks(low, high, scalar.logarithmic):
        part = np.log(value / low) / np.log(high / low) if scalar.logarithmic else (value - low) / (high - low)
        y = bottom - 1 - part * (bottom - 1 - top)
        draw.line((right, y, right + 0.05 * bar, y), fill=color)
        draw.text((right + 0.09 * bar, y), f"{value:.4g}", font=text, fill=color, anchor="lm")
    if label := one_line(str(scalar.label)):
        # Over the bar where the picture is wide enough to its right, else ending at the picture's border.
        fits = left + draw.textlength(label, font=text) < width - 0.04 * bar
        place = (left, top - 0.025 * height) if fits else (width - 0.04 * bar, top - 0.025 * height)
        draw.text(place, label, font=text, fill=color, anchor="lb" if fits else "rb")


def ticks(low: float, high: float, logarithmic: bool = False) -> list[float]:
    """Round values between two limits, about five of them: multiples of 1, 2, 2.5 or 5 times a power of ten."""
    # Steps: a value that is so near to a tick, as a quotient of rounded numbers is, is the tick.
    near = 1e-9
    if logarithmic:
        first, last = int(np.floor(np.log10(low))), int(np.ceil(np.log10(high)))
        for mantissas in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7)):
            values = [m * 10.0**power for power in range(first, last + 1) for m in mantissas]
            inside = [value for value in values if low * (1 - near) <= value <= high * (1 + near)]
            if len(inside) >= 4:
                return inside[:: max(1, len(inside) // 6)]
        # Less than a factor of two or so: the logarithm is nearly straight.
    room = near * (high - low)
    return [value for value in nice_ticks(low, high, 5) if low - room <= value <= high + room]


def nice_ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers from at or below ``low`` to at or above ``high``."""
    near = 1e-9  # steps: a value that is so near to a tick, as a quotient of rounded numbers is, is the tick
    raw = max(high - low, ROUND_OFF, near * max(abs(low), abs(high))) / count
    unit = 10.0 ** math.floor(math.log10(raw))
    step = next(unit * m for m in (1, 2, 2.5, 5, 10) if unit * m >= raw * (1 - near))
    first, last = math.floor(low / step + near), math.ceil(high / step - near)
    return [k * step for k in range(first, max(last, first + 1) + 1)]


def grid(
    images: list[Image.Image], captions: list[str], background: object, transparent: bool, columns: int, title: str
) -> Image.Image:
    """Put pictures of one size side by side, each over its caption, in so many columns, 0 for as many as look well.

    The renderer is that of the last of them.
    """
    count = len(images)
    columns = columns or (count if count <= 3 else int(np.ceil(np.sqrt(count))))
    columns = max(1, min(columns, count))
    rows = -(-count // columns)
    width, height = max(image.width for image in images), max(image.height for image in images)
    longest = max((len(caption) for caption in captions), default=0)
    # Width of a sheet over the height of its captions: shown 750 pixels wide, as on a page, letters have 12.
    # Letter width, of a letter over its height, at most on average: captions stay apart
    legible = min(columns * width / 64.0, width / (0.6 * max(longest, 1)))
    letters = max(11.0, min(width, height) / 24.0, legible)
    band = round(2.0 * letters) if any(captions) else 0
    head = round(2.6 * letters) if title else 0
    size = (columns * width, head + rows * (height + band))
    if transparent:
        canvas = Image.new("RGBA", size, (0, 0, 0, 0))
    else:
        behind = np.broadcast_to(backdrop(background, size[0], size[1]), (size[1], size[0], 3))
        canvas = Image.fromarray(np.rint(behind * 255).astype(np.uint8))
    draw = ImageDraw.Draw(canvas)
    color = ink(background, transparent)
    for k, image in enumerate(images):
        x, y = (k % columns) * width, head + (k // columns) * (height + band)
        place = (x + (width - image.width) // 2, y)
        # Panels come transparent where the background runs through the whole sheet.
        canvas.paste(image, place, image if image.mode == "RGBA" and not transparent else None)
        if band and captions[k]:
            middle = (x + width / 2, y + height + band * 0.42)
            draw.text(middle, captions[k], font=font(letters), fill=color, anchor="mm")
    if head:
        draw.text((size[0] / 2, head * 0.55), title, font=font(letters * 1.25), fill=color, anchor="mm")
    canvas.info["backend"] = next((image.info["backend"] for image in reversed(images) if "backend" in image.info), "")
    return canvas
