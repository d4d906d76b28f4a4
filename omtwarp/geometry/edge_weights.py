"""Cotangent weights of a surface's edges as an array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.start import wp
from omtwarp.geometry.edge_weight_kernels import edge_weights_of_corners
from omtwarp.mesh.surface import Surface


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
