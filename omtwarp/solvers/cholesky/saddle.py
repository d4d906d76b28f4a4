"""Saddle-point matrices [A, Bᵀ; B, -C] on a mesh: their numbers on a device, and the order of their elimination.

With A and C positive definite the matrix is quasi-definite: it has a factorisation L S Lᵀ, S diagonal with entries 1
and -1, in every symmetric order of elimination, without pivoting [1]. The order is the mesh's nested dissection; inside
a front the coordinates come before the multipliers, whose pivots then are Schur complements. Unknowns and couplings are
numbered as :class:`SaddleMatrix` has them.

References:
    [1] R. J. Vanderbei, "Symmetric quasi-definite matrices", SIAM Journal on Optimization 5(1), 1995.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty
from omtwarp.device.start import wp
from omtwarp.mesh.arrays import Floats
from omtwarp.solvers.cholesky.dissection import Dissection, dissect, edge_blocks, of_unknowns

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
    count, total = d.vertex_count, each * d.vertex_count
    fronts, multipliers = len(d.owned), each - COORDINATES
    front_of = np.repeat(np.arange(fronts), d.owned)  # of every place of a vertex
    begin, inside = each * d.first[front_of], np.arange(count) - d.first[front_of]
    own: NDArray[np.int64] = np.arange(count, dtype=np.int64)
    # Places of a vertex's unknowns, by its own place, and the unknowns.
    places = [begin + 2 * inside, begin + 2 * inside + 1, begin + 2 * d.owned[front_of] + inside][:each]
    unknowns = [2 * d.order, 2 * d.order + 1, 2 * count + d.order][:each]
    of_vertices = np.stack(places, axis=1)
    order = np.empty(total, dtype=np.int64)
    order[of_vertices] = np.stack(unknowns, axis=1)
    of_row = np.repeat(np.arange(fronts), each * np.diff(d.starts))
    i, j = (d.edges[:, k].astype(np.int64) for k in range(2))
    ends = [(i, j), (j, i)][: 2 * multipliers]
    slopes = [np.stack([np.stack([2 * count + p, 2 * q + b], axis=1) for b in range(2)], axis=1) for p, q in ends]
    inner = np.stack([2 * own, 2 * own + 1], axis=1)
    couplings = [edge_blocks(d.edges, COORDINATES), *(part.reshape(-1, 2) for part in slopes), inner]
    row_keys = of_row * total + of_vertices[d.rows].ravel()
    expanded = of_unknowns(d, order, each * d.first, each * d.owned, row_keys, np.concatenate(couplings))
    return expanded, (multipliers * d.owned).astype(np.int32)


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
    return _expand_nodes(nodes, len(points), edges, joints)


def _expand_nodes(
    d: Dissection, vertices: int, edges: NDArray[np.int32], joints: NDArray[np.int64]
) -> tuple[Dissection, NDArray[np.int32]]:
    """Order the unknowns of vertices and cells as their nodes are ordered.

    Args:
        d: of the nodes, the first ``vertices`` of which are vertices and the others cells.
        vertices: V.
        edges: of the mesh, shape [E, 2].
        joints: vertex and cell, as nodes, of every coupling between them, shape [J, 2].

    Returns:
        The dissection of the unknowns, and how many of those that a front eliminates are multipliers, shape [fronts].
        Inside a front the coordinates come first.
    """
    nodes, fronts = d.vertex_count, len(d.owned)
    total = COORDINATES * vertices + (nodes - vertices)
    front_of = np.repeat(np.arange(fronts), d.owned)  # of every place of a node
    is_cell = d.order >= vertices
    own_cells = np.bincount(front_of[is_cell], minlength=fronts)
    owned = COORDINATES * (d.owned - own_cells) + own_cells
    first = np.cumsum(owned) - owned
    # Rank of a node among those of its kind in its front.
    cells_before: NDArray[np.int64] = np.cumsum(is_cell) - is_cell
    cell_rank: NDArray[np.int64] = cells_before - cells_before[d.first[front_of]]
    vertex_rank = np.arange(nodes) - d.first[front_of] - cell_rank
    begin = first[front_of]
    place = np.where(
        is_cell, begin + COORDINATES * (d.owned - own_cells)[front_of] + cell_rank, begin + COORDINATES * vertex_rank
    )  # of the first unknown of the node in every place
    unknown = np.where(is_cell, vertices + d.order, COORDINATES * d.order)  # 2 V + c = V + node
    count = np.where(is_cell, 1, COORDINATES)

    order = np.empty(total, dtype=np.int64)
    order[place] = unknown
    order[place[~is_cell] + 1] = unknown[~is_cell] + 1

    of_node_row = np.repeat(np.arange(fronts), np.diff(d.starts))
    copies = count[d.rows]
    of_row = np.repeat(of_node_row, copies)
    within = np.arange(len(of_row)) - np.repeat(np.cumsum(copies) - copies, copies)
    row_keys = of_row * total + np.repeat(place[d.rows], copies) + within

    v, c = COORDINATES * joints[:, 0].astype(np.int64), vertices + joints[:, 1].astype(np.int64)
    gradients = np.stack([np.stack([c, v + b], axis=1) for b in range(2)], axis=1)
    own = COORDINATES * np.arange(vertices, dtype=np.int64)
    inner = np.stack([own, own + 1], axis=1)
    couplings = np.concatenate([edge_blocks(edges, COORDINATES), gradients.reshape(-1, 2), inner])
    expanded = of_unknowns(d, order, first, owned, row_keys, couplings)
    return expanded, own_cells.astype(np.int32)
