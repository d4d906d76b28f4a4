"""Weights on a surface: which parts are to cover more of the sphere than their area."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import Surface


def weighted_surface(surface: Surface, weights: ArrayLike | None) -> Surface:
    """Multiply the area of every triangle by a weight; the result is the measure that maps of the surface keep.

    Args:
        surface: V vertices and F triangles.
        weights: positive and finite, shape [V] or [F]; a triangle takes the mean of its vertices. Only ratios count:
            a part of weight 2 among parts of weight 1 covers twice as much of the sphere for its area. None keeps the
            surface as it is.

    Returns:
        The surface with its measure, of total 4π; see :class:`omtwarp.Surface`.

    Raises:
        OmtwarpError: another number of weights, or one that is not positive and finite.

    Example:
        >>> import numpy as np, omtwarp
        >>> from omtwarp.measures import weighted_surface
        >>> surface = omtwarp.shapes.icosphere(8)
        >>> north = weighted_surface(surface, np.where(surface.vertices[:, 2] > 0, 3.0, 1.0))
        >>> bool(north.vertex_areas[surface.vertices[:, 2] > 0.2].sum() > 2 * 4 * np.pi / 4)
        True
    """
    if weights is None:
        return surface
    try:
        given = np.array(weights, dtype=np.float64)
    except (TypeError, ValueError):
        raise OmtwarpError("the weights are not numbers") from None
    vertices, faces = surface.vertex_count, surface.face_count
    if given.ndim != 1 or len(given) not in (vertices, faces):
        raise OmtwarpError(
            f"the weights have shape {list(given.shape)}: give one for each of {vertices} vertices or {faces} triangles"
        )
    wrong = ~(np.isfinite(given) & (given > 0.0))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise OmtwarpError(
            f"{int(wrong.sum())} weights are not positive and finite, the first is weight {first}: {given[first]:g}"
        )
    given /= given.max()
    per_face = given if len(given) != vertices else given[surface.faces].mean(axis=1)
    return surface.with_areas(surface.face_areas * per_face)
