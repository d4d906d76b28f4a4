"""The discrete optimal map: derivatives, closed forms, one optimum from every start, and its tolerances."""

from functools import partial

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

import omtwarp
from omtwarp import OmtwarpError
from omtwarp.conformal import conformal_map
from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.flips.exact import is_bijective
from omtwarp.mesh.shapes import blob, ellipsoid, icosphere, noisy
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.metrics.optimality import optimality, relative_curl
from omtwarp.moser import moser_map
from omtwarp.optimal import GAIN, optimal_map
from omtwarp.optimal.solver import minimise
from omtwarp.optimal.sphere import energy_on_sphere

CPU = resolve_device("cpu")


def stretched(level: int, factor: float = 1.6) -> Surface:
    """Make a spheroid whose axis is no axis of the icosphere that it is made from."""
    ball = icosphere(level)
    turn = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    return Surface((ball.vertices @ turn) * [1.0, 1.0, factor], ball.faces)


def tangent_step(points, size, seed):
    step = np.random.default_rng(seed).normal(size=points.shape) * size
    return step - (step * points).sum(1, keepdims=True) * points


def moved(points, step):
    out = points + step
    return out / np.linalg.norm(out, axis=1, keepdims=True)


@pytest.fixture(scope="module", params=[0.0, 0.05], ids=["squared", "soft distance"])
def energy_and_map(request):
    surface = blob(seed=3, amplitude=0.25, degree=4, sphere=320)
    x = conformal_map(surface, device="cpu").sphere
    y = moser_map(surface, x, device="cpu").sphere
    return energy_on_sphere(surface, vectors(x, CPU), CPU, shape_weight=0.02, softness=request.param), y


def test_gradient_is_the_derivative(energy_and_map):
    energy, y = energy_and_map
    multipliers = wp.array(np.random.default_rng(0).normal(size=len(y)) * 0.1, device="cpu")

    def value(points):
        return energy.lagrangian(energy.terms(vectors(points, CPU), multipliers))

    gradient = energy.gradient(vectors(y, CPU), energy.terms(vectors(y, CPU)), multipliers).numpy()
    assert np.abs((gradient * y).sum(axis=1)).max() < 1e-12  # tangent
    for seed in range(3):
        step = tangent_step(y, 1e-5, seed)
        difference = (value(moved(y, step)) - value(moved(y, -step))) / 2
        assert difference == pytest.approx(float((gradient * step).sum()), rel=1e-6, abs=1e-12)


def test_couplings_are_derivatives_of_the_areas(energy_and_map):
    energy, y = energy_and_map
    surface = energy.surface
    points = vectors(y, CPU)
    energy.blocks(points, energy.terms(points))
    couplings = energy.matrix.slopes.numpy().reshape(2, -1, 2)
    axis = np.zeros_like(y)
    axis[np.arange(len(y)), np.abs(y).argmin(axis=1)] = 1.0
    first = np.cross(y, axis) / np.linalg.norm(np.cross(y, axis), axis=1)[:, None]
    step = tangent_step(y, 1e-5, 1)
    coordinates = np.stack([(step * first).sum(1), (step * np.cross(y, first)).sum(1)], axis=1)
    i, j = surface.edges.T
    change = np.bincount(i, (couplings[0] * coordinates[j]).sum(1), len(y))
    change += np.bincount(j, (couplings[1] * coordinates[i]).sum(1), len(y))
    ahead, behind = (energy.terms(vectors(moved(y, s * step), CPU)).areas.numpy() for s in (1, -1))
    np.testing.assert_allclose((ahead - behind) / 2, change, atol=1e-10)


