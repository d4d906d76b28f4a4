"""Maps to the plane, of a torus's universal cover or of a disk: domain, squared distances, distortion of triangles.

A map of least cost to a torus is the gradient of a convex function |x|²/2 + φ with φ periodic, so that each point is
moved to the nearest copy of its image (D. Cordero-Erausquin, "Sur le transport de mesures périodiques", Comptes Rendus
329, 1999): y_v - x_v in the universal cover stands in place of a geodesic.

The corner k of face f lies at ``points[faces[f][k]] + shift[f, k]`` in the plane. Kernels of triangles on the sphere
take them at height 1, one triangle after the other: there det[a, b, c] is twice a triangle's signed area.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty, sent
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, wp
from omtwarp.device.sums import Reading
from omtwarp.device.threads import Each, computed, each, launch_parts
from omtwarp.geometry.spherical import TINY, oriented_volume
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal import shape_kernels as kernels
from omtwarp.optimal.energy import Domain, ShapeTerms
from omtwarp.optimal.kernels import Fit, raised_fit, weighted_fit
from omtwarp.solvers.motion_kernels import triangle_trouble
from omtwarp.solvers.triangle import triangle_frames

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def lift_corners(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    # Data out:
    lifted: wp.array2d[wp.vec3d],
):
    """Compute every triangle's corners at height 1, shape [F, 3]."""
    f = wp.tid()
    for k in range(3):
        place = points[faces[f][k]] + shift[f, k]
        lifted[f, k] = wp.vec3d(place[0], place[1], ONE)


@wp.kernel
def sum_at_vertices(
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    values: wp.array[wp.vec3d],
    # Data out:
    sums: wp.array[wp.vec2d],
):
    """Sum the values of the corners around every vertex, without their part across the plane."""
    v = wp.tid()
    total = wp.vec3d()
    for k in range(offsets[v], offsets[v + 1]):
        total += values[corners[k]]
    sums[v] = wp.vec2d(total[0], total[1])


@wp.kernel
def plane_areas(
    lifted: wp.array[wp.vec3d],
    # Data out:
    areas: wp.array[wp.float64],
):
    """Compute every triangle's signed area, shape [F]."""
    f = wp.tid()
    areas[f] = HALF * oriented_volume(lifted[3 * f], lifted[3 * f + 1], lifted[3 * f + 2])


@wp.kernel
def plane_area_slopes(
    lifted: wp.array[wp.vec3d],
    # Data out:
    slopes: wp.array2d[wp.vec2d],
):
    """Compute the derivatives of every area by its corners, shape [F, 3]."""
    f = wp.tid()
    for k in range(3):
        side = lifted[3 * f + (k + 2) % 3] - lifted[3 * f + (k + 1) % 3]
        slopes[f, k] = HALF * wp.vec2d(-side[1], side[0])


