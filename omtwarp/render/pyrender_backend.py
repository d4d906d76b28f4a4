"""Drawing with pyrender, offscreen through EGL: on a GPU where there is one, with Mesa's llvmpipe on the CPU elsewhere.

Everything here runs in the drawing process. It imports pyrender, so import it only there, after
:func:`omtwarp.render.pyrender_compat.import_pyrender`.
"""

from __future__ import annotations

import os
import sys

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from omtwarp.render import shaders
from omtwarp.render.camera import Shot
from omtwarp.render.colors import parse_color
from omtwarp.render.installing import INSTALL_GL
from omtwarp.render.light import LIGHTS
from omtwarp.render.pyrender_compat import GLUnavailable, import_pyrender
from omtwarp.render.scene import Part, RenderJob
from omtwarp.srgb import to_linear

pyrender = import_pyrender()

from OpenGL import GL  # noqa: E402
from pyrender.camera import Camera  # noqa: E402
from pyrender.mesh import Mesh  # noqa: E402
from pyrender.platforms.base import Platform  # noqa: E402
from pyrender.renderer import Renderer  # noqa: E402
from pyrender.scene import Scene  # noqa: E402
from pyrender.shader_program import ShaderProgram, ShaderProgramCache  # noqa: E402

SURFACELESS = "surfaceless"
# Of the supersampled picture: each pixel takes 40 bytes with its multisample buffers. Larger pictures are drawn with
# the hardware's four samples alone.
MOST_PIXELS = 40_000_000

LIGHT_OF_SRGB = np.round(65535.0 * to_linear(np.arange(256) / 255.0)).astype(np.uint16)


class _Program(ShaderProgram):  # type: ignore[misc]
    """A program from :mod:`omtwarp.render.shaders` instead of pyrender's files, with uniforms of our own."""

    uniforms: dict[str, object]

    def _load(self, shader_filename: str) -> str:
        source = shaders.VERTEX if shader_filename.endswith(".vert") else shaders.FRAGMENT
        defines = "".join(f"#define {name} {value}\n" for name, value in self.defines.items())
        return f"#version 330 core\n{defines}{source}"

    def _bind(self) -> None:
        super()._bind()
        for name, value in self.uniforms.items():
            self.set_uniform(name, value)


class _Programs(ShaderProgramCache):  # type: ignore[misc]
    """Programs by their defines; ``defines`` and ``uniforms`` hold for every program of the job in hand."""

    def __init__(self) -> None:
        super().__init__()
        self.defines: dict[str, int] = {}
        self.uniforms: dict[str, object] = {}

    def get_program(
        self,
        vertex_shader: str,
        fragment_shader: str,
        geometry_shader: str | None = None,
        defines: dict[str, int] | None = None,
    ) -> _Program:
        every = {**(defines or {}), **self.defines}
        key = tuple(sorted(every.items()))
        if key not in self._program_cache:
            self._program_cache[key] = _Program(vertex_shader, fragment_shader, defines=every)
        program: _Program = self._program_cache[key]
        program.uniforms = self.uniforms
        return program


class _Renderer(Renderer):  # type: ignore[misc]
    """pyrender's renderer without the depth image, whose read-back and conversion cost as much as a small scene."""

    def _read_main_framebuffer(self, scene: Scene, flags: int) -> NDArray[np.uint8]:
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
        for name, value in (
            (GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR),
            (GL.GL_TEXTURE_MIN_FILTER, smaller),
            (GL.GL_TEXTURE_WRAP_S, self.sampler.wrapS),
            (GL.GL_TEXTURE_WRAP_T, self.sampler.wrapT),
        ):
            GL.glTexParameteri(GL.GL_TEXTURE_2D, name, value)
        GL.glBindTexture(GL.GL_TEXTURE_2D, 0)


