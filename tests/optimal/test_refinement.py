"""Refinement never flips, never goes up, and ends at a minimum."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.patches import Patches
from omtwarp.mesh.shapes import blob, icosphere, limbs, noisy, tube
from omtwarp.metrics.distortion import measure_triangles
from omtwarp.optimal.refinement import refine_map, refinement_weight
from omtwarp.solvers.newton import PatchMatrix
from omtwarp.start.hierarchical import hierarchical_embedding
from omtwarp.untangling.untangle import untangle


def start_map(surface):
    return hierarchical_embedding(surface, device="cpu").sphere


def check(surface, start, weight):
    """Refine a map, and assert what is promised of every refined map."""
    result = refine_map(surface, start, weight=weight, device="cpu", iterations=40)
    energies = [record["energy"] for record in result.history]
    assert all(after <= before for before, after in pairwise(energies))
    assert not flipped_faces(result.sphere, surface.faces).any()
    judged = measure_triangles(surface.vertices, surface.faces, result.sphere)
    assert judged.degree == pytest.approx(1.0, abs=1e-9)
    assert judged.area["surface"] == pytest.approx(result.history[-1]["area"], rel=1e-12)
    assert judged.angle["surface"] == pytest.approx(result.history[-1]["angle"], rel=1e-12)
    return result, judged


def ring_errors(surface, sphere):
    """Solid angle of the triangles around every vertex over their area on the surface, less 1."""
    a, b, c = (sphere[surface.faces[:, k]] for k in range(3))
    dots = 1.0 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1)
    solid = 2.0 * np.arctan2(np.linalg.det(np.stack([a, b, c], axis=1)), dots)
    return surface.sum_to_vertices(solid) / (3.0 * surface.vertex_areas) - 1.0


def test_refined_blob_keeps_areas_around_vertices(device):
    """Refinement towards area keeps areas around vertices, at less angle distortion than areas of triangles."""
    surface = blob(1, sphere=1500)
    result = refine_map(surface, start_map(surface), device=device)
    judged = measure_triangles(surface.vertices, surface.faces, result.sphere)
    assert result.converged and len(result.history) < 40 and result.weight == 1000.0
    assert judged.flips == 0
    assert judged.area["surface"] <= 2.01
    assert np.sqrt((ring_errors(surface, result.sphere) ** 2).mean()) < 3e-3
    assert result.history[-1]["ring_largest"] == pytest.approx(np.abs(ring_errors(surface, result.sphere)).max())


@pytest.mark.parametrize("area", [2.02, 2.05, 2.2])
def test_an_area_distortion_is_matched(area):
    """The map whose weight is searched for has the area distortion asked for, and hardly less."""
    surface = blob(7, amplitude=0.5, sphere=800)
    result = refine_map(surface, start_map(surface), weight=f"match:{area}", device="cpu")
    judged = measure_triangles(surface.vertices, surface.faces, result.sphere)
    assert judged.flips == 0 and result.converged
    assert area - 2e-3 <= judged.area["surface"] <= area


@pytest.mark.parametrize("area", [5.0, 2.0000001])
def test_an_area_distortion_out_of_reach_is_not_converged(area):
    surface = blob(7, amplitude=0.5, sphere=320)
    result = refine_map(surface, start_map(surface), weight=f"match:{area}", device="cpu")
    assert not result.converged and not flipped_faces(result.sphere, surface.faces).any()


def test_an_area_beyond_what_rings_reach_is_matched_by_triangles():
    surface = blob(7, amplitude=0.5, sphere=800)

    def area(sphere):
        return measure_triangles(surface.vertices, surface.faces, sphere).area["surface"]

    rings = refine_map(surface, start_map(surface), weight="area", device="cpu").sphere
    wanted = 2.0 + 0.5 * (area(rings) - 2.0)
    result = refine_map(surface, rings, weight=f"match:{wanted}", device="cpu")
    assert not flipped_faces(result.sphere, surface.faces).any()
    assert wanted - 2e-3 <= area(result.sphere) <= wanted


def test_weights_trade_area_for_angle():
    """Along decreasing λ the angle distortion falls and the area distortion grows: the curve of best pairs."""
    surface = blob(7, amplitude=0.5, sphere=800)
    sphere, pairs = start_map(surface), []
    for weight in (100.0, 20.0, 5.0, 1.0):
        result, judged = check(surface, sphere, weight)
        sphere = result.sphere
        pairs.append((judged.area["surface"], judged.angle["surface"]))
    areas, angles = zip(*pairs, strict=True)
    assert list(areas) == sorted(areas) and list(angles) == sorted(angles, reverse=True)


def test_the_minimum_does_not_depend_on_the_start():
    """A rotated, disturbed start ends at the same pair."""
    surface = blob(4, amplitude=0.25, sphere=500)
    start = start_map(surface)
    first, _ = check(surface, start, 10.0)
    rotation, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    rotation *= np.sign(np.linalg.det(rotation))
    noise = np.random.default_rng(1).normal(size=start.shape) * 0.02
    moved = start @ rotation.T + noise
    disturbed = untangle(surface, moved / np.linalg.norm(moved, axis=1, keepdims=True), device="cpu").sphere
    second = refine_map(surface, disturbed, weight=10.0, device="cpu", tolerance=1e-7)
    assert second.history[-1]["energy"] == pytest.approx(first.history[-1]["energy"], rel=1e-3)


def test_the_identity_on_the_sphere_stays():
    """Refinement leaves the identity on the sphere where it is."""
    surface = icosphere(5)
    sphere = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
    result = refine_map(surface, sphere, weight="balanced", device="cpu")
    assert np.abs(result.sphere - sphere).max() < 1e-9


def test_same_answer_twice():
    """Two calls give the same bits."""
    surface = noisy(blob(9, sphere=600), 0.2)
    start = start_map(surface)
    first, second = (refine_map(surface, start, device="cpu", iterations=8).sphere for _ in range(2))
    assert np.array_equal(first, second)


def test_tiny_triangles_grow_back():
    """A patch squeezed to a hundredth of its size does not stop the rest and recovers."""
    surface = blob(6, amplitude=0.2, sphere=900)
    start = refine_map(surface, start_map(surface), weight=10.0, device="cpu").sphere
    pole = start[0]
    near = np.clip(start @ pole, -1.0, 1.0)
    angle = np.arccos(near)
    squeezed = angle * np.where(angle < 0.6, 0.01 + 0.99 * (angle / 0.6) ** 3, 1.0)
    axis = start - near[:, None] * pole
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-300)
    bad = np.cos(squeezed)[:, None] * pole + np.sin(squeezed)[:, None] * axis
    bad = untangle(surface, bad, device="cpu").sphere
    before = measure_triangles(surface.vertices, surface.faces, bad)
    assert before.area["surface"] > 10.0 and before.area["max"] > 100.0
    _, judged = check(surface, bad, 100.0)
    assert judged.area["surface"] < 2.003


@settings(max_examples=6)
@given(
    seed=st.integers(0, 10**6), kind=st.sampled_from(["blob", "noise", "tube", "limbs"]), weight=st.floats(1.0, 200.0)
)
def test_no_flip_on_random_shapes(seed, kind, weight):
    """On random shapes and weights refinement has no flip and degree 1, and never raises the energy."""
    rng = np.random.default_rng(seed)
    if kind == "tube":
        surface = tube(length=float(rng.uniform(3, 12)), face_count=600)
    elif kind == "limbs":
        surface = limbs(sphere=800)
    else:
        surface = blob(seed, amplitude=float(rng.uniform(0.1, 0.6)), sphere=600)
    if kind == "noise":
        surface = noisy(surface, 0.3, seed)
    check(surface, start_map(surface), weight)


@pytest.mark.parametrize(
    "own",
    [
        [],
        [[1], [1, 2]],
        "x",
        3,
        True,
        np.ones(42, bool),
        np.ones(80),
        np.arange(80),
        np.ones((80, 1), bool),
        [False] * 80,
    ],
)
def test_refuses_masks_that_are_not_of_the_triangles(own):
    """What is no mask of the triangles is refused in one line; a list of truth values is one."""
    ball = icosphere(2)
    with pytest.raises(OmtwarpError, match="own: must be a mask of the 80 triangles, true"):
        refine_map(ball, ball.vertices, own=own, device="cpu")
    masks = [True] * 80, np.ones(80, bool), None
    found = [refine_map(ball, ball.vertices, own=mask, iterations=1, device="cpu").sphere for mask in masks]
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])


def test_refuses_flipped_maps_and_unknown_weights():
    """Flipped maps and unknown weights are refused, each in one line."""
    surface = icosphere(3)
    sphere = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
    mirrored = sphere * [1.0, 1.0, -1.0]
    with pytest.raises(OmtwarpError, match="flipped triangles, the first is face 0"):
        refine_map(surface, mirrored, device="cpu")
    for wrong in ("round", "-1", 0.0, float("inf"), "nan"):
        with pytest.raises(OmtwarpError, match="unknown refinement"):
            refinement_weight(wrong)
    assert refinement_weight("12.5") == 12.5 and refinement_weight("area") == 1000.0


def test_newton_matrix_sums_blocks():
    """The Newton matrix of a patch is the dense sum of the same blocks."""
    surface = icosphere(2)
    count = surface.vertex_count
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(surface.face_count, 6, 7))
    blocks = factors @ factors.transpose(0, 2, 1)
    dense = np.zeros((2 * count, 2 * count))
    for face, block in zip(surface.faces, blocks, strict=True):
        index = (2 * face[:, None] + np.arange(2)).ravel()
        dense[np.ix_(index, index)] += block
    patches = Patches.of_vertices(surface.faces, np.ones(count, dtype=bool))
    assert np.array_equal(patches.vertices, np.arange(count)) and np.array_equal(patches.faces, surface.faces)
    matrix, right = PatchMatrix(patches, surface, 0.0), rng.normal(size=(count, 2))
    matrix.factorise(np.ascontiguousarray(blocks[:, *np.triu_indices(6)]))
    assert np.allclose(matrix.solve(right).ravel(), np.linalg.solve(dense, right.ravel()))


def ring_rms(surface, sphere):
    """Relative errors of the areas around vertices, root mean square by area."""
    a, b, c = (sphere[surface.faces[:, k]] for k in range(3))
    dots = 1.0 + sum(np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    solid = 2.0 * np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), dots)
    image, own = surface.sum_to_vertices(solid), surface.sum_to_vertices(surface.own_areas)
    return float(np.sqrt(own @ (image / own - 1.0) ** 2 / own.sum()))


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
def test_refinement_named_area_loses_none_on_long_limbs():
    """The same weight as a number, with 10 of it on triangles, makes their areas on a long tube worse."""
    surface = tube(20.0, face_count=1500)
    optimal = map_to_sphere(surface, optimality=False, device="cpu")
    given_area = optimal.distortion().area["surface"] - 2.0
    named, number = (
        refine_map(surface, optimal.sphere, weight=weight, device="cpu").sphere for weight in ("area", 1e3)
    )
    lost, kept = (measure_triangles(surface.vertices, surface.faces, sphere) for sphere in (number, named))
    assert lost.area["surface"] - 2.0 > 1.1 * given_area
    assert kept.area["surface"] - 2.0 < 1.05 * given_area and kept.flips == 0
    assert ring_rms(surface, named) < 0.02
