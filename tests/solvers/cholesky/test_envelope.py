"""Small matrices factorised within their envelopes, against NumPy's dense solutions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.solvers.cholesky.envelope import COLUMNS, Envelope, Envelopes, solve_envelope

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def solve_each(
    m: Envelope,
    # Data in and out:
    diagonal: wp.array[wp.mat33d],
    x: wp.array[wp.vec3d],
    # Data out:
    definite: wp.array2d[wp.float64],
):
    p, _compiled_once = wp.tid()
    gates = m.starts  # one lane has no others to wait for
    solve_envelope(p, 0, 1, m, gates, diagonal, x, definite)


def solved(edges, matrix, count, dense, right):
    """Solve with the blocks of dense matrices; return the solution and whether each matrix has the right signs."""
    envelopes = Envelopes.of_edges(edges, matrix, count)
    diagonal, uploaded = np.empty((len(matrix), 3, 3)), envelopes.upload()
    groups = uploaded.left.numpy().reshape(envelopes.size, 3, 3, COLUMNS)
    groups[:] = 0.0
    blocks = dense.reshape(len(matrix), 3, len(matrix), 3).swapaxes(1, 2)
    for i, own in enumerate(envelopes.order):
        diagonal[i] = blocks[own, own]
        for j in range(envelopes.first[i], i):
            group = envelopes.rows[i] + j // COLUMNS - envelopes.first[i] // COLUMNS
            groups[group, :, :, j % COLUMNS] = blocks[own, envelopes.order[j]]
    x = np.ascontiguousarray(right.reshape(-1, 3)[envelopes.order])
    definite = np.zeros((count, 1))
    arrays = [(diagonal, wp.mat33d), (x, wp.vec3d), (definite, wp.float64)]
    outputs = [wp.array(values, dtype=kind, device="cpu", copy=False) for values, kind in arrays]
    wp.launch(solve_each, dim=count, inputs=[uploaded], outputs=outputs, device="cpu")
    out = np.empty((len(matrix), 3))
    out[envelopes.order] = x
    return out.ravel(), definite[:, 0] > 0.0


def random_matrix(edges, vertices, rng):
    """A symmetric positive definite matrix with blocks at the edges, of any scale at each vertex."""
    dense = np.zeros((2 * vertices, 2 * vertices))
    for i, j in edges:
        block = rng.normal(size=(2, 4))  # of rank two over both ends
        ends = [2 * i, 2 * i + 1, 2 * j, 2 * j + 1]
        dense[np.ix_(ends, ends)] += block.T @ block
    dense += np.diag(rng.uniform(0.1, 2.0, 2 * vertices))
    scale = np.repeat(10.0 ** rng.uniform(-2, 2, vertices), 2)
    return scale[:, None] * dense * scale


def random_graphs(sizes, rng):
    """Edges of several graphs, some given twice, the vertices numbered in any order, and the graph of each vertex."""
    vertices = sum(sizes)
    of_matrix = np.repeat(np.arange(len(sizes)), sizes)
    edges = []
    for k in range(len(sizes)):
        own = np.flatnonzero(of_matrix == k)
        edges += [(own[n], own[rng.integers(n)]) for n in range(1, len(own)) for _ in range(2)]
    numbers = rng.permutation(vertices)
    matrix = np.empty(vertices, dtype=np.int64)
    matrix[numbers] = of_matrix
    return numbers[np.array(edges, dtype=np.int64).reshape(-1, 2)], matrix


graphs = given(seed=st.integers(0, 10**6), sizes=st.lists(st.integers(1, 25), min_size=1, max_size=4))


def saddle_point(edges, matrix, rng):
    """A dense matrix with two unknowns of a definite one and a multiplier at each vertex, coupled along edges."""
    vertices = len(matrix)
    dense = np.zeros((vertices, 3, vertices, 3))
    dense[:, :2, :, :2] = random_matrix(edges, vertices, rng).reshape(vertices, 2, vertices, 2)
    ends = np.concatenate([edges, edges[:, ::-1], np.arange(vertices)[:, None].repeat(2, axis=1)])
    for i, j in ends:
        dense[i, 2, j, :2] = rng.normal(size=2)
        dense[j, :2, i, 2] = dense[i, 2, j, :2]
    dense[np.arange(vertices), 2, np.arange(vertices), 2] = -rng.uniform(0.1, 2.0, vertices)
    return dense.reshape(3 * vertices, 3 * vertices)


@settings(max_examples=20)
@graphs
def test_solutions_are_those_of_dense_matrices(seed, sizes):
    """Of several graphs at once, single vertices among them, numbered in any order, edges given once or twice."""
    rng = np.random.default_rng(seed)
    edges, matrix = random_graphs(sizes, rng)
    dense, right = saddle_point(edges, matrix, rng), rng.normal(size=3 * len(matrix))
    x, definite = solved(edges, matrix, len(sizes), dense, right)
    assert definite.all()
    expected = np.linalg.solve(dense, right)
    assert np.abs(dense @ x - right).max() < 1e-9 * np.abs(dense).max() * np.abs(expected).max() + 1e-12


def test_a_matrix_that_is_not_definite_is_told_from_its_neighbours():
    edges = np.array([[0, 1], [2, 3], [4, 5]])
    matrix = np.array([0, 0, 1, 1, 2, 2])
    dense = saddle_point(edges, matrix, np.random.default_rng(1))
    dense[9, 9] = -1.0
    x, definite = solved(edges, matrix, 3, dense, np.ones(18))
    assert definite.tolist() == [True, False, True]
    inside = np.r_[0:6, 12:18]
    np.testing.assert_allclose(dense[np.ix_(inside, inside)] @ x[inside], 1.0, rtol=1e-9)


def test_patches_of_a_mesh_have_a_small_bandwidth():
    """Work grows as for a band of the square root of the number of vertices, not as for dense matrices."""
    operations = []
    for frequency in (6, 12):
        surface = blob(1, sphere=icosphere(frequency))
        half = surface.vertices[:, 2] > 0.0
        number = np.cumsum(half) - 1
        edges = number[surface.edges[half[surface.edges].all(axis=1)]]
        envelopes = Envelopes.of_edges(edges, np.zeros(half.sum(), dtype=np.int64), 1)
        assert sorted(envelopes.order) == list(range(half.sum()))
        operations.append(envelopes.operations[0])
    assert operations[1] == pytest.approx(16.0 * operations[0], rel=0.4)  # with four times the vertices
