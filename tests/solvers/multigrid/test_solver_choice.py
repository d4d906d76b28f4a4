"""One policy decides where systems are solved, and maps do not depend on it."""

import numpy as np
import pytest

from omtwarp.conformal import conformal_map
from omtwarp.device import policy
from omtwarp.device.start import wp
from omtwarp.device.sums import MAX_PARTIAL_ROWS
from omtwarp.errors import OmtwarpError
from omtwarp.geometry import cotangent_laplacian
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.shapes import blob, needle
from omtwarp.moser import moser_map
from omtwarp.solvers.multigrid import DeviceLaplacian, Outcome, laplacian
from omtwarp.solvers.poisson import LaplacianSolver, SurfaceLaplacianSolver, solve_arrays
from omtwarp.transport.flow import optimal_transport
from omtwarp.transport.polish import polish_transport


class OnCuda:
    """A stand-in for a CUDA device with the attributes that the policy reads."""

    is_cuda = True


def test_large_meshes_on_cuda_are_solved_on_the_device(monkeypatch):
    cpu, cuda = wp.get_device("cpu"), OnCuda()
    limit = policy.DEVICE_VERTICES
    for wanted, expected in {
        None: [False, False, False, True],
        "auto": [False, False, False, True],
        "cholesky": 4 * [False],
        "scipy": 4 * [False],
        "multigrid": 4 * [True],
    }.items():
        if wanted is not None:
            monkeypatch.setenv("OMTWARP_SOLVER", wanted)
        chosen = [policy.on_device(where, size) for where in (cpu, cuda) for size in (limit, limit + 1)]
        assert chosen == expected
    monkeypatch.setenv("OMTWARP_SOLVER", "gpu")
    with pytest.raises(OmtwarpError, match="unknown solver 'gpu': use auto, scipy, cholesky, multigrid, cudss"):
        policy.on_device(cpu, 5)


@pytest.mark.parametrize("columns", [0, 1, 3])
def test_both_solvers_agree(device, monkeypatch, columns):
    surface = blob(seed=2, amplitude=0.4, sphere=3000)
    shape = (surface.vertex_count, columns) if columns else (surface.vertex_count,)
    right = np.random.default_rng(1).normal(size=shape)
    kept = right.copy()
    answers = []
    for solver in ("cholesky", "multigrid"):
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
    monkeypatch.setenv("OMTWARP_SOLVER", "multigrid")
    monkeypatch.setattr(DeviceLaplacian, "solve", lambda self, given, out: Outcome(7, False))
    solver = SurfaceLaplacianSolver(surface, surface.scaled_vertices)
    for _ in range(2):
        np.testing.assert_array_equal(solver.solve(right), usual)
    (solved,) = solver.solve_arrays([wp.array(right, dtype=wp.float64, device="cpu")])
    np.testing.assert_array_equal(solved.numpy(), usual)


def test_an_image_stretched_otherwise_gets_levels_of_its_own(monkeypatch):
    """A sphere stretched to a needle, for which the surface's levels converge too slowly, gets levels of its own."""
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


def test_arrays_are_solved_where_the_solver_is(device, monkeypatch):
    """Every solver takes several right-hand sides on a device, and returns solutions on that device."""
    surface = blob(seed=2, amplitude=0.4, sphere=1500)
    matrix = cotangent_laplacian(surface.scaled_vertices, surface.faces)
    right = np.random.default_rng(1).normal(size=(surface.vertex_count, 2))
    truth = LaplacianSolver(matrix).solve(right)
    given = [wp.array(np.ascontiguousarray(column), dtype=wp.float64, device=device) for column in right.T]
    positions = wp.array(surface.scaled_vertices, dtype=wp.vec3d, device=device)
    solvers = [LaplacianSolver(matrix)]
    for kind in ("cholesky", "multigrid"):
        monkeypatch.setenv("OMTWARP_SOLVER", kind)
        for points in (surface.scaled_vertices, positions):
            solvers.append(SurfaceLaplacianSolver(surface, points, device=device))
    positions.zero_()  # by now it may change
    for solver in solvers:
        for column, solved in enumerate(solve_arrays(solver, given)):
            assert solved.device == wp.get_device(device)
            np.testing.assert_allclose(solved.numpy(), truth[:, column], atol=1e-11 * np.abs(truth).max())


@pytest.fixture(scope="module")
def by_stages():
    """A surface, and its maps stage by stage on the host."""
    surface = blob(seed=11, amplitude=0.4, sphere=3000)
    start = conformal_map(surface, device="cpu").sphere
    moser = moser_map(surface, start, device="cpu").sphere
    transported = optimal_transport(surface, moser, start=start, device="cpu").sphere
    polished = polish_transport(surface, transported, start=start, device="cpu")
    return surface, start, moser, transported, polished


def test_each_stage_agrees(device, monkeypatch, by_stages):
    surface, start, moser, transported, polished = by_stages
    monkeypatch.setenv("OMTWARP_SOLVER", "multigrid")
    np.testing.assert_allclose(conformal_map(surface, device=device).sphere, start, atol=1e-9)
    np.testing.assert_allclose(moser_map(surface, start, device=device).sphere, moser, atol=1e-9)
    again = polish_transport(surface, transported, start=start, device=device)
    np.testing.assert_allclose(again.sphere, polished.sphere, atol=1e-9)
    assert len(again.history) == len(polished.history) > 3
    for one, other in zip(again.history, polished.history, strict=True):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-9)


def test_only_numbers_leave_the_device_within_a_stage(device, monkeypatch, by_stages):
    """Within a stage no array as long as the mesh leaves the device, but for its map and its documented results."""
    surface, start, _, transported, _ = by_stages
    monkeypatch.setenv("OMTWARP_SOLVER", "multigrid")
    laplacian.surface_hierarchy(surface, wp.get_device(device))  # levels are made from the host's arrays, once
    read = []
    numpy = wp.array.numpy
    monkeypatch.setattr(wp.array, "numpy", lambda self: (read.append(self.size), numpy(self))[1])
    conformal_map(surface, device=device)
    assert len(read) > 6  # sums for every step of centring
    # The plane, and the sphere:
    assert [size for size in read if size > 12 * MAX_PARTIAL_ROWS] == 3 * [surface.vertex_count]
    read.clear()
    moser_map(surface, start, device=device)
    # Points, potential and steps:
    assert [size for size in read if size > MAX_PARTIAL_ROWS] == 3 * [surface.vertex_count]
    read.clear()
    rounds = len(polish_transport(surface, transported, start=start, device=device).history)
    assert rounds > 3
    assert len(read) > 3 * rounds
    assert [size for size in read if size > 3 * MAX_PARTIAL_ROWS] == [surface.vertex_count]


def test_a_whole_map_does_not_depend_on_where_it_is_solved(device, monkeypatch):
    surface = blob(seed=11, amplitude=0.4, sphere=2000)
    results = []
    for solver, where in (("cholesky", "cpu"), ("multigrid", device), ("multigrid", device)):
        monkeypatch.setenv("OMTWARP_SOLVER", solver)
        results.append(map_to_sphere((surface.vertices, surface.faces), device=where))
    host, one, two = results
    for name in ("conformal", "transported", "sphere"):
        atol = 1e-9 if device == "cpu" else 1e-6
        np.testing.assert_allclose(getattr(one, name), getattr(host, name), atol=atol)
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert [s["flips"] for s in one.report["stages"]] == [s["flips"] for s in host.report["stages"]]
