"""What a texture shows on the two sides of every edge of a surface."""

from __future__ import annotations

from typing import Any

import numpy as np

SHARES = (0.2, 0.5, 0.8)  # of an edge, where colours are compared


def shown(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours at texture coordinates, between texels linear, the image repeating both ways, shape [N, 3]."""
    height, width = image.shape[:2]
    place = np.stack([(1.0 - uv[:, 1]) * height, uv[:, 0] * width], axis=1) - 0.5
    low = np.floor(place).astype(np.int64)
    share = place - low
    total = np.zeros((len(uv), 3))
    for i in (0, 1):
        for j in (0, 1):
            weight = np.abs(1 - i - share[:, 0]) * np.abs(1 - j - share[:, 1])
            total += weight[:, None] * image[(low[:, 0] + i) % height, (low[:, 1] + j) % width, :3]
    return total


def jumps_across_edges(textured: Any) -> tuple[np.ndarray, np.ndarray]:
    """Where edges lie in space, and the largest difference of colour between their two sides.

    Args:
        textured: ``vertices``, ``faces``, ``uv`` and ``image``; edges are known by the places of their ends.

    Returns:
        The ends, shape [E, 2, 3], and the differences of 255, shape [E], of edges that two triangles have.
    """
    points, uv_of = textured.vertices[textured.faces].reshape(-1, 3), textured.uv.reshape(-1, 2)
    faces = np.arange(len(points)).reshape(-1, 3)
    _, name = np.unique(np.round(points / np.ptp(points, axis=0).max(), 9), axis=0, return_inverse=True)
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    turned = name[tail] > name[head]
    one, other = np.where(turned, head, tail), np.where(turned, tail, head)
    order = np.lexsort((name[other], name[one]))
    one, other = one[order], other[order]
    keys = np.stack([name[one], name[other]], axis=1)
    _, first, count = np.unique(keys, axis=0, return_index=True, return_counts=True)
    first = first[count == 2]
    worst = np.zeros(len(first))
    for share in SHARES:
        uv = (1.0 - share) * uv_of[one] + share * uv_of[other]
        colours = shown(textured.image, uv)
        worst = np.maximum(worst, np.abs(colours[first] - colours[first + 1]).max(axis=1))
    return points[np.stack([one[first], other[first]], axis=1)], worst
