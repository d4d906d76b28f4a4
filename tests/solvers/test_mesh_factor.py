"""SciPy's factorisations can carry every stage: each against the built-in solvers, and against dense algebra."""

import numpy as np
import pytest
import trimesh

import omtwarp
from omtwarp.device.policy import solving_with, wanted_solver
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.patches import Patches
from omtwarp.mesh.shapes import blob
from omtwarp.options import Solver
from omtwarp.solvers.cholesky.saddle import SaddleMatrix
from omtwarp.solvers.factor import MeshMatrix, NotPositiveDefinite
from omtwarp.solvers.mesh_factor import (
    SparseFactor,
    cell_saddle_factor,
    solve_parts,
    surface_factor,
    surface_saddle_factor,
)
from omtwarp.solvers.newton import PatchMatrix

SURFACE = blob(seed=3, amplitude=0.3, sphere=1280)
EVERY = (Solver.SCIPY, Solver.CHOLESKY)


def random_blocks(block: int, seed: int = 0):
    """Blocks of a symmetric positive definite matrix on the surface's edges, and the matrix."""
    rng = np.random.default_rng(seed)
    count, edges = SURFACE.vertex_count, SURFACE.edges
    off = rng.normal(size=(len(edges), block, block))
    diagonal = np.broadcast_to(60.0 * np.eye(block), (count, block, block)).copy()
    dense = np.zeros((count, block, count, block))
    dense[np.arange(count), :, np.arange(count), :] = diagonal
    dense[edges[:, 0], :, edges[:, 1], :] = off
    dense[edges[:, 1], :, edges[:, 0], :] = off.transpose(0, 2, 1)
    return diagonal, off, dense.reshape(count * block, count * block)


@pytest.mark.parametrize("solver", [Solver.SCIPY, Solver.CHOLESKY])
@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("columns", [(), (3,)])
def test_solutions_are_those_of_dense_algebra(solver, block, columns):
    diagonal, off, dense = random_blocks(block)
    shape = (SURFACE.vertex_count, *((block,) if block > 1 else ()), *columns)
    right = np.random.default_rng(1).normal(size=shape)
    with solving_with(solver):
        factor = surface_factor(SURFACE, block)
        assert isinstance(factor, SparseFactor) is (solver is Solver.SCIPY)
        factor.factorise(
            MeshMatrix(diagonal.reshape(-1) if block == 1 else diagonal, off.reshape(-1) if block == 1 else off)
        )
        solved = factor.solve(right)
    truth = np.linalg.solve(dense, right.reshape(len(dense), -1)).reshape(shape)
    np.testing.assert_allclose(solved, truth, rtol=0, atol=1e-14)


@pytest.mark.parametrize("solver", [Solver.SCIPY, Solver.CHOLESKY])
def test_what_is_not_positive_definite_is_refused(solver):
    diagonal, off, _ = random_blocks(2)
    diagonal[7] = -np.eye(2)
    with solving_with(solver), pytest.raises(NotPositiveDefinite):
        surface_factor(SURFACE, 2).factorise(MeshMatrix(diagonal, off))


def test_saddle_points_are_solved_alike():
    rng = np.random.default_rng(2)
    diagonal, off, _ = random_blocks(2)
    gradients = rng.normal(size=(2, len(SURFACE.edges), 2))
    compliance = rng.uniform(1.0, 2.0, SURFACE.vertex_count)
    first, second = rng.normal(size=(SURFACE.vertex_count, 2)), rng.normal(size=SURFACE.vertex_count)
    answers = []
    for solver in (Solver.SCIPY, Solver.CHOLESKY):
        with solving_with(solver):
            factor = surface_saddle_factor(SURFACE)
            factor.factorise(SaddleMatrix.of(diagonal, off, gradients, compliance))
            answers.append(solve_parts(factor, first, second))
    for one, other in zip(*answers, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)


def test_saddle_points_with_cells_are_solved_alike():
    rng = np.random.default_rng(3)
    diagonal, off, _ = random_blocks(2)
    gradients = rng.normal(size=(SURFACE.face_count, 3, 2))
    compliance = rng.uniform(1.0, 2.0, SURFACE.face_count)
    first, second = rng.normal(size=(SURFACE.vertex_count, 2)), rng.normal(size=SURFACE.face_count)
    answers = []
    for solver in (Solver.SCIPY, Solver.CHOLESKY):
        with solving_with(solver):
            factor = cell_saddle_factor(SURFACE.scaled_vertices, SURFACE.edges, SURFACE.faces)
            factor.factorise(SaddleMatrix.of(diagonal, off, gradients, compliance))
            answers.append(solve_parts(factor, first, second))
    for one, other in zip(*answers, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-13)


