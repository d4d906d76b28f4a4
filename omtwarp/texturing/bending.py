"""Directions of the texels of an atlas, as they are or moved from the linear map of a mesh to its smooth one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.threads import launch_parts
from omtwarp.mesh.surface import face_neighbours
from omtwarp.texturing import kernels
from omtwarp.texturing.atlas import Atlas
from omtwarp.texturing.baking import GROW, NOBODY, claimed
from omtwarp.texturing.seams import Unwrapped
from omtwarp.texturing.smooth import SmoothCurves

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

PARTS = (3, 8)  # 8 are 45 points in every triangle; more would turn by less than 5 degrees from one to the next


class Look:
    """The directions that the texels of an atlas show.

    Args:
        atlas: the picture's layout.
        where: the device.
    """

    def __init__(self, atlas: Atlas, where: wp.Device):
        offset, gutter = atlas.parameters
        self.atlas, self.where = atlas, where
        self._picture = [atlas.kind, atlas.width, atlas.height, wp.float64(offset), wp.float64(gutter)]
        self._kernel: wp.Kernel = kernels.texel_sample_directions
        self._tables: list[object] = []

    def directions(self, texels: wp.array, samples: int) -> wp.array:
        """Return the directions of texels' samples, a regular grid in each texel, vec3d [N samples²]."""
        count = samples**2
        out = wp.empty(len(texels) * count, dtype=wp.vec3d, device=self.where)
        launch_parts(
            self._kernel,
            len(texels),
            lambda some: (
                [*self._picture, texels[some], samples, *self._tables],
                [out[some.start * count : some.stop * count]],
            ),
            self.where,
        )
        return out


class Bending:
    """A smooth map divided as finely as the texels of an atlas show.

    Args:
        curves: the mesh's smooth map.
        atlas: the picture's layout.

    Attributes:
        atlas, curves: these.
        first: where the points of every triangle begin in ``grid``, shape [F].
        parts: into how many parts its edges are divided, 0 where the map is as good as linear, shape [F].
        grid: the numbers of the points.
        points: unit vectors, shape [N, 3].
    """

    def __init__(self, curves: SmoothCurves, atlas: Atlas):
        least_moved = 0.2  # texels: triangles in which the smooth map stays nearer to the linear one are left linear
        self.curves, self.atlas = curves, atlas
        texel = atlas.texel_angle
        away = np.linalg.norm(curves.sphere - curves.given, axis=1)[curves.faces].max(axis=1)
        bend = curves.bend / texel
        # Divided into n parts, a curve that leaves a straight one by b texels is followed to b / n² texels.
        wanted = np.ceil(np.sqrt(bend / 0.1)).astype(np.int64)
        divided = np.zeros(len(curves.faces), dtype=np.int32)
        divided[(away > least_moved * texel) | (bend > least_moved)] = 1
        least = 1
        for parts in PARTS:
            divided[(divided > 0) & (wanted > least)] = parts
            least = parts
        first = np.zeros(len(divided), dtype=np.int32)
        grids, points, rows, count = [], [curves.sphere], 0, len(curves.sphere)
        sizes = np.unique(divided[divided > 0]).tolist()
        # NumPy lets go of the interpreter in long operations.
        with ThreadPoolExecutor(len(PARTS)) as pool:
            finer = {
                parts: pool.submit(curves.divided, parts, np.flatnonzero(divided == parts))
                for parts in sizes
                if parts > 1
            }
        for parts in sizes:
            which = np.flatnonzero(divided == parts)
            if parts == 1:
                grid = curves.faces[which][:, [0, 2, 1]]  # in the order of a grid's points
            else:
                made = finer[parts].result()
                grid = np.where(made.grid < len(curves.sphere), made.grid, made.grid + count - len(curves.sphere))
                points.append(made.sphere[len(curves.sphere) :])
                count += len(points[-1])
            first[which] = rows + np.arange(len(which)) * grid.shape[1]
            rows += grid.size
            grids.append(grid.ravel())
        self.first, self.parts = first, divided
        self.grid = np.concatenate([*grids, np.zeros(0, dtype=np.int32)])
        self.points = np.concatenate(points)


class BentLook(Look):
    """The directions for the texels of a mesh's picture with which the mesh, linear in triangles, shows its smooth map.

    Args:
        bending: the smooth map, for the picture's layout.
        cut: the mesh unwrapped onto it.
        rotation: turns the function on the sphere, shape [3, 3].
        where: the device.
    """

    def __init__(self, bending: Bending, cut: Unwrapped, rotation: Floats, where: wp.Device):
        hint_block = 8  # texels along the side of a block that has a triangle of its own at which searches begin
        atlas, curves = bending.atlas, bending.curves
        super().__init__(atlas, where)
        faces, given = curves.faces, curves.given @ rotation
        across, down = -(-atlas.width // hint_block), -(-atlas.height // hint_block)
        corner_uv = cut.uv[cut.faces]
        blocks = np.stack([corner_uv[..., 0] * atlas.width, (1.0 - corner_uv[..., 1]) * atlas.height], axis=-1) / float(
            hint_block
        )
        corners = wp.array(np.ascontiguousarray(blocks), dtype=wp.vec2d, device=where)
        part = claimed(corners, across, down, GROW, where)
        # Hint reach: blocks past the borders of charts to which the hints go, which is more than a gutter
        part = np.where(part == NOBODY, claimed(corners, across, down, 1.0, where), part)
        hints = np.where(part == NOBODY, -1, cut.source_face[np.minimum(part, len(cut.source_face) - 1)])
        self._kernel = kernels.bent_sample_directions
        self._tables = [hint_block, across]
        self._tables += [
            wp.array(np.ascontiguousarray(table), dtype=kind, device=where)
            for table, kind in (
                (hints, wp.int32),
                (faces, wp.vec3i),
                (face_neighbours(faces, len(given)), wp.vec3i),
                (given, wp.vec3d),
                (bending.first, wp.int32),
                (bending.parts, wp.int32),
                (bending.grid, wp.int32),
                (bending.points @ rotation, wp.vec3d),
            )
        ]
