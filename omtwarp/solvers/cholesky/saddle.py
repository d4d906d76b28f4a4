"""Saddle-point matrices [A, Bᵀ; B, -C] on a mesh: their numbers on a device, and the order of their elimination.

With A and C positive definite the matrix is quasi-definite: it has a factorisation L S Lᵀ, S diagonal with entries 1
and -1, in every symmetric order of elimination, without pivoting [1]. The order is the mesh's nested dissection; inside
a front the coordinates come before the multipliers, whose pivots then are Schur complements. Unknowns and couplings are
numbered as :class:`SaddleMatrix` has them.

References:
    [1] R. J. Vanderbei, "Symmetric quasi-definite matrices", SIAM Journal on Optimization 5(1), 1995.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty
from omtwarp.device.start import wp
from omtwarp.mesh.arrays import Floats
from omtwarp.solvers.cholesky.dissection import Dissection, dissect

COORDINATES = 2  # unknowns of a vertex


class SaddleMatrix:
    """The entries of one matrix on a mesh, written in parts.

    Args:
        vertices: V, of the mesh.
        edges: E.
        multipliers: N; none for a matrix of the coordinates alone.
        slopes: number of entries of B.
        device: a Warp device.

    Attributes:
        entries: all of them, float64; what follows are parts of it.
        diagonal: of A, shape [2 V].
        compliance: the diagonal of -C, shape [N].
        off_diagonal: A's blocks of the edges (i, j), rows of i, columns of j, shape [E, 4].
        slopes: B's entries. Of multipliers of vertices: of every edge, row i by the coordinates of j, then of every
            edge, row j by those of i. Of cells: of every cell by the coordinates of its vertices.
        inner: A's entries between the two coordinates of a vertex, shape [V].
    """

    def __init__(self, vertices: int, edges: int, multipliers: int, slopes: int, device: wp.Device):
        self.vertices, self.multipliers = vertices, multipliers
        sizes = [COORDINATES * vertices, multipliers, 4 * edges, slopes, vertices]
        ends = np.cumsum([0, *sizes]).tolist()
        self.entries = empty(ends[-1], wp.float64, device)
        none = wp.empty(0, dtype=wp.float64, device=device)
        parts = [self.entries[a:b] if b > a else none for a, b in pairwise(ends)]
        self.diagonal, self.compliance, off_diagonal, self.slopes, self.inner = parts
        self.off_diagonal = off_diagonal.reshape((edges, 4))
        self._ends = ends
        self.points: wp.array | None = None

    @classmethod
    def of(cls, own: Floats, others: Floats, slopes: Floats, compliance: Floats) -> SaddleMatrix:
        """Return a matrix on the host.

        Args:
            own: A's blocks of the vertices, shape [V, 2, 2].
            others: A's blocks of the edges, shape [E, 2, 2].
            slopes: B's entries in any shape.
            compliance: C's diagonal, shape [N].
        """
        matrix = cls(len(own), len(others), len(compliance), slopes.size, wp.get_device("cpu"))
        numbers = [own[:, [0, 1], [0, 1]], -compliance, others, slopes, own[:, 0, 1]]
        np.concatenate([part.ravel() for part in numbers], out=matrix.entries.numpy())
        return matrix

    def on_host(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return the numbers that :meth:`of` takes; of B flat."""
        diagonal, compliance, others, slopes, inner = np.split(self.entries.numpy(), self._ends[1:-1])
        own = np.empty((self.vertices, 2, 2))
        own[:, [0, 1], [0, 1]] = diagonal.reshape(-1, 2)
        own[:, 0, 1] = own[:, 1, 0] = inner
        return own, others.reshape(-1, 2, 2), slopes, -compliance


UNKNOWNS = 3  # of a vertex that has a multiplier of its own


