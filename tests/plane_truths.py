"""Meshes in the plane whose maps are known."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay

from omtwarp.mesh.surface import plane_areas


def round_disk(rings: int = 14) -> tuple[np.ndarray, np.ndarray]:
    """Triangulate a unit disk in the plane: points of nearly even density, [V, 2], and faces."""
    points = [np.zeros((1, 2))]
    for ring in range(1, rings + 1):
        turn = 2.0 * np.pi * (np.arange(6 * ring) + 0.5 * (ring % 2)) / (6 * ring)
        points.append(ring / rings * np.stack([np.cos(turn), np.sin(turn)], axis=1))
    flat = np.concatenate(points)
    faces = Delaunay(flat).simplices
    return flat, np.where((plane_areas(flat[faces]) < 0.0)[:, None], faces[:, ::-1], faces)