def spheroid_maps(surface: Surface, a: float = 1.0, c: float = 1.6):
    """The conformal and the optimal map of a spheroid: latitudes by quadrature and by area, longitude as it is."""
    z, longitude = surface.vertices[:, 2], np.arctan2(surface.vertices[:, 1], surface.vertices[:, 0])
    e = np.sqrt(1.0 - (a / c) ** 2)

    def area_below(height):  # from the equator, up to a factor
        s = e * height / c
        return s * np.sqrt(1.0 - s**2) + np.arcsin(s)

    # Isometric latitude: the integral of arc length over distance to the axis along a meridian (a cos t, c sin t).
    grid = 0.5 * np.pi * (1.0 - (1.0 - np.linspace(0.0, 1.0, 200001)) ** 2) * (1.0 - 1e-9)
    slope = np.hypot(a * np.sin(grid), c * np.cos(grid)) / (a * np.cos(grid))
    isometric = cumulative_trapezoid(slope, grid, initial=0.0)
    t = np.arcsin(np.clip(z / c, -1.0, 1.0))
    conformal = np.tanh(np.sign(t) * np.interp(np.abs(t), grid, isometric))

    def at(height):
        width = np.sqrt(1.0 - height**2)
        return np.stack([width * np.cos(longitude), width * np.sin(longitude), height], axis=1)

    return at(conformal), at(area_below(z) / area_below(c))


def spheroid_error(level: int) -> tuple[float, float]:
    """Errors of map (root mean square, radians) and of the mean squared distance on a spheroid."""
    surface = stretched(level)
    x, exact = spheroid_maps(surface)
    found = optimal_map(surface, moser_map(surface, x, device="cpu").sphere, start=x, gain=1e-6, device="cpu")
    assert found.converged
    weights = surface.vertex_areas / surface.vertex_areas.sum()
    error = np.sqrt((weights * ((found.sphere - exact) ** 2).sum(axis=1)).sum())
    cost = (weights * np.arccos(np.clip((x * exact).sum(axis=1), -1.0, 1.0)) ** 2).sum()
    return float(error), float(abs(found.history[-1]["cost"] / (4.0 * np.pi) - cost))


def test_spheroids_converge_at_second_order():
    coarse, fine = spheroid_error(8), spheroid_error(16)
    assert fine[0] < coarse[0] / 3.5 and fine[0] < 1e-4
    assert fine[1] < coarse[1] / 3.5 and fine[1] < 2e-5


def mean_distance(surface, x, y):
    angles = 2.0 * np.arcsin(0.5 * np.linalg.norm(x - y, axis=1))
    return float(surface.vertex_areas @ angles / surface.vertex_areas.sum())


def test_the_mean_distance_on_a_spheroid_is_what_crosses_the_parallels():
    """Mass moves along meridians: the least mean distance is the mass that crosses each parallel, over all of them."""
    surface = stretched(12)
    x, exact = spheroid_maps(surface)
    angle = 0.4 * exact[:, 2]  # turning each parallel keeps areas
    cosine, sine = np.cos(angle), np.sin(angle)
    twisted = np.stack([cosine * exact[:, 0] - sine * exact[:, 1], sine * exact[:, 0] + cosine * exact[:, 1]], axis=1)
    start = np.column_stack([twisted, exact[:, 2]])
    found = optimal_map(surface, start, start=x, cost="geodesic", shape_weight=0.001, device="cpu")
    assert found.converged
    colatitude = np.linspace(0.0, np.pi, 4001)
    order = np.argsort(x[:, 2])
    below = np.cumsum(surface.vertex_areas[order]) - 0.5 * surface.vertex_areas[order]
    share = 1.0 - np.interp(np.cos(colatitude), x[order, 2], below / surface.vertex_areas.sum())
    crossing = np.abs(share - 0.5 * (1.0 - np.cos(colatitude)))
    least = float(np.sum(0.5 * (crossing[1:] + crossing[:-1]) * np.diff(colatitude)))
    assert mean_distance(surface, x, start) > 1.3 * least
    assert mean_distance(surface, x, found.sphere) == pytest.approx(least, rel=0.01)


