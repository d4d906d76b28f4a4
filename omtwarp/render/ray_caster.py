"""Drawing with Warp: one ray per pixel through a bounding volume hierarchy, more where the picture has edges.

It needs no OpenGL, runs on the CPU and on CUDA devices, and takes the same jobs as pyrender with the same camera,
lights, texture filter and lines.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from omtwarp.colors import parse_color, to_linear
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.mesh.arrays import Bytes
from omtwarp.render import ray_kernels as kernels
from omtwarp.render.camera import Shot
from omtwarp.render.scene import Appearance, Part, RenderJob


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
    # The footprint of the first pass, in pixels: only smooth areas keep its result, where a sharper filter cannot
    # alias.
    first_spacing = 0.75
    where = resolve_device(device)
    together = job.parts[:1] if job.one_each else job.parts
    shape, mesh = _geometry(together, where)
    images: list[Appearance] = [part for part in together if part.image is not None]
    grey = Appearance(kind="color", value=np.empty(0), image=np.full((1, 1, 3), 128, np.uint8), mipmaps=False)
    kept = [_picture(part, where) for part in images or [grey]]
    pictures = wp.array(kept, dtype=kernels.Picture, device=where)
    look = _look(job, where)
    drawn = []
    for k, shot in enumerate(job.shots):
        if job.one_each and k > 0:
            shape, mesh = _geometry(job.parts[k : k + 1], where)
        view = _view(shot, job.width, job.height)
        colors = wp.empty((job.height, job.width), dtype=wp.vec4, device=where)
        size = (job.height, job.width)
        wp.launch(
            kernels.draw_centres,
            size,
            inputs=[view, shape, pictures, look, first_spacing],
            outputs=[colors],
            device=where,
        )
        # More samples matter beside an edge: a step of 6/255 is the smallest that is visible as a jagged one.
        first, around = colors.numpy(), {"size": (3, 3, 1), "mode": "nearest"}
        steps = np.maximum(maximum_filter(first, **around) - first, first - minimum_filter(first, **around))
        chosen = np.flatnonzero((steps > np.float32(6.0 / 255.0)).any(axis=2)).astype(np.int32)
        if chosen.size:
            pixels = wp.array(chosen, dtype=wp.int32, device=where)
            side = 2 * max(2, job.samples)
            wp.launch(
                kernels.draw_finely,
                len(chosen),
                inputs=[view, shape, pictures, look, pixels, side],
                outputs=[colors],
                device=where,
            )
        drawn.append(np.rint(np.clip(colors.numpy(), 0.0, 1.0) * 255.0).astype(np.uint8))
    del mesh, kept  # kept until here: the kernels know them by numbers only
    return drawn


def _geometry(parts: list[Part], where: wp.Device) -> tuple[kernels.Geometry, wp.Mesh]:
    """Join the parts to one mesh with unshared corners, so that a face's number is enough to find its points."""
    offsets = np.cumsum([0] + [len(part.positions) for part in parts])
    faces = np.concatenate([part.faces + offset for part, offset in zip(parts, offsets[:-1], strict=True)])
    positions = np.concatenate([part.positions for part in parts])
    mesh = wp.Mesh(
        points=wp.array(positions, dtype=wp.vec3, device=where),
        indices=wp.array(faces.ravel().astype(np.int32), dtype=wp.int32, device=where),
    )
    shape = kernels.Geometry()
    shape.mesh = mesh.id
    shape.normals = wp.array(np.concatenate([part.normals for part in parts]), dtype=wp.vec3, device=where)
    shape.values = wp.array(np.concatenate([part.value for part in parts]), dtype=wp.vec3, device=where)
    shape.faces = wp.array(faces.astype(np.int32), dtype=wp.int32, device=where)
    kinds = np.concatenate([np.full(len(part.faces), kernels.Kind[part.kind.upper()], np.int32) for part in parts])
    edges = np.concatenate([np.full(len(part.faces), int(part.edges), np.int32) for part in parts])
    having = np.cumsum([part.image is not None for part in parts]) - 1
    numbers = np.concatenate([np.full(len(p.faces), max(k, 0), np.int32) for p, k in zip(parts, having, strict=True)])
    shape.pictures = wp.array(numbers, dtype=wp.int32, device=where)
    shape.kinds = wp.array(kinds, dtype=wp.int32, device=where)
    shape.edges = wp.array(edges, dtype=wp.int32, device=where)
    return shape, mesh


def _picture(part: Appearance, where: wp.Device) -> kernels.Picture:
    """Return a part's image with its mip levels."""
    image = np.asarray(part.image)
    sizes = [(image.shape[1], image.shape[0])]
    while part.mipmaps and sizes[-1] != (1, 1):
        width, height = sizes[-1]
        sizes.append((max(width // 2, 1), max(height // 2, 1)))
    counts = [width * height for width, height in sizes]
    offsets = np.cumsum([0, *counts])
    decode = wp.array(to_linear(np.arange(256) / 255.0).astype(np.float32), dtype=wp.float32, device=where)
    texels = wp.empty((int(offsets[-1]), 3), dtype=wp.uint8, device=where)
    wp.copy(texels, wp.array(image.reshape(-1, 3), dtype=wp.uint8, device=where), count=3 * counts[0])
    for level in range(1, len(sizes)):
        wp.launch(
            kernels.halve_texels,
            sizes[level][::-1],
            inputs=[decode, int(offsets[level - 1]), *sizes[level - 1], int(offsets[level]), *sizes[level]],
            outputs=[texels],
            device=where,
        )
    picture = kernels.Picture()
    picture.texels = texels
    picture.decode = decode
    picture.offsets = wp.array(offsets[:-1].astype(np.int32), dtype=wp.int32, device=where)
    picture.widths = wp.array(np.array([width for width, _ in sizes], np.int32), dtype=wp.int32, device=where)
    picture.heights = wp.array(np.array([height for _, height in sizes], np.int32), dtype=wp.int32, device=where)
    picture.levels = len(sizes)
    picture.repeat, picture.repeat_rows = int(part.repeat), int(part.repeat_rows)
    tint = to_linear(np.array(part.tint))
    picture.tint = wp.vec3(*(float(channel) for channel in tint))
    return picture


def _look(job: RenderJob, where: wp.Device) -> kernels.Look:
    lights = job.light.unit_directions()
    look = kernels.Look()
    look.directions = wp.array(
        np.array([way for way, _ in lights], np.float32).reshape(-1, 3), dtype=wp.vec3, device=where
    )
    look.powers = wp.array(np.array([power for _, power in lights], np.float32), dtype=wp.float32, device=where)
    look.sky, look.ground, look.roughness = job.light.sky, job.light.ground, job.light.roughness
    look.unlit = int(job.light.unlit)
    look.edge_color = wp.vec3(*(float(channel) for channel in parse_color(job.wireframe.color)))
    look.edge_width, look.edge_opacity = job.wireframe.width, job.wireframe.opacity
    return look


def _view(shot: Shot, width: int, height: int) -> kernels.View:
    view = kernels.View()
    right, up, backward, origin = (wp.vec3(*(float(x) for x in shot.pose[:3, k])) for k in range(4))
    view.right, view.up, view.backward, view.origin = right, up, backward, origin
    view.perspective = int(shot.perspective)
    view.half_width, view.half_height = shot.half_width, shot.half_height
    view.width, view.height = width, height
    return view
