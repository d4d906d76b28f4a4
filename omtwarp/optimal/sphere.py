"""Maps to the sphere: its domain, and the cost of geodesic distances."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import Workspace, empty, vectors
from omtwarp.device.start import wp
from omtwarp.device.sums import Reading
from omtwarp.device.threads import FIRST_THREAD, Each, each, launch_parts
from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.arrays import normalised
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.cells import Cells, MeasuredRings, RingCells
from omtwarp.optimal.energy import AREA_WEIGHT, MapTerms, ShapeTerms, TransportEnergy
from omtwarp.optimal.kernels import area_slopes, cost_metric, transport_gradient, vertex_costs
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.further import VertexTerm
from omtwarp.solvers.mesh_factor import SaddlePointFactor
from omtwarp.solvers.motion_kernels import from_tangent, to_tangent
from omtwarp.untangling.kernels import solid_angles
from omtwarp.untangling.steps import FlipFreeSteps

Numbers = NDArray[np.float64]


class Sphere:
    """The unit sphere as the :class:`omtwarp.optimal.energy.Domain` of one surface's maps.

    Args:
        surface: V vertices, F faces.
        device: a Warp device.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self.surface, self.device = surface, device
        self._faces = surface.on(device).faces
        self._areas = empty(surface.face_count, wp.float64, device)

    def sent(self, values: Numbers) -> wp.array:
        """Return points or tangent vectors, shape [V, 3], as vec3d on the device."""
        return vectors(values, self.device)

    def flipped(self, points: Numbers) -> NDArray[np.bool_]:
        """Return a mask of the triangles that are turned over, decided exactly, shape [F]."""
        return flipped_faces(points, self.surface.faces)

    def areas(self, points: wp.array) -> wp.array:
        """Return the solid angle of every triangle, float64, shape [F]; valid until the next call."""
        inputs = [points, Each(self._faces)]
        launch_parts(solid_angles, self.surface.face_count, inputs, each(self._areas), self.device)
        return self._areas

    def area_slopes(self, points: wp.array) -> wp.array:
        """Return the derivatives of every solid angle by its corners, in their frames, vec2d, shape [F, 3]."""
        slopes = wp.empty((self.surface.face_count, 3), dtype=wp.vec2d, device=self.device)
        launch_parts(area_slopes, len(slopes), [points, self._faces, FIRST_THREAD], [slopes], self.device)
        return slopes

    def coordinates(self, points: wp.array, vectors: wp.array) -> wp.array:
        """Return vectors, vec3d, shape [V], in the tangent bases at ``points``, float64, shape [V, 2]."""
        out = wp.empty((len(vectors), 2), dtype=wp.float64, device=self.device)
        wp.launch(to_tangent, dim=len(vectors), inputs=[points, vectors], outputs=[out], device=self.device)
        return out

    def vectors(self, points: wp.array, coordinates: wp.array) -> wp.array:
        """Return the vectors with these coordinates in the tangent bases at ``points``, vec3d, shape [V]."""
        out = empty(len(points), wp.vec3d, self.device)
        wp.launch(from_tangent, dim=len(points), inputs=[points, coordinates], outputs=[out], device=self.device)
        return out

    def steps(self) -> FlipFreeSteps:
        """Return an object that moves maps along tangent vectors without flipping triangles."""
        return FlipFreeSteps(self.surface, self.device)

    def factor(self, cells: Cells, workspace: Workspace | None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every cell."""
        return cells.factor(workspace)


class GeodesicCost:
    """The squared geodesic distance that every vertex moves, or a soft distance.

    Args:
        surface: V vertices.
        start: x, unit vectors, vec3d, shape [V], on the device.
        device: a Warp device.
        softness: in radians; 0 for the squared distance, otherwise the cost is sqrt(d² + softness²) - softness.

    Attributes:
        start: x on the host, shape [V, 3].
    """

    def __init__(self, surface: Surface, start: wp.array, device: wp.Device, softness: float = 0.0):
        self._count, self._device, self._start = surface.vertex_count, device, start
        self.start: Numbers = start.numpy()
        self.softness = wp.float64(softness)
        self._mesh = surface.on(device)
        self._metric = wp.empty((self._count, 4), dtype=wp.float64, device=device)

    def values(self, points: wp.array) -> wp.array:
        """Return the cost of every vertex, shape [V]."""
        cost = empty(self._count, wp.float64, self._device)
        inputs = [*each(self._start, points), self.softness]
        launch_parts(vertex_costs, self._count, inputs, each(cost), self._device)
        return cost

    def gradient(
        self, points: wp.array, masses: wp.array, potential: wp.array, further: wp.array, weight: float
    ) -> wp.array:
        """Return the gradient of Σ masses_v cost_v + Σ potential_f area_f and a further one, vec3d, shape [V]."""
        gradient = empty(self._count, wp.vec3d, self._device)
        mesh = [self._start, points, self._mesh.faces, masses, potential, *self._mesh.vertex_corners]
        inputs = [*mesh, self.softness, further, wp.float64(weight), FIRST_THREAD]
        launch_parts(transport_gradient, self._count, inputs, [gradient], self._device)
        return gradient

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return the second derivative at the optimum, with raised eigenvalues, float64, shape [V, 4]."""
        mesh = [self._start, points, self._mesh.faces, masses, *self._mesh.vertex_corners]
        inputs = [*mesh, wp.float64(least), self.softness, FIRST_THREAD]
        launch_parts(cost_metric, self._count, inputs, [self._metric], self._device)
        return self._metric


class NoCost(GeodesicCost):
    """A cost that counts nothing: it and its second derivative are 0, and areas alone have a gradient."""

    def values(self, points: wp.array) -> wp.array:
        """Return zeros, shape [V]."""
        return wp.zeros(self._count, dtype=wp.float64, device=self._device)

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return zeros, shape [V, 4]."""
        return wp.zeros((self._count, 4), dtype=wp.float64, device=self._device)


class SphereShape:
    """The distortion of the triangles of a surface's maps to the sphere.

    Args:
        distortion: evaluates it.
    """

    def __init__(self, distortion: DistortionEnergy):
        self.distortion = distortion

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Numbers], Terms]:
        """Begin to measure the distortion of a map."""
        return self.distortion.begin(points, reading)

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient by the vertices, tangent to the sphere, vec3d, shape [V]."""
        assert isinstance(terms, Terms)
        return self.distortion.gradient(points, terms, weight)

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return every triangle's Hessian, shape [F, 21], as :meth:`DistortionEnergy.hessian` does."""
        assert isinstance(terms, Terms)
        return self.distortion.hessian(points, terms, weight)


def energy_on_sphere(
    surface: Surface,
    start: wp.array,
    device: wp.Device,
    shape_weight: float,
    *,
    domain: Sphere | None = None,
    cells: Cells | None = None,
    area_weight: float = AREA_WEIGHT,
    softness: float = 0.0,
) -> TransportEnergy:
    """Return the energy of maps of a surface to the sphere.

    Args:
        surface: V vertices.
        start: x, unit vectors, vec3d, shape [V], on the device.
        device: a Warp device.
        shape_weight, area_weight: as of :class:`TransportEnergy`.
        domain: that of symmetric maps of a double, in place of that of all maps.
        cells: whose areas are kept; the triangles around vertices by default.
        softness: as of :class:`GeodesicCost`.
    """
    kept = RingCells(surface, device) if cells is None else cells
    cost, shape = GeodesicCost(surface, start, device, softness), SphereShape(DistortionEnergy(surface, device))
    where = Sphere(surface, device) if domain is None else domain
    workspace = shape.distortion.workspace
    energy = TransportEnergy(where, kept, cost, shape, shape_weight, area_weight=area_weight, workspace=workspace)
    energy.has_local_steps = domain is None and isinstance(kept, RingCells)
    return energy


class ShapeEnergy(TransportEnergy):
    """The distortion of the triangles of maps to the sphere, and no cost of transport.

    Args:
        surface: V vertices.
        device: a Warp device.
        area_weight: λ, of area against angle distortion.
        most_strain, vertex_term: a barrier and a further term, as of :class:`omtwarp.refine.energy.DistortionEnergy`.
        cells: whose areas are kept; by default those around vertices are measured and not kept.
    """

    def __init__(
        self,
        surface: Surface,
        device: wp.Device,
        area_weight: float,
        *,
        most_strain: float | None = None,
        vertex_term: VertexTerm | None = None,
        cells: Cells | None = None,
    ):
        self.distortion = DistortionEnergy(surface, device, most_strain=most_strain, vertex_term=vertex_term)
        kept = MeasuredRings(surface, device) if cells is None else cells
        cost = NoCost(surface, vectors(normalised(surface.vertices), device), device)
        domain, shape, workspace = Sphere(surface, device), SphereShape(self.distortion), self.distortion.workspace
        super().__init__(domain, kept, cost, shape, 1.0, 0.0, area_weight, workspace=workspace)
        # The kernel of local steps knows neither the barrier nor the further term.
        self.has_local_steps = isinstance(kept, RingCells) and not self.distortion.extended

    def cost(self, terms: MapTerms) -> float:
        """Return 4π, a mean of 1: gains are compared with the distortion, not with a cost."""
        return SPHERE_AREA

    def vertex_metric(self, points: wp.array, terms: MapTerms) -> wp.array:
        """Return the second derivative of the term at vertices, float64, shape [V, 4]; zeros without one."""
        assert isinstance(terms.shape, Terms)
        further = self.distortion.vertex_blocks(points, terms.shape)
        if further is None:
            return super().vertex_metric(points, terms)
        return wp.array(further.reshape(-1, 4), dtype=wp.float64, device=self.device)


__all__ = ["GeodesicCost", "ShapeEnergy", "Sphere", "SphereShape", "energy_on_sphere"]
