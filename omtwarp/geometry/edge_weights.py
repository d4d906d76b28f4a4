"""Cotangent weights of a surface's edges, without a matrix around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import wp
from omtwarp.geometry.edge_weight_kernels import edge_weight_kernel
from omtwarp.mesh.surface import Surface


def cotangent_edge_weights(surface: Surface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(cot R + cot S) / 2 of every edge, its weight in the matrix D of section 4.1, shape [E].

    Minus the entries of :func:`omtwarp.geometry.cotangent_laplacian` off the diagonal, in the order of
    :attr:`Surface.edges`.

    Args:
        surface: a closed surface.
        points: positions of its vertices, shape [V, 3].
    """
    corners = surface.edge_corners
    weights = np.empty(len(corners))
    inputs = [
        wp.array(np.ascontiguousarray(points, dtype=np.float64), dtype=wp.vec3d, device="cpu", copy=False),
        wp.array(surface.faces, dtype=wp.vec3i, device="cpu", copy=False),
        wp.array(corners, dtype=wp.vec2i, device="cpu", copy=False),
    ]
    out = wp.array(weights, dtype=wp.float64, device="cpu", copy=False)
    wp.launch(edge_weight_kernel, dim=len(corners), inputs=inputs, outputs=[out], device="cpu")
    return weights


__all__ = ["cotangent_edge_weights"]
