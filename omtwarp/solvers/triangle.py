"""One triangle of a map from a surface to the sphere: its frame on the surface, and its Jacobian as Warp functions.

A triangle of the surface laid flat has its first edge (l, 0) and its second (x, h). With e1, e2 the same edges of the
image, the columns of the Jacobian are c1 = e1 / l and c2 = (e2 - (x / l) e1) / h: linear in the image, and a sum of
squares when squared, so that slivers lose no digits to cancelling cotangents. The three numbers 1/l, -x/(l h), 1/h are
the triangle's frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ZERO, wp
from omtwarp.geometry.spherical import first_tangent
from omtwarp.mesh.arrays import Floats, norms
from omtwarp.mesh.surface import Surface

wp.set_module_options(KERNEL_OPTIONS)

EQUILATERAL_HEIGHT = np.sqrt(3.0) / 2.0  # over an edge
# λ, of area against angle distortion wherever both are minimised: more trades shapes for the areas of triangles, and
# beyond it these lock a mesh. Embeddings and repairs end with the same areas to 0.003 with 5; on a scan of 20,000
# triangles the metric jumps from one triangle to the next by 0.054 with 2 and 10, 0.060 with 30 and 0.071 with 100.
AREA_WEIGHT = 10.0


def triangle_frames(surface: Surface, thinnest: float = 0.0, triangles: NDArray[np.integer] | None = None) -> Floats:
    """Return the frames (1/l, -x/(l h), 1/h) of the scaled triangles, see :mod:`.triangle`.

    Args:
        surface: the surface; its area is taken as 4π. With another measure than area, every triangle is scaled to the
            area that it is to have.
        thinnest: triangles thinner than this, as height over length, are made this thick, so that their shape can be
            reached; 0 keeps every triangle as it is.
        triangles: indices of the triangles, shape [T]; all of the surface by default.

    Returns:
        float64, shape [T, 3].
    """
    chosen = slice(None) if triangles is None else triangles
    corner = surface.scaled_vertices.take(surface.faces[chosen], axis=0)
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    base = norms(first)
    base = np.maximum(base, np.finfo(float).tiny ** 0.25)
    unit = first / base[:, None]
    foot = np.einsum("ij,ij->i", second, unit)
    height = norms(second - foot[:, None] * unit)
    longest = np.maximum(base, norms(second))
    height = np.maximum(height, 1e-14 * longest)  # so that its inverse is finite
    if thinnest > 0.0:
        base, foot, height = _thickened(base, foot, height, thinnest)
    frames = np.stack([1.0 / base, -foot / (base * height), 1.0 / height], axis=1)
    if surface.weighted:  # frames are lengths inverted
        frames *= np.sqrt(surface.own_areas[chosen] / surface.face_areas[chosen])[:, None]
    return frames


def _thickened(base: Floats, foot: Floats, height: Floats, thinnest: float) -> tuple[Floats, Floats, Floats]:
    """Widen thin triangles across their length, whichever corner comes first.

    A triangle is the image of an equilateral one under a linear map; of its singular values the smaller one is raised.
    The result does not depend on the order of the corners, and is continuous in the triangle.

    Args:
        base, foot, height: the first edge, and place and height of the third corner over it, shape [T].
        thinnest: the least height over length.

    Returns:
        Base, foot and height of the widened triangles.
    """
    across, up = (foot - 0.5 * base) / EQUILATERAL_HEIGHT, height / EQUILATERAL_HEIGHT
    determinant, square = base * up, base**2 + across**2 + up**2
    larger = np.sqrt(0.5 * (square + np.sqrt(np.maximum(square**2 - 4.0 * determinant**2, 0.0))))
    smaller = determinant / larger
    wanted = np.maximum(smaller, thinnest / EQUILATERAL_HEIGHT * larger)
    angle = 0.5 * np.arctan2(2.0 * base * across, base**2 - across**2 - up**2)
    cosine, sine = np.cos(angle), np.sin(angle)
    left_x, left_y = (base * cosine + across * sine) / larger, up * sine / larger
    more = wanted - smaller
    first = np.stack([base + more * left_y * sine, -more * left_x * sine], axis=1)
    third = np.stack([across - more * left_y * cosine, up + more * left_x * cosine], axis=1)
    second = 0.5 * first + EQUILATERAL_HEIGHT * third
    length = norms(first)
    wide = wanted > smaller
    return (
        np.where(wide, length, base),
        np.where(wide, np.einsum("ij,ij->i", first, second) / length, foot),
        np.where(wide, EQUILATERAL_HEIGHT * larger * wanted / length, height),
    )


@wp.func
def columns(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the two columns of the Jacobian."""
    return frame[0] * (b - a), frame[1] * (b - a) + frame[2] * (c - a)


@wp.func
def column_weights(frame: wp.vec3d):
    """Return the derivatives of the two columns by the three corners."""
    return wp.vec3d(-frame[0], frame[0], ZERO), wp.vec3d(-frame[1] - frame[2], frame[1], frame[2])


@wp.func
def first_tangents(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.mat33d:
    """Return the first directions of the tangent bases at three points, as rows."""
    return wp.matrix_from_rows(first_tangent(a), first_tangent(b), first_tangent(c))


@wp.func
def tangent_coordinates(y: wp.vec3d, v: wp.vec3d) -> wp.vec2d:
    """Return the coordinates of a vector in the tangent basis of a point."""
    t = first_tangent(y)
    return wp.vec2d(wp.dot(t, v), wp.dot(wp.cross(y, t), v))


@wp.func
def in_tangent(y: wp.vec3d, x0: wp.float64, x1: wp.float64) -> wp.vec3d:
    """Move a point by coordinates in its tangent basis, and project it to the sphere."""
    t = first_tangent(y)
    return wp.normalize(y + x0 * t + x1 * wp.cross(y, t))


@wp.func
def barrier(d: wp.float64, eps: wp.float64) -> wp.float64:
    """Return χ(D, ε) = (D + sqrt(D² + ε²)) / 2 of Garanzha et al. (2021).

    It is positive, and near D where D is well above ε.
    """
    root = wp.sqrt(d * d + eps * eps)
    if d >= ZERO:
        return HALF * (d + root)
    return HALF * eps * eps / (root - d)
