"""Möbius centring moves the mean to the centre by a Möbius transformation, and undoes any other one."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import apart, random_rotation

from omtwarp.conformal import centre_points
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import blob, fibonacci_sphere


def mobius(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """A complex 2 x 2 matrix acting on the sphere by w -> (a w + b) / (c w + d), in homogeneous coordinates."""
    x, y, z = points.T
    north = z > 0.0  # the pair that does not vanish
    first = np.where(north, 1.0 + z, x + 1.0j * y)
    second = np.where(north, x - 1.0j * y, 1.0 - z)
    p, q = matrix @ np.stack([first, second])
    size = np.abs(p) ** 2 + np.abs(q) ** 2
    w = 2.0 * p * q.conj() / size
    return np.stack([w.real, w.imag, (np.abs(p) ** 2 - np.abs(q) ** 2) / size], axis=1)


def cross_ratios(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """|p - q| |r - s| / (|p - r| |q - s|) of random fours, which Möbius transformations of the sphere keep."""
    rng = np.random.default_rng(seed)
    p, q, r, s = (points[k] for k in np.array([rng.permutation(len(points))[:4] for _ in range(200)]).T)
    length = np.linalg.norm
    return length(p - q, axis=1) * length(r - s, axis=1) / (length(p - r, axis=1) * length(q - s, axis=1))


POINTS = fibonacci_sphere(600).vertices
MASSES = blob(seed=4, amplitude=0.4, sphere=fibonacci_sphere(600)).vertex_areas


def test_the_independent_transformation_is_one():
    np.testing.assert_allclose(mobius(POINTS, np.eye(2)), POINTS, atol=1e-15)
    np.testing.assert_allclose(
        cross_ratios(mobius(POINTS, np.array([[2.0, 1.0j], [0.3, 1.0]]))), cross_ratios(POINTS), rtol=1e-12
    )


def test_reaches_the_centre_by_a_mobius_transformation():
    centred, steps = centre_points(POINTS, MASSES)
    assert np.linalg.norm(MASSES @ centred) / MASSES.sum() <= 1e-13
    assert 0 < steps < 20
    np.testing.assert_allclose(cross_ratios(centred), cross_ratios(POINTS), rtol=1e-11)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), size=st.floats(0.0, 4.0))
def test_undoes_any_mobius_transformation_up_to_a_rotation(seed, size):
    """The centred image is unique (Baden, Crane and Kazhdan 2018, section 3), wherever one starts.

    ``size`` is the hyperbolic distance by which the transformation moves the ball's centre: at 4 it shrinks areas by
    exp(8) = 3000.
    """
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(2, 2)) + 1.0j * rng.normal(size=(2, 2)))
    matrix = turn @ np.diag([np.exp(size / 2), np.exp(-size / 2)]) @ turn.conj().T
    centred, _ = centre_points(POINTS, MASSES)
    again, _ = centre_points(mobius(POINTS, matrix), MASSES)
    assert np.linalg.norm(MASSES @ again) / MASSES.sum() <= 1e-12
    # Coordinates rounded to 1e-16 where areas are shrunk by exp(2 size) come back magnified by exp(size).
    assert apart(again, centred).max() < 1e-12 * np.exp(size)


def test_a_centred_map_is_left_alone():
    centred, _ = centre_points(POINTS, MASSES)
    again, steps = centre_points(centred, MASSES)
    assert steps <= 1
    np.testing.assert_allclose(again, centred, atol=1e-12)


def test_a_rotation_passes_through():
    rotation = random_rotation(7)
    one, _ = centre_points(POINTS, MASSES)
    other, _ = centre_points(POINTS @ rotation.T, MASSES)
    np.testing.assert_allclose(other, one @ rotation.T, atol=1e-12)


def test_the_unit_of_mass_does_not_matter():
    one, _ = centre_points(POINTS, MASSES)
    other, _ = centre_points(POINTS, 1e20 * MASSES)
    np.testing.assert_allclose(other, one, atol=1e-13)


def test_half_of_the_mass_in_a_point_cannot_be_centred():
    masses = MASSES.copy()
    masses[17] = 3.0 * masses.sum()
    with pytest.raises(OmtwarpError, match="Möbius centring"):
        centre_points(POINTS, masses)
