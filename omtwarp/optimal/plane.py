"""Maps to the plane, of a torus's universal cover or of a disk: domain, squared distances, distortion of triangles.

A map of least cost to a torus is the gradient of a convex function |x|²/2 + φ with φ periodic, so that each point is
moved to the nearest copy of its image (D. Cordero-Erausquin, "Sur le transport de mesures périodiques", Comptes Rendus
329, 1999): y_v - x_v in the universal cover stands in place of a geodesic.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.sums import Reading
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal import plane_kernels as kernels
from omtwarp.optimal.domain import ShapeTerms
from omtwarp.solvers.triangle_newton.frames import triangle_frames
from omtwarp.untangling.steps import FlipFreeSteps

Floats = NDArray[np.float64]


class Plane:
    """The plane as the :class:`omtwarp.optimal.domain.Domain` of one surface's maps.

    Args:
        surface: V vertices and F faces; areas in the plane add up to 4π, as its own do.
        shift: of the corners of every triangle from where their vertices lie, across the seam of a torus's universal
            cover, shape [F, 3, 2].
        device: a Warp device.
    """

    def __init__(self, surface: Surface, shift: Floats, device: wp.Device):
        self.surface, self.device = surface, device
        self.mesh = surface.on(device)
        self.shift = self.kept(shift, wp.vec2d)

    def kept(self, values: Floats, dtype: type) -> wp.array:
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
        return self.kept(values, wp.vec2d)

    def flipped(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask of the triangles that are turned over, shape [F]."""
        return np.asarray(~(self.areas(self.sent(points)).numpy() > 0.0))

    def areas(self, points: wp.array) -> wp.array:
        """Return the signed area of every triangle, float64, shape [F]."""
        areas = self.empty(wp.float64, self.surface.face_count)
        self.launch(kernels.plane_areas, points, [], [areas])
        return areas

    def area_slopes(self, points: wp.array) -> wp.array:
        """Return the derivatives of every area by its corners, vec2d, shape [F, 3]."""
        slopes = self.empty(wp.vec2d, self.surface.face_count, 3)
        self.launch(kernels.plane_area_slopes, points, [], [slopes])
        return slopes

    def coordinates(self, points: wp.array, vectors: wp.array) -> wp.array:
        """Return the vectors, float64, shape [V, 2]: in the plane all frames are the axes."""
        out = self.empty(wp.float64, len(vectors), 2)
        self.at_vertices(kernels.taken_apart, [vectors], [out])
        return out

    def vectors(self, points: wp.array, coordinates: wp.array) -> wp.array:
        """Return the coordinates as vec2d, shape [V]: in the plane all frames are the axes."""
        out = self.empty(wp.vec2d, len(coordinates))
        self.at_vertices(kernels.put_together, [coordinates], [out])
        return out

    def steps(self) -> FlipFreeSteps:
        """Return an object that moves maps along vectors without turning triangles over."""
        return PlaneSteps(self)


class PlaneSteps(FlipFreeSteps):
    """Moves maps to the plane; triangles that a step would turn over hold their corners back.

    Args:
        plane: where the maps are.
    """

    _independent = False  # the whole map is looked at again where vertices are held back

    def __init__(self, plane: Plane):
        super().__init__(plane.surface, plane.device)
        self._plane = plane

    def untangled(self, moved: wp.array, marks: wp.array, weight: float) -> tuple[wp.array, int] | None:
        """Return None, as patches are for spheres."""
        return None

    def _moved(self, points: wp.array, direction: wp.array, share: wp.array | None, length: float) -> wp.array:
        whole = wp.full(len(points), 1.0, dtype=wp.float64, device=self._plane.device) if share is None else share
        moved = self._plane.empty(wp.vec2d, len(points))
        self._plane.at_vertices(kernels.move_in_plane, [points, direction, whole, wp.float64(length)], [moved])
        return moved

    def _marks(self, moved: wp.array, volume: wp.array) -> wp.array:
        areas = self._plane.areas(moved)
        marks, device = self._plane.empty(wp.float64, len(areas)), self._plane.device
        wp.launch(kernels.plane_trouble, dim=len(areas), inputs=[areas, volume], outputs=[marks], device=device)
        return marks


