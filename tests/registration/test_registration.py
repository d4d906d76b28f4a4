"""Registration of made cortices: known warps are found again, nothing flips, strain is bounded, starts do not count."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_cortices import BALL, EDGE, FIRM, flowed, folded, points_of, rms, unit
from sphere_truths import random_rotation

import omtwarp
from omtwarp.alignment.rotation_search import Best
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces
from omtwarp.location import Locator
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.data import read_data
from omtwarp.mesh.surface import triangle_areas
from omtwarp.registration.feature_term import FeatureField, FeatureTerm
from omtwarp.registration.folding import HeatFlow, folding_features, smoothed
from omtwarp.registration.sides import Side, target_points
from omtwarp.registration.strain import kept_within, octaves, strain_at_vertices
from omtwarp.resampling import SpherePoints
from omtwarp.spheres import mesh_grid


@pytest.mark.parametrize("degrees", [10.0, 40.0])
def test_a_known_warp_is_found_again_there_and_back(degrees):
    """The rms distance from the truth is below a triangle's size, of which the warp moved vertices by many.

    So is what both ways together leave, there and back; of the larger warp, whose way takes ten seconds, there alone.
    """
    surface, truth = folded(BALL), flowed(BALL.vertices, degrees)
    here, there = points_of(BALL.vertices, surface), points_of(truth, surface)
    found = omtwarp.register(here, there, **FIRM)
    assert found.certificate.bijective and not flipped_faces(found.sphere, BALL.faces).any()
    assert found.largest_strain <= 2.0
    assert rms(found.sphere, truth) < EDGE < rms(found.start.sphere, truth)
    for values in found.correlations.values():
        assert values["after"] > max(0.9, values["before"])
    if degrees > 10.0:
        return
    back = omtwarp.register(there, here, **FIRM)
    returned = Locator(truth, BALL.faces, device="cpu").find(found.sphere).on_sphere(BALL.faces, back.sphere)
    assert rms(returned, BALL.vertices) < EDGE


@pytest.mark.parametrize(("degrees", "seed", "most_strain"), [(30.0, 2, 2.0), (40.0, 3, 3.0), (30.0, 2, 1e9)])
def test_warps_that_bring_folds_next_to_others_are_found_again(degrees, seed, most_strain):
    """Of these the rotation is away by several triangles, and by more than a fold's width where it is farthest."""
    surface, truth = folded(BALL, seed), flowed(BALL.vertices, degrees, seed + 1)
    here, there = points_of(BALL.vertices, surface), points_of(truth, surface)
    found = omtwarp.register(here, there, stiffness=0.3, max_strain=most_strain)
    assert found.certificate.bijective and rms(found.sphere, truth) < EDGE
    assert np.argmin([one["energy"] for one in found.starts]) == 0  # the match of places
    farthest = np.arccos((found.start.sphere * truth).sum(axis=1).min())
    assert np.degrees(farthest) > 26.0


@pytest.mark.parametrize("without", [(0,), (1,), (0, 1)])
def test_a_part_without_numbers_pulls_nothing(without):
    """A wall of 30 degrees with NaN on a side, or both: the rest of a known warp is found as without it.

    The mean over the sphere in their place, whose edge both sides would have to fit, leaves correlations of 0.97.
    """
    surface, truth = folded(BALL), flowed(BALL.vertices, 10.0)
    wall = BALL.vertices[:, 0] > np.cos(np.radians(30.0))
    folds = folding_features(surface, BALL.faces)
    sides = [{k: np.where(wall & (n in without), np.nan, v) for k, v in folds.items()} for n in range(2)]
    places = points_of(BALL.vertices, surface), points_of(truth, surface)
    found = omtwarp.register(*places, features=sides[0], to_features=sides[1], **FIRM)
    assert found.certificate.bijective and rms(found.sphere[~wall], truth[~wall]) < 0.3 * EDGE
    assert rms(found.sphere[wall], truth[wall]) < EDGE
    assert min(values["after"] for values in found.correlations.values()) > 0.99


def test_strain_at_vertices_is_that_of_their_triangles():
    by_area, _ = octaves(BALL.vertices, 2.0 * BALL.vertices, BALL.faces)
    np.testing.assert_allclose(strain_at_vertices(BALL.vertices, BALL.faces, by_area), 2.0, atol=1e-12)


def test_the_bound_of_strain_is_kept_where_the_truth_is_beyond_it():
    surface, truth = folded(BALL), flowed(BALL.vertices, 10.0)
    by_area, by_stretch = octaves(BALL.vertices, truth, BALL.faces)
    assert max(np.abs(by_area).max(), by_stretch.max()) > 0.45
    found = omtwarp.register(
        points_of(BALL.vertices, surface), points_of(truth, surface), stiffness=0.3, max_strain=0.3
    )
    assert found.certificate.bijective and 0.2 < found.largest_strain <= 0.3


