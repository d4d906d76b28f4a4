"""The smooth map against maps known in closed form, and what it must never do."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings, strategies as st
from texturing_shapes import ellipsoid, rotation, stretch_latitude, unit

from omtwarp.flips.exact import count_flips, flipped_faces
from omtwarp.mesh import shapes
from omtwarp.mesh.polygons import grid_points
from omtwarp.texturing import bake, texture
from omtwarp.texturing.baking import sample
from omtwarp.texturing.smooth import smooth_curves, smooth_map


def ball(subdivisions):
    """A ball and a smooth map of it that distorts areas: (vertices, faces, the map of any direction)."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    turn = rotation(5)
    return unit(np.asarray(mesh.vertices)), np.asarray(mesh.faces), lambda x: stretch_latitude(unit(x) @ turn)


def errors(subdivisions, parts=4):
    """Largest angle between the map of the ball and what is made of its values at the vertices: smooth, and linear."""
    vertices, faces, exact = ball(subdivisions)
    divided = smooth_curves(vertices, faces, exact(vertices), filtered=False).divided(parts)
    truth = exact(divided.weights @ vertices)
    linear = unit(divided.weights @ exact(vertices))
    return np.linalg.norm(divided.sphere - truth, axis=1).max(), np.linalg.norm(linear - truth, axis=1).max()


def test_the_error_falls_faster_than_that_of_the_linear_map():
    (coarse, coarse_linear), (fine, fine_linear) = errors(2), errors(3)
    assert fine < 0.2 * fine_linear
    assert coarse / fine > 6.0 > coarse_linear / fine_linear  # third order and more, against the second


