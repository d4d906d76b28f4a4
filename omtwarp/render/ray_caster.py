"""Drawing with Warp: one ray per pixel through a bounding volume hierarchy, more where the picture has edges.

It needs no OpenGL, runs on the CPU and on CUDA devices, and takes the same jobs as pyrender with the same camera,
filter, light and lines, those of the shaders in ``shaders/mesh.frag``. Single precision throughout, unlike the rest of
the package: the result is eight bits per channel, and Warp's ray query takes nothing else.
"""

import math
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import maximum_filter, minimum_filter

from omtwarp.colors import parse_color, to_linear, to_srgb
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.mesh.arrays import Bytes
from omtwarp.render.camera import Shot
from omtwarp.render.scene import Appearance, Part, RenderJob
from omtwarp.texturing.image import as_bytes

wp.set_module_options(KERNEL_OPTIONS)

PI_F = wp.constant(wp.float32(math.pi))


class Kind(IntEnum):
    """What a part's corners hold: colours, texture coordinates, or directions on the sphere."""

    COLOR, UV, SPHERE = 0, 1, 2


@wp.struct
class View:
    origin: wp.vec3
    right: wp.vec3
    up: wp.vec3
    backward: wp.vec3
    perspective: wp.int32
    half_width: wp.float32
    half_height: wp.float32
    width: wp.int32
    height: wp.int32


@wp.struct
class Geometry:
    mesh: wp.uint64
    normals: wp.array[wp.vec3]
    values: wp.array[wp.vec3]
    faces: wp.array2d[wp.int32]
    kinds: wp.array[wp.int32]  # per face, a Kind
    pictures: wp.array[wp.int32]  # per face, number of its picture
    edges: wp.array[wp.int32]  # per face, 1 where its edges are drawn


@wp.struct
class Picture:
    texels: wp.array2d[wp.uint8]  # every level, one after the other, [texels, 3], rows from the top
    sizes: wp.array2d[wp.int32]  # width, height and first texel of every level
    decode: wp.array[wp.float32]  # sRGB byte to linear
    repeat: wp.int32
    repeat_rows: wp.int32
    tint: wp.vec3  # linear


@wp.struct
class Look:
    lights: wp.array[wp.vec4]  # directions towards them, in the camera's frame, and their powers
    sky: wp.float32
    ground: wp.float32
    roughness: wp.float32
    unlit: wp.int32
    edge_color: wp.vec3
    edge_width: wp.float32
    edge_opacity: wp.float32


@wp.func
def light_of(c: wp.float32):
    """Convert an sRGB value to linear light (IEC 61966-2-1), as :func:`omtwarp.colors.to_linear` does."""
    return wp.where(c > 0.04045, wp.pow((c + 0.055) / 1.055, 2.4), c / 12.92)


@wp.func
def srgb_of(c: wp.float32):
    """Convert linear light to an sRGB value (IEC 61966-2-1), as :func:`omtwarp.colors.to_srgb` does."""
    clamped = wp.clamp(c, 0.0, 1.0)
    return wp.where(clamped > 0.0031308, 1.055 * wp.pow(clamped, 1.0 / 2.4) - 0.055, clamped * 12.92)


@wp.func
def wrapped(index: int, count: int, repeat: int):
    """Bring an index into [0, count): the image repeats, or its border is continued."""
    inside = wp.clamp(index, 0, count - 1)
    if repeat != 0:
        inside = index - count * int(wp.floor(float(index) / float(count)))
        inside = wp.clamp(inside, 0, count - 1)  # the quotient may round up
    return inside


@wp.func
def texel(picture: Picture, level: int, column: int, row: int):
    at = picture.sizes[level, 2] + row * picture.sizes[level, 0] + column
    return wp.vec3(
        picture.decode[int(picture.texels[at, 0])],
        picture.decode[int(picture.texels[at, 1])],
        picture.decode[int(picture.texels[at, 2])],
    )


