"""cuDSS by SciPy, for machines without a GPU: the functions of its binding that the package calls.

It reads the arrays of the fake device by their addresses, as cuDSS does, and factorises without pivoting in the order
that it is given. What is not called in the right order, or with the wrong type, is an error.
"""

from __future__ import annotations

import ctypes
from enum import IntEnum
from itertools import count
from types import SimpleNamespace

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu


def numbers_at(address: int, dtype: type, length: int) -> np.ndarray:
    """A view of memory."""
    size = np.dtype(dtype).itemsize * length
    return np.frombuffer((ctypes.c_char * size).from_address(address), dtype=dtype) if length else np.empty(0, dtype)


class FakeCudss:
    """The binding ``nvmath.bindings.cudss``; values of enumerations are those of version 1.0.

    Attributes:
        analyses, factorisations, solves: how often each phase was run.
        alive: what was created and not destroyed.
    """

    ConfigParam = IntEnum("ConfigParam", {"PIVOT_TYPE": 7, "DETERMINISTIC_MODE": 24})
    DataParam = IntEnum("DataParam", {"INERTIA": 3, "USER_PERM": 9})
    DataType = IntEnum("DataType", {"R_64F": 1, "R_32I": 10})
    IndexBase = IntEnum("IndexBase", {"ZERO": 0})
    Layout = IntEnum("Layout", {"COL_MAJOR": 0})
    MatrixType = IntEnum("MatrixType", {"SYMMETRIC": 1})
    MatrixViewType = IntEnum("MatrixViewType", {"UPPER": 2})
    Phase = IntEnum("Phase", {"ANALYSIS": 3, "FACTORIZATION": 4, "SOLVE": 1008})
    PivotType = IntEnum("PivotType", {"PIVOT_NONE": 1})

    def __init__(self) -> None:
        self.analyses = self.factorisations = self.solves = 0
        self.alive: dict[int, SimpleNamespace] = {}
        self._names = count(1)

    def _new(self, **content: object) -> int:
        name = next(self._names)
        self.alive[name] = SimpleNamespace(**content)
        return name

    def create(self) -> int:
        return self._new(kind="handle")

    def config_create(self) -> int:
        return self._new(kind="config", values={})

    def data_create(self, handle: int) -> int:
        return self._new(kind="data", order=None, lu=None, inertia=None, analysed=False)

    def set_stream(self, handle: int, stream: int) -> None:
        assert self.alive[handle].kind == "handle"

    def config_set(self, config: int, param: int, value: int, size: int) -> None:
        assert size == 4
        self.alive[config].values[int(param)] = int(numbers_at(value, np.int32, 1)[0])

    def data_set(self, handle: int, data: int, param: int, value: int, size: int) -> None:
        assert param == self.DataParam.USER_PERM
        self.alive[data].order = numbers_at(value, np.int32, size // 4).copy()

    def matrix_create_csr(self, rows, columns, entries, starts, ends, indices, values, *kinds) -> int:
        assert kinds == (10, 10, 1, 1, 2, 0) and ends == 0 and rows == columns
        return self._new(kind="matrix", size=rows, entries=entries, starts=starts, indices=indices, values=values)

    def matrix_create_dn(self, rows, columns, leading, values, kind, layout) -> int:
        assert (leading, kind, layout, columns) == (rows, 1, 0, 1)
        return self._new(kind="vectors", rows=rows, columns=columns, values=values)

    def execute(self, handle: int, phase: int, config: int, data: int, matrix: int, solution: int, right: int) -> None:
        named, state, settings = self.alive[matrix], self.alive[data], self.alive[config].values
        assert settings == {self.ConfigParam.DETERMINISTIC_MODE: 1, self.ConfigParam.PIVOT_TYPE: 1}
        if phase == self.Phase.ANALYSIS:
            assert sorted(state.order) == list(range(named.size))
            state.analysed = True
            self.analyses += 1
        elif phase == self.Phase.FACTORIZATION:
            assert state.analysed
            self._factorise(named, state)
            self.factorisations += 1
        else:
            self._solve(state, self.alive[solution], self.alive[right])
            self.solves += 1

    def _factorise(self, named: SimpleNamespace, state: SimpleNamespace) -> None:
        starts = numbers_at(named.starts, np.int32, named.size + 1)
        indices = numbers_at(named.indices, np.int32, named.entries)
        values = numbers_at(named.values, np.float64, named.entries)
        upper = sparse.csr_matrix((values, indices, starts), shape=(named.size, named.size))
        assert upper.has_canonical_format and (sparse.tril(upper, -1).nnz == 0)
        whole = (upper + sparse.triu(upper, 1).T).tocsc()[state.order][:, state.order]
        state.lu = splu(whole, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        assert np.array_equal(state.lu.perm_r, np.arange(named.size))
        pivots = state.lu.U.diagonal()
        state.inertia = [int((pivots > 0.0).sum()), int((pivots < 0.0).sum())]

    def _solve(self, state: SimpleNamespace, solution: SimpleNamespace, right: SimpleNamespace) -> None:
        given, out = (
            numbers_at(v.values, np.float64, v.rows * v.columns).reshape(v.columns, v.rows) for v in (right, solution)
        )
        for k in range(right.columns):
            out[k, state.order] = state.lu.solve(given[k, state.order])

    def data_get(self, handle: int, data: int, param: int, value: int, size: int, written: int) -> None:
        assert param == self.DataParam.INERTIA and size == 8
        numbers_at(value, np.int32, 2)[:] = self.alive[data].inertia

    def _destroy(self, name: int) -> None:
        del self.alive[name]

    matrix_destroy = config_destroy = destroy = _destroy

    def data_destroy(self, handle: int, data: int) -> None:
        assert handle in self.alive
        del self.alive[data]