def kinks(divided, faces):
    """Where the mean of the two points beside each edge lies, an eighth of a height away, from the edge's middle."""
    n, steps = divided.parts, grid_points(divided.parts)
    share = np.column_stack([n - steps.sum(axis=1), steps])
    sums, middles = {}, {}
    for k in range(3):
        half, beside = np.full(3, n // 2), np.full(3, n // 2 - 1)
        half[k], beside[k] = 0, 2
        middle, near = (int(np.flatnonzero((share == want).all(axis=1))[0]) for want in (half, beside))
        for f in range(len(faces)):
            edge = divided.grid[f, middle]
            middles[edge] = divided.sphere[edge]
            sums.setdefault(edge, []).append(divided.sphere[divided.grid[f, near]])
    return np.array([np.mean(pair, axis=0) - middles[edge] for edge, pair in sums.items()])


def test_lines_have_no_corners_at_edges():
    """Where the derivative jumps at an edge, the mean of two points beside it lies elsewhere than by the exact map."""
    vertices, faces, exact = ball(2)
    sphere = exact(vertices)
    smooth = smooth_curves(vertices, faces, sphere, filtered=False).divided(16)
    linear = replace(smooth, sphere=unit(smooth.weights @ sphere))
    truth = kinks(replace(smooth, sphere=exact(smooth.weights @ vertices)), faces)
    off, off_linear = (np.linalg.norm(kinks(m, faces) - truth, axis=1) for m in (smooth, linear))
    assert np.quantile(off, 0.95) < 0.25 * np.quantile(off_linear, 0.95)


def test_points_lie_where_the_weights_say_and_vertices_stay():
    vertices, faces, sphere = ellipsoid(2, seed=1)
    divided = smooth_curves(vertices, faces, sphere, filtered=False).divided(3)
    np.testing.assert_array_equal(divided.sphere[: len(sphere)], sphere)
    np.testing.assert_allclose(np.asarray(divided.weights.sum(axis=1)).ravel(), 1.0, rtol=1e-12)
    share = np.column_stack([3 - grid_points(3).sum(axis=1), grid_points(3)]) / 3.0
    expected = np.einsum("kc,fcj->fkj", share, vertices[faces])
    np.testing.assert_allclose((divided.weights @ vertices)[divided.grid], expected, atol=1e-12)
    # Euler's formula: nothing is there twice, and every edge is shared.
    edges = len(np.unique(np.sort(divided.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))
    assert len(divided.sphere) - edges + len(divided.faces) == 2


def test_waves_of_a_few_edges_are_filtered_out_and_the_map_is_kept():
    """Noise on a map known in closed form: most of it goes, and without noise next to nothing moves."""
    vertices, faces, exact = ball(3)
    sphere = exact(vertices)
    edge = np.linalg.norm(sphere[faces[:, 0]] - sphere[faces[:, 1]], axis=1).mean()
    noise = np.random.default_rng(0).normal(size=sphere.shape)
    noise -= np.einsum("ij,ij->i", noise, sphere)[:, None] * sphere
    noise *= 0.1 * edge / np.linalg.norm(noise, axis=1, keepdims=True)
    rough = unit(sphere + noise)
    left = smooth_map(vertices, faces, rough, 2).sphere[: len(sphere)]
    assert np.linalg.norm(left - sphere, axis=1).mean() < 0.55 * np.linalg.norm(rough - sphere, axis=1).mean()
    still = smooth_map(vertices, faces, sphere, 2).sphere[: len(sphere)]
    assert np.linalg.norm(still - sphere, axis=1).max() < 0.01 * edge


def test_no_vertex_moves_farther_than_a_fraction_of_its_edges():
    vertices, faces, sphere = ellipsoid(2, seed=3)
    rough = unit(sphere + 0.3 * np.random.default_rng(1).normal(size=sphere.shape))
    moved = np.linalg.norm(smooth_map(vertices, faces, rough, 2).sphere[: len(rough)] - rough, axis=1)
    corners = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    length = np.linalg.norm(rough[corners[:, 0]] - rough[corners[:, 1]], axis=1)
    mean = np.bincount(corners.ravel(), np.repeat(length, 2)) / np.bincount(corners.ravel())
    assert 0.0 < moved.max() and (moved <= 1.05 * 0.3 * mean).all()


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), strength=st.floats(0.0, 0.9), parts=st.integers(2, 6))
def test_nothing_is_flipped_that_was_not(seed, strength, parts):
    """Rough maps: vertices moved at random; where that leaves a triangle of the mesh in order, its parts are too."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    rng = np.random.default_rng(seed)
    vertices, faces = np.asarray(mesh.vertices) * rng.uniform(0.3, 2.0, 3), np.asarray(mesh.faces)
    sphere = unit(unit(np.asarray(mesh.vertices)) + 0.2 * strength * rng.normal(size=(len(vertices), 3)))
    divided = smooth_map(vertices, faces, sphere, parts)
    allowed = np.repeat(flipped_faces(sphere, faces), parts**2)
    assert not (flipped_faces(divided.sphere, divided.faces) & ~allowed).any()


@pytest.mark.parametrize("seed", [0, 1])
def test_few_triangles_lose_their_curves_where_the_map_is_stretched(seed):
    """A sphere turned about its poles by 20 / 3 radians more in the north than in the south, which shears it.

    Of the triangles a tenth are flipped by that. The others keep curves, but for a few.
    """
    mesh = shapes.uv_sphere(24, 12)
    rough = unit(mesh.vertices + 0.02 * np.random.default_rng(seed).normal(size=mesh.vertices.shape))
    angle = 20.0 / 3.0 * np.tanh(3.0 * mesh.vertices[:, 2])
    c, s = np.cos(angle), np.sin(angle)
    sphere = np.column_stack([c * rough[:, 0] - s * rough[:, 1], s * rough[:, 0] + c * rough[:, 1], rough[:, 2]])
    divided = smooth_map(mesh.vertices, mesh.faces, sphere, 4)
    linear = unit(divided.weights @ divided.sphere[: len(sphere)])
    away = np.linalg.norm(divided.sphere - linear, axis=1)[divided.grid].max(axis=1)
    assert (away < 1e-12).mean() < 0.04  # 0.14 where each edge had a share of its own


def test_an_even_map_stays_without_flips():
    vertices, faces, sphere = ellipsoid(2, seed=2)
    divided = smooth_map(vertices, faces, sphere, 8)
    assert count_flips(divided.sphere, divided.faces) == 0


def test_meshes_that_are_no_surfaces_do_no_harm():
    """A folded map, a face twice, one without area, a vertex without a face: finite points, and vertices that stay."""
    vertices, faces, sphere = ellipsoid(1, seed=4)
    sphere = sphere.copy()
    sphere[7] = -sphere[7]
    faces = np.concatenate([faces[:-1], faces[:1], [[3, 3, 5]]])
    vertices, sphere = np.concatenate([vertices, [[9.0, 9.0, 9.0]]]), np.concatenate([sphere, [[0.0, 0.0, 1.0]]])
    divided = smooth_map(vertices, faces, sphere, 4)
    assert np.isfinite(divided.sphere).all()
    still = smooth_curves(vertices, faces, sphere, filtered=False).divided(4)
    np.testing.assert_array_equal(still.sphere[: len(sphere)], sphere)


@pytest.mark.parametrize("atlas", ["cube", "octahedral", "equirectangular"])
def test_a_smooth_texture_shows_what_the_exact_map_does(atlas):
    """A soft function baked through a coarse mesh, looked up at points inside of its triangles."""
    vertices, faces, exact = ball(2)

    def shade(d):
        return 0.5 + 0.5 * np.sin(5.0 * d)

    worst = {}
    picture = (255.0 * bake(shade, "equirectangular", size=2048, device="cpu") + 0.5).astype(np.uint8)
    rng = np.random.default_rng(0)
    share = rng.dirichlet(np.ones(3), size=4 * len(faces))
    corner = faces[np.arange(len(share)) % len(faces)]
    place = np.einsum("kc,kcj->kj", share, vertices[corner])
    chord = unit(np.einsum("kc,kcj->kj", share, exact(vertices)[corner]))
    for smooth in (True, False):
        # (1024, 512) is not the picture's own size, which would be kept to the byte
        size = (1024, 512) if atlas == "equirectangular" else 768
        textured = texture((vertices, faces, exact(vertices)), picture, atlas=atlas, size=size, smooth=smooth)
        seen = sample(textured.image, chord, textured.layout.atlas, device="cpu")
        worst[smooth] = np.quantile(np.abs(seen - shade(exact(place))), 0.99)
    assert worst[True] < 0.8 * worst[False]