@wp.func
def bilinear(picture: Picture, u: float, v: float, level: int):
    width, height = picture.sizes[level, 0], picture.sizes[level, 1]
    x, y = u * float(width) - 0.5, (1.0 - v) * float(height) - 0.5
    column, row = int(wp.floor(x)), int(wp.floor(y))
    s, t = x - wp.floor(x), y - wp.floor(y)
    left, right = wrapped(column, width, picture.repeat), wrapped(column + 1, width, picture.repeat)
    top, bottom = wrapped(row, height, picture.repeat_rows), wrapped(row + 1, height, picture.repeat_rows)
    above = (1.0 - s) * texel(picture, level, left, top) + s * texel(picture, level, right, top)
    below = (1.0 - s) * texel(picture, level, left, bottom) + s * texel(picture, level, right, bottom)
    return (1.0 - t) * above + t * below


@wp.func
def trilinear(picture: Picture, u: float, v: float, level: float):
    clamped = wp.clamp(level, 0.0, float(picture.sizes.shape[0] - 1))
    lower = int(wp.floor(clamped))
    blend = clamped - float(lower)
    found = bilinear(picture, u, v, lower)
    if blend > 0.0:
        found = (1.0 - blend) * found + blend * bilinear(picture, u, v, lower + 1)
    return found


@wp.func
def filtered(picture: Picture, uv: wp.vec2, along_x: wp.vec2, along_y: wp.vec2):
    """Return the mean colour of an image over the ellipse that the derivatives span.

    Samples are taken along its long axis, at the mip level of the short one.
    """
    width, height = float(picture.sizes[0, 0]), float(picture.sizes[0, 1])
    ax, ay = along_x[0] * width, along_x[1] * height
    bx, by = along_y[0] * width, along_y[1] * height
    xx, yy, xy = ax * ax + bx * bx, ay * ay + by * by, ax * ay + bx * by
    half_gap = 0.5 * (xx - yy)
    root = wp.sqrt(half_gap * half_gap + xy * xy)
    longest = wp.sqrt(0.5 * (xx + yy) + root)
    # Smallest, texels: footprints are divided by their length
    shortest = wp.abs(ax * by - ay * bx) / wp.max(longest, wp.float32(1.0e-12))
    axis = wp.vec2(xy, root - half_gap)
    if half_gap >= 0.0:
        axis = wp.vec2(half_gap + root, xy)
    size = wp.length(axis)
    if size > 0.0:
        axis = axis / size
    else:
        axis = wp.vec2(1.0, 0.0)
    # Most probes, along a footprint: anisotropy that textures are filtered with at most
    probes = wp.clamp(wp.ceil(longest / wp.max(shortest, 1.0)), 1.0, wp.float32(48.0))
    level = wp.log2(wp.max(wp.max(shortest, longest / probes), 1.0))
    step_u = axis[0] * longest / (width * probes)
    step_v = axis[1] * longest / (height * probes)
    first_u = uv[0] - 0.5 * (probes - 1.0) * step_u
    first_v = uv[1] - 0.5 * (probes - 1.0) * step_v
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(int(probes)):
        total += trilinear(picture, first_u + float(k) * step_u, first_v + float(k) * step_v, level)
    return total / probes


@wp.func
def sphere_color(picture: Picture, p: wp.vec3, px: wp.vec3, py: wp.vec3):
    """Return the equirectangular image at a point of the sphere; derivatives by the chain rule, hence no seam."""
    across = wp.max(wp.dot(px, px), wp.dot(py, py))
    flat2 = p[0] * p[0] + p[1] * p[1]
    # Squared distance from the axis: the poles have no longitude.
    rho2 = wp.max(flat2, wp.max(0.0625 * across, wp.float32(1.0e-20)))
    rho = wp.sqrt(rho2)
    r2 = rho2 + p[2] * p[2]
    longitude_x = (p[0] * px[1] - p[1] * px[0]) / rho2
    longitude_y = (p[0] * py[1] - p[1] * py[0]) / rho2
    latitude_x = (rho * px[2] - p[2] * (p[0] * px[0] + p[1] * px[1]) / rho) / r2
    latitude_y = (rho * py[2] - p[2] * (p[0] * py[0] + p[1] * py[1]) / rho) / r2
    uv = wp.vec2(0.5 + wp.atan2(p[1], p[0]) / (2.0 * PI_F), 0.5 + wp.atan2(p[2], wp.sqrt(flat2)) / PI_F)
    along_x = wp.vec2(longitude_x / (2.0 * PI_F), latitude_x / PI_F)
    along_y = wp.vec2(longitude_y / (2.0 * PI_F), latitude_y / PI_F)
    return filtered(picture, uv, along_x, along_y)


