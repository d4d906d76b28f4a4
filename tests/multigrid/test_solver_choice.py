"""Where systems are solved is one decision, and maps do not depend on it."""

import numpy as np
import pytest

from omtwarp import linear
from omtwarp._warp import wp
from omtwarp.errors import OmtwarpError
from omtwarp.linear import SurfaceLaplacianSolver
from omtwarp.mesh.shapes import blob, needle
from omtwarp.multigrid import DeviceLaplacian, Outcome, laplacian
from omtwarp.pipeline import map_to_sphere


class OnCuda:
    """What the decision asks of a device."""

    is_cuda = True


def test_large_meshes_on_cuda_are_solved_on_the_device(monkeypatch):
    cpu, cuda = wp.get_device("cpu"), OnCuda()
    limit = linear.DEVICE_VERTICES
    for wanted, expected in {
        None: [False, False, False, True],
        "auto": [False, False, False, True],
        "host": 4 * [False],
        "device": 4 * [True],
    }.items():
        if wanted is not None:
            monkeypatch.setenv("OMTWARP_SOLVER", wanted)
        chosen = [linear.on_device(where, size) for where in (cpu, cuda) for size in (limit, limit + 1)]
        assert chosen == expected
    monkeypatch.setenv("OMTWARP_SOLVER", "gpu")
    with pytest.raises(OmtwarpError, match="unknown OMTWARP_SOLVER 'gpu': use auto, host, device"):
        linear.on_device(cpu, 5)


@pytest.mark.parametrize("columns", [0, 1, 3])
def test_both_solvers_agree(device, monkeypatch, columns):
    surface = blob(seed=2, amplitude=0.4, sphere=3000)
    shape = (surface.vertex_count, columns) if columns else (surface.vertex_count,)
    right = np.random.default_rng(1).normal(size=shape)
    kept = right.copy()
    answers = []
    for solver in ("host", "device"):
        monkeypatch.setenv("OMTWARP_SOLVER", solver)
        answers.append(SurfaceLaplacianSolver(surface, surface.scaled_vertices, device=device).solve(right))
        np.testing.assert_array_equal(right, kept)
    assert answers[1].shape == shape
    np.testing.assert_allclose(answers[1], answers[0], atol=1e-11 * np.abs(answers[0]).max())
    np.testing.assert_allclose(answers[1].mean(axis=0), 0.0, atol=1e-14)


def test_without_convergence_the_host_goes_on(monkeypatch):
    surface = blob(seed=2, sphere=1500)
    right = np.random.default_rng(1).normal(size=surface.vertex_count)
    usual = SurfaceLaplacianSolver(surface, surface.scaled_vertices).solve(right)
    monkeypatch.setenv("OMTWARP_SOLVER", "device")
    monkeypatch.setattr(DeviceLaplacian, "solve", lambda self, given, out: Outcome(7, False))
    solver = SurfaceLaplacianSolver(surface, surface.scaled_vertices)
    for _ in range(2):
        np.testing.assert_array_equal(solver.solve(right), usual)


def test_an_image_stretched_otherwise_gets_levels_of_its_own(monkeypatch):
    """Vertices of a round sphere pulled out to a needle: the surface's levels do not suit it."""
    surface = blob(seed=0, sphere=5120)
    stretched = surface.scaled_vertices * [30.0, 1.0, 1.0]
    points = wp.array(stretched, dtype=wp.vec3d, device="cpu")
    right = wp.array(np.random.default_rng(1).normal(size=surface.vertex_count), dtype=wp.float64, device="cpu")
    out = wp.empty_like(right)
    solver = DeviceLaplacian(surface, points)
    first, second = solver.solve(right, out), solver.solve(right, out)
    assert first.iterations > laplacian.MANY_ITERATIONS and first.converged
    assert second.converged and second.iterations < 0.8 * first.iterations
    truth = SurfaceLaplacianSolver(surface, stretched).solve(right.numpy())
    np.testing.assert_allclose(out.numpy(), truth, atol=1e-9 * np.abs(truth).max())


def test_levels_are_made_once_for_a_surface():
    surface, where = needle(3.0, 1000), wp.get_device("cpu")
    assert laplacian.surface_hierarchy(surface, where) is laplacian.surface_hierarchy(surface, where)
    assert laplacian.surface_hierarchy(needle(3.0, 1000), where) is not laplacian.surface_hierarchy(surface, where)


def test_a_whole_map_does_not_depend_on_where_it_is_solved(device, monkeypatch):
    surface = blob(seed=11, amplitude=0.4, sphere=2000)
    results = []
    for solver, where in (("host", "cpu"), ("device", device), ("device", device)):
        monkeypatch.setenv("OMTWARP_SOLVER", solver)
        results.append(map_to_sphere((surface.vertices, surface.faces), device=where))
    host, one, two = results
    for name in ("conformal", "moser", "transported", "sphere"):
        np.testing.assert_allclose(getattr(one, name), getattr(host, name), atol=1e-6)
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert [s["flips"] for s in one.report["stages"]] == [s["flips"] for s in host.report["stages"]]