def test_the_optimal_map_of_the_distance_has_less_of_it_and_a_gradient_for_direction():
    surface = blob(seed=4, amplitude=0.3, degree=4, sphere=1280)
    x = conformal_map(surface, device="cpu").sphere
    y = moser_map(surface, x, device="cpu").sphere
    squared = optimal_map(surface, y, start=x, shape_weight=0.003, device="cpu")
    found = optimal_map(surface, squared.sphere, start=x, shape_weight=0.001, cost="geodesic", device="cpu")
    assert found.converged and found.history[-1]["ring_rms"] < 2e-4
    assert is_bijective(found.sphere, surface.faces)
    assert mean_distance(surface, x, found.sphere) < 0.96 * mean_distance(surface, x, squared.sphere)
    before, after = (
        relative_curl(surface, sphere, start=x, cost="geodesic", device="cpu")
        for sphere in (squared.sphere, found.sphere)
    )
    assert after < 0.5 * before


def test_keeps_areas_cost_and_orientation_at_once():
    shape = blob(seed=7, amplitude=0.3, degree=6, sphere=5120)
    x = conformal_map(shape, device="cpu").sphere
    start = moser_map(shape, x, device="cpu").sphere
    found = optimal_map(shape, start, start=x, shape_weight=0.001, device="cpu")
    assert found.converged and found.ended == "optimal"
    assert is_bijective(found.sphere, shape.faces)
    assert found.history[-1]["ring_rms"] < 2e-4 and found.history[-1]["ring_largest"] < 5e-3
    # The same bits again.
    again = optimal_map(shape, start, start=x, shape_weight=0.001, device="cpu")
    np.testing.assert_array_equal(again.sphere, found.sphere)
    measured = optimality(shape, found.sphere, start=x, device="cpu")
    assert measured.gap < 1e-3 and measured.relative_curl < 0.03


def test_one_optimum_from_two_starts():
    surface = blob(seed=11, amplitude=0.3, degree=5, sphere=1280)
    x = conformal_map(surface, device="cpu").sphere
    one = optimal_map(surface, moser_map(surface, x, device="cpu").sphere, start=x, device="cpu")
    # The conformal map itself is no area-preserving map at all.
    other = optimal_map(surface, x, start=x, device="cpu")
    assert one.converged and other.converged
    distance = np.linalg.norm(one.sphere - other.sphere, axis=1)
    weights = surface.vertex_areas / surface.vertex_areas.sum()
    assert np.sqrt((weights * distance**2).sum()) < 2e-3
    assert one.history[-1]["cost"] == pytest.approx(other.history[-1]["cost"], rel=1e-4)


def test_the_optimum_does_not_depend_on_the_penalty_of_areas(monkeypatch):
    surface = blob(seed=11, amplitude=0.3, degree=5, sphere=1280)
    x = conformal_map(surface, device="cpu").sphere
    energy = energy_on_sphere(surface, vectors(x, CPU), CPU, 0.01)
    heavy = minimise(energy, x, gain=2e-4, iterations=40, progress=None)
    monkeypatch.setattr("omtwarp.optimal.solver.PENALTY", 3.0)
    light = minimise(energy, x, gain=2e-4, iterations=40, progress=None)
    assert heavy.converged and light.converged
    assert light.history[-1]["ring_rms"] < 2e-4
    weights = surface.vertex_areas / surface.vertex_areas.sum()
    assert np.sqrt((weights * ((heavy.sphere - light.sphere) ** 2).sum(axis=1)).sum()) < 2e-3
    assert heavy.history[-1]["cost"] == pytest.approx(light.history[-1]["cost"], rel=1e-4)


@pytest.mark.parametrize("wrong", [np.zeros((3, 3)), np.full((162, 3), np.nan), np.ones((162, 3), dtype=complex)])
def test_points_that_are_none_are_refused(wrong):
    surface = icosphere(4)
    for maps in ((wrong, surface.vertices), (surface.vertices, wrong)):
        with pytest.raises(OmtwarpError):
            optimal_map(surface, maps[0], start=maps[1], device="cpu")


def test_a_sphere_stays_where_it_is():
    ball = icosphere(8)
    found = optimal_map(ball, ball.vertices, start=ball.vertices, device="cpu")
    # Its vertex areas are those of flat triangles: the same up to the error of the mesh.
    assert np.abs(found.sphere - ball.vertices).max() < 0.01


