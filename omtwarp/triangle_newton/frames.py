"""Frames of the triangles of a surface laid flat, what every energy of a map is measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.surface import Surface


def triangle_frames(
    surface: Surface, thinnest: float = 0.0, triangles: NDArray[np.integer] | None = None
) -> NDArray[np.float64]:
    """Frames (1/l, -x/(l h), 1/h) of the scaled triangles, see :mod:`omtwarp.triangle_newton.triangle`.

    Args:
        surface: the surface; its area is taken as 4π. With another measure than area, every triangle is scaled to the
            area that it is to have.
        thinnest: triangles with h below this many times their longest edge are made this thick, so that their shape
            asks for something within reach; 0 keeps every triangle as it is.
        triangles: indices of the triangles, shape [T]; all of the surface by default.

    Returns:
        float64, shape [T, 3].
    """
    chosen = slice(None) if triangles is None else triangles
    corner = surface.scaled_vertices[surface.faces[chosen]]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    base = np.linalg.norm(first, axis=1)
    base = np.maximum(base, np.finfo(float).tiny ** 0.25)
    unit = first / base[:, None]
    foot = np.einsum("ij,ij->i", second, unit)
    height = np.linalg.norm(second - foot[:, None] * unit, axis=1)
    longest = np.maximum(base, np.linalg.norm(second, axis=1))
    height = np.maximum(height, max(thinnest, 1e-14) * longest)
    frames = np.stack([1.0 / base, -foot / (base * height), 1.0 / height], axis=1)
    if surface.weighted:  # frames are lengths inverted
        frames *= np.sqrt(surface.own_areas[chosen] / surface.face_areas[chosen])[:, None]
    return frames
