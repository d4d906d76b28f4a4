"""A mesh with materials, and texture coordinates at the corners of its triangles, that can be written to files."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from omtwarp.materials.base import PaintedArrays
from omtwarp.materials.export import export
from omtwarp.options import TextureFormat


@dataclass(frozen=True, eq=False, repr=False)
class PaintedMesh(PaintedArrays):
    """A triangle mesh with its texture coordinates and materials.

    Attributes:
        vertices: float64, shape [V, 3]; not doubled along seams.
        faces: int32, shape [F, 3].
        uv: texture coordinates of every corner, float64, shape [F, 3, 2], v up; NaN where a triangle has none, None
            where no triangle has any. They may leave [0, 1]: the picture repeats.
        materials: at least one.
        face_material: number of the material of every triangle, int32, shape [F].
        vertex_colors: sRGB and opacity at the vertices, uint8, shape [V, 4]; None where the file has none.
        notes: decisions made while reading, in words.
        wraps_rows: whether pictures repeat upwards; they always repeat to the right.
        source_files: files that an export must not replace.

    Raises:
        OmtwarpError: the arrays do not belong together.

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(4)
        >>> halves = (ball.vertices[ball.faces].mean(axis=1)[:, 2] > 0).astype(int)
        >>> red, blue = omtwarp.Material("red", (1, 0, 0, 1)), omtwarp.Material("blue", (0, 0, 1, 1))
        >>> omtwarp.PaintedMesh(ball.vertices, ball.faces, materials=(red, blue), face_material=halves)
        PaintedMesh(162 vertices, 320 faces without texture coordinates, 2 materials)
    """

    def export(
        self,
        path: str | os.PathLike[str],
        *,
        keep: Iterable[Path | None] = (),
        texture_format: str = TextureFormat.PNG,
    ) -> list[Path]:
        """Write the mesh with its materials.

        ``.glb`` holds a primitive for every material, its pictures embedded; ``.obj`` is written with its ``.mtl`` and
        a ``.png`` for every picture in the same folder.

        Args:
            path: the file to write.
            keep: more files that must not be replaced.
            texture_format: ``png``, or ``webp`` in a ``.glb``: the same texels in fewer bytes, for viewers that
                read the extension ``EXT_texture_webp``.

        Returns:
            The files written, the named one last.

        Raises:
            OmtwarpError: another suffix, or a place that cannot be written to. No file is left half written.
        """
        return export(self, path, keep=(*keep, *self.source_files), texture_format=texture_format)


__all__ = ["PaintedMesh"]
