"""Exact orientation of spherical triangles: what floating point cannot decide is decided in integers.

A map is flip-free where det[a, b, c] > 0 for every spherical triangle. The determinant of three float64 points is a
rational number with a definite sign; a forward error bound (Shewchuk, "Adaptive precision floating-point arithmetic and
fast robust geometric predicates", 1997) certifies the sign of all but the smallest, and Python's integers settle those.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Six triple products, each rounded at most four times, and their sum: 7 units of roundoff would do; 8 leaves the
# rounding of the bound itself room.
_RELATIVE_BOUND = 8.0 * 2.0**-53
# Products below this may have lost bits to gradual underflow, which a relative bound does not see.
_UNDERFLOW_BOUND = 2.0**-1000


def orientation_signs(sphere: ArrayLike, faces: ArrayLike) -> NDArray[np.int8]:
    """Exact sign of det[a, b, c] for every triangle.

    The coordinates are taken as they are, so the points need not have unit length.

    Args:
        sphere: float64 points, shape [V, 3].
        faces: Integer corner indices, shape [F, 3].

    Returns:
        int8, shape [F]: 1 counter-clockwise seen from outside, -1 flipped, 0 exactly degenerate (the plane of the three
        points contains the origin) or a corner that is not finite.
    """
    points = np.ascontiguousarray(sphere, dtype=np.float64)
    corners = np.asarray(faces).reshape(-1, 3)
    a, b, c = (points[corners[:, k]] for k in range(3))
    with np.errstate(all="ignore"):
        minors = [(b[:, i] * c[:, j], b[:, j] * c[:, i]) for i, j in ((1, 2), (2, 0), (0, 1))]
        value = sum(a[:, k] * (plus - minus) for k, (plus, minus) in enumerate(minors))
        magnitude = sum(np.abs(a[:, k]) * (np.abs(plus) + np.abs(minus)) for k, (plus, minus) in enumerate(minors))
        decided = np.abs(value) > _RELATIVE_BOUND * magnitude + _UNDERFLOW_BOUND
    finite = np.isfinite(value)
    signs = np.where(decided & finite, np.sign(value), 0.0).astype(np.int8)
    open_cases = np.flatnonzero(~(decided & finite))
    if len(open_cases):
        usable = np.isfinite(np.hstack([a[open_cases], b[open_cases], c[open_cases]])).all(axis=1)
        open_cases = open_cases[usable]
        signs[open_cases] = _exact_signs(a[open_cases], b[open_cases], c[open_cases])
    return signs


def count_flips(sphere: ArrayLike, faces: ArrayLike) -> int:
    """Number of triangles with det[a, b, c] <= 0, decided exactly; one with a corner that is not finite counts."""
    return int((orientation_signs(sphere, faces) <= 0).sum())


def _exact_signs(a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]) -> NDArray[np.int8]:
    """Signs of the determinants of finite points, shape [n, 3] each, in integer arithmetic."""
    if len(a) == 0:
        return np.zeros(0, dtype=np.int8)
    ia, ib, ic = (_common_integers(x) for x in (a, b, c))
    value = (
        ia[:, 0] * (ib[:, 1] * ic[:, 2] - ib[:, 2] * ic[:, 1])
        + ia[:, 1] * (ib[:, 2] * ic[:, 0] - ib[:, 0] * ic[:, 2])
        + ia[:, 2] * (ib[:, 0] * ic[:, 1] - ib[:, 1] * ic[:, 0])
    )
    return (value > 0).astype(np.int8) - (value < 0).astype(np.int8)


def _common_integers(points: NDArray[np.float64]) -> NDArray[np.object_]:
    """Every point times a power of two of its own that makes its coordinates integers, as Python integers."""
    mantissa, exponent = np.frexp(points)
    exponent = np.where(points == 0.0, exponent.max(initial=0), exponent)
    shift = exponent - exponent.min(axis=1, keepdims=True)
    integers = np.ldexp(mantissa, 53).astype(np.int64).astype(object)
    return integers << shift.astype(object)
