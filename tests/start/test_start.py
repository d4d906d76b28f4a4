"""The map that transport starts from: conformal where it can be, a bijection everywhere."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import apart, at_height, height_and_longitude, rms

import omtwarp
from omtwarp.conformal.maps import covers_once, harmonic_points
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import count_flips
from omtwarp.mesh.shapes import blob, flip_edges, icosphere, limbs, needle, noisy, plate, random_sphere, tube
from omtwarp.metrics.certificate import certify_triangles
from omtwarp.start import choice as start_module
from omtwarp.start.choice import bijective_start


def test_a_sound_conformal_map_is_taken_as_it_is(device):
    surface = blob(seed=3, amplitude=0.25, sphere=1280)
    start = bijective_start(surface, device=device)
    assert (start.route, start.reason, start.repaired_flips) == ("conformal", "", 0)
    np.testing.assert_array_equal(start.sphere, harmonic_points(surface, device=device).sphere)


def test_a_few_flips_are_repaired_and_the_rest_stays():
    surface = flip_edges(blob(seed=1, amplitude=0.3, sphere=1280), rounds=6, seed=2)
    conformal = harmonic_points(surface).sphere
    flips = count_flips(conformal, surface.faces)
    assert 0 < flips < 0.02 * surface.face_count  # a case for repair
    start = bijective_start(surface)
    assert start.route == "conformal, repaired"
    assert start.repaired_flips == flips
    assert certify_triangles(surface.faces, start.sphere).bijective
    moved = (start.sphere != conformal).any(axis=1)
    assert 0 < moved.sum() < 0.25 * surface.vertex_count  # the patches around the flips alone


@pytest.mark.parametrize("length", [12.0, 30.0])
def test_long_tubes_take_another_road(length):
    """A tube's ends shrink to exp(-length / girth) of its middle: areas of 1e-11 can be held, areas of 1e-26 cannot."""
    surface = tube(length=length, girth=1.0, face_count=1500)
    start = bijective_start(surface)
    assert certify_triangles(surface.faces, start.sphere).bijective
    if length < 20.0:
        assert start.route == "conformal"
        return
    assert start.route == "hierarchical"
    assert "shrinks" in start.reason


@pytest.mark.parametrize(
    ("frequency", "instead"), [(6, "harmonic map made from an"), (12, "coarse-to-fine embedding is")]
)
def test_a_sphere_stretched_to_a_needle_is_mapped_from_points_that_cover_the_sphere(frequency, instead):
    """Triangles 25 times as long as high: section 4.1's map covers the sphere twice or not at all."""
    ball = icosphere(frequency)
    surface = omtwarp.Surface(ball.vertices * [1.0, 1.0, 25.0], ball.faces)
    result = omtwarp.map_to_sphere(surface, device="cpu")
    assert instead in result.report["start"]["reason"]
    assert covers_once(result.source, surface.faces)
    assert result.distortion().area["surface"] < 2.005 and result.report["optimality"]["gap"] < 0.01
    assert result.report["warnings"] == []


@pytest.mark.parametrize("length", [15.0, 25.0])
def test_tubes_whose_harmonic_map_collapses_end_at_the_optimum(length):
    """Their gaps were infinite, and areas off by 2.3, as long as transport began on a circle."""
    surface = tube(length=length, girth=1.0, face_count=600)
    result = omtwarp.map_to_sphere(surface, device="cpu")
    assert "the harmonic map collapses" in result.report["start"]["reason"]
    assert result.certificate.bijective and result.report["optimality"]["gap"] < 0.01
    assert result.distortion().area["surface"] < 2.1


def test_a_long_tube_of_obtuse_triangles_is_embedded_coarse_to_fine():
    surface = flip_edges(tube(length=30.0, girth=1.0, face_count=1500), rounds=8, seed=1)
    start = bijective_start(surface)
    assert start.route == "hierarchical"
    assert certify_triangles(surface.faces, start.sphere).bijective


