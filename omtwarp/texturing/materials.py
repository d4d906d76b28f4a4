"""Materials of meshes, in the terms of glTF 2.0, and the tangents that their normal maps are read with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from omtwarp.colors import to_linear
from omtwarp.mesh.arrays import ROUND_OFF, TINY, Bytes, Floats, Ints

WHITE = (1.0, 1.0, 1.0, 1.0)  # sRGB and opacity: the factor that does not change a picture


def linear(color: Floats) -> Floats:
    """Convert colours from sRGB to linear light (IEC 61966-2-1), shape [..., 4]; their opacity does not change."""
    return np.concatenate([to_linear(color[..., :3]), color[..., 3:]], axis=-1)


@dataclass(frozen=True, eq=False)
class Material:
    """How the triangles of one material look, in the terms of glTF 2.0.

    Attributes:
        name: as the file calls it.
        color: red, green, blue (sRGB) and opacity, from 0 to 1; a factor on the picture where there is one.
        picture: colours, uint8 sRGB, shape [H, W, 3] or [H, W, 4], row 0 on top; None for one colour.
        metallic: 0 for a dielectric, 1 for a metal.
        roughness: 0 for a mirror, 1 for a matt surface.
        emission: factor on the light that the material sends out, linear red, green and blue.
        two_sided: whether the triangles are seen from behind.
        normal_picture: tangent-space normals as glTF's ``normalTexture`` holds them.
        occlusion_picture: ambient occlusion in red, as glTF's ``occlusionTexture`` holds it; 255 is open.
        roughness_picture: roughness in green and metalness in blue, glTF's ``metallicRoughnessTexture``.
        emission_picture: the light that is sent out, glTF's ``emissiveTexture``.
        own_tangents: whether ``normal_picture`` belongs to the tangents that a file is written with, rather than to
            those that a reader computes.
        phong: statements of an OBJ library that glTF has no terms for, by their names, such as ``("Ns", (250.0,))``;
            an OBJ is written with them again.

    Example:
        >>> import omtwarp
        >>> omtwarp.Material("glass", color=(0.9, 1.0, 1.0, 0.3)).opaque
        False
    """

    name: str = "material"
    color: tuple[float, float, float, float] = WHITE
    picture: Bytes | None = None
    metallic: float = 0.0
    roughness: float = 0.65
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    two_sided: bool = False
    normal_picture: Bytes | None = None
    occlusion_picture: Bytes | None = None
    roughness_picture: Bytes | None = None
    emission_picture: Bytes | None = None
    own_tangents: bool = False
    phong: tuple[tuple[str, tuple[float, ...]], ...] = ()

    @property
    def plain(self) -> bool:
        """Whether the material has no picture of any kind."""
        pictures = (self.picture, self.normal_picture, self.occlusion_picture)
        return all(one is None for one in (*pictures, self.roughness_picture, self.emission_picture))

    @property
    def opaque(self) -> bool:
        """Whether the material is opaque."""
        transparent = self.picture is not None and self.picture.shape[2] == 4 and self.picture[..., 3].min() < 255
        return self.color[3] >= 1.0 and not transparent


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
    # Of a normal's x: another axis helps where it is larger. Below 1/sqrt(2) an axis is 45 degrees or more from the
    # normal.
    helper = np.where(np.abs(normal[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    other = np.cross(normal, helper)
    other /= np.maximum(np.linalg.norm(other, axis=1, keepdims=True), TINY)
    degenerate = length <= ROUND_OFF * max(float(length.max(initial=0.0)), TINY)
    unit = np.where(degenerate, other, flat / np.maximum(length, TINY))
    return np.concatenate([unit, np.repeat(sign, 3)[:, None]], axis=1).reshape(-1, 3, 4)