@wp.func
def lit(look: Look, albedo: wp.vec3, n: wp.vec3, v: wp.vec3):
    """Return Lambert's diffuse term and a GGX highlight (Schlick's Fresnel, Smith's shadowing; glTF 2.0, appendix B).

    With h = (l + v) / |l + v| and |l + v|² = 2 (1 + l.v) all angles come from n.l, n.v and l.v.
    """
    alpha2 = wp.pow(look.roughness, 4.0)
    k = (look.roughness + 1.0) * (look.roughness + 1.0) / 8.0
    facing = wp.dot(n, v)
    # Least cosine towards the viewer in the highlight's shadowing, whose quotient it keeps finite.
    shadow = wp.clamp(wp.abs(facing), wp.float32(0.001), 1.0) * (1.0 - k) + k
    gloss = alpha2 / (4.0 * PI_F)
    high = 0.5 + 0.5 * n[1]
    diffuse = look.ground * (1.0 - high) + look.sky * high
    shine = float(0.0)
    for i in range(look.lights.shape[0]):
        light = look.lights[i]
        way = wp.vec3(light[0], light[1], light[2])
        incident = wp.dot(n, way)
        nl = wp.clamp(incident, 0.0, 1.0)
        both = 1.0 + wp.dot(v, way)
        # Squared length of the sum of the ways to light and viewer: they are opposite.
        scale = 1.0 / wp.sqrt(wp.max(2.0 * both, wp.float32(1.0e-6)))
        nh = wp.clamp((incident + facing) * scale, 0.0, 1.0)
        fresnel = 0.04 + 0.96 * wp.pow(1.0 - wp.clamp(both * scale, 0.0, 1.0), 5.0)
        spread = nh * nh * (alpha2 - 1.0) + 1.0
        power = nl * light[3]
        diffuse += power * (1.0 - fresnel) / PI_F
        shine += power * fresnel * gloss / (spread * spread * (nl * (1.0 - k) + k) * shadow)
    return diffuse * albedo + wp.vec3(shine, shine, shine)


@wp.func
def ray_at(view: View, x: float, y: float):
    """Return where the ray of a point of the picture begins, and its unit direction."""
    across = (2.0 * x / float(view.width) - 1.0) * view.half_width
    above = (1.0 - 2.0 * y / float(view.height)) * view.half_height
    aside = across * view.right + above * view.up
    if view.perspective == 0:
        return view.origin + aside, -view.backward
    return view.origin, wp.normalize(aside - view.backward)


@wp.func
def as_seen(view: View, v: wp.vec3):
    """Return the components of a vector to the right, upwards and to the viewer."""
    return wp.vec3(wp.dot(v, view.right), wp.dot(v, view.up), wp.dot(v, view.backward))


@wp.func
def weights_on_plane(origin: wp.vec3, way: wp.vec3, p0: wp.vec3, e1: wp.vec3, e2: wp.vec3, facing: float):
    """Return the barycentric weights of corners 1 and 2 where a ray meets a triangle's plane, and the determinant.

    Moeller & Trumbore (1997). ``facing`` is the determinant of the ray the pixel is drawn with (0 for that ray itself):
    a neighbouring ray that runs along the plane or meets it behind the camera is limited to a tenth of it.
    """
    across = wp.cross(way, e2)
    determinant = wp.dot(e1, across)
    if facing > 0.0:
        determinant = wp.max(determinant, 0.1 * facing)
    if facing < 0.0:
        determinant = wp.min(determinant, 0.1 * facing)
    if determinant == 0.0:
        # No determinant, in place of zero, of a ray along the triangle's plane
        determinant = wp.float32(1.0e-20)
    to = origin - p0
    return wp.vec3(wp.dot(to, across) / determinant, wp.dot(way, wp.cross(to, e1)) / determinant, determinant)


