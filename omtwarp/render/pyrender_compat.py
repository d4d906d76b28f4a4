"""Changes to pyrender 0.1.45 at run time, which needs them on today's Python, NumPy and PyOpenGL without a display.

Call :func:`import_pyrender` before anything else imports pyrender or OpenGL in the process. It runs in the drawing
process only (see :mod:`omtwarp.render.drawing_process`), so that its changes affect no other code.
"""

from __future__ import annotations

import ctypes.util
import importlib
import importlib.util
import os
import sys
import types
from collections.abc import Callable

import numpy as np

from omtwarp.render.installing import INSTALL_GL, INSTALL_PYRENDER


class GLUnavailable(Exception):
    """No OpenGL on this machine; the text says what is missing and how to install it."""


def import_pyrender() -> types.ModuleType:
    """Import pyrender with EGL as its platform, or with the system's own OpenGL on Windows and macOS.

    Returns:
        The module.

    Raises:
        GLUnavailable: pyrender or an OpenGL library is missing.
    """
    if sys.platform.startswith("linux"):
        os.environ["PYOPENGL_PLATFORM"] = "egl"  # the same path for llvmpipe and for a GPU's driver
    _restore_numpy_name()
    # pyrender's viewer pulls in pyglet, which needs X libraries just to be imported; nothing here opens a window.
    viewer = types.ModuleType("pyrender.viewer")
    viewer.Viewer = type("Viewer", (), {})  # type: ignore[attr-defined]
    sys.modules.setdefault("pyrender.viewer", viewer)
    _hollow_trimesh()
    _hollow_networkx()
    # For good: PyOpenGL looks for libraries when they are first used, EGL long after this.
    ctypes.util.find_library = _find_library(ctypes.util.find_library)  # type: ignore[assignment]
    try:
        import OpenGL

        OpenGL.ERROR_LOGGING = False
        import OpenGL.GL

        _teach_array_handler()
        import pyrender
    except ImportError as error:
        if error.name in ("pyrender", "OpenGL"):
            raise GLUnavailable(f"pyrender is not installed ({INSTALL_PYRENDER})") from error
        raise GLUnavailable(_missing(error)) from error
    except (AttributeError, OSError) as error:  # libEGL without libGL: 'NoneType' has no attribute 'glGetError'
        raise GLUnavailable(_missing(error)) from error
    return pyrender


def _missing(error: Exception) -> str:
    if sys.platform.startswith("linux"):
        return f"no OpenGL library with EGL was found ({INSTALL_GL})"
    return f"no OpenGL library was found ({error})"


def _hollow_trimesh() -> None:
    """Give pyrender a trimesh without its ``__init__``, which takes longer to import than everything else together.

    Of trimesh pyrender needs the submodule ``transformations`` and, in functions not called here, the class names.
    """
    spec = importlib.util.find_spec("trimesh")
    if "trimesh" in sys.modules or spec is None or spec.submodule_search_locations is None:
        return
    hollow = types.ModuleType("trimesh")
    hollow.__path__ = list(spec.submodule_search_locations)
    sys.modules["trimesh"] = hollow
    try:
        importlib.import_module("trimesh.transformations")
    except Exception:  # a release in which the submodule leans on the package
        for name in [name for name in sys.modules if name.split(".")[0] == "trimesh"]:
            del sys.modules[name]


class _Graph:
    """The part of ``networkx.DiGraph`` that a pyrender scene uses: each node leads to at most one other."""

    def __init__(self) -> None:
        self._next: dict[object, list[object]] = {}

    def add_node(self, node: object) -> None:
        self._next.setdefault(node, [])

    def add_edge(self, node: object, following: object) -> None:
        self.add_node(node)
        self.add_node(following)
        self._next[node] = [following]

    def path(self, node: object, target: object) -> list[object]:
        """Return the nodes from one to another, both included."""
        nodes = [node]
        while nodes[-1] != target:
            nodes += self._next[nodes[-1]]
        return nodes


def _hollow_networkx() -> None:
    """Give pyrender a graph in the place of networkx, whose import takes half of the drawing process's start."""
    hollow = types.ModuleType("networkx")
    hollow.DiGraph = _Graph  # type: ignore[attr-defined]
    hollow.shortest_path = _Graph.path  # type: ignore[attr-defined]
    sys.modules.setdefault("networkx", hollow)


def _restore_numpy_name() -> None:
    """Restore ``np.infty``, which pyrender's bounding boxes use and NumPy 2 removed."""
    if not hasattr(np, "infty"):
        setattr(np, "infty", np.inf)  # noqa: B010


def _find_library(original: Callable[[str], str | None]) -> Callable[[str], str | None]:
    """Return a search that also tries the loader: PyOpenGL 3.1.0 asks ldconfig alone, without LD_LIBRARY_PATH."""

    def find(name: str) -> str | None:
        found: str | None = original(name)
        if found is None and sys.platform.startswith("linux") and name in ("EGL", "GL"):
            candidate = f"lib{name}.so.1"
            try:
                ctypes.CDLL(candidate)
            except OSError:
                return None
            return candidate
        return found

    return find


def _teach_array_handler() -> None:
    """Register the type behind ``byref``, which Python 3.12 renamed and PyOpenGL 3.1.0 knows by name only."""
    from OpenGL.plugins import FormatHandler

    handler = FormatHandler.by_name("ctypesparameter")
    if handler is not None and "_ctypes.CArgObject" not in handler.check:
        handler.check.append("_ctypes.CArgObject")
