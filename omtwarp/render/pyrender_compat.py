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
process only (see :mod:`omtwarp.render.gl_client`), so that its changes affect no other code.
"""

import ctypes.util
import os
import sys
import types
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np

INSTALL_GL = "apt-get install --no-install-recommends libegl1 libgl1"
INSTALL_PYRENDER = "pip install 'omtwarp[preview]'"


class GLUnavailable(Exception):
    """No OpenGL on this machine; the text says what is missing and how to install it."""


def import_pyrender() -> types.ModuleType:
    """Import pyrender with EGL as its platform, or with the system's own OpenGL on Windows and macOS.

    Returns:
        The module.

    Raises:
        GLUnavailable: pyrender or an OpenGL library is missing.
    """
    linux = sys.platform.startswith("linux")
    if linux:
        os.environ["PYOPENGL_PLATFORM"] = "egl"  # the same path for llvmpipe and for a GPU's driver
    if not hasattr(np, "infty"):
        setattr(np, "infty", np.inf)  # noqa: B010
    viewer = types.ModuleType("pyrender.viewer")
    viewer.Viewer = type("Viewer", (), {})  # type: ignore[attr-defined]
    sys.modules.setdefault("pyrender.viewer", viewer)
    # For good: PyOpenGL looks for libraries when they are first used, EGL long after this.
    ctypes.util.find_library = partial(_find_library, ctypes.util.find_library)  # type: ignore[assignment]
    try:
        import OpenGL

        OpenGL.ERROR_LOGGING = False
        import OpenGL.GL
        from OpenGL.plugins import FormatHandler

        handler = FormatHandler.by_name("ctypesparameter")
        if handler is not None and "_ctypes.CArgObject" not in handler.check:
            handler.check.append("_ctypes.CArgObject")
        import pyrender
    except (ImportError, AttributeError, OSError) as error:
        # libEGL without libGL: 'NoneType' has no attribute 'glGetError'
        if isinstance(error, ImportError) and error.name in ("pyrender", "OpenGL"):
            raise GLUnavailable(f"pyrender is not installed ({INSTALL_PYRENDER})") from error
        missing = f"with EGL was found ({INSTALL_GL})" if linux else f"was found ({error})"
        raise GLUnavailable(f"no OpenGL library {missing}") from error
    return pyrender


def _find_library(original: Callable[[str], str | None], name: str) -> str | None:
    """Find a library as ``original`` does or, where that finds no OpenGL, by asking the loader."""
    found = original(name)
    if found is None and sys.platform.startswith("linux") and name in ("EGL", "GL"):
        with suppress(OSError):
            ctypes.CDLL(f"lib{name}.so.1")
            return f"lib{name}.so.1"
    return found
