"""Triangles laid out on a picture: copies where coordinates leave it, overlaps, and values and materials at texels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import ROUND_OFF
from omtwarp.painting import kernels
from omtwarp.srgb import to_linear, to_srgb
from omtwarp.texturing.baking import SAMPLES_AT_ONCE, Layout, Picture, VertexValues, bake_to_uv
from omtwarp.texturing.image import as_floats
from omtwarp.texturing.kernels import average_samples
from omtwarp.texturing.materials import Floats, Ints, Material

PADDING = 16
"""Texels by which charts are continued beyond their borders: bilinear samples see them at the fifth mip level yet."""

SAMPLES = 2
"""Side of the grid of samples in a texel that a picture is carried over with."""

MOST_TILES = 16
"""Copies of the picture that one triangle may reach over, along either side."""

INSIDE = 0.02
"""Texels by which a centre lies inside a triangle for certain: neighbours share their sides to round-off."""


def tiled_copies(uv: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Copy triangles so that each copy covers its part of the unit square, for pictures that repeat.

    Args:
        uv: coordinates of the corners, shape [F, 3, 2].

    Returns:
        Which triangle each copy is of, shape [T], and its coordinates, shape [T, 3, 2]; a copy may reach over the
        square's border, and another one then reaches over the opposite border.

    Raises:
        OmtwarpError: a triangle reaches over more than :data:`MOST_TILES` pictures along a side.
    """
    low = np.floor(uv.min(axis=1) + ROUND_OFF).astype(np.int64)
    high = np.maximum(np.ceil(uv.max(axis=1) - ROUND_OFF).astype(np.int64), low + 1)
    count = high - low
    if len(count) and count.max() > MOST_TILES:
        face = int(np.argmax(count.max(axis=1)))
        raise OmtwarpError(
            f"texture coordinates: face {face} reaches over {count[face].max()} copies of the picture, and "
            f"{MOST_TILES} is the most"
        )
    number = count.prod(axis=1)
    which = np.repeat(np.arange(len(uv)), number)
    step = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
    shift = low[which] + np.stack([step % count[which, 0], step // count[which, 0]], axis=1)
    return which, uv[which] - shift[:, None, :]


def overlap(uv: Floats, width: int, height: int, where: wp.Device) -> float:
    """Return the share of the covered texels that lie in more than one triangle, from 0 to 1."""
    if not len(uv):
        return 0.0
    texels = np.stack([uv[..., 0] * width, (1.0 - uv[..., 1]) * height], axis=-1)
    claims = wp.zeros(width * height, dtype=wp.int32, device=where)
    corners = wp.array(np.ascontiguousarray(texels), dtype=wp.vec2d, device=where)
    wp.launch(
        kernels.count_claims,
        dim=len(uv),
        inputs=[corners, width, height, wp.float64(INSIDE), claims],
        device=where,
    )
    counts = claims.numpy()
    return float((counts > 1).sum() / max((counts > 0).sum(), 1))


def bake_corners(
    uv: Floats,
    values: Floats,
    size: tuple[int, int],
    *,
    padding: int = PADDING,
    samples: int = SAMPLES,
    device: wp.Device,
) -> Picture:
    """Bake values at corners, linear over every triangle, to a picture; texels outside of all triangles are 0.

    Args:
        uv: coordinates of the corners, shape [F, 3, 2].
        values: shape [F, 3, C].
        size: width and height in texels.
        padding: texels by which charts are continued, -1 for all.
        samples: side of the grid of samples in a texel.
        device: where to compute.

    Returns:
        float32, shape [H, W, C].
    """
    flat = np.arange(3 * len(uv)).reshape(-1, 3)
    source = VertexValues(values.reshape(3 * len(uv), -1))
    no_sphere = np.zeros((3 * len(uv), 3))
    return bake_to_uv(
        source, no_sphere, flat, uv, size=size, padding=padding, supersample=samples, device=device
    )  # fmt: skip


def covered(uv: Floats, size: tuple[int, int], *, padding: int = PADDING, device: wp.Device) -> NDArray[np.bool_]:
    """Return a mask of the texels that triangles and the padding around them cover, shape [H, W]."""
    ones = np.ones((len(uv), 3, 1))
    return bake_corners(uv, ones, size, padding=padding, samples=1, device=device)[..., 0] > 0.5


def bake_materials(
    layout: Layout, own: Floats | None, which: Ints, materials: tuple[Material, ...], colors: Floats | None, rings: int
) -> Picture:
    """Bake the colours of materials to the texels of a layout, through the triangles' own coordinates.

    Args:
        layout: the triangles on the picture to be made.
        own: coordinates of the layout's corners on the materials' own pictures, shape [K, 3, 2]; None without any.
        which: number of the material of every triangle, shape [K].
        materials: whose colours are taken; pictures repeat.
        colors: sRGB and opacity at the corners from 0 to 1, shape [K, 3, 4], for materials without a picture.
        rings: texels by which charts are continued, -1 for all.

    Returns:
        sRGB and opacity from 0 to 1, float32, shape [H, W, 4]; opaque black where nothing is.
    """
    where = layout.where
    out = wp.zeros((layout.width * layout.height, 4), dtype=wp.float32, device=where)
    texels = layout.owned()
    number = which[layout.owner.numpy()[texels]]
    for k, material in enumerate(materials):
        mine = texels[number == k]
        if not len(mine):
            continue
        factor = np.array(material.color, dtype=np.float32)
        white = np.ones((1, 1, 4), dtype=np.float32)
        picture = white if material.picture is None else as_floats(material.picture)
        if picture.shape[2] == 3:
            picture = np.concatenate([picture, np.ones((*picture.shape[:2], 1), np.float32)], axis=2)
        picture = tinted(picture, factor)
        at_corners = own if own is not None else np.zeros((len(which), 3, 2))
        by_color = colors is not None and material.picture is None
        given = colors if by_color else at_corners
        values = wp.array(np.ascontiguousarray(given), dtype=wp.float64, device=where)
        source = wp.array(np.ascontiguousarray(picture), dtype=wp.float32, device=where)
        step = max(SAMPLES_AT_ONCE // SAMPLES**2, 1)
        for start in range(0, len(mine), step):
            some = wp.array(mine[start : start + step], dtype=wp.int32, device=where)
            count = len(some) * SAMPLES**2
            points = wp.empty((count, 4 if by_color else 2), dtype=wp.float64, device=where)
            layout.interpolate(values, some, SAMPLES, points)
            found = points
            if not by_color:
                found = wp.empty((count, 4), dtype=wp.float64, device=where)
                wp.launch(kernels.sample_repeated, dim=count, inputs=[source, points, found], device=where)
            wp.launch(average_samples, dim=len(some), inputs=[found, SAMPLES, some, out], device=where)
    found = layout.dilate(out, rings).numpy()
    found[~layout.known & (found[:, 3] == 0), 3] = 1.0  # texels outside of all triangles make no material transparent
    return found.reshape(layout.height, layout.width, 4)


def tinted(picture: NDArray[np.float32], factor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Multiply a picture by a colour as light; both are sRGB with opacity from 0 to 1, shape [H, W, 4]."""
    if (factor == 1.0).all():
        return picture
    rgb = to_srgb(to_linear(picture[..., :3]) * to_linear(factor[:3]))
    return np.concatenate([rgb, picture[..., 3:] * factor[3]], axis=2).astype(np.float32)


def over(top: NDArray[np.float32], bottom: NDArray[np.float32], opacity: float) -> NDArray[np.float32]:
    """Lay one picture over another by Porter and Duff's "over" [1]_, in linear light.

    Args:
        top: sRGB and opacity from 0 to 1, shape [H, W, 4].
        bottom: the same.
        opacity: factor on the opacity of the top, from 0 to 1.

    Returns:
        sRGB and opacity, shape [H, W, 4].

    .. [1] T. Porter, T. Duff, "Compositing Digital Images", SIGGRAPH 1984.
    """
    above = top[..., 3:] * np.float32(opacity)
    below = bottom[..., 3:] * (1.0 - above)
    total = above + below
    # Least cover, of opacity: what is more transparent has no colour; eight bits resolve 4e-3
    light = (to_linear(top[..., :3]) * above + to_linear(bottom[..., :3]) * below) / np.maximum(total, np.float32(1e-6))
    return np.concatenate([to_srgb(light), total], axis=2).astype(np.float32)


__all__ = ["PADDING", "bake_corners", "bake_materials", "covered", "over", "overlap", "tiled_copies", "tinted"]
