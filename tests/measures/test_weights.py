"""Another measure than area: the one place that carries it, and that everything derived from it follows."""

import numpy as np
import pytest

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.measures import weighted_surface
from omtwarp.mesh.read import MeshFile
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.solvers.triangle import triangle_frames

SURFACE = blob(4, sphere=600)
WEIGHTS = 1.0 + np.arange(SURFACE.face_count) % 7


def test_a_measure_has_the_sphere_s_total_and_the_ratios_given():
    other = SURFACE.with_areas(WEIGHTS)
    assert other.face_areas.sum() == pytest.approx(SPHERE_AREA, rel=1e-13)
    np.testing.assert_allclose(other.face_areas / other.face_areas[0], WEIGHTS, rtol=1e-13)
    assert other.vertex_areas.sum() == pytest.approx(SPHERE_AREA, rel=1e-13)
    np.testing.assert_array_equal(other.own_areas, SURFACE.face_areas)
    assert other.weighted
    assert not SURFACE.weighted


def test_what_the_measure_does_not_change_is_shared_and_what_it_changes_is_not(device):
    surface = blob(4, sphere=600)
    neighbours, before = surface.face_neighbours, surface.vertex_areas.copy()
    sent = surface.on(device).face_areas.numpy().copy()
    surface.on(device).faces  # noqa: B018
    other = surface.with_areas(WEIGHTS)
    assert other.face_neighbours is neighbours
    assert other.on(device).faces is surface.on(device).faces
    np.testing.assert_array_equal(surface.vertex_areas, before)
    np.testing.assert_array_equal(surface.on(device).face_areas.numpy(), sent)
    np.testing.assert_array_equal(other.on(device).face_areas.numpy(), other.face_areas)


def test_frames_have_the_shapes_of_triangles_and_the_areas_asked_for():
    """A frame (1/l, -x/(l h), 1/h) is of a triangle of area l h / 2 with its foot at x."""
    other = SURFACE.with_areas(WEIGHTS)
    own, asked = triangle_frames(SURFACE), triangle_frames(other)
    np.testing.assert_allclose(0.5 / (asked[:, 0] * asked[:, 2]), other.face_areas, rtol=1e-12)
    np.testing.assert_allclose(asked[:, 1] / asked[:, 2], own[:, 1] / own[:, 2], rtol=1e-9, atol=1e-9)
    some = np.array([5, 3, 8])
    np.testing.assert_array_equal(triangle_frames(other, 0.0, some), asked[some])


def test_weights_per_vertex_and_per_triangle():
    per_face = weighted_surface(SURFACE, WEIGHTS)
    np.testing.assert_allclose(
        per_face.face_areas / SURFACE.face_areas * (SURFACE.face_areas @ WEIGHTS) / SPHERE_AREA, WEIGHTS
    )
    heights = 1.5 + SURFACE.vertices[:, 2] / np.abs(SURFACE.vertices[:, 2]).max()
    at_vertices = weighted_surface(SURFACE, 1e200 * heights)  # only ratios count
    means = (heights[SURFACE.faces].sum(axis=1) / 3) * triangle_areas(SURFACE.vertices, SURFACE.faces)
    np.testing.assert_allclose(at_vertices.face_areas / SPHERE_AREA, means / means.sum(), rtol=1e-12)
    assert weighted_surface(SURFACE, None) is SURFACE


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (np.ones(5), "one for each of"),
        (np.ones((SURFACE.face_count, 1)), "one for each of"),
        (
            np.r_[0.0, np.ones(SURFACE.face_count - 1)],
            "the weights: 1 number that is not positive and finite, first in row 0",
        ),
        (np.r_[np.nan, -np.ones(SURFACE.vertex_count - 1)], "are not positive and finite, first in row 0"),
        (["a"] * SURFACE.face_count, "must be real numbers"),
        (np.logspace(0.0, 13.0, SURFACE.vertex_count), "at most 1e12 times the smallest"),
        (np.logspace(-200.0, 200.0, SURFACE.face_count), "at most 1e12 times the smallest"),
    ],
)
def test_weights_that_cannot_be_used_are_refused_in_one_line(weights, message):
    with pytest.raises(OmtwarpError, match=message):
        weighted_surface(SURFACE, weights)


@pytest.mark.parametrize("areas", [np.ones(3), np.zeros(SURFACE.face_count), np.full(SURFACE.face_count, np.inf), "x"])
def test_areas_that_cannot_be_used_are_refused(areas):
    with pytest.raises(OmtwarpError, match=r"areas? "):
        SURFACE.with_areas(areas)


def test_where_there_are_as_many_vertices_as_triangles_an_argument_says_which():
    """A tetrahedron has four of both: a weight of a vertex is spread over its three triangles."""
    points = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    surface = Surface(points, faces)
    weights = [4.0, 1.0, 1.0, 1.0]
    with pytest.raises(OmtwarpError, match=r"as many vertices as triangles: say which.*weights_at='vertices'"):
        weighted_surface(surface, weights)
    for map_it in (omtwarp.map_to_sphere, omtwarp.map_surface):
        with pytest.raises(OmtwarpError, match="weights_at='vertices'"):
            map_it((points, faces), weights=weights)
    of_triangles = weighted_surface(surface, weights, "triangles").face_areas
    np.testing.assert_allclose(of_triangles / SPHERE_AREA, np.array([4, 1, 1, 1]) / 7, rtol=1e-12)
    of_vertices = weighted_surface(surface, weights, "vertices").face_areas
    np.testing.assert_allclose(of_vertices / SPHERE_AREA, np.array([2, 2, 2, 1]) / 7, rtol=1e-12)
    result = omtwarp.map_to_sphere((points, faces), weights=weights, weights_at="triangles", device="cpu")
    np.testing.assert_allclose(result.measure / SPHERE_AREA, np.array([4, 1, 1, 1]) / 7, rtol=1e-12)


def test_weights_of_the_other_kind_than_is_said_are_refused():
    with pytest.raises(OmtwarpError, match=f"give one for each of {SURFACE.vertex_count} vertices$"):
        weighted_surface(SURFACE, WEIGHTS, "vertices")
    with pytest.raises(OmtwarpError, match=f"give one for each of {SURFACE.face_count} triangles$"):
        weighted_surface(SURFACE, np.ones(SURFACE.vertex_count), "triangles")
    with pytest.raises(OmtwarpError, match="unknown weights_at"):
        weighted_surface(SURFACE, WEIGHTS, "edges")


def test_weights_take_what_maps_take():
    """A mesh as a file holds it, and a pair of arrays."""
    ball = icosphere(2)
    weights = np.linspace(1.0, 2.0, ball.vertex_count)
    expected = weighted_surface(ball, weights).face_areas
    for mesh in (MeshFile(ball.vertices, ball.faces.astype(np.int64)), (ball.vertices, ball.faces)):
        assert np.array_equal(weighted_surface(mesh, weights).face_areas, expected)


def test_weights_of_a_surface_whose_faces_are_whole_floats():
    """Faces that are floats, as some files and libraries give them, take weights in all domains."""
    ball = icosphere(2)
    weights = np.linspace(1.0, 2.0, ball.vertex_count)
    given = [(ball.vertices, ball.faces[1:].astype(kind)) for kind in (int, float)]
    plain, floats = (omtwarp.map_surface(mesh, domain="disk", weights=weights, device="cpu") for mesh in given)
    assert np.array_equal(plain.sphere, floats.sphere)