@wp.func
def line_strength(weight: float, gradient_x: float, gradient_y: float, width: float, ramp: float):
    # Squared slope of a weight over pixels: an edge seen so large is as if it lay nowhere.
    height = 1.0 / wp.sqrt(wp.max(gradient_x * gradient_x + gradient_y * gradient_y, wp.float32(1.0e-20)))
    line = wp.clamp((0.5 * width - weight * height) / ramp + 0.5, 0.0, 1.0)
    return line * wp.clamp((height - width) / (5.0 * width), 0.12, 1.0)


@wp.func
def sample(view: View, shape: Geometry, pictures: wp.array[Picture], look: Look, x: float, y: float, spacing: float):
    """Return colour and coverage at a point of the picture; ``spacing`` is the width of the area it represents."""
    origin, way = ray_at(view, x, y)
    hit = wp.mesh_query_ray(shape.mesh, origin, way, 1.0e6)
    if not hit.result:
        # Rays exactly at a vertex can miss; a thousandth of a pixel next to it they do not.
        origin, way = ray_at(view, x + wp.float32(1.1e-3), y + wp.float32(0.7e-3))
        hit = wp.mesh_query_ray(shape.mesh, origin, way, 1.0e6)
    if not hit.result:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    face = hit.face
    picture = pictures[shape.pictures[face]]
    i0, i1, i2 = shape.faces[face, 0], shape.faces[face, 1], shape.faces[face, 2]
    p0 = wp.mesh_get_point(shape.mesh, 3 * face)
    e1 = wp.mesh_get_point(shape.mesh, 3 * face + 1) - p0
    e2 = wp.mesh_get_point(shape.mesh, 3 * face + 2) - p0
    here = weights_on_plane(origin, way, p0, e1, e2, 0.0)
    u, v = here[0], here[1]
    ox, wx = ray_at(view, x + spacing, y)
    oy, wy = ray_at(view, x, y - spacing)
    beside = weights_on_plane(ox, wx, p0, e1, e2, here[2])
    above = weights_on_plane(oy, wy, p0, e1, e2, here[2])
    ux, vx = beside[0] - u, beside[1] - v
    uy, vy = above[0] - u, above[1] - v
    a0 = shape.values[i0]
    a1, a2 = shape.values[i1] - a0, shape.values[i2] - a0
    value = a0 + u * a1 + v * a2
    along_x, along_y = ux * a1 + vx * a2, uy * a1 + vy * a2
    kind = shape.kinds[face]
    albedo = wp.vec3(light_of(value[0]), light_of(value[1]), light_of(value[2]))
    if kind == Kind.UV:
        if picture.sizes.shape[0] == 1:
            albedo = bilinear(picture, value[0], value[1], 0)
        else:
            grad_x, grad_y = wp.vec2(along_x[0], along_x[1]), wp.vec2(along_y[0], along_y[1])
            albedo = filtered(picture, wp.vec2(value[0], value[1]), grad_x, grad_y)
    if kind == Kind.SPHERE:
        albedo = sphere_color(picture, value, along_x, along_y)
    if kind != Kind.COLOR:
        albedo = wp.cw_mul(albedo, picture.tint)
    if look.unlit == 0:
        n = (1.0 - u - v) * shape.normals[i0] + u * shape.normals[i1] + v * shape.normals[i2]
        if wp.dot(wp.cross(e1, e2), way) > 0.0:
            n = -n
        albedo = lit(look, albedo, wp.normalize(as_seen(view, n)), as_seen(view, -way))
    color = wp.vec3(srgb_of(albedo[0]), srgb_of(albedo[1]), srgb_of(albedo[2]))
    if shape.edges[face] != 0:
        # The derivatives were taken over `spacing`; the lines' width is in whole pixels.
        per, width = 1.0 / spacing, look.edge_width
        ramp = wp.min(2.0 * spacing, 1.0)
        line = line_strength(u, ux * per, uy * per, width, ramp)
        line = wp.max(line, line_strength(v, vx * per, vy * per, width, ramp))
        line = wp.max(line, line_strength(1.0 - u - v, (ux + vx) * per, (uy + vy) * per, width, ramp))
        line = line * look.edge_opacity
        color = (1.0 - line) * color + line * look.edge_color
    return wp.vec4(color[0], color[1], color[2], 1.0)


