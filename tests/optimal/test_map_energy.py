"""The public energy: its derivatives are those of its values, with NumPy arrays in and out."""

import numpy as np
import pytest

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.optimal import MapEnergy


def unit(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def tangent(points, seed):
    step = np.random.default_rng(seed).normal(size=points.shape)
    return step - (step * points).sum(axis=1, keepdims=True) * points


@pytest.fixture(scope="module", params=[0.0, 0.1], ids=["squared", "soft"])
def energy_and_map(request):
    surface = blob(seed=3, amplitude=0.25, sphere=320)
    x = omtwarp.conformal_map(surface).sphere
    return MapEnergy(surface, x, softness=request.param), surface, x, omtwarp.moser_map(surface, x).sphere


def test_terms_are_those_of_other_functions(energy_and_map):
    energy, surface, x, y = energy_and_map
    terms = energy.terms(y)
    d = np.arccos(np.clip((x * y).sum(axis=1), -1.0, 1.0))
    soft = np.sqrt(d**2 + 0.1**2) - 0.1
    means = [surface.vertex_areas @ cost / surface.vertex_areas.sum() for cost in (d**2, soft)]
    assert min(abs(terms["cost"] - mean) for mean in means) < 1e-9
    measured = omtwarp.distortion(surface, y)
    assert terms["angle"] + 2.0 == pytest.approx(measured.angle["surface"], rel=1e-12)
    a, b, c = (y[surface.faces[:, k]] for k in range(3))
    dots = 1.0 + (a * b).sum(axis=1) + (b * c).sum(axis=1) + (c * a).sum(axis=1)
    solid = 2.0 * np.arctan2((a * np.cross(b, c)).sum(axis=1), dots)  # Van Oosterom and Strackee
    around = np.bincount(surface.faces.ravel(), np.repeat(solid, 3))
    np.testing.assert_allclose(terms["areas"], around, rtol=1e-10)
    np.testing.assert_allclose(terms["wanted"], 3.0 * surface.vertex_areas)


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_are_differences(energy_and_map, seed):
    energy, surface, _, y = energy_and_map
    multipliers, step = np.random.default_rng(seed).normal(size=surface.vertex_count), tangent(y, seed)
    ahead, behind = (unit(y + s * 1e-6 * step) for s in (1.0, -1.0))
    slope = (energy.value(ahead, multipliers) - energy.value(behind, multipliers)) / 2e-6
    gradient = energy.gradient(y, multipliers)
    assert slope == pytest.approx(float((gradient * step).sum()), rel=1e-5)
    assert np.abs((gradient * y).sum(axis=1)).max() < 1e-12
    change = (energy.terms(ahead)["areas"] - energy.terms(behind)["areas"]) / 2e-6
    np.testing.assert_allclose(energy.area_changes(y, step), change, atol=1e-7)


def test_the_matrix_is_symmetric_and_semidefinite(energy_and_map):
    energy, _, _, y = energy_and_map
    u, v = tangent(y, 1), tangent(y, 2)
    one, other = ((energy.hessian_product(y, a) * b).sum() for a, b in ((u, v), (v, u)))
    assert one == pytest.approx(other, rel=1e-10)
    assert (energy.hessian_product(y, u) * u).sum() > 0.0


def test_the_matrix_is_the_second_derivative_where_triangles_are_hardly_distorted():
    """On a sphere mapped to itself no part of the distortion's second derivative is cut off, and x is y."""
    ball = icosphere(5)
    y = unit(ball.vertices)
    surface = omtwarp.Surface(y, ball.faces)
    energy, plain = (MapEnergy(surface, y, shape_weight=weight) for weight in (1.0, 0.0))
    for seed in range(3):
        u = tangent(y, seed)
        slopes = [energy.gradient(unit(y + s * 1e-5 * u)) - plain.gradient(unit(y + s * 1e-5 * u)) for s in (1, -1)]
        second = float(((slopes[0] - slopes[1]) * u).sum()) / 2e-5
        product = energy.hessian_product(y, u) - plain.hessian_product(y, u)
        assert float((product * u).sum()) == pytest.approx(second, rel=2e-3)


@pytest.mark.parametrize("wrong", [{"shape_weight": -1.0}, {"softness": np.nan}, {"area_weight": "much"}])
def test_wrong_weights_are_refused(wrong):
    ball = icosphere(2)
    with pytest.raises(OmtwarpError, match=next(iter(wrong))):
        MapEnergy(ball, unit(ball.vertices), **wrong)
