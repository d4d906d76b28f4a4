"""Refinement whose vectors and matrices stay on the device takes the steps that it takes on the host."""

from __future__ import annotations

import numpy as np
import pytest

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.predicates import flipped_faces
from omtwarp.mesh.shapes import blob, noisy
from omtwarp.optimal.refinement import refine_map
from omtwarp.refine import steps
from omtwarp.refine.energy import DistortionEnergy
from omtwarp.refine.steps import DeviceSteps, HostSteps, flat
from omtwarp.refine.sums import DistortionSums
from omtwarp.solvers.multigrid import MultigridSolver, Outcome
from omtwarp.start.hierarchical import hierarchical_embedding


@pytest.fixture(scope="module")
def start():
    surface = noisy(blob(4, amplitude=0.3, sphere=1500), 0.2)
    return surface, hierarchical_embedding(surface, device="cpu").sphere


def test_maps_do_not_depend_on_where_steps_are_found(start, device, monkeypatch):
    surface, sphere = start
    results = []
    for solver in ("cholesky", "multigrid", "multigrid"):
        monkeypatch.setenv("OMTWARP_SOLVER", solver)
        results.append(refine_map(surface, sphere, device=device))
    host, one, two = results
    np.testing.assert_array_equal(one.sphere, two.sphere)
    np.testing.assert_allclose(one.sphere, host.sphere, atol=1e-6)
    assert len(one.history) == len(host.history) and one.factorisations == host.factorisations
    assert not flipped_faces(one.sphere, surface.faces).any()


def test_directions_and_corrections_agree(start, device, monkeypatch):
    """Host and device agree over more pairs than are kept; both drop one without positive curvature."""
    surface, sphere = start
    monkeypatch.setattr(steps, "MAX_PAIRS", 3)
    energy = DistortionEnergy(surface, wp.get_device(device))
    points = energy.upload(sphere)
    terms = energy.terms(points)
    gradient = energy.gradient(points, terms, 20.0)
    finders = HostSteps(energy), DeviceSteps(energy)
    for finder in finders:
        finder.assemble(points, terms, 20.0, 1.0)
        finder.factorise()
    decrements = [finder.decrements(gradient) for finder in finders]
    np.testing.assert_allclose(decrements[1], decrements[0], rtol=1e-7)
    rng = np.random.default_rng(0)
    share = wp.array(rng.uniform(size=surface.vertex_count), dtype=wp.float64, device=device)
    for k in range(6):
        host, other = (finder.direction(points, gradient) for finder in finders)
        np.testing.assert_allclose(other.vectors.numpy(), host.vectors.numpy(), atol=1e-7 * host.reach)
        assert other.slope == pytest.approx(host.slope, rel=1e-7) and host.slope < 0.0
        assert other.reach == pytest.approx(host.reach, rel=1e-7)
        assert other.slope_of(share) == pytest.approx(host.slope_of(share), rel=1e-7)
        tilt = (other.vectors.numpy() * points.numpy()).sum(axis=1)
        np.testing.assert_allclose(tilt, 0.0, atol=1e-14 * max(1.0, host.reach))
        moved = points.numpy() + 1e-3 * host.vectors.numpy()
        new_points = energy.upload(moved / np.linalg.norm(moved, axis=1, keepdims=True))
        new_gradient = energy.gradient(new_points, energy.terms(new_points), 20.0)
        if k == 4:
            new_gradient = wp.array(2.0 * gradient.numpy() - new_gradient.numpy(), dtype=wp.vec3d, device=device)
        for finder in finders:
            finder.update(points, gradient, new_points, new_gradient)
        points, gradient = new_points, new_gradient
    assert len(finders[0]._pairs) == len(finders[1]._pairs) == 3


def test_sums_of_distortion_agree_with_numpy(start, device):
    surface, sphere = start
    energy = DistortionEnergy(surface, wp.get_device("cpu"))
    truth = energy.terms(energy.upload(sphere))
    other = DistortionEnergy(surface, wp.get_device(device))
    other._sums = DistortionSums(surface.face_count, wp.get_device(device))
    got = other.terms(other.upload(sphere))
    for name in ("angle", "area", "scale", "inverse_sum"):
        assert getattr(got, name) == pytest.approx(getattr(truth, name), rel=1e-12)
    assert got.needle == pytest.approx(truth.needle, rel=1e-12)
    np.testing.assert_allclose(got.ratio, truth.ratio, rtol=1e-12)
    np.testing.assert_allclose(got.d_volume.numpy(), truth.d_volume.numpy(), rtol=1e-11)


def test_a_matrix_that_multigrid_gives_up_is_factorised(start, device, monkeypatch):
    surface, sphere = start
    energy = DistortionEnergy(surface, wp.get_device(device))
    points = energy.upload(sphere)
    terms = energy.terms(points)
    gradient = energy.gradient(points, terms, 20.0)
    finder = DeviceSteps(energy)
    finder.assemble(points, terms, 20.0, 1.0)
    finder.factorise()
    usual = finder.direction(points, gradient)
    monkeypatch.setattr(MultigridSolver, "solve", lambda self, right, out, tolerance: Outcome(500, False))
    finder.assemble(points, terms, 20.0, 1.0)
    finder.factorise()
    other = finder.direction(points, gradient)
    np.testing.assert_allclose(other.vectors.numpy(), usual.vectors.numpy(), atol=1e-7 * usual.reach)
    negative = wp.array(-energy.hessian(points, terms, 20.0, 1.0).numpy(), dtype=wp.float64, device=device)
    finder._matrix.assemble(points, lambda: negative)
    finder.factorise()
    with pytest.raises(OmtwarpError, match="not finite"):
        finder.direction(points, gradient)


def test_the_same_memory_as_numbers(device):
    vectors = wp.array(np.arange(12.0).reshape(4, 3), dtype=wp.vec3d, device=device)
    numbers = flat(vectors)
    np.testing.assert_array_equal(numbers.numpy(), np.arange(12.0))
    numbers.fill_(1.0)
    np.testing.assert_array_equal(vectors.numpy(), np.ones((4, 3)))
