"""The start by latitude and longitude."""

from __future__ import annotations

import numpy as np
import pytest

from omtwarp.flips.predicates import flipped_faces
from omtwarp.mesh.shapes import blob, icosphere, limbs, noisy, shuffled, tube, uv_sphere
from omtwarp.mesh.surface import Surface
from omtwarp.metrics.distortion import measure_triangles
from omtwarp.start.tube import area_latitude, poles, positive_cotangent_weights, tube_map, weighted_laplacian
from omtwarp.untangling.untangle import untangle


def tetrahedron():
    return Surface([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def octahedron():
    return Surface(
        [[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]],
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
    )


@pytest.mark.parametrize(
    "surface",
    [
        tetrahedron(),
        octahedron(),
        icosphere(3),
        uv_sphere(9, 12),
        tube(length=10.0, face_count=1500),
        limbs(sphere=2000),
        noisy(blob(2, sphere=800), 0.3),
        shuffled(blob(3, sphere=500), seed=1),
    ],
    ids=["tetrahedron", "octahedron", "icosphere", "uv sphere", "tube", "limbs", "noisy", "shuffled"],
)
def test_covers_the_sphere_once(surface):
    """The start of a tube covers the sphere once, with few flips, and none after untangling."""
    sphere = tube_map(surface)
    assert np.allclose(np.linalg.norm(sphere, axis=1), 1.0)
    judged = measure_triangles(surface.vertices, surface.faces, sphere)
    assert judged.degree == pytest.approx(1.0, abs=1e-9)
    assert judged.flips <= 0.1 * surface.face_count
    repaired = untangle(surface, sphere, device="cpu")
    assert repaired.flips_after == 0 and not flipped_faces(repaired.sphere, surface.faces).any()


def test_a_long_tube_does_not_shrink():
    """A conformal map would shrink its end by exp(-2π · 20); here bands keep their areas."""
    surface = tube(length=20.0, face_count=3000)
    sphere = tube_map(surface)
    heights = np.sort(sphere[:, 2])
    below = np.cumsum(surface.vertex_areas[np.argsort(sphere[:, 2], kind="stable")]) / surface.vertex_areas.sum()
    assert np.abs((heights + 1) / 2 - below).max() < 0.02


def test_poles_are_far_apart_and_never_neighbours():
    """Poles are the ends of a tube, and on the smallest meshes two vertices that are no neighbours."""
    surface = tube(length=12.0, face_count=1200)
    south, north = poles(surface)
    length = np.ptp(surface.vertices, axis=0).max()
    assert np.linalg.norm(surface.vertices[south] - surface.vertices[north]) > 0.8 * length
    small = octahedron()
    pair = sorted(poles(small))
    assert not (small.edges == pair).all(axis=1).any()


def test_positive_weights_are_the_cotangent_ones_on_an_acute_mesh():
    """The Laplacian annihilates constants and, on a subdivided icosahedron, is the cotangent one."""
    surface = icosphere(4)
    weights = positive_cotangent_weights(surface)
    assert (weights > 0).all()
    laplacian = weighted_laplacian(surface.vertex_count, surface.edges, weights)
    assert np.abs(laplacian @ np.ones(surface.vertex_count)).max() < 1e-12
    x = surface.scaled_vertices
    # Dirichlet energy of the coordinates of a surface is twice its area.
    assert np.sum(x * (laplacian @ x)) == pytest.approx(2 * surface.face_areas.sum(), rel=1e-10)


def test_latitude_shares_ties():
    """Vertices of one level share a height, and the mean height weighted by area is zero."""
    level = np.array([0.0, 1.0, 1.0, 1.0, 2.0])
    areas = np.array([1.0, 2.0, 2.0, 2.0, 1.0])
    height = area_latitude(level, areas)
    assert np.allclose(height, [-0.875, 0.0, 0.0, 0.0, 0.875])
    assert (areas * height).sum() == pytest.approx(0.0)


def test_same_answer_twice():
    """Two calls give the same bits."""
    surface = blob(5, sphere=500)
    assert np.array_equal(tube_map(surface), tube_map(surface))