def expand(d: Dissection, each: int = UNKNOWNS) -> tuple[Dissection, NDArray[np.int32]]:
    """Return the order of elimination of the unknowns of vertices.

    Args:
        d: of the vertices.
        each: unknowns of a vertex, 3 with a multiplier for each or 2 without.

    Returns:
        The dissection of the unknowns, and how many of those that a front eliminates are multipliers, shape [fronts].
    """
    return _expand_nodes(d, *(np.full(d.vertex_count, most, np.int8) for most in (COORDINATES, each - COORDINATES)))


def expand_with_cells(
    points: Floats, edges: NDArray[np.int32], cells: NDArray[np.int32]
) -> tuple[Dissection, NDArray[np.int32]]:
    """Return the order of elimination of the coordinates of vertices and of one multiplier for every cell.

    Vertices and cells are dissected together, as the nodes of one graph, a cell coupled with the vertices of its own.

    Args:
        points: positions of the vertices, by which they are ordered, shape [V, 3].
        edges: of the mesh, shape [E, 2].
        cells: the vertices of every cell, shape [N, K].

    Returns:
        As :func:`expand`.
    """
    numbers = len(points) + np.repeat(np.arange(len(cells)), cells.shape[1])
    joints = np.stack([cells.ravel(), numbers], axis=1)
    places = np.concatenate([points, points[cells].mean(axis=1)])
    nodes = dissect(places, np.concatenate([edges, joints]).astype(np.int32))
    is_cell = (np.arange(len(places)) >= len(points)).astype(np.int8)
    return _expand_nodes(nodes, COORDINATES * (1 - is_cell), is_cell)


