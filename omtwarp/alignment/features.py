"""Features of shapes as functions on the sphere, expanded in spherical harmonics."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.harmonics import real_harmonics
from omtwarp.mesh.arrays import in_range, real_numbers
from omtwarp.resampling import SpherePoints
from omtwarp.spheres import triangle_solid_angles

Floats = NDArray[np.float64]


# Of the largest value: a feature that varies less is rounding around a constant (1e-16 times the root of the vertices).
LEAST_VARIATION = 1e-9


def sphere_weights(points: SpherePoints) -> Floats:
    """Return a third of the spherical triangles' areas around every vertex, shape [V].

    The sum is 4π, less what fills holes: values there are not the surface's, and count for nothing.
    """
    faces = points.grid.own_triangles
    angles = triangle_solid_angles(*(points.grid.points[faces[:, k]] for k in range(3)))
    return np.bincount(faces.ravel(), np.repeat(angles / 3.0, 3), minlength=len(points.grid.points)).astype(np.float64)


def own_features(points: SpherePoints) -> dict[str, Floats]:
    """Return the default features: distance from the centre, and area on the surface over area on the sphere.

    Neither depends on rotation or scale. Areas are left out where the map preserves them.

    Raises:
        OmtwarpError: the sphere is given without its surface.
    """
    # Standard deviation of the logarithm of area below which areas carry no information, as in area-preserving maps.
    least_area_spread = 0.1
    # Of the whole: the least share of a vertex's area that has a logarithm; a vertex of no area takes it in place of
    # infinity.
    smallest_share = 1e-12
    if points.vertices is None:
        raise OmtwarpError(
            f"{points.grid.name}: a sphere without its surface has no features of its own: give the surface, or data"
        )
    masses = points.surface_areas()
    centre = masses @ points.vertices / masses.sum()
    features = {"radius": np.linalg.norm(points.vertices - centre, axis=1)}
    weights = sphere_weights(points)
    ratio = np.log(
        np.maximum(masses / masses.sum(), smallest_share) / np.maximum(weights / weights.sum(), smallest_share)
    )
    if spread(ratio, weights) > least_area_spread:
        features["areas"] = ratio
    return features


def checked_features(given: Mapping[str, ArrayLike], points: SpherePoints, whose: str) -> dict[str, Floats]:
    """Return the features as float64 arrays of one number per vertex, 0 in what fills holes.

    Where a feature has no number, NaN, it has its mean over the sphere, which counts for nothing.

    Raises:
        OmtwarpError: a feature has another length, infinite numbers, or none at all.
    """
    count = points.grid.own_points
    filling = np.zeros(len(points.grid.points) - count)
    out = {}
    for name, values in given.items():
        own = points.at_own_points(np.asarray(values))
        array: Floats = real_numbers(own, f"feature '{name}' of {whose}", (count,), finite=False)
        without = np.isnan(array)
        if np.isinf(array).any() or without.all():
            raise OmtwarpError(f"feature '{name}' of {whose} has infinite numbers, or none at all")
        if without.any():
            weights = sphere_weights(points)[:count] * ~without
            array = np.where(without, weights @ np.where(without, 0.0, array) / weights.sum(), array)
        out[name] = np.concatenate([in_range(array), filling])
    return out


def spread(values: Floats, weights: Floats) -> float:
    """Return the standard deviation of a feature over the sphere."""
    mean = weights @ values / weights.sum()
    return float(np.sqrt(max(weights @ (values - mean) ** 2 / weights.sum(), 0.0)))


def is_constant(values: Floats, weights: Floats, least: float = LEAST_VARIATION) -> bool:
    """Return whether a feature is the same all over the sphere.

    Args:
        values: shape [V].
        weights: of the vertices, shape [V].
        least: variation, as a part of the largest value, up to which it is.
    """
    return not spread(values, weights) > least * np.abs(values).max()


def varying_features(points: SpherePoints) -> dict[str, Floats]:
    """Return the default features that are not constant, as those of a ball are."""
    weights = sphere_weights(points)
    # Up to this variation they are constant; positions come from files: six digits and single precision vary by 1e-6.
    return {k: values for k, values in own_features(points).items() if not is_constant(values, weights, 1e-5)}


def feature_coefficients(features: Mapping[str, Floats], points: SpherePoints, degree: int) -> Floats:
    """Return the real coefficients of features of mean 0 and standard deviation 1, shape [(L + 1)², K].

    By quadrature with the vertices' areas on the sphere, which turns with the sphere: no position is preferred.
    """
    at_once = 16384
    weights = sphere_weights(points)
    columns = []
    for name, values in features.items():
        if is_constant(values, weights):
            raise OmtwarpError(f"feature '{name}' is constant and determines no rotation: leave it out")
        columns.append(weights * (values - weights @ values / weights.sum()) / spread(values, weights))
    weighted = np.stack(columns, axis=1)
    total = np.zeros(((degree + 1) ** 2, len(columns)))
    for first in range(0, len(weighted), at_once):
        part = slice(first, first + at_once)
        total += real_harmonics(points.grid.points[part], degree).T @ weighted[part]
    return total


def coefficient_errors(features: Mapping[str, Floats], points: SpherePoints) -> Floats:
    """Estimate the noise of each feature's coefficients from the differences between neighbours, shape [K].

    Noise that is independent between vertices enters a coefficient with the vertex's area on the sphere.
    """
    weights = sphere_weights(points)
    faces = points.grid.own_triangles
    count = len(points.grid.points)
    around = np.bincount(faces.ravel(), minlength=count) * 2.0
    errors = []
    for values in features.values():
        others = values[faces[:, [1, 2, 0]]] + values[faces[:, [2, 0, 1]]]
        apart = values - np.bincount(faces.ravel(), others.ravel(), minlength=count) / np.maximum(around, 1.0)
        errors.append(np.linalg.norm(weights * apart) / spread(values, weights))
    return np.array(errors)
