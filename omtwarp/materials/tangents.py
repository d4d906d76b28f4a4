"""Tangents of a surface along its texture coordinates, as normal maps are read with them."""

from __future__ import annotations

import numpy as np

from omtwarp.materials.base import Floats, Ints
from omtwarp.mesh.arrays import ROUND_OFF, TINY

# Of a normal's x: another axis helps where it is larger. Below 1/sqrt(2) an axis is 45 degrees or more from the normal.
MOST_ALONG = 0.7


def corner_tangents(vertices: Floats, faces: Ints, uv: Floats, normals: Floats) -> Floats:
    """Return the unit tangents of corners in the direction of growing u, with glTF's sign of the bitangent.

    The tangents of triangles (Lengyel, "Foundations of Game Engine Development 2", 2019, section 7.5) are summed over
    the triangles around a vertex that meet there with the same coordinates and orientation, and made orthogonal to the
    normal. The bitangent is ``sign * cross(normal, tangent)``, along growing v (upwards in the picture).

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        uv: of the corners, v up, shape [F, 3, 2].
        normals: unit, of the vertices, shape [V, 3].

    Returns:
        Shape [F, 3, 4]: the tangent and the sign, 1 or -1 (mirrored coordinates).
    """
    edge_1, edge_2 = vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]]
    du_1, dv_1 = (uv[:, 1] - uv[:, 0]).T
    du_2, dv_2 = (uv[:, 2] - uv[:, 0]).T
    area = du_1 * dv_2 - du_2 * dv_1
    sign = np.where(area < 0, -1.0, 1.0)
    # Weighted by the triangle's area in the picture.
    tangent = (edge_1 * dv_2[:, None] - edge_2 * dv_1[:, None]) * sign[:, None]
    rows = np.concatenate([faces.reshape(-1, 1), uv.reshape(-1, 2), np.repeat(sign, 3)[:, None]], axis=1)
    _, group = np.unique(rows, axis=0, return_inverse=True)
    group = group.reshape(-1)
    each = np.repeat(tangent, 3, axis=0)
    total = np.stack([np.bincount(group, each[:, k]) for k in range(3)], axis=1)[group]
    normal = normals[faces.ravel()]
    flat = total - normal * (total * normal).sum(axis=1, keepdims=True)
    length = np.linalg.norm(flat, axis=1, keepdims=True)
    # Where triangles have no area in the picture any tangent will do.
    helper = np.where(np.abs(normal[:, :1]) < MOST_ALONG, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    other = np.cross(normal, helper)
    other /= np.maximum(np.linalg.norm(other, axis=1, keepdims=True), TINY)
    degenerate = length <= ROUND_OFF * max(float(length.max(initial=0.0)), TINY)
    unit = np.where(degenerate, other, flat / np.maximum(length, TINY))
    return np.concatenate([unit, np.repeat(sign, 3)[:, None]], axis=1).reshape(-1, 3, 4)


__all__ = ["corner_tangents"]
