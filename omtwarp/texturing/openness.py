"""Ambient occlusion by ray casting: the openness of the space in front of a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.texturing.openness_kernels import vertex_openness

RAYS = 24  # from a vertex: openness in steps of 4 %


def face_openness(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the openness of every face, 0 (enclosed) to 1 (open in all directions), shape [F].

    Large meshes are sampled: a face without a sample takes the value of the face before it.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    x = (vertices - low) / (high - low).max()
    p = x[faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0, length, 1.0)
    # Ray budget: about half a second on one CPU core
    step = max(1, int(np.ceil(len(faces) * RAYS / 400_000)))
    chosen = np.arange(0, len(faces), step)
    device = wp.get_device("cpu")
    mesh = wp.Mesh(
        points=wp.array(x.astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(np.ascontiguousarray(faces.ravel(), dtype=np.int32), dtype=wp.int32, device=device),
    )
    # Ray start, of the extent, off the surface: single precision resolves 1e-7 of it
    origins = (p[chosen].mean(axis=1) + 1e-4 * normal[chosen]).astype(np.float32)
    out = wp.zeros(len(chosen), dtype=wp.float32, device=device)
    wp.launch(
        vertex_openness,
        dim=len(chosen),
        inputs=[
            mesh.id,
            wp.array(origins, dtype=wp.vec3, device=device),
            wp.array(normal[chosen].astype(np.float32), dtype=wp.vec3, device=device),
            RAYS,
            out,
        ],
        device=device,
    )
    return np.repeat(out.numpy().astype(np.float64), step)[: len(faces)]
