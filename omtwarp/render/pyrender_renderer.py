"""Drawing with pyrender, offscreen through EGL: on a GPU where there is one, with Mesa's llvmpipe on the CPU elsewhere.

Everything here runs in the drawing process. It imports pyrender, so import it only there, after
:func:`omtwarp.render.pyrender_compat.import_pyrender`.
"""

import os
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
from PIL import Image

from omtwarp.colors import parse_color, to_linear
from omtwarp.mesh.arrays import Bytes
from omtwarp.render.camera import Shot
from omtwarp.render.pyrender_compat import INSTALL_GL, GLUnavailable, import_pyrender
from omtwarp.render.scene import Part, RenderJob

pyrender = import_pyrender()

from OpenGL import GL  # noqa: E402
from pyrender.platforms.base import Platform  # noqa: E402
from pyrender.shader_program import ShaderProgram, ShaderProgramCache  # noqa: E402

LIGHT_OF_SRGB = np.round(65535.0 * to_linear(np.arange(256) / 255.0)).astype(np.uint16)


class _Programs(ShaderProgramCache):  # type: ignore[misc]
    """Programs from the shaders beside this file, all with the ``defines`` and ``uniforms`` of the job in hand."""

    def __init__(self) -> None:
        super().__init__(str(Path(__file__).with_name("shaders")))
        self.defines: dict[str, int] = {}
        self.uniforms: dict[str, object] = {}

    def get_program(self, defines: dict[str, int], **shaders: str | None) -> ShaderProgram:
        program = super().get_program(defines=defines | self.defines, **shaders)
        if not program._in_context():
            program._add_to_context()
        program._bind()
        for name, value in self.uniforms.items():
            program.set_uniform(name, value)
        return program


class _Renderer(pyrender.Renderer):  # type: ignore[misc, name-defined]
    """pyrender's renderer without the depth image, whose read-back and conversion cost as much as a small scene."""

    def _read_main_framebuffer(self, scene: object, flags: int) -> Bytes:
        width, height = self._main_fb_dims
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb)
        GL.glBlitFramebuffer(0, 0, width, height, 0, 0, width, height, GL.GL_COLOR_BUFFER_BIT, GL.GL_LINEAR)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb)
        GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
        data = GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE)
        return np.frombuffer(data, dtype=np.uint8).reshape(height, width, 4)[::-1]


class _Texture(pyrender.Texture):  # type: ignore[misc, name-defined]
    """A texture of linear light rather than its sRGB encoding, so that filtering averages light.

    With 16 bits per channel nothing is lost, and a driver on the CPU need not decode every sample of the filter.
    """

    mipmaps = True

    def _add_to_context(self) -> None:
        self._texid = GL.glGenTextures(1)
        GL.glBindTexture(GL.GL_TEXTURE_2D, self._texid)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
        height, width = self.source.shape[:2]
        pixels = np.ascontiguousarray(LIGHT_OF_SRGB[self.source[::-1]])
        GL.glTexImage2D(GL.GL_TEXTURE_2D, 0, GL.GL_RGBA16, width, height, 0, GL.GL_RGB, GL.GL_UNSIGNED_SHORT, pixels)
        if self.mipmaps:
            GL.glGenerateMipmap(GL.GL_TEXTURE_2D)
        smaller = GL.GL_LINEAR_MIPMAP_LINEAR if self.mipmaps else GL.GL_LINEAR
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR)
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_MIN_FILTER, smaller)
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_WRAP_S, self.sampler.wrapS)
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_WRAP_T, self.sampler.wrapT)
        GL.glBindTexture(GL.GL_TEXTURE_2D, 0)


