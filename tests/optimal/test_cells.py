"""The optimal map of a quartered mesh: derivatives, and the areas of the mesh's own triangles."""

import numpy as np
import pytest

from omtwarp.conformal import conformal_map
from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import is_bijective
from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.shapes import blob
from omtwarp.metrics.optimality import optimality
from omtwarp.moser import moser_map
from omtwarp.optimal import exact, optimal_map
from omtwarp.optimal.cells import TriangleCells
from omtwarp.optimal.exact import exact_map
from omtwarp.optimal.sphere import energy_on_sphere

CPU = resolve_device("cpu")


@pytest.fixture(scope="module")
def mapped():
    surface = blob(seed=3, amplitude=0.25, degree=4, sphere=320)
    x = conformal_map(surface, device="cpu").sphere
    return surface, x, moser_map(surface, x, device="cpu").sphere


@pytest.fixture(scope="module")
def energy_and_map(mapped):
    surface, x, y = mapped
    cut = quarter(surface)
    start, cells = vectors(cut.on_sphere(x), CPU), TriangleCells(cut, CPU)
    return energy_on_sphere(cut.surface, start, CPU, shape_weight=0.02, cells=cells), cut.on_sphere(y)


def step_of(points, seed):
    step = np.random.default_rng(seed).normal(size=points.shape) * 1e-5
    return step - (step * points).sum(1, keepdims=True) * points


def moved(points, step):
    out = points + step
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def solid_angles(sphere, faces):
    """Van Oosterom and Strackee's formula."""
    a, b, c = (sphere[faces[:, k]] for k in range(3))
    dots = 1 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1)
    return 2 * np.arctan2((a * np.cross(b, c)).sum(1), dots)


def test_gradient_is_the_derivative(energy_and_map):
    energy, y = energy_and_map
    multipliers = wp.array(np.random.default_rng(0).normal(size=len(energy.wanted)) * 0.1, device="cpu")

    def value(points):
        return energy.lagrangian(energy.terms(vectors(points, CPU), multipliers))

    gradient = energy.gradient(vectors(y, CPU), energy.terms(vectors(y, CPU)), multipliers).numpy()
    assert np.abs((gradient * y).sum(axis=1)).max() < 1e-12  # tangent
    for seed in range(3):
        step = step_of(y, seed)
        difference = (value(moved(y, step)) - value(moved(y, -step))) / 2
        assert difference == pytest.approx(float((gradient * step).sum()), rel=1e-6, abs=1e-12)


def test_couplings_are_derivatives_of_the_areas(energy_and_map):
    energy, y = energy_and_map
    points = vectors(y, CPU)
    energy.blocks(points, energy.terms(points))
    couplings = energy.matrix.slopes.numpy().reshape(-1, 6, 2)
    axis = np.zeros_like(y)
    axis[np.arange(len(y)), np.abs(y).argmin(axis=1)] = 1.0
    first = np.cross(y, axis) / np.linalg.norm(np.cross(y, axis), axis=1)[:, None]
    step = step_of(y, 1)
    coordinates = np.stack([(step * first).sum(1), (step * np.cross(y, first)).sum(1)], axis=1)
    change = (couplings * coordinates[energy.cells.vertices]).sum(axis=(1, 2))
    ahead, behind = (energy.terms(vectors(moved(y, s * step), CPU)).areas.numpy() for s in (1, -1))
    np.testing.assert_allclose((ahead - behind) / 2, change, atol=1e-10)


def test_masses_and_cost_are_those_of_the_quartered_mesh(energy_and_map):
    """The cost by cells equals the sum over the quartered mesh's vertices where areas are kept."""
    energy, y = energy_and_map
    terms = energy.terms(vectors(y, CPU))
    shares = np.repeat([1 / 12, 1 / 4], 3) * energy.wanted[:, None]
    masses = np.bincount(energy.cells.vertices.ravel(), shares.ravel())
    np.testing.assert_allclose(masses, energy.surface.vertex_areas, rtol=1e-9)
    np.testing.assert_allclose(
        terms.areas.numpy(), solid_angles(y, energy.surface.faces).reshape(-1, 4).sum(axis=1), rtol=1e-9
    )


def test_every_triangle_keeps_its_area_and_the_map_is_optimal(mapped, monkeypatch):
    """An exact map keeps triangles' areas to 1e-6 without a flip, with less of a gap than the default map in parts."""
    surface, x, y = mapped
    plain = optimal_map(surface, y, start=x, device="cpu")
    cut = quarter(surface)
    start = cut.on_sphere(x)
    told = []
    found = exact_map(
        cut, cut.on_sphere(plain.sphere), start=start, device="cpu", progress=lambda *arguments: told.append(arguments)
    )
    assert found.converged and found.ended == "optimal"
    areas = solid_angles(found.sphere, cut.surface.faces).reshape(-1, 4).sum(axis=1)
    np.testing.assert_allclose(areas, surface.face_areas, rtol=1e-6)
    assert is_bijective(found.sphere, cut.surface.faces)
    before, after = (
        optimality(cut.surface, points, start=start, device="cpu")
        for points in (cut.on_sphere(plain.sphere), found.sphere)
    )
    assert after.gap < before.gap and after.relative_curl < before.relative_curl
    assert [number for _, number, *_ in told] == list(range(1, len(found.history)))
    again = exact_map(cut, cut.on_sphere(plain.sphere), start=start, device="cpu")
    np.testing.assert_array_equal(again.sphere, found.sphere)
    monkeypatch.setattr(exact, "ITERATIONS", 0)
    few = exact_map(cut, cut.on_sphere(y), start=start, device="cpu")
    assert not few.converged


def test_flipped_maps_are_refused(mapped):
    surface, x, _ = mapped
    cut = quarter(surface)
    with pytest.raises(OmtwarpError, match="flipped"):
        exact_map(cut, -cut.on_sphere(x), start=cut.on_sphere(x), device="cpu")


@pytest.mark.parametrize("weight", [np.nan, np.inf, -1.0, True, "x", None, 10**400])
def test_shape_weights_of_exact_maps_that_are_no_numbers(weight):
    """NaN was taken without a word, and gave the map back as it was."""
    cut = quarter(blob(sphere=80))
    points = cut.surface.vertices / np.linalg.norm(cut.surface.vertices, axis=1, keepdims=True)
    with pytest.raises(OmtwarpError, match="shape_weight: must be a finite number"):
        exact_map(cut, points, start=points, shape_weight=weight, device="cpu")
