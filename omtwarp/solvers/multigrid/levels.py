"""The index arrays of one level of a multigrid method, and how it is joined to the next coarser one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from omtwarp.device.start import wp


@dataclass(frozen=True)
class Rows:
    """Compressed rows of a sparse matrix's pattern, on the device.

    Attributes:
        offsets: int32, shape [N + 1].
        columns: of every entry, ascending in a row, int32.
        rows: of every entry, int32.
        entries: how many.
    """

    offsets: wp.array
    columns: wp.array
    rows: wp.array
    entries: int

    @classmethod
    def of(cls, matrix: sparse.csr_matrix, device: wp.Device) -> Rows:
        rows = np.repeat(np.arange(matrix.shape[0], dtype=np.int32), np.diff(matrix.indptr))
        offsets, columns = on_device_indices(matrix.indptr, device), on_device_indices(matrix.indices, device)
        return cls(offsets, columns, on_device_indices(rows, device), len(rows))


@dataclass(frozen=True)
class Level:
    """One level, and how it is joined to the next coarser one.

    Attributes:
        size: number of nodes N.
        pattern: of the level's matrix.
        diagonal: position of every row's diagonal entry, int32, shape [N].
        colours: nodes of one colour each, int32; no two of a colour are neighbours.
        aggregates: the coarse node of every node, int32, shape [N]; None on the coarsest level.
        prolongation: pattern of P.
        restriction: the columns of P: offsets by coarse node, the fine node and the place in P of every entry.
        product: pattern of A P.
    """

    size: int
    pattern: Rows
    diagonal: wp.array
    colours: list[wp.array]
    aggregates: wp.array | None = None
    prolongation: Rows | None = None
    restriction: tuple[wp.array, wp.array, wp.array] | None = None
    product: Rows | None = None


def on_device_indices(values: NDArray, device: wp.Device) -> wp.array:
    """Copy whole numbers to a device as int32."""
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=device)


__all__ = ["Level", "Rows", "on_device_indices"]
