"""Möbius centring: the conformal map whose area-weighted mean is the centre of the sphere.

Conformal maps to the sphere are unique up to Möbius transformations only. Centring picks one (up to rotation) and
shrinks the range of the density μ. Source: Baden, Crane and Kazhdan, "Möbius Registration" (2018).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.conformal.kernels import apply_ball_inversion, weighted_moments
from omtwarp.device.arrays import vectors
from omtwarp.device.policy import on_device, resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import RowSums, partial_count
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import real_numbers
from omtwarp.mesh.checks import as_unit_vectors

TOLERANCE = 1e-13
MAXIMUM_STEPS = 100
MAX_CENTRE = 0.7  # of the ball's radius: Newton's centre can lie outside the ball, where there is no transformation
MIN_CENTRE = 1e-16  # a step halved to less than this moves nothing in float64
FULL_STEP_MEAN = 1e-10  # below this size of the mean the decrease is lost in round-off: steps are taken whole


def mobius_centring(
    sphere: NDArray[np.float64] | wp.array, masses: NDArray[np.float64], *, device: str | None = "auto"
) -> tuple[NDArray[np.float64], int]:
    """Apply the Möbius transformation that brings the mass-weighted mean of the points to the origin.

    Args:
        sphere: unit vectors, float64, shape [V, 3]; or a Warp array of vec3d on the device.
        masses: non-negative weights, shape [V], any unit; no point may carry half of the mass.
        device: where the per-vertex kernel runs.

    Returns:
        The moved points, shape [V, 3], and the number of Newton steps.

    Raises:
        OmtwarpError: the arrays do not fit together or are not of numbers, or the masses are so concentrated that the
            centre cannot be reached.

    Example:
        >>> import numpy as np, omtwarp
        >>> surface = omtwarp.shapes.icosphere(8)
        >>> sphere = surface.vertices + np.array([0.0, 0.0, 0.3])
        >>> sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)  # crowded in the north
        >>> centred, steps = omtwarp.mobius_centring(sphere, surface.vertex_areas, device="cpu")
        >>> bool(np.linalg.norm(surface.vertex_areas @ centred) < 1e-10)
        True
    """
    if not isinstance(sphere, wp.array):
        sphere = as_unit_vectors(sphere, name="sphere")
    masses = real_numbers(masses, "masses", (len(sphere),))
    if masses.min(initial=0.0) < 0.0 or not masses.sum() > 0.0:
        raise OmtwarpError("masses must not be negative, and not all be zero")
    where = resolve_device(device)
    points = wp.clone(vectors(sphere, where))
    moved = wp.empty_like(points)
    weights = masses / masses.sum()
    means: _Moments = (_DeviceMoments if on_device(where, len(weights)) else _HostMoments)(weights, where)

    mean = means.of(points)
    for step in range(MAXIMUM_STEPS):
        size = np.linalg.norm(mean)
        if size <= TOLERANCE:
            return points.numpy().copy(), step
        # The derivative of the mean with respect to the centre of inversion is 2 (I - sum of w p p').
        jacobian = 2.0 * (np.eye(3) - means.square())
        try:
            centre = -np.linalg.solve(jacobian, mean)
        except np.linalg.LinAlgError:
            break
        length = np.linalg.norm(centre)
        if length > MAX_CENTRE:
            centre *= MAX_CENTRE / length
        while True:
            wp.launch(apply_ball_inversion, dim=len(points), inputs=[points, wp.vec3d(*centre), moved], device=where)
            new_mean = means.of(moved)
            if np.linalg.norm(new_mean) < size or size < FULL_STEP_MEAN:
                break
            centre *= 0.5
            if np.linalg.norm(centre) < MIN_CENTRE:
                raise OmtwarpError("Möbius centring stalled: the conformal map crowds half of the surface into a point")
        if np.linalg.norm(new_mean) >= size:
            return points.numpy().copy(), step  # at round-off
        points, moved = moved, points
        mean = new_mean
    raise OmtwarpError("Möbius centring did not converge: the conformal map crowds half of the surface into a point")


class _Moments(Protocol):
    """Weighted moments of points, weights of sum one."""

    def of(self, points: wp.array) -> NDArray[np.float64]:
        """The mean of points, vec3d, shape [V]."""

    def square(self) -> NDArray[np.float64]:
        """The mean of p p' of the points last given, shape [3, 3]."""


class _HostMoments:
    """By NumPy, in its order."""

    def __init__(self, weights: NDArray[np.float64], device: wp.Device):
        self._weights = weights

    def of(self, points: wp.array) -> NDArray[np.float64]:
        self._values: NDArray[np.float64] = points.numpy()
        return np.asarray(self._weights @ self._values)

    def square(self) -> NDArray[np.float64]:
        return np.asarray(np.einsum("v,vi,vj->ij", self._weights, self._values, self._values))


class _DeviceMoments:
    """By a kernel; a few rows of partial sums come to the host."""

    def __init__(self, weights: NDArray[np.float64], device: wp.Device):
        rows = partial_count(len(weights))
        self._weights = wp.array(weights, dtype=wp.float64, device=device)
        self._partial = wp.empty((rows, 12), dtype=wp.float64, device=device)
        self._sums = RowSums(rows, 12, device)

    def of(self, points: wp.array) -> NDArray[np.float64]:
        inputs = [points, self._weights]
        wp.launch(
            weighted_moments, dim=self._partial.shape, inputs=inputs, outputs=[self._partial], device=points.device
        )
        self._numbers: NDArray[np.float64] = self._sums(self._partial).numpy().sum(axis=0)
        return self._numbers[:3]

    def square(self) -> NDArray[np.float64]:
        return self._numbers[3:].reshape(3, 3)
