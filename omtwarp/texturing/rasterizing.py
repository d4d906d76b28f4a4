"""Patterns as pictures of the whole sphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.texturing.adaptive import bake_bytes
from omtwarp.texturing.atlas import Equirectangular, check_size
from omtwarp.texturing.bending import Look
from omtwarp.texturing.image import as_bytes
from omtwarp.texturing.patterns import Pattern, pattern
from omtwarp.texturing.projection import check_projection, direction_from_angles


def rasterize(
    source: str | Pattern,
    width: int = 2048,
    height: int | None = None,
    projection: str = "equirectangular",
    *,
    supersample: int = 3,
    device: str | None = "auto",
) -> NDArray[np.uint8]:
    """Draw a pattern as a supersampled picture of the whole sphere.

    Args:
        source: name of a pattern, or a pattern.
        width, height: in texels; the height is half the width by default.
        projection: ``equirectangular``, or ``sinusoidal``: a picture for ``texture(..., projection="sinusoidal")``,
            with the texels outside the two bounding curves filled from the nearest point inside.
        supersample: side of the grid of samples per texel where the colour changes.

    Returns:
        uint8, shape [height, width, 3], north on top.
    """
    check_projection(projection)
    width, height = check_size((width, max(width // 2, 1) if height is None else height))
    given = pattern(source)
    if projection == "equirectangular":
        target = Equirectangular(width, height)
        return bake_bytes(given, Look(target, resolve_device(device)), supersample=supersample)
    return as_bytes(_rasterize_sinusoidal(given, width, height, supersample, device))


def _rasterize_sinusoidal(
    given: Pattern, width: int, height: int, supersample: int, device: wp.Device
) -> NDArray[np.float32]:
    picture = np.empty((height, width, 3), dtype=np.float32)
    x = ((np.arange(width * supersample) + 0.5) / (width * supersample) - 0.5) * 2.0 * np.pi
    # At once, texels whose colours are computed together: 13 MB of directions
    rows = max(1, (1 << 19) // (width * supersample**2))
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        sub = np.arange(start * supersample, stop * supersample)
        lat = (0.5 - (sub + 0.5) / (height * supersample)) * np.pi
        lon = np.clip(x[None, :] / np.cos(lat)[:, None], -np.pi, np.pi)
        colours = given(direction_from_angles(lon, lat[:, None]).reshape(-1, 3), device)
        blocks = colours.reshape(stop - start, supersample, width, supersample, 3)
        picture[start:stop] = blocks.mean(axis=(1, 3))
    return picture