class PlaneCost:
    """The squared distance that every vertex moves.

    Args:
        plane: where the vertices move.
        start: x in the plane, shape [V, 2].
    """

    def __init__(self, plane: Plane, start: Floats):
        self._plane, self._start = plane, plane.kept(start, wp.vec2d)

    def values(self, points: wp.array) -> wp.array:
        """Return |y_v - x_v|², shape [V]."""
        costs = self._plane.empty(wp.float64, len(points))
        self._plane.at_vertices(kernels.plane_costs, [self._start, points], [costs])
        return costs

    def gradient(
        self, points: wp.array, masses: wp.array, potential: wp.array, further: wp.array, weight: float
    ) -> wp.array:
        """Return the gradient of Σ masses_v cost_v + Σ potential_f area_f and a further one, vec2d, shape [V]."""
        plane = self._plane
        gradient = plane.empty(wp.vec2d, len(points))
        mesh = [self._start, points, plane.shift, plane.mesh.faces, masses, potential, *plane.mesh.vertex_corners]
        plane.at_vertices(kernels.plane_transport_gradient, [*mesh, further, wp.float64(weight)], [gradient])
        return gradient

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return the second derivative at the optimum, with raised eigenvalues, float64, shape [V, 4]."""
        metric, mesh = self._plane.empty(wp.float64, len(points), 4), self._plane.mesh
        weights = [masses, *mesh.vertex_corners, wp.float64(least)]
        inputs = [self._start, points, self._plane.shift, mesh.faces, *weights]
        self._plane.at_vertices(kernels.plane_cost_metric, inputs, [metric])
        return metric


@dataclass(frozen=True)
class PlaneTerms:
    """The distortion of one map.

    Attributes:
        angle, area: mean distortions of the triangles, less 2; infinite where one is turned over.
        d_volume: signed areas of the triangles, float64, shape [F].
    """

    angle: float
    area: float
    d_volume: wp.array

    def total(self, weight: float) -> float:
        """Return angle plus ``weight`` times area distortion."""
        return self.angle + weight * self.area


class PlaneShape:
    """The distortion of the triangles, angle plus a weight times area, averaged over the surface.

    Args:
        plane: where the vertices move.
    """

    def __init__(self, plane: Plane):
        self._plane, surface = plane, plane.surface
        self._frames = plane.kept(triangle_frames(surface), wp.vec3d)
        self._weights = plane.kept(surface.face_areas / SPHERE_AREA, wp.float64)

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Floats], PlaneTerms]:
        """Begin to measure the distortion of a map."""
        count = self._plane.surface.face_count
        areas, angle, area = (self._plane.empty(wp.float64, count) for _ in range(3))
        self._plane.launch(kernels.plane_triangles, points, [self._frames], [areas, angle, area])
        mean_angle, mean_area = (reading.dot(self._weights, distortion) for distortion in (angle, area))
        return lambda numbers: PlaneTerms(float(numbers[mean_angle]), float(numbers[mean_area]), areas)

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient by the vertices, vec2d, shape [V]."""
        plane, weights = self._plane, [self._frames, self._weights, wp.float64(weight)]
        out, sums = plane.empty(wp.vec2d, plane.surface.face_count, 3), plane.empty(wp.vec2d, len(points))
        plane.launch(kernels.plane_gradients, points, weights, [out])
        plane.at_vertices(kernels.sum_at_vertices, [*plane.mesh.vertex_corners, out.flatten()], [sums])
        return sums

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return every triangle's Hessian without the areas' own curvature, shape [F, 21]."""
        hessians = self._plane.empty(wp.float64, self._plane.surface.face_count, 21)
        weights = [self._frames, self._weights, wp.float64(weight)]
        self._plane.launch(kernels.plane_hessians, points, weights, [hessians])
        return hessians
