"""Drawing with pyrender, offscreen through EGL: on a GPU where there is one, with Mesa's llvmpipe on the CPU elsewhere.

Everything here runs in the drawing process. It imports pyrender, so import it only there, after
:func:`omtwarp.render.pyrender_compat.import_pyrender`.
"""

import os
import sys
from contextlib import suppress

import numpy as np
from PIL import Image

from omtwarp.colors import parse_color
from omtwarp.mesh.arrays import Bytes
from omtwarp.render.camera import Light, Shot
from omtwarp.render.pyrender_compat import INSTALL, import_pyrender, light_texture
from omtwarp.render.scene import Part, RenderJob

pyrender = import_pyrender()

from OpenGL import GL  # noqa: E402
from pyrender.platforms.base import Platform  # noqa: E402


class GLRenderer:
    """One OpenGL context and its renderer, for many jobs.

    Raises:
        SystemExit: no device gives a context.
    """

    def __init__(self) -> None:
        self._platform = _open_context()
        self._renderer = pyrender.Renderer(64, 64)
        self.device = (GL.glGetString(GL.GL_RENDERER) or b"unknown").decode(errors="replace")

    def draw(self, job: RenderJob) -> list[Bytes]:
        """Draw every shot.

        Returns:
            One picture per shot, uint8 [height, width, 4], colours multiplied by their coverage.
        """
        self._platform.make_current()
        # Of the supersampled picture: each pixel takes 40 bytes with its multisample buffers. Larger pictures are drawn
        # with the hardware's four samples alone.
        affordable = int((40_000_000 / (job.width * job.height)) ** 0.5)
        largest = int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE)) // max(job.width, job.height)
        samples = max(1, min(job.samples, affordable, largest))
        self._renderer.viewport_width, self._renderer.viewport_height = job.width * samples, job.height * samples
        light = Light() if job.light.unlit else job.light  # the colours themselves
        surroundings = [light.sky, light.ground, job.wireframe.width * samples]
        textures: dict[tuple, object] = {}  # parts of a film share theirs
        meshes = [_mesh(part, job, textures) for part in job.parts]
        pictures = []
        for k, shot in enumerate(job.shots):
            scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 0.0], ambient_light=surroundings)
            for mesh in meshes[k : k + 1] if job.one_each else meshes:
                scene.add(mesh)
            for way, power in light.unit_directions():
                scene.add_node(pyrender.Node(light=pyrender.PointLight(intensity=power), translation=way))
            scene.add(_camera(shot, job.width / job.height), pose=shot.pose)
            pixels = self._renderer.render(scene, pyrender.RenderFlags.OFFSCREEN | pyrender.RenderFlags.RGBA)
            pictures.append(_averaged(pixels, samples))
        return pictures


def _mesh(part: Part, job: RenderJob, textures: dict[tuple, object]) -> object:
    key = (id(part.image), part.repeat, part.repeat_rows)
    if part.image is not None and key not in textures:
        height, width = np.minimum(part.image.shape[:2], GL.glGetIntegerv(GL.GL_MAX_TEXTURE_SIZE)).tolist()
        fitted = Image.fromarray(part.image).resize((width, height), Image.Resampling.BOX)
        right, up = (GL.GL_REPEAT if on else GL.GL_CLAMP_TO_EDGE for on in (part.repeat, part.repeat_rows))
        textures[key] = light_texture(np.asarray(fitted), wrapS=right, wrapT=up)
    material = pyrender.MetallicRoughnessMaterial(
        baseColorTexture=textures.get(key),
        baseColorFactor=[*part.tint, job.wireframe.opacity],
        emissiveFactor=parse_color(job.wireframe.color),
        metallicFactor=float(part.mipmaps),
        roughnessFactor=float(job.light.roughness),
        doubleSided=True,
    )
    primitive = pyrender.Primitive(
        positions=part.positions,
        normals=part.normals,
        texcoord_0=part.value[:, :2] if part.kind == "uv" else None,
        texcoord_1=part.value[:, :2] if part.edges else None,
        color_0=part.value,
        indices=None if part.edges else part.faces,
        material=material,
    )
    return pyrender.Mesh([primitive])


def _averaged(pixels: Bytes, side: int) -> Bytes:
    """Average blocks of ``side`` x ``side`` pixels."""
    height, width = pixels.shape[:2]
    # Not as RGBA: Pillow would take the colours as unmultiplied and weight them by their coverage again.
    picture = Image.frombuffer("RGBX", (width, height), np.ascontiguousarray(pixels).tobytes(), "raw", "RGBX", 0, 1)
    return np.asarray(picture.reduce(side) if side > 1 else picture)


def _camera(shot: Shot, aspect: float) -> object:
    if shot.perspective:
        opening = 2.0 * np.arctan(shot.half_height)
        return pyrender.PerspectiveCamera(yfov=float(opening), znear=shot.near, zfar=shot.far, aspectRatio=aspect)
    return pyrender.OrthographicCamera(xmag=shot.half_width, ymag=shot.half_height, znear=shot.near, zfar=shot.far)


def _open_context() -> Platform:
    """Open an OpenGL context on the first device that provides one.

    Device 0 may be a graphics card the user may not open, so each is tried; ``EGL_DEVICE_ID`` goes first.
    """
    if sys.platform.startswith("linux"):
        from pyrender.platforms import egl

        devices = []
        with suppress(Exception):
            devices = egl.query_devices()
        wanted = [device for k, device in enumerate(devices) if str(k) == os.environ.get("EGL_DEVICE_ID")]
        # At last Mesa without a device, where none is listed or usable.
        platforms = [egl.EGLPlatform(64, 64, device) for device in (*wanted, *devices, egl.EGLDevice())]
    else:
        from pyrender.platforms.pyglet_platform import PygletPlatform

        platforms = [PygletPlatform(64, 64)]
    reason = "no OpenGL version reported"
    for platform in platforms:
        try:
            platform.init_context()
            if GL.glGetString(GL.GL_VERSION):
                return platform
        except Exception as error:
            reason = f"{type(error).__name__}: {error}".splitlines()[0]
    sys.exit(f"no device gives an OpenGL context: {reason} ({INSTALL})")
