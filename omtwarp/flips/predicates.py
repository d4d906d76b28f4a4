"""Exact orientation of spherical triangles, in integers where floating point cannot decide.

A map is flip-free where det[a, b, c] > 0 for every spherical triangle. The determinant of three float64 points is a
rational number with a definite sign; a forward error bound (Shewchuk, "Adaptive precision floating-point arithmetic and
fast robust geometric predicates", 1997) certifies the sign of all but the smallest, which Python's integers decide.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import triangles, vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, ZERO, wp
from omtwarp.device.threads import Arguments, cut, launch_parts
from omtwarp.mesh.arrays import Floats

wp.set_module_options(KERNEL_OPTIONS)

UNCERTAIN = wp.constant(2)  # instead of a sign


@wp.kernel
def certain_signs(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    relative: wp.float64,
    underflow: wp.float64,
    # Data out:
    signs: wp.array[wp.int8],
):
    """Compute the signs of det[a, b, c] that rounding cannot have changed, and UNCERTAIN for the others."""
    f = wp.tid()
    a, b, c = points[faces[f][0]], points[faces[f][1]], points[faces[f][2]]
    value = wp.dot(a, wp.cross(b, c))
    magnitude = wp.abs(a[0]) * (wp.abs(b[1] * c[2]) + wp.abs(b[2] * c[1]))
    magnitude += wp.abs(a[1]) * (wp.abs(b[2] * c[0]) + wp.abs(b[0] * c[2]))
    magnitude += wp.abs(a[2]) * (wp.abs(b[0] * c[1]) + wp.abs(b[1] * c[0]))
    signs[f] = wp.int8(UNCERTAIN)
    if wp.isfinite(value) and wp.abs(value) > relative * magnitude + underflow:
        signs[f] = wp.where(value > ZERO, wp.int8(1), wp.int8(-1))


def orientation_signs(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> NDArray[np.int8]:
    """Return the exact sign of det[a, b, c] for every triangle.

    The coordinates are taken as they are, so the points need not have unit length.

    Args:
        sphere: float64 points, shape [V, 3]; or a Warp array of vec3d.
        faces: Integer corner indices, shape [F, 3]; or a Warp array of vec3i.
        device: where floating point is tried.

    Returns:
        int8, shape [F]: 1 counter-clockwise seen from outside, -1 flipped, 0 exactly degenerate (the plane of the three
        points contains the origin) or a corner that is not finite.
    """
    where = resolve_device(device)
    given = vectors(sphere, where)
    corners = triangles(faces if isinstance(faces, wp.array) else np.asarray(faces).reshape(-1, 3), where)
    out = wp.empty(len(corners), dtype=wp.int8, device=where)

    def arguments(part: slice) -> Arguments:
        # Six triple products, each rounded at most four times, and their sum: 7 units of roundoff suffice, 8 also cover
        # the rounding of the bound. Fused multiply-add only lowers the error.
        # Products below this may have lost bits to gradual underflow, which a relative bound does not see.
        return [given, cut(corners, part), wp.float64(8.0 * 2.0**-53), wp.float64(2.0**-1000)], [cut(out, part)]

    launch_parts(certain_signs, len(corners), arguments, where)
    signs = out.numpy()
    open_cases = np.flatnonzero(signs == UNCERTAIN)
    if len(open_cases):
        signs[open_cases] = 0
        points, places = given.numpy(), corners.numpy()[open_cases]
        a, b, c = (points[places[:, k]] for k in range(3))
        usable = np.isfinite(np.hstack([a, b, c])).all(axis=1)
        signs[open_cases[usable]] = exact_signs(a[usable], b[usable], c[usable])
    return signs


def flipped_faces(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> NDArray[np.bool_]:
    """Find triangles with det[a, b, c] <= 0, decided exactly, or with a corner that is not finite; bool, shape [F]."""
    flipped: NDArray[np.bool_] = orientation_signs(sphere, faces, device=device) <= 0
    return flipped


def count_flips(
    sphere: ArrayLike | wp.array, faces: ArrayLike | wp.array, *, device: str | wp.Device | None = "cpu"
) -> int:
    """Return the number of triangles with det[a, b, c] <= 0, decided exactly.

    A triangle with a corner that is not finite counts.
    """
    return int(flipped_faces(sphere, faces, device=device).sum())


def exact_signs(a: Floats, b: Floats, c: Floats) -> NDArray[np.int8]:
    """Return the signs of the determinants of finite points, shape [n, 3] each, in integer arithmetic."""
    if len(a) == 0:
        return np.zeros(0, dtype=np.int8)
    ia, ib, ic = (_common_integers(x) for x in (a, b, c))
    value = (
        ia[:, 0] * (ib[:, 1] * ic[:, 2] - ib[:, 2] * ic[:, 1])
        + ia[:, 1] * (ib[:, 2] * ic[:, 0] - ib[:, 0] * ic[:, 2])
        + ia[:, 2] * (ib[:, 0] * ic[:, 1] - ib[:, 1] * ic[:, 0])
    )
    return (value > 0).astype(np.int8) - (value < 0).astype(np.int8)


def _common_integers(points: Floats) -> NDArray[np.object_]:
    """Scale every point by its own power of two to integer coordinates, as Python integers."""
    mantissa, exponent = np.frexp(points)
    exponent = np.where(points == 0.0, exponent.max(initial=0), exponent)
    shift = exponent - exponent.min(axis=1, keepdims=True)
    integers = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    return integers << shift.astype(object)