class GLRenderer:
    """One OpenGL context and its renderer, for many jobs.

    Raises:
        GLUnavailable: no device gives a context.
    """

    def __init__(self) -> None:
        self._platform = _open_context()
        self._renderer = _Renderer(64, 64)
        self._renderer._program_cache = _Programs()
        self.largest_texture = int(GL.glGetIntegerv(GL.GL_MAX_TEXTURE_SIZE))
        self.largest_picture = int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE))
        self.device = (GL.glGetString(GL.GL_RENDERER) or b"unknown").decode(errors="replace")

    def draw(self, job: RenderJob) -> list[Bytes]:
        """Draw every shot.

        Returns:
            One picture per shot, uint8 [height, width, 4], colours multiplied by their coverage.
        """
        self._platform.make_current()
        programs = self._renderer._program_cache
        # Of the supersampled picture: each pixel takes 40 bytes with its multisample buffers. Larger pictures are drawn
        # with the hardware's four samples alone.
        affordable = int((40_000_000 / (job.width * job.height)) ** 0.5)
        samples = max(1, min(job.samples, affordable, self.largest_picture // max(job.width, job.height)))
        self._renderer.viewport_width, self._renderer.viewport_height = job.width * samples, job.height * samples
        lights = np.zeros((4, 4))
        for column, (way, power) in zip(lights.T, job.light.unit_directions(), strict=False):
            column[:] = *way, power
        # A part's defines differ by its mipmaps alone, and at most one part has an image.
        single = any(part.image is not None and not part.mipmaps for part in job.parts)
        programs.defines = dict.fromkeys(["UNLIT"] * job.light.unlit + ["SINGLE_LEVEL"] * single, 1)
        programs.uniforms = {
            "lights": lights,
            "light_count": len(job.light.directional),
            "sky": np.full(3, job.light.sky),
            "ground": np.full(3, job.light.ground),
            "edge_color": parse_color(job.wireframe.color),
            "edge_width": float(job.wireframe.width * samples),
            "edge_opacity": float(job.wireframe.opacity),
        }
        textures: dict[tuple, _Texture] = {}  # parts of a film share theirs
        meshes = [self._mesh(part, job.light.roughness, textures) for part in job.parts]
        pictures = []
        for k, shot in enumerate(job.shots):
            scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 0.0], ambient_light=[0.0, 0.0, 0.0])
            for mesh in meshes[k : k + 1] if job.one_each else meshes:
                scene.add(mesh)
            scene.add(_camera(shot, job.width / job.height), pose=shot.pose)
            pixels = self._renderer.render(scene, pyrender.RenderFlags.OFFSCREEN | pyrender.RenderFlags.RGBA)
            pictures.append(_averaged(pixels, samples))
        # An empty scene makes the renderer free the meshes and textures of this job.
        self._renderer._update_context(pyrender.Scene(), pyrender.RenderFlags.NONE)
        return pictures

    def _mesh(self, part: Part, roughness: float, textures: dict[tuple, _Texture]) -> object:
        key = (id(part.image), part.repeat, part.repeat_rows, part.mipmaps)
        if part.image is not None and key not in textures:
            right, up = (GL.GL_REPEAT if on else GL.GL_CLAMP_TO_EDGE for on in (part.repeat, part.repeat_rows))
            height, width = np.minimum(part.image.shape[:2], self.largest_texture).tolist()
            fitted = Image.fromarray(part.image).resize((width, height), Image.Resampling.BOX)
            sampler = pyrender.Sampler(wrapS=right, wrapT=up)
            textures[key] = _Texture(source=np.asarray(fitted), source_channels="RGB", sampler=sampler)
            textures[key].mipmaps = part.mipmaps
        material = pyrender.MetallicRoughnessMaterial(
            baseColorTexture=None if part.image is None else textures[key],
            baseColorFactor=[*(float(channel) for channel in part.tint), 1.0],
            metallicFactor=0.0,
            roughnessFactor=float(roughness),
            doubleSided=True,
        )
        primitive = pyrender.Primitive(
            positions=part.positions,
            normals=part.normals,
            texcoord_0=part.value[:, :2] if part.kind == "uv" else None,
            texcoord_1=np.tile(np.eye(3, 2, dtype=np.float32), (len(part.faces), 1)) if part.edges else None,
            color_0=np.column_stack([part.value, np.ones(len(part.value))]) if part.kind != "uv" else None,
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
    if not sys.platform.startswith("linux"):
        from pyrender.platforms.pyglet_platform import PygletPlatform

        platform = PygletPlatform(64, 64)
        platform.init_context()
        return platform
    from pyrender.platforms import egl

    devices = [None]  # Mesa without a device, where none is listed or usable
    with suppress(Exception):
        devices = [*egl.query_devices(), None]
    wanted = os.environ.get("EGL_DEVICE_ID", "")
    if wanted.isdecimal() and int(wanted) < len(devices):
        devices.insert(0, devices.pop(int(wanted)))
    reason = ""
    for device in devices:
        if device is None:
            os.environ["EGL_PLATFORM"] = "surfaceless"
        platform = egl.EGLPlatform(64, 64, device=device or egl.EGLDevice(None))
        try:
            platform.init_context()
            if GL.glGetString(GL.GL_VERSION):
                return platform
            reason = "no OpenGL version reported"
        except Exception as error:
            reason = (str(error) or type(error).__name__).splitlines()[0]
        with suppress(Exception):
            platform.delete_context()
    raise GLUnavailable(f"no EGL device gives an OpenGL context: {reason} ({INSTALL_GL})")
