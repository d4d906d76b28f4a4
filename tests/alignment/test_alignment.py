"""Alignment of spheres: rotations found again, own axes of known shapes, group means."""

from __future__ import annotations

import os
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sphere_truths import SHARED, pushed_north, random_rotation

import omtwarp
from omtwarp.alignment import align, align_to_axes, procrustes_mean
from omtwarp.alignment.group import superpose
from omtwarp.alignment.rotation_search import (
    best_rotation,
    complex_coefficients,
    correlation_grid,
    derivatives,
    rotated,
)
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.harmonics import real_harmonics
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.resampling import SpherePoints, resample
from omtwarp.spheres import mesh_grid
from omtwarp.topology.kind import parts_of

SPHERE = shapes.icosphere(20)


def blob_map(seed: int = 3) -> SpherePoints:
    blob = shapes.blob(seed=seed, sphere=SPHERE)
    return SpherePoints(mesh_grid(SPHERE.vertices, SPHERE.faces, "blob"), blob.vertices)


def turned(
    points: SpherePoints, rotation: np.ndarray, pose: np.ndarray | None = None, noise: float = 0.0, seed: int = 0
):
    """Turn a map's sphere, move its surface to another pose, and add noise relative to the surface's size."""
    grid = mesh_grid(points.grid.points @ rotation.T, points.grid.triangles, "turned")
    vertices = points.vertices if pose is None else points.vertices @ pose.T + [1.0, -2.0, 0.5]
    size = np.ptp(points.vertices, axis=0).max()
    return SpherePoints(grid, vertices + noise * size * np.random.default_rng(seed).normal(size=vertices.shape))


def degrees_apart(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(one @ other.T).magnitude()))


def test_rotated_coefficients_are_those_of_the_rotated_function():
    rng = np.random.default_rng(0)
    coefficients, rotation = rng.normal(size=(36, 2)), random_rotation(1)
    points = rng.normal(size=(80, 3))
    moved = real_harmonics(points @ rotation, 5) @ coefficients  # f(R⁻¹ u)
    expected = np.linalg.lstsq(real_harmonics(points, 5), moved, rcond=None)[0]
    found = rotated(complex_coefficients(coefficients), rotation)
    np.testing.assert_allclose(found, complex_coefficients(expected), atol=1e-12)


def test_grid_of_correlations_is_that_of_integrals():
    rng = np.random.default_rng(2)
    a, b = rng.normal(size=(16, 1)), rng.normal(size=(16, 1))
    grid = correlation_grid(complex_coefficients(a), complex_coefficients(b), 16)
    for place in ((0, 0, 0), (3, 5, 7), (15, 8, 1)):
        rotation = Rotation.from_euler("ZYZ", 2 * np.pi / 16 * np.array(place)).as_matrix()
        expected = np.vdot(complex_coefficients(b), rotated(complex_coefficients(a), rotation)).real
        assert abs(grid[place] - expected) < 1e-12 * np.abs(grid).max()


def test_derivatives_are_those_of_differences():
    rng = np.random.default_rng(3)
    a, b = (complex_coefficients(rng.normal(size=(25, 2))) for _ in range(2))

    def value(move):
        return np.vdot(b, rotated(a, Rotation.from_rotvec(move).as_matrix())).real

    gradient, hessian = derivatives(a, b)
    step = 1e-4
    for k in range(3):
        e = np.eye(3)[k] * step
        assert abs((value(e) - value(-e)) / (2 * step) - gradient[k]) < 1e-6
        for m in range(3):
            d = np.eye(3)[m] * step
            mixed = (value(e + d) - value(e - d) - value(d - e) + value(-e - d)) / (4 * step * step)
            assert abs(mixed - hessian[k, m]) < 1e-4


def test_best_of_all_rotations_beats_random_ones():
    rng = np.random.default_rng(4)
    a, b = (complex_coefficients(rng.normal(size=(49, 1))) for _ in range(2))
    best = best_rotation(a, b)
    a[0] = b[0] = 0.0
    norm = np.linalg.norm(a) * np.linalg.norm(b)
    others = [np.vdot(b, rotated(a, r)).real / norm for r in Rotation.random(3000, random_state=0).as_matrix()]
    assert best.score >= max(others) and best.score > best.runner_up > 0


