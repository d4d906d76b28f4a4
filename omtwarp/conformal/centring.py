"""Möbius centring: the conformal map whose area-weighted mean is the centre of the sphere.

Conformal maps to the sphere are unique up to Möbius transformations only. Centring picks one (up to rotation) and
shrinks the range of the density μ. Source: Baden, Crane and Kazhdan, "Möbius Registration" (2018).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import resolve_device, wp
from omtwarp.conformal.kernels import apply_ball_inversion
from omtwarp.errors import OmtwarpError

TOLERANCE = 1e-13
MAXIMUM_STEPS = 100


def mobius_centring(
    sphere: NDArray[np.float64], masses: NDArray[np.float64], *, device: str | None = "auto"
) -> tuple[NDArray[np.float64], int]:
    """Apply the Möbius transformation that brings the mass-weighted mean of the points to the origin.

    Args:
        sphere: unit vectors, float64, shape [V, 3].
        masses: non-negative weights, shape [V], any unit; no point may carry half of the mass.
        device: where the per-vertex kernel runs.

    Returns:
        The moved points, shape [V, 3], and the number of Newton steps.

    Raises:
        OmtwarpError: the masses are so concentrated that the centre cannot be reached.
    """
    where = resolve_device(device)
    points = wp.array(np.ascontiguousarray(sphere), dtype=wp.vec3d, device=where)
    moved = wp.empty_like(points)
    weights = masses / masses.sum()

    def mean_of(array: wp.array) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        values = array.numpy()
        return weights @ values, values

    mean, values = mean_of(points)
    for step in range(MAXIMUM_STEPS):
        size = np.linalg.norm(mean)
        if size <= TOLERANCE:
            return values.copy(), step
        # The derivative of the mean with respect to the centre of inversion is 2 (I - sum of w p p').
        jacobian = 2.0 * (np.eye(3) - np.einsum("v,vi,vj->ij", weights, values, values))
        try:
            centre = -np.linalg.solve(jacobian, mean)
        except np.linalg.LinAlgError:
            break
        length = np.linalg.norm(centre)
        if length > 0.7:  # stay inside the ball, where the transformation is one
            centre *= 0.7 / length
        while True:
            wp.launch(apply_ball_inversion, dim=len(points), inputs=[points, wp.vec3d(*centre), moved], device=where)
            new_mean, new_values = mean_of(moved)
            if np.linalg.norm(new_mean) < size or size < 1e-10:
                break
            centre *= 0.5
            if np.linalg.norm(centre) < 1e-16:
                raise OmtwarpError("Möbius centring stalled: the conformal map crowds half of the surface into a point")
        if np.linalg.norm(new_mean) >= size:
            return values.copy(), step  # at round-off
        points, moved = moved, points
        mean, values = new_mean, new_values
    raise OmtwarpError("Möbius centring did not converge: the conformal map crowds half of the surface into a point")
