"""Factorise saddle-point matrices [A, Bᵀ; B, -C] with two coordinates per vertex and one multiplier per cell.

As :mod:`omtwarp.solvers.cholesky.saddle`, but the multipliers belong to cells, each coupled with the few vertices of
its own. Vertices and cells are dissected together, as the nodes of one graph.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.memory import Workspace
from omtwarp.solvers.cholesky.dissection import Dissection, dissect, edge_blocks, of_unknowns
from omtwarp.solvers.cholesky.multifrontal import MultifrontalCholesky, SymmetricFactor

COORDINATES = 2  # unknowns of a vertex; a cell has one


class CellSaddleFactor:
    """Factorises saddle-point matrices of one mesh and its cells; order and storage are kept for the next matrix.

    Args:
        points: positions of the vertices, by which they are ordered, shape [V, 3].
        edges: of the mesh, shape [E, 2].
        cells: the vertices of every cell, shape [N, K].
        workspace: see :class:`MultifrontalCholesky`.
        factor: makes the factorisation of the matrices of all unknowns.
    """

    def __init__(
        self,
        points: NDArray[np.float64],
        edges: NDArray[np.int32],
        cells: NDArray[np.int32],
        workspace: Workspace | None = None,
        factor: SymmetricFactor = MultifrontalCholesky,
    ):
        self._vertices, self._cells = len(points), len(cells)
        places = np.concatenate([points, points[cells].mean(axis=1)])
        numbers = self._vertices + np.repeat(np.arange(self._cells), cells.shape[1])
        joints = np.stack([cells.ravel(), numbers], axis=1)
        nodes = dissect(places, np.concatenate([edges, joints]).astype(np.int32))
        unknowns, negative = expand_nodes(nodes, self._vertices, edges, joints)
        self._factor = factor(unknowns, workspace=workspace, negative=negative)
        sizes = np.cumsum([4 * len(edges), COORDINATES * len(joints), self._vertices])
        self._couplings = np.empty(sizes[-1])
        self._blocks = self._couplings[: sizes[0]].reshape(-1, 2, 2)
        self._gradients = self._couplings[sizes[0] : sizes[1]].reshape(*cells.shape, COORDINATES)
        self._inner = self._couplings[sizes[1] :]
        self._diagonal = np.empty(COORDINATES * self._vertices + self._cells)

    def factorise(
        self,
        diagonal: NDArray[np.float64],
        off_diagonal: NDArray[np.float64],
        gradients: NDArray[np.float64],
        compliance: NDArray[np.float64],
    ) -> None:
        """Factorise one matrix.

        Args:
            diagonal: A's blocks of the vertices, shape [V, 2, 2].
            off_diagonal: A's blocks of the edges (i, j), rows of i, columns of j, shape [E, 2, 2].
            gradients: B's entries: of every cell by the coordinates of its vertices, shape [N, K, 2].
            compliance: C's diagonal, positive, shape [N].

        Raises:
            NotPositiveDefinite: A is not positive definite, to round-off.
        """
        own = self._diagonal[: COORDINATES * self._vertices].reshape(-1, COORDINATES)
        own[:, 0], own[:, 1] = diagonal[:, 0, 0], diagonal[:, 1, 1]
        np.negative(compliance, out=self._diagonal[COORDINATES * self._vertices :])
        self._inner[:] = diagonal[:, 0, 1]
        self._blocks[:] = off_diagonal
        self._gradients[:] = gradients
        self._factor.factorise(self._diagonal, self._couplings)

    def solve(
        self, first: NDArray[np.float64], second: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Solve [A, Bᵀ; B, -C] [u; q] = [first; second]: coordinates u, shape [V, 2], and multipliers q, shape [N]."""
        solved = self._factor.solve(np.concatenate([first.ravel(), second.ravel()]))
        split = COORDINATES * self._vertices
        return solved[:split].reshape(-1, COORDINATES).copy(), solved[split:].copy()


def expand_nodes(
    d: Dissection, vertices: int, edges: NDArray[np.int32], joints: NDArray[np.int64]
) -> tuple[Dissection, NDArray[np.int32]]:
    """Order the unknowns of vertices and cells as their nodes are ordered.

    Unknowns 2 v and 2 v + 1 are those of vertex v, 2 V + c that of cell c. Couplings are numbered as
    :class:`CellSaddleFactor` has them: four for each edge's block, two for each vertex of each cell, and one for each
    vertex between its coordinates.

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
        is_cell,
        begin + COORDINATES * (d.owned - own_cells)[front_of] + cell_rank,
        begin + COORDINATES * vertex_rank,
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


__all__ = ["CellSaddleFactor"]