def _expand_nodes(
    d: Dissection, coordinates: NDArray[np.int8], multipliers: NDArray[np.int8]
) -> tuple[Dissection, NDArray[np.int32]]:
    """Order the unknowns of the nodes of a graph as the nodes are ordered, with the same fronts.

    Args:
        d: of the nodes.
        coordinates: how many every node has, 2 or none, shape [nodes].
        multipliers: how many it has, 1 or none, shape [nodes].

    Returns:
        The dissection of the unknowns, and how many of those that a front eliminates are multipliers, shape [fronts].
        Among the unknowns that a front eliminates the coordinates come first.
    """
    nodes, fronts, kinds = d.vertex_count, np.arange(len(d.owned)), (coordinates, multipliers)
    ends = np.append(d.first, nodes)
    of_place, of_row, in_row = np.repeat(fronts, d.owned), np.repeat(fronts, d.sizes), d.order[d.rows]
    # Of each kind the first unknown of every node, its place, and where it is among the rows of all fronts. These rows
    # are in groups that one front eliminates, each with the coordinates first.
    changes = np.diff(of_place[d.rows], prepend=-1, append=-1) != 0
    changes[d.starts] = True
    unknowns, _ = _lay_out([(counts, [0, nodes]) for counts in kinds])
    places, first = _lay_out([(counts[d.order], ends) for counts in kinds])
    at, groups = _lay_out([(counts[in_row], np.flatnonzero(changes)) for counts in kinds])
    starts = np.append(at[0][d.starts[:-1]], groups[-1])
    inside = np.array(at) - starts[of_row].astype(np.int32)

    # The row of the parent is any where the front eliminates the row itself.
    order, above = np.empty(first[-1], dtype=np.int64), d.starts[d.parent[of_row]] + d.upward
    rows, upward = (np.empty(starts[-1], dtype=np.int32) for _ in range(2))
    for kind, counts in enumerate(kinds):
        which = np.arange(COORDINATES - kind, dtype=np.int32)[:, None]
        k = _chosen(counts[d.order])
        order[places[kind][k] + which] = unknowns[kind][d.order[k]] + which
        k = _chosen(counts[in_row])
        rows[at[kind][k] + which] = places[kind][d.rows[k]] + which
        upward[at[kind][k] + which] = np.where(d.upward[k] >= 0, inside[kind][above[k]] + which, np.int32(-1))

    # Couplings in the order of their numbers, and of every front: the kind of the first unknown, the second being a
    # coordinate; the nodes of both, in the order of the edges; their rows, in the order of entering; and which of the
    # unknowns of their nodes they are.
    (i, j), own = np.ascontiguousarray(d.edges.T, dtype=np.intp), np.arange(nodes)
    begin = d.starts[np.repeat(fronts, np.diff(d.edge_starts))]
    row_i, row_j = (begin + np.where(d.edge_turned == turned, d.edge_row, d.edge_column) for turned in (False, True))
    own_row = d.starts[of_place] + own - d.first[of_place]
    couplings = [
        (0, i, j, row_i, row_j, [(0, 0), (0, 1), (1, 0), (1, 1)]),
        (1, i, j, row_i, row_j, [(0, 0), (0, 1)]),
        (1, j, i, row_j, row_i, [(0, 0), (0, 1)]),
        (0, own, own, own_row, own_row, [(0, 1)]),
    ]
    many = [np.minimum(kinds[kind][a] * coordinates[b], len(pairs)) for kind, a, b, *_, pairs in couplings]
    numbers, (_, total) = _lay_out([(counts, [0, len(counts)]) for counts in many])
    entered = [(d.entering, d.edge_starts)] * 3 + [(d.order, ends)]
    into, edge_starts = _lay_out([(counts[k], bounds) for counts, (k, bounds) in zip(many, entered, strict=True)])
    entering, edge_row, edge_column = (np.empty(total, dtype=np.int32) for _ in range(3))
    edges = rest = np.empty((total, 2), dtype=np.int32)
    for n, (kind, one, other, row, column, pairs) in enumerate(couplings):
        k = _chosen(many[n])
        x, y = unknowns[kind][one[k]], unknowns[0][other[k]]
        part, rest = np.split(rest, [many[n].sum()])
        np.stack([end for a, b in pairs for end in (x + a, y + b)], axis=1, out=part.reshape(-1, 2 * len(pairs)))
        enters, _ = entered[n]
        k = _chosen(many[n][enters])
        to, number = into[n][k].astype(np.intp), numbers[n][enters[k]]
        x, y = inside[kind][row[k]], inside[0][column[k]]
        for step, (a, b) in enumerate(pairs):
            entering[step:][to] = number + step
            p, q = x + a, y + b
            edge_row[step:][to], edge_column[step:][to] = np.maximum(p, q), np.minimum(p, q)
    expanded = replace(
        d,
        order=order,
        first=first[:-1],
        owned=np.diff(first),
        starts=starts,
        rows=rows,
        upward=upward,
        entering=entering,
        edge_starts=edge_starts.astype(np.int32),
        edge_row=edge_row,
        edge_column=edge_column,
        edge_turned=np.zeros(total, dtype=np.bool_),
        edges=edges,
    )
    return expanded, np.bincount(of_place, multipliers[d.order], len(fronts)).astype(np.int32)


def _lay_out(
    kinds: list[tuple[NDArray[np.integer], NDArray[np.integer] | list[int]]],
) -> tuple[list[NDArray[np.int32]], NDArray[np.int64]]:
    """Return where entries are that stand group by group, and in every group kind by kind.

    Args:
        kinds: of every kind, how many entries each of its items has, shape [items], and where the items of every group
            begin, and the end, shape [groups + 1].

    Returns:
        Of every kind, where the entries of each item begin, shape [items] each; and where groups begin, and the end,
        shape [groups + 1].
    """
    before = [np.append(np.int32(0), np.cumsum(counts, dtype=np.int32)) for counts, _ in kinds]
    begins = np.array([entries[bounds] for entries, (_, bounds) in zip(before, kinds, strict=True)])
    at, ahead = [], begins[:, :-1].sum(axis=0, dtype=np.int32)
    for entries, begin, (_, bounds) in zip(before, begins, kinds, strict=True):
        at.append(entries[:-1] + np.repeat(ahead - begin[:-1], np.diff(bounds)))
        ahead += np.diff(begin)
    return at, begins.sum(axis=0, dtype=np.int64)


def _chosen(counts: NDArray[np.int8]) -> slice | NDArray[np.intp]:
    """Return which items have entries, without a list where all have."""
    return slice(None) if counts.all() else np.flatnonzero(counts)