@pytest.mark.parametrize("seed", range(6))
def test_turns_of_a_blob_are_found_again(seed):
    rotation = random_rotation(seed)
    other = turned(blob_map(), rotation, random_rotation(seed + 50), noise=1e-3, seed=seed)
    found = align(blob_map(), other, by="features")
    assert degrees_apart(found.rotation, rotation) < 0.1
    np.testing.assert_allclose(found.sphere, blob_map().grid.points @ found.rotation.T, atol=1e-14)
    assert found.score > 0.999 and found.score > found.runner_up


def test_a_feature_that_is_noise_does_not_move_what_another_determines():
    one, rotation = blob_map(), random_rotation(3)
    radius = np.linalg.norm(one.vertices - one.vertices.mean(axis=0), axis=1)
    rng = np.random.default_rng(1)

    def features():
        return {"radius": radius, "noise": radius + 2.0 * np.std(radius) * rng.normal(size=len(radius))}

    found = align(one, turned(one, rotation), features=features(), to_features=features())
    assert degrees_apart(found.rotation, rotation) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hippocampus_12k", "cortex_white_lh_20k", "bucket_10k"])
def test_turns_of_scans_are_found_again(name):
    path = SHARED / "data" / f"{name}.ply"
    if not path.exists():
        pytest.skip("the scans are not beside this checkout")
    mesh = omtwarp.read_mesh(path)
    result = omtwarp.map_to_sphere((mesh.vertices, mesh.faces), until="conformal", device="cpu")
    points = SpherePoints(mesh_grid(result.sphere, result.faces, name), result.vertices)
    for seed in range(int(os.environ.get("OMTWARP_TURNS", "4"))):  # 100 take a minute or two
        rotation = random_rotation(seed)
        other = turned(points, rotation, random_rotation(seed + 500), noise=1e-3, seed=seed)
        assert degrees_apart(align(points, other, by="features").rotation, rotation) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("area", "degrees", "apart"), [("natural", 0.4, 0.8), ("small", 0.6, 2.5)])
def test_cortex_without_its_medial_wall_is_aligned_to_the_whole(area, degrees, apart):
    """Against the best rotation of equal vertices, and millimetres on one grid (medians)."""
    path = SHARED / "data" / "cortex_white_lh_20k.ply"
    if not path.exists():
        pytest.skip("the scans are not beside this checkout")
    mesh = omtwarp.read_mesh(path)
    around = mesh.vertices - mesh.vertices.mean(axis=0)
    middle = np.array([around[:, 0].max(), 0.0, 0.0])
    wall = np.linalg.norm((around - middle) * [1.0, 0.5, 1.0], axis=1) < 18.0
    used, kept = np.unique(mesh.faces[~wall[mesh.faces].any(axis=1)], return_inverse=True)
    part = max(parts_of(mesh.vertices[used], kept.reshape(-1, 3)), key=lambda one: len(one.faces))
    whole = omtwarp.map_to_sphere((mesh.vertices, mesh.faces), device="cpu")
    filled = omtwarp.map_surface((part.vertices, part.faces), domain="sphere", fill_area=area, device="cpu")
    found = align(filled, whole)
    left, _, right = np.linalg.svd(filled.sphere.T @ whole.sphere[used[part.vertex_origin]])
    assert degrees_apart(found.rotation, (left @ right).T) < degrees
    ours = omtwarp.resample(found.turned(filled), "fsaverage5", device="cpu")
    theirs = omtwarp.resample(whole, "fsaverage5", device="cpu").surface()
    assert np.median(np.linalg.norm(ours.surface() - theirs, axis=1)[~ours.empty]) < apart


def test_another_mesh_of_the_same_shape():
    """A rotation between two triangulations of one shape is found, from the shape alone."""
    rotation = random_rotation(9)
    fine = shapes.icosphere(27)
    blob = shapes.blob(seed=3, sphere=fine)
    other = SpherePoints(mesh_grid(fine.vertices @ rotation.T, fine.faces, "finer"), blob.vertices)
    assert degrees_apart(align(blob_map(), other).rotation, rotation) < 0.1


def test_given_features_are_enough_for_a_sphere():
    points = SPHERE.vertices
    field = points[:, 0] ** 3 + points[:, 1] * points[:, 2] + 0.3 * points[:, 2]
    rotation = random_rotation(12)
    found = align(
        (points, SPHERE.faces),
        (points @ rotation.T, SPHERE.faces),
        features={"field": field},
        to_features={"field": 5.0 + 2.0 * field},
    )
    assert found.method == "features" and degrees_apart(found.rotation, rotation) < 1e-4