@wp.kernel
def plane_transport_gradient(
    start: wp.array[wp.vec2d],
    points: wp.array[wp.vec2d],
    masses: wp.array[wp.float64],
    potential: wp.array[wp.float64],
    slopes: wp.array[wp.vec2d],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    further: wp.array[wp.vec2d],
    weight: wp.float64,
    # Data out:
    gradient: wp.array[wp.vec2d],
):
    """Compute the gradient of Σ masses_v |y_v - x_v|² + Σ P_f area_f by the vertices, shape [V].

    ``slopes`` are those of the areas by the corners; ``weight`` times a further gradient is added.
    """
    v = wp.tid()
    total = TWO * masses[v] * (points[v] - start[v])
    for c in range(offsets[v], offsets[v + 1]):
        total += potential[corners[c] // 3] * slopes[corners[c]]
    gradient[v] = total + weight * further[v]


@wp.kernel
def plane_costs(
    start: wp.array[wp.vec2d],
    points: wp.array[wp.vec2d],
    # Data out:
    costs: wp.array[wp.float64],
):
    """Compute the squared distance that every vertex moves, shape [V]."""
    v = wp.tid()
    costs[v] = wp.length_sq(points[v] - start[v])


@wp.kernel
def move_in_plane(
    points: wp.array[wp.vec2d],
    direction: wp.array[wp.vec2d],
    share: wp.array[wp.float64],
    length: wp.float64,
    # Data out:
    moved: wp.array[wp.vec2d],
):
    """Move every vertex by its share of a step."""
    v = wp.tid()
    moved[v] = points[v] + length * share[v] * direction[v]


@wp.kernel
def plane_cost_metric(
    start: wp.array[wp.vec2d],
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    masses: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    least: wp.float64,
    # Data out:
    metric: wp.array[wp.vec4d],
):
    """Compute the derivative of the inverse map y -> x at every vertex, fitted to its neighbours, scaled, shape [V].

    It is made symmetric and its eigenvalues raised to ``least``: see :func:`omtwarp.optimal.kernels.cost_metric`.
    """
    v = wp.tid()
    fit = Fit()
    for k in range(offsets[v], offsets[v + 1]):
        f = corners[k] // 3
        own = corners[k] - 3 * f
        other = (own + 1) % 3
        w = faces[f][other]
        apart = shift[f, other] - shift[f, own]
        d = points[w] - points[v] + apart
        e = start[w] - start[v] + apart
        weight = ONE / wp.max(wp.dot(d, d), TINY)
        fit += weighted_fit(weight, d[0], d[1], e[0], e[1])
    metric[v] = TWO * masses[v] * raised_fit(fit, least)


class Plane(Domain):
    """The plane as the :class:`omtwarp.optimal.energy.Domain` of one surface's maps.

    Args:
        surface: V vertices and F faces; areas in the plane add up to 4π, as its own do.
        shift: of the corners of every triangle from where their vertices lie, across the seam of a torus's universal
            cover, shape [F, 3, 2].
        device: a Warp device.

    Attributes:
        corners: the places of every triangle's corners among those of all, one after the other, vec3i, shape [F].
    """

    def __init__(self, surface: Surface, shift: Floats, device: wp.Device):
        self.surface, self.device = surface, device
        self.mesh = surface.on(device)
        self.shift = self.sent(shift)
        numbers = np.arange(3 * surface.face_count, dtype=np.int32)
        self.corners = Each(sent(numbers, wp.vec3i, device))

    def at_vertices(self, kernel: wp.Kernel, inputs: list[object], dtype: type) -> wp.array:
        """Return what a kernel computes at every vertex, shape [V]."""
        out = wp.empty(self.surface.vertex_count, dtype=dtype, device=self.device)
        wp.launch(kernel, dim=len(out), inputs=inputs, outputs=[out], device=self.device)
        return out

    def lifted(self, points: wp.array) -> wp.array:
        """Return the corners of all triangles of a map at height 1, vec3d, shape [3F]."""
        out = wp.empty((self.surface.face_count, 3), dtype=wp.vec3d, device=self.device)
        return computed(lift_corners, [points, *each(self.shift, self.mesh.faces)], out).flatten()

    def sent(self, values: Floats) -> wp.array:
        """Return points or vectors, shape [V, 2], as vec2d."""
        return wp.array(np.ascontiguousarray(values), dtype=wp.vec2d, device=self.device)

    def flipped(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask of the triangles that are turned over, shape [F]."""
        return np.asarray(~(self.areas(self.sent(points)).numpy() > 0.0))

    def areas(self, points: wp.array) -> wp.array:
        """Return the signed area of every triangle, float64, shape [F]."""
        areas = empty(self.surface.face_count, wp.float64, self.device)
        return computed(plane_areas, [Each(self.lifted(points), 3)], areas)

    def area_slopes(self, points: wp.array) -> wp.array:
        """Return the derivatives of every area by its corners, vec2d, shape [F, 3]."""
        slopes = wp.empty((self.surface.face_count, 3), dtype=wp.vec2d, device=self.device)
        return computed(plane_area_slopes, [Each(self.lifted(points), 3)], slopes)

    def coordinates(self, points: wp.array, vectors: wp.array) -> wp.array:
        """Return the vectors, float64, shape [V, 2]: in the plane all frames are the axes."""
        return vectors.view(wp.float64)

    def vectors(self, points: wp.array, coordinates: wp.array) -> wp.array:
        """Return the coordinates as vec2d, shape [V]: in the plane all frames are the axes."""
        return coordinates.view(wp.vec2d)

    def moved(self, points: wp.array, direction: wp.array, share: wp.array, length: float) -> wp.array:
        """Return the points after a step along vectors, vec2d, shape [V]."""
        return self.at_vertices(move_in_plane, [points, direction, share, wp.float64(length)], wp.vec2d)

    def spoilt(self, moved: wp.array, volume: wp.array) -> wp.array:
        """Return 1 for every triangle that a step turns over or nearly flattens, 0 for others, float64, shape [F]."""
        return computed(triangle_trouble, [self.lifted(moved), self.corners, Each(volume)], wp.empty_like(volume))


class PlaneCost:
    """The squared distance that every vertex moves.

    Args:
        plane: where the vertices move.
        start: x in the plane, shape [V, 2].
    """

    def __init__(self, plane: Plane, start: Floats):
        self._plane, self._start = plane, plane.sent(start)

    def values(self, points: wp.array) -> wp.array:
        """Return |y_v - x_v|², shape [V]."""
        return self._plane.at_vertices(plane_costs, [self._start, points], wp.float64)

    def gradient(
        self, points: wp.array, masses: wp.array, potential: wp.array, further: wp.array, weight: float
    ) -> wp.array:
        """Return the gradient of Σ masses_v cost_v + Σ potential_f area_f and a further one, vec2d, shape [V]."""
        plane = self._plane
        slopes = [plane.area_slopes(points).flatten(), *plane.mesh.vertex_corners]
        inputs = [self._start, points, masses, potential, *slopes, further, wp.float64(weight)]
        return plane.at_vertices(plane_transport_gradient, inputs, wp.vec2d)

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return the second derivative at the optimum, with raised eigenvalues, float64, shape [V, 4]."""
        plane, mesh = self._plane, self._plane.mesh
        inputs = [self._start, points, plane.shift, mesh.faces, masses, *mesh.vertex_corners, wp.float64(least)]
        return plane.at_vertices(plane_cost_metric, inputs, wp.vec4d).view(wp.float64)


class PlaneShape:
    """The distortion of the triangles, angle plus a weight times area, averaged over the surface.

    Args:
        plane: where the vertices move.
    """

    def __init__(self, plane: Plane):
        self._plane, surface = plane, plane.surface
        frames = sent(triangle_frames(surface), wp.vec3d, plane.device)
        self._weights = sent(surface.face_areas / SPHERE_AREA, wp.float64, plane.device)
        self._mesh = [plane.corners, *each(frames, self._weights)]
        self._unscaled = wp.full(1, SPHERE_AREA, dtype=wp.float64, device=plane.device)

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Floats], ShapeTerms]:
        """Begin to measure the distortion of a map, whose ``d_volume`` are twice the signed areas of triangles."""
        device, count = self._plane.device, len(self._weights)
        angle, ratio, volume, area, unused = (empty(count, wp.float64, device) for _ in range(5))
        inputs, outputs = [self._plane.lifted(points), *self._mesh[:2]], each(angle, ratio, volume, unused)
        launch_parts(kernels.triangle_terms, count, inputs, outputs, device)
        launch_parts(kernels.distortion_summands, count, [Each(ratio), self._unscaled], each(area, unused), device)
        mean_angle, mean_area = (reading.dot(self._weights, distortion) for distortion in (angle, area))
        return lambda numbers: ShapeTerms(float(numbers[mean_angle]), float(numbers[mean_area]), volume)

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient by the vertices, vec2d, shape [V]."""
        plane, corners = self._plane, wp.empty(3 * len(self._weights), dtype=wp.vec3d, device=self._plane.device)
        inputs = [plane.lifted(points), *self._mesh, wp.vec3d(weight, weight, 0.0)]
        launch_parts(kernels.triangle_gradient, len(self._weights), inputs, [Each(corners, 3)], plane.device)
        return plane.at_vertices(sum_at_vertices, [*plane.mesh.vertex_corners, corners], wp.vec2d)

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return every triangle's Hessian, as :meth:`omtwarp.optimal.energy.Shape.hessian` describes it."""
        hessians = wp.empty((len(self._weights), 21), dtype=wp.float64, device=self._plane.device)
        inputs = [self._plane.lifted(points), *self._mesh, wp.vec3d(weight, weight, 0.0), wp.float64(1.0), True]
        return computed(kernels.triangle_hessian, inputs, hessians)
