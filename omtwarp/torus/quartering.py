"""Maps to a flat torus of a mesh whose triangles are cut into four."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.quarter import PARTS, QuarteredSurface
from omtwarp.torus.harmonic import quantised

Floats = NDArray[np.float64]


def quartered_torus(
    quartered: QuarteredSurface, faces: NDArray[np.integer], wraps: NDArray[np.int64], *maps: Floats
) -> tuple[NDArray[np.int64], list[Floats]]:
    """Extend maps to a torus to the quartered mesh, with new vertices at the midpoints of the edges' images.

    Args:
        quartered: the mesh's triangles in four parts each.
        faces: those of the mesh itself, shape [F, 3].
        wraps: at the corners of those, shape [F, 3, 2].
        maps: coordinates of the mesh's vertices, shape [V, 2] each.

    Returns:
        The wraps at the corners of the parts, shape [4 F, 3, 2], and the coordinates of all vertices.
    """
    count, edges = len(maps[0]), len(quartered.ends)
    # A middle has the wraps of the first end of its edge.
    first = quartered.ends[quartered.middles - count, 0]
    own = np.where((faces == first)[..., None], wraps, np.roll(wraps, -1, axis=1))
    step = np.zeros((edges, 2), dtype=np.int64)
    after = np.roll(wraps, -1, axis=1) - wraps
    step[quartered.middles - count] = np.where((faces == first)[..., None], after, -after)
    parts = np.empty((len(faces), PARTS, 3, 2), dtype=np.int64)
    for k in range(3):
        parts[:, k] = np.stack([wraps[:, k], own[:, k], own[:, k - 1]], axis=1)
    parts[:, 3] = own
    found = []
    for places in maps:
        one, other = places[quartered.ends[:, 0]], places[quartered.ends[:, 1]]
        found.append(np.concatenate([places, quantised(0.5 * (one + other + step))]))
    return parts.reshape(-1, 3, 2), found


__all__ = ["quartered_torus"]
