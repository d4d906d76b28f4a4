"""The import of NumPy and SciPy by a command, at half its usual time."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

UNUSED = frozenset({"ctypeslib", "f2py", "ma", "matlib", "polynomial", "testing"})
"""Modules of NumPy that SciPy imports only as it goes through all of NumPy's names; whoever uses one imports it."""

THREADS = "OPENBLAS_NUM_THREADS"


class _Docstring(dict[str, list[str]]):
    """A function's documentation as it stands, in place of SciPy's parsed one."""

    def __init__(self, function: object):
        super().__init__(Notes=[])
        self._text = function.__doc__ or ""

    def __str__(self) -> str:
        return f"\n{self._text}"  # SciPy drops the first line, which is the signature


@contextlib.contextmanager
def _without_notes() -> Iterator[None]:
    """Let SciPy leave its functions' documentation as it is, where this version would add a note to each.

    It parses and writes the docstrings of 230 functions again to add which arrays they take: 0.1 s.
    """
    try:
        import scipy._lib._array_api as made
    except ImportError:
        yield
        return
    kept = getattr(made, "FunctionDoc", None)
    if kept is None:
        yield
        return
    made.FunctionDoc = _Docstring
    try:
        yield
    finally:
        made.FunctionDoc = kept


def import_scipy(spatial: bool = False) -> None:
    """Import NumPy and SciPy without what a command has no use for; nothing where SciPy is imported already.

    SciPy looks up every name of NumPy, which imports the modules that NumPy leaves until they are used: 0.1 s. Threads
    of OpenBLAS, which maps do not use, wait for one another while they start: 0.1 s of processor time. Docstrings are
    not written anew.

    Args:
        spatial: whether the command looks for nearest points or hulls, as textures and pictures do.
    """
    if "scipy" in sys.modules:
        return
    threads = os.environ.get(THREADS)
    os.environ.setdefault(THREADS, "1")
    try:
        import numpy as np

        exported, listed = np.__all__, np.__dir__
        try:
            np.__all__ = [name for name in exported if name not in UNUSED]
            np.__dir__ = lambda: [name for name in listed() if name not in UNUSED]  # type: ignore[method-assign, assignment]
            with _without_notes():
                import scipy.linalg
                import scipy.sparse

                if spatial:
                    import scipy.spatial  # noqa: F401
        finally:
            np.__all__, np.__dir__ = exported, listed  # type: ignore[method-assign]
    finally:
        if threads is None:
            del os.environ[THREADS]
