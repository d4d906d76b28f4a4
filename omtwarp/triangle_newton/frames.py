"""Frames of the triangles of a surface laid flat, what every energy of a map is measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.surface import Surface


def triangle_frames(
    surface: Surface, thinnest: float = 0.0, faces: NDArray[np.int32] | None = None
) -> NDArray[np.float64]:
    """Frames (1/l, -x/(l h), 1/h) of the scaled triangles, see :mod:`omtwarp.triangle_newton.triangle`.

    Args:
        surface: the surface; its area is taken as 4π.
        thinnest: triangles with h below this many times their longest edge are made this thick, so that their shape
            asks for something within reach; 0 keeps every triangle as it is.
        faces: the triangles, shape [F, 3]; all of the surface by default.

    Returns:
        float64, shape [F, 3].
    """
    corner = surface.scaled_vertices[surface.faces if faces is None else faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    base = np.linalg.norm(first, axis=1)
    base = np.maximum(base, np.finfo(float).tiny ** 0.25)
    unit = first / base[:, None]
    foot = np.einsum("ij,ij->i", second, unit)
    height = np.linalg.norm(second - foot[:, None] * unit, axis=1)
    longest = np.maximum(base, np.linalg.norm(second, axis=1))
    height = np.maximum(height, max(thinnest, 1e-14) * longest)
    return np.stack([1.0 / base, -foot / (base * height), 1.0 / height], axis=1)
