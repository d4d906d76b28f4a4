"""Distortion against singular values computed another way, against the judge, and against maps known by hand."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from sphere_truths import judge, pushed_north, random_rotation, turned, twisted

import omtwarp
from omtwarp.mesh.shapes import blob, fibonacci_sphere, icosphere, noisy, random_sphere
from omtwarp.mesh.surface import Surface
from omtwarp.metrics import WEIGHTINGS, measure_triangles


def by_singular_values(surface: Surface, sphere: np.ndarray) -> dict:
    """Compute distortion by its definition, with NumPy's SVD of the map between every pair of triangles.

    The Jacobian J takes edge vectors to edge vectors and normals to nothing: J = E' E⁺ with E and E' the 3 x 2 matrices
    of edges. Its two non-zero singular values are those of the paper; areas come from Heron-free cross products.
    """
    faces = surface.faces
    sphere = sphere / np.linalg.norm(sphere, axis=1)[:, None]

    def edges(points):
        corners = points[faces]
        pairs = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
        areas = np.linalg.norm(np.cross(pairs[:, :, 0], pairs[:, :, 1]), axis=1) / 2
        return pairs * np.sqrt(4 * np.pi / areas.sum()), areas / areas.sum()

    original, original_share = edges(surface.vertices)
    image, image_share = edges(sphere)
    s1, s2 = np.linalg.svd(image @ np.linalg.pinv(original), compute_uv=False)[:, :2].T
    weights = {"mean": np.full(len(faces), 1 / len(faces)), "surface": original_share, "sphere": image_share}
    out = {"triple": np.linalg.det(sphere[faces])}
    for name, values in (("area", s1 * s2 + 1 / (s1 * s2)), ("angle", s1 / s2 + s2 / s1)):
        out[name] = values
        out[f"{name} by"] = {k: w @ values for k, w in weights.items()}
        out[f"{name} by"] |= {"median": np.median(values), "p95": np.percentile(values, 95), "max": values.max()}
    return out


def some_map(seed: int) -> tuple[Surface, np.ndarray]:
    """An irregular surface and a sphere map of it with a few flips and areas wrong by factors of several."""
    base = random_sphere(400, seed)
    surface = blob(seed=seed, amplitude=0.3, sphere=base)
    sphere = twisted(pushed_north(base.vertices, 0.5), 0.4)
    return surface, noisy(Surface(sphere, base.faces), 0.05, seed).vertices


@settings(max_examples=20)
@given(seed=st.integers(0, 100_000))
def test_agrees_with_singular_values(seed):
    """Every triangle and every aggregate. pinv of a sliver loses digits: 1e-9 relative on its own triangle."""
    surface, sphere = some_map(seed)
    got, truth = measure_triangles(surface.vertices, surface.faces, sphere), by_singular_values(surface, sphere)
    np.testing.assert_allclose(got.face_area, truth["area"], rtol=1e-8)
    np.testing.assert_allclose(got.face_angle, truth["angle"], rtol=1e-8)
    np.testing.assert_allclose(got.triple, truth["triple"], rtol=1e-7, atol=1e-14)
    assert got.flips == (truth["triple"] <= 0).sum()
    for name, values in (("area", got.area), ("angle", got.angle)):
        assert set(values) == {*WEIGHTINGS, "median", "p95", "max"}
        for key, value in values.items():
            assert value == pytest.approx(truth[f"{name} by"][key], rel=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_the_judge(device, seed):
    surface, sphere = some_map(seed)
    if seed == 4:
        sphere = sphere * np.random.default_rng(0).uniform(0.5, 2.0, (len(sphere), 1))  # the judge normalises too
    verdict = judge()(surface.vertices, sphere, surface.faces)
    got = measure_triangles(surface.vertices, surface.faces, sphere, device=device).to_dict()
    assert got["flips"] == verdict["flips"]
    assert got["finite"] is verdict["finite"] is True
    assert got["degree"] == pytest.approx(verdict["degree"], abs=1e-12)
    for name in ("area", "angle"):
        assert set(got[name]) == set(verdict[name])
        for key, value in got[name].items():
            assert value == pytest.approx(verdict[name][key], rel=1e-12)


def test_the_identity_is_perfect(device):
    surface = fibonacci_sphere(500)
    got = measure_triangles(surface.vertices, surface.faces, surface.vertices, device=device)
    assert got.flips == 0
    assert got.degree == pytest.approx(1.0, abs=1e-13)
    for values in (*got.area.values(), *got.angle.values()):
        assert values == pytest.approx(2.0, abs=1e-12)
    np.testing.assert_allclose(got.area_ratio, 1.0, rtol=1e-13)


def test_a_stretched_octahedron_by_hand():
    """Corners at (±1, 0, 0), (0, ±1, 0), (0, 0, ±h): all triangles are alike, so area is perfect.

    From the horizontal edge of length √2 the apex is √(1/2 + h²) high; on the sphere √(3/2). So s1/s2 = √((1 + 2h²)/3).
    """
    h = 3.0
    sphere = np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    got = measure_triangles(sphere * [1.0, 1.0, h], faces, sphere)
    ratio = np.sqrt((1.0 + 2.0 * h * h) / 3.0)
    for key in ("mean", "surface", "sphere", "median", "p95", "max"):
        assert got.area[key] == pytest.approx(2.0, abs=1e-12)
        assert got.angle[key] == pytest.approx(ratio + 1.0 / ratio, rel=1e-12)
    assert got.degree == pytest.approx(1.0, abs=1e-14)


def test_mirrored_and_collapsed_maps():
    surface = turned(icosphere(3))
    mirrored = measure_triangles(surface.vertices, surface.faces, surface.vertices * [1.0, 1.0, -1.0])
    assert mirrored.flips == surface.face_count
    assert mirrored.degree == pytest.approx(-1.0, abs=1e-12)
    sphere = surface.vertices.copy()
    a, b, _ = surface.faces[7]
    sphere[a] = sphere[b]
    collapsed = measure_triangles(surface.vertices, surface.faces, sphere)
    assert collapsed.degree == pytest.approx(1.0, abs=1e-12)
    assert collapsed.area["max"] == collapsed.area["surface"] == np.inf
    assert (np.abs(collapsed.triple) < 1e-16).sum() == 2  # both triangles at that edge, whatever their rounded sign


def test_coordinates_that_are_not_finite_are_said_so():
    surface = icosphere(2)
    sphere = surface.vertices.copy()
    sphere[5] = np.nan
    got = measure_triangles(surface.vertices, surface.faces, sphere)
    assert not got.finite
    assert got.flips == np.any(surface.faces == 5, axis=1).sum()


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), exponent=st.integers(-30, 30))
def test_position_unit_and_rotation_do_not_matter(seed, exponent):
    surface, sphere = some_map(seed)
    base = measure_triangles(surface.vertices, surface.faces, sphere)
    # A shift of the size of the surface, lest its coordinates round the shape away.
    moved = 10.0**exponent * (surface.vertices @ random_rotation(seed).T + [1.0, -2.0, 0.5])
    other = measure_triangles(moved, surface.faces, sphere @ random_rotation(seed + 1).T)
    np.testing.assert_allclose(other.face_area, base.face_area, rtol=1e-7)
    np.testing.assert_allclose(other.face_angle, base.face_angle, rtol=1e-7)


def test_printed_form_names_flips_degree_area_and_angle():
    surface = icosphere(2)
    text = str(measure_triangles(surface.vertices, surface.faces, surface.vertices))
    assert text.startswith("flips 0  degree 1.000000  area 2.0000")


def test_a_measured_distortion_prints_in_a_line():
    ball = icosphere(4)
    text = repr(omtwarp.distortion(ball, ball.vertices, device="cpu"))
    assert "\n" not in text and len(text) < 120 and "area 2.0" in text and "320 faces" in text


@pytest.mark.parametrize("measure", [omtwarp.certify, omtwarp.distortion])
def test_points_that_are_not_of_unit_length_are_refused(measure):
    ball = icosphere(4)
    points = ball.vertices.copy()
    points[7] *= 1.001
    with pytest.raises(omtwarp.OmtwarpError, match="1 points of the map are not on the unit sphere, first vertex 7"):
        measure(ball, points, device="cpu")
