"""Memory on the host: a workspace that steps of a computation share, and the return of freed memory to the system."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray


class Workspace:
    """An array that steps of a computation use in turn; it grows to the largest number of elements requested.

    Its contents are valid until the next step uses it.
    """

    def __init__(self) -> None:
        self._numbers: NDArray[np.float64] = np.empty(0)

    def numbers(self, count: int) -> NDArray[np.float64]:
        """Return an uninitialised float64 array, shape [count], in the same memory at every call."""
        if len(self._numbers) < count:
            self._numbers = np.empty(0)  # free the old array first: otherwise both exist for a moment
            self._numbers = np.empty(count)
        return self._numbers[:count]


def give_back() -> None:
    """Return freed memory from the C library to the system, where the library can (glibc).

    The arrays of a stage do not fit into the gaps that the stage before leaves: on meshes of some ten thousand
    triangles these gaps take more memory than the map itself.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@lru_cache(maxsize=1)
def _trim() -> Callable[[int], int] | None:
    """Return ``malloc_trim`` of the GNU C library, or None."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):
            trim: Callable[[int], int] = ctypes.CDLL("libc.so.6").malloc_trim
            return trim
    return None
