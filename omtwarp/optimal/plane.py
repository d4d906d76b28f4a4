"""Maps to the plane, of a torus's universal cover or of a disk: domain, squared distances, distortion of triangles.

A map of least cost to a torus is the gradient of a convex function |x|²/2 + φ with φ periodic, so that each point is
moved to the nearest copy of its image (D. Cordero-Erausquin, "Sur le transport de mesures périodiques", Comptes Rendus
329, 1999): y_v - x_v in the universal cover stands in place of a geodesic.

The corner k of face f lies at ``points[faces[f][k]] + shift[f, k]`` in the plane.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.device.sums import Reading
from omtwarp.geometry.spherical import TINY, oriented_volume
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.energy import Domain, ShapeTerms
from omtwarp.optimal.kernels import Fit, raised_fit, weighted_fit
from omtwarp.optimal.shape_kernels import distortion_gradient, distortion_hessian, distortion_terms
from omtwarp.solvers.motion_kernels import keeps_volume
from omtwarp.solvers.triangle import triangle_frames

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def turned(v: wp.vec2d) -> wp.vec2d:
    """Return a vector turned by +90 degrees."""
    return wp.vec2d(-v[1], v[0])


@wp.func
def area_by_corner(p: wp.vec2d, q: wp.vec2d) -> wp.vec2d:
    """Return the gradient of the area of the triangle (own, p, q) by its first corner."""
    return HALF * turned(q - p)


@wp.func
def corner_place(points: wp.array[wp.vec2d], shift: wp.array2d[wp.vec2d], faces: wp.array[wp.vec3i], f: int, k: int):
    """Return where the corner k of a triangle lies in the plane."""
    return points[faces[f][k]] + shift[f, k]


@wp.func
def corners_above(points: wp.array[wp.vec2d], shift: wp.array2d[wp.vec2d], faces: wp.array[wp.vec3i], f: int):
    """Return a triangle's corners at height 1: there det[a, b, c] is twice its signed area."""
    a = corner_place(points, shift, faces, f, 0)
    b = corner_place(points, shift, faces, f, 1)
    c = corner_place(points, shift, faces, f, 2)
    return wp.vec3d(a[0], a[1], ONE), wp.vec3d(b[0], b[1], ONE), wp.vec3d(c[0], c[1], ONE)


@wp.kernel
def plane_triangles(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    # Data out:
    areas: wp.array[wp.float64],
    angle: wp.array[wp.float64],
    area: wp.array[wp.float64],
):
    """Compute every triangle's signed area, and its distortions of angle and of area, each less 2.

    Distortion is infinite where the triangle is turned over.
    """
    f = wp.tid()
    a, b, c = corners_above(points, shift, faces, f)
    of_angle, d, volume, _upright = distortion_terms(frames[f], a, b, c)
    areas[f] = HALF * volume
    angle[f] = wp.where(volume > ZERO, of_angle, wp.float64(wp.inf))
    area[f] = wp.where(volume > ZERO, (d - ONE) * (d - ONE) / d, wp.float64(wp.inf))


@wp.kernel
def plane_gradients(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    area_weight: wp.float64,
    # Data out:
    gradients: wp.array2d[wp.vec2d],
):
    """Compute the gradient of weighted distortion by the corners, shape [F, 3]."""
    f = wp.tid()
    a, b, c = corners_above(points, shift, faces, f)
    rows = distortion_gradient(frames[f], weights[f], a, b, c, wp.vec3d(area_weight, area_weight, ZERO))
    for k in range(3):
        gradients[f, k] = wp.vec2d(rows[k, 0], rows[k, 1])


@wp.kernel
def plane_hessians(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    area_weight: wp.float64,
    # Data out:
    hessians: wp.array2d[wp.float64],
):
    """Compute positive semidefinite Hessians of the distortion, entries on and above the diagonal, shape [F, 21].

    With the Jacobian J and its determinant D the energy is |J|² / D + λ (D + 1 / D): see
    :func:`omtwarp.optimal.shape_kernels.triangle_hessian`.
    """
    f = wp.tid()
    a, b, c = corners_above(points, shift, faces, f)
    axis, pressures = wp.vec3d(ONE, ZERO, ZERO), wp.vec3d(area_weight, area_weight, ZERO)
    distortion_hessian(f, frames[f], weights[f], a, b, c, wp.matrix_from_rows(axis, axis, axis), pressures, hessians)


@wp.kernel
def sum_at_vertices(
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    values: wp.array[wp.vec2d],
    # Data out:
    sums: wp.array[wp.vec2d],
):
    """Sum the values of the corners around every vertex."""
    v = wp.tid()
    total = wp.vec2d()
    for k in range(offsets[v], offsets[v + 1]):
        total += values[corners[k]]
    sums[v] = total


