"""The changes that pyrender 0.1.45, its last release, needs to run on today's Python and NumPy and without a display.

It requires PyOpenGL 3.1.0 exactly. What is changed, why, and where it was reported:

* ``np.infty``, which NumPy 2 removed and pyrender's bounding boxes use: github.com/mmatl/pyrender/issues/288.
* ``pyrender.viewer``, which imports pyglet, whose import fails without the X libraries:
  github.com/mmatl/pyrender/issues/7.
* ``ctypes.util.find_library``, by which PyOpenGL 3.1.0 asks ldconfig alone, without ``LD_LIBRARY_PATH``:
  github.com/mcfletch/pyopengl/issues/90.
* PyOpenGL's handler of pointers, which knows the type behind ``byref`` by the name it had before Python 3.12:
  github.com/mcfletch/pyopengl/issues/99.

Call :func:`import_pyrender` before anything else imports pyrender or OpenGL in the process. It runs in the drawing
process only (see :mod:`omtwarp.render.drawing_process`), so that its changes affect no other code.
"""

from __future__ import annotations

import ctypes.util
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
    viewer = types.ModuleType("pyrender.viewer")
    viewer.Viewer = type("Viewer", (), {})  # type: ignore[attr-defined]
    sys.modules.setdefault("pyrender.viewer", viewer)
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
