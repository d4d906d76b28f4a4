"""The discrete harmonic map against closed forms, and that it is a minimum of the Dirichlet energy."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import apart, random_rotation, rms, turned
from test_conformal_map import conformal_latitude

import omtwarp
from omtwarp.conformal.centring import centre_points
from omtwarp.conformal.maps import covers_once
from omtwarp.geometry import cotangent_laplacian
from omtwarp.mesh.shapes import blob, icosphere, noisy, random_sphere, tube
from omtwarp.mesh.surface import Surface


@pytest.mark.parametrize("frequency", [2, 4, 8, 16, 32])
def test_a_sphere_stays_itself(frequency):
    ball = icosphere(frequency)
    found = omtwarp.harmonic_points(ball, device="cpu")
    assert found.converged
    assert np.degrees(apart(found.sphere, ball.vertices).max()) < (0.1 if frequency >= 4 else 0.3)


@pytest.mark.parametrize(
    "change",
    [
        lambda ball: turned(ball, 7),
        lambda ball: Surface(ball.vertices * 1e3 + [3e4, -2e4, 5.0], ball.faces),
        lambda ball: noisy(ball, 1e-9, seed=1),
    ],
    ids=["turned", "moved", "noise"],
)
def test_a_sphere_stays_itself_however_it_lies(change):
    ball = icosphere(8)
    found = omtwarp.harmonic_points(change(ball), device="cpu")
    assert np.degrees(apart(found.sphere, ball.vertices).max()) < 0.1


@pytest.mark.parametrize(("equator", "pole"), [(1.0, 0.6), (1.0, 1.6)], ids=["oblate", "prolate"])
def test_second_order_on_ellipsoids_of_revolution(equator, pole):
    """Where section 4.1's map is of first order: halving the edges divides the error by four."""
    errors = []
    for frequency in (6, 12, 24):
        sphere = turned(icosphere(frequency))
        surface = Surface(sphere.vertices * [equator, equator, pole], sphere.faces)
        found = omtwarp.harmonic_points(surface, device="cpu")
        errors.append(rms(apart(found.sphere, conformal_latitude(sphere.vertices, equator, pole))))
    assert errors[1] < 0.3 * errors[0] and errors[2] < 0.3 * errors[1]


def test_second_order_on_a_sphere_under_a_mobius_transformation():
    """Masses decide which of the conformal maps is centred: those of another map of the sphere undo its shift."""
    errors = []
    for frequency in (6, 12):
        ball = turned(icosphere(frequency))
        z = ball.vertices[:, 2]
        factor = 0.75 / (1.25 + z) ** 2  # of areas, under a boost along z with cosh 1.25 and sinh 1
        masses = factor[ball.faces].mean(axis=1) * ball.face_areas
        surface = ball.with_areas(masses)
        truth, _ = centre_points(ball.vertices, surface.vertex_areas)
        found = omtwarp.harmonic_points(surface, device="cpu")
        errors.append(rms(apart(found.sphere, truth)))
    assert errors[1] < 0.3 * errors[0]


def test_irregular_triangulations_of_a_sphere_are_second_order():
    errors = []
    for count in (1000, 4000, 16000):
        ball = random_sphere(count, seed=2)
        found = omtwarp.harmonic_points(ball, device="cpu")
        errors.append(rms(apart(found.sphere, ball.vertices)))
    assert errors[2] < 0.35 * errors[1] < 0.2 * errors[0]


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), amplitude=st.floats(0.1, 0.5))
def test_it_is_centred_and_no_small_move_lowers_the_energy(seed, amplitude):
    """The energy is recomputed here with the cotangents of the surface, whose triangles are all Delaunay."""
    surface = blob(seed=seed, amplitude=amplitude, sphere=320)
    found = omtwarp.harmonic_points(surface, device="cpu")
    np.testing.assert_allclose(surface.vertex_areas @ found.sphere, 0.0, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(found.sphere, axis=1), 1.0, atol=1e-14)
    energies = [record["energy"] for record in found.history]
    assert all(after < before for before, after in pairwise(energies))
    assert found.converged


def test_the_energy_is_that_of_the_cotangent_laplacian():
    surface = icosphere(8)  # all of its triangles are Delaunay
    found = omtwarp.harmonic_points(surface, device="cpu")
    laplacian = cotangent_laplacian(surface.scaled_vertices, surface.faces)
    assert found.history[-1]["energy"] == pytest.approx(0.5 * np.trace(found.sphere.T @ (laplacian @ found.sphere)))


def test_a_start_given_leads_to_the_same_points():
    surface = blob(seed=2, amplitude=0.3, sphere=1280)
    usual = omtwarp.harmonic_points(surface, device="cpu").sphere
    other = omtwarp.harmonic_points(surface, start=usual @ random_rotation(4).T, device="cpu").sphere
    assert apart(other, usual).max() < 1e-4


def test_points_that_would_collapse_onto_a_circle_stay_what_they_were():
    """A tube with few vertices around has no harmonic map of degree 1: the last triangles grow over the sphere."""
    surface = tube(length=15.0, girth=1.0, face_count=600)
    began = centre_points(omtwarp.conformal_map(surface, intrinsic=True, device="cpu").sphere, surface.vertex_areas)[0]
    found = omtwarp.harmonic_points(surface, device="cpu")
    assert found.collapsed and not found.converged and len(found.history) == 1
    np.testing.assert_array_equal(found.sphere, began)
    assert covers_once(found.sphere, surface.faces)


def test_a_map_covers_the_sphere_once_or_not():
    ball = icosphere(6)
    points = ball.vertices
    assert covers_once(points, ball.faces) and not covers_once(points * [1.0, 1.0, -1.0], ball.faces)
    aside = 0.1 * points + [1.0, 0.0, 0.0]
    assert not covers_once(aside / np.linalg.norm(aside, axis=1, keepdims=True), ball.faces)
    scattered = np.random.default_rng(1).permutation(points)  # whatever its degree, most of it is turned over
    assert not covers_once(scattered, ball.faces)
    few = points.copy()
    few[5] = ball.vertices[ball.faces[0]].mean(axis=0) / np.linalg.norm(ball.vertices[ball.faces[0]].mean(axis=0))
    assert covers_once(few, ball.faces)  # a few flips are no matter


def test_wrong_starts_are_refused():
    surface = icosphere(4)
    with pytest.raises(omtwarp.OmtwarpError):
        omtwarp.harmonic_points(surface, start=surface.vertices[1:], device="cpu")
