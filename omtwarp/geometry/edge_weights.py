"""Cotangent weights of a surface's edges as an array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.start import HALF, KERNEL_OPTIONS, wp
from omtwarp.geometry.kernels import corner_cotangent
from omtwarp.mesh.surface import Surface

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def cotangent_at(corner: int, points: wp.array[wp.vec3d], faces: wp.array[wp.vec3i]) -> wp.float64:
    face = faces[corner // 3]
    k = corner % 3
    return corner_cotangent(points[face[k]], points[face[(k + 1) % 3]], points[face[(k + 2) % 3]])


@wp.kernel
def edge_weights_of_corners(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    corners: wp.array[wp.vec2i],
    # Data out:
    weights: wp.array[wp.float64],
):
    e = wp.tid()
    weights[e] = HALF * (cotangent_at(corners[e][0], points, faces) + cotangent_at(corners[e][1], points, faces))


def cotangent_edge_weights(surface: Surface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weight of every edge in the matrix D of section 4.1, (cot R + cot S) / 2, shape [E].

    Minus the entries of :func:`omtwarp.geometry.cotangent_laplacian` off the diagonal, in the order of
    :attr:`Surface.edges`.

    Args:
        surface: a closed surface.
        points: positions of its vertices, shape [V, 3].
    """
    mesh = surface.on("cpu")
    weights = wp.empty(len(mesh.edge_corners), dtype=wp.float64, device="cpu")
    inputs = [vectors(points, weights.device), mesh.faces, mesh.edge_corners]
    wp.launch(edge_weights_of_corners, dim=weights.size, inputs=inputs, outputs=[weights], device="cpu")
    return weights.numpy()
