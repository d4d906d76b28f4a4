"""Multigrid and conjugate gradients on the device against SciPy's direct solver, on the matrices of maps."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import scipy.sparse as sparse
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.linalg import splu

from omtwarp.device.start import wp
from omtwarp.geometry.edge_weights import cotangent_edge_weights
from omtwarp.mesh.shapes import blob, ellipsoid, icosphere, needle, noisy, random_sphere, uv_sphere
from omtwarp.mesh.surface import Surface
from omtwarp.refine.energy import DistortionEnergy
from omtwarp.solvers.multigrid import MeshHierarchy, MultigridSolver
from omtwarp.solvers.multigrid.hierarchy import COARSEST, aggregate, colour
from omtwarp.solvers.triangle_newton.newton import NewtonMatrix
from omtwarp.start.hierarchical import hierarchical_embedding

SHAPES = {
    "blob": lambda: blob(0, amplitude=0.4, sphere=5120),
    "noise": lambda: noisy(blob(1, sphere=4000), 0.3),
    "uneven": lambda: blob(2, sphere=random_sphere(4000, 3, clustering=0.8)),
    "slivers": lambda: needle(20.0, 5120),
    "hubs": lambda: uv_sphere(40, 120),
    "flat": lambda: ellipsoid((1.0, 1.0, 0.05), 5120),
}


def laplacian(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Diagonal and edge entries of the cotangent Laplacian."""
    weights = cotangent_edge_weights(surface, surface.scaled_vertices)
    count, edges = surface.vertex_count, surface.edges
    return np.bincount(edges[:, 0], weights, count) + np.bincount(edges[:, 1], weights, count), -weights


def assembled(surface: Surface, diagonal: np.ndarray, off: np.ndarray) -> sparse.csc_matrix:
    """The matrix with these blocks, by SciPy alone; shapes [V, b, b] and [E, b, b]."""
    block, count = diagonal.shape[-1], surface.vertex_count
    i, j = surface.edges.T
    rows, columns = np.r_[np.arange(count), i, j], np.r_[np.arange(count), j, i]
    blocks = np.concatenate([diagonal, off, off.transpose(0, 2, 1)])
    u, v = np.meshgrid(np.arange(block), np.arange(block), indexing="ij")
    places = (block * rows[:, None, None] + u).ravel(), (block * columns[:, None, None] + v).ravel()
    return sparse.csc_matrix((blocks.ravel(), places))


def solver_of(
    surface: Surface, diagonal: np.ndarray, off: np.ndarray, device: str = "cpu", record: bool | None = None
) -> MultigridSolver:
    """A solver for one unknown per vertex; whether constants are annihilated shows in the entries."""
    where = wp.get_device(device)
    hierarchy = MeshHierarchy(surface.vertex_count, surface.edges, diagonal, off, where)
    singular = abs(diagonal.sum() + 2.0 * off.sum()) < 1e-10 * diagonal.sum()
    solver = MultigridSolver(hierarchy, record=record, laplacian=singular)
    solver.refresh(*(wp.array(a, dtype=wp.float64, device=where) for a in (diagonal, off)))
    return solver


def solved(solver: MultigridSolver, right: np.ndarray, tolerance: float = 1e-12) -> tuple[np.ndarray, int]:
    """The solution and the number of iterations."""
    flat = wp.array(right.ravel(), dtype=wp.float64, device=solver.device)
    out = wp.empty_like(flat)
    outcome = solver.solve(flat, out, tolerance)
    assert outcome.converged
    return out.numpy().reshape(right.shape).copy(), outcome.iterations


def newton(surface: Surface, sphere: np.ndarray, weight: float = 100.0, curvature_share: float = 1.0):
    """Blocks of the Newton matrix at a map, its gradient in tangent coordinates, and what rotations do there."""
    energy = DistortionEnergy(surface, wp.get_device("cpu"))
    points = energy.upload(sphere)
    blocks = energy.hessian(points, energy.terms(points), weight, curvature_share).numpy()
    diagonal, off = NewtonMatrix.of_surface(surface).assemble(blocks)
    diagonal = diagonal + 1e-8 * np.einsum("vuu->v", diagonal).mean() / 2.0 * np.eye(2)
    # The bases of omtwarp.solvers.triangle_newton.triangle.first_tangent.
    axis = np.where(
        (np.abs(sphere[:, 1]) < np.abs(sphere[:, 0])) & (np.abs(sphere[:, 1]) <= np.abs(sphere[:, 2])),
        1,
        np.where(np.abs(sphere[:, 2]) < np.abs(sphere[:, 0]), 2, 0),
    )
    first = np.cross(sphere, np.eye(3)[axis])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(sphere, first)
    return diagonal, off.copy(), np.stack([second, -first], axis=1)