@wp.kernel
def draw_pixels(
    view: View,
    shape: Geometry,
    pictures: wp.array[Picture],
    look: Look,
    pixels: wp.array[wp.int32],
    side: wp.int32,
    spacing: wp.float32,
    # Data out:
    colors: wp.array2d[wp.vec4],
):
    """Compute listed pixels as the mean over ``side`` x ``side`` samples, each of an area ``spacing`` wide."""
    pixel = pixels[wp.tid()]
    row = pixel // view.width
    column = pixel - row * view.width
    step = 1.0 / float(side)
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(side):
        for j in range(side):
            x = float(column) + (float(j) + 0.5) * step
            y = float(row) + (float(k) + 0.5) * step
            total += sample(view, shape, pictures, look, x, y, spacing)
    colors[row, column] = total * (step * step)


def draw(job: RenderJob, device: str = "auto") -> list[Bytes]:
    """Draw every shot.

    Args:
        job: parts, cameras, size and lights.
        device: ``auto``, ``cpu`` or a CUDA device.

    Returns:
        One picture per shot, uint8 [height, width, 4], colours multiplied by their coverage.

    Raises:
        OmtwarpError: unknown device.
    """
    where = resolve_device(device)
    together = job.parts[:1] if job.one_each else job.parts
    shape, mesh = _geometry(together, where)
    images: list[Appearance] = [part for part in together if part.image is not None]
    grey = Appearance(kind="color", value=np.empty(0), image=np.full((1, 1, 3), 128, np.uint8), mipmaps=False)
    kept = [_picture(part, where) for part in images or [grey]]
    pictures = wp.array(kept, dtype=Picture, device=where)
    look = _look(job, where)
    drawn = []
    for k, shot in enumerate(job.shots):
        if job.one_each and k > 0:
            shape, mesh = _geometry(job.parts[k : k + 1], where)
        inputs = [_view(shot, job.width, job.height), shape, pictures, look]
        colors = wp.empty((job.height, job.width), dtype=wp.vec4, device=where)
        # With a footprint of 0.75 pixels: only smooth areas keep the result, where a sharper filter cannot alias.
        _draw_pixels(np.arange(job.height * job.width), 1, 0.75, inputs, colors)
        # More samples matter beside an edge: a step of 6/255 is the smallest that is visible as a jagged one.
        first, around = colors.numpy(), {"size": (3, 3, 1), "mode": "nearest"}
        steps = np.maximum(maximum_filter(first, **around) - first, first - minimum_filter(first, **around))
        side = 2 * max(2, job.samples)
        chosen = np.flatnonzero((steps > np.float32(6.0 / 255.0)).any(axis=2))
        _draw_pixels(chosen, side, 1.0 / side, inputs, colors)
        drawn.append(np.rint(np.clip(colors.numpy(), 0.0, 1.0) * 255.0).astype(np.uint8))
    del mesh, kept  # kept until here: the kernels know them by numbers only
    return drawn


def _draw_pixels(pixels: NDArray[np.integer], side: int, spacing: float, inputs: list, colors: wp.array) -> None:
    """Draw pixels, given by their numbers row by row, with ``side`` x ``side`` samples each."""
    listed = wp.array(pixels, dtype=wp.int32, device=colors.device)
    wp.launch(draw_pixels, len(pixels), inputs=[*inputs, listed, side, spacing], outputs=[colors], device=colors.device)


