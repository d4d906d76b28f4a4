"""Local steps of the optimal map: they gain, keep areas and boundaries, and find the same optimum sooner."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import load
from omtwarp.flips.exact import is_bijective
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.patches import Patches, grow
from omtwarp.mesh.shapes import blob, demo_shape, icosphere
from omtwarp.optimal.local import FREED_RINGS, MAX_CHOSEN_SHARE, LocalSteps, freed_vertices, local_steps
from omtwarp.optimal.solver import PENALTY, minimise
from omtwarp.optimal.sphere import energy_on_sphere

CPU = resolve_device("cpu")


@pytest.fixture(scope="module")
def moser():
    surface = demo_shape(3000)
    return surface, map_to_sphere(surface, until="moser", device="cpu")


def energy_of(surface, moser):
    return energy_on_sphere(surface, vectors(moser.conformal, CPU), CPU, shape_weight=0.01)


def nothing(count):
    """Return multipliers that are zero."""
    return wp.zeros(count, dtype=wp.float64, device="cpu")


def worth(energy, terms, stiffness):
    """Return cost, shape and penalty as a sum over the whole sphere."""
    return energy.lagrangian(terms) + 0.5 * float(stiffness @ terms.missing.numpy() ** 2)


def test_steps_gain_and_touch_nothing_else(moser):
    surface, result = moser
    energy = energy_of(surface, result)
    points = vectors(result.sphere, CPU)
    before = energy.terms(points)
    stiffness = PENALTY / energy.wanted.sum() / energy.wanted
    seed = np.zeros(surface.vertex_count, dtype=bool)
    seed[np.argsort(-np.abs(before.relative.numpy()))[:20]] = True
    freed = grow(surface.faces, seed, 2)
    patches = Patches.of_vertices(surface.faces, freed)
    steps = LocalSteps(energy, patches, stiffness, constrained=True)
    there, multipliers = steps.run(points, before, nothing(len(freed)), 0.0)
    after, moved = energy.terms(there), there.numpy()
    assert worth(energy, after, stiffness) < worth(energy, before, stiffness)
    np.testing.assert_array_equal(moved[~freed], result.sphere[~freed])
    assert np.abs(moved - result.sphere).max() > 1e-4
    assert is_bijective(moved, surface.on("cpu").faces, device="cpu")
    # Patches cover what they covered, and their multipliers have no constant part.
    areas = [terms.areas.numpy()[patches.vertices].sum() for terms in (before, after)]
    assert areas[1] == pytest.approx(areas[0], rel=1e-9)
    multipliers = multipliers.numpy()
    assert float(energy.wanted @ multipliers) == pytest.approx(0.0, abs=1e-9 * np.abs(multipliers).max())
    assert np.count_nonzero(multipliers) <= len(patches.vertices)


@pytest.mark.parametrize("cost", [0.0, 0.2])
def test_many_steps_end_where_the_whole_energy_has_no_slope(moser, cost):
    """At the vertices that moved, under a penalty on areas, with both costs."""
    surface, result = moser
    energy = energy_on_sphere(surface, vectors(moser[1].conformal, CPU), CPU, shape_weight=0.01, softness=cost)
    points = vectors(result.sphere, CPU)
    terms = energy.terms(points)
    stiffness = PENALTY / energy.wanted.sum() / energy.wanted
    seed = np.zeros(surface.vertex_count, dtype=bool)
    seed[7] = True
    freed = grow(surface.faces, seed, 4)
    patches = Patches.of_vertices(surface.faces, freed)
    assert patches.count == 1
    steps = LocalSteps(energy, patches, stiffness, constrained=False)
    there, _ = steps.run(points, terms, nothing(len(seed)), 1e-16, 60)

    def slope(where, of):
        pressure = wp.array(stiffness * of.missing.numpy(), device="cpu")
        return np.linalg.norm(energy.gradient(where, of, pressure).numpy()[freed], axis=1).max()

    after = energy.terms(there)
    assert np.abs(there.numpy() - result.sphere).max() > 1e-4
    # Of the total area, which is taken as constant, the slope stays.
    assert slope(there, after) < 2e-3 * slope(points, terms)


@pytest.mark.parametrize("lanes", [2, 3])
def test_threads_that_share_a_patch_agree_to_the_bit_with_one_that_has_it_alone(moser, monkeypatch, lanes):
    """As the threads of a block on a GPU do; without one of their barriers this fails or differs."""
    surface, result = moser
    energy = energy_of(surface, result)
    points = vectors(result.sphere, CPU)
    terms = energy.terms(points)
    seed = np.zeros(surface.vertex_count, dtype=bool)
    seed[[7, 700]] = True
    patches = Patches.of_vertices(surface.faces, grow(surface.faces, seed, 2))
    steps = LocalSteps(energy, patches, PENALTY / energy.wanted.sum() / energy.wanted, constrained=True)
    alone = steps.run(points, terms, nothing(len(seed)), 0.0, 3)

    def launch(kernel, sizes, inputs, outputs, device):
        group = wp.array(np.arange(len(sizes), dtype=np.int32), device=device)
        load(kernel, device)

        def of_lane(lane):
            of_thread = [group, lane, lanes, *inputs[2:]]
            wp.launch(kernel, dim=(len(sizes), 1), inputs=of_thread, outputs=outputs, device=device)

        with ThreadPoolExecutor(lanes) as pool:
            list(pool.map(of_lane, range(lanes)))

    monkeypatch.setattr("omtwarp.optimal.local.lanes_on", lambda device: lanes)
    monkeypatch.setattr("omtwarp.optimal.local.launch_patches", launch)
    shared = steps.run(points, terms, nothing(len(seed)), 0.0, 3)
    assert np.abs(shared[0].numpy() - result.sphere).max() > 1e-4
    for one, several in zip(alone, shared, strict=True):
        np.testing.assert_array_equal(one.numpy(), several.numpy())


def test_large_patches_are_left_to_steps_of_the_whole_map():
    surface = blob(1, amplitude=0.2, sphere=icosphere(40))
    energy = energy_on_sphere(surface, vectors(icosphere(40).vertices, CPU), CPU, shape_weight=0.01)
    setting = np.ones(surface.vertex_count), True
    for height, small in ((-0.5, False), (0.95, True)):
        patches = Patches.of_vertices(surface.faces, icosphere(40).vertices[:, 2] > height)
        assert LocalSteps(energy, patches, *setting).worthwhile == small


def test_the_same_optimum_in_fewer_factorisations(moser):
    surface, result = moser
    found = {}
    for local in (True, False):
        energy = energy_of(surface, result)
        energy.has_local_steps = local
        found[local] = minimise(energy, result.sphere, gain=1e-6, iterations=100, progress=None)
        assert found[local].converged
    assert any(record["settled"] for record in found[True].history)
    assert not any(record["settled"] for record in found[False].history)
    last = [found[local].history[-1] for local in (True, False)]
    assert last[0]["energy"] <= last[1]["energy"] * (1.0 + 1e-3)
    assert last[0]["cost"] == pytest.approx(last[1]["cost"], rel=2e-3)
    assert found[True].factorisations < found[False].factorisations


def test_a_vertex_with_all_there_is_to_gain_moves_with_its_surroundings():
    surface = demo_shape(3000)
    count = surface.vertex_count
    assert not freed_vertices(surface.faces, np.zeros(count), np.inf).any()
    gains = np.full(count, 1e-6)
    gains[7] = 1.0
    freed = freed_vertices(surface.faces, gains, np.inf)
    np.testing.assert_array_equal(freed, grow(surface.faces, np.arange(count) == 7, FREED_RINGS))


def test_one_vertex_with_a_gain_beyond_what_is_expected_does_not_hide_the_others():
    surface = demo_shape(3000)
    gains = np.zeros(surface.vertex_count)
    gains[[7, 700, 1400]] = 1e10, 0.5, 0.2
    alone, beside = (freed_vertices(surface.faces, gains, expected) for expected in (np.inf, 1.0))
    assert alone.any() and beside.any()
    np.testing.assert_array_equal(alone[[7, 700, 1400]], [True, False, False])
    assert beside[[7, 700, 1400]].all()
    assert not freed_vertices(surface.faces, gains, 0.0).any()


def test_no_more_than_a_share_of_the_vertices_is_chosen():
    surface = demo_shape(3000)
    gains = np.arange(surface.vertex_count, 0.0, -1.0)  # the largest come first
    freed = freed_vertices(surface.faces, gains, np.inf)
    chosen = np.zeros(surface.vertex_count, dtype=bool)
    chosen[: int(MAX_CHOSEN_SHARE * surface.vertex_count)] = True
    np.testing.assert_array_equal(freed, grow(surface.faces, chosen, FREED_RINGS))


def test_patches_that_are_too_large_do_not_keep_others_from_moving(moser, monkeypatch):
    """A large and a small patch: the small one moves alone; of one that is too large fewer vertices move."""
    surface, result = moser
    energy = energy_of(surface, result)
    stiffness = PENALTY / energy.wanted.sum() / energy.wanted
    near = np.argsort(-surface.vertices @ surface.vertices[7])
    gains = np.zeros(surface.vertex_count)
    gains[near[:100]], gains[near[-1]] = np.linspace(1.0, 0.9, 100), 2.0
    whole = local_steps(energy, gains, np.inf, stiffness, constrained=True)
    assert whole is not None
    for most, count in (
        (0.9, int(grow(surface.faces, np.arange(len(gains)) == near[-1], FREED_RINGS).sum())),
        (0.0, 0),
    ):
        largest = float(whole[0]._envelopes.operations.max())
        monkeypatch.setattr("omtwarp.optimal.local.MAX_OPERATIONS", most * largest)
        fewer = local_steps(energy, gains, np.inf, stiffness, constrained=True)
        assert (0 if fewer is None else fewer[1]) == count < whole[1]
    gains[near[-1]] = 0.0
    monkeypatch.setattr("omtwarp.optimal.local.MAX_OPERATIONS", 0.9 * largest)
    fewer = local_steps(energy, gains, np.inf, stiffness, constrained=True)
    assert fewer is not None and 0 < fewer[1] < whole[1]
