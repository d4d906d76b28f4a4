"""The member for GPUs gives what the host's gives: on a fake device, with cuDSS by SciPy."""

import gc
import inspect
import sys
from enum import EnumType
from itertools import pairwise

import numpy as np
import pytest
from fake_cudss import FakeCudss

import omtwarp
from omtwarp.device.policy import solving_with
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import blob, icosphere
from omtwarp.options import Solver
from omtwarp.solvers import cudss
from omtwarp.solvers.cholesky.saddle import SaddleMatrix
from omtwarp.solvers.factor import MeshMatrix, NotPositiveDefinite
from omtwarp.solvers.mesh_factor import cell_saddle_factor, solve_parts, surface_factor, surface_saddle_factor

SURFACE = blob(seed=4, amplitude=0.3, sphere=500)


def definite(rng, block):
    """Blocks of a random matrix whose diagonal dominates, in the form of a factorisation's arguments."""
    count, edges = SURFACE.vertex_count, len(SURFACE.edges)
    off = rng.normal(size=(edges, block, block))
    own = rng.normal(size=(count, block, block))
    own = own + own.transpose(0, 2, 1) + 40.0 * np.eye(block)
    return (own.ravel(), off.ravel()) if block == 1 else (own, off)


@pytest.mark.parametrize("block", [1, 2])
@pytest.mark.parametrize("columns", [0, 1, 3])
def test_definite_matrices(library, block, columns):
    """One analysis serves all matrices of a pattern; several right-hand sides are solved one after another."""
    rng = np.random.default_rng(block)
    shape = (SURFACE.vertex_count,) + ((block,) if block > 1 else ()) + ((columns,) if columns else ())
    host = surface_factor(SURFACE, block)
    with solving_with(Solver.CUDSS):
        there = surface_factor(SURFACE, block)
    for _ in range(2):
        matrix, right = definite(rng, block), rng.normal(size=shape)
        host.factorise(MeshMatrix(*matrix))
        there.factorise(MeshMatrix(*matrix))
        np.testing.assert_allclose(there.solve(right), host.solve(right), rtol=0.0, atol=1e-13)
    assert (library.analyses, library.factorisations, library.solves) == (1, 2, 2 * max(columns, 1))


def saddle_arguments(rng, gradients, multipliers):
    own, off = definite(rng, 2)
    return own, off, rng.normal(size=gradients), rng.uniform(0.1, 1.0, size=multipliers)


def test_saddle_point_matrices(library):
    rng = np.random.default_rng(0)
    count, edges = SURFACE.vertex_count, len(SURFACE.edges)
    matrix = saddle_arguments(rng, (2, edges, 2), count)
    right = rng.normal(size=(count, 2)), rng.normal(size=count)
    host = surface_saddle_factor(SURFACE)
    with solving_with(Solver.CUDSS):
        there = surface_saddle_factor(SURFACE)
    for factor in (host, there):
        factor.factorise(SaddleMatrix.of(*matrix))
    for one, other in zip(*(solve_parts(factor, *right) for factor in (host, there)), strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-12)


def test_saddle_point_matrices_of_cells(library):
    rng = np.random.default_rng(1)
    cells = SURFACE.faces
    matrix = saddle_arguments(rng, (*cells.shape, 2), len(cells))
    right = rng.normal(size=(SURFACE.vertex_count, 2)), rng.normal(size=len(cells))
    host = cell_saddle_factor(SURFACE.scaled_vertices, SURFACE.edges, cells)
    with solving_with(Solver.CUDSS):
        there = cell_saddle_factor(SURFACE.scaled_vertices, SURFACE.edges, cells)
    for factor in (host, there):
        factor.factorise(SaddleMatrix.of(*matrix))
    for one, other in zip(*(solve_parts(factor, *right) for factor in (host, there)), strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-12)


def test_pivots_of_the_wrong_sign_are_seen(library):
    with solving_with(Solver.CUDSS):
        factor, saddle = surface_factor(SURFACE), surface_saddle_factor(SURFACE)
    rng = np.random.default_rng(0)
    diagonal, off = definite(rng, 1)
    diagonal[7] = -30.0
    with pytest.raises(NotPositiveDefinite, match="1 negative, in place of"):
        factor.factorise(MeshMatrix(diagonal, off))
    own, off, gradients, compliance = saddle_arguments(rng, (2, len(SURFACE.edges), 2), SURFACE.vertex_count)
    own[3] = -60.0 * np.eye(2)
    with pytest.raises(NotPositiveDefinite):
        saddle.factorise(SaddleMatrix.of(own, off, 1e-3 * gradients, compliance))


