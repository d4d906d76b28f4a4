"""A map does not depend on where it is made, and is the same every time."""

import numpy as np
import pytest

from omtwarp.conformal import conformal_map
from omtwarp.device.arrays import vectors
from omtwarp.device.start import wp
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.shapes import blob
from omtwarp.mesh.surface import Surface
from omtwarp.moser import moser_map
from omtwarp.optimal.shape import DistortionEnergy
from omtwarp.wavelets import SphereSampler, WaveletPreconditioner, sphere_hierarchy


@pytest.fixture(scope="module")
def surface() -> Surface:
    return blob(seed=11, amplitude=0.4, sphere=3000)


@pytest.fixture(scope="module")
def on_cpu(surface):
    return map_to_sphere((surface.vertices, surface.faces), device="cpu")


def test_a_whole_map_agrees_with_the_cpu_and_repeats_to_the_bit(device, surface, on_cpu):
    one, two = (map_to_sphere((surface.vertices, surface.faces), device=device) for _ in range(2))
    for name in ("conformal", "transported", "sphere"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
        np.testing.assert_allclose(getattr(one, name), getattr(on_cpu, name), atol=1e-6)
    assert [s["flips"] for s in one.report["stages"]] == [s["flips"] for s in on_cpu.report["stages"]]
    assert one.report["certificate"]["flips"] == on_cpu.report["certificate"]["flips"] == 0


def test_particles_of_moser_flow_agree(device, surface):
    start = conformal_map(surface, device="cpu")
    cpu, other = (moser_map(surface, start.sphere, solver=start.solver, device=where) for where in ("cpu", device))
    np.testing.assert_allclose(other.sphere, cpu.sphere, atol=1e-11)  # rounding, carried along a path
    np.testing.assert_allclose(other.potential, cpu.potential, rtol=0.0, atol=1e-12 * np.abs(cpu.potential).max())


def test_energy_gradient_and_hessian_agree(device, surface, on_cpu):
    values = []
    for where in ("cpu", device):
        energy = DistortionEnergy(surface, wp.get_device(where))
        points = vectors(on_cpu.conformal, energy.device)
        terms = energy.terms(points)
        # A copy: on the CPU it is a view of a workspace that the gradient takes next.
        hessian = energy.hessian(points, terms, 100.0).numpy().copy()
        values.append((terms.total(100.0), energy.gradient(points, terms, 100.0).numpy(), hessian))
    assert values[1][0] == pytest.approx(values[0][0], rel=1e-12)
    for cpu, other in zip(values[0][1:], values[1][1:], strict=True):
        np.testing.assert_allclose(other, cpu, rtol=1e-12, atol=1e-12 * np.abs(cpu).max())


def test_sampling_and_preconditioner_agree(device, on_cpu):
    hierarchy = sphere_hierarchy(4)
    values = np.sin(3.0 * hierarchy.vertices[:, 0]) + hierarchy.vertices[:, 2]
    results = []
    for where in ("cpu", device):
        sampler = SphereSampler(hierarchy, on_cpu.sphere, device=where)
        force = sampler.gradient_adjoint(on_cpu.sphere[:, [1, 2, 0]])
        smooth = WaveletPreconditioner(hierarchy, butterfly=True, device=where).apply(force)
        results.append((sampler.interpolate(values), force, smooth))
    for cpu, other in zip(*results, strict=True):
        np.testing.assert_allclose(other, cpu, rtol=1e-12, atol=1e-12 * np.abs(cpu).max())