def _geometry(parts: list[Part], where: wp.Device) -> tuple[Geometry, wp.Mesh]:
    """Join the parts to one mesh with unshared corners, so that a face's number is enough to find its points."""
    offsets = np.cumsum([0] + [len(part.positions) for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets[:-1], strict=True)])
    positions = np.concatenate([part.positions for part in parts])
    corners = wp.array(faces.astype(np.int32), dtype=wp.int32, device=where)
    mesh = wp.Mesh(wp.array(positions, dtype=wp.vec3, device=where), corners.flatten())
    shape = Geometry()
    shape.mesh, shape.faces = mesh.id, corners
    shape.normals = wp.array(np.concatenate([part.normals for part in parts]), dtype=wp.vec3, device=where)
    shape.values = wp.array(np.concatenate([part.value for part in parts]), dtype=wp.vec3, device=where)
    having = np.cumsum([part.image is not None for part in parts]) - 1
    numbers = [Kind[part.kind.upper()] for part in parts], [part.edges for part in parts], np.maximum(having, 0)
    counts = [len(part.faces) for part in parts]
    shape.kinds, shape.edges, shape.pictures = (
        wp.array(np.repeat(of_parts, counts).astype(np.int32), dtype=wp.int32, device=where) for of_parts in numbers
    )
    return shape, mesh


def _picture(part: Appearance, where: wp.Device) -> Picture:
    """Return a part's image with its mip levels."""
    decode = to_linear(np.arange(256) / 255.0).astype(np.float32)
    levels = [np.asarray(part.image)]
    while part.mipmaps and levels[-1].shape[:2] != (1, 1):
        half = (max(levels[-1].shape[1] // 2, 1), max(levels[-1].shape[0] // 2, 1))
        # One channel after the other: three times as fast as with all in one array
        lights = (Image.fromarray(decode[channel]) for channel in np.moveaxis(levels[-1], 2, 0))
        halves = [np.asarray(light.resize(half, Image.Resampling.BOX)) for light in lights]
        levels.append(np.stack([as_bytes(to_srgb(light)) for light in halves], axis=2))
    heights, widths = np.array([level.shape[:2] for level in levels], dtype=np.int32).T
    sizes = np.column_stack([widths, heights, np.cumsum(heights * widths) - heights * widths])
    texels = np.concatenate([level.reshape(-1, 3) for level in levels])
    picture = Picture()
    picture.texels = wp.array(texels, dtype=wp.uint8, device=where)
    picture.decode = wp.array(decode, dtype=wp.float32, device=where)
    picture.sizes = wp.array(sizes, dtype=wp.int32, device=where)
    picture.repeat, picture.repeat_rows = int(part.repeat), int(part.repeat_rows)
    picture.tint = wp.vec3(*to_linear(np.array(part.tint)).tolist())
    return picture


def _look(job: RenderJob, where: wp.Device) -> Look:
    look = Look()
    lights = np.array([[*way, power] for way, power in job.light.unit_directions()], np.float32).reshape(-1, 4)
    look.lights = wp.array(lights, dtype=wp.vec4, device=where)
    look.sky, look.ground, look.roughness = job.light.sky, job.light.ground, job.light.roughness
    look.unlit = int(job.light.unlit)
    look.edge_color = wp.vec3(*parse_color(job.wireframe.color).tolist())
    look.edge_width, look.edge_opacity = job.wireframe.width, job.wireframe.opacity
    return look


def _view(shot: Shot, width: int, height: int) -> View:
    view = View()
    view.right, view.up, view.backward, view.origin = (wp.vec3(*shot.pose[:3, k].tolist()) for k in range(4))
    view.perspective = int(shot.perspective)
    view.half_width, view.half_height = shot.half_width, shot.half_height
    view.width, view.height = width, height
    return view
