"""Newton steps of the distortion energy, corrected between factorisations by limited-memory BFGS.

Nocedal and Wright, "Numerical Optimization", algorithm 7.4, with the Newton matrix as initial Hessian. On the host with
NumPy and a factorisation, or on the device with multigrid; :func:`omtwarp.device.policy.on_device` says which.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import on_device
from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum
from omtwarp.refine.device_newton import DeviceNewtonMatrix
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.kernels import from_tangent, newton_decrements, to_tangent
from omtwarp.refine.step_kernels import (
    add_share,
    descent_direction,
    gradient_differences,
    largest_of_strides,
    subtract_share,
)
from omtwarp.triangle_newton.newton import NewtonMatrix

MEMORY = 8  # pairs kept by limited-memory BFGS
CURVED = 1e-12  # of the product of its lengths: pairs with less curvature than that are forgotten


@dataclass(frozen=True)
class Direction:
    """Where to go.

    Attributes:
        vectors: vec3d, shape [V], tangent to the sphere, on the device.
        slope: of the energy along it.
        reach: the longest vector.
        slope_of: the slope where every vertex goes its own share of the way, float64, shape [V], on the device.
    """

    vectors: Any
    slope: float
    reach: float
    slope_of: Callable[[wp.array], float]


class Steps(Protocol):
    """What finds directions; points and gradients are vec3d arrays of shape [V] on the device."""

    def assemble(self, points: wp.array, terms: Terms, weight: float, caution: float) -> None:
        """Make the Newton matrix of a map, and forget all pairs."""

    def factorise(self) -> None:
        """Make ready for directions with the matrix assembled last."""

    def decrements(self, gradient: wp.array) -> NDArray[np.float64]:
        """Twice what every vertex is expected to gain alone, by the matrix assembled last, shape [V]."""

    def direction(self, points: wp.array, gradient: wp.array) -> Direction:
        """The direction at a map."""

    def learn(self, points: wp.array, gradient: wp.array, new_points: wp.array, new_gradient: wp.array) -> None:
        """Take account of how the gradient changed along a step."""


class HostSteps:
    """Steps whose vectors are NumPy's.

    Args:
        energy: of the surface's maps.
    """

    def __init__(self, energy: DistortionEnergy):
        self._energy, self._device = energy, energy.device
        self._count = energy.surface.vertex_count
        self._matrix = NewtonMatrix.of_surface(energy.surface, energy.room)
        self._blocks = self._matrix.diagonal_blocks.flatten()
        self._places = wp.array(np.arange(self._count, dtype=np.int32), device="cpu", copy=False)
        self._decrements = wp.empty(self._count, dtype=wp.float64, device="cpu")
        self._memory: list[tuple[NDArray[np.float64], NDArray[np.float64], float]] = []

    def assemble(self, points: wp.array, terms: Terms, weight: float, caution: float) -> None:
        self._matrix.assemble(self._energy.hessian(points, terms, weight, caution).numpy())
        self._base = points
        self._memory.clear()

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

    def learn(self, points: wp.array, gradient: wp.array, new_points: wp.array, new_gradient: wp.array) -> None:
        change, turn = new_points.numpy() - points.numpy(), new_gradient.numpy() - gradient.numpy()
        product = float((change * turn).sum())
        if product > CURVED * float(np.linalg.norm(change) * np.linalg.norm(turn)):
            self._memory.append((change, turn, product))
            del self._memory[:-MEMORY]

    def _corrected(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """The factorised matrix's step for a gradient, corrected by the steps since."""
        right = gradient.copy()
        factors = []
        for change, turn, product in reversed(self._memory):
            factor = float((change * right).sum()) / product
            factors.append(factor)
            right -= factor * turn
        out = self._solve(right)
        for (change, turn, product), factor in zip(self._memory, reversed(factors), strict=True):
            out += change * (factor - float((turn * out).sum()) / product)
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
        self._matrix = DeviceNewtonMatrix(energy)
        self._sum = DeviceSum(self._device)
        self._right, self._step = (wp.empty(count, dtype=wp.vec3d, device=self._device) for _ in range(2))
        self._along, self._reach = (wp.empty(count, dtype=wp.float64, device=self._device) for _ in range(2))
        self._coordinates = wp.empty((count, 2), dtype=wp.float64, device=self._device)
        # First the slope or the three products of a pair, then the largest reaches.
        self._numbers = wp.empty(3 + self.REACHES, dtype=wp.float64, device=self._device)
        self._places: list[Any] = [self._numbers[k : k + 1] for k in range(3)]
        self._reaches: Any = self._numbers[3:]
        self._factors = [wp.empty(1, dtype=wp.float64, device=self._device) for _ in range(MEMORY)]
        self._memory: list[tuple[Any, Any, Any]] = []
        self._spare: tuple[Any, Any, Any] | None = None

    def assemble(self, points: wp.array, terms: Terms, weight: float, caution: float) -> None:
        self._memory.clear()  # first: Hessians take as much room
        self._spare = None
        self._matrix.assemble(points, lambda: self._energy.hessian(points, terms, weight, caution))
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

    def learn(self, points: wp.array, gradient: wp.array, new_points: wp.array, new_gradient: wp.array) -> None:
        change, turn, product = self._spare or self._room()
        self._spare = change, turn, product
        self._launch(gradient_differences, [new_points, points], [change])
        self._launch(gradient_differences, [new_gradient, gradient], [turn])
        for place, (one, other) in zip(self._places, ((change, turn), (change, change), (turn, turn)), strict=True):
            self._sum.dot(flat(one), flat(other), place)
        wp.copy(product, self._places[0])
        curvature, *squares = self._numbers.numpy()[:3]
        if curvature > CURVED * np.sqrt(squares[0] * squares[1]):
            self._memory.append(self._spare)
            self._spare = self._memory.pop(0) if len(self._memory) > MEMORY else None

    def _room(self) -> tuple[Any, Any, Any]:
        count, device = self._count, self._device
        change, turn = (wp.empty(count, dtype=wp.vec3d, device=device) for _ in range(2))
        return change, turn, wp.empty(1, dtype=wp.float64, device=device)

    def _slope_of(self, share: wp.array) -> float:
        self._sum.dot(self._along, share, self._places[0])
        return float(self._numbers.numpy()[0])

    def _correct(self, gradient: wp.array) -> None:
        """The step for a gradient as the matrix and the pairs have it."""
        wp.copy(self._right, gradient)
        for (change, turn, product), factor in zip(reversed(self._memory), self._factors, strict=False):
            self._sum.dot(flat(change), flat(self._right), factor)
            self._launch(subtract_share, [factor, product, turn], [self._right])
        self._launch(to_tangent, [self._base, self._right], [self._coordinates])
        self._matrix.solve(self._coordinates)
        self._launch(from_tangent, [self._base, self._coordinates], [self._step])
        used = self._factors[: len(self._memory)]
        for (change, turn, product), factor in zip(self._memory, reversed(used), strict=True):
            self._sum.dot(flat(turn), flat(self._step), self._places[0])
            self._launch(add_share, [factor, self._places[0], product, change], [self._step])

    def _launch(self, kernel: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=self._count, inputs=inputs, outputs=outputs, device=self._device)


def steps_for(energy: DistortionEnergy) -> Steps:
    """Steps on the host or on the device, whichever suits the surface."""
    return (DeviceSteps if on_device(energy.device, energy.surface.vertex_count) else HostSteps)(energy)


def flat(vectors: wp.array) -> wp.array:
    """The numbers of contiguous vectors one after the other, in the same memory."""
    size = vectors.size * (3 if vectors.dtype is wp.vec3d else 1)
    return wp.array(ptr=vectors.ptr, dtype=wp.float64, shape=(size,), device=vectors.device)


__all__ = ["DeviceSteps", "Direction", "HostSteps", "Steps", "steps_for"]
