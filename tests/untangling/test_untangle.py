"""Untangling: flips are removed, and other vertices do not move."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import random_rotation

import omtwarp
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.shapes import blob, flip_edges, icosphere, noisy
from omtwarp.mesh.surface import Surface
from omtwarp.metrics.certificate import certify_triangles
from omtwarp.solvers.triangle import triangle_frames
from omtwarp.untangling.kernels import untangle_newton, untangle_value
from omtwarp.untangling.untangle import RINGS, RepairBudget, untangle


def unit(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def scrambled(surface, centre, radius, seed):
    """The surface's own directions, those within a cap thrown about at random inside it."""
    sphere = unit(surface.vertices)
    rng = np.random.default_rng(seed)
    inside = np.flatnonzero(sphere @ sphere[centre] > np.cos(radius))
    moved = sphere.copy()
    moved[inside] = unit(sphere[centre] + rng.normal(size=(len(inside), 3)) * radius / 3)
    return sphere, moved, inside


def test_untangled_map_is_left_alone(device):
    """Nothing flipped, nothing moved."""
    surface = icosphere(4)
    sphere = unit(surface.vertices)
    result = untangle(surface, sphere, device=device)
    assert (result.flips_before, result.flips_after, result.rounds, result.vertices_moved) == (0, 0, 0, 0)
    assert np.allclose(result.sphere, sphere, atol=1e-15)


def test_repair_can_be_the_same_at_every_scale(device):
    """Of conformal maps that show a scrambled cap at a hundredth and at a thousandth of its size."""
    surface = icosphere(12)
    x, y, z = unit(surface.vertices).T
    inside = np.flatnonzero(z > np.cos(0.3))
    scrambled_cap = np.random.default_rng(1).permutation(inside)

    def repaired(scale, keep):
        # Stereographic projection, scaled, and back: a Möbius map.
        turn, angle = np.arctan2(y, x), 2.0 * np.arctan(scale * np.tan(0.5 * np.arccos(np.clip(z, -1.0, 1.0))))
        sphere = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=1)
        sphere[inside] = sphere[scrambled_cap]
        result = untangle(surface, sphere, keep_scale=keep, device=device)
        assert result.flips_before > 20 and result.bijective
        return result.sphere[inside, :2] / scale

    np.testing.assert_allclose(repaired(1e-2, True), repaired(1e-3, True), atol=1e-4)
    assert np.abs(repaired(1e-2, False) - repaired(1e-3, False)).max() > 1e-3


def test_repair_leaves_a_conformal_map_conformal(device):
    """Two flips cost it nothing, where a repair towards even areas costs a tenth of its angles."""
    surface = flip_edges(blob(seed=1, amplitude=0.3, sphere=1280), rounds=6, seed=2)
    points = omtwarp.harmonic_points(surface, device="cpu").sphere
    before = omtwarp.distortion(surface, points, device="cpu")
    assert before.flips == 2
    angles = [
        omtwarp.distortion(surface, untangle(surface, points, keep_scale=keep, device=device).sphere).angle["sphere"]
        for keep in (True, False)
    ]
    assert angles[0] < before.angle["sphere"] + 0.005 and angles[1] > before.angle["sphere"] + 0.1


def test_two_scrambled_patches_leave_the_rest(device):
    """Far patches are solved together, and vertices away from both do not move."""
    surface = icosphere(12)
    first = scrambled(surface, 0, 0.3, 1)
    far = int(np.argmin(first[0] @ first[0][0]))
    second = scrambled(surface, far, 0.3, 2)
    start = first[1].copy()
    start[second[2]] = second[1][second[2]]
    result = untangle(surface, start, device=device)
    assert result.flips_before > 20 and result.flips_after == 0
    assert not flipped_faces(result.sphere, surface.faces).any()
    assert result.history[0]["patches"] == 2
    equator = np.abs(first[0] @ first[0][0]) < 0.3
    assert np.array_equal(result.sphere[equator], start[equator])
    assert np.allclose(np.linalg.norm(result.sphere, axis=1), 1.0)


