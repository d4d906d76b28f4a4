"""Made cortices: surfaces with folds, and smooth warps of them that are known."""

from __future__ import annotations

import numpy as np

from omtwarp.geometry.harmonics import real_harmonics
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface
from omtwarp.resampling import SpherePoints
from omtwarp.spheres import mesh_grid

BALL = shapes.icosphere(16)
EDGE = np.radians(3.9)  # of BALL's triangles
FIRM = {"stiffness": 0.3, "max_strain": 2.0}


def unit(points):
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def folded(ball: Surface, seed: int = 0, highest: int = 14) -> np.ndarray:
    """A star-shaped surface whose folds have all wave lengths down to 360 / 14 degrees, shape [V, 3]."""
    orders = np.floor(np.sqrt(np.arange((highest + 1) ** 2)))
    shares = np.random.default_rng(seed).normal(size=len(orders)) * (orders > 0) / np.sqrt(2.0 * orders + 1.0)
    height = real_harmonics(ball.vertices, highest) @ shares
    return ball.vertices * np.exp(0.15 * np.tanh(height / height.std()))[:, None]


def flowed(points: np.ndarray, degrees: float, seed: int = 1) -> np.ndarray:
    """Points after the flow of a smooth tangent field that has no part of rotation and moves some so far."""
    a, b = np.random.default_rng(seed).normal(size=(2, 3, 3))
    stretch, swirl = (m + m.T - np.trace(m + m.T) / 3.0 * np.eye(3) for m in (a, b))

    def field(x):
        along = 0.5 * x @ stretch + np.cross(x, x @ swirl)
        return along - (along * x).sum(axis=1, keepdims=True) * x

    moved, length = points, 2e-3
    while np.degrees(np.arccos(np.clip((moved * points).sum(axis=1), -1.0, 1.0))).max() < degrees:
        middle = unit(moved + 0.5 * length * field(moved))
        moved = unit(moved + length * field(middle))
    return moved


def points_of(sphere, vertices, ball=BALL):
    return SpherePoints(mesh_grid(sphere, ball.faces), vertices)


def rms(one, other):
    return float(np.sqrt(((one - other) ** 2).sum(axis=1).mean()))
