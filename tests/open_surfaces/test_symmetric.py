"""The symmetric saddle-point problem of a double, solved on one half."""

from __future__ import annotations

import numpy as np
import pytest

import omtwarp
from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device, solving_with
from omtwarp.device.start import wp
from omtwarp.flips.exact import is_bijective
from omtwarp.mesh import shapes
from omtwarp.open_surfaces.hemisphere import is_symmetric, symmetric_map
from omtwarp.open_surfaces.symmetric import MirroredSphere, folded, folded_map
from omtwarp.optimal.sphere import energy_on_sphere
from omtwarp.options import Solver
from omtwarp.solvers.cholesky import multifrontal
from omtwarp.topology.closing import Double, double, split_chords


def doubled_cap() -> tuple[Double, omtwarp.Surface, np.ndarray, np.ndarray]:
    """The double of a bent hemisphere, a symmetric map of it that is not optimal, and points to start from."""
    ball = shapes.uv_sphere(15, 24)  # one of its parallels is the equator
    kept = (ball.vertices[ball.faces, 2] > -1e-9).all(axis=1)
    used, faces = np.unique(ball.faces[kept], return_inverse=True)
    split = split_chords(ball.vertices[used], faces.reshape(-1, 3))
    glued = double(split.vertices * [1.0, 0.8, 1.3], split.faces)
    rim = glued.on_boundary
    sphere = np.concatenate([split.vertices, split.vertices[~rim[: len(split.vertices)]]])
    sphere[rim, 2] = 0.0
    start = sphere + 0.1 * np.sin(3.0 * sphere[:, [1, 0, 0]])
    start /= np.linalg.norm(start, axis=1)[:, None]
    surface = omtwarp.Surface(glued.vertices, glued.faces)
    return glued, surface, folded_map(glued, sphere), folded_map(glued, start)


@pytest.mark.parametrize("solver", [Solver.CHOLESKY, Solver.SCIPY])
def test_half_system_has_the_symmetric_solution_of_the_whole_one(solver, monkeypatch):
    monkeypatch.setattr(multifrontal, "ACCURACY", 1e-12)  # more than steps need, so that the two systems are compared
    glued, surface, sphere, start = doubled_cap()
    where = resolve_device("cpu")
    assert is_bijective(sphere, surface.faces)
    rng = np.random.default_rng(0)
    with solving_with(solver):
        energies = [
            energy_on_sphere(surface, vectors(start, where), where, 0.01),
            energy_on_sphere(surface, vectors(start, where), where, 0.01, domain=MirroredSphere(glued, surface, where)),
        ]
        points = vectors(sphere, where)
        steps, changes = [], []
        symmetric = rng.normal(size=len(glued.half))[np.minimum(np.arange(len(sphere)), glued.mirror)]
        multipliers = wp.array(symmetric, device=where)
        for energy in energies:
            terms = energy.terms(points)
            gradient = energy.gradient(points, terms, multipliers)
            assert np.abs(folded(glued, gradient.numpy()) - gradient.numpy()).max() < 1e-12
            energy.factorise(points, terms, wp.array(0.01 * energy.wanted, device=where))
            _, solution = energy.newton_step(gradient, terms.missing)
            steps.append(solution.numpy()[: 2 * len(sphere)])
            changes.append(solution.numpy()[2 * len(sphere) :])
    scale = np.abs(steps[0]).max()
    assert np.abs(steps[0] - steps[1]).max() < 1e-8 * scale
    assert np.abs(changes[0] - changes[1]).max() < 1e-8 * np.abs(changes[0]).max()


def test_symmetric_optimum_is_that_of_the_double():
    glued, surface, sphere, start = doubled_cap()
    domain = MirroredSphere(glued, surface, resolve_device("cpu"))
    even = omtwarp.optimal_map(surface, sphere, start=start, gain=1e-5, domain=domain, device="cpu")
    free = omtwarp.optimal_map(surface, sphere, start=start, gain=1e-5, device="cpu")
    assert even.converged and free.converged
    assert is_symmetric(glued, even.sphere) and np.abs(even.sphere[glued.on_boundary, 2]).max() == 0.0
    assert is_bijective(even.sphere, surface.faces)
    assert even.history[-1]["cost"] == pytest.approx(free.history[-1]["cost"], rel=1e-5)
    assert np.abs(even.sphere - free.sphere).max() < 2e-3  # edges are 0.15 long


def test_nearly_symmetric_maps_are_made_symmetric_or_refused():
    glued, surface, sphere, _ = doubled_cap()
    assert symmetric_map(glued, surface, sphere, device="cpu") is sphere
    shaken = sphere + 1e-3 * np.random.default_rng(1).normal(size=sphere.shape)
    found = symmetric_map(glued, surface, shaken / np.linalg.norm(shaken, axis=1)[:, None], device="cpu")
    assert found is not None and is_symmetric(glued, found) and np.abs(found - sphere).max() < 0.01
    torn = sphere[np.random.default_rng(2).permutation(len(sphere))]
    assert symmetric_map(glued, surface, torn, repair=False, device="cpu") is None
