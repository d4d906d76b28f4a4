"""Resampling against closed forms, identities and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import sparse
from sphere_truths import pushed_north, random_rotation, twisted

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.resampling import resample
from omtwarp.resampling.resample import overlap_areas
from omtwarp.spheres import mesh_grid, named_grid

METHODS = ["barycentric", "nearest", "adaptive", "conservative"]


def irregular(seed: int = 0, count: int = 12):
    """Make a bijective map of the sphere with triangles of very different sizes and shapes."""
    sphere = shapes.icosphere(count)
    points = twisted(pushed_north(sphere.vertices @ random_rotation(seed).T, 0.7), 1.5)
    return mesh_grid(points, sphere.faces, "irregular")


def smooth(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    return 1.5 + x * y + 0.5 * z**3 - 0.3 * x


@pytest.mark.parametrize("method", METHODS)
def test_constants_are_kept(method):
    weights = resample(irregular(), named_grid("ico3"), method=method, device="cpu").matrix
    np.testing.assert_allclose(np.asarray(weights.sum(axis=1)).ravel(), 1.0, atol=1e-14)
    assert weights.data.min() >= 0.0


@pytest.mark.parametrize("method", METHODS)
def test_same_sphere_gives_the_same_data(method):
    grid = irregular(1)
    values = np.random.default_rng(0).normal(size=(len(grid.points), 2))
    np.testing.assert_allclose(resample(grid, grid, method=method, device="cpu").apply(values), values, atol=1e-10)


@pytest.mark.parametrize(("method", "order"), [("barycentric", 2.0), ("conservative", 1.0), ("nearest", 1.0)])
def test_order_of_convergence(method, order):
    target = named_grid("healpix:20")
    errors = []
    for level in (3, 4, 5):
        grid = named_grid(f"ico{level}")
        found = resample(grid, target, method=method, device="cpu").apply(smooth(grid.points))
        errors.append(np.sqrt(np.mean((found - smooth(target.points)) ** 2)))
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert rates.min() > 0.75 * order, (errors, rates)


@settings(max_examples=8)
@given(seed=st.integers(0, 1000))
@pytest.mark.parametrize("name", ["ico3", "healpix:7", "equiangular:12x20", "octahedral:14"])
def test_conservative_keeps_integrals_bounds_and_signs(name, seed):
    source, target = irregular(seed), named_grid(name)
    values = np.random.default_rng(seed).exponential(size=len(source.points)) ** 3
    found = resample(source, target, method="conservative", device="cpu").apply(values)
    before, after = values @ source.areas, found @ target.areas
    assert abs(after - before) <= 1e-12 * before
    assert found.min() >= 0.0 and found.max() <= values.max() * (1 + 1e-14)


def test_overlaps_are_those_of_many_random_points():
    source, target = irregular(3, count=2), named_grid("octahedral:4")
    areas = overlap_areas(target, source, device="cpu").toarray()
    np.testing.assert_allclose(areas.sum(axis=1), target.areas, rtol=1e-12)
    np.testing.assert_allclose(areas.sum(axis=0), source.areas, rtol=1e-12)
    count = 200_000
    points = np.random.default_rng(0).normal(size=(count, 3))

    def owners(grid):
        corners, owner = grid.cells
        inside = np.ones((count, len(owner)), bool)
        for k in range(4):
            inside &= points @ np.cross(corners[:, k], corners[:, (k + 1) % 4]).T >= 0
        return owner[inside.argmax(axis=1)]

    pairs = np.zeros_like(areas)
    np.add.at(pairs, (owners(target), owners(source)), 4.0 * np.pi / count)
    deviation = np.sqrt(4.0 * np.pi * np.maximum(areas, 1e-4) / count)
    assert np.abs(pairs - areas).max() < 5.5 * deviation.max()
    assert (np.abs(pairs - areas) < 6.0 * deviation).all()


def test_an_octant_in_closed_form():
    """The octahedron's faces and the six cells of its vertices overlap in thirds of octants."""
    sphere = shapes.icosphere(1)
    octahedron = mesh_grid(np.concatenate([np.eye(3), -np.eye(3)]), _octahedron_faces(), "octahedron")
    np.testing.assert_allclose(octahedron.areas, 4.0 * np.pi / 6.0, rtol=1e-14)
    turned = mesh_grid(octahedron.points @ random_rotation(5).T, octahedron.faces, "turned")
    areas = overlap_areas(turned, octahedron, device="cpu")
    np.testing.assert_allclose(np.asarray(areas.sum(axis=0)).ravel(), 4.0 * np.pi / 6.0, rtol=1e-13)
    icosahedron = mesh_grid(sphere.vertices, sphere.faces, "icosahedron")
    np.testing.assert_allclose(icosahedron.areas, icosahedron.areas.mean(), rtol=1e-13)


def _octahedron_faces() -> np.ndarray:
    faces = []
    for i in (0, 3):
        for j in (1, 4):
            for k in (2, 5):
                flips = (i == 3) + (j == 4) + (k == 5)
                faces.append((i, j, k) if flips % 2 == 0 else (i, k, j))
    return np.array(faces)


def test_nearest_is_the_nearest():
    source, target = irregular(4), named_grid("ico2")
    chosen = resample(source, target, method="nearest").matrix.indices
    np.testing.assert_array_equal(chosen, (target.points @ source.points.T).argmax(axis=1))


def test_adaptive_uses_every_source_point_and_its_area():
    fine, coarse = named_grid("ico5"), named_grid("ico3")
    weights = resample(fine, coarse, method="adaptive", device="cpu").matrix
    assert (np.asarray((weights != 0).sum(axis=0)).ravel() > 0).all()
    assert (np.asarray((resample(fine, coarse).matrix != 0).sum(axis=0)).ravel() == 0).any()
    values = smooth(fine.points)
    kept = (coarse.areas @ (weights @ values)) / (fine.areas @ values) - 1
    assert abs(kept) < 2e-3


