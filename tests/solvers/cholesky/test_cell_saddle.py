"""Saddle-point matrices with a multiplier per cell: the solution is SciPy's."""

import numpy as np
import pytest
import scipy.sparse as sparse
from scipy.sparse.linalg import spsolve

from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.shapes import icosphere, random_sphere
from omtwarp.solvers.cholesky.saddle import SaddleMatrix, expand_with_cells
from omtwarp.solvers.factor import NotPositiveDefinite
from omtwarp.solvers.mesh_factor import OrderedSaddleFactor, solve_parts


def random_saddle(count, edges, cells, seed):
    """Blocks of a random quasi-definite matrix, and the matrix, coordinates before multipliers."""
    rng = np.random.default_rng(seed)
    off = rng.normal(size=(len(edges), 2, 2))
    diagonal = np.zeros((count, 2, 2))
    for ends in edges.T:
        np.add.at(diagonal, ends, 2.5 * np.eye(2))
    twist = rng.normal(size=count)
    diagonal[:, 0, 1] = diagonal[:, 1, 0] = twist
    diagonal[:, [0, 1], [0, 1]] += np.abs(twist)[:, None] + np.abs(off).sum() / count
    gradients = rng.normal(size=(*cells.shape, 2))
    compliance = rng.uniform(1e-3, 1.0, size=len(cells))
    i, j = edges.T.astype(int)
    rows, columns, values = [], [], []
    for a in range(2):
        for b in range(2):
            rows += [2 * np.arange(count) + a, 2 * i + a, 2 * j + b]
            columns += [2 * np.arange(count) + b, 2 * j + b, 2 * i + a]
            values += [diagonal[:, a, b], off[:, a, b], off[:, a, b]]
    upper = sparse.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))))
    columns = (2 * cells[:, :, None].astype(int) + np.arange(2)).ravel()
    rows = np.repeat(np.arange(len(cells)), 2 * cells.shape[1])
    coupling = sparse.csr_matrix((gradients.ravel(), (rows, columns)), shape=(len(cells), 2 * count))
    matrix = sparse.bmat([[upper, coupling.T], [coupling, -sparse.diags(compliance)]]).tocsc()
    return (diagonal, off, gradients, compliance), matrix


@pytest.mark.parametrize("surface", [icosphere(1), icosphere(6), random_sphere(1200, 3)], ids=str)
def test_solution_is_scipys(surface):
    cut = quarter(surface)
    cells = np.concatenate([surface.faces, cut.middles], axis=1)
    parts, matrix = random_saddle(cut.surface.vertex_count, cut.surface.edges, cells, 1)
    factor = OrderedSaddleFactor(expand_with_cells(cut.surface.scaled_vertices, cut.surface.edges, cells))
    rng = np.random.default_rng(9)
    first, second = rng.normal(size=(cut.surface.vertex_count, 2)), rng.normal(size=len(cells))
    for _ in range(2):  # storage is used again
        factor.factorise(SaddleMatrix.of(*parts))
        u, q = solve_parts(factor, first, second)
    expected = spsolve(matrix, np.concatenate([first.ravel(), second]))
    found = np.concatenate([u.ravel(), q])
    assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()


def test_indefinite_coordinates_are_refused():
    surface = icosphere(2)
    cut = quarter(surface)
    cells = np.concatenate([surface.faces, cut.middles], axis=1)
    (diagonal, *rest), _ = random_saddle(cut.surface.vertex_count, cut.surface.edges, cells, 1)
    factor = OrderedSaddleFactor(expand_with_cells(cut.surface.scaled_vertices, cut.surface.edges, cells))
    with pytest.raises(NotPositiveDefinite):
        factor.factorise(SaddleMatrix.of(-diagonal, *rest))
