"""Point location on the sphere against what every triangle says, and closest points against trimesh."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from sphere_truths import pushed_north, twisted
from trimesh.triangles import closest_point

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import orientation_signs
from omtwarp.geometry.sphere_hierarchy import sphere_hierarchy
from omtwarp.location import Locator
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface
from omtwarp.moser import walk as moser_walk
from omtwarp.wavelets.sampling import SphereSampler


def random_directions(count: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1)[:, None]


def images(found, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.einsum("pk,pkd->pd", found.coordinates, points[faces[found.faces]])


def sheared(sphere: Surface) -> Surface:
    """Make long oblique triangles without a flip: not a Delaunay triangulation, so that walks could go in circles."""
    moved = Surface(twisted(pushed_north(sphere.vertices, 0.6), 3.0), sphere.faces)
    assert (orientation_signs(moved.vertices, moved.faces) == 1).all()
    return moved


SPHERES = {
    "regular": lambda: shapes.icosphere(8),
    "octahedron": lambda: shapes.icosphere(1),
    "clustered": lambda: shapes.random_sphere(800, seed=1, clustering=0.9),
    "not Delaunay": lambda: sheared(shapes.icosphere(24)),
    "needles at the poles": lambda: shapes.uv_sphere(40, 8),
}


@pytest.mark.parametrize("name", SPHERES)
def test_points_lie_where_they_are_found(name, device):
    sphere = SPHERES[name]()
    points, faces = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1)[:, None], sphere.faces
    # Vertices and middles of edges lie in several triangles at once: any of them will do, but one must be found.
    middles = points[sphere.edges].sum(axis=1)
    queries = np.concatenate([random_directions(500), points, middles, -points])
    found = Locator(points, faces, device=device).find(queries)
    assert found.coordinates.min() >= 0.0
    np.testing.assert_allclose(found.coordinates.sum(axis=1), 1.0, atol=1e-15)
    at = images(found, points, faces)
    at /= np.linalg.norm(at, axis=1)[:, None]
    np.testing.assert_allclose(at, queries / np.linalg.norm(queries, axis=1)[:, None], atol=1e-12)


@given(seed=st.integers(0, 10**6), clustering=st.floats(0.0, 0.95))
def test_the_triangle_found_is_the_one_that_a_search_of_all_finds(seed, clustering):
    sphere = shapes.random_sphere(200, seed=seed % 7, clustering=clustering)
    points, faces = sphere.vertices, sphere.faces
    queries = random_directions(50, seed)
    found = Locator(points, faces, device="cpu").find(queries)
    a, b, c = (points[faces[:, k]] for k in range(3))
    weights = np.stack([queries @ np.cross(u, v).T for u, v in ((b, c), (c, a), (a, b))], axis=2)
    inside = (weights > 1e-13).all(axis=2)
    assert inside[np.arange(50), found.faces][inside.any(axis=1)].all()


def test_closest_points_are_those_of_trimesh(device):
    sphere = shapes.flip_edges(shapes.icosphere(6), rounds=3, seed=5)
    queries = random_directions(60, 3)
    found = Locator(sphere.vertices, sphere.faces, device=device).find_closest(queries)
    count = len(sphere.faces)
    corners = np.tile(sphere.vertices[sphere.faces], (len(queries), 1, 1))
    every = closest_point(corners, np.repeat(queries, count, axis=0)).reshape(len(queries), count, 3)
    least = np.linalg.norm(every - queries[:, None], axis=2).min(axis=1)
    ours = np.linalg.norm(images(found, sphere.vertices, sphere.faces) - queries, axis=1)
    np.testing.assert_allclose(ours, least, atol=1e-14)


def test_interpolation_matrix_keeps_constants_and_linear_functions():
    sphere = shapes.icosphere(16)
    queries = random_directions(300, 4)
    found = Locator(sphere.vertices, sphere.faces, device="cpu").find(queries)
    matrix = found.matrix(sphere.faces, sphere.vertex_count)
    assert matrix.shape == (300, sphere.vertex_count)
    np.testing.assert_allclose(matrix @ np.ones(sphere.vertex_count), 1.0, atol=1e-15)
    at = matrix @ sphere.vertices  # the flat triangle's point on the ray
    np.testing.assert_allclose(np.cross(at, queries), 0.0, atol=1e-14)


def test_the_interpolation_matrix_leaves_what_was_found_as_it_was():
    """Entries are sorted by column in the matrix, coordinates stay in the order of the triangle's corners."""
    ball = shapes.icosphere(6)
    found = Locator(ball.vertices, ball.faces, device="cpu").find(ball.vertices[ball.faces].mean(axis=1))
    before = found.coordinates.copy()
    found.matrix(ball.faces, len(ball.vertices))
    np.testing.assert_array_equal(found.coordinates, before)


def test_location_on_a_hierarchy_agrees():
    """The wavelets' descent through nested triangles and the search among boxes give the same coordinates."""
    hierarchy = sphere_hierarchy(3)
    queries = random_directions(400, 6)
    sampler = SphereSampler(hierarchy, queries, device="cpu")
    found = Locator(hierarchy.vertices, hierarchy.faces, device="cpu").find(queries)
    np.testing.assert_array_equal(found.faces, sampler.point_faces.numpy())
    np.testing.assert_allclose(found.coordinates, sampler.coordinates.numpy(), atol=1e-14)


def test_moving_points_share_the_kernels():
    from omtwarp import location as kernels

    assert moser_walk is kernels.walk


def test_same_bits_twice_and_in_parts(device):
    sphere = shapes.icosphere(12)
    queries = random_directions(9000, 7)
    locator = Locator(sphere.vertices, sphere.faces, device=device)
    whole = locator.find(queries)
    again = Locator(sphere.vertices, sphere.faces, device=device).find(queries[:100])
    np.testing.assert_array_equal(whole.faces[:100], again.faces)
    np.testing.assert_array_equal(whole.coordinates[:100], again.coordinates)


def test_half_a_sphere_is_refused():
    sphere = shapes.icosphere(4)
    upper = sphere.faces[(sphere.vertices[sphere.faces][..., 2] > -0.1).all(axis=1)]
    with pytest.raises(OmtwarpError, match="does not cover the sphere"):
        Locator(sphere.vertices, upper, device="cpu").find([[0.0, 0.0, -1.0]])
    with pytest.raises(OmtwarpError, match="without triangles"):
        Locator(sphere.vertices, np.zeros((0, 3), np.int32), device="cpu")


@pytest.mark.parametrize("point", [[0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, 1e200], ["x", "y", "z"], [0.0, 1.0]])
def test_points_without_a_direction_are_refused(point):
    sphere = shapes.icosphere(2)
    with pytest.raises(OmtwarpError, match=r"the points|no direction"):
        Locator(sphere.vertices, sphere.faces).find([point])
