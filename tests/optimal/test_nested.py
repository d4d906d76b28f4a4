"""The road to the optimal map: the coarse triangulation, the law of the shape term, and where it leads."""

import sys
from pathlib import Path

import numpy as np
import pytest
from sphere_truths import apart, random_rotation, turned

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import count_flips
from omtwarp.mesh.shapes import blob, icosphere, noisy, random_sphere, tube
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.open_surfaces.hemisphere import mirror_frame, symmetrised
from omtwarp.open_surfaces.symmetric import ACROSS
from omtwarp.optimal.nested import coarse_surface, embedded_start, nested_start, shape_term
from omtwarp.topology.closing import double

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from random_shapes import random_shape


@pytest.fixture(scope="module")
def shape():
    surface = blob(seed=4, amplitude=0.4, sphere=5120)
    return surface, omtwarp.harmonic_points(surface, device="cpu").sphere


def test_the_coarse_triangulation_is_a_delaunay_sphere_with_the_whole_mass(shape):
    surface, points = shape
    found = coarse_surface(surface, points)
    coarse, carried = found.surface, found.carried
    assert coarse.vertex_count < surface.vertex_count / 4
    assert len(coarse.faces) == 2 * coarse.vertex_count - 4
    assert coarse.face_areas.sum() == pytest.approx(SPHERE_AREA)
    # No vertex lies inside the circle of a triangle: the plane of each has all others on one side.
    a, b, c = (coarse.vertices[coarse.faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    heights = normals @ coarse.vertices.T - (normals * a).sum(axis=1, keepdims=True)
    assert heights.max() < 1e-12
    # The identity is carried to where the points are, up to the second order of the coarse triangles.
    assert np.linalg.norm(carried(coarse.vertices) - points, axis=1).max() < 0.1


def test_the_choice_of_coarse_vertices_follows_the_shape(shape):
    surface, points = shape
    rng = np.random.default_rng(0)
    order = rng.permutation(surface.vertex_count)
    rotation = random_rotation(3)
    other = Surface(surface.vertices[order] @ rotation.T + 5.0, np.argsort(order)[surface.faces])
    one, two = coarse_surface(surface, points).surface, coarse_surface(other, points[order]).surface
    assert one.vertex_count == two.vertex_count
    np.testing.assert_allclose(np.sort(one.vertices[:, 0]), np.sort(two.vertices[:, 0]), atol=1e-12)


def test_the_coarse_triangulation_of_a_double_has_both_of_its_halves():
    """A copy lies where the surface does: a grid that took one of the two would leave half of the sphere empty."""
    ball = icosphere(12)
    cap = ball.faces[(ball.vertices[ball.faces, 2] > -0.4).all(axis=1)]
    used, faces = np.unique(cap, return_inverse=True)
    whole = double(ball.vertices[used], faces.reshape(-1, 3))
    surface = Surface(whole.vertices, whole.faces)
    points = omtwarp.harmonic_points(surface, device="cpu").sphere
    points = symmetrised(whole, points @ mirror_frame(whole, points, surface.vertex_areas))
    found = coarse_surface(surface, points, mirror=whole.mirror)
    coarse, carried = found.surface, found.carried
    assert len(coarse.faces) == 2 * coarse.vertex_count - 4
    np.testing.assert_allclose(np.unique(coarse.vertices, axis=0), np.unique(coarse.vertices * ACROSS, axis=0))
    assert np.linalg.norm(carried(coarse.vertices) - points, axis=1).max() < 0.1


def test_angles_weigh_the_same_share_of_the_cost_on_every_surface(shape):
    """The share is 3 %, whatever the size of the surface and however far its points move."""
    surface, points = shape
    shares = []
    for flow in (0.0, 1.0):
        moved = (
            omtwarp.moser_map(surface, points, device="cpu").sphere if flow else omtwarp.map_to_sphere(surface).sphere
        )
        term = shape_term(surface, moved, points, "cpu")
        cost = omtwarp.transport_cost(surface, moved, start=points, device="cpu") / SPHERE_AREA
        angle = omtwarp.distortion(surface, moved, device="cpu").angle["surface"]
        shares.append(term.weight * (angle - 2.0) / cost)
        assert term.area == pytest.approx(8.0 * np.sqrt(angle - 2.0), rel=0.02)
    assert shares == pytest.approx([0.03, 0.03], rel=0.02)


def test_a_nested_start_is_a_bijection_near_the_optimum(shape):
    surface, _ = shape
    found = omtwarp.map_to_sphere(surface, device="cpu")
    start = nested_start(surface, found.source, device="cpu")
    assert count_flips(start, surface.faces) == 0
    weights = surface.vertex_areas / SPHERE_AREA
    assert np.sqrt(weights @ ((start - found.sphere) ** 2).sum(axis=1)) < 0.05


def test_points_that_coincide_have_no_coarse_triangulation():
    surface = tube(length=40.0, girth=1.0, face_count=1500)
    points = omtwarp.harmonic_points(surface, device="cpu").sphere
    with pytest.raises(OmtwarpError):
        nested_start(surface, np.tile(points[:1], (len(points), 1)), device="cpu")
    start = embedded_start(surface, points, device="cpu")
    assert count_flips(start, surface.faces) == 0


def test_triangulations_of_an_embedding_lead_nearer_to_the_optimum():
    """A serpent's conformal points coincide: its embedding is optimised from coarse to fine."""
    _, serpent = random_shape(315, 8000)
    found = omtwarp.map_to_sphere(serpent, device="cpu")
    assert next(stage for stage in found.report["stages"] if stage["name"] == "omt")["road"] == "embedded"
    surface = omtwarp.Surface(found.vertices, found.faces)
    weights = surface.vertex_areas / SPHERE_AREA
    away = []
    for alone in (False, True):  # the map of a double is turned back on the surface alone
        start = embedded_start(surface, found.source, double=alone, device="cpu")
        assert count_flips(start, surface.faces) == 0
        away.append(np.sqrt(weights @ ((start - found.sphere) ** 2).sum(axis=1)))
    assert away[0] < 0.8 * away[1] and away[0] < 0.12


@pytest.mark.parametrize("frequency", [8, 16])
@pytest.mark.parametrize("change", [lambda s: s, turned, lambda s: noisy(s, 1e-9)], ids=["itself", "turned", "noise"])
def test_a_sphere_stays_itself(frequency, change):
    ball = icosphere(frequency)
    result = omtwarp.map_to_sphere(change(ball), device="cpu")
    measured = result.distortion()
    assert max(measured.area["surface"], measured.angle["surface"]) < 2.00005
    assert np.degrees(apart(result.sphere, ball.vertices).max()) < 0.1


def test_an_irregular_sphere_stays_itself_to_second_order():
    errors = []
    for count in (2000, 8000):
        ball = random_sphere(count, seed=3)
        errors.append(float(apart(omtwarp.map_to_sphere(ball, device="cpu").sphere, ball.vertices).mean()))
    assert errors[1] < 0.4 * errors[0]