def test_a_feature_without_numbers_in_a_part_finds_the_same_turn():
    """A wall of NaN counts for nothing: the turn is found as with the numbers, and no number is none."""
    one, rotation = blob_map(), random_rotation(4)
    other = turned(one, rotation)
    field = one.grid.points @ [0.3, 1.0, -0.4] + (one.grid.points[:, 0] * one.grid.points[:, 2]) ** 2
    wall = np.where(one.grid.points @ [0.0, 0.6, 0.8] > 0.85, np.nan, field)
    found = align(one, other, features={"a": wall}, to_features={"a": wall}, by="features")
    assert degrees_apart(found.rotation, rotation) < 0.5
    with pytest.raises(OmtwarpError, match="or none at all"):
        align(one, other, features={"a": np.full(len(field), np.nan)}, to_features={"a": wall})


def test_mirror_image_is_found_where_asked_for():
    blob = blob_map()
    rotation = random_rotation(2)
    image = SpherePoints(
        mesh_grid(blob.grid.points * [1, -1, 1] @ rotation.T, blob.grid.triangles[:, ::-1], "image"),
        blob.vertices * [1, -1, 1],
    )
    with pytest.warns(omtwarp.OmtwarpWarning, match="the mirror image fits better: score 1.000, not 0"):
        plain = align(blob, image, by="features")
    found = align(blob, image, by="features", mirror=True)
    assert found.mirrored and not plain.mirrored and found.score > 0.99999 > plain.score
    np.testing.assert_allclose(found.rotation, rotation @ np.diag([1.0, -1.0, 1.0]), atol=1e-6)
    np.testing.assert_allclose(found.sphere, image.grid.points, atol=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_reversed_sign_is_warned_of(sign):
    """A feature with the other sign on one side puts a shape elsewhere; the warning names it, and only then."""
    blob = blob_map()
    rotation = random_rotation(5)
    other = turned(blob, rotation)
    radius = np.linalg.norm(blob.vertices, axis=1)
    height = blob.vertices[:, 0] * blob.vertices[:, 2]
    ours, theirs = {"sulc": radius, "height": height}, {"sulc": sign * radius, "height": height}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = align(blob, other, by="features", features=ours, to_features=theirs)
    said = [str(one.message) for one in caught]
    assert found.margin == found.score - found.runner_up > 0.0
    if sign > 0.0:
        assert not said and degrees_apart(found.rotation, rotation) < 1e-3
    else:
        assert any("'sulc' fits better with the other sign: score 1.000" in words for words in said)
        assert not any("'height'" in words for words in said)
        align(blob, other, by="features", features=ours, to_features=theirs, check=False)
        assert len(caught) == len(said)


def test_same_faces_are_aligned_by_vertices():
    blob = blob_map()
    rotation = random_rotation(4)
    found = align(blob, turned(blob, rotation))
    assert found.method == "vertices"
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.score, 1.0, atol=1e-12)


def test_equal_faces_alone_do_not_make_two_shapes_correspond():
    """Two shapes on one grid, one rotated on it, are aligned by shape; by vertex numbers they would not move."""
    blob, rotation = blob_map(), random_rotation(6)
    turned_grid = mesh_grid(SPHERE.vertices @ rotation.T, SPHERE.faces)
    other = resample(SpherePoints(turned_grid, blob.vertices), (SPHERE.vertices, SPHERE.faces), device="cpu")
    on_grid = SpherePoints(blob.grid, other.surface())
    found = align(blob, on_grid)
    assert (found.method, found.basis) == ("features", "radius, areas")
    assert degrees_apart(found.rotation, rotation) < 0.5
    asked = align(blob, on_grid, by="vertices")
    assert degrees_apart(asked.rotation, np.eye(3)) < 1e-6 and asked.basis == "equal faces, as asked for"


def test_why_vertices_were_taken_is_said():
    blob, rotation = blob_map(), random_rotation(7)
    noisy = turned(blob, rotation, random_rotation(8), noise=1e-3)
    found = align(blob, SpherePoints(noisy.grid, 3.0 * noisy.vertices))
    assert (found.method, found.basis) == ("vertices", "equal faces, and one surface in both")
    alone = align((SPHERE.vertices, SPHERE.faces), noisy)
    assert (alone.method, alone.basis) == ("vertices", "equal faces, and a side is a sphere alone")
    assert degrees_apart(found.rotation, rotation) < 1e-6 and degrees_apart(alone.rotation, rotation) < 1e-6
    assert align(blob, noisy, by="features").to_dict()["basis"] == "radius, areas"
    assert align(blob).basis == "the shape's own axes"


