"""Small matrices factorised within their envelopes, one thread each, against NumPy's dense solutions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.solvers.cholesky.envelope import Envelopes
from omtwarp.solvers.cholesky.envelope_kernels import factorise_envelope, solve_envelope

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def solve_each(
    starts: wp.array[wp.int32],
    first: wp.array[wp.int32],
    rows: wp.array[wp.int64],
    # Data in and out:
    matrix: wp.array[wp.mat22d],
    x: wp.array[wp.float64],
    # Data out:
    definite: wp.array[wp.int32],
):
    p, _compiled_once = wp.tid()
    definite[p] = wp.int32(0)
    if factorise_envelope(starts[p], starts[p + 1], first, rows, matrix):
        definite[p] = wp.int32(1)
        solve_envelope(starts[p], starts[p + 1], first, rows, matrix, x)


def solved(edges, matrix, count, dense, right):
    """Solve with the 2x2 blocks of dense matrices; return the solution and whether each matrix is definite."""
    envelopes = Envelopes.of_edges(edges, matrix, count)
    blocks = np.zeros((envelopes.size, 2, 2))
    for i, own in enumerate(envelopes.order):
        for j in range(envelopes.first[i], i + 1):
            other = envelopes.order[j]
            blocks[envelopes.rows[i] + j - envelopes.first[i]] = dense[2 * own : 2 * own + 2, 2 * other : 2 * other + 2]
    x = np.ascontiguousarray(right.reshape(-1, 2)[envelopes.order].ravel())
    definite = np.zeros(count, dtype=np.int32)
    arrays = [(blocks, wp.mat22d), (x, wp.float64), (definite, wp.int32)]
    outputs = [wp.array(values, dtype=kind, device="cpu", copy=False) for values, kind in arrays]
    wp.launch(solve_each, dim=count, inputs=envelopes.upload(), outputs=outputs, device="cpu")
    out = np.empty((len(matrix), 2))
    out[envelopes.order] = x.reshape(-1, 2)
    return out.ravel(), definite.astype(bool)


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


@settings(max_examples=20)
@given(seed=st.integers(0, 10**6), sizes=st.lists(st.integers(1, 25), min_size=1, max_size=4))
def test_solutions_are_those_of_dense_matrices(seed, sizes):
    """Of several graphs at once, single vertices among them, numbered in any order, edges given once or twice."""
    rng = np.random.default_rng(seed)
    vertices = sum(sizes)
    of_matrix = np.repeat(np.arange(len(sizes)), sizes)
    edges = []
    for k in range(len(sizes)):
        own = np.flatnonzero(of_matrix == k)
        edges += [(own[n], own[rng.integers(n)]) for n in range(1, len(own)) for _ in range(2)]
    numbers = rng.permutation(vertices)
    edges = numbers[np.array(edges, dtype=np.int64).reshape(-1, 2)]
    matrix = np.empty(vertices, dtype=np.int64)
    matrix[numbers] = of_matrix
    dense, right = random_matrix(edges, vertices, rng), rng.normal(size=2 * vertices)
    x, definite = solved(edges, matrix, len(sizes), dense, right)
    assert definite.all()
    expected = np.linalg.solve(dense, right)
    assert np.abs(dense @ x - right).max() < 1e-9 * np.abs(dense).max() * np.abs(expected).max() + 1e-12


def test_a_matrix_that_is_not_definite_is_told_from_its_neighbours():
    edges = np.array([[0, 1], [2, 3], [4, 5]])
    matrix = np.array([0, 0, 1, 1, 2, 2])
    dense = random_matrix(edges, 6, np.random.default_rng(1))
    dense[6, 6] = -1.0
    x, definite = solved(edges, matrix, 3, dense, np.ones(12))
    assert definite.tolist() == [True, False, True]
    inside = np.r_[0:4, 8:12]
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
