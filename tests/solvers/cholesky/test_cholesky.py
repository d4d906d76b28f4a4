"""Sparse Cholesky on surfaces against SciPy's general solver, and the order of elimination against its definition."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sparse
from hypothesis import given, settings, strategies as st
from scipy.sparse.linalg import splu, spsolve

from omtwarp.geometry import cotangent_laplacian
from omtwarp.geometry.operators import cotangent_edge_weights
from omtwarp.mesh.shapes import blob, icosphere, random_sphere, uv_sphere
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.cholesky import MultifrontalCholesky, dissect, multifrontal, part_dissection, surface_dissection
from omtwarp.solvers.factor import MeshMatrix, NotPositiveDefinite
from omtwarp.solvers.poisson import LaplacianSolver, cotangent_solver


def block_matrix(surface: Surface, diagonal: np.ndarray, off: np.ndarray) -> sparse.csc_matrix:
    """The symmetric matrix with these blocks, assembled without the package."""
    block, count = diagonal.shape[-1], surface.vertex_count
    i, j = surface.edges.T
    rows = np.concatenate([np.arange(count), i, j])
    columns = np.concatenate([np.arange(count), j, i])
    blocks = np.concatenate([diagonal, off, off.transpose(0, 2, 1)])
    u, v = np.meshgrid(np.arange(block), np.arange(block), indexing="ij")
    return sparse.csc_matrix(
        (blocks.ravel(), ((block * rows[:, None, None] + u).ravel(), (block * columns[:, None, None] + v).ravel()))
    )


def dominant_blocks(surface: Surface, block: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random symmetric blocks of a positive definite matrix: its diagonal outweighs its rows."""
    rng = np.random.default_rng(seed)
    off = rng.normal(size=(len(surface.edges), block, block))
    weight = np.bincount(surface.edges.ravel(), np.repeat(np.abs(off).sum(axis=(1, 2)), 2), surface.vertex_count)
    diagonal = rng.normal(size=(surface.vertex_count, block, block))
    diagonal = diagonal + diagonal.transpose(0, 2, 1)
    diagonal += (np.abs(diagonal).sum(axis=(1, 2)) + weight + 0.1)[:, None, None] * np.eye(block)
    return diagonal, off


@settings(max_examples=12)
@given(
    seed=st.integers(0, 10_000),
    count=st.sampled_from([4, 6, 30, 200, 900]),
    block=st.sampled_from([1, 2]),
    leaf=st.sampled_from([2, 8, 48]),
)
def test_solutions_are_those_of_a_general_solver(seed, count, block, leaf):
    surface = blob(seed=seed, sphere=random_sphere(count, seed))
    diagonal, off = dominant_blocks(surface, block, seed)
    factor = MultifrontalCholesky(dissect(surface.vertices, surface.edges, leaf), block)
    factor.factorise(MeshMatrix(diagonal, off))
    right = np.random.default_rng(seed + 1).normal(size=(surface.vertex_count, block, 3))
    truth = spsolve(block_matrix(surface, diagonal, off), right.reshape(-1, 3)).reshape(right.shape)
    np.testing.assert_allclose(factor.solve(right), truth, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(factor.solve(right[:, :, 1]), truth[:, :, 1], rtol=1e-9, atol=1e-11)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    counts=st.lists(st.sampled_from([4, 5, 12, 40, 150]), min_size=1, max_size=7),
    block=st.sampled_from([1, 2]),
    leaf=st.sampled_from([2, 8, 24]),
    threads=st.sampled_from([1, 3]),
)
def test_pieces_that_do_not_touch(seed, counts, block, leaf, threads):
    """Meshes of several pieces, such as patches that are untangled, are factorised; their fronts form a forest."""
    rng = np.random.default_rng(seed)
    pieces = [random_sphere(count, seed + k) for k, count in enumerate(counts)]
    first = np.cumsum([0, *(piece.vertex_count for piece in pieces)])
    points = np.concatenate([piece.vertices + rng.normal(scale=4.0, size=3) for piece in pieces])
    edges = np.concatenate([piece.edges + start for piece, start in zip(pieces, first, strict=False)]).astype(np.int32)
    union = SimpleNamespace(vertex_count=int(first[-1]), edges=edges)
    diagonal, off = dominant_blocks(union, block, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(multifrontal, "MIN_PARALLEL_OPERATIONS", 1.0)
        factor = MultifrontalCholesky(dissect(points, edges, leaf), block, threads)
        factor.factorise(MeshMatrix(diagonal, off))
    right = rng.normal(size=(union.vertex_count, block))
    truth = spsolve(block_matrix(union, diagonal, off), right.ravel()).reshape(right.shape)
    np.testing.assert_allclose(factor.solve(right), truth, rtol=1e-9, atol=1e-11)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), chosen=st.sampled_from([1, 3, 20, 300, 1212]), threads=st.sampled_from([1, 3]))