@wp.kernel
def plane_areas(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    # Data out:
    areas: wp.array[wp.float64],
):
    """Compute every triangle's signed area, shape [F]."""
    f = wp.tid()
    a, b, c = corners_above(points, shift, faces, f)
    areas[f] = HALF * oriented_volume(a, b, c)


@wp.kernel
def plane_area_slopes(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    # Data out:
    slopes: wp.array2d[wp.vec2d],
):
    """Compute the derivatives of every area by its corners, shape [F, 3]."""
    f = wp.tid()
    for k in range(3):
        after = corner_place(points, shift, faces, f, (k + 1) % 3)
        slopes[f, k] = area_by_corner(after, corner_place(points, shift, faces, f, (k + 2) % 3))


@wp.kernel
def plane_transport_gradient(
    start: wp.array[wp.vec2d],
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    masses: wp.array[wp.float64],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    further: wp.array[wp.vec2d],
    weight: wp.float64,
    # Data out:
    gradient: wp.array[wp.vec2d],
):
    """Compute the gradient of Σ masses_v |y_v - x_v|² + Σ P_f area_f by the vertices, shape [V].

    ``weight`` times a further gradient is added.
    """
    v = wp.tid()
    total = TWO * masses[v] * (points[v] - start[v])
    for c in range(offsets[v], offsets[v + 1]):
        f = corners[c] // 3
        k = corners[c] - 3 * f
        after = corner_place(points, shift, faces, f, (k + 1) % 3)
        total += potential[f] * area_by_corner(after, corner_place(points, shift, faces, f, (k + 2) % 3))
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
def plane_trouble(
    areas: wp.array[wp.float64],
    before: wp.array[wp.float64],
    # Data out:
    trouble: wp.array[wp.float64],
):
    """Mark with 1 where a step turns a triangle over or takes nearly all its area, shape [F]."""
    f = wp.tid()
    trouble[f] = wp.where(keeps_volume(areas[f], before[f]), ZERO, ONE)


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
    metric: wp.array2d[wp.float64],
):
    """Compute the derivative of the inverse map y -> x at every vertex, fitted to its neighbours, scaled, shape [V, 4].

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
    entries = TWO * masses[v] * raised_fit(fit, least)
    metric[v, 0] = entries[0]
    metric[v, 1] = entries[1]
    metric[v, 2] = entries[1]
    metric[v, 3] = entries[2]


class Plane(Domain):
    """The plane as the :class:`omtwarp.optimal.energy.Domain` of one surface's maps.

    Args:
        surface: V vertices and F faces; areas in the plane add up to 4π, as its own do.
        shift: of the corners of every triangle from where their vertices lie, across the seam of a torus's universal
            cover, shape [F, 3, 2].
        device: a Warp device.
    """

    def __init__(self, surface: Surface, shift: Floats, device: wp.Device):
        self.surface, self.device = surface, device
        self.mesh = surface.on(device)
        self.shift = self.copied(shift, wp.vec2d)

    def copied(self, values: Floats, dtype: type) -> wp.array:
        """Return a copy of numbers on the device."""
        return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=dtype, device=self.device)

    def empty(self, dtype: type, *shape: int) -> wp.array:
        """Return an array on the device with anything in it."""
        return wp.empty(shape, dtype=dtype, device=self.device)

    def at_vertices(self, kernel: wp.Kernel, inputs: list[object], outputs: list[wp.array]) -> None:
        """Launch a kernel over all vertices."""
        wp.launch(kernel, dim=self.surface.vertex_count, inputs=inputs, outputs=outputs, device=self.device)

    def launch(self, kernel: wp.Kernel, points: wp.array, inputs: list[object], outputs: list[wp.array]) -> None:
        """Launch a kernel over all triangles of a map."""
        given = [points, self.shift, self.mesh.faces, *inputs]
        wp.launch(kernel, dim=self.surface.face_count, inputs=given, outputs=outputs, device=self.device)

    def sent(self, values: Floats) -> wp.array:
        """Return points or vectors, shape [V, 2], as vec2d."""
        return self.copied(values, wp.vec2d)

    def flipped(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask of the triangles that are turned over, shape [F]."""
        return np.asarray(~(self.areas(self.sent(points)).numpy() > 0.0))

    def areas(self, points: wp.array) -> wp.array:
        """Return the signed area of every triangle, float64, shape [F]."""
        areas = self.empty(wp.float64, self.surface.face_count)
        self.launch(plane_areas, points, [], [areas])
        return areas

    def area_slopes(self, points: wp.array) -> wp.array:
        """Return the derivatives of every area by its corners, vec2d, shape [F, 3]."""
        slopes = self.empty(wp.vec2d, self.surface.face_count, 3)
        self.launch(plane_area_slopes, points, [], [slopes])
        return slopes

    def coordinates(self, points: wp.array, vectors: wp.array) -> wp.array:
        """Return the vectors, float64, shape [V, 2]: in the plane all frames are the axes."""
        return vectors.view(wp.float64)

    def vectors(self, points: wp.array, coordinates: wp.array) -> wp.array:
        """Return the coordinates as vec2d, shape [V]: in the plane all frames are the axes."""
        return coordinates.view(wp.vec2d)

    def moved(self, points: wp.array, direction: wp.array, share: wp.array, length: float) -> wp.array:
        """Return the points after a step along vectors, vec2d, shape [V]."""
        moved = self.empty(wp.vec2d, len(points))
        self.at_vertices(move_in_plane, [points, direction, share, wp.float64(length)], [moved])
        return moved

    def spoilt(self, moved: wp.array, volume: wp.array) -> wp.array:
        """Return 1 for every triangle that a step turns over or nearly flattens, 0 for others, float64, shape [F]."""
        marks = self.empty(wp.float64, len(volume))
        inputs = [self.areas(moved), volume]
        wp.launch(plane_trouble, dim=len(volume), inputs=inputs, outputs=[marks], device=self.device)
        return marks


