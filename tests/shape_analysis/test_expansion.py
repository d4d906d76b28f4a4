"""SPHARM of surfaces against closed forms, an independent library, and SPHARM-PDM's formula written out."""

import math

import numpy as np
import pytest
from scipy.special import lpmv
from sphere_truths import SHARED, random_rotation

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.harmonics import real_harmonics
from omtwarp.mesh.shapes import blob, icosphere, random_sphere
from omtwarp.shape_analysis.expansion import Expansion, expand, read_coef, write_coef

SPHERE = icosphere(16)


@pytest.mark.parametrize("method", ["least-squares", "quadrature"])
def test_an_ellipsoid_has_nothing_but_the_first_degree(method):
    """x = a X for unit X: coefficients a √(4π / 3) at Y_11, Y_1,-1 and Y_10; the centre stands in degree 0."""
    axes, centre = np.array([3.0, 2.0, 0.5]), np.array([5.0, -1.0, 2.0])
    found = expand(SPHERE.vertices, SPHERE.vertices * axes + centre, 6, faces=SPHERE.faces, method=method)
    wanted = np.zeros((49, 3))
    wanted[0] = centre * np.sqrt(4 * np.pi)
    wanted[[3, 1, 2], [0, 1, 2]] = axes * np.sqrt(4 * np.pi / 3)
    tolerance = 1e-12 if method == "least-squares" else 0.02  # linear between the vertices: of second order
    np.testing.assert_allclose(found.coefficients, wanted, atol=tolerance)
    np.testing.assert_allclose(found.at(SPHERE.vertices), SPHERE.vertices * axes + centre, atol=10 * tolerance)
    np.testing.assert_allclose(found.power()[1], (axes**2).sum() * 4 * np.pi / 3, rtol=10 * tolerance)


def test_quadrature_is_of_second_order():
    errors = []
    for frequency in (8, 16):
        sphere = icosphere(frequency)
        values = np.exp(sphere.vertices @ [0.5, -0.3, 0.8])
        fine = icosphere(40)
        truth = expand(fine.vertices, np.exp(fine.vertices @ [0.5, -0.3, 0.8]), 12, faces=fine.faces)
        found = expand(sphere.vertices, values, 5, faces=sphere.faces, method="quadrature")
        errors.append(np.abs(found.coefficients - truth.truncated(5).coefficients).max())
    assert errors[0] < 0.02
    assert errors[1] < 0.3 * errors[0]


def test_band_limited_surfaces_come_back_from_irregular_points():
    rng = np.random.default_rng(3)
    wanted = rng.normal(size=(100, 3)) / (1 + np.repeat(np.arange(10), 2 * np.arange(10) + 1))[:, None] ** 2
    sphere = random_sphere(1200, seed=1)
    for faces in (None, sphere.faces):
        found = expand(sphere.vertices, real_harmonics(sphere.vertices, 9) @ wanted, 9, faces=faces)
        np.testing.assert_allclose(found.coefficients, wanted, atol=1e-10)


def test_they_agree_with_pyshtools():
    """Coefficients agree with those of pyshtools on its own grid (Driscoll and Healy) to 1e-6."""
    pyshtools = pytest.importorskip("pyshtools")
    longitude, colatitude = np.arange(48) * 2 * np.pi / 48, np.arange(24) * np.pi / 24
    theta, phi = (a.ravel() for a in np.meshgrid(colatitude, longitude, indexing="ij"))
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    rng = np.random.default_rng(0)
    values = real_harmonics(points, 11) @ rng.normal(size=144)
    known = pyshtools.expand.SHExpandDH(values.reshape(24, 48), sampling=2, norm=4, csphase=1)
    found = expand(points, values, 11).coefficients[:, 0]
    for n in range(12):
        row = np.concatenate([known[1, n, 1 : n + 1][::-1], known[0, n, : n + 1]])
        np.testing.assert_allclose(found[n * n : (n + 1) ** 2], row, atol=1e-8)


def test_what_is_cut_off_is_the_error():
    """Parseval: the mean square error over the sphere is the power of the degrees left out."""
    surface = blob(2, sphere=SPHERE)
    whole = expand(SPHERE.vertices, surface.vertices, 24, faces=SPHERE.faces)
    areas = SPHERE.vertex_areas
    for degree in (3, 6, 10):
        error = (areas @ ((whole.truncated(degree).at(SPHERE.vertices) - whole.at(SPHERE.vertices)) ** 2)).sum()
        assert error == pytest.approx(whole.power()[degree + 1 :].sum(), rel=0.03)