def test_a_part_is_ordered_by_the_separators_of_the_whole(seed, chosen, threads):
    """Systems on any vertices of a surface, as those of patches, are solved in the order of the whole surface."""
    surface = blob(seed=seed % 7, sphere=2560)
    rng = np.random.default_rng(seed)
    vertices = rng.permutation(surface.vertex_count)[:chosen]
    place = np.full(surface.vertex_count, -1, dtype=np.int32)
    place[vertices] = np.arange(chosen)
    edges = place[surface.edges]
    edges = edges[(edges >= 0).all(axis=1)]
    part = SimpleNamespace(vertex_count=chosen, edges=edges)
    diagonal, off = dominant_blocks(part, 2, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(multifrontal, "MIN_PARALLEL_OPERATIONS", 1.0)
        factor = MultifrontalCholesky(part_dissection(surface, vertices, edges), 2, threads)
        factor.factorise(MeshMatrix(diagonal, off))
    right = rng.normal(size=(chosen, 2))
    truth = spsolve(block_matrix(part, diagonal, off), right.ravel()).reshape(right.shape)
    np.testing.assert_allclose(factor.solve(right), truth, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("threads", [1, 3])
def test_matrices_and_right_sides_may_change_place_and_number(threads):
    """What is kept from one factorisation or solve to the next does not depend on where the arrays of the last lay."""
    surface = blob(seed=5, sphere=5120)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(multifrontal, "MIN_PARALLEL_OPERATIONS", 1.0)
        factor = MultifrontalCholesky(surface_dissection(surface), 2, threads)
    rng = np.random.default_rng(0)
    kept = dominant_blocks(surface, 2, 0)
    for round in range(4):
        diagonal, off = dominant_blocks(surface, 2, round)
        if round % 2:
            kept[0][:], kept[1][:] = diagonal, off  # the same arrays as two rounds ago
            factor.factorise(MeshMatrix(*kept))
        else:
            factor.factorise(MeshMatrix(diagonal, off))
        matrix = block_matrix(surface, diagonal, off)
        for columns in (1, 3, 1):
            right = rng.normal(size=(surface.vertex_count, 2, columns))
            found = factor.solve(right)
            again = factor.solve(right)
            np.testing.assert_array_equal(found, again)
            residual = matrix @ found.reshape(-1, columns) - right.reshape(-1, columns)
            assert np.abs(residual).max() < 1e-9


@pytest.mark.parametrize("leaf", [1, 7, 48])
def test_no_edge_joins_vertices_of_fronts_on_different_branches(leaf):
    """The defining property of a dissection: of the ends of an edge, one is eliminated in a front above the other's."""
    surface = blob(seed=1, sphere=2560)
    dissection = dissect(surface.scaled_vertices, surface.edges, leaf)
    count = surface.vertex_count
    np.testing.assert_array_equal(np.sort(dissection.order), np.arange(count))
    front = np.repeat(np.arange(len(dissection.owned)), dissection.owned)[np.argsort(dissection.order)]
    ends = np.sort(front[surface.edges], axis=1)
    at, above = ends[:, 0], ends[:, 1]
    for _ in range(len(dissection.depths)):
        at = np.where(at < above, dissection.parent[at], at)
    np.testing.assert_array_equal(at, above)


def test_rows_of_a_front_are_those_that_elimination_fills():
    """Fronts have the rows of the factor that a general solver computes in the same order."""
    surface = blob(seed=2, sphere=640)
    dissection = dissect(surface.scaled_vertices, surface.edges, 8)
    diagonal, off = dominant_blocks(surface, 1, 0)
    matrix = block_matrix(surface, diagonal, off)[dissection.order][:, dissection.order].tocsc()
    lower = splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}).L.tocsc()
    for f in range(len(dissection.owned)):
        rows = dissection.rows[dissection.starts[f] : dissection.starts[f + 1]]
        filled = set()
        for column in range(dissection.first[f], dissection.first[f] + dissection.owned[f]):
            filled |= set(lower.indices[lower.indptr[column] : lower.indptr[column + 1]])
        assert filled <= set(rows.tolist())
        assert np.all(np.diff(rows) > 0)


