"""The paper's flow on spheres whose optimal map is known: the identity under a twist, and a stretch along the axis."""

from __future__ import annotations

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.transport.paper import V_CYCLE, PaperFlow, default_resolutions, paper_flow
from omtwarp.wavelets import SphericalWavelets, sphere_hierarchy


def turn(points: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points turned about the z axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1], points[:, 2]], axis=1)


def twisted_sphere(level: int = 4, amplitude: float = 0.4):
    """An icosphere and an area-preserving twist of it: each parallel turned by a function of its height."""
    hierarchy = sphere_hierarchy(level)
    x, z = hierarchy.vertices, hierarchy.vertices[:, 2]
    return x, hierarchy.faces, turn(x, amplitude * (1 - z**2) * (0.5 + z)), triangle_areas(x, hierarchy.faces)


def stretched_sphere(level: int = 4, stretch: float = 0.25, amplitude: float = 0.3):
    """Density mu = 1 - 2 a z, its optimal map Z = z + a (1 - z^2) along meridians, and that map twisted."""
    hierarchy = sphere_hierarchy(level)
    x, z = hierarchy.vertices, hierarchy.vertices[:, 2]
    height = z + stretch * (1 - z**2)
    radius = np.sqrt(1 - height**2) / np.maximum(np.sqrt(1 - z**2), 1e-12)
    optimal = np.stack([radius * x[:, 0], radius * x[:, 1], height], axis=1)
    start = turn(optimal, amplitude * (1 - height**2) * (0.5 + height))
    return x, hierarchy.faces, optimal, start, triangle_areas(optimal, hierarchy.faces)


def paper_state(surface: Surface, start: np.ndarray, initial: np.ndarray, cost: str, highest: int) -> PaperFlow:
    """The state of Algorithm 1 before its first step."""
    return PaperFlow(surface, start, initial, SphericalWavelets(sphere_hierarchy(highest + 1), device="cpu"), cost)


def flips(image: np.ndarray, faces: np.ndarray) -> int:
    return int((np.linalg.det(image[faces]) <= 0).sum())