def start_map(surface: Surface) -> np.ndarray:
    return hierarchical_embedding(surface, device="cpu").sphere


@pytest.mark.parametrize("shape", SHAPES)
def test_laplacians_are_solved_as_by_scipy(shape):
    """Laplacians of closed surfaces, whose right-hand sides and solutions have mean zero, are solved as by SciPy."""
    surface = SHAPES[shape]()
    diagonal, off = laplacian(surface)
    if shape in ("noise", "slivers"):
        assert (off > 0.0).any()  # obtuse: entries of the sign that M-matrices do not have
    right = np.random.default_rng(0).normal(size=surface.vertex_count)
    right -= right.mean()
    matrix = assembled(surface, diagonal[:, None, None], off[:, None, None])
    truth = np.r_[0.0, splu(matrix[1:, 1:]).solve(right[1:])]
    got, iterations = solved(solver_of(surface, diagonal, off), right, 1e-13)
    assert abs(got.mean()) < 1e-12 * np.abs(got).max()
    np.testing.assert_allclose(got, truth - truth.mean(), atol=1e-9 * np.abs(truth).max())
    assert iterations <= (120 if shape == "slivers" else 50)


def test_iterations_hardly_grow_with_the_mesh():
    counts = []
    for faces in (5120, 20480, 81920):
        surface = blob(0, sphere=faces)
        right = np.random.default_rng(0).normal(size=surface.vertex_count)
        counts.append(solved(solver_of(surface, *laplacian(surface)), right - right.mean())[1])
    assert counts[2] <= 1.3 * counts[0] and counts[2] <= 30


@pytest.mark.parametrize("mass", [1e-6, 1.0, 1e4])
def test_laplacians_with_a_mass(mass):
    surface = SHAPES["noise"]()
    diagonal, off = laplacian(surface)
    diagonal += mass * surface.vertex_areas
    right = np.random.default_rng(1).normal(size=surface.vertex_count)
    truth = splu(assembled(surface, diagonal[:, None, None], off[:, None, None])).solve(right)
    got, _ = solved(solver_of(surface, diagonal, off), right, 1e-13)
    np.testing.assert_allclose(got, truth, rtol=1e-8, atol=1e-9 * np.abs(truth).max())


@pytest.fixture(scope="module")
def uneven_solver():
    surface = SHAPES["uneven"]()
    diagonal, off = laplacian(surface)
    diagonal = diagonal + surface.vertex_areas
    return splu(assembled(surface, diagonal[:, None, None], off[:, None, None])), solver_of(surface, diagonal, off)


@settings(max_examples=12)
@given(seed=st.integers(0, 10**6), scale=st.floats(-60.0, 60.0), support=st.sampled_from([1, 10, 10**6]))
def test_any_right_hand_side(uneven_solver, seed, scale, support):
    """Right-hand sides of any size, at all vertices or a single one, are solved."""
    direct, solver = uneven_solver
    rng = np.random.default_rng(seed)
    right = np.zeros(direct.shape[0])
    chosen = rng.permutation(len(right))[:support]
    right[chosen] = 10.0**scale * rng.normal(size=len(chosen))
    truth = direct.solve(right)
    got, iterations = solved(solver, right)
    np.testing.assert_allclose(got, truth, rtol=0, atol=1e-9 * np.abs(truth).max())
    assert iterations <= 40


def test_nothing_gives_nothing(uneven_solver):
    got, iterations = solved(uneven_solver[1], np.zeros(uneven_solver[0].shape[0]))
    assert iterations == 0 and not got.any()


