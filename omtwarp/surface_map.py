"""Maps of surfaces that need not be closed, connected or of genus 0, and their files."""

from __future__ import annotations

import os
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import staged
from omtwarp.inputs import open_input, read_arrays
from omtwarp.limits import LARGEST_MESH_FILE
from omtwarp.mesh.surface import triangle_areas
from omtwarp.metrics.distortion import Distortion, distortion
from omtwarp.result import MapResult

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceMap(MapResult):
    """The map of a surface with holes, handles or several parts to the sphere, or to a part of it.

    Attributes that a :class:`~omtwarp.result.MapResult` has too are of the surface as it is mapped: the input's faces,
    in their order, but where an edge had to be split or a handle to be cut. ``report["certificate"]`` is of the closed
    surface that was mapped, filled, cut or doubled.

    Attributes:
        domain: ``sphere``, ``hemisphere``, ``disk``, ``cap``, or ``several`` where parts differ; for a disk, ``sphere``
            is the hemisphere it came from.
        disk: the map to the unit disk, float64, shape [V, 2], where that is the domain.
        vertex_origin: the input's vertex that each vertex is or is a copy of, -1 where one splits an edge, shape [V].
        face_origin: the input's face that each face is a part of, shape [F].
        split_edges: the two vertices that each vertex of origin -1 lies halfway between, in their order, shape [K, 2].
        part: the part of the surface, each on a sphere of its own, that each face belongs to, shape [F].
        loops: vertices of the boundary loops that were filled, one loop after the other, shape [N].
        loop_ends: where each loop ends in ``loops``, shape [L].
        loop_pairs: the two sides of each cut, as numbers of loops, shape [G, 2].
        filled_vertices: vertices of the surface as filled, those of the map first, shape [W, 3].
        filled_faces: faces of the surface as filled, those of the map first, shape [H, 3].
        filled_sphere: the map of ``filled_vertices``, shape [W, 3].
        filled_loop: the loop that each face of ``filled_faces`` fills, -1 for the surface's own, shape [H].
    """

    domain: str = "sphere"
    disk: Array | None = None
    split_edges: NDArray[np.int64] | None = None
    part: NDArray[np.int64] | None = None
    loops: NDArray[np.int64] | None = None
    loop_ends: NDArray[np.int64] | None = None
    loop_pairs: NDArray[np.int64] | None = None
    filled_vertices: Array | None = None
    filled_faces: NDArray[np.int64] | None = None
    filled_sphere: Array | None = None
    filled_loop: NDArray[np.int64] | None = None

    def __repr__(self) -> str:
        size = f"{len(self.vertices)} vertices, {len(self.faces)} faces"
        return f"SurfaceMap({self.domain}, {size}, {self.distortion()})"

    def distortion(self, stage: str = "sphere") -> Distortion:
        """Distortion of the map, or of a stage: ``conformal``, ``moser`` or ``transported``.

        Areas are compared within each part, every part scaled to the area of its image, and all parts count alike.

        Raises:
            OmtwarpError: the stage was not run.
        """
        if self.part is None:
            return super().distortion(stage)
        points = getattr(self, stage, None) if stage in ("sphere", "conformal", "moser", "transported") else None
        if points is None:
            raise OmtwarpError(f"this map has no stage '{stage}'")
        on_surface, on_sphere = triangle_areas(self.vertices, self.faces), triangle_areas(points, self.faces)
        ratio = np.bincount(self.part, on_sphere) / np.bincount(self.part, on_surface)
        scale = np.ones(len(self.vertices))
        scale[self.faces] = np.sqrt(ratio[self.part])[:, None]
        return distortion(self.vertices * scale[:, None], self.faces, points)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map as ``.npz``: what a :class:`MapResult` writes, and the arrays and the domain of this class.

        Raises:
            OmtwarpError: the file cannot be written; nothing is left of it.
        """
        target = Path(path)
        with staged(target) as file:
            super().save(file)
            with np.load(file) as stored:
                arrays = dict(stored)
            arrays["domain"] = np.array(self.domain)
            arrays |= {name: getattr(self, name) for name in _ARRAYS if getattr(self, name) is not None}
            with open(file, "wb") as stream:  # given a name, NumPy would add a suffix to it
                np.savez(stream, **arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SurfaceMap:
        """Read a map written by :meth:`save`; one of a closed surface has the domain ``sphere``.

        Raises:
            OmtwarpError: the file is missing, or is no map.
        """
        base = MapResult.load(path)
        with open_input(Path(path), LARGEST_MESH_FILE, "map") as stream:
            arrays: dict[str, Any] = read_arrays(stream, (*_ARRAYS, "domain"))
        domain = str(arrays.pop("domain", "sphere"))
        for name, array in arrays.items():
            numbers = array.dtype.kind in ("f" if name in _FLOATS else "iu")
            if not numbers or array.ndim > 2:
                raise OmtwarpError(f"'{path}' is not a map: '{name}' is not an array of numbers")
        known = {item.name: getattr(base, item.name) for item in fields(MapResult)}
        return cls(**known, domain=domain, **arrays)


_FLOATS = ("disk", "filled_vertices", "filled_sphere")
_ARRAYS = (
    *_FLOATS,
    "split_edges",
    "part",
    "loops",
    "loop_ends",
    "loop_pairs",
    "filled_faces",
    "filled_loop",
)

__all__ = ["SurfaceMap"]
