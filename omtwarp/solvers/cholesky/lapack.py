"""LAPACK and BLAS by address: kernels call them from compiled code, and wrappers would copy every block."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

from omtwarp.device.threads import run_all

PANEL = 192  # columns eliminated at once where threads share a front
STRIP = 256  # columns of the remaining matrix that one of them updates at a time

LETTERS = np.frombuffer(b"LRTN", dtype=np.uint8).copy()
ONES = np.array([1.0, -1.0])  # the factors that routines of BLAS take by address


@lru_cache
def routine(name: str) -> int:
    """Return the address of a routine that SciPy offers to compiled code: ``dpotrf``, or one of BLAS."""
    capsule = (cython_lapack if name == "dpotrf" else cython_blas).__pyx_capi__[name]
    get_name = ctypes.pythonapi.PyCapsule_GetName
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    get_pointer.restype, get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = get_name(capsule)
    if b"int *" not in signature:  # a build with another integer
        raise ImportError(f"unknown signature of {name}")
    return int(get_pointer(capsule, signature))


@lru_cache
def _callable(name: str, arguments: int) -> Callable[..., None]:
    """Make a routine callable from Python; other threads run meanwhile."""
    return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(routine(name))


def eliminate_together(own: int, size: int, corner: int, negative: int = 0) -> bool:
    """Eliminate the first columns of one large symmetric matrix on all threads; rounding depends on their number.

    Args:
        own: columns to eliminate.
        size: its rows.
        corner: address of its first number; its lower triangle is stored by columns.
        negative: how many of the columns to eliminate, the last ones, have negative pivots.

    Returns:
        Whether all pivots have the sign that they should have.
    """
    potrf, trsm = _callable("dpotrf", 5), _callable("dtrsm", 11)
    syrk, gemm = _callable("dsyrk", 10), _callable("dgemm", 13)
    lower = LETTERS.ctypes.data
    right, transposed, plain = lower + 1, lower + 2, lower + 3
    one = ONES.ctypes.data
    minus = one + 8

    def at(row: int, column: int) -> int:
        return corner + 8 * (row + column * size)

    def numbers(*values: int) -> tuple[NDArray[np.int32], list[int]]:
        workspace = np.array([*values, size], dtype=np.int32)
        return workspace, [workspace.ctypes.data + 4 * k for k in range(len(workspace))]

    panels = [(k, min(k + PANEL, own - negative)) for k in range(0, own - negative, PANEL)]
    panels += [(k, min(k + PANEL, own)) for k in range(own - negative, own, PANEL)]
    for first, last in panels:
        positive = first < own - negative
        if first == own - negative:
            _turn_sign(own, size, corner, negative)
        status = ctypes.c_int(0)
        width, (n_width, n_size) = numbers(last - first)
        potrf(lower, n_width, at(first, first), n_size, ctypes.addressof(status))
        if status.value != 0:
            return False

        def scale(rows: range, first: int = first, last: int = last) -> None:
            kept, (n_rows, n_columns, n_lead) = numbers(len(rows), last - first)
            trsm(
                right, lower, transposed, plain, n_rows, n_columns, one,
                at(first, first), n_lead, at(rows.start, first), n_lead,
            )  # fmt: skip
            del kept

        def update(columns: range, first: int = first, last: int = last, positive: bool = positive) -> None:
            below = size - columns.stop
            kept, (n_columns, n_inner, n_below, n_lead) = numbers(len(columns), last - first, below)
            panel, own_block = at(columns.start, first), at(columns.start, columns.start)
            # Later columns with negative pivots have had their sign changed already.
            factor = minus if positive or columns.start < own else one
            syrk(lower, plain, n_columns, n_inner, factor, panel, n_lead, one, own_block, n_lead)
            if below:
                gemm(
                    plain, transposed, n_below, n_columns, n_inner, factor, at(columns.stop, first), n_lead,
                    panel, n_lead, one, at(columns.stop, columns.start), n_lead,
                )  # fmt: skip
            del kept

        del width
        bounds = [(last, size)] if positive else [(last, own), (own, size)]
        strips = [range(k, min(k + STRIP, end)) for begin, end in bounds for k in range(begin, end, STRIP)]
        run_all(scale, strips)
        run_all(update, strips)
    return True


def _turn_sign(own: int, size: int, corner: int, count: int) -> None:
    """Multiply the last of the columns to eliminate by -1, from the diagonal down."""
    numbers = (ctypes.c_double * (size * own)).from_address(corner)
    columns = np.ctypeslib.as_array(numbers).reshape(own, size)
    columns[own - count :, own - count :] *= -1.0
