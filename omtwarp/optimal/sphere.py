"""Maps to the sphere: their domain, the cost of geodesic distances, and the energy with NumPy arrays in and out."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import empty, vectors
from omtwarp.device.policy import HEAVY_LAUNCH, resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import FIRST_THREAD, Each, computed, each
from omtwarp.flips.exact import flipped_faces
from omtwarp.mesh.arrays import Floats, dots, normalised, real_number, real_numbers
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_surface, as_unit_vectors
from omtwarp.optimal.cells import Cells, MeasuredRings, RingCells
from omtwarp.optimal.energy import SHAPE_WEIGHT, Domain, MapTerms, Shape, TransportEnergy
from omtwarp.optimal.kernels import area_slopes, cost_metric, transport_gradient, vertex_costs
from omtwarp.optimal.shape import DistortionEnergy
from omtwarp.solvers.cholesky.saddle import COORDINATES
from omtwarp.solvers.mesh_factor import block_matrix
from omtwarp.solvers.motion_kernels import from_tangent, retract_to_sphere, to_tangent, triangle_trouble
from omtwarp.solvers.triangle import AREA_WEIGHT
from omtwarp.untangling.kernels import solid_angles


class Sphere(Domain):
    """The unit sphere as the :class:`omtwarp.optimal.energy.Domain` of one surface's maps.

    Args:
        surface: V vertices, F faces.
        device: a Warp device.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self.surface, self.device = surface, device
        self._faces = surface.on(device).faces
        self._examined = surface.face_count  # the first triangles, which are looked at after a step

    def sent(self, values: Floats) -> wp.array:
        """Return points or tangent vectors, shape [V, 3], as vec3d on the device."""
        return vectors(values, self.device)

    def flipped(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask of the triangles that are turned over, decided exactly, shape [F]."""
        return flipped_faces(points, self.surface.faces)

    def areas(self, points: wp.array) -> wp.array:
        """Return the solid angle of every triangle, float64, shape [F]."""
        areas = empty(self.surface.face_count, wp.float64, self.device)
        return computed(solid_angles, [points, Each(self._faces)], areas)

    def area_slopes(self, points: wp.array) -> wp.array:
        """Return the derivatives of every solid angle by its corners, in their frames, vec2d, shape [F, 3]."""
        slopes = wp.empty((self.surface.face_count, 3), dtype=wp.vec2d, device=self.device)
        return computed(area_slopes, [points, Each(self._faces)], slopes, HEAVY_LAUNCH)

    def coordinates(self, points: wp.array, vectors: wp.array) -> wp.array:
        """Return vectors, vec3d, shape [V], in the tangent bases at ``points``, float64, shape [V, 2]."""
        return computed(to_tangent, each(points, vectors), empty(len(vectors), wp.vec2d, self.device)).view(wp.float64)

    def vectors(self, points: wp.array, coordinates: wp.array) -> wp.array:
        """Return the vectors with these coordinates in the tangent bases at ``points``, vec3d, shape [V]."""
        return computed(from_tangent, each(points, coordinates), empty(len(points), wp.vec3d, self.device))

    def moved(self, points: wp.array, direction: wp.array, share: wp.array, length: float) -> wp.array:
        """Return the points after a step along tangent vectors, projected to the sphere, vec3d, shape [V]."""
        inputs = [*each(points, direction, share), wp.float64(length)]
        return computed(retract_to_sphere, inputs, empty(len(points), wp.vec3d, self.device))

    def spoilt(self, moved: wp.array, volume: wp.array) -> wp.array:
        """Return 1 for every triangle that a step flips or nearly flattens, 0 for others, float64, shape [F]."""
        marks = wp.zeros(self.surface.face_count, dtype=wp.float64, device=self.device)
        computed(triangle_trouble, [moved, *each(self._faces, volume)], marks[: self._examined])
        return marks

    def joined(self, freed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return vertices that move on their own, shape [V], with those that have to move with them."""
        return freed

    def completed(self, points: wp.array, multipliers: wp.array) -> tuple[wp.array, wp.array]:
        """Return a map and its multipliers where some vertices moved on their own, with those that depend on them."""
        return points, multipliers


class GeodesicCost:
    """The squared geodesic distance that every vertex moves, or a soft distance.

    Args:
        surface: V vertices.
        start: x, unit vectors, shape [V, 3], or vec3d, shape [V], on the device.
        device: a Warp device.
        softness: in radians; 0 for the squared distance, otherwise the cost is sqrt(d² + softness²) - softness.

    Attributes:
        start: x, vec3d, shape [V], on the device.
    """

    def __init__(self, surface: Surface, start: ArrayLike | wp.array, device: wp.Device, softness: float = 0.0):
        self._count, self._device, self.start = surface.vertex_count, device, vectors(start, device)
        self.softness = wp.float64(softness)
        self._mesh = surface.on(device)

    def values(self, points: wp.array) -> wp.array:
        """Return the cost of every vertex, shape [V]."""
        inputs = [*each(self.start, points), self.softness]
        return computed(vertex_costs, inputs, empty(self._count, wp.float64, self._device))

    def gradient(
        self, points: wp.array, masses: wp.array, potential: wp.array, further: wp.array, weight: float
    ) -> wp.array:
        """Return the gradient of Σ masses_v cost_v + Σ potential_f area_f and a further one, vec3d, shape [V]."""
        mesh = [self.start, points, self._mesh.faces, masses, potential, *self._mesh.vertex_corners]
        inputs = [*mesh, self.softness, further, wp.float64(weight), FIRST_THREAD]
        return computed(transport_gradient, inputs, empty(self._count, wp.vec3d, self._device), HEAVY_LAUNCH)

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return the second derivative at the optimum, with raised eigenvalues, float64, shape [V, 4]."""
        mesh = [self.start, points, self._mesh.faces, masses, *self._mesh.vertex_corners]
        inputs = [*mesh, wp.float64(least), self.softness, FIRST_THREAD]
        metric = wp.empty(self._count, dtype=wp.vec4d, device=self._device)
        return computed(cost_metric, inputs, metric, HEAVY_LAUNCH).view(wp.float64)


class NoCost(GeodesicCost):
    """A cost that counts nothing: it and its second derivative are 0, and areas alone have a gradient."""

    def values(self, points: wp.array) -> wp.array:
        """Return zeros, shape [V]."""
        return wp.zeros(self._count, dtype=wp.float64, device=self._device)

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return zeros, shape [V, 4]."""
        return wp.zeros((self._count, 4), dtype=wp.float64, device=self._device)


def energy_on_sphere(
    surface: Surface,
    start: ArrayLike | wp.array,
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
        start: x, as of :class:`GeodesicCost`.
        device: a Warp device.
        shape_weight, area_weight: as of :class:`TransportEnergy`.
        domain: that of symmetric maps of a double, in place of that of all maps.
        cells: whose areas are kept; the triangles around vertices by default.
        softness: as of :class:`GeodesicCost`.
    """
    cost, shape = GeodesicCost(surface, start, device, softness), DistortionEnergy(surface, device)
    where = Sphere(surface, device) if domain is None else domain
    energy = TransportEnergy(where, cells, cost, shape, shape_weight, 1.0, area_weight)
    energy.has_local_steps = isinstance(energy.cells, RingCells)
    return energy


class ShapeEnergy(TransportEnergy):
    """The distortion of the triangles of maps to the sphere, and no cost of transport.

    Args:
        surface: V vertices.
        device: a Warp device.
        area_weight: λ, of area against angle distortion.
        shape: what is minimised of the triangles, their distortion by default.
        cells: whose areas are kept; by default those around vertices are measured and not kept.
    """

    def __init__(
        self,
        surface: Surface,
        device: wp.Device,
        area_weight: float,
        *,
        shape: Shape | None = None,
        cells: Cells | None = None,
    ):
        distortion = DistortionEnergy(surface, device) if shape is None else shape
        kept = MeasuredRings(surface, device) if cells is None else cells
        cost = NoCost(surface, normalised(surface.vertices), device)
        super().__init__(Sphere(surface, device), kept, cost, distortion, 1.0, 0.0, area_weight)
        # The kernel of local steps knows the distortion alone.
        self.has_local_steps = isinstance(kept, RingCells) and shape is None

    def cost(self, terms: MapTerms) -> float:
        """Return 4π, a mean of 1: gains are compared with the distortion, not with a cost."""
        return SPHERE_AREA


class MapEnergy:
    """What the optimal map minimises, term by term, with its derivatives.

    The energy of a map y of points x is C + β (angle + λ area), C the mean of d(x, y)² or of the soft distance, under
    the condition that the areas around vertices are three times the masses: see :mod:`omtwarp.optimal.energy`.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices.
        start: the points x, unit vectors, shape [V, 3].
        shape_weight: β.
        area_weight: λ.
        softness: δ of the soft distance sqrt(d² + δ²) - δ, in radians; 0 for the squared distance.
        device: where the kernels run.

    Raises:
        OmtwarpError: the mesh, the points or a weight cannot be used.

    Example:
        >>> import omtwarp
        >>> from omtwarp.optimal import MapEnergy
        >>> surface = omtwarp.shapes.blob(sphere=320)
        >>> result = omtwarp.map_to_sphere(surface)
        >>> energy = MapEnergy(surface, result.conformal)
        >>> terms = energy.terms(result.sphere)
        >>> bool(terms["cost"] > 0.0 and abs(terms["areas"].sum() - 12 * 3.141592653589793) < 1e-9)
        True
    """

    def __init__(
        self,
        surface: MeshLike,
        start: ArrayLike,
        *,
        shape_weight: float = SHAPE_WEIGHT,
        area_weight: float = AREA_WEIGHT,
        softness: float = 0.0,
        device: str | None = "auto",
    ):
        where, mesh = resolve_device(device), as_surface(surface)
        x = as_unit_vectors(start, mesh.vertex_count)
        weight = real_number(shape_weight, "shape_weight", least=0.0)
        of_areas = real_number(area_weight, "area_weight", least=0.0)
        soft = real_number(softness, "softness", least=0.0)
        self._energy = energy_on_sphere(mesh, x, where, weight, area_weight=of_areas, softness=soft)
        self._count = mesh.vertex_count

    def terms(self, sphere: ArrayLike) -> dict[str, float | Floats]:
        """Return the terms of a map.

        Args:
            sphere: unit vectors, shape [V, 3].

        Returns:
            ``cost``, the mean squared or soft distance; ``angle`` and ``area``, mean distortions of the triangles less
            2; ``areas`` around the vertices, shape [V], and ``wanted``, what they are to be.
        """
        terms, energy = self._energy.terms(self._sent(sphere)), self._energy
        numbers = {"cost": energy.cost(terms) / SPHERE_AREA, "angle": terms.shape.angle, "area": terms.shape.area}
        return numbers | {"areas": terms.areas.numpy().copy(), "wanted": energy.wanted.copy()}

    def value(self, sphere: ArrayLike, multipliers: ArrayLike | None = None) -> float:
        """Return the Lagrangian: the energy plus Σ p_v (a_v - 3 m_v), where a cost counts by areas in place of masses.

        Args:
            sphere: unit vectors, shape [V, 3].
            multipliers: p_v, shape [V]; zeros where left out.
        """
        return self._energy.lagrangian(self._energy.terms(self._sent(sphere), self._multipliers(multipliers)))

    def gradient(self, sphere: ArrayLike, multipliers: ArrayLike | None = None) -> Floats:
        """Return the gradient of :meth:`value` by the vertices, tangent to the sphere, shape [V, 3]."""
        points = self._sent(sphere)
        gradient = self._energy.gradient(points, self._energy.terms(points), self._multipliers(multipliers))
        return np.array(gradient.numpy())

    def hessian_product(self, sphere: ArrayLike, direction: ArrayLike) -> Floats:
        """Return the product of the matrix of Newton's steps with tangent vectors, shape [V, 3].

        The matrix is symmetric and positive semidefinite: of the distortion of every triangle the part that is, and of
        the cost what its second derivative is at the optimum.

        Args:
            sphere: unit vectors, shape [V, 3].
            direction: shape [V, 3], of which the tangent part counts.
        """
        points, u = self._coordinates(sphere, direction)
        own, others, _, _ = self._energy.matrix.on_host()
        matrix = block_matrix(self._count, self._energy.surface.edges, own, others, COORDINATES)
        product = wp.array((matrix @ u.ravel()).reshape(u.shape), dtype=wp.float64, device=points.device)
        return np.array(self._energy.domain.vectors(points, product).numpy())

    def area_changes(self, sphere: ArrayLike, direction: ArrayLike) -> Floats:
        """Return the derivative of the areas around vertices along tangent vectors, shape [V]; arguments as before."""
        _, u = self._coordinates(sphere, direction)
        slopes = self._energy.matrix.on_host()[2].reshape(-1, COORDINATES)
        of, by = np.concatenate([self._energy.surface.edges, self._energy.surface.edges[:, ::-1]]).T
        return np.asarray(np.bincount(of, dots(slopes, u[by]), self._count), dtype=np.float64)

    def _coordinates(self, sphere: ArrayLike, direction: ArrayLike) -> tuple[wp.array, Floats]:
        """Compute the matrix of a map; return its points and a direction in their frames, shape [V, 2]."""
        points = self._sent(sphere)
        along = vectors(real_numbers(direction, "direction", (self._count, 3)), points.device)
        self._energy.blocks(points, self._energy.terms(points))
        return points, self._energy.domain.coordinates(points, along).numpy()

    def _sent(self, sphere: ArrayLike) -> wp.array:
        return self._energy.domain.sent(as_unit_vectors(sphere, self._count))

    def _multipliers(self, given: ArrayLike | None) -> wp.array:
        numbers = np.zeros(self._count) if given is None else real_numbers(given, "multipliers", (self._count,))
        return wp.array(numbers, dtype=wp.float64, device=self._energy.device)
