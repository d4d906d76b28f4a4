"""The shape of warps: the distortion of triangles, a bound on their strain, and an energy at vertices.

The bound is kept by a barrier. Barrier and energy are computed on the host.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.device.sums import Reading
from omtwarp.device.threads import Each, computed, each, launch_parts
from omtwarp.geometry.spherical import corners_of
from omtwarp.mesh.arrays import Floats, dots
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.energy import ShapeTerms
from omtwarp.optimal.shape import DistortionEnergy
from omtwarp.optimal.shape_kernels import distortion_gradient, distortion_hessian, distortion_terms, gather_tangent
from omtwarp.solvers.motion_kernels import from_tangent
from omtwarp.solvers.newton import packed
from omtwarp.solvers.triangle import first_tangents

wp.set_module_options(KERNEL_OPTIONS)

Octaves = TypeVar("Octaves", float, NDArray[np.float64])

# Places of the 2x2 blocks of the three corners among the 21 entries of a triangle's Hessian: (0, 0), (0, 1), (1, 1).
OWN_BLOCKS = np.array([[0, 1, 6], [11, 12, 15], [18, 19, 20]])


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
    a, b, c = corners_of(sphere, faces[t])
    strains[t] = strain(frames[t], a, b, c)


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
    frame = frames[t]
    a, b, c = corners_of(sphere, faces[t])
    points, axes = wp.matrix_from_rows(a, b, c), first_tangents(a, b, c)
    w = strain(frame, a, b, c)
    share = areas[t] / divisor
    slope = share * barrier_slope(w, limit)
    distortion_hessian(t, frame, slope, a, b, c, axes, wp.vec3d(ONE, ONE, ZERO), hessian)
    rows = distortion_gradient(frame, ONE, a, b, c, wp.vec3d(ONE, ONE, ZERO))
    along = wp.vector(dtype=wp.float64, length=6)
    for k in range(3):
        along[2 * k] = wp.dot(axes[k], rows[k])
        along[2 * k + 1] = wp.dot(wp.cross(points[k], axes[k]), rows[k])
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
        worst = computed(strain_terms, [points, *each(*self._mesh[:2])], strains).numpy()
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

        It is laid out as by :meth:`omtwarp.optimal.shape.DistortionEnergy.hessian`.
        """
        blocks = wp.empty((self._count, 21), dtype=wp.float64, device=self._device)
        inputs = [points, *each(*self._mesh), wp.float64(self._limit), wp.float64(SPHERE_AREA)]
        return np.asarray(computed(barrier_hessian, inputs, blocks).numpy())


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

    A class with the method below is one. The value has to be continuous, and the gradient its derivative: the line
    search compares the two.
    """

    def at(self, points: NDArray[np.float64]) -> VertexDerivatives:
        """Return the term and its derivatives at a map, unit vectors, shape [V, 3]."""


@dataclass(frozen=True)
class WarpTerms(ShapeTerms):
    """The terms of a warp's energy.

    Attributes:
        own: the distortion of its triangles.
        strain: the barrier of strain; 0 without a bound, infinite where one is reached.
        at_vertices: the term at vertices and its derivatives, where there is one and no bound is reached.
    """

    own: ShapeTerms
    strain: float
    at_vertices: VertexDerivatives | None

    def total(self, weight: float) -> float:
        """Return angle plus ``weight`` times area distortion, plus barrier and term at vertices."""
        return self.own.total(weight) + self.strain + (0.0 if self.at_vertices is None else self.at_vertices.value)


class WarpShape:
    """The distortion of triangles with a bound on their strain, an energy at vertices, or both.

    It is a :class:`omtwarp.optimal.energy.Shape` on the host.

    Args:
        surface: what is warped, V vertices and F faces.
        device: a Warp device, the host's.
        most_strain: the limit of the strain of triangles that the barrier keeps (:func:`strain_limit`).
        vertex_term: the energy at vertices.
    """

    def __init__(
        self,
        surface: Surface,
        device: wp.Device,
        *,
        most_strain: float | None = None,
        vertex_term: VertexTerm | None = None,
    ):
        self._distortion, self._device, self._vertex_term = DistortionEnergy(surface, device), device, vertex_term
        mesh = surface.on(device)
        frames = wp.array(self._distortion.frames, dtype=wp.vec3d, device=device, copy=False)
        given = [mesh.faces, frames, mesh.face_areas], mesh.vertex_corners
        self._barrier = None if most_strain is None else StrainBarrier(*given, most_strain)
        offsets, corners = surface.vertex_corners
        self._first = corners[offsets[:-1]]  # a corner of some triangle at every vertex

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Floats], WarpTerms]:
        """Begin to measure a warp; return what makes its terms of the numbers that are read."""
        finish = self._distortion.begin(points, reading)
        strain = 0.0 if self._barrier is None else self._barrier.value(points)
        further = None
        if self._vertex_term is not None and np.isfinite(strain):
            further = self._vertex_term.at(points.numpy())

        def terms(numbers: Floats) -> WarpTerms:
            own = finish(numbers)
            return WarpTerms(own.angle, own.area, own.d_volume, own, strain, further)

        return terms

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient of the energy by the vertices, tangent to the sphere, vec3d, shape [V]."""
        assert isinstance(terms, WarpTerms)
        total, here = self._distortion.gradient(points, terms.own, weight).numpy().copy(), points.numpy()
        if self._barrier is not None:
            total += self._barrier.gradient(points)
        if terms.at_vertices is not None:
            further = terms.at_vertices.gradient
            total += further - dots(further, here)[..., None] * here
        return vectors(total, self._device)

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return every triangle's Hessian as :meth:`omtwarp.optimal.shape.DistortionEnergy.hessian` does, [F, 21].

        One triangle at every vertex has the Hessian of the term there.
        """
        assert isinstance(terms, WarpTerms)
        blocks = self._distortion.hessian(points, terms.own, weight)
        numbers = blocks.numpy()
        if self._barrier is not None:
            numbers += self._barrier.hessian(points)
        if terms.at_vertices is not None:
            own = tangent_blocks(points, terms.at_vertices.hessian)[:, [0, 0, 1], [0, 1, 1]]
            numbers[self._first[:, None] // 3, OWN_BLOCKS[self._first % 3]] += own
        return blocks


def tangent_blocks(points: wp.array, hessian: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrices in space, [V, 3, 3], as the blocks of the tangent bases of points, shape [V, 2, 2].

    Args:
        points: vec3d, shape [V], on the host.
        hessian: symmetric, shape [V, 3, 3].
    """
    count = points.size
    bases = []
    for k in range(2):
        one = np.tile(np.eye(2)[k], (count, 1))
        vectors = wp.empty(count, dtype=wp.vec3d, device="cpu")
        inputs = [points, wp.array(one, dtype=wp.float64, device="cpu", copy=False)]
        wp.launch(from_tangent, dim=count, inputs=inputs, outputs=[vectors], device="cpu")
        bases.append(vectors.numpy())
    basis = np.stack(bases, axis=1)
    return np.asarray(basis @ hessian @ basis.transpose(0, 2, 1))
