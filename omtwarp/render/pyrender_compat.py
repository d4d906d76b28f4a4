"""The changes that pyrender 0.1.45, its last release, needs to run on today's Python and NumPy and without a display.

It requires PyOpenGL 3.1.0 exactly. What is changed, why, and where it was reported:

* ``np.infty``, which NumPy 2 removed and pyrender's bounding boxes use: github.com/mmatl/pyrender/issues/288.
* ``pyrender.viewer``, which imports pyglet, whose import fails without the X libraries:
  github.com/mmatl/pyrender/issues/7.
* ``ctypes.util.find_library``, by which PyOpenGL 3.1.0 asks ldconfig alone, without ``LD_LIBRARY_PATH``:
  github.com/mcfletch/pyopengl/issues/90.
* PyOpenGL's handler of pointers, which knows the type behind ``byref`` by the name it had before Python 3.12:
  github.com/mcfletch/pyopengl/issues/99.
* ``pyrender.renderer.ShaderProgramCache``, which reads pyrender's own shaders, and no argument names others:
  github.com/mmatl/pyrender/issues/39.
* ``pyrender.Texture``, of 8 bits, whose mipmaps average encoded colours, and ``pyrender.Renderer``, which reads depths
  too, at the cost of a small scene: neither has an option (github.com/mmatl/pyrender/issues/181).

Call :func:`import_pyrender` before anything else imports pyrender or OpenGL in the process. It runs in the drawing
process only (see :mod:`omtwarp.render.gl_client`), so that its changes affect no other code.
"""

from __future__ import annotations

import ctypes.util
import os
import sys
import types
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from omtwarp.colors import to_linear
from omtwarp.mesh.arrays import Bytes

if TYPE_CHECKING:
    import pyrender

INSTALL = "pip install 'omtwarp[preview]'; apt-get install --no-install-recommends libegl1 libgl1 on Debian and Ubuntu"
LIGHT_OF_SRGB = np.round(65535.0 * to_linear(np.arange(256) / 255.0)).astype(np.uint16)


def import_pyrender() -> types.ModuleType:
    """Import pyrender with EGL as its platform, or with the system's own OpenGL on Windows and macOS.

    Returns:
        The module.

    Raises:
        SystemExit: an OpenGL library is missing.
    """
    if sys.platform.startswith("linux"):
        os.environ["PYOPENGL_PLATFORM"] = "egl"  # the same path for llvmpipe and for a GPU's driver
        os.environ["EGL_PLATFORM"] = "surfaceless"  # of Mesa's display without a device
        # For good: PyOpenGL looks for libraries when they are first used, EGL long after this.
        find = ctypes.util.find_library
        ctypes.util.find_library = lambda name: f"lib{name}.so.1" if name in ("EGL", "GL") else find(name)
    setattr(np, "infty", np.inf)  # noqa: B010
    sys.modules.setdefault("pyrender.viewer", cast(types.ModuleType, types.SimpleNamespace(Viewer=object)))
    try:
        import OpenGL

        OpenGL.ERROR_LOGGING = False
        import OpenGL.GL
        from OpenGL.plugins import FormatHandler

        FormatHandler.by_name("ctypesparameter").check.append("_ctypes.CArgObject")
        import pyrender
    except (ImportError, AttributeError, OSError) as error:  # AttributeError: libEGL without libGL
        sys.exit(f"pyrender found no OpenGL library: {error} ({INSTALL})")
    shaders = str(Path(__file__).with_name("shaders"))
    pyrender.renderer.ShaderProgramCache = partial(pyrender.renderer.ShaderProgramCache, shaders)
    pyrender.Renderer._read_main_framebuffer = _read_colors
    return pyrender


def _read_colors(renderer: pyrender.Renderer, scene: object, flags: int) -> Bytes:
    """Return what was drawn, each pixel the mean of its samples."""
    from OpenGL import GL

    width, height = renderer.viewport_width, renderer.viewport_height
    GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, renderer._main_fb_ms)
    GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, renderer._main_fb)
    GL.glBlitFramebuffer(0, 0, width, height, 0, 0, width, height, GL.GL_COLOR_BUFFER_BIT, GL.GL_LINEAR)
    GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, renderer._main_fb)
    data = GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE)
    return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 4)[::-1]


def light_texture(image: Bytes, **sampler: object) -> object:
    """Return a texture of linear light rather than its sRGB encoding, so that filtering averages light.

    With 16 bits per channel nothing is lost, and a driver on the CPU need not decode every sample of the filter.

    Args:
        image: shape [height, width, 3].
        sampler: how it goes on beyond its borders.
    """
    import pyrender
    from OpenGL import GL

    class LightTexture(pyrender.Texture):  # type: ignore[misc, name-defined]
        def _add_to_context(self) -> None:
            GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
            super()._add_to_context()
            self._bind()
            size, light = image.shape[1::-1], np.ascontiguousarray(LIGHT_OF_SRGB[image[::-1]])
            GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_RGBA16, *size, 0, GL.GL_RGB, GL.GL_UNSIGNED_SHORT, light)
            GL.glGenerateMipmap(GL.GL_TEXTURE_2D)

    return LightTexture(source=image[:1, :1], source_channels="RGB", sampler=pyrender.Sampler(**sampler))