def test_the_position_at_the_start_does_not_count():
    """Four positions of a surface of 642 vertices, whose edges are 7.8 degrees."""
    ball = shapes.icosphere(8)
    surface = folded(ball, highest=8)
    target = points_of(flowed(ball.vertices, 10.0), surface, ball)
    found = omtwarp.register(points_of(ball.vertices, surface, ball), target, **FIRM)
    for seed in range(4):
        turned = ball.vertices @ random_rotation(seed).T
        again = omtwarp.register(points_of(turned, surface, ball), target, **FIRM)
        assert rms(again.sphere, found.sphere) < 0.25 * 2.0 * EDGE
        assert again.correlations["sulc"]["after"] == pytest.approx(found.correlations["sulc"]["after"], abs=0.002)


def test_the_order_of_vertices_does_not_count():
    surface, target = folded(BALL), points_of(flowed(BALL.vertices, 10.0), folded(BALL))
    found = omtwarp.register(points_of(BALL.vertices, surface), target, **FIRM)
    order = np.random.default_rng(3).permutation(BALL.vertex_count)
    faces = np.argsort(order)[BALL.faces]
    shuffled = SpherePoints(mesh_grid(BALL.vertices[order], faces), surface[order])
    again = omtwarp.register(shuffled, target, **FIRM)
    np.testing.assert_allclose(again.sphere, found.sphere[order], atol=1e-3)


def test_a_doubtful_start_is_tried_from_several_rotations():
    """A surface of revolution, but for a bump: the rotations about its axis agree nearly as well as the true one."""
    x, y, z = BALL.vertices.T
    height = np.cos(5.0 * np.arccos(z)) + 0.3 * np.exp(-8.0 * ((x - 1.0) ** 2 + y**2 + z**2))
    found = omtwarp.register(
        points_of(BALL.vertices @ random_rotation(5).T, None),
        points_of(BALL.vertices, None),
        features={"height": height},
        to_features={"height": height},
    )
    assert found.doubtful and len(found.starts) > 2
    assert found.starts[1]["score"] >= found.starts[2]["score"]
    assert found.correlations["height"]["after"] > 0.99


def test_the_margin_is_that_of_the_best_rotation_whichever_is_taken(monkeypatch):
    """Of two rotations that agree nearly as well, the second leads to less energy, and has no next best one."""
    half_turn = np.diag([1.0, -1.0, -1.0])
    given = [Best(half_turn, 0.937, 0.935), Best(np.eye(3), 0.935, -1.0)]
    monkeypatch.setattr(Side, "rotations", lambda _self, _target: (given, True))
    points = points_of(BALL.vertices, folded(BALL))
    found = omtwarp.register(points, points, **FIRM)
    assert rms(found.start.sphere, BALL.vertices) < 1e-9 and found.doubtful
    assert found.facts()["registration_margin"] == pytest.approx(0.002)
    assert (found.to_dict()["score"], found.to_dict()["runner_up"]) == (0.937, 0.935)


def test_folding_does_not_depend_on_size_place_or_order():
    vertices = folded(BALL)
    found = folding_features(vertices, BALL.faces)
    order = np.random.default_rng(3).permutation(BALL.vertex_count)
    other = folding_features((7.0 * vertices @ random_rotation(2).T + 3.0)[order], np.argsort(order)[BALL.faces])
    for name, values in found.items():
        np.testing.assert_allclose(other[name], values[order], atol=1e-7 * np.abs(values).max())
    radius = np.linalg.norm(vertices, axis=1)
    assert np.corrcoef(found["sulc"], radius)[0, 1] < -0.5  # deep is near to the centre
    assert np.corrcoef(found["curv"], found["sulc"])[0, 1] < -0.5  # gyri are convex


def test_depth_is_that_of_freesurfer_on_its_average():
    datasets = pytest.importorskip("nilearn.datasets")
    files = datasets.fetch_surf_fsaverage("fsaverage5")
    white = omtwarp.read_mesh(files["white_left"])
    theirs = read_data(Path(files["sulc_left"])).values[:, 0]
    depth = folding_features(white.vertices, white.faces)["sulc"]
    areas = np.bincount(white.faces.ravel(), np.repeat(triangle_areas(white.vertices, white.faces), 3))
    a, b = (x - np.average(x, weights=areas) for x in (depth, theirs))
    assert (areas * a) @ b / np.sqrt(((areas * a) @ a) * ((areas * b) @ b)) > 0.97