@pytest.mark.parametrize("right", [np.nan, np.inf])
def test_what_is_not_finite_is_said_to_have_failed(uneven_solver, right):
    direct, solver = uneven_solver
    values = np.ones(direct.shape[0])
    values[7] = right
    flat = wp.array(values, dtype=wp.float64, device="cpu")
    assert not solver.solve(flat, wp.empty_like(flat), 1e-10).converged


def test_an_indefinite_matrix_is_said_to_have_failed():
    surface = icosphere(12)
    diagonal, off = laplacian(surface)
    right = np.random.default_rng(0).normal(size=surface.vertex_count)
    solver = solver_of(surface, diagonal, off)
    solver.refresh(*(wp.array(a, dtype=wp.float64, device="cpu") for a in (diagonal - 3.0, off)))
    flat = wp.array(right, dtype=wp.float64, device="cpu")
    assert not solver.solve(flat, wp.empty_like(flat), 1e-10).converged


@pytest.mark.parametrize("shape", ["blob", "uneven"])
@pytest.mark.parametrize("curvature_share", [1.0, 0.03])
def test_newton_matrices_are_solved_as_by_scipy(shape, curvature_share):
    """Newton matrices with λ = 100, nearly singular under rotations of the sphere, are solved as by SciPy."""
    surface = SHAPES[shape]()
    sphere = start_map(surface)
    diagonal, off, rotations = newton(surface, sphere, 100.0, curvature_share)
    device = wp.get_device("cpu")
    weights = cotangent_edge_weights(surface, sphere)
    own = np.bincount(surface.edges.ravel(), np.repeat(weights, 2), surface.vertex_count)
    hierarchy = MeshHierarchy(surface.vertex_count, surface.edges, own, -weights, device)
    solver = MultigridSolver(hierarchy, block=2)
    flat = [wp.array(a.ravel(), dtype=wp.float64, device=device) for a in (diagonal, off, rotations)]
    solver.refresh(*flat)
    # As a gradient is: nothing along the rotations.
    right = np.random.default_rng(0).normal(size=(surface.vertex_count, 2))
    modes, _ = np.linalg.qr(rotations.reshape(-1, 3))
    right -= (modes @ (modes.T @ right.ravel())).reshape(-1, 2)
    truth = splu(assembled(surface, diagonal, off)).solve(right.ravel()).reshape(-1, 2)
    got, iterations = solved(solver, right, 1e-11)
    matrix = assembled(surface, diagonal, off)
    difference = (got - truth).ravel()
    # As far as the factorisation itself can be trusted.
    assert difference @ (matrix @ difference) < 1e-15 * (truth.ravel() @ (matrix @ truth.ravel()))
    assert iterations <= 120


def test_the_same_bits_twice(device):
    surface = SHAPES["noise"]()
    diagonal, off = laplacian(surface)
    right = np.random.default_rng(3).normal(size=surface.vertex_count)
    right -= right.mean()
    answers = [solved(solver_of(surface, diagonal, off, device), right)[0] for _ in range(2)]
    solver = solver_of(surface, diagonal, off, device)
    solved(solver, np.roll(right, 1))
    solver.refresh(*(wp.array(a, dtype=wp.float64, device=device) for a in (2.0 * diagonal, 2.0 * off)))
    halved, _ = solved(solver, right)
    np.testing.assert_array_equal(answers[0], answers[1])
    np.testing.assert_array_equal(2.0 * halved, answers[0])  # a power of two changes no bit of a mantissa


def test_the_loop_can_be_recorded():
    """A recorded solve, replayed with other right-hand sides and matrices, gives the same as a direct one."""
    surface = SHAPES["uneven"]()
    diagonal, off = laplacian(surface)
    diagonal += surface.vertex_areas
    plain, recorded = (solver_of(surface, diagonal, off, record=record) for record in (False, True))
    rng = np.random.default_rng(5)
    for change in (1.0, 3.0):
        for solver in (plain, recorded):
            solver.refresh(*(wp.array(a, dtype=wp.float64, device="cpu") for a in (change * diagonal, off)))
        for _ in range(2):
            right = rng.normal(size=surface.vertex_count)
            (one, steps), (other, same) = (solved(solver, right) for solver in (plain, recorded))
            np.testing.assert_array_equal(one, other)
            assert steps == same > 0