@settings(max_examples=12)
@given(seed=st.integers(0, 10**6), radius=st.floats(0.1, 0.9), noise=st.floats(0.0, 0.3))
def test_scrambled_patches_on_random_shapes(seed, radius, noise):
    """Of any size up to a third of the sphere, on any star-shaped surface."""
    surface = noisy(blob(seed, amplitude=0.3, sphere=icosphere(6)), noise, seed)
    _, start, _ = scrambled(surface, seed % surface.vertex_count, radius, seed)
    result = untangle(surface, start, device="cpu")
    assert result.flips_after == 0
    assert not flipped_faces(result.sphere, surface.faces).any()


def test_turning_the_map_or_the_corners_of_triangles_turns_what_is_untangled():
    """Also on long triangles, which are widened before their shape is asked for, and damped steps are the same."""
    surface = noisy(blob(3, amplitude=0.3, sphere=icosphere(8)), 0.3, 3)
    surface = Surface(surface.vertices * [1.0, 1.0, 0.15], surface.faces)
    _, start, _ = scrambled(surface, 5, 0.7, 4)
    one = untangle(surface, start, device="cpu")
    assert one.bijective and one.flips_before > 30
    rotation = random_rotation(7)
    turned = untangle(surface, start @ rotation.T, device="cpu").sphere
    np.testing.assert_allclose(turned, one.sphere @ rotation.T, atol=1e-7)
    rolled = Surface(surface.vertices, np.roll(surface.faces, 1, axis=1))
    np.testing.assert_allclose(untangle(rolled, start, device="cpu").sphere, one.sphere, atol=1e-7)


def sides_of(frames):
    """Lengths of the three edges of triangles from their frames, shape [T, 3], and their areas, shape [T]."""
    base, height = 1.0 / frames[:, 0], 1.0 / frames[:, 2]
    foot = -frames[:, 1] * base * height
    return np.stack([base, np.hypot(base - foot, height), np.hypot(foot, height)], axis=1), 0.5 * base * height


def test_thin_triangles_are_widened_alike_whichever_corner_comes_first():
    corners = np.random.default_rng(0).normal(size=(600, 3)) * [1.0, 0.05, 0.05]
    faces = np.arange(600, dtype=np.int32).reshape(-1, 3)
    sides, areas = sides_of(triangle_frames(Surface(corners, faces), 0.2))
    others, same = sides_of(triangle_frames(Surface(corners, np.roll(faces, -1, axis=1)), 0.2))
    np.testing.assert_allclose(np.roll(others, 1, axis=1), sides, rtol=1e-9)
    np.testing.assert_allclose(same, areas, rtol=1e-9)
    before, _ = sides_of(triangle_frames(Surface(corners, faces)))
    thickness = 2.0 * areas / sides.max(axis=1) ** 2
    assert thickness.min() > 0.19 and np.median(thickness) < 0.25
    assert np.abs(sides.max(axis=1) / before.max(axis=1) - 1.0).max() < 0.1  # no longer than they were


def test_triangles_collapsed_to_a_point():
    """Area exactly zero, as where a conformal map underflows."""
    surface = icosphere(6)
    sphere = unit(surface.vertices)
    start = sphere.copy()
    start[sphere @ sphere[0] > np.cos(0.5)] = sphere[0]
    result = untangle(surface, start, device="cpu")
    assert result.flips_before > 10 and result.flips_after == 0


def test_same_answer_twice():
    """Two calls give the same bits."""
    surface = icosphere(6)
    _, start, _ = scrambled(surface, 3, 0.5, 0)
    first, second = (untangle(surface, start, device="cpu").sphere for _ in range(2))
    assert np.array_equal(first, second)


@pytest.mark.parametrize("rings", [None, 4, "4", (4.5,), (-1,), ["x"], [[4], [4, 8]], (10**30,), iter((4, 8))])
def test_rings_that_are_no_whole_numbers(rings):
    """Rings that are not a list of whole numbers from 0 on are refused in one line."""
    ball = icosphere(2)
    with pytest.raises(OmtwarpError, match="rings: "):
        untangle(ball, ball.vertices, device="cpu", rings=rings)