class PlaneCost:
    """The squared distance that every vertex moves.

    Args:
        plane: where the vertices move.
        start: x in the plane, shape [V, 2].
    """

    def __init__(self, plane: Plane, start: Floats):
        self._plane, self._start = plane, plane.copied(start, wp.vec2d)

    def values(self, points: wp.array) -> wp.array:
        """Return |y_v - x_v|², shape [V]."""
        costs = self._plane.empty(wp.float64, len(points))
        self._plane.at_vertices(plane_costs, [self._start, points], [costs])
        return costs

    def gradient(
        self, points: wp.array, masses: wp.array, potential: wp.array, further: wp.array, weight: float
    ) -> wp.array:
        """Return the gradient of Σ masses_v cost_v + Σ potential_f area_f and a further one, vec2d, shape [V]."""
        plane = self._plane
        gradient = plane.empty(wp.vec2d, len(points))
        mesh = [self._start, points, plane.shift, plane.mesh.faces, masses, potential, *plane.mesh.vertex_corners]
        plane.at_vertices(plane_transport_gradient, [*mesh, further, wp.float64(weight)], [gradient])
        return gradient

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return the second derivative at the optimum, with raised eigenvalues, float64, shape [V, 4]."""
        metric, mesh = self._plane.empty(wp.float64, len(points), 4), self._plane.mesh
        weights = [masses, *mesh.vertex_corners, wp.float64(least)]
        inputs = [self._start, points, self._plane.shift, mesh.faces, *weights]
        self._plane.at_vertices(plane_cost_metric, inputs, [metric])
        return metric


class PlaneShape:
    """The distortion of the triangles, angle plus a weight times area, averaged over the surface.

    Args:
        plane: where the vertices move.
    """

    def __init__(self, plane: Plane):
        self._plane, surface = plane, plane.surface
        self._frames = plane.copied(triangle_frames(surface), wp.vec3d)
        self._weights = plane.copied(surface.face_areas / SPHERE_AREA, wp.float64)

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Floats], ShapeTerms]:
        """Begin to measure the distortion of a map, whose ``d_volume`` are the signed areas of triangles."""
        areas, angle, area = (self._plane.empty(wp.float64, self._plane.surface.face_count) for _ in range(3))
        self._plane.launch(plane_triangles, points, [self._frames], [areas, angle, area])
        mean_angle, mean_area = (reading.dot(self._weights, distortion) for distortion in (angle, area))
        return lambda numbers: ShapeTerms(float(numbers[mean_angle]), float(numbers[mean_area]), areas)

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient by the vertices, vec2d, shape [V]."""
        plane, weights = self._plane, [self._frames, self._weights, wp.float64(weight)]
        out, sums = plane.empty(wp.vec2d, plane.surface.face_count, 3), plane.empty(wp.vec2d, len(points))
        plane.launch(plane_gradients, points, weights, [out])
        plane.at_vertices(sum_at_vertices, [*plane.mesh.vertex_corners, out.flatten()], [sums])
        return sums

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return every triangle's Hessian, as :meth:`omtwarp.optimal.energy.Shape.hessian` describes it."""
        hessians = self._plane.empty(wp.float64, self._plane.surface.face_count, 21)
        weights = [self._frames, self._weights, wp.float64(weight)]
        self._plane.launch(plane_hessians, points, weights, [hessians])
        return hessians
