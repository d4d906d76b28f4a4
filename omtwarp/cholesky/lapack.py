"""The three dense eliminations of a front, in place, called by address: their wrappers would copy every block."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack


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
