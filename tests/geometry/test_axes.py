"""Axes of a surface: moments in closed form, independent of order, position and triangulation."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from sphere_truths import random_rotation

from omtwarp.geometry.axes import principal_axes, rotation_onto_axes, towards_coordinates
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.shapes import blob, ellipsoid, icosphere
from omtwarp.mesh.surface import Surface


def wedge():
    """Make a tetrahedron with four different corners, which has three axes and three directions."""
    points = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.3, 2.0, 0.0], [0.2, 0.4, 1.0]])
    return Surface(points, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]))


def quartered(surface):
    """Cut every triangle into four at the middles of its edges: another mesh of the same shape."""
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, index = np.unique(edges, axis=0, return_inverse=True)
    middle = index.reshape(-1, 3) + surface.vertex_count
    a, b, c = surface.faces.T
    ab, bc, ca = middle.T
    faces = np.concatenate([np.stack(row, axis=1) for row in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return Surface(np.concatenate([surface.vertices, surface.vertices[unique].mean(axis=1)]), faces)


@given(seed=st.integers(0, 10**6), scale=st.floats(1e-6, 1e6))
def test_axes_follow_the_shape_wherever_it_is(seed, scale):
    """A rotated, moved and scaled surface has the rotated axes, and so has one with other triangles."""
    surface = wedge()
    axes = principal_axes(surface)
    assert axes.note == ""
    np.testing.assert_allclose(axes.frame @ axes.frame.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(axes.frame) == pytest.approx(1.0)
    turn = random_rotation(seed)
    moved = Surface(scale * (surface.vertices @ turn.T + [3.0, -2.0, 1.0]), surface.faces)
    np.testing.assert_allclose(principal_axes(moved).frame, axes.frame @ turn.T, atol=1e-6)
    np.testing.assert_allclose(principal_axes(quartered(surface)).frame, axes.frame, atol=1e-12)


def test_a_long_box_has_the_axes_of_its_sides():
    surface = ellipsoid((1.0, 3.0, 2.0), 320)
    axes = principal_axes(surface)
    np.testing.assert_allclose(np.abs(axes.frame), [[0, 1, 0], [0, 0, 1], [1, 0, 0]], atol=1e-6)
    assert "alike in opposite directions" in axes.note
    assert np.linalg.det(axes.frame) == pytest.approx(1.0)


@pytest.mark.parametrize("shape", [icosphere(4), Surface(3.0 * icosphere(1).vertices + 5.0, icosphere(1).faces)])
def test_shapes_without_axes_say_so(shape):
    axes = principal_axes(shape)
    np.testing.assert_array_equal(axes.frame, np.eye(3))
    assert "no axes of its own" in axes.note


def test_third_moments_point_the_way_of_the_longer_tail():
    """A pyramid's centre is nearer to its base: the direction of largest extent is that of its tip."""
    base = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0], [0, 0, 9.0]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [0, 2, 1], [0, 3, 2]])
    axes = principal_axes(Surface(base, faces))
    np.testing.assert_allclose(axes.frame[0], [0, 0, 1], atol=1e-6)
    assert "one axis of its own" in axes.note


def test_a_turned_map_is_turned_back():
    surface = blob(seed=2, sphere=320)
    sphere = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
    axes = principal_axes(surface).frame
    wanted, determined = rotation_onto_axes(surface, sphere, axes)
    assert determined
    turn = random_rotation(5)
    again, _ = rotation_onto_axes(surface, sphere @ turn.T, axes)
    np.testing.assert_allclose(sphere @ turn.T @ again.T, sphere @ wanted.T, atol=1e-12)


@pytest.fixture(scope="module")
def plain():
    surface = blob(seed=5, amplitude=0.25, degree=4, sphere=1280)
    return surface, map_to_sphere(surface, optimality=False)


@pytest.mark.parametrize("change", ["noise", "corners rolled", "moved", "turned", "shuffled"])
def test_the_map_depends_on_the_shape_and_not_on_order_or_place(plain, change):
    """Points stay within a mean of 1e-3 and a largest distance of 0.02 radians, without any alignment."""
    surface, result = plain
    vertices, faces, expected = surface.vertices, surface.faces, result.sphere
    rng = np.random.default_rng(3)
    if change == "noise":
        vertices = vertices + 1e-12 * rng.normal(size=vertices.shape)
    elif change == "corners rolled":
        start = rng.integers(0, 3, len(faces))
        faces = np.stack([faces[np.arange(len(faces)), (start + k) % 3] for k in range(3)], axis=1)
    elif change == "moved":
        vertices = vertices + [10.0, -20.0, 5.0]
    elif change == "turned":
        vertices = vertices @ random_rotation(8).T
    else:
        order = rng.permutation(len(vertices))
        vertices, faces, expected = (
            vertices[order],
            np.argsort(order)[faces][rng.permutation(len(faces))],
            expected[order],
        )
    again = map_to_sphere((vertices, faces), optimality=False).sphere
    if change == "turned":  # which ends of its axes are which, the mesh's coordinates say
        halves = [np.diag(signs) for signs in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))]
        again = min((again @ half for half in halves), key=lambda points: np.abs(points - expected).max())
    distance = 2.0 * np.arcsin(np.minimum(np.linalg.norm(again - expected, axis=1) / 2.0, 1.0))
    assert distance.mean() < 1e-3 and distance.max() < 0.02


@given(seed=st.integers(0, 10**6))
def test_axes_point_along_the_coordinates(seed):
    frame = random_rotation(seed)
    turned = towards_coordinates(frame)
    np.testing.assert_array_equal(np.abs(turned), np.abs(frame))
    assert np.linalg.det(turned) == pytest.approx(1.0)
    assert turned[0][np.abs(turned[0]).argmax()] > 0.0 < turned[2][np.abs(turned[2]).argmax()]


@pytest.mark.parametrize("seed", range(5))
def test_the_north_of_a_body_that_spins_about_z_is_its_top(seed):
    """Asteroids spin about the axis of least extent, which files have as z: the picture's north is not their south."""
    surface = blob(seed=seed, amplitude=0.1, degree=5, sphere=320)
    surface = Surface(surface.vertices * [1.0, 0.8, 0.6], surface.faces)
    result = map_to_sphere(surface, until="conformal")
    areas = surface.vertex_areas
    heights = surface.vertices[:, 2] - areas @ surface.vertices[:, 2] / areas.sum()
    assert areas @ (heights * result.sphere[:, 2]) > 0.5 * np.sqrt((areas @ heights**2) * areas.sum() / 3.0)


def test_the_report_says_where_a_shape_has_no_axes():
    assert "no axes" in map_to_sphere(icosphere(4), until="conformal").report["start"]["axes"]
    lopsided = blob(seed=5, amplitude=0.25, degree=4, sphere=320)
    assert "axes" not in map_to_sphere(lopsided, until="conformal").report["start"]