class GLRenderer:
    """One OpenGL context and its renderer, for many jobs.

    Raises:
        GLUnavailable: no device gives a context.
    """

    def __init__(self) -> None:
        self._platform = _open_context()
        self._renderer = _Renderer(64, 64)
        self._programs = _Programs()
        self._renderer._program_cache = self._programs
        self.largest_texture = int(GL.glGetIntegerv(GL.GL_MAX_TEXTURE_SIZE))
        self.largest_picture = int(GL.glGetIntegerv(GL.GL_MAX_RENDERBUFFER_SIZE))
        name = GL.glGetString(GL.GL_RENDERER)
        self.device = name.decode(errors="replace") if name else "unknown"

    def warm_up(self) -> None:
        """Draw a textured triangle: the driver compiles the commonest shader while the caller reads its mesh."""
        corners = np.eye(3, dtype=np.float32)
        normals = np.full((3, 3), 3.0**-0.5, dtype=np.float32)
        image = np.full((4, 4, 3), 128, dtype=np.uint8)
        part = Part(corners, normals, np.array([[0, 1, 2]], dtype=np.int32), "uv", corners, image)
        pose = np.eye(4)
        pose[2, 3] = 4.0
        shot = Shot(pose, perspective=True, half_width=0.5, half_height=0.5, near=1.0, far=8.0)
        self.draw(RenderJob([part], [shot], width=16, height=16, light=LIGHTS["studio"]))

    def draw(self, job: RenderJob) -> list[NDArray[np.uint8]]:
        """Draw every shot.

        Returns:
            One picture per shot, uint8 [height, width, 4], colours multiplied by their coverage.
        """
        self._platform.make_current()
        affordable = int((MOST_PIXELS / (job.width * job.height)) ** 0.5)
        samples = max(1, min(job.samples, affordable, self.largest_picture // max(job.width, job.height)))
        self._renderer.viewport_width, self._renderer.viewport_height = job.width * samples, job.height * samples
        wires = job.wireframe
        lights = np.zeros((4, 4))
        for k, (way, power) in enumerate(job.light.unit_directions()):
            lights[:, k] = [*way, power]
        self._programs.defines = {"UNLIT": 1} if job.light.unlit else {}
        self._programs.uniforms = {
            "lights": lights,
            "light_count": len(job.light.directional),
            "sky": np.full(3, job.light.sky),
            "ground": np.full(3, job.light.ground),
            "edge_color": parse_color(wires.color),
            "edge_width": float(wires.width * samples),
            "edge_opacity": float(wires.opacity),
        }
        textures: dict[tuple, _Texture] = {}  # parts of a film share theirs
        meshes = [self._mesh(part, job.light.roughness, textures) for part in job.parts]
        pictures = []
        for k, shot in enumerate(job.shots):
            scene = pyrender.Scene(bg_color=[0.0, 0.0, 0.0, 0.0], ambient_light=[0.0, 0.0, 0.0])
            for mesh in meshes[k : k + 1] if job.one_each else meshes:
                scene.add(mesh)
            scene.add(_camera(shot, job.width / job.height), pose=shot.pose)
            # A part's defines differ by its mipmaps alone, and at most one part has an image.
            if any(part.image is not None and not part.mipmaps for part in job.parts):
                self._programs.defines["SINGLE_LEVEL"] = 1
            pixels = self._renderer.render(scene, pyrender.RenderFlags.OFFSCREEN | pyrender.RenderFlags.RGBA)
            pictures.append(_averaged(pixels, samples))
        # An empty scene makes the renderer free the meshes and textures of this job.
        self._renderer._update_context(pyrender.Scene(), pyrender.RenderFlags.NONE)
        return pictures

    def _mesh(self, part: Part, roughness: float, textures: dict[tuple, _Texture]) -> Mesh:
        key = (id(part.image), part.repeat, part.repeat_rows, part.mipmaps)
        texture = None if part.image is None else textures.get(key)
        if part.image is not None and texture is None:
            wrap = GL.GL_REPEAT if part.repeat else GL.GL_CLAMP_TO_EDGE
            vertical = GL.GL_REPEAT if part.repeat_rows else GL.GL_CLAMP_TO_EDGE
            sampler = pyrender.Sampler(wrapS=wrap, wrapT=vertical)
            texture = _Texture(source=_fitted(part.image, self.largest_texture), source_channels="RGB", sampler=sampler)
            texture.mipmaps = part.mipmaps
            textures[key] = texture
        material = pyrender.MetallicRoughnessMaterial(
            baseColorTexture=texture,
            baseColorFactor=[*(float(channel) for channel in part.tint), 1.0],
            metallicFactor=0.0,
            roughnessFactor=float(roughness),
            alphaMode="OPAQUE",
            doubleSided=True,
        )
        inside = np.tile(np.eye(3, 2, dtype=np.float32), (len(part.faces), 1)) if part.edges else None
        primitive = pyrender.Primitive(
            positions=part.positions,
            normals=part.normals,
            texcoord_0=part.value[:, :2] if part.kind == "uv" else None,
            texcoord_1=inside,
            color_0=np.column_stack([part.value, np.ones(len(part.value))]) if part.kind != "uv" else None,
            indices=None if part.edges else part.faces,
            material=material,
        )
        return pyrender.Mesh([primitive])

    def close(self) -> None:
        """Free the context."""
        self._platform.make_current()
        self._renderer.delete()
        self._platform.delete_context()


def _averaged(pixels: NDArray[np.uint8], side: int) -> NDArray[np.uint8]:
    """Average blocks of ``side`` x ``side`` pixels."""
    height, width = pixels.shape[:2]
    # Not as RGBA: Pillow would take the colours as unmultiplied and weight them by their coverage again.
    picture = Image.frombuffer("RGBX", (width, height), np.ascontiguousarray(pixels).tobytes(), "raw", "RGBX", 0, 1)
    return np.asarray(picture.reduce(side) if side > 1 else picture)


def _fitted(image: NDArray[np.uint8], largest: int) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    if max(height, width) <= largest:
        return image
    smaller = Image.fromarray(image).resize((min(width, largest), min(height, largest)), Image.Resampling.BOX)
    return np.asarray(smaller)


def _camera(shot: Shot, aspect: float) -> Camera:
    if shot.perspective:
        opening = 2.0 * float(np.arctan(shot.half_height))
        return pyrender.PerspectiveCamera(yfov=opening, znear=shot.near, zfar=shot.far, aspectRatio=aspect)
    return pyrender.OrthographicCamera(xmag=shot.half_width, ymag=shot.half_height, znear=shot.near, zfar=shot.far)


def _open_context() -> Platform:
    """Open an OpenGL context on the first device that provides one.

    Device 0 may be a graphics card the user may not open, so each is tried; ``EGL_DEVICE_ID`` goes first.
    """
    if not sys.platform.startswith("linux"):
        from pyrender.platforms.pyglet_platform import PygletPlatform

        platform = PygletPlatform(64, 64)
        platform.init_context()
        platform.make_current()
        return platform
    from pyrender.platforms import egl

    try:
        devices = egl.query_devices()
    except Exception:
        devices = []
    wanted = os.environ.get("EGL_DEVICE_ID", "")
    if wanted.isascii() and wanted.isdigit() and int(wanted) < len(devices):
        devices.insert(0, devices.pop(int(wanted)))
    reasons = []
    for device in [*devices, None]:
        if device is None:  # no device listed, or none usable: Mesa without one
            os.environ["EGL_PLATFORM"] = SURFACELESS
            device = egl.EGLDevice(None)
        platform = egl.EGLPlatform(64, 64, device=device)
        try:
            platform.init_context()
            if GL.glGetString(GL.GL_VERSION):
                return platform
            reasons.append("no OpenGL version reported")
        except Exception as error:
            reasons.append(str(error).splitlines()[0] if str(error) else type(error).__name__)
        try:
            platform.delete_context()
        except Exception:
            pass
    raise GLUnavailable(f"no EGL device gives an OpenGL context: {reasons[-1]} ({INSTALL_GL})")
