"""Newton steps of the distortion energy, corrected between factorisations by limited-memory BFGS.

Nocedal and Wright, "Numerical Optimization", algorithm 7.4, with the Newton matrix as initial Hessian. On the host with
NumPy and a factorisation, or on the device with multigrid; :func:`omtwarp.device.policy.on_device` says which.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import on_device
from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.kernels import newton_decrements
from omtwarp.refine.step_kernels import (
    add_share,
    descent_direction,
    gradient_differences,
    largest_of_strides,
    subtract_share,
)
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


class Steps(Protocol):
    """The interface of search directions; points and gradients are vec3d arrays of shape [V] on the device."""

    def assemble(self, points: wp.array, terms: Terms, weight: float, curvature_share: float) -> None:
        """Compute the Newton matrix of a map, and drop all pairs."""

    def factorise(self) -> None:
        """Factorise the matrix assembled last, or prepare its levels."""

    def decrements(self, gradient: wp.array) -> NDArray[np.float64]:
        """Return twice the expected gain of every vertex alone, by the matrix assembled last, shape [V]."""

    def direction(self, points: wp.array, gradient: wp.array) -> Direction:
        """Return the direction at a map."""

    def update(self, points: wp.array, gradient: wp.array, new_points: wp.array, new_gradient: wp.array) -> None:
        """Add the pair (s, y) of a step: s the change of the points, y that of the gradient (Nocedal 1980)."""


class HostSteps:
    """Steps whose vectors are NumPy's.

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
        diagonal, _ = self._matrix.assemble(self._energy.hessian(points, terms, weight, curvature_share).numpy())
        further = self._energy.vertex_blocks(points, terms)
        if further is not None:
            diagonal += further
        self._base = points
        self._pairs.clear()

    def factorise(self) -> None:
        self._matrix.factorise()

    def decrements(self, gradient: wp.array) -> NDArray[np.float64]:
        inputs = [*(array.to("cpu") for array in (self._base, gradient)), self._places, self._blocks]
        wp.launch(newton_decrements, dim=self._count, inputs=inputs, outputs=[self._decrements], device="cpu")
        return self._decrements.numpy()

    def direction(self, points: wp.array, gradient: wp.array) -> Direction:
        slopes = gradient.numpy()
        out, here = self._corrected(slopes), points.numpy()
        direction = (out * here).sum(axis=1, keepdims=True) * here - out
        along = (slopes * direction).sum(axis=1)
        reach = float(np.sqrt((direction * direction).sum(axis=1).max()))
        vectors = wp.array(direction, dtype=wp.vec3d, device=self._device, copy=False)
        return Direction(vectors, float(along.sum()), reach, lambda share: float(along @ share.numpy()))

    def update(self, points: wp.array, gradient: wp.array, new_points: wp.array, new_gradient: wp.array) -> None:
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