def test_devices_agree(device):
    surface = SHAPES["blob"]()
    diagonal, off = laplacian(surface)
    right = np.random.default_rng(3).normal(size=surface.vertex_count)
    right -= right.mean()
    cpu, other = (solved(solver_of(surface, diagonal, off, where), right)[0] for where in ("cpu", device))
    np.testing.assert_allclose(other - other.mean(), cpu - cpu.mean(), atol=1e-10 * np.abs(cpu).max())


def test_the_preconditioner_is_symmetric_and_near_the_inverse():
    """Of the preconditioned matrix all eigenvalues but that of the constant lie in a short interval up to one."""
    surface = blob(0, amplitude=0.4, sphere=900)
    diagonal, off = laplacian(surface)
    solver = solver_of(surface, diagonal, off)
    count = surface.vertex_count
    cycle = np.empty((count, count))
    for k, unit in enumerate(np.eye(count)):
        column = wp.array(cycle[k], dtype=wp.float64, device="cpu", copy=False)
        solver._cycle.apply(wp.array(unit, dtype=wp.float64, device="cpu"), column)
    np.testing.assert_allclose(cycle, cycle.T, atol=1e-13 * np.abs(cycle).max())
    matrix = assembled(surface, diagonal[:, None, None], off[:, None, None]).toarray()
    values = np.sort(np.linalg.eigvals(cycle @ matrix).real)
    assert abs(values[0]) < 1e-9
    assert values[1] > 0.2 and values[-1] < 1.0 + 1e-9


@pytest.mark.parametrize("shape", SHAPES)
def test_levels(shape):
    """Every node is in one connected group, neighbours differ in colour, and patterns are those of SciPy's products."""
    surface = SHAPES[shape]()
    diagonal, off = laplacian(surface)
    hierarchy = MeshHierarchy(surface.vertex_count, surface.edges, diagonal, off, wp.get_device("cpu"))
    sizes = [level.size for level in hierarchy.levels]
    assert sizes[0] == surface.vertex_count and sizes[-1] <= COARSEST < sizes[-2]
    assert all(2 * below <= above for above, below in pairwise(sizes))
    pattern = None
    for level in hierarchy.levels:
        rows, columns = level.pattern.rows.numpy(), level.pattern.columns.numpy()
        if pattern is not None:
            mine = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (level.size, level.size))
            assert (abs(mine - (pattern > 0)) > 0).nnz == 0
        assert (rows[level.diagonal.numpy()] == np.arange(level.size)).all()
        nodes = np.concatenate([c.numpy() for c in level.colours])
        np.testing.assert_array_equal(np.sort(nodes), np.arange(level.size))
        own = np.empty(level.size, dtype=int)
        own[nodes] = np.repeat(np.arange(len(level.colours)), [c.size for c in level.colours])
        assert (own[rows] != own[columns])[rows != columns].all()
        if level.aggregates is not None:
            groups = level.aggregates.numpy()
            assert groups.min() == 0 and len(np.unique(groups)) == groups.max() + 1
            adjacency = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), (level.size, level.size))
            tentative = sparse.csr_matrix((np.ones(level.size), (np.arange(level.size), groups)))
            smoothed = (adjacency @ tentative > 0).astype(float)
            pattern = smoothed.T @ adjacency @ smoothed


def test_groups_and_colours_of_small_graphs():
    """Groups and colours are right for a path, a star and isolated nodes."""
    path = sparse.diags([-np.ones(8), 2.0 * np.ones(9), -np.ones(8)], [-1, 0, 1]).tocsr()
    groups, number = aggregate(path, 0.1)
    np.testing.assert_array_equal(groups, [0, 0, 1, 1, 1, 2, 2, 2, 2])
    assert number == 3
    dense = np.diag([5.0] + 5 * [1.0])
    dense[0, 1:] = dense[1:, 0] = -1.0
    star = sparse.csr_matrix(dense)
    assert aggregate(star, 0.1)[1] == 1
    assert [len(nodes) for nodes in colour(star)] == [1, 5]
    assert aggregate(sparse.identity(4).tocsr(), 0.1)[1] == 4
