"""Turns of maps against the optimal one: none in optimal maps, those of twists known, and steps that take them out."""

import numpy as np
import pytest
from sphere_truths import at_height, height_and_longitude, pushed_north, random_rotation, turned, twisted

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.flips.predicates import count_flips
from omtwarp.mesh.shapes import icosphere
from omtwarp.metrics.optimality import relative_curl
from omtwarp.transport.twist import Turns, turned_back, turns


def turns_of(surface, y, x, device) -> Turns:
    where = resolve_device(device)
    return turns(surface, vectors(y, where), vectors(x, where))


def moved_along_gradient(x: np.ndarray) -> np.ndarray:
    """exp(∇ψ) of a small ψ(x) = x · Q x / 2 without symmetry: the optimal map of the masses that it makes."""
    axes = random_rotation(5)
    matrix = 0.25 * axes @ np.diag([1.0, -0.4, -0.6]) @ axes.T
    gradient = x @ matrix
    gradient -= (gradient * x).sum(axis=1, keepdims=True) * x
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.cos(length) * x + np.sinc(length / np.pi) * gradient


def shrunken(points: np.ndarray, factor: float) -> np.ndarray:
    """The conformal map that shrinks the north by a factor: stereographic coordinates from the south divided by it."""
    z, longitude = height_and_longitude(points)
    tangent = np.sqrt((1.0 - z) / (1.0 + z)) / factor
    return at_height((1.0 - tangent**2) / (1.0 + tangent**2), longitude)


@pytest.mark.parametrize("move", [moved_along_gradient, lambda x: pushed_north(x, 0.6)])
def test_optimal_maps_turn_nothing(move, device):
    """Up to the error of the mesh: the derivative of a linear interpolant is off by the length of the edges."""
    rms = []
    for size in (8, 16, 32):
        surface = turned(icosphere(size))
        rms.append(turns_of(surface, move(surface.vertices), surface.vertices, device).rms)
    assert rms[-1] < 1e-3
    assert rms[0] > 1.8 * rms[1] > 3.24 * rms[2]


@pytest.mark.parametrize("angle", [0.4, -0.7])
def test_turns_are_counter_clockwise_and_do_not_depend_on_size(angle, device):
    surface = turned(icosphere(16))
    y = surface.vertices
    cosine, sine = np.cos(angle), np.sin(angle)
    rotated = y @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    near = (y[surface.faces, 2] > 0.95).all(axis=1)
    assert near.sum() > 50
    for factor in (1.0, 10.0, 1e4):
        angles = turns_of(surface, rotated, shrunken(y, factor), device).angles.numpy()
        assert abs(np.median(angles[near]) - angle) < 0.02


def test_triangles_flipped_at_the_start_count_as_not_turned(device):
    surface = turned(icosphere(4))
    mirrored = surface.vertices * np.array([1.0, 1.0, -1.0])
    assert turns_of(surface, surface.vertices, mirrored, device).rms == 0.0


@pytest.mark.parametrize("power", [1.0, 5.0])
def test_a_limb_is_turned_back_where_the_start_is_shrunken_too(power, device):
    """With the higher power the north is shrunken to a tenth and less, and the curl of the displacements is small."""
    surface = turned(icosphere(24))
    best = surface.vertices
    z, longitude = height_and_longitude(best)
    colatitude = np.arccos(z)
    drawn = np.minimum(colatitude / 1.2, 1.0)
    x = at_height(np.cos(colatitude * drawn ** (power - 1.0)), longitude)
    y = given = at_height(z, longitude + 0.5 * (1.0 - drawn**2) ** 2)
    curl = relative_curl(surface, y, start=x, device=device)
    assert (curl < 0.2) == (power > 1.0)
    found = [turns_of(surface, y, x, device)]
    for _ in range(4):
        y = turned_back(surface, vectors(y, resolve_device(device)), found[-1])
        assert np.allclose(np.linalg.norm(y, axis=1), 1.0, atol=1e-12)
        assert count_flips(y, surface.faces) == 0
        found.append(turns_of(surface, y, x, device))
    of_mesh = turns_of(surface, best, x, device).rms  # the error of the mesh: the optimal map turns nothing
    away = [np.sqrt(((sphere - best) ** 2).sum(axis=1).mean()) for sphere in (given, y)]
    assert found[-1].rms < max(1.1 * of_mesh, 0.02 * found[0].rms)
    assert away[1] < 0.2 * away[0]


def test_turning_back_gives_the_same_bits_twice(device):
    surface = turned(icosphere(8))
    x, y = surface.vertices, twisted(surface.vertices, 0.3)
    first, second = (
        turned_back(surface, vectors(y, resolve_device(device)), turns_of(surface, y, x, device)) for _ in range(2)
    )
    np.testing.assert_array_equal(first, second)
