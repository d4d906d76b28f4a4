"""Turns of rings against coverings known in closed form, and maps that are held back."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from sphere_truths import random_rotation, turned

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import count_flips, is_bijective, ring_turns, tangled_faces
from omtwarp.flips.guard import hold_back
from omtwarp.mesh.shapes import icosphere, random_sphere, uv_sphere


def wrapped(surface, times):
    """Multiply longitudes by k: a map without flips whose rings around the poles turn k times."""
    x, y, z = surface.vertices.T
    radius, longitude = np.hypot(x, y), times * np.arctan2(y, x)
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], axis=1)


@pytest.mark.parametrize("times", [1, 2, 3])
def test_branched_coverings_without_flips(device, times):
    """Where longitudes are multiplied by k, no triangle flips, rings of the poles turn k times and all others once."""
    surface = uv_sphere(7, 24)
    sphere = wrapped(surface, times) @ random_rotation(4).T
    assert count_flips(sphere, surface.faces, device=device) == 0
    turns = ring_turns(sphere, surface.faces, device=device)
    poles = np.abs(surface.vertices[:, 2]) > 1.0 - 1e-12
    assert turns[poles].tolist() == [times, times] and (turns[~poles] == 1).all()
    assert is_bijective(sphere, surface.faces, device=device) == (times == 1)
    around = poles[surface.faces].any(axis=1)
    assert np.array_equal(tangled_faces(sphere, surface.faces, device=device), around & (times > 1))


@given(seed=st.integers(0, 10**6), clustering=st.floats(0.0, 30.0))
def test_convex_hulls_turn_once(seed, clustering):
    """Every ring of a convex hull around the centre turns once, however small its triangles are."""
    surface = random_sphere(120, seed, clustering)
    assert is_bijective(surface.vertices, surface.faces)
    assert set(ring_turns(-surface.vertices, surface.faces).tolist()) == {-1}
    assert not is_bijective(-surface.vertices, surface.faces)


@pytest.mark.parametrize("size", [1e-3, 1e-9, 1e-14, 3e-16])
@pytest.mark.parametrize("times", [1, 2])
def test_rings_as_small_as_rounding(device, size, times):
    """A ring of four around a pole, scaled down to a few units in the last place, still turns as often as it does."""
    # Eight exact directions around (0, 0, 1); the points' lengths are not 1, which plays no role.
    around = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]], dtype=float)
    if times == 2:
        around = np.concatenate([around, around])
    count = len(around)
    ring = np.concatenate([size * around, np.ones((count, 1))], axis=1)
    points = np.concatenate([[[0.0, 0.0, 1.0]], ring])
    k = np.arange(count)
    faces = np.stack([np.zeros(count, dtype=int), 1 + k, 1 + (k + 1) % count], axis=1)
    assert ring_turns(points, faces, device=device)[0] == times


def test_exact_counting_agrees_with_angles(monkeypatch):
    """Counts in integers, used for all vertices here, agree with sums of angles, also where triangles are flipped."""
    surface = turned(icosphere(4))
    sphere = wrapped(uv_sphere(5, 16), 2)
    folded = surface.vertices.copy()
    folded[[3, 40, 77]] *= -1.0
    cases = [(surface.vertices, surface.faces), (sphere, uv_sphere(5, 16).faces), (folded, surface.faces)]
    by_angles = [ring_turns(*case) for case in cases]
    monkeypatch.setattr("omtwarp.flips.exact._CERTAIN", -1.0)
    for case, expected in zip(cases, by_angles, strict=True):
        assert np.array_equal(ring_turns(*case), expected)


def test_no_faces_are_refused_and_whole_floats_are_taken():
    surface = icosphere(2)
    for call in (is_bijective, ring_turns, tangled_faces):
        for none in (surface.faces[:0], []):
            with pytest.raises(OmtwarpError, match="the number of faces: must be a whole number from 1"):
                call(surface.vertices, none)
    assert tangled_faces(-surface.vertices, surface.faces.astype(float)).all()


def test_missing_coordinates_are_no_bijection():
    surface = icosphere(3)
    broken = surface.vertices.copy()
    broken[5] = np.nan
    assert not is_bijective(broken, surface.faces)


def test_holding_back_ends_in_a_bijection_near_the_wanted_map():
    """A good map is reached; towards a double covering, noise or NaN the result stays the nearest bijection found."""
    surface = uv_sphere(7, 24)
    start = surface.vertices
    near = start @ random_rotation(1).T * 0.05 + start
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    assert np.abs(hold_back(surface, start, near) - near).max() < 0.05
    rng = np.random.default_rng(2)
    noise = rng.normal(size=start.shape)
    for wanted in (wrapped(surface, 2), noise / np.linalg.norm(noise, axis=1)[:, None], np.full_like(start, np.nan)):
        held = hold_back(surface, start, wanted)
        assert is_bijective(held, surface.faces)
        np.testing.assert_allclose(np.linalg.norm(held, axis=1), 1.0, atol=1e-14)
