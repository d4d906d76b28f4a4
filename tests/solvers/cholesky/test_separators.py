"""Least separators against all sets of vertices that separate, and against the cuts that they begin with."""

from itertools import combinations

import numpy as np
import pytest
import scipy.sparse as sparse
from hypothesis import given, strategies as st
from scipy.sparse.csgraph import connected_components

from omtwarp.mesh.shapes import blob, limbs
from omtwarp.solvers.cholesky import dissect, dissection
from omtwarp.solvers.cholesky.dissection import least_separators


def strip(rng: np.random.Generator, columns: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges of a random graph on a grid, none longer than one column, and the column of every vertex."""
    column = np.repeat(np.arange(columns), rows)
    pairs = np.array(list(combinations(range(columns * rows), 2)))
    pairs = pairs[np.abs(np.diff(column[pairs], axis=1))[:, 0] <= 1]
    return pairs[rng.random(len(pairs)) < 0.5], column


def separate(edges: np.ndarray, removed: np.ndarray, first: np.ndarray, second: np.ndarray) -> bool:
    """Whether no path leads from the first side to the second past the vertices removed."""
    kept = edges[~removed[edges].any(axis=1)]
    graph = sparse.coo_matrix((np.ones(len(kept)), kept.T), shape=(len(removed),) * 2)
    label = connected_components(graph, directed=False)[1]
    return not np.intersect1d(label[first & ~removed], label[second & ~removed]).size


@given(seed=st.integers(0, 10_000), rows=st.integers(1, 3))
def test_no_smaller_set_of_the_band_separates(seed, rows):
    """The number of vertices is the least of all subsets of the band, tried one by one."""
    edges, column = strip(np.random.default_rng(seed), 6, rows)
    band, second = (column >= 1) & (column <= 4), column > 2
    found, beyond = least_separators(edges, band, second)
    first_side, second_side = column == 0, column == 5
    assert not (found & ~band).any() and not (beyond & (found | first_side)).any() and beyond[second_side].all()
    sides = np.where(beyond, 1, -1) * ~found
    assert (sides[edges].prod(axis=1) >= 0).all()  # no edge leads across
    assert separate(edges, found, first_side, second_side)
    for fewer in combinations(np.flatnonzero(band), int(found.sum()) - 1) if found.any() else ():
        removed = np.zeros(len(column), dtype=bool)
        removed[list(fewer)] = True
        assert not separate(edges, removed, first_side, second_side)


def test_a_graph_that_nothing_joins_needs_no_separator():
    """Without a band and without edges the sides stay as they are."""
    second = np.array([False, True, True])
    found, beyond = least_separators(np.zeros((0, 2), dtype=np.int64), np.zeros(3, dtype=bool), second)
    assert not found.any() and (beyond == second).all()


@pytest.mark.parametrize("surface", [blob(seed=2, sphere=5120), limbs()])
def test_fewer_operations_than_with_straight_cuts(monkeypatch, surface):
    """Elimination takes no more operations, and any two halves are still separate."""

    def operations() -> float:
        order = dissect(surface.scaled_vertices, surface.edges)
        front = np.repeat(np.arange(len(order.owned)), order.owned)[np.argsort(order.order)]
        low, high = np.sort(front[surface.edges], axis=1).T
        while (low < high).any():  # the fronts of the ends of an edge lie on one branch
            low = np.where(low < high, order.parent[low], low)
        assert (low == high).all()
        own, size = order.owned.astype(float), order.sizes.astype(float)
        return float((own**3 / 3 + own**2 * (size - own) + own * (size - own) ** 2).sum())

    refined = operations()
    monkeypatch.setattr(dissection, "MIN_REFINED", 10**9)
    assert refined < operations()
