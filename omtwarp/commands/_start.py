"""The import of NumPy and SciPy by a command, at half its usual time."""

from __future__ import annotations

import os
import sys

UNUSED = frozenset({"ctypeslib", "f2py", "ma", "matlib", "polynomial", "testing"})
"""Modules of NumPy that SciPy imports only as it goes through all of NumPy's names; whoever uses one imports it."""

THREADS = "OPENBLAS_NUM_THREADS"


def import_scipy(spatial: bool = False) -> None:
    """Import NumPy and SciPy without what a command has no use for; nothing where SciPy is imported already.

    SciPy looks up every name of NumPy, which imports the modules that NumPy leaves until they are used: 0.1 s. Threads
    of OpenBLAS, which maps do not use, wait for one another while they start: 0.1 s of processor time.

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
            import scipy.linalg
            import scipy.sparse

            if spatial:
                import scipy.spatial  # noqa: F401
        finally:
            np.__all__, np.__dir__ = exported, listed  # type: ignore[method-assign]
    finally:
        if threads is None:
            del os.environ[THREADS]
