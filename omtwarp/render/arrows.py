"""Arrows for a vector field on a surface, as triangles that both renderers draw like any others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.colors import parse_color
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import TINY
from omtwarp.render.scene import Arrows, Part, SurfaceView, normalisation, numbers_of, welded_normals

# Bisections of the width of a grid's cells, in radii, between the first two: 2000 to 1 in powers of two, to 0.003 %.
CELLS, BISECTIONS = (1e-3, 2.0), 18


def arrow_part(view: SurfaceView, arrows: Arrows) -> Part | None:
    """Convert a field's arrows to the renderers' form; None where the field is zero everywhere.

    Raises:
        OmtwarpError: the field has the wrong shape or a value that is not finite.
    """
    vertices, faces = np.asarray(view.vertices), np.asarray(view.faces)
    vectors = numbers_of(arrows.vectors, "arrows")
    if vectors.shape not in ((len(vertices), 3), (len(faces), 3)):
        raise OmtwarpError(
            f"arrows need a vector per vertex [{len(vertices)}, 3] or per face [{len(faces)}, 3], "
            f"not {list(vectors.shape)}"
        )
    bad = np.flatnonzero(~np.isfinite(vectors).all(axis=1))
    if bad.size:
        raise OmtwarpError(f"arrows have NaN or infinite values in {bad.size} rows, the first is row {bad[0]}")
    centre, radius = normalisation(view)
    positions = (vertices - centre) / radius
    normals = welded_normals(positions, faces)
    if len(vectors) != len(vertices):
        positions = positions[faces].mean(axis=1)
        normals = normals[faces].mean(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=1), TINY)[:, None]
    lengths = np.linalg.norm(vectors, axis=1)
    longest = lengths.max(initial=0.0)
    if longest == 0.0:
        return None
    chosen = _thin_out(positions, max(int(arrows.count), 1))
    chosen = chosen[lengths[chosen] > 0.02 * longest]  # shorter ones would be dots
    if chosen.size == 0:
        chosen = np.array([int(np.argmax(lengths))])
    way = vectors[chosen] / lengths[chosen][:, None]
    size = np.full(len(chosen), arrows.length) if arrows.uniform else arrows.length * lengths[chosen] / longest
    # Lifted off the surface by the shaft's thickness, so that they are not hidden in it.
    feet = positions[chosen] + 0.012 * normals[chosen]
    return _solid_arrows(feet, way, normals[chosen], size, arrows.length, parse_color(arrows.color))


def _thin_out(points: NDArray[np.float64], count: int) -> NDArray[np.intp]:
    """Return the indices of about ``count`` points spread evenly.

    There is one for each occupied cell of a grid of suitable width.
    """
    base = 100_003  # a prime above the number of cells along an axis, which are 4000 at most
    if len(points) <= count:
        return np.arange(len(points))

    def occupied(width: float) -> NDArray[np.intp]:
        cells = np.floor((points + 2.0) / width).astype(np.int64)
        keys = (cells[:, 0] * base + cells[:, 1]) * base + cells[:, 2]
        # Of the points in a cell the one nearest its middle, so that neighbours keep their distance.
        offset = np.abs((points + 2.0) / width - cells - 0.5).max(axis=1)
        order = np.lexsort((offset, keys))
        first = np.ones(len(order), dtype=bool)
        first[1:] = keys[order][1:] != keys[order][:-1]
        return order[first]

    narrow, wide = CELLS
    for _ in range(BISECTIONS):
        middle = np.sqrt(narrow * wide)
        narrow, wide = (middle, wide) if len(occupied(middle)) > count else (narrow, middle)
    return np.sort(occupied(wide))


def _solid_arrows(
    feet: NDArray[np.float64],
    way: NDArray[np.float64],
    normal: NDArray[np.float64],
    size: NDArray[np.float64],
    longest: float,
    color: NDArray[np.float64],
) -> Part:
    """Return a round shaft and a cone for every arrow, by broadcasting one template."""
    sides = 8  # of an arrow's shaft and head: at the size of an arrow, corners are invisible
    across = 1e-6  # sine: an arrow that stands on the surface at right angles to within this takes another side
    side = np.cross(normal, way)
    weak = np.linalg.norm(side, axis=1) < across
    side[weak] = np.cross(way[weak], np.eye(3)[np.argmin(np.abs(way[weak]), axis=1)])
    side /= np.linalg.norm(side, axis=1)[:, None]
    over = np.cross(way, side)
    # Thickness grows with the square root of the length: short arrows stay visible, long ones slim.
    thick = 0.045 * longest * np.sqrt(size / longest)
    head = np.minimum(0.45 * size, 5.5 * thick)
    angle = 2.0 * np.pi * np.arange(sides) / sides
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * over[:, None]  # [N, S, 3]
    base, neck, tip = feet, feet + (size - head)[:, None] * way, feet + size[:, None] * way
    slim, broad = thick[:, None, None] * ring, 2.4 * thick[:, None, None] * ring
    slope = (2.4 * thick / head)[:, None, None]
    cone_normal = (ring + slope * way[:, None]) / np.sqrt(1.0 + slope**2)
    back = np.broadcast_to(-way[:, None], ring.shape)
    rows = [
        (base[:, None] + slim, ring),  # shaft
        (neck[:, None] + slim, ring),
        (neck[:, None] + broad, cone_normal),  # cone
        (np.broadcast_to(tip[:, None], ring.shape), cone_normal),
        (neck[:, None] + broad, back),  # the cone's underside
        (np.broadcast_to(neck[:, None], ring.shape), back),
        (base[:, None] + slim, back),  # the shaft's end
        (np.broadcast_to(base[:, None], ring.shape), back),
    ]
    positions = np.stack([place for place, _ in rows], axis=1).reshape(-1, 3)
    normals = np.stack([facing for _, facing in rows], axis=1).reshape(-1, 3)
    k = np.arange(sides)
    after = (k + 1) % sides
    template = []
    for lower, upper in ((0, 1), (2, 3), (5, 4), (7, 6)):
        low, high = lower * sides, upper * sides
        template.append(np.column_stack([low + k, low + after, high + after]))
        template.append(np.column_stack([low + k, high + after, high + k]))
    stencil = np.concatenate(template)
    faces = (stencil[None] + (len(rows) * sides) * np.arange(len(feet))[:, None, None]).reshape(-1, 3)
    return Part(
        positions=positions.astype(np.float32),
        normals=normals.astype(np.float32),
        faces=faces.astype(np.int32),
        kind="color",
        value=np.broadcast_to(color, positions.shape).astype(np.float32),
    )
