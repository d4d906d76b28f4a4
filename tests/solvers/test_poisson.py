"""Sparse solves against SciPy's own and against dense least squares."""

import numpy as np
import pytest
import scipy.sparse as sparse
from hypothesis import given, settings, strategies as st
from scipy.sparse.linalg import spsolve

from omtwarp.errors import OmtwarpError
from omtwarp.geometry import cotangent_laplacian
from omtwarp.mesh.shapes import blob, icosphere, random_sphere
from omtwarp.solvers.poisson import Factorization, LaplacianSolver


def definite(seed: int, size: int = 40) -> sparse.csc_matrix:
    """A random sparse symmetric positive definite matrix."""
    rng = np.random.default_rng(seed)
    root = sparse.random(size, size, density=0.1, rng=rng, data_rvs=rng.standard_normal)
    return sparse.csc_matrix(root @ root.T + sparse.identity(size))


@pytest.mark.parametrize("seed", range(5))
def test_factorization_solves_like_scipy(seed):
    matrix = definite(seed)
    right = np.random.default_rng(seed).normal(size=(40, 3))
    factorization = Factorization(matrix)
    truth = spsolve(matrix, right)
    np.testing.assert_allclose(factorization.solve(right), truth, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(factorization.solve(right[:, 1]), truth[:, 1], rtol=1e-10, atol=1e-12)
    strided = np.asfortranarray(right)[:, ::2]
    np.testing.assert_allclose(factorization.solve(strided), truth[:, ::2], rtol=1e-10, atol=1e-12)


def test_any_sparse_format_is_taken():
    matrix = definite(7)
    truth = np.linalg.solve(matrix.toarray(), np.ones(40))
    for form in (matrix, sparse.csr_matrix(matrix), sparse.coo_matrix(matrix), sparse.csc_array(matrix)):
        np.testing.assert_allclose(Factorization(form).solve(np.ones(40)), truth, rtol=1e-10)


def test_a_singular_matrix_is_one_clear_error():
    with pytest.raises(OmtwarpError, match="2 unknowns is singular"):
        Factorization(sparse.csc_matrix(np.ones((2, 2))))


def test_the_right_hand_side_is_left_alone():
    right = np.random.default_rng(0).normal(size=40)
    before = right.copy()
    Factorization(definite(1)).solve(right)
    np.testing.assert_array_equal(right, before)


@settings(max_examples=10)
@given(seed=st.integers(0, 10_000), columns=st.sampled_from([0, 1, 3]))
def test_laplacian_solver_is_the_least_squares_solution_of_least_norm(seed, columns):
    """The minimum-norm solution has mean zero, and its residual is the right-hand side's mean: both as documented."""
    surface = blob(seed=seed, amplitude=0.3, sphere=random_sphere(160, seed))
    laplacian = cotangent_laplacian(surface.scaled_vertices, surface.faces)
    shape = (surface.vertex_count, columns) if columns else surface.vertex_count
    right = np.random.default_rng(seed).normal(size=shape)
    truth = np.linalg.lstsq(laplacian.toarray(), right, rcond=1e-12)[0]
    got = LaplacianSolver(laplacian).solve(right)
    assert got.shape == right.shape
    scale = np.abs(truth).max()
    np.testing.assert_allclose(got, truth, rtol=0, atol=1e-9 * scale)


def test_pinned_vertex_does_not_matter():
    surface = blob(seed=3, sphere=320)
    laplacian = cotangent_laplacian(surface.scaled_vertices, surface.faces)
    right = np.random.default_rng(3).normal(size=surface.vertex_count)
    one, other = (LaplacianSolver(laplacian, pinned=k).solve(right) for k in (0, 100))
    np.testing.assert_allclose(one, other, atol=1e-11 * np.abs(one).max())


def test_spherical_harmonics_are_eigenfunctions():
    """Δ z = -2 z on the unit sphere: solving L u = M z gives z / 2, to second order in the triangles' size."""
    errors = []
    for frequency in (8, 16):
        surface = icosphere(frequency)
        z = surface.vertices[:, 2]
        u = LaplacianSolver(cotangent_laplacian(surface.vertices, surface.faces)).solve(surface.vertex_areas * z)
        errors.append(np.abs(u - z / 2).max())
    assert errors[0] < 0.01
    assert errors[1] < 0.3 * errors[0]
