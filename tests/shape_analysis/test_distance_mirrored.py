"""Distances of shapes from their mirror images."""

from __future__ import annotations

import omtwarp
from omtwarp import shapes
from omtwarp.shape_analysis import shape_distance


def test_a_mirror_image_is_apart_until_it_is_mirrored_back():
    """Rotations do not take a shape without planes of symmetry to its mirror image; mirroring it does."""
    ball = shapes.icosphere(6)
    vertices = ball.vertices * [1.0, 1.3, 0.8]
    vertices = vertices + 0.3 * vertices[:, [1, 2, 0]] * abs(vertices)
    mirror, back = [-1.0, 1.0, 1.0], slice(None, None, -1)
    image = (vertices * mirror, ball.faces[:, back])
    restored = (image[0] * mirror, image[1][:, back])
    maps = [
        omtwarp.map_to_sphere(mesh, until="moser", device="cpu") for mesh in ((vertices, ball.faces), image, restored)
    ]
    distances = [shape_distance(maps[0], other, degree=5, device="cpu").coefficients for other in maps[1:]]
    assert distances[1] < 1e-6 < 0.02 < distances[0]
