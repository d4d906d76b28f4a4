"""Patches that do not touch, untangled together, and the budget of a repair."""

from __future__ import annotations

import numpy as np
import pytest
from sphere_truths import random_rotation

from omtwarp.device import threads
from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.metrics.certificate import certify_triangles
from omtwarp.untangling.untangle import RepairBudget, untangle


def unit(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def tangled():
    """Return a surface and a map of it with vertices thrown about in three caps that do not touch."""
    surface = blob(5, amplitude=0.2, sphere=icosphere(12))
    sphere = unit(surface.vertices)
    moved = sphere.copy()
    rng = np.random.default_rng(0)
    for centre in (unit(np.eye(3)) @ random_rotation(3).T).round(12):
        inside = sphere @ centre > np.cos(0.2)
        moved[inside] = unit(centre + 0.1 * rng.normal(size=(int(inside.sum()), 3)))
    return surface, moved


def test_patches_apart_lose_all_their_flips_and_nothing_else_moves(tangled):
    surface, start = tangled
    result = untangle(surface, start, device="cpu")
    assert result.flips_before > 30
    assert result.bijective and not flipped_faces(result.sphere, surface.faces).any()
    assert certify_triangles(surface.faces, result.sphere).degree == 1
    assert result.history[0]["patches"] == 3
    moved = np.any(result.sphere != start, axis=1)
    assert moved.sum() <= result.history[-1]["vertices"] < surface.vertex_count


def test_a_patch_ends_where_it_does_on_any_number_of_cores(tangled, monkeypatch):
    surface, start = tangled
    both = untangle(surface, start, device="cpu").sphere
    monkeypatch.setattr(threads, "core_count", lambda: 1)
    np.testing.assert_array_equal(untangle(surface, start, device="cpu").sphere, both)


def test_the_budget_ends_a_patch_that_cannot_be_untangled():
    """Noise alone: no more is spent than granted and one step, and the result is the best map found."""
    surface = icosphere(6)
    noise = unit(np.random.default_rng(4).normal(size=surface.vertices.shape))
    budget = RepairBudget(surface, share=0.02)
    result = untangle(surface, noise, budget=budget, device="cpu")
    assert budget.exhausted and not result.bijective
    assert budget.spent <= budget.granted + 2 * (surface.vertex_count + 1000)
    assert np.isfinite(result.sphere).all()
