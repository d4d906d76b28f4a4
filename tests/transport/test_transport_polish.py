"""The last rounds of transport, on the image mesh: curl is removed and areas are kept, also near huge triangles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sphere_truths import at_height, mean_edge, pushed_north, random_rotation, rms, turned, twisted

from omtwarp.device.start import wp
from omtwarp.flips.predicates import count_flips
from omtwarp.mesh.shapes import icosphere, random_sphere, sphere_from_directions
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.metrics import measure_triangles
from omtwarp.metrics.optimality import optimality
from omtwarp.transport.flow import AREA_PRICE
from omtwarp.transport.polish import (
    AREA_SLACK,
    cost_and_area_errors,
    displacements_to_start,
    move_by_potentials,
    polish_transport,
    weak_curl_and_area,
)


def capped_sphere(rim: float = 0.6, around: int = 90) -> Surface:
    """A sphere of small triangles but for one cap: a fan of long thin triangles from a pole to a ring of vertices."""
    golden = np.pi * (1.0 + np.sqrt(5.0))
    k = np.arange(1600) + 0.5
    z = 1.0 - 2.0 * k / len(k)
    lowest = np.cos(rim + 0.6 * 2.0 * np.pi / around * np.sin(rim))
    spiral = at_height(z, golden * k)[z < lowest]
    ring = at_height(np.full(around, np.cos(rim)), 2.0 * np.pi * np.arange(around) / around)
    points = np.concatenate([[[0.0, 0.0, 1.0]], ring, spiral])
    return sphere_from_directions(points @ random_rotation(7).T)


def area_excess(surface, sphere) -> float:
    return measure_triangles(surface.vertices, surface.faces, sphere).area["sphere"] - 2.0


def test_a_small_twist_is_undone(device):
    """The identity is the only optimal map from the uniform sphere to itself."""
    surface = turned(icosphere(16))
    x = surface.vertices
    initial = twisted(x, 0.2)
    polished = polish_transport(surface, initial, start=x, device=device)
    left, right = (rms(np.linalg.norm(y - x, axis=1)) for y in (polished.sphere, initial))
    assert left < 1e-3 * right
    assert polished.history[-1]["cost"] < 1e-6 * polished.history[0]["cost"]
    assert area_excess(surface, polished.sphere) < area_excess(surface, initial)


def test_nearly_optimal_maps_become_optimal(device):
    """Points pushed along meridians, whose inverse is the optimal map of that density (McCann 2001), after a twist."""
    surface = turned(icosphere(16))
    best = surface.vertices
    x, initial = pushed_north(best, 0.6), twisted(best, 0.2)
    polished = polish_transport(surface, initial, start=x, device=device)
    assert rms(np.linalg.norm(polished.sphere - best, axis=1)) < 0.1 * mean_edge(surface, best)
    assert polished.history[-1]["curl"] < 0.005 * polished.history[0]["curl"]


def test_a_fan_of_large_triangles_does_not_hold_its_rim_back(device):
    """Curl beside triangles much larger than the rest goes too, and next to no area is paid for it.

    Judged by the independent report. Velocities averaged by angle leave twenty times the gap and six times the area
    error, which grows from round to round.
    """
    surface = capped_sphere()
    assert np.sort(surface.face_areas)[-90] > 2.5 * np.median(surface.face_areas)
    tilted = surface.vertices @ random_rotation(7)  # the fan's pole is then on the z axis
    x = pushed_north(tilted[:, [2, 0, 1]], 0.5)[:, [1, 2, 0]] @ random_rotation(7).T
    initial = twisted(surface.vertices, 0.25)
    polished = polish_transport(surface, initial, start=x, device=device)
    before, after = (optimality(surface, y, start=x, device=device) for y in (initial, polished.sphere))
    assert after.relative_curl < 0.1 * before.relative_curl
    assert after.gap < 5e-5 < before.gap
    assert area_excess(surface, polished.sphere) < 4e-4
    assert count_flips(polished.sphere, surface.faces) == 0


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), amount=st.floats(-0.8, 0.8), push=st.floats(-0.7, 0.7))
def test_what_is_kept_never_cost_area_nor_added_curl(seed, amount, push):
    """On irregular triangles; rounds that fail are taken back, and the last record tells of the map returned."""
    surface = random_sphere(300, seed)
    initial = twisted(surface.vertices, amount)
    if count_flips(initial, surface.faces):
        return
    polished = polish_transport(surface, initial, start=pushed_north(surface.vertices, push), rounds=6)
    first = polished.history[0]
    again = polish_transport(surface, polished.sphere, start=pushed_north(surface.vertices, push), rounds=0).history[0]
    gained = max(0.0, 1.0 - again["cost"] / first["cost"]) if first["cost"] > 0.0 else 0.0
    assert again["area_error"] <= first["area_error"] + AREA_SLACK + AREA_PRICE * gained
    assert again["curl"] ** 2 * again["cost"] <= 1.5 * first["curl"] ** 2 * first["cost"] + 1e-12
    for name in ("cost", "area_error"):  # the curl is measured in the metric of the first image
        assert polished.history[-1][name] == pytest.approx(again[name], rel=1e-9, abs=1e-15)
    assert count_flips(polished.sphere, surface.faces) == 0
    np.testing.assert_allclose(np.linalg.norm(polished.sphere, axis=1), 1.0, atol=1e-14)


def test_history_progress_and_the_same_bits_twice():
    surface = turned(icosphere(6))
    start, initial = pushed_north(surface.vertices, 0.3), twisted(surface.vertices, 0.4)
    kept = start.copy(), initial.copy()
    told = []
    one = polish_transport(surface, initial, start=start, rounds=4, progress=lambda *arguments: told.append(arguments))
    two = polish_transport(surface, initial, start=start, rounds=4)
    np.testing.assert_array_equal(start, kept[0])
    np.testing.assert_array_equal(initial, kept[1])
    np.testing.assert_array_equal(one.sphere, two.sphere)
    assert one.history == two.history
    assert told == [("omt", k, 4, record) for k, record in enumerate(one.history)]
    assert [record["iteration"] for record in one.history] == list(range(one.iterations + 1))


@pytest.mark.parametrize("rounds", [0, 1])
def test_few_rounds_do_no_harm(rounds):
    surface = turned(icosphere(5))
    initial = twisted(surface.vertices, 0.3)
    polished = polish_transport(surface, initial, start=surface.vertices, rounds=rounds)
    assert polished.iterations == rounds
    if rounds == 0:
        np.testing.assert_array_equal(polished.sphere, initial)


def test_every_kernel_of_a_round_agrees_with_the_cpu(device):
    """And with the cost between centres and the mean of D + 1/D - 2, each triangle counting as much as it may."""
    surface = random_sphere(700, 2)
    start, image = pushed_north(surface.vertices, 0.4), twisted(surface.vertices, 0.7)
    potentials = np.random.default_rng(4).normal(size=(2, surface.vertex_count))
    results = []
    for where in ("cpu", device):
        origin, points = (wp.array(p, dtype=wp.vec3d, device=where) for p in (start, image))
        faces = wp.array(surface.faces, dtype=wp.vec3i, device=where)
        areas = wp.array(surface.face_areas, dtype=wp.float64, device=where)
        rows = [wp.array(array, dtype=wp.int32, device=where) for array in surface.vertex_corners]
        stream, potential = (wp.array(values, dtype=wp.float64, device=where) for values in potentials)
        pull, moved = wp.empty_like(points), wp.empty_like(points)
        curl, energy, area = (wp.empty(surface.vertex_count, dtype=wp.float64, device=where) for _ in range(3))
        measured = wp.empty((surface.face_count, 3), dtype=wp.float64, device=where)
        for kernel, size, inputs, outputs in (
            (displacements_to_start, len(points), [origin, points], [pull]),
            (weak_curl_and_area, len(points), [points, pull, faces, *rows, 0], [curl, energy, area]),
            (move_by_potentials, len(points), [points, faces, stream, potential, *rows, 0.3, 0.6, 0], [moved]),
            (cost_and_area_errors, surface.face_count, [origin, points, faces, areas, 0.1, 10.0], [measured]),
        ):
            wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device=where)
        results.append([array.numpy() for array in (pull, curl, energy, area, moved, measured)])
    for cpu, other in zip(*results, strict=True):
        np.testing.assert_allclose(other, cpu, rtol=1e-12, atol=1e-12 * np.abs(cpu).max())
    cost, usual, worst = results[1][-1].sum(axis=0)
    begin, end = (points[surface.faces].sum(axis=1) for points in (start, image))
    moved = np.arctan2(np.linalg.norm(np.cross(begin, end), axis=1), (begin * end).sum(axis=1))
    assert cost == pytest.approx(surface.face_areas @ moved**2, rel=1e-12)
    ratio = triangle_areas(image, surface.faces) / surface.face_areas
    for sums, largest in ((usual, 0.1), (worst, 10.0)):
        error = np.minimum(ratio + 1.0 / ratio - 2.0, largest)
        assert sums == pytest.approx(surface.face_areas @ error, rel=1e-10)