class DeviceSteps:
    """Steps whose vectors never leave the device; three numbers return for every direction and for every pair.

    Args:
        energy: of the surface's maps.
    """

    REACHES = 64  # numbers among which the host finds the largest

    def __init__(self, energy: DistortionEnergy):
        self._energy, self._device = energy, energy.device
        count = self._count = energy.surface.vertex_count
        from omtwarp.refine.device_newton import DeviceNewtonMatrix  # its kernels are read where a device solves

        self._matrix = DeviceNewtonMatrix(energy)
        self._sum = DeviceSum(self._device)
        self._right, self._step = (wp.empty(count, dtype=wp.vec3d, device=self._device) for _ in range(2))
        self._along, self._reach = (wp.empty(count, dtype=wp.float64, device=self._device) for _ in range(2))
        self._coordinates = wp.empty((count, 2), dtype=wp.float64, device=self._device)
        # First the slope or the three products of a pair, then the largest reaches.
        self._numbers = wp.empty(3 + self.REACHES, dtype=wp.float64, device=self._device)
        self._places: list[wp.array] = [self._numbers[k : k + 1] for k in range(3)]
        self._reaches = self._numbers[3:]
        self._factors = [wp.empty(1, dtype=wp.float64, device=self._device) for _ in range(MAX_PAIRS)]
        self._pairs: list[tuple[wp.array, wp.array, wp.array]] = []
        self._spare_pair: tuple[wp.array, wp.array, wp.array] | None = None

    def assemble(self, points: wp.array, terms: Terms, weight: float, curvature_share: float) -> None:
        self._pairs.clear()  # before the Hessians, which take as much memory
        self._spare_pair = None
        self._matrix.assemble(points, lambda: self._energy.hessian(points, terms, weight, curvature_share))
        self._base = points

    def factorise(self) -> None:
        self._matrix.make_levels(self._base)

    def decrements(self, gradient: wp.array) -> NDArray[np.float64]:
        self._launch(newton_decrements, [self._base, gradient, *self._matrix.diagonal_blocks], [self._along])
        return self._along.numpy()

    def direction(self, points: wp.array, gradient: wp.array) -> Direction:
        self._correct(gradient)
        vectors = wp.empty(self._count, dtype=wp.vec3d, device=self._device)
        self._launch(descent_direction, [points, self._step, gradient], [vectors, self._along, self._reach])
        self._sum.total(self._along, self._places[0])
        inputs, outputs = [self._reach], [self._reaches]
        wp.launch(largest_of_strides, dim=self.REACHES, inputs=inputs, outputs=outputs, device=self._device)
        numbers = self._numbers.numpy()
        return Direction(vectors, float(numbers[0]), float(numbers[3:].max()), self._slope_of)

    def update(self, points: wp.array, gradient: wp.array, new_points: wp.array, new_gradient: wp.array) -> None:
        s, y, product = self._spare_pair or self._new_pair()
        self._spare_pair = s, y, product
        self._launch(gradient_differences, [new_points, points], [s])
        self._launch(gradient_differences, [new_gradient, gradient], [y])
        for place, (one, other) in zip(self._places, ((s, y), (s, s), (y, y)), strict=True):
            self._sum.dot(flat(one), flat(other), place)
        wp.copy(product, self._places[0])
        curvature, *squares = self._numbers.numpy()[:3]
        if curvature > MIN_CURVATURE * np.sqrt(squares[0] * squares[1]):
            self._pairs.append(self._spare_pair)
            self._spare_pair = self._pairs.pop(0) if len(self._pairs) > MAX_PAIRS else None

    def _new_pair(self) -> tuple[wp.array, wp.array, wp.array]:
        count, device = self._count, self._device
        s, y = (wp.empty(count, dtype=wp.vec3d, device=device) for _ in range(2))
        return s, y, wp.empty(1, dtype=wp.float64, device=device)

    def _slope_of(self, share: wp.array) -> float:
        self._sum.dot(self._along, share, self._places[0])
        return float(self._numbers.numpy()[0])

    def _correct(self, gradient: wp.array) -> None:
        """Apply the L-BFGS inverse to a gradient: two loops over the pairs around a solve."""
        wp.copy(self._right, gradient)
        for (s, y, product), factor in zip(reversed(self._pairs), self._factors, strict=False):
            self._sum.dot(flat(s), flat(self._right), factor)
            self._launch(subtract_share, [factor, product, y], [self._right])
        self._launch(to_tangent, [self._base, self._right], [self._coordinates])
        self._matrix.solve(self._coordinates)
        self._launch(from_tangent, [self._base, self._coordinates], [self._step])
        used = self._factors[: len(self._pairs)]
        for (s, y, product), factor in zip(self._pairs, reversed(used), strict=True):
            self._sum.dot(flat(y), flat(self._step), self._places[0])
            self._launch(add_share, [factor, self._places[0], product, s], [self._step])

    def _launch(self, kernel: wp.Kernel, inputs: list[object], outputs: list[object]) -> None:
        wp.launch(kernel, dim=self._count, inputs=inputs, outputs=outputs, device=self._device)


def steps_for(energy: DistortionEnergy) -> Steps:
    """Return the steps on the host or on the device, whichever suits the surface; terms of NumPy's need the host."""
    device = on_device(energy.device, energy.surface.vertex_count) and not energy.extended
    return (DeviceSteps if device else HostSteps)(energy)


def flat(vectors: wp.array) -> wp.array:
    """View contiguous vectors as a flat array of numbers in the same memory."""
    size = vectors.size * (3 if vectors.dtype is wp.vec3d else 1)
    return wp.array(ptr=vectors.ptr, dtype=wp.float64, shape=(size,), device=vectors.device)


__all__ = ["DeviceSteps", "Direction", "HostSteps", "Steps", "steps_for"]