SHAPES = {
    "needle": lambda: needle(15.0, 1280),
    "plate": lambda: plate(face_count=1280),
    "limbs": lambda: limbs(length=3.0, sharpness=40.0, sphere=1280),
    "noise": lambda: noisy(icosphere(8), 0.5, seed=1),
    "obtuse": lambda: flip_edges(random_sphere(1000, 4), rounds=20, seed=4),
    "bent": lambda: tube(length=6.0, girth=1.0, bend=2.0, taper=0.4, face_count=1200),
}


@pytest.mark.parametrize("name", SHAPES)
def test_hard_shapes_have_a_bijective_start(name):
    surface = SHAPES[name]()
    start = bijective_start(surface)
    assert np.isfinite(start.sphere).all()
    assert certify_triangles(surface.faces, start.sphere).bijective


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), amplitude=st.floats(0.1, 0.6), rounds=st.integers(0, 6))
def test_random_blobs_have_a_bijective_start(seed, amplitude, rounds):
    surface = flip_edges(blob(seed=seed, amplitude=amplitude, sphere=random_sphere(400, seed)), rounds, seed)
    start = bijective_start(surface)
    assert certify_triangles(surface.faces, start.sphere).bijective
    np.testing.assert_allclose(np.linalg.norm(start.sphere, axis=1), 1.0, atol=1e-14)


def test_a_conformal_map_that_cannot_be_made_has_a_substitute(monkeypatch):
    def fails(surface, *, device, progress):
        raise OmtwarpError("the plane has a hole")

    monkeypatch.setattr(start_module, "harmonic_points", fails)
    surface = blob(seed=0, sphere=320)
    told = []
    start = bijective_start(surface, progress=lambda *arguments: told.append(arguments))
    assert (start.route, start.reason, start.points) == ("hierarchical", "the plane has a hole", None)
    assert certify_triangles(surface.faces, start.sphere).bijective
    assert told and all(stage == "start" and 0 <= done <= total for stage, done, total, _ in told)


def test_the_same_bits_twice():
    surface = tube(length=8.0, girth=1.0, face_count=800)
    np.testing.assert_array_equal(bijective_start(surface).sphere, bijective_start(surface).sphere)


@pytest.mark.parametrize(("length", "faces"), [(8.0, 4000), (10.0, 10000)])
def test_long_triangles_do_not_fold_the_points(length, faces):
    """On an ellipsoid of long triangles the mesh's own weights flip 15 % and more; the points keep its closed form.

    A conformal map of a surface of revolution to the sphere keeps longitude, and tanh of the integral of ds / r is the
    height: s along the meridian, r from the axis.
    """
    surface = needle(length, face_count=faces)
    assert count_flips(omtwarp.conformal_map(surface).sphere, surface.faces) > 0.1 * surface.face_count
    start = bijective_start(surface)
    assert start.route.startswith("conformal")
    points = surface.vertices / np.abs(surface.vertices).max(axis=0)  # of the unit sphere, with the long axis along z
    colatitude = np.linspace(1e-6, np.pi - 1e-6, 400_001)
    stretch = np.hypot(np.cos(colatitude), length * np.sin(colatitude)) / np.sin(colatitude)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (stretch[1:] + stretch[:-1]) * np.diff(colatitude))])
    z, longitude = height_and_longitude(points)
    height = np.tanh(np.interp(np.arccos(np.clip(z, -1.0, 1.0)), colatitude, 0.5 * integral[-1] - integral))
    assert rms(apart(start.points, at_height(height, longitude))) < 0.01


@pytest.mark.parametrize(
    "surface", [needle(8.0, face_count=4000), plate(8.0, 3.0, 0.1, face_count=3000)], ids=["needle", "plate"]
)
def test_maps_of_long_triangles_end_at_the_optimum(surface):
    found = omtwarp.map_to_sphere(surface, device="cpu")
    assert found.report["optimality"]["gap"] < 1e-3
    stage = next(stage for stage in found.report["stages"] if stage["name"] == "omt")
    assert stage["converged"] and stage["area"]["surface"] < 2.006
