"""Memory on the host: room that steps of a computation share, and giving back what is no longer used."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Room:
    """Memory for what is made and used up before the next step needs room; it is as large as the largest of these."""

    def __init__(self) -> None:
        self._numbers: NDArray[np.float64] = np.empty(0)

    def numbers(self, count: int) -> NDArray[np.float64]:
        """So many float64, of any value; they are the first ones of every other call."""
        if len(self._numbers) < count:
            self._numbers = np.empty(0)  # first: both would be there for a moment
            self._numbers = np.empty(count)
        return self._numbers[:count]


def give_back() -> None:
    """Return to the system what was freed and what the C library keeps for later, where it can be told to.

    A stage leaves holes in which the arrays of the next one do not fit: on meshes of some ten thousand triangles, more
    than what a map is made of.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@lru_cache(maxsize=1)
def _trim() -> Any:
    """``malloc_trim`` of the GNU C library, or None."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):
            return ctypes.CDLL("libc.so.6").malloc_trim
    return None


__all__ = ["Room", "give_back"]
