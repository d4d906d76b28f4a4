"""The three dense eliminations of a front, in place, called by address: their wrappers would copy every block."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

from omtwarp.threads import run_all

PANEL = 192  # columns eliminated at once where threads share a front
STRIP = 256  # columns of what is left that one of them updates at a time


def _function(module: Any, name: str, arguments: int) -> Any:
    """A routine that SciPy offers to compiled code; calling it lets other threads run."""
    capsule = module.__pyx_capi__[name]
    get_name = ctypes.pythonapi.PyCapsule_GetName
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    get_pointer.restype, get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = get_name(capsule)
    if b"int *" not in signature:  # a build with another integer
        raise ImportError(f"unknown signature of {name}")
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(get_pointer(capsule, signature))


class DenseEliminations:
    """Eliminates the first columns of symmetric matrices stored by columns (lower triangles).

    Args:
        own: columns to eliminate of every front, int32, shape [N].
        sizes: rows of every front, int32, shape [N].
    """

    def __init__(self, own: NDArray[np.int32], sizes: NDArray[np.int32]):
        self._potrf = _function(cython_lapack, "dpotrf", 5)
        self._trsm = _function(cython_blas, "dtrsm", 11)
        self._syrk = _function(cython_blas, "dsyrk", 10)
        self._gemm = _function(cython_blas, "dgemm", 13)
        self.own = own.tolist()
        self.sizes = sizes.tolist()
        self._numbers = np.ascontiguousarray(np.stack([own, sizes, sizes - own], axis=1), dtype=np.int32)
        self._ones = np.array([1.0, -1.0])
        self._letters = np.frombuffer(b"LRTN", dtype=np.uint8).copy()

    def run(self, fronts: range, address: int, offsets: list[int]) -> int:
        """Factorise the first block of fronts and update their rest.

        Args:
            fronts: which.
            address: of the storage that holds them.
            offsets: where in it every front begins, in numbers.

        Returns:
            The first front that is not positive definite, or -1.
        """
        potrf, trsm, syrk = self._potrf, self._trsm, self._syrk
        lower = self._letters.ctypes.data
        right, transposed, plain = lower + 1, lower + 2, lower + 3
        one = self._ones.ctypes.data
        minus = one + 8
        numbers = self._numbers.ctypes.data
        status = ctypes.c_int(0)
        info = ctypes.addressof(status)
        for f in fronts:
            own, size = self.own[f], self.sizes[f]
            if own == 0:
                continue
            n_own = numbers + 12 * f
            n_size, n_rest = n_own + 4, n_own + 8
            corner = address + 8 * offsets[f]
            potrf(lower, n_own, corner, n_size, info)
            if status.value != 0:
                return f
            if size > own:
                side = corner + 8 * own
                trsm(right, lower, transposed, plain, n_rest, n_own, one, corner, n_size, side, n_size)
                rest = side + 8 * own * size
                syrk(lower, plain, n_rest, n_own, minus, side, n_size, one, rest, n_size)
        return -1

    def run_together(self, front: int, address: int, offset: int) -> int:
        """The same for one large front, all threads sharing it; its result differs by rounding.

        Returns:
            The front if it is not positive definite, or -1.
        """
        own, size = self.own[front], self.sizes[front]
        corner = address + 8 * offset
        lower = self._letters.ctypes.data
        right, transposed, plain = lower + 1, lower + 2, lower + 3
        one = self._ones.ctypes.data
        minus = one + 8

        def at(row: int, column: int) -> int:
            return corner + 8 * (row + column * size)

        def numbers(*values: int) -> tuple[NDArray[np.int32], list[int]]:
            room = np.array([*values, size], dtype=np.int32)
            return room, [room.ctypes.data + 4 * k for k in range(len(room))]

        for first in range(0, own, PANEL):
            last = min(first + PANEL, own)
            status = ctypes.c_int(0)
            width, (n_width, n_size) = numbers(last - first)
            self._potrf(lower, n_width, at(first, first), n_size, ctypes.addressof(status))
            if status.value != 0:
                return front

            def scale(rows: range, first: int = first, last: int = last) -> None:
                kept, (n_rows, n_columns, n_lead) = numbers(len(rows), last - first)
                self._trsm(
                    right, lower, transposed, plain, n_rows, n_columns, one,
                    at(first, first), n_lead, at(rows.start, first), n_lead,
                )  # fmt: skip
                del kept

            def update(columns: range, first: int = first, last: int = last) -> None:
                below = size - columns.stop
                kept, (n_columns, n_inner, n_below, n_lead) = numbers(len(columns), last - first, below)
                panel, own_block = at(columns.start, first), at(columns.start, columns.start)
                self._syrk(lower, plain, n_columns, n_inner, minus, panel, n_lead, one, own_block, n_lead)
                if below:
                    self._gemm(
                        plain, transposed, n_below, n_columns, n_inner, minus, at(columns.stop, first), n_lead,
                        panel, n_lead, one, at(columns.stop, columns.start), n_lead,
                    )  # fmt: skip
                del kept

            del width
            strips = [range(k, min(k + STRIP, size)) for k in range(last, size, STRIP)]
            run_all(scale, strips)
            run_all(update, strips)
        return -1
