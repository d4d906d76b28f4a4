"""Sparse Cholesky factors by dense eliminations in a tree of fronts (Duff and Reid 1983; Liu 1992).

SuperLU, which SciPy brings, treats a symmetric matrix as a general one, orders it anew for every factorisation and
works with small dense blocks. Here the order comes from the mesh, once, the work is dense Cholesky of LAPACK, and
independent fronts run on as many threads as there are cores.
"""

from __future__ import annotations

import contextlib
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import wp
from omtwarp.cholesky.dissection import Dissection
from omtwarp.cholesky.kernels import add_fronts, enter_blocks, solve_triangular
from omtwarp.cholesky.lapack import DenseEliminations
from omtwarp.threads import blas_threads, core_count, launch_parts, run_all

# Below so many operations on a depth a second thread costs more than it saves.
THREADED = 1e7
THREADED_ADDITIONS = 1e6
# Operations per thread from which on threads share a front, where there are fewer fronts than threads.
TOGETHER = 5e7


# First position in the storage, length of a column, source, whether a block enters transposed; empty without any.
Entries = tuple[wp.array, ...]


class NotPositiveDefinite(ArithmeticError):
    """A matrix has a pivot that is not positive, to round-off."""


class MultifrontalCholesky:
    """Factorises matrices with ``block`` unknowns per vertex whose pattern is the mesh's edges.

    Args:
        dissection: the order of elimination.
        block: unknowns per vertex, 1 or 2.
        keep: keep the room that fronts are eliminated in from one factorisation to the next.
        threads: shares that independent fronts are cut into; one per core by default. On large meshes, where the last
            fronts are given to several threads together, results depend on it by rounding.
    """

    def __init__(self, dissection: Dissection, block: int = 1, threads: int | None = None, keep: bool = False):
        self.dissection = dissection
        self.block = block
        self.threads = threads or core_count()
        sizes = block * dissection.sizes
        own = block * dissection.owned
        self._dense = DenseEliminations(own.astype(np.int32), sizes.astype(np.int32))
        self._factor_offsets = np.cumsum(own * sizes) - own * sizes
        self._factor = np.empty(int((own * sizes).sum()))
        # Fronts of a depth lie one after another; two depths are there at a time.
        squares = sizes * sizes
        offsets = np.empty(len(sizes), dtype=np.int64)
        lengths = []
        for depth in dissection.depths:
            ends = np.cumsum(squares[depth])
            offsets[depth] = ends - squares[depth]
            lengths.append(int(ends[-1]))
        self._offsets = offsets
        self._offset_list = offsets.tolist()
        self._factor_list = self._factor_offsets.tolist()
        self._keep = keep
        self._rooms: list[NDArray[np.float64]] = []
        self._lengths = lengths
        costs = own**3 / 3 + own**2 * (sizes - own) + own * (sizes - own) ** 2
        self._operations = float(costs.sum())
        self._additions = [float(((sizes - own)[depth] ** 2).sum()) for depth in dissection.depths]
        few = [len(costs[depth]) < self.threads for depth in dissection.depths]
        self._together = [
            one and costs[depth].sum() > TOGETHER * self.threads
            for one, depth in zip(few, dissection.depths, strict=True)
        ]
        self._chunks = [self._split(depth, costs[depth]) for depth in dissection.depths]
        self._entries()
        self._upload()

    def _split(self, depth: slice, costs: NDArray[np.float64]) -> list[range]:
        """The fronts of a depth in shares of about the same work."""
        total = float(costs.sum())
        shares = min(self.threads, len(costs)) if total > THREADED and len(costs) >= self.threads else 1
        cuts = np.searchsorted(np.cumsum(costs), total * np.arange(1, shares) / shares) + depth.start + 1
        bounds = [depth.start, *cuts.tolist(), depth.stop]
        return [range(a, b) for a, b in pairwise(bounds) if b > a]

    def _entries(self) -> None:
        """Where diagonal and edges enter, depth by depth."""
        d, block = self.dissection, self.block
        sizes = block * d.sizes
        front = np.repeat(np.arange(len(d.owned)), d.owned)  # of every place
        column = block * (np.arange(d.vertex_count) - d.first[front])
        depth_of = np.repeat(np.arange(len(d.depths)), [depth.stop - depth.start for depth in d.depths])

        def by_depth(
            front: NDArray, row: NDArray, column: NDArray, source: NDArray, turned: NDArray
        ) -> list[Entries]:
            ends = np.cumsum(np.bincount(depth_of[front], minlength=len(d.depths)))
            first = self._offsets[front] + column * sizes[front] + row
            columns = (
                (first, wp.int64),
                (sizes[front], wp.int32),
                (source, wp.int32),
                (turned, wp.uint8),
            )
            first, lengths, source, turned = (wp.array(values, dtype=dtype, device="cpu") for values, dtype in columns)
            return [
                (first[a:b], lengths[a:b], source[a:b], turned[a:b]) if b > a else ()
                for a, b in pairwise([0, *ends.tolist()])
            ]

        straight = np.zeros(d.vertex_count, dtype=bool)
        self._diagonal_entries = by_depth(front, column, column, d.order, straight)
        order = np.argsort(d.edge_front, kind="stable")
        row, column = block * d.edge_row.astype(np.int64), block * d.edge_column.astype(np.int64)
        # An edge's block has rows of its first end; where that is eliminated first it enters transposed.
        self._edge_entries = by_depth(d.edge_front[order], row[order], column[order], order, d.edge_turned[order])

    def _upload(self) -> None:
        d = self.dissection

        def keep(values: NDArray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values, dtype=dtype), device="cpu")

        self._first, self._owned = keep(d.first, np.int32), keep(d.owned, np.int32)
        self._starts, self._rows = keep(d.starts, np.int64), keep(d.rows, np.int32)
        self._upward, self._parent = keep(d.upward, np.int32), keep(d.parent, np.int32)
        self._w_offsets, self._w_factor_offsets = keep(self._offsets, np.int64), keep(self._factor_offsets, np.int64)
        self._w_factor = wp.array(self._factor, device="cpu", copy=False)
        # Siblings stand together in a depth; one thread adds them all to their parent.
        self._families, self._family_counts = [], []
        for depth in d.depths[:-1]:
            parents = d.parent[depth]
            changes = np.flatnonzero(np.r_[True, np.diff(parents) != 0, True]) + depth.start
            self._families.append(keep(changes, np.int32))
            self._family_counts.append(len(changes) - 1)
        self._largest = self.block * int(d.sizes.max())

    def factorise(self, diagonal: NDArray[np.float64], off_diagonal: NDArray[np.float64]) -> None:
        """Factorise a symmetric positive definite matrix.

        Args:
            diagonal: of every vertex, shape [V], or its block, shape [V, 2, 2].
            off_diagonal: of every edge (i, j) of the dissection, shape [E], or its block with rows of i and columns
                of j, shape [E, 2, 2].

        Raises:
            NotPositiveDefinite: it is not, to round-off.
        """
        d = self.dissection
        values = [
            wp.array(np.ascontiguousarray(array, dtype=np.float64).ravel(), device="cpu", copy=False)
            for array in (diagonal, off_diagonal)
        ]
        if not self._rooms:
            self._rooms = [np.empty(max(self._lengths[k::2], default=0)) for k in range(2)]
        # Small matrices are done before a library has been told how many threads to use.
        with blas_threads(1) if self._operations > TOGETHER else contextlib.nullcontext():
            for k in range(len(d.depths)):
                self._factorise_depth(k, values)
        if not self._keep:
            self._rooms = []

    def _factorise_depth(self, k: int, values: list[wp.array]) -> None:
        room = self._rooms[k % 2]
        room[: self._lengths[k]] = 0.0
        target = wp.array(room, device="cpu", copy=False)
        for entries, data in zip((self._diagonal_entries[k], self._edge_entries[k]), values, strict=True):
            if entries:
                count = len(entries[0])
                wp.launch(enter_blocks, dim=count, inputs=[self.block, *entries, data, target], device="cpu")
        if k > 0:
            self._add_below(k - 1)
        if self._together[k]:
            failed = max(self._share(front, room) for fronts in self._chunks[k] for front in fronts)
        else:
            failed = max(run_all(lambda fronts: self._eliminate(fronts, room), self._chunks[k]))
        if failed >= 0:
            raise NotPositiveDefinite(f"pivot of front {failed} of {len(self._dense.own)} is not positive")

    def _add_below(self, k: int) -> None:
        below, above = (wp.array(self._rooms[q % 2], device="cpu", copy=False) for q in (k, k + 1))
        families, inputs = self._families[k], [self._owned, self._starts, self._upward, self._parent, self._w_offsets]

        def arguments(part: slice) -> tuple[list[Any], list[Any]]:
            return [families[part.start : part.stop + 1], self.block, *inputs, below], [above]

        least = 2 if self._additions[k] > THREADED_ADDITIONS else self._family_counts[k] + 1
        launch_parts(add_fronts, self._family_counts[k], arguments, "cpu", least=least)

    def _share(self, front: int, room: NDArray[np.float64]) -> int:
        """Eliminate one front on all threads and keep its columns; itself if that fails, or -1."""
        failed = self._dense.run_together(front, room.ctypes.data, self._offset_list[front])
        self._store(range(front, front + 1), room)
        return failed

    def _eliminate(self, fronts: range, room: NDArray[np.float64]) -> int:
        """Eliminate fronts and keep their columns; the first that fails, or -1."""
        failed = self._dense.run(fronts, room.ctypes.data, self._offset_list)
        self._store(fronts, room)
        return failed

    def _store(self, fronts: range, room: NDArray[np.float64]) -> None:
        factor, own, sizes = self._factor, self._dense.own, self._dense.sizes
        for f in fronts:
            begin, target, length = self._offset_list[f], self._factor_list[f], own[f] * sizes[f]
            factor[target : target + length] = room[begin : begin + length]

    @property
    def storage(self) -> int:
        """Bytes of the factor and of the room that it is made in."""
        return 8 * (len(self._factor) + sum(max(self._lengths[k::2], default=0) for k in range(2)))

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides, shape [V, 2] or [V, 2, K]; [V] or [V, K] for one unknown per vertex."""
        d, block = self.dissection, self.block
        flat = np.asarray(right, dtype=np.float64).reshape(d.vertex_count, block, -1)
        count = flat.shape[2]
        x = np.ascontiguousarray(flat[d.order].transpose(2, 0, 1).reshape(-1))
        inputs = [
            block * d.vertex_count,
            self._largest,
            len(d.owned),
            block,
            self._first,
            self._owned,
            self._starts,
            self._rows,
            self._w_factor,
            self._w_factor_offsets,
            wp.empty(count * self._largest, dtype=wp.float64, device="cpu"),
            wp.array(x, dtype=wp.float64, device="cpu", copy=False),
        ]
        for upward in (0, 1):
            wp.launch(solve_triangular, dim=count, inputs=[upward, *inputs], device="cpu")
        out = np.empty_like(flat)
        out[d.order] = x.reshape(count, d.vertex_count, block).transpose(1, 2, 0)
        return out.reshape(np.shape(right))