def test_labels_go_to_the_largest_overlap():
    source, target = irregular(6), named_grid("ico2")
    keys = np.random.default_rng(1).choice([-3, 0, 7, 1000], size=len(source.points))
    found = resample(source, target, method="conservative", device="cpu").labels(keys)
    areas = overlap_areas(target, source, device="cpu").toarray()
    votes = np.stack([areas[:, keys == key].sum(axis=1) for key in (-3, 0, 7, 1000)], axis=1)
    np.testing.assert_array_equal(found, np.array([-3, 0, 7, 1000])[votes.argmax(axis=1)])


def test_vertices_without_a_label_have_label_zero():
    """As a medial wall, where files of CIFTI's have NaN."""
    source = irregular(6)
    keys = np.random.default_rng(2).choice([3.0, 5.0, np.nan], size=len(source.points))
    found = resample(source, named_grid("ico2"), device="cpu")
    np.testing.assert_array_equal(found.labels(keys), found.labels(np.nan_to_num(keys).astype(int)))


def test_surface_has_the_same_faces_for_all_subjects():
    subjects = [shapes.blob(seed=k, amplitude=0.2, sphere=shapes.icosphere(16)) for k in (1, 2)]
    sphere = shapes.icosphere(16)
    grid = named_grid("ico4")
    meshes = []
    for surface in subjects:
        found = resample((sphere.vertices, sphere.faces), grid, device="cpu")
        with pytest.raises(OmtwarpError, match="sphere without its surface"):
            found.surface()
        meshes.append(found.apply(surface.vertices))
        rows = np.linalg.norm(found.apply(sphere.vertices), axis=1)
        assert rows.max() <= 1.0 + 1e-12 and rows.min() > 0.98
    assert meshes[0].shape == meshes[1].shape == (2562, 3)


def test_matrix_is_saved_and_read(tmp_path):
    found = resample("ico3", "healpix:4", device="cpu")
    found.save(tmp_path / "weights.npz")
    again = sparse.load_npz(tmp_path / "weights.npz")
    assert (again != found.matrix).nnz == 0


@pytest.mark.parametrize("method", METHODS)
def test_same_bits_twice(method, device):
    one, other = (resample(irregular(7), named_grid("ico4"), method=method, device=device).matrix for _ in range(2))
    np.testing.assert_array_equal(one.data, other.data)
    np.testing.assert_array_equal(one.indices, other.indices)


@pytest.mark.parametrize("method", METHODS)
def test_points_without_a_number_are_carried_and_not_spread(method):
    """A wall of NaN stays as large as it is, to half of its edges, and numbers beside it are unharmed."""
    found = resample("ico5", irregular(7), method=method, device="cpu")
    source, target = (end.grid.points for end in (found.source, found.target))
    values = np.stack([np.where(source[:, 2] > 0.6, np.nan, 3.0), source[:, 0], np.full(len(source), np.nan)], axis=1)
    carried = found.apply(values)
    wall = np.isnan(carried[:, 0])
    edge = 0.2  # of ico5 and of the target, together
    assert wall[target[:, 2] > 0.6 + edge].all() and not wall[target[:, 2] < 0.6 - edge].any()
    assert abs(wall.sum() - (target[:, 2] > 0.6).sum()) < 0.1 * wall.sum()
    np.testing.assert_allclose(carried[~wall, 0], 3.0, rtol=1e-12)
    np.testing.assert_allclose(carried[:, 1], found.apply(values[:, 1]), rtol=1e-12, atol=1e-15)
    assert np.isnan(carried[:, 2]).all()


def test_data_that_do_not_fit_are_refused():
    found = resample("ico2", "ico3", device="cpu")
    with pytest.raises(OmtwarpError, match="161 where ico2 has 162"):
        found.apply(np.ones(161))
    with pytest.raises(OmtwarpError, match="infinite at 1 of 162 points, first point 5"):
        found.apply(np.where(np.arange(162) == 5, np.inf, 1.0))
    with pytest.raises(OmtwarpError, match="whole numbers"):
        found.labels(np.full(162, 0.5))
    with pytest.raises(OmtwarpError, match="unknown interpolation 'cubic'"):
        resample("ico2", "ico3", method="cubic")
    with pytest.raises(OmtwarpError, match="areas of the source"):
        resample("ico2", "ico3", method="adaptive", source_areas=np.ones(3))
    flipped = shapes.icosphere(4)
    points = flipped.vertices.copy()
    points[20] = -points[20] * 0.2 + points[flipped.faces[(flipped.faces == 20).any(axis=1)][0]].sum(axis=0)
    points /= np.linalg.norm(points, axis=1)[:, None]
    around = flipped.faces[(flipped.faces == 20).any(axis=1)]
    points[20] = 2.5 * points[around[0]].sum(axis=0) - 1.5 * points[around[2]].sum(axis=0)
    points[20] /= np.linalg.norm(points[20])
    with pytest.raises(OmtwarpError, match="turned over"):
        resample((points, flipped.faces), "ico2", method="conservative", device="cpu")


@pytest.mark.parametrize("keys", [[[1], [1, 2]], ["a"] * 162, [2**70] * 162, np.full(162, 2**63 + 5, dtype=np.uint64)])
def test_labels_that_are_no_whole_numbers_are_refused(keys):
    """Rows of unequal length, text and numbers out of range are refused in one line; NaN in a list counts as 0."""
    onto = resample("ico2", "ico1")
    with pytest.raises(OmtwarpError, match="the labels: "):
        onto.labels(keys)
    assert not onto.labels([np.nan] * 162).any()
