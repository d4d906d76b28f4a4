"""What several tests compare maps of the sphere with: rotations, maps known in closed form, an independent judge."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from omtwarp.mesh.surface import Surface

SHARED = Path(__file__).resolve().parents[2] / "shared"


def random_rotation(seed: int) -> np.ndarray:
    """A rotation matrix, the same for the same seed."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def rotated_onto(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Rotate points, without reflection, to bring them nearest to the target (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(points.T @ target)
    return points @ (u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def apart(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the distance of every point from its target after the best rotation, shape [V]."""
    return np.linalg.norm(rotated_onto(points, target) - target, axis=1)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def at_height(z: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """Points of the unit sphere, shape [V, 3]."""
    radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], axis=1)


def height_and_longitude(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return points[:, 2], np.arctan2(points[:, 1], points[:, 0])


def turned(surface: Surface, seed: int = 3) -> Surface:
    """Rotate a surface so that no vertex lies on an axis and none is an axis of symmetry."""
    return Surface(surface.vertices @ random_rotation(seed).T, surface.faces)


def pushed_north(points: np.ndarray, amount: float) -> np.ndarray:
    """A map of the sphere that moves points along meridians: height z to z + amount (1 - z²) / 2, |amount| < 1.

    Seen from its image, the uniform sphere has the axisymmetric density 1 / (1 - amount z); the inverse is the monotone
    rearrangement in latitude.
    """
    z, longitude = height_and_longitude(points)
    return at_height(z + amount * (1.0 - z * z) / 2.0, longitude)


def twisted(points: np.ndarray, amount: float = 1.0) -> np.ndarray:
    """An area-preserving map of the sphere: every parallel turned about the z axis by an angle of its own."""
    z, longitude = height_and_longitude(points)
    return at_height(z, longitude + amount * (0.6 * np.cos(2.0 * z) + 0.5 * z))


def ring_errors(surface: Surface, sphere: np.ndarray) -> np.ndarray:
    """Solid angle around every vertex over three times its mass, less 1, by van Oosterom and Strackee's formula."""
    a, b, c = (sphere[surface.faces[:, k]] for k in range(3))
    dots = 1 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1)
    solid = 2 * np.arctan2((a * np.cross(b, c)).sum(1), dots)
    return surface.sum_to_vertices(solid) / (3 * surface.vertex_areas) - 1


def ring_rms(surface: Surface, sphere: np.ndarray) -> float:
    return float(np.sqrt(surface.vertex_areas @ ring_errors(surface, sphere) ** 2 / (4 * np.pi)))


def mean_edge(surface: Surface, points: np.ndarray) -> float:
    ends = points[surface.edges]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).mean())


def judge():
    """The function ``judge(vertices, sphere, faces)`` that the project's figures are quoted in; skips without it."""
    path = SHARED / "eval" / "distortion.py"
    if not path.exists():
        pytest.skip("the judge is not beside this checkout (../shared/eval/distortion.py)")
    spec = importlib.util.spec_from_file_location("distortion_judge", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.judge