def test_the_step_that_a_foreseen_end_spares_would_gain_next_to_nothing():
    spared = 0
    for seed in range(4):
        surface = blob(seed=seed, amplitude=0.3, degree=5, sphere=2000)
        x = conformal_map(surface, device="cpu").sphere
        y = moser_map(surface, x, device="cpu").sphere
        solve = partial(optimal_map, surface, start=x, device="cpu")
        whole, foreseen = solve(y), solve(y, foresee=True)
        spared += len(whole.history) - len(foreseen.history)
        after = solve(foreseen.sphere, multipliers=foreseen.multipliers, iterations=1).history
        assert foreseen.converged and after[1]["decrement"] <= GAIN * after[0]["cost"] / SPHERE_AREA
        assert np.sqrt(surface.vertex_areas @ ((foreseen.sphere - whole.sphere) ** 2).sum(axis=1) / SPHERE_AREA) < 3e-4
    assert spared >= 2


def test_stopped_early_says_so_and_is_no_worse():
    surface = noisy(ellipsoid((1.0, 0.6, 0.5), 1280), 0.15)
    x = conformal_map(surface, device="cpu").sphere
    found = optimal_map(surface, x, start=x, iterations=1, device="cpu")
    assert not found.converged and found.ended == "most steps taken"
    assert is_bijective(found.sphere, surface.faces)
    assert found.history[-1]["ring_rms"] < found.history[0]["ring_rms"]


def test_flipped_map_is_refused():
    surface = icosphere(4)
    with pytest.raises(OmtwarpError, match="flipped"):
        optimal_map(surface, -surface.vertices, start=surface.vertices, device="cpu")


def test_an_unknown_cost_is_refused():
    surface = icosphere(4)
    with pytest.raises(OmtwarpError, match="unknown cost 'cubed'"):
        optimal_map(surface, surface.vertices, start=surface.vertices, cost="cubed", device="cpu")


@pytest.mark.parametrize("seed", [1, 2])
def test_no_exchange_of_vertex_masses_costs_less(seed):
    """POT's exact plan takes every vertex's mass at x to its own y; all costs that are shown are its cost."""
    ot = pytest.importorskip("ot")
    surface = blob(seed=seed, amplitude=0.3, sphere=1280)
    result = omtwarp.map_to_sphere(surface, device="cpu")
    mass = surface.vertex_areas / surface.vertex_areas.sum()
    square = np.arccos(np.clip(result.conformal @ result.sphere.T, -1.0, 1.0)) ** 2
    plan = ot.emd(mass, mass, square, numItermax=1_000_000)
    np.testing.assert_allclose(plan, np.diag(mass), atol=1e-12)
    least = SPHERE_AREA * float((plan * square).sum())
    report = result.report
    shown = [report["optimality"]["cost"], report["stages"][-2]["transport_cost"]]
    shown.append(omtwarp.transport_cost(surface, result.sphere, start=result.conformal))
    np.testing.assert_allclose(shown, least, rtol=1e-6)


@pytest.mark.parametrize("angle", [0.1, 0.3, 0.6])
def test_a_map_that_was_turned_turns_back_in_whole_steps(angle):
    """Straight steps would stretch what they turn: corrected, they keep the areas and need no halving."""
    surface = blob(seed=3, amplitude=0.3, degree=5, sphere=1280)
    x = conformal_map(surface, device="cpu").sphere
    best = optimal_map(surface, moser_map(surface, x, device="cpu").sphere, start=x, device="cpu").sphere
    turned = Rotation.from_rotvec(angle * np.array([0.0, 0.6, 0.8])).apply(best)
    found = optimal_map(surface, turned, start=x, device="cpu")
    assert found.converged and len(found.history) <= 1 + 4
    assert {record["length"] for record in found.history[1:]} == {1.0}
    assert is_bijective(found.sphere, surface.faces)
    np.testing.assert_allclose(found.sphere, best, atol=1e-3)
