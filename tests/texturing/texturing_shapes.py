"""Surfaces with maps to the sphere known in closed form, for the tests of textures."""

import numpy as np
import trimesh

AXES = np.array([1.0, 0.8, 1.25])


def rotation(seed):
    """A random rotation matrix."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def unit(vectors):
    """Vectors of length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def stretch_latitude(directions, strength=0.45):
    """A smooth bijection of the sphere that moves z and so changes areas: z -> z + strength (1 - z²) / 2."""
    x, y, z = directions.T
    moved = z + strength * (1.0 - z * z) / 2.0
    scale = np.sqrt(np.maximum(1.0 - moved**2, 0.0) / np.maximum(1.0 - z * z, 1e-300))
    return unit(np.column_stack([x * scale, y * scale, moved]))


def ellipsoid(subdivisions=3, seed=None, strength=0.45):
    """An ellipsoid and a map to the sphere that distorts areas: (vertices, faces, sphere)."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    base = unit(np.asarray(mesh.vertices))
    turn = np.eye(3) if seed is None else rotation(seed)
    return base * AXES, np.asarray(mesh.faces, dtype=np.int32), stretch_latitude(base @ turn, strength)


def texel_directions(width: int, height: int) -> np.ndarray:
    """Unit vectors of the texel centres of an equirectangular image, shape [height, width, 3], north row first."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2.0 * np.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height)[:, None] * np.pi
    z = np.broadcast_to(np.sin(latitude), (height, width))
    return np.stack([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), z], axis=2)
