"""The start of a command: NumPy, SciPy and Warp imported without what no command uses, in half the usual time."""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import importlib.util
import os
import sys
import threading
from collections.abc import Iterator
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import CodeType, ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

UNUSED = frozenset({"ctypeslib", "f2py", "ma", "matlib", "polynomial", "testing"})
"""Modules of NumPy that SciPy imports only as it goes through all of NumPy's names; whoever uses one imports it."""

THREADS = "OPENBLAS_NUM_THREADS"
BUILT_INS = "warp._src.builtins"
PARTS = {
    "scipy.linalg": ("cython_blas", "cython_lapack"),
    "scipy.sparse.linalg": (),
    "scipy.sparse.csgraph": ("_traversal", "_min_spanning_tree", "_shortest_path"),
    "scipy.spatial": ("_ckdtree", "_qhull"),
}
"""Packages of SciPy, and those of their modules that hold all that most commands use of them."""
_OF_IMPORTS = ("__wrapped__", "__warningregistry__")  # names that Python itself asks modules for, which have none
LIBRARIES = ("warp.so", "warp-clang.so")
"""Warp's libraries on Linux, where reading them takes longest: the first has code for all graphics cards in it."""


def import_scipy() -> None:
    """Import NumPy and SciPy without what a command has no use for; nothing where SciPy is imported already.

    SciPy looks up every name of NumPy, which imports the modules that NumPy leaves until they are used: 0.1 s. It reads
    and rewrites the documentation of its functions: 0.05 s. Threads of OpenBLAS, which maps do not use, wait for one
    another while they start: 0.1 s of processor time. Its packages import all of themselves where a module or two are
    used: 0.06 s. NumPy asks its module of masked arrays whether an array is one, and none is before that is imported.
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
            with _documentation_as_written():
                import scipy.sparse  # noqa: F401

                for name, parts in PARTS.items():
                    _load_by_name(name, parts)
                importlib.import_module("scipy.linalg.cython_blas")  # starts OpenBLAS, while it may have one thread
            if "numpy.ma" not in sys.modules:
                np.ma = _MaskedArrays("numpy.ma")
        finally:
            np.__all__, np.__dir__ = exported, listed  # type: ignore[method-assign]
    finally:
        if threads is None:
            del os.environ[THREADS]


class _MaskedArrays(ModuleType):
    """Stands for NumPy's module of masked arrays until something else of it is used than the question for one."""

    @staticmethod
    def is_masked(array: object) -> bool:
        """Return whether an array has masked entries."""
        real = sys.modules.get("numpy.ma")
        return real is not None and bool(real.is_masked(array))

    @staticmethod
    def isMaskedArray(array: object) -> bool:
        """Return whether an array is one of NumPy's masked arrays."""
        real = sys.modules.get("numpy.ma")
        return real is not None and bool(real.isMaskedArray(array))

    def __getattr__(self, name: str) -> object:
        return getattr(importlib.import_module("numpy.ma"), name)


def _load_by_name(name: str, parts: tuple[str, ...]) -> None:
    """Put a module in the place of a package that loads some of its modules, or all of it, when asked for a name.

    Args:
        name: of the package.
        parts: names of its modules that are loaded alone where what is asked for is one of them, or in one of them.
    """
    spec = importlib.util.find_spec(name)
    if name in sys.modules or spec is None or spec.loader is None or not spec.submodule_search_locations:
        return
    module, run = importlib.util.module_from_spec(spec), spec.loader.exec_module

    def look_up(attribute: str) -> object:
        for part in () if attribute.startswith("__") else parts:
            found = importlib.import_module(f"{name}.{part}")
            if attribute == part:
                return found
            if not attribute.startswith("_") and hasattr(found, attribute):
                return getattr(found, attribute)
        if attribute in _OF_IMPORTS:
            raise AttributeError(attribute)
        del module.__getattr__  # type: ignore[attr-defined]
        run(module)
        return getattr(module, attribute)

    module.__getattr__ = look_up  # type: ignore[method-assign]
    sys.modules[name] = module
    parent, _, own = name.rpartition(".")
    setattr(sys.modules[parent], own, module)


@contextlib.contextmanager
def _documentation_as_written() -> Iterator[None]:
    """Keep SciPy from adding notes to the documentation of its functions while it is imported in a block."""
    try:
        from scipy._lib import _array_api as notes

        real = notes.xp_capabilities
    except (ImportError, AttributeError):  # another version of SciPy
        yield
        return
    notes.xp_capabilities = lambda **_: lambda function: function
    try:
        yield
    finally:
        notes.xp_capabilities = real


def prepare_warp() -> None:
    """Make the import of Warp faster, for a process that runs a command and nothing else.

    Warp lists its built-in functions for every combination of types that code outside of kernels could call them with:
    two thirds of the list, and 0.1 s. No command calls them so, and kernels do not use these versions. The libraries
    are read from disk on another core in the meantime.
    """
    if "warp" in sys.modules:
        return
    sys.meta_path.insert(0, _BuiltIns)
    if sys.platform == "linux":
        threading.Thread(target=_load_libraries, daemon=True).start()


class _BuiltIns:
    """Finds Warp's module of built-in functions, once, and makes it leave out the versions for use outside kernels."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the module's usual spec, with a loader that shortens the list; None for every other module."""
        if name != BUILT_INS:
            return None
        sys.meta_path.remove(_BuiltIns)
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            load = spec.loader.exec_module
            spec.loader.exec_module = lambda module: _load_short(load, module)  # type: ignore[method-assign]
        return spec


def _load_short(load: Callable[[ModuleType], None], module: ModuleType) -> None:
    from warp._src import context

    add = context.add_builtin
    code: CodeType | None = getattr(add, "__code__", None)
    if code is None or "constraint" not in code.co_varnames:  # another version of Warp
        load(module)
        return

    def add_once(*arguments: object, **options: object) -> None:
        add(*arguments, **{**options, "constraint": _is_never_met})

    context.add_builtin = add_once
    try:
        load(module)
    finally:
        context.add_builtin = add


def _is_never_met(types: object) -> bool:
    """Tell Warp that no combination of types is possible for a function called outside of kernels."""
    return False


def _load_libraries() -> None:
    """Load Warp's libraries, so that its own import finds them in memory.

    Only a function called through ctypes lets other threads run meanwhile: hence the C library's own ``dlopen``.
    """
    with contextlib.suppress(Exception):  # Warp itself says what is wrong
        spec = importlib.util.find_spec("warp")
        assert spec is not None and spec.origin is not None
        load = ctypes.CDLL(None).dlopen
        load.argtypes, load.restype = (ctypes.c_char_p, ctypes.c_int), ctypes.c_void_p
        for name in LIBRARIES:
            load(os.fsencode(Path(spec.origin).parent / "bin" / name), os.RTLD_NOW)
