"""Newton steps of the distortion energy, corrected between factorisations by limited-memory BFGS.

Nocedal and Wright, "Numerical Optimization", algorithm 7.4, with the Newton matrix as initial Hessian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.kernels import newton_decrements
from omtwarp.solvers.triangle_newton.motion_kernels import from_tangent, to_tangent
from omtwarp.solvers.triangle_newton.newton import NewtonMatrix

MAX_PAIRS = 8  # (s, y) that limited-memory BFGS keeps; 3 to 20 are usual (Nocedal and Wright 2006, chapter 7)
MIN_CURVATURE = 1e-12  # s · y over |s| |y|: pairs with less are not kept, their inverse curvature is round-off


@dataclass(frozen=True)
class Direction:
    """A search direction on the sphere.

    Attributes:
        vectors: vec3d, shape [V], tangent to the sphere, on the device.
        slope: derivative of the energy along it.
        reach: length of the longest vector, in radians.
        slope_of: the slope where every vertex goes its own share of the way, float64, shape [V], on the device.
    """

    vectors: wp.array
    slope: float
    reach: float
    slope_of: Callable[[wp.array], float]


class Steps:
    """Search directions; their vectors are NumPy's.

    Args:
        energy: of the surface's maps.
    """

    def __init__(self, energy: DistortionEnergy):
        self._energy, self._device = energy, energy.device
        self._count = energy.surface.vertex_count
        self._matrix = NewtonMatrix.of_surface(energy.surface, energy.workspace)
        self._blocks = self._matrix.diagonal_blocks.flatten()
        self._places = wp.array(np.arange(self._count, dtype=np.int32), device="cpu", copy=False)
        self._decrements = wp.empty(self._count, dtype=wp.float64, device="cpu")
        self._pairs: list[tuple[NDArray[np.float64], NDArray[np.float64], float]] = []

    def assemble(self, points: wp.array, terms: Terms, weight: float, curvature_share: float) -> None:
        """Compute the Newton matrix of a map, and drop all pairs."""
        diagonal, _ = self._matrix.assemble(self._energy.hessian(points, terms, weight, curvature_share).numpy())
        further = self._energy.vertex_blocks(points, terms)
        if further is not None:
            diagonal += further
        self._base = points
        self._pairs.clear()

    def factorise(self) -> None:
        """Factorise the matrix assembled last."""
        self._matrix.factorise()

    def decrements(self, gradient: wp.array) -> NDArray[np.float64]:
        """Return twice the expected gain of every vertex alone, by the matrix assembled last, shape [V]."""
        inputs = [*(array.to("cpu") for array in (self._base, gradient)), self._places, self._blocks]
        wp.launch(newton_decrements, dim=self._count, inputs=inputs, outputs=[self._decrements], device="cpu")
        return self._decrements.numpy()

    def direction(self, points: wp.array, gradient: wp.array) -> Direction:
        """Return the direction at a map; points and gradient are vec3d, shape [V], on the device."""
        slopes = gradient.numpy()
        out, here = self._corrected(slopes), points.numpy()
        direction = (out * here).sum(axis=1, keepdims=True) * here - out
        along = (slopes * direction).sum(axis=1)
        reach = float(np.sqrt((direction * direction).sum(axis=1).max()))
        vectors = wp.array(direction, dtype=wp.vec3d, device=self._device, copy=False)
        return Direction(vectors, float(along.sum()), reach, lambda share: float(along @ share.numpy()))

    def update(self, points: wp.array, gradient: wp.array, new_points: wp.array, new_gradient: wp.array) -> None:
        """Add the pair (s, y) of a step: s the change of the points, y that of the gradient (Nocedal 1980)."""
        s, y = new_points.numpy() - points.numpy(), new_gradient.numpy() - gradient.numpy()
        product = float((s * y).sum())
        if product > MIN_CURVATURE * float(np.linalg.norm(s) * np.linalg.norm(y)):
            self._pairs.append((s, y, product))
            del self._pairs[:-MAX_PAIRS]

    def _corrected(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Apply the L-BFGS inverse to a gradient: two loops over the pairs around a solve."""
        right = gradient.copy()
        factors = []
        for s, y, product in reversed(self._pairs):
            factor = float((s * right).sum()) / product
            factors.append(factor)
            right -= factor * y
        out = self._solve(right)
        for (s, y, product), factor in zip(self._pairs, reversed(factors), strict=True):
            out += s * (factor - float((y * out).sum()) / product)
        return out

    def _solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        count, device = self._count, self._device
        coordinates = wp.empty((count, 2), dtype=wp.float64, device=device)
        vectors = wp.empty(count, dtype=wp.vec3d, device=device)
        inputs = [self._base, wp.array(right, dtype=wp.vec3d, device=device, copy=False)]
        wp.launch(to_tangent, dim=count, inputs=inputs, outputs=[coordinates], device=device)
        solved = wp.array(self._matrix.solve(coordinates.numpy()), dtype=wp.float64, device=device, copy=False)
        wp.launch(from_tangent, dim=count, inputs=[self._base, solved], outputs=[vectors], device=device)
        return vectors.numpy()


__all__ = ["Direction", "Steps"]