def test_heat_damps_harmonics_as_the_sphere_does():
    """Of degree l by 1 / (1 + t l (l + 1)) in an implicit step."""
    fine = shapes.icosphere(32)
    flow = HeatFlow(fine, fine.vertices, 0.02)
    x, y, z = fine.vertices.T
    for values, degree in ((z, 1), (x * y, 2), (z * (x**2 - y**2), 3)):
        ratio = (flow.step(values) @ values) / (values @ values)
        assert ratio == pytest.approx(1.0 / (1.0 + 0.02 * degree * (degree + 1)), rel=2e-3)


def test_the_term_is_what_it_says():
    """Value by its sum, gradient by differences, with a matrix that has no negative part."""
    fine = shapes.icosphere(64)
    field = FeatureField(fine, np.column_stack([fine.vertices[:, 0] * fine.vertices[:, 1], fine.vertices[:, 2]]))
    x, y, z = BALL.vertices.T
    values = np.column_stack([x * y, z])
    moved = flowed(BALL.vertices, 5.0)
    areas, weights = np.full(BALL.vertex_count, 1.0 / BALL.vertex_count), np.array([2.0, 0.5])
    term = FeatureTerm(values, areas, field, weights)
    read, slopes = field.at(moved)
    exact = np.column_stack([moved[:, 0] * moved[:, 1], moved[:, 2]])
    np.testing.assert_allclose(read, exact, atol=3e-4)
    found = term.at(moved)
    assert found.value == pytest.approx((weights * (read - values) ** 2).sum() / BALL.vertex_count)
    step = np.cross(moved, [0.3, 0.5, 0.8])
    ahead, behind = (term.at(unit(moved + t * step)).value for t in (1e-3, -1e-3))
    assert float((found.gradient * step).sum()) == pytest.approx((ahead - behind) / 2e-3, rel=0.02)
    assert np.linalg.eigvalsh(found.hessian).min() > -1e-12
    tangent = np.abs(np.einsum("vdk,vd->vk", slopes, moved)).max()
    assert tangent < 0.1 * np.abs(slopes).max()


def test_the_gradient_of_a_field_is_that_of_its_values():
    """By differences, at points anywhere in triangles, so that line searches and Newton's steps agree."""
    x, y, z = BALL.vertices.T
    field = FeatureField(BALL, np.column_stack([x * y * z, np.sin(5.0 * x)]))
    rng = np.random.default_rng(6)
    points, step = unit(rng.normal(size=(300, 3))), 1e-6
    along = np.cross(points, rng.normal(size=points.shape))
    ahead, behind = (field.at(unit(points + t * along))[0] for t in (step, -step))
    slopes = np.einsum("pdc,pd->pc", field.at(points)[1], along)
    # A difference across an edge is between two slopes.
    assert np.median(np.abs((ahead - behind) / (2.0 * step) - slopes)) < 1e-8


def test_a_field_follows_functions_of_second_degree():
    x, y, z = BALL.vertices.T
    points = unit(np.random.default_rng(7).normal(size=(500, 3)))
    found = FeatureField(BALL, np.column_stack([x * y + z**2])).at(points)[0][:, 0]
    linear = np.square(EDGE) / 8.0  # what is lost by linear interpolation of a bend of 1
    np.testing.assert_allclose(found, points[:, 0] * points[:, 1] + points[:, 2] ** 2, atol=linear / 4.0)


def test_features_are_not_read_finer_than_the_meshes():
    """Two edges of 2,562 vertices are 8.7 degrees: the level of 12 is the last."""
    surface, truth = folded(BALL), flowed(BALL.vertices, 10.0)
    found = omtwarp.register(points_of(BALL.vertices, surface), points_of(truth, surface), **FIRM)
    assert [level["width"] for level in found.levels][-1] == 12.0
    fine = shapes.icosphere(40)
    again = omtwarp.register(points_of(fine.vertices, folded(fine), fine), points_of(fine.vertices, folded(fine), fine))
    assert [level["width"] for level in again.levels][-1] == 4.4


def test_strain_is_that_of_the_singular_values():
    moved = flowed(BALL.vertices, 20.0)
    by_area, by_stretch = octaves(BALL.vertices, moved, BALL.faces)

    def flat(points):
        p, q = (points[BALL.faces[:, k]] - points[BALL.faces[:, 0]] for k in (1, 2))
        along = p / np.linalg.norm(p, axis=1, keepdims=True)
        up = unit(np.cross(np.cross(p, q), along))
        return np.stack([np.stack([(e * along).sum(1), (e * up).sum(1)], axis=1) for e in (p, q)], axis=2)

    s = np.linalg.svd(flat(moved) @ np.linalg.inv(flat(BALL.vertices)), compute_uv=False)
    np.testing.assert_allclose(by_area, np.log2(s.prod(axis=1)), atol=1e-10)
    np.testing.assert_allclose(by_stretch, np.log2(s[:, 0] / s[:, 1]), atol=1e-6)


