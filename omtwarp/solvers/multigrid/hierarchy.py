"""The levels of a multigrid method on a mesh's edges: aggregates of nodes, and the patterns of all products.

Smoothed aggregation (Vaněk, Mandel and Brezina, "Algebraic multigrid by smoothed aggregation", 1996). The levels are
made once from the weights of one matrix; the matrices of all levels then follow the values of any matrix on the same
edges, see :mod:`omtwarp.solvers.multigrid.cycle`.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.solvers.multigrid.aggregation_kernels import aggregate_nodes, colour_nodes
from omtwarp.solvers.multigrid.cycle import LevelMatrix, coarsen
from omtwarp.solvers.multigrid.levels import Level, Rows, on_device_indices

# Nodes are strongly connected where the entry between them is this share of the geometric mean of their diagonals;
# halved from level to level, as the stencils of coarse levels grow. A larger part makes smaller groups: fewer
# iterations with larger matrices. With blocks memory is the limit: 0.08 in place of 0.15 takes 250 bytes per vertex
# less, and a sixth more iterations.
STRONG = 0.15
STRONG_BLOCKS = 0.08
# Levels end where the rest is solved by a dense matrix.
COARSEST = 40
SCALAR_DAMPING = 0.66  # of the Jacobi step that smooths prolongations: 4/3 over the largest eigenvalue of D^-1 A


class MeshHierarchy:
    """Levels for symmetric matrices on the vertices and edges of a connected mesh.

    Args:
        count: number of vertices V.
        edges: every edge once, shape [E, 2].
        diagonal: of the matrix that determines the aggregates, shape [V].
        off_diagonal: its entries at the edges, shape [E].
        device: where the levels live.
        strong: the threshold of a strong connection.

    Attributes:
        levels: from the mesh to the coarsest.
        source: what every entry of the finest matrix is taken from, see ``fill_rows`` of the kernels.
    """

    def __init__(
        self,
        count: int,
        edges: NDArray[np.int32],
        diagonal: NDArray[np.float64],
        off_diagonal: NDArray[np.float64],
        device: wp.Device,
        strong: float = STRONG,
    ):
        self.device = device
        numbers, vertices = np.arange(len(edges), dtype=np.int32), np.arange(count, dtype=np.int32)
        rows = np.concatenate([vertices, edges[:, 0], edges[:, 1]])
        columns = np.concatenate([vertices, edges[:, 1], edges[:, 0]])
        # One more than the codes of fill_rows: an explicit zero might be dropped.
        codes = np.concatenate([3 * vertices, 3 * numbers + 1, 3 * numbers + 2]) + 1
        coded = sparse.coo_matrix((codes, (rows, columns)), shape=(count, count)).tocsr()
        coded.sort_indices()
        self.source = on_device_indices(coded.data - 1, device)
        matrix = _pattern(coded)
        self.levels: list[Level] = []
        level = _first_half(matrix, device)
        values = LevelMatrix(level, 1, device)
        values.fill(
            self.source,
            wp.array(np.ascontiguousarray(diagonal, dtype=np.float64), device=device),
            wp.array(np.ascontiguousarray(off_diagonal, dtype=np.float64), device=device),
        )
        threshold = strong
        while level.size > COARSEST:
            numeric = sparse.csr_matrix((values.values.numpy(), matrix.indices, matrix.indptr), shape=matrix.shape)
            groups, number = aggregate(numeric, threshold)
            level, matrix = _second_half(level, matrix, groups, number, device)
            self.levels.append(level)
            coarse = _first_half(matrix, device)
            below = LevelMatrix(coarse, 1, device)
            values.level = level
            values.invert_diagonal()
            coarsen(values, below, wp.full(level.size, 1.0, dtype=wp.float64, device=device), SCALAR_DAMPING)
            level, values = coarse, below
            threshold *= 0.5
        self.levels.append(level)

    @property
    def storage(self) -> int:
        """Bytes of all index arrays."""
        total = 4 * self.source.size
        for level in self.levels:
            patterns = [p for p in (level.pattern, level.prolongation, level.product) if p is not None]
            total += sum(4 * (p.offsets.size + 2 * p.entries) for p in patterns) + 8 * level.size
            if level.restriction is not None:
                total += 4 * (level.size + sum(a.size for a in level.restriction))
        return total


def aggregate(matrix: sparse.csr_matrix, threshold: float) -> tuple[NDArray[np.int32], int]:
    """Group the nodes of a symmetric matrix; the group of every node, shape [N], and how many there are.

    Where the strong entries alone would leave more than half as many groups as nodes, all entries count.
    """
    diagonal = np.sqrt(np.maximum(matrix.diagonal(), 0.0))
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    size = np.abs(matrix.data)
    for least in (threshold, 0.0):
        kept = (size >= least * diagonal[rows] * diagonal[matrix.indices]) & (rows != matrix.indices)
        offsets = np.zeros(matrix.shape[0] + 1, dtype=np.int32)
        np.cumsum(np.bincount(rows[kept], minlength=matrix.shape[0]), out=offsets[1:])
        groups = np.empty(matrix.shape[0], dtype=np.int32)
        number = np.empty(1, dtype=np.int32)
        inputs = [
            wp.array(offsets, dtype=wp.int32, device="cpu"),
            wp.array(matrix.indices[kept], dtype=wp.int32, device="cpu"),
            wp.array(size[kept], dtype=wp.float64, device="cpu"),
        ]
        outputs = [wp.array(a, dtype=wp.int32, device="cpu", copy=False) for a in (groups, number)]
        wp.launch(aggregate_nodes, dim=1, inputs=inputs, outputs=outputs, device="cpu")
        if 2 * int(number[0]) <= matrix.shape[0]:
            break
    return groups, int(number[0])


def colour(matrix: sparse.csr_matrix) -> list[NDArray[np.int32]]:
    """Colour the nodes so that neighbours differ; return the nodes of every colour, ascending."""
    colours = np.empty(matrix.shape[0], dtype=np.int32)
    inputs = [wp.array(a, dtype=wp.int32, device="cpu") for a in (matrix.indptr, matrix.indices)]
    out = wp.array(colours, dtype=wp.int32, device="cpu", copy=False)
    wp.launch(colour_nodes, dim=1, inputs=inputs, outputs=[out], device="cpu")
    order = np.argsort(colours, kind="stable").astype(np.int32)
    return np.split(order, np.cumsum(np.bincount(colours))[:-1])


def _first_half(matrix: sparse.csr_matrix, device: wp.Device) -> Level:
    """Make a level without its transfer to the next coarser one."""
    rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    own = np.flatnonzero(rows == matrix.indices)
    colours = [on_device_indices(nodes, device) for nodes in colour(matrix)]
    return Level(matrix.shape[0], Rows.of(matrix, device), on_device_indices(own, device), colours)


def _second_half(
    level: Level, matrix: sparse.csr_matrix, groups: NDArray[np.int32], number: int, device: wp.Device
) -> tuple[Level, sparse.csr_matrix]:
    """Complete a level by its transfer to the next coarser one, and return it and the next matrix's pattern."""
    size = level.size
    # Counts of paths: positive sums, so that no entry of a pattern can cancel.
    tentative = _ones(groups, np.arange(size + 1), (size, number))
    prolongation = _pattern(_ones(matrix.indices, matrix.indptr, matrix.shape) @ tentative)
    product = _pattern(_ones(matrix.indices, matrix.indptr, matrix.shape) @ prolongation)
    places = sparse.csr_matrix(
        (np.arange(len(prolongation.indices)), prolongation.indices, prolongation.indptr), prolongation.shape
    ).tocsc()
    coarse = _pattern(_ones(places.indices, places.indptr, (number, size)) @ product)
    joined = Level(
        size,
        level.pattern,
        level.diagonal,
        level.colours,
        on_device_indices(groups, device),
        Rows.of(prolongation, device),
        (
            on_device_indices(places.indptr, device),
            on_device_indices(places.indices, device),
            on_device_indices(places.data, device),
        ),
        Rows.of(product, device),
    )
    return joined, coarse


def _ones(indices: NDArray, offsets: NDArray, shape: tuple[int, int]) -> sparse.csr_matrix:
    return sparse.csr_matrix((np.ones(len(indices), dtype=np.float32), indices, offsets), shape)


def _pattern(matrix: sparse.csr_matrix) -> sparse.csr_matrix:
    """Return the pattern of a matrix: ones where it has entries, columns ascending."""
    matrix.sort_indices()
    return _ones(matrix.indices, matrix.indptr, matrix.shape)


__all__ = ["MeshHierarchy", "aggregate", "colour"]
