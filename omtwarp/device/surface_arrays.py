"""A surface's arrays where kernels run, for all stages alike."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from omtwarp.device.start import wp

if TYPE_CHECKING:
    from omtwarp.mesh.surface import Surface


class SurfaceArrays:
    """Arrays of a surface on a device; kernels read them. Made by :meth:`omtwarp.mesh.surface.Surface.on`.

    Each is sent when it is first asked for, and stays while the surface does. On the CPU they are the surface's own
    arrays, without a copy.

    Args:
        surface: the surface, V vertices, F faces and E edges.
        device: a Warp device.
        sent: what is there already, by name; more is added.
    """

    def __init__(self, surface: Surface, device: wp.Device, sent: dict[str, wp.array]):
        self._surface, self._device, self._sent = surface, device, sent

    def _array(self, name: str, dtype: Any, part: int | None = None) -> wp.array:
        key = name if part is None else f"{name} {part}"
        if key not in self._sent:
            values = getattr(self._surface, name)
            values = np.ascontiguousarray(values if part is None else values[part])
            self._sent[key] = wp.array(values, dtype=dtype, device=self._device, copy=False)
        return self._sent[key]

    @property
    def vertices(self) -> wp.array:
        """Positions, vec3d, shape [V], in the units of the input."""
        return self._array("vertices", wp.vec3d)

    @property
    def faces(self) -> wp.array:
        """Corners of the triangles, vec3i, shape [F]."""
        return self._array("faces", wp.vec3i)

    @property
    def face_areas(self) -> wp.array:
        """Areas of the scaled triangles, float64, shape [F]."""
        return self._array("face_areas", wp.float64)

    @property
    def vertex_areas(self) -> wp.array:
        """A third of the areas around every vertex, float64, shape [V]."""
        return self._array("vertex_areas", wp.float64)

    @property
    def face_neighbours(self) -> wp.array:
        """The faces across the edges of every face, vec3i, shape [F]."""
        return self._array("face_neighbours", wp.vec3i)

    @property
    def vertex_corners(self) -> list[wp.array]:
        """Corners around every vertex as compressed rows, int32: offsets, shape [V + 1], and corners, shape [3F]."""
        return [self._array("vertex_corners", wp.int32, part) for part in range(2)]

    @property
    def edges(self) -> wp.array:
        """Every edge once, vec2i, shape [E]."""
        return self._array("edges", wp.vec2i)

    @property
    def edge_corners(self) -> wp.array:
        """The corners opposite to every edge, vec2i, shape [E]."""
        return self._array("edge_corners", wp.vec2i)


__all__ = ["SurfaceArrays"]