@pytest.mark.parametrize("seed", range(4))
def test_axes_of_an_ellipsoid(seed):
    """Where x = A u exactly, the frame is the ellipsoid's, and the sphere's axes go to the ends of the ellipsoid's."""
    pose, turn = random_rotation(seed), random_rotation(seed + 20)
    tailed = SPHERE.vertices + 0.05 * (SPHERE.vertices**2 - 1.0 / 3.0)  # tails towards +x, +y and +z
    surface = tailed * [3.0, 2.0, 1.0] @ pose.T
    given = SpherePoints(mesh_grid(SPHERE.vertices @ turn.T, SPHERE.faces, "ellipsoid"), surface)
    found = align_to_axes(given)
    np.testing.assert_allclose(found.frame, pose.T, atol=2e-3)
    np.testing.assert_allclose(found.sphere, SPHERE.vertices, atol=2e-3)
    assert found.score > 0.01


def test_axes_do_not_depend_on_the_pose():
    blob = blob_map(5)
    one = align_to_axes(blob)
    other = align_to_axes(turned(blob, random_rotation(1), random_rotation(2)))
    np.testing.assert_allclose(one.sphere, other.sphere, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(one.rotation), 1.0, atol=1e-12)


def test_group_of_turned_copies_has_the_shape_for_its_mean():
    blob = blob_map()
    members = [turned(blob, random_rotation(k), random_rotation(k + 30)) for k in range(4)]
    group = procrustes_mean(members, grid="ico4", device="cpu")
    assert group.surfaces.shape == (4, 2562, 3)
    spread = np.sqrt(np.mean(np.sum((group.surfaces - group.mean) ** 2, axis=2)))
    size = np.sqrt(np.mean(np.sum(group.mean**2, axis=1)))
    assert spread < 2e-3 * size  # what resampling to other places leaves
    back = [rotation @ random_rotation(k) for k, rotation in enumerate(group.rotations)]
    assert max(degrees_apart(one, back[0]) for one in back) < 0.05


def test_superposition_takes_poses_and_sizes_out():
    rng = np.random.default_rng(0)
    shape = rng.normal(size=(50, 3))
    factors = np.array([0.5, 1.0, 2.0])
    copies = np.stack([f * shape @ random_rotation(k).T + k for k, f in enumerate(factors)])
    posed, mean, scales, _ = superpose(copies, np.ones(50), scale=True)
    np.testing.assert_allclose(posed, np.broadcast_to(mean, posed.shape), atol=1e-9)
    np.testing.assert_allclose(scales * factors, scales[0] * factors[0])


@pytest.mark.parametrize("digits", [15, 6])
def test_balls_are_aligned_as_they_lie_in_space(digits):
    """Two balls of other triangles, sizes and places, their maps turned at will: directions in space correspond."""
    one, other = shapes.icosphere(7), shapes.icosphere(9)
    rng = np.random.default_rng(3)
    turn, again = random_rotation(rng), random_rotation(rng)
    near = np.round(3.0 * one.vertices + (1.0, 2.0, 3.0), digits)
    far = np.round(0.5 * other.vertices, digits)
    found = align(
        SpherePoints(mesh_grid(one.vertices @ turn.T, one.faces, "one"), near),
        SpherePoints(mesh_grid(other.vertices @ again.T, other.faces, "other"), far),
    )
    assert found.method == "places" and "directions in space" in found.basis and found.score > 0.999
    np.testing.assert_allclose(found.sphere, one.vertices @ again.T, atol=1e-4)


def test_a_group_of_balls_is_aligned_as_they_lie_in_space():
    """They have no features: the mean is a ball, whose points are where those of the first are."""
    ball = shapes.icosphere(7)
    turns = [random_rotation(k) for k in range(3)]
    members = [SpherePoints(mesh_grid(ball.vertices @ turn.T, ball.faces, "ball"), ball.vertices) for turn in turns]
    group = procrustes_mean(members, grid="ico2", device="cpu")
    for turn, rotation in zip(turns, group.rotations, strict=True):
        np.testing.assert_allclose(rotation @ turn, turns[0], atol=1e-6)
    assert not group.mirrored.any() and np.abs(group.surfaces - group.mean).max() < 1e-6


