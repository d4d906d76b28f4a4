"""Patches that one thread untangles each, beside the same patches untangled step by step with one sparse matrix."""

from __future__ import annotations

import numpy as np
import pytest
from sphere_truths import random_rotation

from omtwarp.device import threads
from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.patches import Patches
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.metrics.certificate import certify_triangles
from omtwarp.solvers import patches as small_patches
from omtwarp.solvers.patches import SmallPatches
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


def test_both_ways_remove_all_flips_and_move_the_same_vertices(tangled, monkeypatch):
    surface, start = tangled
    alone = untangle(surface, start, device="cpu")
    monkeypatch.setattr(small_patches, "MAX_OPERATIONS", 0.0)
    together = untangle(surface, start, device="cpu")
    assert alone.flips_before > 30
    for result in (alone, together):
        assert result.bijective and not flipped_faces(result.sphere, surface.faces).any()
        assert certify_triangles(surface.faces, result.sphere).degree == 1
    first = [result.history[0] for result in (alone, together)]
    assert [record["patches"] for record in first] == [3, 3]
    assert first[0]["vertices"] == first[1]["vertices"]
    # Both lower the same energy from the same map; a patch alone may take fewer steps for a value of ε.
    assert np.abs(alone.sphere - together.sphere).max() < 0.2


def test_a_patch_ends_where_it_does_alone_on_any_number_of_cores(tangled, monkeypatch):
    surface, start = tangled
    both = untangle(surface, start, device="cpu").sphere
    monkeypatch.setattr(small_patches, "core_count", lambda: 1)
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


def test_large_patches_are_left_to_the_sparse_matrix():
    surface = icosphere(48)
    assert SmallPatches.of(Patches.of_vertices(surface.faces, surface.vertices[:, 2] > -0.9)) is None
    assert SmallPatches.of(Patches.of_vertices(surface.faces, surface.vertices[:, 2] > 0.9)) is not None
