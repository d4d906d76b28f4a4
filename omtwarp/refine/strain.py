"""A bound on how far triangles are stretched, which minimisation keeps by a barrier."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.threads import Arguments, cut, launch_parts
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.refine.kernels import gather_tangent
from omtwarp.refine.strain_kernels import barrier_gradient, barrier_hessian, strain_terms

Octaves = TypeVar("Octaves", float, NDArray[np.float64])


def strain_limit(octaves: Octaves) -> Octaves:
    """Return the limit of w = (R + 1/R - 2) + (D + 1/D - 2) that keeps ratios of areas and stretches within 2^±octaves.

    Args:
        octaves: bound on |log2 D| and on log2 R, positive.

    Example:
        >>> strain_limit(1.0)
        0.5
    """
    return 2.0**octaves + 2.0**-octaves - 2.0


class StrainBarrier:
    """The mean over the triangles of w² / (limit - w), weighted by original area; infinite where one reaches the limit.

    Args:
        faces: corners of the triangles, vec3i, shape [F], on the host as all that follows.
        frames: see :func:`omtwarp.solvers.triangle_newton.frames.triangle_frames`, vec3d, shape [F].
        areas: on the original surface, float64, shape [F].
        rows: corners of the triangles around the vertices: offsets and corners, int32.
        limit: see :func:`strain_limit`.
    """

    def __init__(self, faces: wp.array, frames: wp.array, areas: wp.array, rows: list[wp.array], limit: float):
        self._faces, self._frames, self._areas, self._rows = faces, frames, areas, rows
        self._limit, self._count, self._device = limit, len(faces), faces.device

    def value(self, points: wp.array) -> float:
        """Return the barrier at a map, vec3d [V]."""
        strains = wp.empty(self._count, dtype=wp.float64, device=self._device)

        def arguments(part: slice) -> Arguments:
            return [points, cut(self._faces, part), cut(self._frames, part)], [cut(strains, part)]

        launch_parts(strain_terms, self._count, arguments, self._device)
        found = strains.numpy()
        if not found.max() < self._limit:
            return float("inf")
        return float(self._areas.numpy() @ (found**2 / (self._limit - found))) / SPHERE_AREA

    def gradient(self, points: wp.array) -> NDArray[np.float64]:
        """Return the gradient by the vertices, tangent to the sphere, shape [V, 3]."""
        corners = wp.empty(3 * self._count, dtype=wp.vec3d, device=self._device)

        def arguments(part: slice) -> Arguments:
            own = [cut(array, part) for array in (self._faces, self._frames, self._areas)]
            return [points, *own, wp.float64(self._limit)], [corners[3 * part.start : 3 * part.stop]]

        launch_parts(barrier_gradient, self._count, arguments, self._device)
        gradient = wp.empty(self._rows[0].size - 1, dtype=wp.vec3d, device=self._device)
        inputs = [points, *self._rows, corners, wp.float64(SPHERE_AREA), 0]
        wp.launch(gather_tangent, dim=gradient.size, inputs=inputs, outputs=[gradient], device=self._device)
        return np.asarray(gradient.numpy())

    def hessian(self, points: wp.array) -> NDArray[np.float64]:
        """Return the Hessian of every triangle, shape [F, 21].

        It is laid out as by :meth:`omtwarp.refine.energy.DistortionEnergy.hessian`.
        """
        blocks = wp.empty((self._count, 21), dtype=wp.float64, device=self._device)

        def arguments(part: slice) -> Arguments:
            own = [cut(array, part) for array in (self._faces, self._frames, self._areas)]
            return [points, *own, wp.float64(self._limit), wp.float64(SPHERE_AREA)], [cut(blocks, part)]

        launch_parts(barrier_hessian, self._count, arguments, self._device)
        return np.asarray(blocks.numpy())


__all__ = ["StrainBarrier", "strain_limit"]
