"""Steps that cannot flip: whatever the motion, the result is a valid map."""

from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import turned, twisted

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.flips import guard
from omtwarp.flips.exact import count_flips
from omtwarp.mesh.shapes import icosphere, random_sphere
from omtwarp.mesh.surface import Surface


def limited(
    surface: Surface, old: np.ndarray, new: np.ndarray, device: str = "cpu", smallest: float = 0.0
) -> tuple[np.ndarray, int]:
    where = resolve_device(device)
    before = wp.array(np.ascontiguousarray(old), dtype=wp.vec3d, device=where)
    after = wp.array(np.ascontiguousarray(new), dtype=wp.vec3d, device=where)
    with mock.patch.object(guard, "MIN_PART", smallest):
        keeper = guard.StepGuard(surface, where)
        keeper.hold(before, after)
    np.testing.assert_array_equal(before.numpy(), old)
    return after.numpy(), int(keeper.held.numpy()[0])


def unit(points: np.ndarray) -> np.ndarray:
    return points / np.linalg.norm(points, axis=1)[:, None]


@settings(max_examples=40)
@given(seed=st.integers(0, 100_000), size=st.floats(0.01, 3.0), part=st.floats(0.01, 1.0))
def test_random_steps_never_flip(seed, size, part):
    """Random steps, up to the whole sphere's size and for all or a few vertices, leave no triangle flipped."""
    surface = random_sphere(300, seed)
    rng = np.random.default_rng(seed)
    moves = rng.random(surface.vertex_count) < part
    step = size * rng.normal(size=surface.vertices.shape) * moves[:, None]
    wanted = np.where(moves[:, None], unit(surface.vertices + step), surface.vertices)
    got, held = limited(surface, surface.vertices, wanted)
    assert count_flips(got, surface.faces) == 0
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(got[~moves], surface.vertices[~moves], atol=1e-15)  # only who was asked to moves
    assert held >= (got != wanted).any(axis=1).sum()
    if count_flips(wanted, surface.faces) == 0:
        np.testing.assert_array_equal(got, wanted)


@settings(max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_a_shortened_step_lies_on_the_way(seed):
    surface = random_sphere(200, seed)
    wanted = unit(surface.vertices + 0.3 * np.random.default_rng(seed).normal(size=surface.vertices.shape))
    got, _ = limited(surface, surface.vertices, wanted)
    # In the plane of the old and the wanted point, between them.
    old = surface.vertices
    way = np.linalg.norm(wanted - old, axis=1)
    assert (np.linalg.norm(got - old, axis=1) <= way + 1e-14).all()
    np.testing.assert_allclose(np.einsum("ij,ij->i", got, np.cross(old, wanted)), 0.0, atol=1e-14)


@settings(max_examples=20)
@given(seed=st.integers(0, 100_000), size=st.floats(0.01, 1.0), smallest=st.floats(0.01, 0.9))
def test_no_triangle_shrinks_below_its_floor(seed, size, smallest):
    """det is twice the area of a small triangle; one below its floor before the step may grow but not shrink."""
    surface = random_sphere(300, seed)
    old = twisted(surface.vertices, 0.3)
    if count_flips(old, surface.faces):
        return
    wanted = unit(old + size * np.random.default_rng(seed).normal(size=old.shape))
    got, _ = limited(surface, old, wanted, smallest=smallest)
    before, after = (np.linalg.det(points[surface.faces]) for points in (old, got))
    floor = np.minimum(before, 2.0 * smallest * surface.face_areas)
    assert (after >= floor - 1e-14).all()
    assert (after > 0.0).all()


def test_a_valid_step_is_not_touched(device):
    surface = turned(icosphere(8))
    wanted = twisted(surface.vertices, 0.3)
    got, held = limited(surface, surface.vertices, wanted, device)
    assert held == 0
    np.testing.assert_array_equal(got, wanted)


def test_one_bad_vertex_holds_back_nobody_far_away(device):
    """A vertex sent to the sphere's other side is held back, and vertices far away take their whole small step."""
    surface = turned(icosphere(8))
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0.0], [np.sin(0.1), np.cos(0.1), 0.0], [0.0, 0.0, 1.0]])
    wanted = surface.vertices @ turn.T
    wanted[200] = -wanted[200]
    got, held = limited(surface, surface.vertices, wanted, device)
    assert count_flips(got, surface.faces) == 0
    assert 1 <= held <= 40  # a few rings at most of 642
    distance = np.arccos(np.clip(surface.vertices @ surface.vertices[200], -1.0, 1.0))
    far = distance > 0.7
    np.testing.assert_array_equal(got[far], wanted[far])


def test_a_step_that_is_not_finite_is_held_back():
    surface = turned(icosphere(4))
    wanted = surface.vertices.copy()
    wanted[30] = np.nan
    got, held = limited(surface, surface.vertices, wanted)
    assert held >= 1
    assert np.isfinite(got).all()
    np.testing.assert_array_equal(got[30], surface.vertices[30])


def test_the_same_bits_twice():
    surface = random_sphere(300, 9)
    wanted = unit(surface.vertices + 0.5 * np.random.default_rng(9).normal(size=surface.vertices.shape))
    np.testing.assert_array_equal(
        limited(surface, surface.vertices, wanted)[0], limited(surface, surface.vertices, wanted)[0]
    )


def test_many_steps_in_a_row_stay_valid():
    """Many steps in a row, each from the last one's result, leave the map valid."""
    surface = random_sphere(300, 4)
    rng = np.random.default_rng(4)
    points = surface.vertices
    for _ in range(30):
        points, _ = limited(surface, points, unit(points + 0.2 * rng.normal(size=points.shape)))
        assert count_flips(points, surface.faces) == 0
    assert np.linalg.norm(points - surface.vertices, axis=1).mean() == pytest.approx(0.2, abs=0.2)
