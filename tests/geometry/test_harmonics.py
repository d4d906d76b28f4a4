"""Real spherical harmonics against closed forms, their integrals, and an independent library."""

import numpy as np
import pytest
from scipy.special import roots_legendre, sph_harm_y
from sphere_truths import random_rotation

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.harmonics import degree_of, degrees, power_per_degree, real_harmonics


def directions(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def gauss_grid(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights that integrate products of two harmonics of at most this degree exactly."""
    heights, weights = roots_legendre(degree + 1)
    longitudes = np.arange(2 * degree + 2) * np.pi / (degree + 1)
    z, longitude = (a.ravel() for a in np.meshgrid(heights, longitudes, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    points = np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], axis=1)
    return points, np.repeat(weights, len(longitudes)) * np.pi / (degree + 1)


def test_low_degrees_in_closed_form():
    points = 3.0 * directions(50)  # of any length
    x, y, z = points.T / 3.0
    first, second = np.sqrt(3 / (4 * np.pi)), np.sqrt(15 / (4 * np.pi))
    wanted = [
        np.full(50, 1 / np.sqrt(4 * np.pi)),
        *(first * y, first * z, first * x),
        second * x * y,
        second * y * z,
        np.sqrt(5 / (16 * np.pi)) * (3 * z * z - 1),
        second * x * z,
        second / 2 * (x * x - y * y),
    ]
    np.testing.assert_allclose(real_harmonics(points, 2), np.stack(wanted, axis=1), atol=1e-14)


def test_they_are_orthonormal():
    points, weights = gauss_grid(12)
    values = real_harmonics(points, 12)
    np.testing.assert_allclose(values.T @ (weights[:, None] * values), np.eye(169), atol=1e-12)


@pytest.mark.parametrize("degree", [5, 20, 100])
def test_they_agree_with_scipys_complex_ones(degree):
    points = directions(40, degree)
    polar, longitude = np.arccos(points[:, 2]), np.arctan2(points[:, 1], points[:, 0])
    values = real_harmonics(points, degree)
    for order in range(-degree, degree + 1, max(1, degree // 7)):
        known = sph_harm_y(degree, abs(order), polar, longitude) * (-1.0) ** order
        known = known.real if order >= 0 else known.imag
        known = known * (np.sqrt(2) if order else 1)
        np.testing.assert_allclose(values[:, degree * degree + degree + order], known, atol=1e-9)


def test_they_agree_with_pyshtools():
    pyshtools = pytest.importorskip("pyshtools")
    points = directions(20, 1)
    polar, longitude = np.degrees(np.arccos(points[:, 2])), np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    values = real_harmonics(points, 30)
    for k in range(len(points)):
        known = pyshtools.expand.spharm(30, polar[k], longitude[k], normalization="ortho", kind="real", csphase=1)
        for n in range(31):
            row = np.concatenate([known[1, n, 1 : n + 1][::-1], known[0, n, : n + 1]])
            np.testing.assert_allclose(values[k, n * n : (n + 1) ** 2], row, atol=1e-10)


def test_the_poles_and_high_degrees_are_finite_and_sum_up():
    """Σ_m Y_lm² = (2l + 1) / 4π at every point (Unsöld's theorem)."""
    points = np.array([[0.0, 0, 1], [0, 0, -1], [1e-9, 0, 1], [1, 0, 0]])
    values = real_harmonics(points, 300)
    sums = np.stack([(values[:, n * n : (n + 1) ** 2] ** 2).sum(axis=1) for n in range(301)], axis=1)
    np.testing.assert_allclose(sums, np.tile((2 * np.arange(301) + 1) / (4 * np.pi), (4, 1)), rtol=1e-10)


def test_power_does_not_change_under_rotation():
    """A degree's harmonics span a space that rotations keep."""
    points, weights = gauss_grid(8)
    turned = points @ random_rotation(5).T
    values = np.exp(points @ [0.3, -0.5, 0.2])
    powers = [power_per_degree(real_harmonics(p, 8).T @ (weights * values)) for p in (points, turned)]
    np.testing.assert_allclose(powers[0], powers[1], rtol=1e-6)
    both = np.stack([values, 2 * values], axis=1)
    np.testing.assert_allclose(power_per_degree(real_harmonics(points, 8).T @ (weights[:, None] * both)), 5 * powers[0])


def test_where_coefficients_stand():
    assert degrees(2).tolist() == [0, 1, 1, 1, 2, 2, 2, 2, 2]
    assert degree_of(256) == 15
    with pytest.raises(OmtwarpError, match="10 coefficients"):
        degree_of(10)


@pytest.mark.parametrize("degree", [-1, 1.5, 501, True])
def test_degrees_that_there_are_not(degree):
    with pytest.raises(OmtwarpError, match="degree"):
        real_harmonics([[0.0, 0, 1]], degree)


def test_points_of_another_shape_are_refused():
    with pytest.raises(OmtwarpError, match=r"not \[any, 3\]"):
        real_harmonics([0.0, 0, 1], 2)