@pytest.mark.skipif(
    not (SHARED / "data" / "hippocampus_12k.ply").exists(), reason="the mesh is not beside the checkout"
)
def test_a_hippocampus_at_degree_15_misses_what_the_power_beyond_predicts():
    import omtwarp

    mesh = omtwarp.read_mesh(SHARED / "data" / "hippocampus_12k.ply")
    result = omtwarp.map_to_sphere((mesh.vertices, mesh.faces), until="moser", device="cpu")
    whole = expand(result.sphere, result.vertices, 40, faces=result.faces)
    fifteen = expand(result.sphere, result.vertices, 15, faces=result.faces)
    areas = omtwarp.Surface(result.vertices, result.faces).vertex_areas
    error = (areas @ ((fifteen.at(result.sphere) - result.vertices) ** 2)).sum()
    beyond = whole.power()[16:].sum() + (areas @ ((whole.at(result.sphere) - result.vertices) ** 2)).sum()
    assert error == pytest.approx(beyond, rel=0.05)
    assert error < 1e-3 * fifteen.power()[1:].sum()


def pdm_point(numbers: np.ndarray, theta: float, phi: float) -> np.ndarray:
    """SPHARM-PDM's sum at a point, written out from its definition with SciPy's P_lm, which has the phase (-1)^m."""
    total, k = np.zeros(3), 0
    for n in range(math.isqrt(len(numbers))):
        for m in range(n + 1):
            scale = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - m) / math.factorial(n + m))
            value = scale * lpmv(m, n, math.cos(theta))
            total += numbers[k] * math.cos(m * phi) * value
            k += 1
            if m:
                total += numbers[k] * math.sin(m * phi) * value
                k += 1
    return total


def test_coef_files_have_spharm_pdms_order_and_signs(tmp_path):
    surface = blob(5, sphere=SPHERE)
    wanted = expand(SPHERE.vertices, surface.vertices, 7)
    write_coef(tmp_path / "a.coef", wanted)
    text = (tmp_path / "a.coef").read_text()
    assert text.startswith("{ 64,{")
    assert text.endswith("}}")
    numbers = np.array([[float(x) for x in row.split(",")] for row in text[6:].strip("{}").split("},\n{")])
    for theta, phi in ((0.3, 0.2), (1.7, -2.5), (2.9, 3.0)):
        point = [[math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)]]
        np.testing.assert_allclose(pdm_point(numbers, theta, phi), wanted.at(point)[0], atol=1e-12)
    np.testing.assert_array_equal(read_coef(tmp_path / "a.coef").coefficients.shape, wanted.coefficients.shape)
    np.testing.assert_allclose(read_coef(tmp_path / "a.coef").coefficients, wanted.coefficients, rtol=1e-14)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hello", "no .coef file"),
        ("{ 4,{1, 2, 3}}", r"announces 4 coefficients and holds an array of \[1, 3\]"),
        ("{ 1,{1, 2, x}}", "damaged"),
        ("{ 2,{1, 2, 3},\n{1, 2, 3}}", "2 coefficients"),
        ("{ 1,{1, 2, nan}}", "finite"),
    ],
)
def test_files_that_hold_no_coefficients(tmp_path, text, message):
    (tmp_path / "bad.coef").write_text(text)
    with pytest.raises(OmtwarpError, match=message):
        read_coef(tmp_path / "bad.coef")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((SPHERE.vertices, np.ones(3), 2), "do not fit"),
        ((2 * SPHERE.vertices, SPHERE.vertices, 2), "do not lie on the unit sphere"),
        ((SPHERE.vertices, SPHERE.vertices * np.nan, 2), "not all finite"),
        ((SPHERE.vertices[:20], SPHERE.vertices[:20], 4), "20 points do not determine the 25 coefficients"),
        ((np.tile(SPHERE.vertices[:20], (9, 1)), np.ones(180), 4), "do not determine"),
    ],
)
def test_data_that_cannot_be_expanded(arguments, message):
    with pytest.raises(OmtwarpError, match=message):
        expand(*arguments)


def test_power_and_reconstruction_turn_with_the_sphere():
    surface = blob(1, sphere=SPHERE)
    turn = random_rotation(4)
    one = expand(SPHERE.vertices, surface.vertices, 8)
    other = expand(SPHERE.vertices @ turn.T, surface.vertices, 8)
    np.testing.assert_allclose(one.power(), other.power(), rtol=2e-3)
    np.testing.assert_allclose(other.at(SPHERE.vertices @ turn.T), one.at(SPHERE.vertices), atol=0.02)
    assert one.surface(4).vertex_count == one.surface(np.int64(4)).vertex_count == 162
    assert one.truncated(3.0).degree == 3
    for wrong in (
        lambda: one.surface(0), lambda: one.truncated(9), lambda: one.at("x"), lambda: one.at(3.0),
        lambda: Expansion(np.ones(4) * 1j), lambda: Expansion("x"),
    ):  # fmt: skip
        with pytest.raises(OmtwarpError):
            wrong()
    with pytest.raises(OmtwarpError, match="no surface"):
        Expansion(np.ones(4)).surface()
