"""Projections between directions on the sphere and pictures of the sphere.

Image coordinates are (u, v) in 0..1 with u growing to the east (to the right) and v growing to the **north** (up), as
texture coordinates do: (0, 0) is the bottom left corner of the picture, and row 0 of the array is v = 1, the north.
Longitude is ``atan2(y, x)`` in (-π, π], latitude is ``asin(z)``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.options import ProjectionName

Floats = NDArray[np.float64]

PROJECTIONS = tuple(ProjectionName)


def check_projection(projection: str) -> str:
    """Check the name of a projection; the error for an unknown one lists those that exist."""
    if projection not in PROJECTIONS:
        raise OmtwarpError(f"unknown projection '{projection}': use {' or '.join(PROJECTIONS)}")
    return projection


def longitude_latitude(directions: ArrayLike) -> tuple[Floats, Floats]:
    """Return longitudes in (-π, π] and latitudes in [-π/2, π/2], in radians, of directions [..., 3] of any length."""
    d = np.asarray(directions, dtype=np.float64)
    # atan2 keeps full accuracy next to the poles, where asin(z) loses half of the digits.
    return np.arctan2(d[..., 1], d[..., 0]), np.arctan2(d[..., 2], np.hypot(d[..., 0], d[..., 1]))


def direction_from_angles(longitude: ArrayLike, latitude: ArrayLike) -> Floats:
    """Return the unit vectors, shape [..., 3], from longitude and latitude in radians."""
    lon, lat = np.broadcast_arrays(np.asarray(longitude, dtype=np.float64), np.asarray(latitude, dtype=np.float64))
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)


def direction_to_image(directions: ArrayLike, projection: str = "equirectangular") -> Floats:
    """Return the image coordinates of directions.

    ``sinusoidal`` is the correction of section 5 of the paper: the longitude is scaled by the cosine of the latitude,
    so that the picture is not stretched sideways next to the poles. It uses the part of the picture between the two
    curves u = (1 ± cos(latitude)) / 2.

    Args:
        directions: vectors of any length, shape [..., 3].
        projection: ``equirectangular`` or ``sinusoidal``.

    Returns:
        (u, v) in 0..1, float64, shape [..., 2]; v points up.
    """
    check_projection(projection)
    lon, lat = longitude_latitude(directions)
    if projection == "sinusoidal":
        lon = lon * np.cos(lat)
    return np.stack([0.5 + lon / (2.0 * np.pi), 0.5 + lat / np.pi], axis=-1)


def rotation_matrix(rotate: ArrayLike | None) -> Floats:
    """Convert a rotation from any accepted form to a matrix, shape [3, 3].

    Args:
        rotate: None (no rotation), a 3x3 rotation matrix, one number (yaw), or yaw, pitch and roll in **degrees**.
            Yaw turns about z (the poles' axis, to the east), then pitch about the new y (positive: down), then roll
            about the new x.

    Raises:
        OmtwarpError: the argument has none of these forms, or the matrix is no rotation.
    """
    if rotate is None:
        return np.eye(3)
    try:
        given = np.asarray(rotate, dtype=np.float64)
    except (TypeError, ValueError):
        given = np.empty(0)
    if given.shape == (3, 3):
        # Orthonormal, of a rotation's entries: matrices written with seven digits pass
        if not np.allclose(given @ given.T, np.eye(3), atol=1e-6) or np.linalg.det(given) < 0:
            raise OmtwarpError(
                "rotate: the 3x3 matrix is not a rotation: its rows must be orthonormal, its determinant 1"
            )
        u, _, vt = np.linalg.svd(given)  # the nearest exact rotation: the 1e-6 above must not reach the texture
        return u @ vt
    angles = np.atleast_1d(given)
    if angles.shape not in ((1,), (3,)) or not np.all(np.isfinite(angles)):
        raise OmtwarpError("rotate: give yaw, or yaw, pitch and roll in degrees, or a 3x3 rotation matrix")
    yaw, pitch, roll = np.deg2rad(np.concatenate([angles, np.zeros(3 - len(angles))]))
    return _turn(2, yaw) @ _turn(1, pitch) @ _turn(0, roll)


def _turn(axis: int, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = c
    matrix[a, b], matrix[b, a] = -s, s
    return matrix