def distance(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.sqrt(((first - second) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize("cost", ["squared", "geodesic"])
def test_twist_goes_back_to_the_identity(cost):
    x, faces, start, areas = twisted_sphere()
    result = paper_flow(Surface(x, faces, areas), start, start=x, cost=cost, cycles=25, area_loss=np.inf, device="cpu")
    costs = np.array([entry["cost"] for entry in result.history])
    assert (np.diff(costs) <= 0).all()
    assert costs[-1] < (0.04 if cost == "squared" else 0.8) * costs[0]
    assert distance(result.sphere, x) < (0.2 if cost == "squared" else 0.9) * distance(start, x)
    assert flips(result.sphere, faces) == 0
    assert result.history[-1]["area"] < 2.02
    np.testing.assert_allclose(np.linalg.norm(result.sphere, axis=1), 1, rtol=0, atol=1e-14)


def test_known_optimum_of_an_axisymmetric_density():
    x, faces, optimal, start, areas = stretched_sphere()
    result = paper_flow(
        Surface(x, faces, areas), start, start=x, cost="squared", cycles=25, area_loss=np.inf, device="cpu"
    )
    assert distance(result.sphere, optimal) < 0.45 * distance(start, optimal)
    rest = paper_state(Surface(x, faces, areas), x, optimal, "squared", 3)
    reached = result.history[-1]["cost"]
    lowest = rest.cost_of(rest.dual_map)
    assert 0 <= reached - lowest < 0.25 * (result.history[0]["cost"] - lowest)


def test_optimal_maps_have_no_hamiltonian():
    """At the optimum the displacement is a gradient, J Phi_x has no divergence, and the flow stops at once."""
    x, faces, optimal, start, areas = stretched_sphere()
    norms = []
    for image in (optimal, start):
        flow = paper_state(Surface(x, faces, areas), x, image, "squared", 3)
        flow.set_hamiltonian(3)
        norms.append(flow.hamiltonian_norm())
    assert norms[0] < 2e-4 * norms[1]
    result = paper_flow(
        Surface(x, faces, areas),
        optimal,
        start=x,
        cost="squared",
        smallest_hamiltonian=2 * norms[0],
        device="cpu",
        resolutions=[3],
    )
    assert result.stopped == "hamiltonian"
    np.testing.assert_allclose(result.sphere, optimal, rtol=0, atol=1e-14)


def test_rate_of_the_cost_is_minus_the_product_of_hamiltonians():
    """Section 2.3: dM/dt = -∫ H div(J Phi_x), with the sign of equation (11); that of (18) would make the cost rise."""
    x, faces, start, areas = twisted_sphere()
    flow = paper_state(Surface(x, faces, areas), x, start, "squared", 3)
    flow.set_hamiltonian(3)
    rate = flow.set_velocity()
    step = 1e-3 / rate
    assert flow.advance(step)
    measured = (flow.cost_of(flow.advanced) - flow.cost_of(flow.dual_map)) / step
    hamiltonian = flow.sampler.interpolate(flow.hamiltonian).numpy()
    expected = -hamiltonian @ flow._flux.numpy()
    assert measured < 0
    assert measured == pytest.approx(expected, rel=0.05)


def test_velocity_keeps_the_mass():
    """Appendix B: div (mu v) = 0 at every vertex to round-off, whatever the density."""
    x, faces, _, start, areas = stretched_sphere(level=3)
    flow = paper_state(Surface(x, faces, areas), x, start, "geodesic", 2)
    flow.set_hamiltonian(2)
    flow.set_velocity()
    density = areas * (4 * np.pi / areas.sum()) / triangle_areas(x, faces)
    momentum = density[:, None] * flow._velocity.numpy()
    flux = flow.operators.divergence(momentum)
    assert abs(flux).max() < 1e-13 * abs(momentum).max()


def test_geodesic_cost_is_guarded_where_nothing_moves():
    x, faces, _, areas = twisted_sphere(level=3)
    result = paper_flow(Surface(x, faces, areas), x, start=x, cost="geodesic", cycles=1, device="cpu")
    assert np.isfinite(result.sphere).all()
    assert distance(result.sphere, x) < 1e-6


def test_no_triangle_is_turned_over():
    """A rough start with thin triangles: those that were upright stay upright."""
    x, faces, start, areas = twisted_sphere(level=3, amplitude=1.5)
    rough = start + 0.04 * np.random.default_rng(0).normal(size=start.shape)
    rough /= np.linalg.norm(rough, axis=1)[:, None]
    upright = np.linalg.det(rough[faces]) > 0
    result = paper_flow(
        Surface(x, faces, areas), rough, start=x, cost="geodesic", cycles=10, area_loss=np.inf, device="cpu"
    )
    assert (np.linalg.det(result.sphere[faces]) > 0)[upright].all()
    assert result.history[-1]["cost"] < result.history[0]["cost"]


def test_area_bound_ends_the_flow_before_the_step_that_breaks_it():
    x, faces, start, areas = twisted_sphere(level=3, amplitude=1.0)
    free = paper_flow(
        Surface(x, faces, areas), start, start=x, cost="squared", cycles=3, area_loss=np.inf, device="cpu"
    )
    reached = np.array([entry["area"] for entry in free.history])
    bound = (reached.max() + reached[0]) / 2 - reached[0] if reached.max() > reached[0] else -1.0
    held = paper_flow(Surface(x, faces, areas), start, start=x, cost="squared", cycles=3, area_loss=bound, device="cpu")
    assert held.stopped == "area"
    assert len(held.history) == int((reached > reached[0] + bound).argmax()) if bound > 0 else len(held.history) == 1
    assert held.history == free.history[: len(held.history)]


def test_same_answer_twice():
    x, faces, start, areas = twisted_sphere(level=3)
    runs = [paper_flow(Surface(x, faces, areas), start, start=x, cycles=2, device="cpu") for _ in range(2)]
    np.testing.assert_array_equal(runs[0].sphere, runs[1].sphere)
    assert runs[0].history == runs[1].history


def test_steps_are_smaller_at_finer_levels_and_progress_is_told():
    x, faces, start, areas = twisted_sphere(level=4)
    seen: list[int] = []
    result = paper_flow(
        Surface(x, faces, areas),
        start,
        start=x,
        cycles=1,
        device="cpu",
        progress=lambda stage, i, most, details: seen.append(i),
    )
    assert [entry["level"] for entry in result.history[1:]] == [1, 2, 3, 2, 1]
    steps = [entry["step"] for entry in result.history[1:4]]
    assert steps[0] > steps[1] > steps[2]
    assert seen == [1, 2, 3, 4, 5]


def test_resolutions_follow_the_mesh():
    assert default_resolutions(50_000) == V_CYCLE
    assert default_resolutions(12_500) == (1, 2, 3, 4, 3, 2, 1)
    assert default_resolutions(100) == (1,)


def test_unfit_input_is_refused():
    x, faces, start, areas = twisted_sphere(level=2)
    with pytest.raises(OmtwarpError, match="unknown cost 'cubic'"):
        paper_flow(Surface(x, faces, areas), start, start=x, cost="cubic", device="cpu")
    with pytest.raises(OmtwarpError, match="the map: shape"):
        paper_flow(Surface(x, faces, areas), start[:-1], start=x, device="cpu")
