"""Moser's flow against its closed form for an axisymmetric density, and area kept on surfaces."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import cumulative_trapezoid
from sphere_truths import height_and_longitude, mean_edge, pushed_north, random_rotation, rms, turned

from omtwarp.conformal import conformal_map
from omtwarp.device.start import wp
from omtwarp.geometry import cotangent_laplacian
from omtwarp.mesh.shapes import blob, demo_shape, icosphere, random_sphere
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.metrics import measure_triangles
from omtwarp.moser import moser_map
from omtwarp.solvers.poisson import LaplacianSolver, cotangent_solver


def potential_of_latitude(heights: np.ndarray, amount: float) -> np.ndarray:
    """Θ at image heights w for :func:`pushed_north`, up to a constant.

    Integrating ΔΘ = 1 - μ over the cap below w gives (1 - w²) Θ' = w - z(w), with z the height before the push.
    """
    w = np.sin(np.linspace(-np.pi / 2, np.pi / 2, 20_001))[1:-1]
    z = (1.0 - np.sqrt(1.0 - 2.0 * amount * w + amount * amount)) / amount
    theta = cumulative_trapezoid((w - z) / (1.0 - w * w), w, initial=0.0)
    return np.interp(heights, w, theta)


@pytest.mark.parametrize("amount", [0.3, 0.6])
def test_axisymmetric_density_in_closed_form(device, amount):
    """The flow keeps the mass below a particle: (1 - t) M(w) + t (w + 1) is constant on its path, so at t = 1 the
    particle is where the monotone rearrangement in latitude puts it, back on the sphere it came from.

    Fields are linear on triangles, so both the path and Θ are exact to second order in their size.
    """
    moved, potentials = [], []
    for frequency in (8, 16):
        surface = turned(icosphere(frequency))
        start = pushed_north(surface.vertices, amount)
        flowed = moser_map(surface, start, device=device)
        error = np.linalg.norm(flowed.sphere - surface.vertices, axis=1)
        edge = mean_edge(surface, surface.vertices)
        assert np.linalg.norm(start - surface.vertices, axis=1).max() > 0.4 * amount
        assert error.max() < 0.25 * amount * edge**2 / 0.5
        moved.append(rms(error))
        truth = potential_of_latitude(height_and_longitude(start)[0], amount)
        potentials.append(np.ptp(flowed.potential - truth) / np.ptp(truth))
        assert measure_triangles(surface.vertices, surface.faces, flowed.sphere).area["surface"] < 2.0 + 1e-4
    assert moved[1] < 0.3 * moved[0]
    assert potentials[0] < 0.01
    assert potentials[1] < 0.35 * potentials[0]


def test_a_uniform_sphere_stays_where_it_is(device):
    """The flow leaves a uniform sphere where it is."""
    surface = random_sphere(1200, seed=2)
    flowed = moser_map(surface, surface.vertices, device=device)
    np.testing.assert_allclose(flowed.sphere, surface.vertices, atol=1e-12)
    assert np.abs(flowed.potential).max() < 1e-12


def test_area_error_vanishes_under_refinement(device):
    """The area error falls to second order in the edges, for a conformal map with areas wrong by factors of 10."""
    excess = []
    for faces in (1280, 5120):
        surface = blob(seed=2, amplitude=0.35, degree=5, sphere=faces)
        start = conformal_map(surface, device=device)
        flowed = moser_map(surface, start.sphere, device=device)
        judged = measure_triangles(surface.vertices, surface.faces, flowed.sphere)
        assert judged.degree == pytest.approx(1.0, abs=1e-9)
        excess.append(judged.area["surface"] - 2.0)
    assert measure_triangles(surface.vertices, surface.faces, start.sphere).area["surface"] > 4.0
    assert excess[1] < 0.005
    assert excess[1] < excess[0] / 3.0


def test_a_factorisation_handed_in_is_used():
    """The image's own matrix gives the same map, to the bit where the same code factorised it; the surface's, which is
    equal for a conformal image but for the triangles around the pole, nearly the same map."""
    surface = blob(seed=3, amplitude=0.25, degree=4, sphere=2560)
    start = conformal_map(surface)
    own = moser_map(surface, start.sphere).sphere
    solver = cotangent_solver(surface, start.sphere)
    np.testing.assert_array_equal(moser_map(surface, start.sphere, solver=solver).sphere, own)
    general = LaplacianSolver(cotangent_laplacian(start.sphere, surface.faces))
    np.testing.assert_allclose(moser_map(surface, start.sphere, solver=general).sphere, own, atol=1e-9)
    lent = moser_map(surface, start.sphere, solver=start.solver).sphere
    moved = rms(np.linalg.norm(own - start.sphere, axis=1))
    assert 0.0 < rms(np.linalg.norm(lent - own, axis=1)) < 0.1 * moved


def test_the_triangle_that_a_vertex_begins_in_does_not_matter():
    """Paths from tiny triangles, and from corners where many meet, do not depend on the triangle they begin in."""
    surface = demo_shape(2000)
    start = conformal_map(surface, device="cpu").sphere
    one = moser_map(surface, start, device="cpu").sphere
    rng = np.random.default_rng(0)
    shuffled = Surface(surface.vertices, surface.faces[rng.permutation(surface.face_count)])
    np.testing.assert_allclose(moser_map(shuffled, start, device="cpu").sphere, one, atol=1e-7)
    near = start + 1e-13 * rng.normal(size=start.shape)
    near /= np.linalg.norm(near, axis=1)[:, None]
    np.testing.assert_allclose(moser_map(surface, near, device="cpu").sphere, one, atol=1e-7)
    assert triangle_areas(start, surface.faces).min() < 1e-7


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), amount=st.floats(-0.8, 0.8))
def test_turning_the_start_turns_the_map(seed, amount):
    """Rotating the start rotates the map, up to round-off."""
    surface = turned(icosphere(5), seed)
    start = pushed_north(surface.vertices, amount)
    rotation = random_rotation(seed + 1)
    one = moser_map(surface, start).sphere
    other = moser_map(surface, start @ rotation.T).sphere
    assert np.isfinite(one).all()
    np.testing.assert_allclose(np.linalg.norm(one, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(other, one @ rotation.T, atol=1e-9)


def test_the_same_bits_twice():
    surface = blob(seed=2, sphere=1280)
    start = conformal_map(surface)
    one = moser_map(surface, start.sphere, solver=start.solver)
    two = moser_map(surface, start.sphere, solver=start.solver)
    np.testing.assert_array_equal(one.sphere, two.sphere)
    assert one.steps == two.steps


def test_all_particles_go_all_their_way_in_one_launch(device, monkeypatch):
    monkeypatch.setenv("OMTWARP_THREADS", "1")  # else one for every core of a CPU
    surface = turned(icosphere(6))
    launched = []
    launch = wp.launch

    def note(kernel, *arguments, **named):
        launched.append(kernel.key)
        return launch(kernel, *arguments, **named)

    solver = cotangent_solver(surface, surface.vertices)
    monkeypatch.setattr(wp, "launch", note)
    flowed = moser_map(surface, pushed_north(surface.vertices, 0.3), solver=solver, device=device)
    assert flowed.steps > 10
    assert launched.count("vertex_field") == launched.count("integrate_particles") == 1