def test_flips_and_strain_are_taken_out_where_they_are():
    """A vertex carried over others: only those around it move, to a map without flips and within the bound."""
    moved = flowed(BALL.vertices, 5.0)
    tangled = moved.copy()
    tangled[700] = unit(moved[BALL.faces[BALL.faces == 700].max()][None] + 0.3 * moved[[701]])[0]
    far = np.linalg.norm(moved - moved[700], axis=1) > 0.6
    kept = kept_within(BALL, tangled, 1.0)
    assert not flipped_faces(kept, BALL.faces).any()
    by_area, by_stretch = octaves(BALL.vertices, kept, BALL.faces)
    assert max(np.abs(by_area).max(), by_stretch.max()) <= 1.0
    np.testing.assert_array_equal(kept[far], tangled[far])
    np.testing.assert_array_equal(kept_within(BALL, moved, 2.0), moved)


def test_a_registered_map_keeps_its_surface_and_says_what_was_done():
    surface, truth = folded(BALL), flowed(BALL.vertices, 10.0)
    ones = np.ones(BALL.vertex_count)
    result = MapResult(surface, BALL.faces, BALL.vertices, BALL.vertices, ones, report={"optimality": {"gap": 0.1}})
    found = omtwarp.register(result, points_of(truth, surface))
    registered = found.registered(result)
    np.testing.assert_array_equal(registered.sphere, found.sphere)
    np.testing.assert_array_equal(registered.vertices, surface)
    np.testing.assert_allclose(registered.conformal, found.start.sphere, atol=1e-12)
    assert registered.report["registration"]["certificate"]["flips"] == 0 and "optimality" not in registered.report


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"stiffness": 0.0}, "the stiffness"),
        ({"max_strain": -1.0}, "max_strain"),
        ({"features": {"a": np.ones(3)}}, "both sides"),
        ({"features": {"a": BALL.vertices[:, 0]}, "to_features": {"a": np.ones(3)}}, "the target"),
        ({"features": {"a": np.ones(BALL.vertex_count)}, "to_features": {"a": BALL.vertices[:, 0]}}, "constant"),
        ({"features": [BALL.vertices[:, 0]], "to_features": [BALL.vertices[:, 0]]}, "features: must be a dictionary"),
        ({"features": BALL.vertices, "to_features": BALL.vertices}, "features: must be a dictionary"),
        (
            {"features": {"a": [[1.0], [1.0, 2.0]]}, "to_features": {"a": BALL.vertices[:, 0]}},
            "'a' of the map: must be",
        ),
        ({"feature_weights": [1.0, 2.0]}, "feature_weights: must be a dictionary"),
        ({"feature_weights": {"thickness": 1.0}}, "no feature 'thickness'"),
        ({"feature_weights": {"sulc": 0.0, "curv": 0.0}}, "all weights"),
    ],
)
def test_bad_input_is_one_line(options, words):
    with pytest.raises(OmtwarpError, match=words) as caught:
        omtwarp.register(points_of(BALL.vertices, folded(BALL)), points_of(BALL.vertices, folded(BALL)), **options)
    assert "\n" not in str(caught.value)


def test_a_sphere_alone_has_no_folds():
    with pytest.raises(OmtwarpError, match="give the surface, or features"):
        omtwarp.register(points_of(BALL.vertices, None), points_of(BALL.vertices, folded(BALL)))


def test_a_template_is_a_sphere_with_its_surface():
    """Registered to itself from a rotated position, the average hemisphere comes back."""
    pytest.importorskip("nilearn")
    fixed, _ = target_points("fsaverage5-left")
    assert len(fixed.grid.points) == len(fixed.vertices) == 10242
    moved = SpherePoints(mesh_grid(fixed.grid.points @ random_rotation(4).T, fixed.grid.triangles), fixed.vertices)
    found = omtwarp.register(moved, "fsaverage5-left")
    assert not found.doubtful and found.certificate.bijective
    assert rms(found.sphere, fixed.grid.points) < 1e-3 and found.largest_strain < 0.05


def test_smoothing_gives_no_weight_to_what_is_not_known():
    ball = omtwarp.shapes.icosphere(12)
    wall = ball.vertices[:, 0] < -0.8
    for values in (np.full(ball.vertex_count, 2.5), np.random.default_rng(3).normal(size=(ball.vertex_count, 2))):
        smooth = smoothed(
            ball, ball.vertices, np.where(wall if values.ndim == 1 else wall[:, None], np.nan, values), 0.3
        )
        assert np.isnan(smooth[wall]).all() and np.isfinite(smooth[~wall]).all()
        far = ball.vertices[:, 0] > 0.9
        np.testing.assert_allclose(smooth[far], smoothed(ball, ball.vertices, values, 0.3)[far], atol=1e-4)
    np.testing.assert_allclose(smoothed(ball, ball.vertices, np.where(wall, np.nan, 2.5), 0.3)[~wall], 2.5)
