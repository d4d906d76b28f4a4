"""Energy that the optimal map to a flat torus minimises, and its derivatives.

The problem is that of :mod:`omtwarp.optimal.energy` in the plane, with y_v - x_v in the universal cover in place of a
geodesic: minimise C(y) + β S(y) over the maps whose areas around vertices are those of the surface, the cost written as
C' = Σ a_v |y_v - x_v|² / 12π. A map of least cost is the gradient of a convex function |x|²/2 + φ with φ periodic, so
that each point is moved to the nearest copy of its image on the torus (D. Cordero-Erausquin,
"Sur le transport de mesures périodiques", Comptes Rendus 329, 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.energy import AREA_WEIGHT, MAX_RING_ERROR, MAX_RING_RMS
from omtwarp.solvers.mesh_factor import SaddlePointFactor, surface_saddle_factor
from omtwarp.solvers.triangle_newton.frames import triangle_frames
from omtwarp.solvers.triangle_newton.newton import NewtonMatrix
from omtwarp.torus import kernels
from omtwarp.torus.harmonic import FlatTorus

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PlaneTerms:
    """Quantities of one map.

    Attributes:
        triangles: signed areas in the universal cover, shape [F].
        cells: the areas that are constrained, of the triangles around every vertex, shape [V].
        square: |y_v - x_v|², shape [V].
        angle, area: mean distortions of the triangles; infinite where one is turned over.
    """

    triangles: Floats
    cells: Floats
    square: Floats
    angle: float
    area: float


class TorusEnergy:
    """Evaluates maps of one surface to one torus.

    Args:
        surface: of genus 1, V vertices; its areas add up to 4π, as the torus's does.
        torus: the wraps and the lattice.
        start: x in the plane, shape [V, 2].
        shape_weight: β.
        cost_weight: factor of the cost; 0 leaves the shape alone.
        area_weight: λ of the shape, the weight of area distortion against angle distortion.

    Attributes:
        wanted: the areas that constraints ask for, three times the masses, shape [V].
        area_tolerances: root mean square and largest relative error up to which they count as kept.
    """

    area_tolerances = (MAX_RING_RMS, MAX_RING_ERROR)

    def __init__(
        self,
        surface: Surface,
        torus: FlatTorus,
        start: Floats,
        shape_weight: float,
        cost_weight: float = 1.0,
        area_weight: float = AREA_WEIGHT,
    ):
        self.surface, self.shape_weight, self.cost_weight = surface, shape_weight, cost_weight
        self.area_weight, self.start = area_weight, start
        self.wanted = 3.0 * surface.vertex_areas
        mesh = surface.on("cpu")
        self.rows: list[wp.array] = mesh.vertex_corners
        self._mesh = mesh
        self._weights = surface.face_areas / SPHERE_AREA
        self._shift = self._kept(torus.wraps @ torus.lattice, wp.vec2d)
        self._frames = self._kept(triangle_frames(surface), wp.vec3d)
        self._newton = NewtonMatrix.of_surface(surface)

    def saddle_factor(self) -> SaddlePointFactor:
        """Factorise the matrices that :meth:`blocks` gives."""
        return surface_saddle_factor(self.surface)

    def terms(self, points: Floats) -> PlaneTerms:
        """Return the areas, squared distances and distortion of a map, shape [V, 2]."""
        count = self.surface.face_count
        areas, angle, area = (wp.empty(count, dtype=wp.float64, device="cpu") for _ in range(3))
        self._launch(kernels.plane_triangles, count, [*self._map(points), self._frames], [areas, angle, area])
        triangles = areas.numpy()
        square = ((points - self.start) ** 2).sum(axis=1)
        means = [float(self._weights @ each.numpy()) + 2.0 for each in (angle, area)]
        return PlaneTerms(triangles, self.cells_of(triangles), square, means[0], means[1])

    def cells_of(self, triangles: Floats) -> Floats:
        """Return the areas that are constrained, from those of the triangles."""
        return self.surface.sum_to_vertices(triangles)

    def missing(self, terms: PlaneTerms) -> Floats:
        """Return the error of every constrained area: the area less the wanted one, shape [V]."""
        return terms.cells - self.wanted

    def area_errors(self, terms: PlaneTerms) -> tuple[float, float]:
        """Return the root mean square, weighted by area, and largest relative error of the areas."""
        relative = self.missing(terms) / self.wanted
        return float(np.sqrt((self.wanted * relative**2).sum() / self.wanted.sum())), float(np.abs(relative).max())

    def cost(self, terms: PlaneTerms) -> float:
        """Return the transport cost Σ m_v |y_v - x_v|², where the masses sum to 4π."""
        return float(self.surface.vertex_areas @ terms.square)

    def shape(self, terms: PlaneTerms) -> float:
        """Return the shape term β S."""
        return self.shape_weight * (terms.angle - 2.0 + self.area_weight * (terms.area - 2.0))

    def lagrangian(self, terms: PlaneTerms, multipliers: Floats) -> float:
        """Return the Lagrangian C' + Σ p_v (a_v - 3 m_v) + β S."""
        cost = self.cost_weight * float(terms.cells @ self.means(terms)) / self.wanted.sum()
        return cost + float(multipliers @ self.missing(terms)) + self.shape(terms)

    def means(self, terms: PlaneTerms) -> Floats:
        """Return the squared distance in every cell's term of the cost, shape [V]."""
        return terms.square

    def potential(self, terms: PlaneTerms, multipliers: Floats) -> Floats:
        """Return P_v, the potential at the images of the vertices, shape [V], from p_v."""
        return multipliers + self.cost_weight / self.wanted.sum() * self.means(terms)

    def masses(self, terms: PlaneTerms) -> Floats:
        """Return every vertex's share of the torus, times 4π, shape [V]."""
        return terms.cells / 3.0

    def gradient(self, points: Floats, terms: PlaneTerms, multipliers: Floats) -> Floats:
        """Return the gradient of the Lagrangian with respect to the vertices, shape [V, 2]."""
        count = self.surface.face_count
        potential = self.on_triangles(self.potential(terms, multipliers))
        out = wp.empty((count, 3), dtype=wp.vec2d, device="cpu")
        weights = [self._kept(self.shape_weight * self._weights, wp.float64), wp.float64(self.area_weight)]
        inputs = [*self._map(points), self._frames, *weights, self._kept(potential, wp.float64)]
        self._launch(kernels.plane_gradients, count, inputs, [out])
        sums = wp.empty(self.surface.vertex_count, dtype=wp.vec2d, device="cpu")
        self._launch(kernels.sum_at_vertices, self.surface.vertex_count, [*self.rows, out.flatten()], [sums])
        pull = self.cost_weight * 2.0 / SPHERE_AREA * self.masses(terms)
        return sums.numpy() + pull[:, None] * (points - self.start)

    def on_triangles(self, potential: Floats) -> Floats:
        """Return the factor of every triangle's area in the Lagrangian, shape [F]."""
        total: Floats = potential[self.surface.faces].sum(axis=1)
        return total

    def blocks(self, points: Floats, terms: PlaneTerms, least: float) -> tuple[Floats, Floats, Floats]:
        """Return the second derivative of the Lagrangian and first derivatives of the areas.

        Args:
            points: the map, shape [V, 2].
            terms: of the map.
            least: to which eigenvalues of the inverse map's derivative are raised.

        Returns:
            Blocks of the vertices, shape [V, 2, 2], and of the edges, shape [E, 2, 2], positive semidefinite as a
            matrix; and the derivatives as the factor of :meth:`saddle_factor` takes them.
        """
        faces, count = self.surface.face_count, self.surface.vertex_count
        hessians = wp.empty((faces, 21), dtype=wp.float64, device="cpu")
        weights = [self._kept(self.shape_weight * self._weights, wp.float64), wp.float64(self.area_weight)]
        self._launch(kernels.plane_hessians, faces, [*self._map(points), self._frames, *weights], [hessians])
        diagonal, off_diagonal = self._newton.assemble(hessians.numpy())
        scale = self.cost_weight * 2.0 / SPHERE_AREA * self.masses(terms)
        metric = wp.empty((count, 4), dtype=wp.float64, device="cpu")
        inputs = [self._kept(self.start, wp.vec2d), *self._map(points), self._kept(scale, wp.float64), *self.rows]
        self._launch(kernels.plane_cost_metric, count, [*inputs, wp.float64(least)], [metric])
        return diagonal + metric.numpy().reshape(-1, 2, 2), off_diagonal, self.area_derivatives(points)

    def area_derivatives(self, points: Floats) -> Floats:
        """Return the derivatives of the areas around vertices across every edge, both ways, shape [2, E, 2]."""
        edges = len(self.surface.edges)
        forward, backward = (wp.empty(edges, dtype=wp.vec2d, device="cpu") for _ in range(2))
        inputs = [*self._map(points), self._mesh.edges, self._mesh.edge_corners]
        self._launch(kernels.plane_couplings, edges, inputs, [forward, backward])
        return np.stack([forward.numpy(), backward.numpy()])

    def _map(self, points: Floats) -> list[wp.array]:
        return [self._kept(points, wp.vec2d), self._shift, self._mesh.faces]

    @staticmethod
    def _kept(values: NDArray, dtype: type) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=dtype, device="cpu")

    @staticmethod
    def _launch(kernel: wp.Kernel, count: int, inputs: list[object], outputs: list[wp.array]) -> None:
        wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device="cpu")


__all__ = ["PlaneTerms", "TorusEnergy"]
