"""How open the space in front of a surface is: ambient occlusion by ray casting."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import wp

wp.set_module_options({"enable_backward": False})

RAYS = 24
RAY_BUDGET = 400_000  # about half a second on one CPU core


@wp.kernel
def openness_kernel(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    rays: int,
    openness: wp.array(dtype=wp.float32),
):
    """Part of the cosine-weighted rays from a point that leave the surface behind them."""
    i = wp.tid()
    n = normals[i]
    helper = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(n[0]) > 0.7:
        helper = wp.vec3(0.0, 1.0, 0.0)
    t = wp.normalize(wp.cross(n, helper))
    b = wp.cross(n, t)
    free = int(0)
    for k in range(rays):
        # A spiral over the disc lifted to the hemisphere: cosine-weighted, and the same for every run.
        r = wp.sqrt((float(k) + 0.5) / float(rays))
        angle = float(k) * 2.3999632 + float(i) * 0.7548777
        up = wp.sqrt(wp.max(1.0 - r * r, 0.0))
        direction = t * (r * wp.cos(angle)) + b * (r * wp.sin(angle)) + n * up
        query = wp.mesh_query_ray(mesh, origins[i], direction, 4.0)
        if not query.result:
            free += 1
    openness[i] = float(free) / float(rays)


def face_openness(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Openness of every face, 0 (closed in) to 1 (nothing in sight), shape [F].

    Large meshes are sampled: a face that is not takes the value of the one before it in the mesh.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    x = (vertices - low) / (high - low).max()
    p = x[faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0, length, 1.0)
    step = max(1, int(np.ceil(len(faces) * RAYS / RAY_BUDGET)))
    chosen = np.arange(0, len(faces), step)
    device = wp.get_device("cpu")
    mesh = wp.Mesh(
        points=wp.array(x.astype(np.float32), dtype=wp.vec3, device=device),
        indices=wp.array(np.ascontiguousarray(faces.ravel(), dtype=np.int32), dtype=wp.int32, device=device),
    )
    origins = (p[chosen].mean(axis=1) + 1e-4 * normal[chosen]).astype(np.float32)
    out = wp.zeros(len(chosen), dtype=wp.float32, device=device)
    wp.launch(
        openness_kernel,
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
