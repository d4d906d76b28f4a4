"""Saddle-point matrices: the solution is SciPy's, in every path of the elimination."""

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve

from omtwarp.mesh.shapes import icosphere
from omtwarp.solvers.cholesky.dissection import surface_dissection
from omtwarp.solvers.cholesky.multifrontal import MultifrontalCholesky
from omtwarp.solvers.cholesky.saddle import SaddleMatrix, expand
from omtwarp.solvers.factor import NotPositiveDefinite
from omtwarp.solvers.mesh_factor import OrderedSaddleFactor, solve_parts


def _random_saddle(surface, seed):
    """Blocks of a random quasi-definite matrix on a mesh, and the matrix, coordinates before multipliers."""
    rng = np.random.default_rng(seed)
    count, edges = surface.vertex_count, surface.edges
    off = rng.normal(size=(len(edges), 2, 2))
    diagonal = np.zeros((count, 2, 2))
    for ends in edges.T:
        np.add.at(diagonal, ends, 2.5 * np.eye(2))  # dominates four entries of size about one a neighbour
    twist = rng.normal(size=count)
    diagonal[:, 0, 1] = diagonal[:, 1, 0] = twist
    diagonal[:, [0, 1], [0, 1]] += np.abs(twist)[:, None] + np.abs(off).sum() / count
    gradients = rng.normal(size=(2, len(edges), 2))
    compliance = rng.uniform(1e-3, 1.0, size=count)

    i, j = edges.T
    rows, columns, values = [], [], []
    for a in range(2):
        for b in range(2):
            rows += [2 * np.arange(count) + a, 2 * i + a, 2 * j + b]
            columns += [2 * np.arange(count) + b, 2 * j + b, 2 * i + a]
            values += [diagonal[:, a, b], off[:, a, b], off[:, a, b]]
    upper = sparse.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))))
    rows = np.concatenate([i, i, j, j])
    columns = np.concatenate([2 * j, 2 * j + 1, 2 * i, 2 * i + 1])
    values = np.concatenate([gradients[0, :, 0], gradients[0, :, 1], gradients[1, :, 0], gradients[1, :, 1]])
    coupling = sparse.csr_matrix((values, (rows, columns)), shape=(count, 2 * count))
    matrix = sparse.bmat([[upper, coupling.T], [coupling, -sparse.diags(compliance)]]).tocsc()
    return (diagonal, off, gradients, compliance), matrix


@pytest.mark.parametrize("level", [1, 4, 12])
def test_solution_is_scipys(level):
    surface = icosphere(level)
    parts, matrix = _random_saddle(surface, level)
    factor = OrderedSaddleFactor(expand(surface_dissection(surface)))
    rng = np.random.default_rng(9)
    first, second = rng.normal(size=(surface.vertex_count, 2)), rng.normal(size=surface.vertex_count)
    for _ in range(2):  # storage is used again
        factor.factorise(SaddleMatrix.of(*parts))
        u, q = solve_parts(factor, first, second)
    expected = spsolve(matrix, np.concatenate([first.ravel(), second]))
    found = np.concatenate([u.ravel(), q])
    assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()


def _solved(surface, parts, matrix, single):
    """Relative error of a solution, and the kind of numbers of the factor at the end."""
    order, negative = expand(surface_dissection(surface))
    factor = MultifrontalCholesky(order, negative=negative, single=single)
    factor.factorise_entries(SaddleMatrix.of(*parts).entries)
    wanted = np.random.default_rng(3).normal(size=matrix.shape[0])
    solution = factor.solve(matrix @ wanted)
    return np.abs(solution - wanted).max(), factor._kind


def test_a_factor_in_single_precision_is_refined_in_double():
    surface = icosphere(12)
    parts, matrix = _random_saddle(surface, 1)
    error, kind = _solved(surface, parts, matrix, single=True)
    assert kind == np.float32 and error < 1e-9


def test_where_single_precision_does_not_do_the_factor_is_made_in_double():
    """Coordinates of the whole surface that cost next to nothing, and areas that do not hold them either."""
    surface = icosphere(12)
    count, edges = surface.vertex_count, surface.edges
    free = np.zeros(count)
    np.add.at(free, edges.ravel(), 1.0)
    for least, kinds in ((1e-2, np.float32), (1e-8, np.float64)):
        diagonal = (free + least)[:, None, None] * np.eye(2)
        off = np.broadcast_to(-np.eye(2), (len(edges), 2, 2)).copy()
        parts = diagonal, off, np.zeros((2, len(edges), 2)), np.ones(count)
        whole = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
        laplacian = sparse.diags(free + least) - whole - whole.T
        matrix = sparse.bmat([[sparse.kron(laplacian, np.eye(2)), None], [None, -sparse.eye(count)]]).tocsr()
        error, kind = _solved(surface, parts, matrix, single=True)
        assert kind == kinds and error < 1e-6


def test_indefinite_coordinates_are_refused():
    surface = icosphere(2)
    (diagonal, off, gradients, compliance), _ = _random_saddle(surface, 0)
    factor = OrderedSaddleFactor(expand(surface_dissection(surface)))
    with pytest.raises(NotPositiveDefinite):
        factor.factorise(SaddleMatrix.of(-diagonal, off, gradients, compliance))