def stages(solver: Solver, moser: np.ndarray, start: np.ndarray) -> dict[str, np.ndarray]:
    """Return the results of all stages that solve a linear system, for one input."""
    tangled = moser.copy()
    corner, across = SURFACE.faces[0, :2]
    tangled[corner] = 2.0 * moser[across] - moser[corner]
    tangled[corner] /= np.linalg.norm(tangled[corner])
    with solving_with(solver):
        return {
            "conformal": omtwarp.conformal_map(SURFACE, device="cpu").sphere,
            "moser": omtwarp.moser_map(SURFACE, start, device="cpu").sphere,
            "untangle": omtwarp.untangle(SURFACE, tangled, device="cpu").sphere,
            "refine": omtwarp.refine_map(SURFACE, moser, iterations=3, device="cpu").sphere,
            "optimal": omtwarp.optimal_map(SURFACE, moser, start=start, iterations=3, device="cpu").sphere,
            "transport": omtwarp.optimal_transport(SURFACE, moser, start=start, iterations=3, device="cpu").sphere,
            "paper": omtwarp.paper_flow(SURFACE, moser, start=start, cycles=1, device="cpu").sphere,
            "barycentric": omtwarp.barycentric_map(SURFACE, device="cpu").sphere,
            "embedding": omtwarp.hierarchical_embedding(SURFACE, device="cpu").sphere,
        }


@pytest.fixture(scope="module")
def by_cholesky():
    start = omtwarp.conformal_map(SURFACE, device="cpu").sphere
    moser = omtwarp.moser_map(SURFACE, start, device="cpu").sphere
    return start, moser, stages(Solver.CHOLESKY, moser, start)


@pytest.mark.parametrize("solver", [Solver.SCIPY])
def test_every_stage_is_the_same_to_round_off(solver, by_cholesky):
    start, moser, expected = by_cholesky
    for name, sphere in stages(solver, moser, start).items():
        np.testing.assert_allclose(sphere, expected[name], rtol=0, atol=1e-10, err_msg=name)


@pytest.mark.parametrize("solver", [Solver.SCIPY])
def test_a_map_to_the_torus_is_the_same_to_round_off(solver):
    ring = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    usual, other = (omtwarp.map_surface(ring, domain="torus", solver=name) for name in ("cholesky", str(solver)))
    np.testing.assert_allclose(other.lattice, usual.lattice, rtol=0, atol=1e-10)
    np.testing.assert_allclose(other.coordinates, usual.coordinates, rtol=0, atol=1e-8)


def test_scipy_carries_a_whole_map_alone(monkeypatch):
    """A whole map with ``--solver scipy`` creates no built-in solver."""
    for name in ("MultifrontalCholesky", "OrderedSaddleFactor"):
        made = f"omtwarp.solvers.mesh_factor.{name}"
        monkeypatch.setattr(made, lambda *_, **__: pytest.fail("a built-in solver was made"))
    mesh = SURFACE.vertices, SURFACE.faces
    plain = omtwarp.map_to_sphere(mesh, solver="scipy", device="cpu")
    assert plain.bijective and plain.report["solver"] == "scipy"
    monkeypatch.undo()
    usual = omtwarp.map_to_sphere(mesh, device="cpu")
    for name in ("conformal", "transported", "sphere"):
        np.testing.assert_allclose(getattr(plain, name), getattr(usual, name), rtol=0, atol=1e-8, err_msg=name)


def test_patches_use_the_solver_that_is_asked_for():
    with solving_with(Solver.SCIPY):
        patches = Patches.of_vertices(SURFACE.faces, SURFACE.vertices[:, 2] > 0.5)
        assert isinstance(PatchMatrix(patches, SURFACE, 0.0)._factor, SparseFactor)


@pytest.mark.parametrize("solver", EVERY)
def test_a_patch_of_one_vertex_has_no_edges(solver):
    patches = Patches.of_vertices(SURFACE.faces, np.arange(SURFACE.vertex_count) == 7)
    with solving_with(solver):
        matrix = PatchMatrix(patches, SURFACE, 0.0)
        matrix.factorise(np.tile(np.eye(6)[np.triu_indices(6)], (len(patches.faces), 1)))
        np.testing.assert_allclose(matrix.solve(np.ones((1, 2))), 1.0 / len(patches.faces), rtol=1e-12)


def test_what_is_asked_for_last_counts(monkeypatch):
    assert wanted_solver() is Solver.AUTO
    monkeypatch.setenv("OMTWARP_SOLVER", "scipy")
    assert wanted_solver() is Solver.SCIPY
    with solving_with(Solver.CHOLESKY):
        assert wanted_solver() is Solver.CHOLESKY
        with solving_with(Solver.AUTO):
            assert wanted_solver() is Solver.CHOLESKY
    monkeypatch.setenv("OMTWARP_SOLVER", "gauss")
    with pytest.raises(OmtwarpError, match="unknown solver 'gauss': use auto, scipy, cholesky"):
        wanted_solver()
