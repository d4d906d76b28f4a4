"""Steps of the stiffest vertices: they lower the energy, flip nothing, and leave all others where they are."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omtwarp.device.policy import resolve_device
from omtwarp.flips.predicates import flipped_faces
from omtwarp.mesh.patches import grow
from omtwarp.mesh.shapes import blob, noisy
from omtwarp.optimal.refinement import refine_map
from omtwarp.refine.energy import DistortionEnergy
from omtwarp.refine.relaxation import FREED_RINGS, MAX_CHOSEN_SHARE, relax, stiff_vertices
from omtwarp.refine.steps import Steps
from omtwarp.start.hierarchical import hierarchical_embedding


@pytest.fixture(scope="module")
def refined():
    """Return a surface and a refined map of it."""
    surface = noisy(blob(2, amplitude=0.3, sphere=1500), 0.1)
    start = hierarchical_embedding(surface, device="cpu").sphere
    return surface, refine_map(surface, start, weight=20.0, device="cpu", tolerance=1e-6).sphere


def disturbed(surface, sphere, centre, seed):
    """The map with the vertices around one moved at random, without flips."""
    seedling = np.zeros(surface.vertex_count, dtype=bool)
    seedling[centre] = True
    near = grow(surface.faces, seedling, 3)
    moved = sphere.copy()
    edge = np.linalg.norm(sphere[surface.edges[:, 0]] - sphere[surface.edges[:, 1]], axis=1).mean()
    moved[near] += 0.2 * edge * np.random.default_rng(seed).normal(size=(int(near.sum()), 3))
    moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    while flipped_faces(moved, surface.faces).any():
        moved = 0.5 * (moved + sphere)
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
    return moved, near


def relaxed(surface, sphere, chosen=None, device="cpu"):
    """Relax a map; return its energy before and after, the map after, and the chosen vertices."""
    energy = DistortionEnergy(surface, resolve_device(device))
    points = energy.upload(sphere)
    terms = energy.terms(points)
    if chosen is None:
        steps = Steps(energy)
        steps.assemble(points, terms, 20.0, 1.0)
        chosen = stiff_vertices(steps.decrements(energy.gradient(points, terms, 20.0)), terms.total(20.0))
    result = relax(energy, points, terms, 20.0, 1.0, chosen)
    assert result is not None
    moved, after, count = result
    assert count == grow(surface.faces, chosen, FREED_RINGS).sum()
    return terms.total(20.0), after.total(20.0), moved.numpy(), chosen


@settings(max_examples=8)
@given(centre=st.integers(0, 700), seed=st.integers(0, 10**6))
def test_a_disturbed_patch_is_found_and_put_right(refined, centre, seed):
    surface, sphere = refined
    start, near = disturbed(surface, sphere, centre, seed)
    before, after, moved, chosen = relaxed(surface, start)
    energy = DistortionEnergy(surface, resolve_device("cpu"))
    best = energy.terms(energy.upload(sphere)).total(20.0)
    assert near[chosen].mean() > 0.5 and chosen.mean() <= MAX_CHOSEN_SHARE
    assert after < before and after - best < 0.5 * (before - best)
    assert not flipped_faces(moved, surface.faces).any()
    rest = ~grow(surface.faces, chosen, FREED_RINGS)
    np.testing.assert_array_equal(moved[rest], start[rest])


def test_what_is_moved_ends_where_nothing_pulls(refined, device):
    """After enough rounds the whole map's gradient is zero at the freed vertices."""
    surface, sphere = refined
    start, near = disturbed(surface, sphere, 5, 1)
    energy = DistortionEnergy(surface, resolve_device(device))
    pulls = []
    for _ in range(6):
        terms = energy.terms(energy.upload(start))
        pull = np.linalg.norm(energy.gradient(energy.upload(start), terms, 20.0).numpy(), axis=1)
        pulls.append(pull[grow(surface.faces, near, FREED_RINGS)].max())
        result = relax(energy, energy.upload(start), terms, 20.0, 0.1, near)
        if result is None:
            break
        start = result[0].numpy()
    assert min(pulls) < 1e-6 * pulls[0]


def test_two_patches_do_not_hold_each_other_back(refined):
    """A patch ends at the same place alone and beside another that it does not touch, up to rounding."""
    surface, sphere = refined
    far = int(np.argmin(sphere @ sphere[5]))
    start, first = disturbed(surface, sphere, 5, 1)
    start, second = disturbed(surface, start, far, 2)
    assert not (grow(surface.faces, first, FREED_RINGS + 1) & grow(surface.faces, second, FREED_RINGS + 1)).any()
    alone, both = (relaxed(surface, start, chosen)[2] for chosen in (first, first | second))
    inside = grow(surface.faces, first, FREED_RINGS)
    np.testing.assert_allclose(both[inside], alone[inside], atol=1e-9)


def test_too_many_vertices_are_left_to_a_step_of_all(refined):
    surface, sphere = refined
    energy = DistortionEnergy(surface, resolve_device("cpu"))
    points = energy.upload(sphere)
    assert relax(energy, points, energy.terms(points), 20.0, 1.0, np.ones(surface.vertex_count, dtype=bool)) is None


def test_vertices_chosen_gain_more_alone_than_in_a_step_of_all():
    """Chosen are vertices with over three times the mean gain, the largest first: at most 15 %, and at least one."""
    decrements = np.full(1000, 1e-3)
    assert stiff_vertices(decrements, 1.0).sum() == 1
    decrements[[3, 5, 7]] = 4e-3, 2e-3, 1e3
    assert set(np.flatnonzero(stiff_vertices(decrements, 1.0))) == {3, 7}
    decrements = np.arange(1.0, 1001.0)
    assert set(np.flatnonzero(stiff_vertices(decrements, 1e5))) == set(range(850, 1000))
