"""The number of texels that a texture needs for none to be visible as a square on the surface.

Sides of pictures are powers of two, as graphics cards, their mip maps and block compression have them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SCREEN = 1024  # pixels across a picture that the surface fills
TEXEL = 1.5  # pixels of that picture that a texel may cover: bilinear filtering hides the steps of smaller ones
LARGEST_SIZE = 8192  # texels: the largest picture that every graphics card of the last ten years takes
# The largest size that is chosen where none is asked for: a quarter of the time and memory.
LARGEST_UNASKED = 4096
# Widths of the picture, in texels, for one texel along a right angle of the sphere, where texels are largest: measured
# at 20,000 points and in 16 directions, gutters included. Of a cube map the width of three cells.
SIDES = {"cube": 3.76, "octahedral": 3.94, "equirectangular": 4.0}


@dataclass(frozen=True)
class Sharpness:
    """The size of a texture, and the share of the surface that it leaves blurred.

    Attributes:
        size: width of the texture in texels, or width and height of a cube map.
        coarse: part of the surface's area on which texels are larger than they should be, because of the limit.
    """

    size: int | tuple[int, int]
    coarse: float


def sharp_size(
    vertices: Floats, faces: NDArray[np.int32], sphere: Floats, atlas: str, limit: int = LARGEST_SIZE
) -> Sharpness:
    """Return the least size at which no texel covers more than 1.5 pixels of 1024 x 1024 that the surface fills.

    Where a map makes a triangle small on the sphere, its texels are large on the surface; the triangle in which the map
    shrinks lengths most determines the size.

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        sphere: the map, unit vectors, shape [V, 3].
        atlas: name of the layout.
        limit: the largest width.

    Example:
        >>> from omtwarp.mesh import shapes
        >>> from omtwarp.texturing.sharpness import sharp_size
        >>> ball = shapes.icosphere(8)
        >>> sharp_size(ball.vertices, ball.faces, ball.vertices, "cube").size
        (2048, 2048)
    """
    extent = max(float(np.ptp(vertices, axis=0).max()), np.finfo(float).tiny)
    surface = (vertices - vertices.min(axis=0)) / extent
    stretch = largest_stretch(surface, faces, sphere)
    needed = stretch * 0.5 * np.pi * SCREEN / TEXEL * SIDES[atlas]
    size, enough = picture_size(float(needed.max(initial=0.0)), atlas, limit)
    corner = surface[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return Sharpness(size, float(area[needed > enough].sum() / max(float(area.sum()), np.finfo(float).tiny)))


def picture_size(needed: float, atlas: str, limit: int) -> tuple[int | tuple[int, int], float]:
    """Return the least size of a picture with sides that are powers of two, and the width for which it is enough.

    Args:
        needed: texels across the picture, or across three cells of a cube map.
        atlas: name of the layout.
        limit: the largest width.
    """
    # Smallest size, texels: 200 kB; less would hardly save anything
    width = 256
    while True:
        # A cube map has cells of a quarter of its width where it is half as high as wide, and of a third in a square.
        enough = 3.0 * (width // 4) if atlas == "cube" else float(width)
        if needed <= enough or (2 * width > limit and atlas != "cube"):
            return (width, width // 2) if atlas == "cube" else width, enough
        if atlas == "cube" and (needed <= 12.0 * (width // 12) or 2 * width > limit):
            return (width, width), 12.0 * (width // 12)
        width *= 2


def largest_stretch(surface: Floats, faces: NDArray[np.int32], sphere: Floats) -> Floats:
    """Return the largest ratio of length on the surface to length on the sphere in every triangle, shape [F].

    The larger root of det(A - x² B) = 0, with A and B the metrics of a triangle here and there. Infinite where a
    triangle has no area on the sphere, 0 where it is a point on both.
    """
    here, there = _metric(surface[faces]), _metric(sphere[faces])
    (a, b, c), (p, q, r) = here.T, there.T
    lead, middle, last = p * r - q * q, a * r + c * p - 2.0 * b * q, np.maximum(a * c - b * b, 0.0)
    root = np.sqrt(np.maximum(middle * middle - 4.0 * lead * last, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.sqrt(np.maximum(middle + root, 0.0) / (2.0 * lead))
    return np.where(lead > 0.0, found, np.where(a + c > 0.0, np.inf, 0.0))


def _metric(corner: Floats) -> Floats:
    """Return the squared lengths of two edges and, between them, the edges' inner product, shape [F, 3]."""
    one, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    pairs = ((one, one), (one, other), (other, other))
    return np.stack([np.einsum("ij,ij->i", x, y) for x, y in pairs], axis=1)