def test_fill_grows_as_n_log_n():
    """Nested dissection of a planar mesh: entries of the factor per vertex grow by a constant when n quadruples."""
    per_vertex = []
    for frequency in (16, 32, 64):
        sphere = icosphere(frequency)
        dissection = dissect(sphere.vertices, sphere.edges)
        per_vertex.append((dissection.owned * dissection.sizes).sum() / sphere.vertex_count)
    assert per_vertex[2] - per_vertex[1] < 1.5 * (per_vertex[1] - per_vertex[0]) + 5.0
    assert per_vertex[2] < 90


def test_long_triangles_are_cut_along_and_not_across():
    """Six rings of many segments: cuts from pole to pole cross a dozen edges, cuts around cross all segments.

    Such cuts leave fronts of a few dozen vertices; with cuts around, the number of operations would grow as the cube of
    that of segments.
    """
    few, many = (uv_sphere(6, segments) for segments in (500, 2000))
    operations = []
    for surface in (few, many):
        dissection = dissect(surface.vertices, surface.edges)
        own, passed = dissection.owned.astype(float), (dissection.sizes - dissection.owned).astype(float)
        operations.append((own**3 / 3 + own**2 * passed + own * passed**2).sum())
    assert operations[1] < 4.0**1.5 * operations[0]


@pytest.mark.parametrize("divisions", [24, 80])
def test_the_number_of_threads_changes_no_bit(divisions):
    surface = icosphere(divisions)
    diagonal, off = dominant_blocks(surface, 2, 3)
    right = np.random.default_rng(0).normal(size=(surface.vertex_count, 2))
    answers = []
    for threads in (1, 2, 8):
        factor = MultifrontalCholesky(surface_dissection(surface), 2, threads)
        factor.factorise(MeshMatrix(diagonal, off))
        answers.append(factor.solve(right))
    np.testing.assert_array_equal(answers[0], answers[1])
    np.testing.assert_array_equal(answers[0], answers[2])


def test_a_factor_can_be_made_again_in_its_place():
    surface = blob(seed=4, sphere=640)
    factor = MultifrontalCholesky(surface_dissection(surface))
    right = np.ones(surface.vertex_count)
    first = dominant_blocks(surface, 1, 0)
    factor.factorise(MeshMatrix(*first))
    before = factor.solve(right)
    factor.factorise(MeshMatrix(*dominant_blocks(surface, 1, 1)))
    assert np.abs(factor.solve(right) - before).max() > 1e-6
    factor.factorise(MeshMatrix(*first))
    np.testing.assert_array_equal(factor.solve(right), before)


def test_an_indefinite_matrix_is_refused():
    surface = icosphere(5)
    diagonal, off = dominant_blocks(surface, 1, 0)
    diagonal[100] = -1.0
    with pytest.raises(NotPositiveDefinite):
        MultifrontalCholesky(surface_dissection(surface)).factorise(MeshMatrix(diagonal, off))