def test_failure_is_told():
    """With no attempts allowed, the flips left are counted."""
    surface = icosphere(4)
    _, start, _ = scrambled(surface, 3, 0.6, 0)
    result = untangle(surface, start, device="cpu", rings=())
    assert result.flips_after == result.flips_before > 0
    assert RINGS[-1] > surface.vertex_count


@pytest.mark.parametrize("epsilon", [1.0, 0.1, 0.003])
def test_derivatives_of_the_energy(epsilon, device):
    """The gradient by differences, on flipped triangles too; the Hessian positive semidefinite."""
    from omtwarp.untangling.kernels import move_in_tangent

    surface = icosphere(3)
    _, start, _ = scrambled(surface, 3, 1.0, 0)
    where, count = resolve_device(device), surface.face_count
    assert flipped_faces(start, surface.faces).any()
    points = wp.array(start, dtype=wp.vec3d, device=where)
    inputs = [
        wp.array(surface.faces, dtype=wp.vec3i, device=where),
        wp.array(triangle_frames(surface), dtype=wp.vec3d, device=where),
        wp.array(surface.face_areas, dtype=wp.float64, device=where),
        wp.array(np.full(count, epsilon), dtype=wp.float64, device=where),
        wp.float64(2.0),
    ]
    gradient = wp.empty((count, 6), dtype=wp.float64, device=where)
    hessian = wp.empty((count, 21), dtype=wp.float64, device=where)
    wp.launch(untangle_newton, dim=count, inputs=[points, *inputs], outputs=[gradient, hessian], device=where)
    row, column = np.triu_indices(6)
    blocks = np.empty((count, 6, 6))
    blocks[:, row, column] = blocks[:, column, row] = hessian.numpy()
    assert np.linalg.eigvalsh(blocks).min() > -1e-9 * np.abs(blocks).max()

    direction = np.random.default_rng(1).normal(size=(surface.vertex_count, 2))

    def values(h):
        moved = wp.empty(surface.vertex_count, dtype=wp.vec3d, device=where)
        step = wp.array(h * direction, dtype=wp.float64, device=where)
        wp.launch(move_in_tangent, dim=surface.vertex_count, inputs=[points, step], outputs=[moved], device=where)
        value, solid = (wp.empty(count, dtype=wp.float64, device=where) for _ in range(2))
        wp.launch(untangle_value, dim=count, inputs=[moved, *inputs], outputs=[value, solid], device=where)
        return value.numpy().copy()

    h = 1e-6
    differences = (8 * (values(h) - values(-h)) - values(2 * h) + values(-2 * h)) / (12 * h)
    expected = (gradient.numpy() * direction[surface.faces].reshape(-1, 6)).sum(axis=1)
    assert np.allclose(differences, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


def test_repair_ends_when_its_budget_is_spent():
    """A sphere of nothing but noise is given up after the same work on every machine."""
    surface = icosphere(8)
    noise = unit(np.random.default_rng(4).normal(size=surface.vertices.shape))
    spent = []
    for _ in range(2):
        budget = RepairBudget(surface, share=0.05)
        result = untangle(surface, noise, budget=budget)
        spent.append((budget.spent, result.rounds, result.sphere.tobytes()))
        assert budget.exhausted and not result.bijective
        assert budget.spent <= budget.granted + 10 * (surface.vertex_count + 1000)
    assert spent[0] == spent[1]


def test_untangling_never_covers_the_sphere_twice():
    """From a map of degree 1 every attempt keeps the sum of solid angles, whatever it does with flips."""
    surface = icosphere(6)
    rng = np.random.default_rng(9)
    for amount in (0.5, 1.0, 2.0):
        rough = unit(surface.vertices + amount * rng.normal(size=surface.vertices.shape))
        result = untangle(surface, rough)
        if result.flips_after == 0 and certify_triangles(surface.faces, rough).degree == 1:
            assert result.bijective and certify_triangles(surface.faces, result.sphere).degree == 1
