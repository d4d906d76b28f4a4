"""Certificates of maps that are, and are not, bijections."""

import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import pushed_north, random_rotation, turned, twisted

from omtwarp.flips.exact import orientation_signs
from omtwarp.mesh.shapes import fibonacci_sphere, icosphere, random_sphere, uv_sphere
from omtwarp.metrics.certificate import RAYS, certify_triangles


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), clustering=st.floats(0.0, 3.0))
def test_embedded_spheres_are_certified(seed, clustering):
    """A convex hull around the centre is a bijection, whatever its triangles look like."""
    surface = random_sphere(300, seed, clustering)
    certificate = certify_triangles(surface.faces, surface.vertices)
    assert certificate.bijective
    assert (certificate.flips, certificate.first_flip, certificate.degree, certificate.ray_degree) == (0, -1, 1, 1)
    assert certificate.rays == RAYS


def test_smallest_triangle(device):
    surface = random_sphere(300, 5)
    certificate = certify_triangles(surface.faces, surface.vertices, device=device)
    corners = surface.vertices[surface.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert certificate.smallest_face == areas.argmin()
    assert certificate.smallest_area == pytest.approx(4 * np.pi * areas.min() / areas.sum(), rel=1e-12)


def test_turned_inside_out(device):
    surface = turned(icosphere(4))
    certificate = certify_triangles(surface.faces[:, ::-1], surface.vertices, device=device)
    assert not certificate.bijective
    assert (certificate.flips, certificate.degree, certificate.ray_degree) == (surface.face_count, -1, -1)
    assert certificate.first_flip == 0


def test_folded_once_has_degree_one_and_flips(device):
    """A vertex pulled far over its neighbours: the sphere is still covered once in sum, but not one to one."""
    surface = turned(icosphere(5))
    sphere = surface.vertices.copy()
    sphere[100] = -sphere[100]
    certificate = certify_triangles(surface.faces, sphere, device=device)
    truth = np.flatnonzero(np.linalg.det(sphere[surface.faces]) <= 0)
    assert certificate.flips == len(truth) > 0
    assert certificate.first_flip == truth[0]
    assert certificate.degree == certificate.ray_degree
    assert not certificate.bijective


@pytest.mark.parametrize("power", [2, 3])
def test_covered_several_times(device, power):
    """w -> w² wraps the sphere around twice: all triangles but those at the poles are positive, the degree is 2."""
    surface = turned(icosphere(24))
    z, longitude = surface.vertices[:, 2], np.arctan2(surface.vertices[:, 1], surface.vertices[:, 0])
    radius = np.sqrt(1 - z * z)
    sphere = np.stack([radius * np.cos(power * longitude), radius * np.sin(power * longitude), z], axis=1)
    certificate = certify_triangles(surface.faces, sphere, device=device)
    assert certificate.degree == certificate.ray_degree == power
    assert not certificate.bijective


def test_triangles_without_area_are_flips():
    surface = turned(icosphere(3))
    sphere = surface.vertices.copy()
    a, b, _ = surface.faces[7]
    sphere[a] = sphere[b]
    certificate = certify_triangles(surface.faces, sphere)
    assert certificate.flips == 2  # both triangles at that edge
    assert certificate.degree == certificate.ray_degree == 1
    assert certificate.smallest_area == 0.0
    assert not certificate.bijective


def test_triangles_wider_than_a_quarter_of_the_sphere(device):
    """The degree is right for a flat pyramid of three triangles whose corners are 120 degrees apart."""
    turn = 2 * np.pi * np.arange(3) / 3
    for z in (-0.6, -0.05, 0.05, 0.6, 0.95):
        rim = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), 0 * turn + z], axis=1)
        sphere = np.concatenate([rim, [[0.0, 0.0, 1.0]]]) @ random_rotation(2).T
        faces = np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]], dtype=np.int32)
        certificate = certify_triangles(faces, sphere, device=device)
        # With the rim in the south the fourth triangle is the cap below it; in the north it is turned over.
        assert certificate.degree == certificate.ray_degree == (1 if z < 0 else 0)
        assert certificate.flips == (0 if z < 0 else 1)
        assert certificate.bijective == (z < 0)


def test_everything_in_one_point_has_no_degree():
    surface = icosphere(2)
    certificate = certify_triangles(surface.faces, np.tile([0.6, 0.0, 0.8], (surface.vertex_count, 1)))
    assert certificate.flips == surface.face_count
    assert certificate.degree == 0
    assert not certificate.bijective


def test_a_flip_smaller_than_rounding_is_found():
    """A vertex on the great circle through its opposite edge, up to the last bit: decided exactly."""
    surface = fibonacci_sphere(200)
    rng = np.random.default_rng(1)
    sphere = surface.vertices.copy()
    a, b, c = surface.faces[50]
    middle = 0.3 * sphere[b] + 0.7 * sphere[c]
    sphere[a] = middle / np.linalg.norm(middle)
    for _ in range(20):
        sphere[a] = np.nextafter(sphere[a], rng.choice([-2.0, 2.0], 3))
        certificate = certify_triangles(surface.faces, sphere)
        assert certificate.flips == (orientation_signs(sphere, surface.faces) <= 0).sum()
        assert certificate.degree == 1


def test_bijections_of_other_kinds_are_certified():
    surface = turned(fibonacci_sphere(2000))
    for sphere in (pushed_north(surface.vertices, 0.7), twisted(surface.vertices, 0.5)):
        assert certify_triangles(surface.faces, sphere).bijective


def test_turning_everything_changes_nothing():
    surface = random_sphere(300, 3)
    one = certify_triangles(surface.faces, surface.vertices)
    other = certify_triangles(surface.faces, surface.vertices @ random_rotation(0).T)
    assert (one.degree, one.ray_degree, one.flips) == (other.degree, other.ray_degree, other.flips)
    assert one.smallest_area == pytest.approx(other.smallest_area, rel=1e-9)


def test_is_json():
    surface = icosphere(2)
    text = json.dumps(certify_triangles(surface.faces, surface.vertices).to_dict())
    assert json.loads(text)["bijective"] is True


def test_a_branched_covering_without_flips_is_no_bijection(device):
    """Longitudes doubled: every triangle is positive, the two poles' rings turn twice."""
    surface = uv_sphere(7, 24)
    x, y, z = surface.vertices.T
    radius, longitude = np.hypot(x, y), 2.0 * np.arctan2(y, x)
    sphere = np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], axis=1) @ random_rotation(4).T
    certificate = certify_triangles(surface.faces, sphere, device=device)
    assert (certificate.flips, certificate.wound, certificate.degree) == (0, 2, 2)
    assert abs(surface.vertices[certificate.first_wound, 2]) == 1.0
    assert not certificate.bijective
    assert "2 rings" in str(certificate)