def test_what_the_library_holds_is_freed(library):
    with solving_with(Solver.CUDSS):
        factor = surface_factor(SURFACE)
    factor.factorise(MeshMatrix(*definite(np.random.default_rng(0), 1)))
    factor.solve(np.ones(SURFACE.vertex_count))
    assert library.alive
    del factor
    gc.collect()
    assert not library.alive


@pytest.mark.filterwarnings("ignore::omtwarp.OmtwarpWarning")
@pytest.mark.parametrize("options", [{}, {"refine": "balanced"}, {"exact": True}])
def test_whole_maps(library, options):
    """The map is that of the host's solver, and repeats to the bit."""
    host = omtwarp.map_to_sphere(SURFACE, **options)
    one, two = (omtwarp.map_to_sphere(SURFACE, device="cuda:0", solver="cudss", **options) for _ in range(2))
    np.testing.assert_allclose(one.sphere, host.sphere, rtol=0.0, atol=1e-10)
    np.testing.assert_array_equal(one.sphere, two.sphere)
    assert library.factorisations > library.analyses
    assert one.report["solver"] == "cudss"


def test_upper_entries_by_hand():
    """A triangle with two unknowns at a vertex: 6 unknowns, 9 entries of vertices and 12 of edges."""
    edges = np.array([[0, 1], [2, 1], [0, 2]], dtype=np.int32)
    offsets, columns, source = cudss.upper_entries(3, edges, 2)
    flat = np.arange(24.0)
    own, off = flat[:12].reshape(3, 2, 2), flat[12:].reshape(3, 2, 2)
    whole = np.zeros((6, 6))
    for v in range(3):
        whole[2 * v : 2 * v + 2, 2 * v : 2 * v + 2] = np.triu(own[v])
    for (i, j), block in zip(edges, off, strict=True):
        i, j, block = (i, j, block) if i < j else (j, i, block.T)
        whole[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] = block
    found = np.zeros((6, 6))
    for row in range(6):
        for k in range(offsets[row], offsets[row + 1]):
            found[row, columns[k]] = flat[source[k]]
    np.testing.assert_array_equal(found, whole)
    assert len(source) == 21 and all((np.diff(columns[a:b]) > 0).all() for a, b in pairwise(offsets))


def test_what_is_missing_is_said_in_one_line(fake, monkeypatch):
    with pytest.raises(OmtwarpError, match=r"^the solver cudss runs on a GPU: use device='cuda', or another solver$"):
        omtwarp.map_to_sphere(icosphere(3), solver="cudss")
    monkeypatch.setitem(sys.modules, "nvmath.bindings", None)
    with pytest.raises(OmtwarpError, match=r"pip install 'omtwarp\[cuda\]'$"):
        cudss.load_library()


def test_a_library_that_does_not_start_is_an_error(library, monkeypatch):
    def create():
        raise RuntimeError("no libcublas")

    monkeypatch.setattr(library, "create", create)
    with solving_with(Solver.CUDSS), pytest.raises(OmtwarpError, match="cuDSS does not start: no libcublas"):
        surface_factor(SURFACE)


def test_the_stand_in_has_the_binding_s_values_and_arguments():
    """Where NVIDIA's binding is installed, with or without a GPU."""
    binding = pytest.importorskip("nvmath.bindings.cudss")
    kinds = [kind for kind in vars(FakeCudss).values() if isinstance(kind, EnumType)]
    assert len(kinds) == 9
    for kind in kinds:
        for member in kind:
            assert getattr(binding, kind.__name__)[member.name] == member
    for name in ("execute", "matrix_create_csr", "matrix_create_dn", "data_get", "data_set", "config_set"):
        arguments = getattr(binding, name).__doc__.partition("(")[2].partition(")")[0].count(",") + 1
        called = inspect.signature(getattr(FakeCudss, name)).parameters
        assert any(p.kind is p.VAR_POSITIONAL for p in called.values()) or len(called) - 1 == arguments, name