@settings(max_examples=8)
@given(seed=st.integers(0, 10_000), pinned=st.integers(0, 99))
def test_surface_laplacian_agrees_with_the_general_solver(seed, pinned):
    surface = blob(seed=seed, amplitude=0.4, sphere=random_sphere(300, seed))
    laplacian = cotangent_laplacian(surface.scaled_vertices, surface.faces)
    right = np.random.default_rng(seed).normal(size=(surface.vertex_count, 2))
    kept = right.copy()
    got = cotangent_solver(surface, surface.scaled_vertices, pinned).solve(right)
    truth = LaplacianSolver(laplacian, pinned).solve(right)
    np.testing.assert_allclose(got, truth, rtol=1e-9, atol=1e-9 * np.abs(truth).max())
    np.testing.assert_array_equal(right, kept)
    one = cotangent_solver(surface, surface.scaled_vertices, pinned).solve(right[:, 0])
    np.testing.assert_allclose(one, truth[:, 0], rtol=1e-9, atol=1e-9 * np.abs(truth).max())


def test_where_rounding_leaves_no_positive_pivot_the_general_solver_goes_on(monkeypatch):
    surface = blob(seed=0, sphere=640)
    right = np.random.default_rng(0).normal(size=surface.vertex_count)
    usual = cotangent_solver(surface, surface.scaled_vertices).solve(right)

    def refuse(self, matrix):
        raise NotPositiveDefinite

    monkeypatch.setattr(MultifrontalCholesky, "factorise", refuse)
    got = cotangent_solver(surface, surface.scaled_vertices).solve(right)
    np.testing.assert_allclose(got, usual, rtol=1e-9, atol=1e-11)


def test_edge_weights_are_the_entries_of_the_laplacian():
    surface = blob(seed=5, amplitude=0.4, sphere=1280)
    laplacian = cotangent_laplacian(surface.scaled_vertices, surface.faces)
    i, j = surface.edges.T
    weights = cotangent_edge_weights(surface, surface.scaled_vertices)
    np.testing.assert_allclose(-np.asarray(laplacian[i, j]).ravel(), weights, rtol=1e-12, atol=1e-13)


def test_corners_opposite_to_edges():
    surface = blob(seed=6, sphere=640)
    for edge, pair in zip(surface.edges, surface.edge_corners, strict=True):
        for corner in pair:
            face = surface.faces[corner // 3]
            others = {int(v) for k, v in enumerate(face) if k != corner % 3}
            assert others == set(edge.tolist())


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_no_front_is_overwritten_before_its_parent_has_it(threads):
    """In a job's order, no front is placed on another that its parent has not used yet."""
    surface = random_sphere(3000, 3)
    factor = MultifrontalCholesky(dissect(surface.vertices, surface.edges), block=2, threads=threads)
    d, sizes = factor.dissection, factor._sizes
    assert sorted(np.concatenate([*factor._jobs, *factor._trunk]).tolist()) == list(range(len(sizes)))
    waiting: dict[int, range] = {}
    for front in np.concatenate([*factor._jobs, *factor._trunk]).tolist():
        place = range(int(factor._offsets[front]), int(factor._offsets[front] + sizes[front] ** 2))
        assert 0 <= place.start and place.stop <= factor._length
        for other in waiting.values():
            assert place.stop <= other.start or other.stop <= place.start
        for child in np.flatnonzero(d.parent == front).tolist():
            del waiting[child]
        waiting[front] = place
    assert all(d.parent[front] < 0 for front in waiting)
    # That is the point of it: little has to be there at a time.
    assert factor._length < 0.6 * int((sizes**2).sum())


def test_postorder_keeps_branches_together():
    surface = random_sphere(1000, 1)
    d = dissect(surface.vertices, surface.edges)
    place = np.empty(len(d.parent), dtype=np.int64)
    place[d.postorder] = np.arange(len(d.parent))
    branch = {f: {f} for f in range(len(d.parent))}
    for front in np.argsort(place).tolist():
        assert sorted(place[list(branch[front])].tolist()) == list(
            range(int(place[front]) - len(branch[front]) + 1, int(place[front]) + 1)
        )
        if d.parent[front] >= 0:
            branch[int(d.parent[front])] |= branch[front]