def test_registered_maps_of_a_group_stay_as_they_are():
    """Their points correspond already; aligned to something else they are registered no more."""
    ball, shape = shapes.icosphere(7), shapes.blob(3, amplitude=0.3, degree=4, sphere=980)
    here = MapResult(shape.vertices, shape.faces, ball.vertices, ball.vertices, np.ones(ball.vertex_count))
    maps = [here.turned(turn).with_arrays({"report": {"registration": {}}}) for turn in (np.eye(3), random_rotation(3))]
    np.testing.assert_array_equal(procrustes_mean(maps, grid="ico2", device="cpu").rotations, [np.eye(3)] * 2)
    maps[1] = align(maps[1], "axes").turned(maps[1])
    rotations = procrustes_mean(maps, grid="ico2", device="cpu").rotations
    assert degrees_apart(rotations[0], rotations[1]) > 10.0


def test_same_bits_twice():
    other = turned(blob_map(), random_rotation(1), noise=1e-3)
    one, two = align(blob_map(), other, by="features"), align(blob_map(), other, by="features")
    np.testing.assert_array_equal(one.rotation, two.rotation)


@pytest.mark.parametrize("exponent", [-300, -160, 100, 300])
def test_any_unit_gives_the_same_alignment(exponent):
    """Areas of coordinates of 1e±160 are beyond float64; rotations to axes, a surface and a template are not."""
    blob = blob_map()
    scaled = SpherePoints(blob.grid, blob.vertices * 10.0**exponent)
    other = SpherePoints(mesh_grid(pushed_north(SPHERE.vertices, 0.2), SPHERE.faces), blob.vertices)
    for options in ({}, {"to": other}, {"to": other, "by": "features"}):
        plain, found = (align(points, **options) for points in (blob, scaled))
        np.testing.assert_allclose(found.rotation, plain.rotation, atol=1e-7)
        assert found.method == plain.method and found.score == pytest.approx(plain.score, abs=1e-9)


def test_what_cannot_be_aligned_is_refused():
    blob = blob_map()
    bare = (SPHERE.vertices, SPHERE.faces)
    other = shapes.icosphere(6)
    with pytest.raises(OmtwarpError, match="no features of its own"):
        align(bare, (other.vertices, other.faces))
    with pytest.raises(OmtwarpError, match="has no axes"):
        align(bare)
    with pytest.raises(OmtwarpError, match="different faces"):
        align(blob, (other.vertices, other.faces), by="vertices")
    with pytest.raises(OmtwarpError, match="same names"):
        align(blob, blob, features={"a": np.ones(4)}, to_features={"b": np.ones(4)})
    with pytest.raises(OmtwarpError, match="'a' of the map: shape"):
        align(blob, blob, features={"a": np.ones(4)}, to_features={"a": np.ones(4)})
    count = len(SPHERE.vertices)
    with pytest.raises(OmtwarpError, match="constant"):
        align(blob, blob, features={"a": np.ones(count)}, to_features={"a": np.ones(count)})
    for wrong in ("abc", 3, SPHERE.vertices, [np.ones(count)]):
        with pytest.raises(OmtwarpError, match="features: must be a dictionary of them by name"):
            align(blob, blob, features=wrong, to_features=wrong)
        with pytest.raises(OmtwarpError, match="to_features: must be a dictionary of them by name"):
            align(blob, blob, to_features=wrong)
    with pytest.raises(OmtwarpError, match="at least two maps"):
        procrustes_mean([blob])
    with pytest.raises(OmtwarpError, match="maps: must be a list of two maps or more"):
        procrustes_mean(3)
    listed, yielded = (
        procrustes_mean([blob, blob], grid="ico2"),
        procrustes_mean((b for b in (blob, blob)), grid="ico2"),
    )
    assert np.array_equal(listed.mean, yielded.mean)
    for degree in (0, 65, 2.5, "many"):
        with pytest.raises(OmtwarpError, match="the degree: must be a whole number from 1 to 64"):
            align(blob, blob, degree=degree)
    with pytest.raises(OmtwarpError, match="the degree"):
        procrustes_mean([blob, blob], degree=-1)
    assert align(blob, blob, degree=16.0).score == align(blob, blob, degree=16).score
    with pytest.raises(OmtwarpError, match="needs a grid with triangles"):
        procrustes_mean([blob, blob], grid="healpix:4")
    stretched = SpherePoints(mesh_grid(pushed_north(SPHERE.vertices, 0.9), SPHERE.faces), blob.vertices)
    assert align(blob, stretched, by="features").score < 1.0


def test_an_alignment_prints_in_a_line():
    ball = shapes.icosphere(3)
    words = repr(align((ball.vertices, ball.faces), ball))
    assert words.startswith("Alignment(by vertices, score 1.0000") and "\n" not in words
