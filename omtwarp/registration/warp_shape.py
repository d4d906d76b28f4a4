"""What may be minimised together with the distortion of triangles: a bound on their strain, and an energy at vertices.

The bound is kept by a barrier.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.device.threads import Each, each, launch_parts
from omtwarp.geometry.spherical import corners_of
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.refine.kernels import distortion_gradient, distortion_hessian, distortion_terms, gather_tangent
from omtwarp.solvers.motion_kernels import from_tangent
from omtwarp.solvers.newton import packed
from omtwarp.solvers.triangle import first_tangent

wp.set_module_options(KERNEL_OPTIONS)

Octaves = TypeVar("Octaves", float, NDArray[np.float64])


@wp.func
def strain(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    angle, d, volume, _needle = distortion_terms(frame, a, b, c)
    if volume <= ZERO:
        return LARGE
    return angle + (d - ONE) * (d - ONE) / d


@wp.func
def barrier_slope(w: wp.float64, limit: wp.float64) -> wp.float64:
    gap = limit - w
    return w * (TWO * limit - w) / (gap * gap)


@wp.func
def barrier_curvature(w: wp.float64, limit: wp.float64) -> wp.float64:
    gap = limit - w
    return TWO * limit * limit / (gap * gap * gap)


@wp.kernel
def strain_terms(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    # Data out:
    strains: wp.array[wp.float64],
):
    """Compute the strain w of every triangle, shape [F]; flipped ones have a very large one."""
    t = wp.tid()
    face = faces[t]
    strains[t] = strain(frames[t], sphere[face[0]], sphere[face[1]], sphere[face[2]])


@wp.kernel
def barrier_gradient(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    limit: wp.float64,
    # Data out:
    corner_gradient: wp.array[wp.vec3d],
):
    """Compute the gradient of A w² / (limit - w) by the corners, shape [3F], where all strains are below the limit."""
    t = wp.tid()
    a, b, c = corners_of(sphere, faces[t])
    slope = barrier_slope(strain(frames[t], a, b, c), limit)
    rows = distortion_gradient(frames[t], slope * areas[t], a, b, c, wp.vec3d(ONE, ONE, ZERO))
    for k in range(3):
        corner_gradient[3 * t + k] = rows[k]


@wp.kernel
def barrier_hessian(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    limit: wp.float64,
    divisor: wp.float64,
    # Data out:
    hessian: wp.array2d[wp.float64],
):
    """Compute the Hessian of A w² / (limit - w) in tangent bases, divided, positive semidefinite, shape [F, 21].

    It is the slope of the barrier times that of w, without its negative part, and its curvature times the square of the
    gradient of w.
    """
    t, _compiled_once = wp.tid()
    face = faces[t]
    frame = frames[t]
    points = wp.matrix_from_rows(sphere[face[0]], sphere[face[1]], sphere[face[2]])
    w = strain(frame, points[0], points[1], points[2])
    share = areas[t] / divisor
    slope = share * barrier_slope(w, limit)
    distortion_hessian(t, frame, slope, points[0], points[1], points[2], wp.vec3d(ONE, ONE, ZERO), hessian)
    rows = distortion_gradient(frame, ONE, points[0], points[1], points[2], wp.vec3d(ONE, ONE, ZERO))
    along = wp.vector(dtype=wp.float64, length=6)
    for k in range(3):
        tangent = first_tangent(points[k])
        along[2 * k] = wp.dot(tangent, rows[k])
        along[2 * k + 1] = wp.dot(wp.cross(points[k], tangent), rows[k])
    bend = share * barrier_curvature(w, limit)
    for i in range(6):
        for j in range(i, 6):
            hessian[t, packed(i, j)] = hessian[t, packed(i, j)] + bend * along[i] * along[j]


def strain_limit(octaves: Octaves) -> Octaves:
    """Return the limit of w = (R + 1/R - 2) + (D + 1/D - 2) that keeps ratios of areas and stretches within 2^±octaves.

    Args:
        octaves: bound on |log2 D| and on log2 R, positive.

    Example:
        >>> strain_limit(1.0)
        0.5
    """
    return 2.0**octaves + 2.0**-octaves - 2.0


class StrainBarrier:
    """The mean over the triangles of w² / (limit - w), weighted by original area; infinite where one reaches the limit.

    Args:
        mesh: of every triangle the corners, vec3i, the frame (:func:`omtwarp.solvers.triangle.triangle_frames`), vec3d,
            and the area on the original surface, float64, shape [F] each, on the host as all that follows.
        rows: corners of the triangles around the vertices: offsets and corners, int32.
        limit: see :func:`strain_limit`.
    """

    def __init__(self, mesh: list[wp.array], rows: list[wp.array], limit: float):
        self._mesh, self._rows, self._limit = mesh, rows, limit
        self._count, self._device = len(mesh[0]), mesh[0].device

    def value(self, points: wp.array) -> float:
        """Return the barrier at a map, vec3d [V]."""
        strains = wp.empty(self._count, dtype=wp.float64, device=self._device)
        launch_parts(strain_terms, self._count, [points, *each(*self._mesh[:2])], each(strains), self._device)
        worst = strains.numpy()
        if not worst.max() < self._limit:
            return float("inf")
        return float(self._mesh[2].numpy() @ (worst**2 / (self._limit - worst))) / SPHERE_AREA

    def gradient(self, points: wp.array) -> NDArray[np.float64]:
        """Return the gradient by the vertices, tangent to the sphere, shape [V, 3]."""
        corners = wp.empty(3 * self._count, dtype=wp.vec3d, device=self._device)
        inputs = [points, *each(*self._mesh), wp.float64(self._limit)]
        launch_parts(barrier_gradient, self._count, inputs, [Each(corners, 3)], self._device)
        gradient = wp.empty(self._rows[0].size - 1, dtype=wp.vec3d, device=self._device)
        inputs = [points, *self._rows, corners, wp.float64(SPHERE_AREA), 0]
        wp.launch(gather_tangent, dim=gradient.size, inputs=inputs, outputs=[gradient], device=self._device)
        return np.asarray(gradient.numpy())

    def hessian(self, points: wp.array) -> NDArray[np.float64]:
        """Return the Hessian of every triangle, shape [F, 21].

        It is laid out as by :meth:`omtwarp.refine.energy.DistortionEnergy.hessian`.
        """
        blocks = wp.empty((self._count, 21), dtype=wp.float64, device=self._device)
        inputs = [points, *each(*self._mesh), wp.float64(self._limit), wp.float64(SPHERE_AREA)]
        launch_parts(barrier_hessian, self._count, inputs, each(blocks), self._device)
        return np.asarray(blocks.numpy())


@dataclass(frozen=True)
class VertexDerivatives:
    """The value of a term at a map, and its derivatives by the positions of the vertices.

    Attributes:
        value: the term, in the unit of the distortion: a mean over the sphere.
        gradient: by every vertex, shape [V, 3]; what is not tangent to the sphere does not count.
        hessian: of every vertex, symmetric positive semidefinite, shape [V, 3, 3]; of it the solver takes the 2x2 block
            in the tangent plane. Steps go downhill with any such matrix, and are longest with the true one: where that
            is indefinite, leave out its negative part, as Gauss and Newton do with squares.
    """

    value: float
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]


class VertexTerm(Protocol):
    """An energy that is a sum over the vertices of a function of where each lies.

    A class with the method below is one; :class:`omtwarp.refine.solver.Refiner` takes it as ``vertex_term``. The value
    has to be continuous, and the gradient its derivative: the line search compares the two.
    """

    def at(self, points: NDArray[np.float64]) -> VertexDerivatives:
        """Return the term and its derivatives at a map, unit vectors, shape [V, 3]."""


def tangent_blocks(points: wp.array, hessian: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrices in space, [V, 3, 3], as the blocks of the tangent bases of points, shape [V, 2, 2].

    Args:
        points: vec3d, shape [V], on the host.
        hessian: symmetric, shape [V, 3, 3].
    """
    count = points.size
    bases = []
    for k in range(2):
        one = np.zeros((count, 2))
        one[:, k] = 1.0
        vectors = wp.empty(count, dtype=wp.vec3d, device="cpu")
        inputs = [points, wp.array(one, dtype=wp.float64, device="cpu", copy=False)]
        wp.launch(from_tangent, dim=count, inputs=inputs, outputs=[vectors], device="cpu")
        bases.append(vectors.numpy())
    basis = np.stack(bases, axis=1)
    return np.asarray(basis @ hessian @ basis.transpose(0, 2, 1))
