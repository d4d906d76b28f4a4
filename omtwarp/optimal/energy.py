"""The energy that the discrete optimal map minimises, and its derivatives.

Vertex v of the surface has mass m_v (a third of the area of the triangles around it, 4π in all), lies at x_v on the
conformal sphere and is mapped to y_v. With a_v(y) the solid angle of the triangles around v, the discrete problem is

    minimise  C(y) + β S(y)   subject to   a_v(y) = 3 m_v for every vertex,    C = Σ m_v d(x_v, y_v)² / 4π,

where S is angle plus area distortion of the triangles (:mod:`omtwarp.refine.energy`) and β is small. To keep the areas
of all triangles instead would leave a map no freedom: 2V - 5 conditions on 2V - 3 coordinates. To keep the areas around
vertices, on which the paper's density is defined, leaves half of it, as in the smooth problem. Some modes of a mesh
change neither C nor these areas; S determines them.

The cost is written with the areas of the image in place of the masses, C' = Σ a_v d(x_v, y_v)² / 12π. On maps that keep
the areas C' = C, so that the problem is the same. But the multipliers p_v of C' belong to the points x_v, and do not
change when y moves: they are -1/6π times Kantorovich's potential at x_v, while P_v = p_v + d(x_v, y_v)² / 12π is the
potential at y_v. With the multipliers of C, which belong to y_v, the second derivative of the Lagrangian has large
indefinite terms of first order. With those of C' these terms cancel up to the error of the mesh. What remains is, at
each vertex,

    H_v = a_v / 6π · (second derivative of d²/2 - ψ) = a_v / 6π · (derivative of the inverse map y -> x),

symmetric and positive at the optimum (Ma, Trudinger and Wang 2005): :func:`omtwarp.optimal.kernels.cost_metric`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty
from omtwarp.device.start import wp
from omtwarp.device.threads import cut, launch_parts
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.kernels import cost_metric, ring_couplings, ring_terms, transport_gradient
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.solvers.mesh_factor import SaddlePointFactor, surface_saddle_factor
from omtwarp.solvers.triangle_newton.newton import NewtonMatrix
from omtwarp.untangling.kernels import solid_angles
from omtwarp.untangling.steps import FlipFreeSteps

Numbers = NDArray[np.float64]

# λ of the shape term: weight of the area distortion of triangles against angle distortion, large enough that no
# slivers arise.
AREA_WEIGHT = 10.0
# The first share of the curvature that the matrix keeps, see omtwarp.refine.kernels.triangle_hessian, and the least
# later: with 1 as the first a scan of 40,000 triangles takes 11 steps in place of 6.
MIN_CURVATURE_SHARE = 0.03
# Largest root mean square and largest single relative error of the areas around vertices that count as kept.
MAX_RING_RMS, MAX_RING_ERROR = 2e-4, 9e-3


@dataclass(frozen=True)
class MapTerms:
    """The terms of a map's energy: areas, squared distances and distortion.

    Attributes:
        ring: the constrained areas, a_v, shape [V].
        cost: of moving every vertex, d(x_v, y_v)² or the soft distance, shape [V].
        shape: terms of the distortion of the triangles.
    """

    ring: Numbers
    cost: Numbers
    shape: Terms


class TransportEnergy:
    """Evaluates the energy of maps of one surface, and its derivatives.

    Args:
        surface: the surface, V vertices, F faces and E edges.
        start: x, unit vectors, vec3d, shape [V], on the device.
        device: a Warp device.
        shape_weight: β.
        cost_weight: factor of the cost; with 0 only the shape counts.
        area_weight: λ of the shape.
        softness: in radians; 0 for the squared distance, otherwise the cost is sqrt(d² + softness²) - softness.

    Attributes:
        wanted: the areas that constraints ask for, 3 m_v, shape [V].
        area_tolerances: root mean square and largest relative error up to which areas count as kept.
        exact_tolerance: largest relative error after :func:`omtwarp.optimal.restoration.restore_areas`.
        start_points: x on the host, shape [V, 3].
        first_curvature_share: share of the curvature in the first matrix of a minimisation.
        local_steps: whether :class:`omtwarp.optimal.local.LocalSteps` may move single vertices of the maps.
    """

    local_steps = True
    first_curvature_share = MIN_CURVATURE_SHARE
    area_tolerances = (MAX_RING_RMS, MAX_RING_ERROR)
    exact_tolerance = 1e-6

    def __init__(
        self,
        surface: Surface,
        start: wp.array,
        device: wp.Device,
        shape_weight: float,
        cost_weight: float = 1.0,
        area_weight: float = AREA_WEIGHT,
        softness: float = 0.0,
    ):
        self.softness = wp.float64(softness)
        self.surface, self.device, self.shape_weight, self.cost_weight = surface, device, shape_weight, cost_weight
        self.area_weight = area_weight
        self.shape = DistortionEnergy(surface, device)
        self.wanted = 3.0 * surface.vertex_areas
        mesh = surface.on(device)
        self._start, self._mesh, self._rows = start, mesh, mesh.vertex_corners
        self.start_points: Numbers = start.numpy()
        count, faces, edges = surface.vertex_count, surface.face_count, len(surface.edges)
        self._solid = empty(faces, wp.float64, device)
        self._forward, self._backward = (empty(edges, wp.vec2d, device) for _ in range(2))
        self._metric = wp.empty((count, 4), dtype=wp.float64, device=device)
        self._newton = NewtonMatrix.of_surface(surface, self.shape.workspace)

    def saddle_factor(self) -> SaddlePointFactor:
        """Return an object that factorises the matrices of :meth:`blocks`."""
        return surface_saddle_factor(self.surface, self.shape.workspace)

    def flip_free_steps(self) -> FlipFreeSteps:
        """Return an object that moves maps along directions without flipping triangles."""
        return FlipFreeSteps(self.surface, self.device)

    def terms(self, points: wp.array) -> MapTerms:
        """Return the areas around vertices, squared distances and distortion of a map, vec3d, shape [V]."""
        count, faces = self.surface.vertex_count, self._mesh.faces
        ring, cost = (empty(count, wp.float64, self.device) for _ in range(2))

        def of_triangles(part: slice) -> tuple[list[object], list[object]]:
            return [points, cut(faces, part)], [cut(self._solid, part)]

        def of_vertices(part: slice) -> tuple[list[object], list[object]]:
            return [self._start, points, self._solid, *self._rows, self.softness, part.start], [ring, cost]

        launch_parts(solid_angles, self.surface.face_count, of_triangles, self.device)
        launch_parts(ring_terms, count, of_vertices, self.device)
        return MapTerms(ring.numpy(), cost.numpy(), self.shape.terms(points))

    def potential(self, terms: MapTerms, multipliers: Numbers) -> Numbers:
        """Return P_v = p_v + d(x_v, y_v)² / 12π, the potential at the images of the vertices, shape [V]."""
        return multipliers + self.cost_weight / (3.0 * SPHERE_AREA) * terms.cost

    def lagrangian(self, terms: MapTerms, multipliers: Numbers) -> float:
        """Return the Lagrangian C' + Σ p_v (a_v - 3 m_v) + β S."""
        cost = self.cost_weight * float(terms.ring @ terms.cost) / (3.0 * SPHERE_AREA)
        return cost + float(multipliers @ self.missing(terms)) + self.shape_weight * terms.shape.total(self.area_weight)

    def missing(self, terms: MapTerms) -> Numbers:
        """Return the error of every constrained area, a_v - 3 m_v, shape [V]."""
        return terms.ring - self.wanted

    def ring_errors(self, terms: MapTerms) -> tuple[float, float]:
        """Return the root mean square (weighted by area) and the largest of the relative errors a_v / 3 m_v - 1."""
        relative = self.missing(terms) / self.wanted
        return float(np.sqrt((self.wanted * relative**2).sum() / self.wanted.sum())), float(np.abs(relative).max())

    def cost(self, terms: MapTerms) -> float:
        """Return the transport cost Σ m_v d(x_v, y_v)², where the masses sum to 4π."""
        return float(self.surface.vertex_areas @ terms.cost)

    def gradient(self, points: wp.array, terms: MapTerms, multipliers: Numbers) -> Numbers:
        """Return the gradient of the Lagrangian with respect to the vertices, tangent to the sphere, shape [V, 3]."""
        count, device = self.surface.vertex_count, self.device
        ring = wp.array(terms.ring, dtype=wp.float64, device=device, copy=False)
        potential = wp.array(self.potential(terms, multipliers), dtype=wp.float64, device=device, copy=False)
        gradient = empty(count, wp.vec3d, device)
        factor = wp.float64(self.cost_weight * 2.0 / (3.0 * SPHERE_AREA))

        def around(part: slice) -> tuple[list[object], list[object]]:
            mesh = [self._start, points, self._mesh.faces, ring, potential, *self._rows]
            inputs = [*mesh, factor, self.softness, part.start]
            return inputs, [gradient]

        launch_parts(transport_gradient, count, around, device)
        shape = self.shape.gradient(points, terms.shape, self.area_weight)
        return gradient.numpy() + self.shape_weight * shape.numpy()

    def blocks(
        self, points: wp.array, terms: MapTerms, curvature_share: float, least: float
    ) -> tuple[Numbers, Numbers, Numbers]:
        """Return the second derivative of the Lagrangian and the first derivatives of the areas, in tangent bases.

        Args:
            points: the map, vec3d, shape [V].
            terms: the terms of the map.
            curvature_share: see :func:`omtwarp.refine.kernels.triangle_hessian`.
            least: see :func:`omtwarp.optimal.kernels.cost_metric`.

        Returns:
            The blocks of the vertices, shape [V, 2, 2], and of the edges, shape [E, 2, 2], of a positive semidefinite
            matrix; and the areas' derivatives as :meth:`omtwarp.solvers.cholesky.SaddleFactor.factorise` takes them.
        """
        count, device = self.surface.vertex_count, self.device
        hessians = self.shape.hessian(points, terms.shape, self.area_weight, curvature_share)
        diagonal, off_diagonal = (self.shape_weight * blocks for blocks in self._newton.assemble(hessians.numpy()))
        ring = wp.array(terms.ring, dtype=wp.float64, device=device, copy=False)
        numbers = [wp.float64(self.cost_weight * 2.0 / (3.0 * SPHERE_AREA)), wp.float64(least), self.softness]

        def around(part: slice) -> tuple[list[object], list[object]]:
            inputs = [self._start, points, self._mesh.faces, ring, *self._rows, *numbers, part.start]
            return inputs, [self._metric]

        def across(part: slice) -> tuple[list[object], list[object]]:
            inputs = [points, self._mesh.faces, self._mesh.edges[part], self._mesh.edge_corners[part]]
            return inputs, [self._forward[part], self._backward[part]]

        launch_parts(cost_metric, count, around, device)
        launch_parts(ring_couplings, len(off_diagonal), across, device)
        diagonal += self._metric.numpy().reshape(-1, 2, 2)
        return diagonal, off_diagonal, np.stack([self._forward.numpy(), self._backward.numpy()])
