"""The energy that the discrete optimal map minimises, and its derivatives.

Vertex v of the surface has mass m_v (a third of the area of the triangles around it, 4π in all), lies at x_v on the
conformal sphere and is mapped to y_v. With a_v(y) the solid angle of the triangles around v, the discrete problem is

    minimise  C(y) + β S(y)   subject to   a_v(y) = 3 m_v for every vertex,    C = Σ m_v d(x_v, y_v)² / 4π,

where S is angle plus area distortion of the triangles (:mod:`omtwarp.refine.energy`) and β is small. Some modes of a
mesh change neither C nor these areas; S determines them. The formulas are the same where other cells than the triangles
around vertices keep their areas (:mod:`omtwarp.optimal.cells`), and on a torus (:mod:`omtwarp.torus.plane`).

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

from omtwarp.device.memory import Workspace
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.cells import Cells
from omtwarp.optimal.domain import Domain, Shape, ShapeTerms, VertexCost
from omtwarp.solvers.cholesky import NotPositiveDefinite
from omtwarp.solvers.mesh_factor import SaddlePointFactor
from omtwarp.solvers.triangle_newton.newton import TriangleSums
from omtwarp.untangling.steps import FlipFreeSteps

Numbers = NDArray[np.float64]

# λ of the shape term: weight of the area distortion of triangles against angle distortion, large enough that no
# slivers arise.
AREA_WEIGHT = 10.0
# Least eigenvalue kept of the inverse map's derivative: see omtwarp.optimal.kernels.cost_metric. Where x has shrunk
# a limb the cost hardly depends on the image.
LEAST_EIGENVALUE = 1e-3
# Added to the diagonal, relative to its mean: it holds the three rotations and makes H definite. Where rounding still
# leaves a pivot of the wrong sign, the diagonal grows by these shares, one after another.
REGULARISATION = 1e-8
STIFFER = (0.0, 1e-9, 1e-6, 1e-3)


@dataclass(frozen=True)
class MapTerms:
    """The terms of a map's energy: areas, squared distances and distortion.

    Attributes:
        areas: of the cells, a_c, shape [N].
        cost: of moving every vertex, d(x_v, y_v)² or the soft distance, shape [V].
        shape: terms of the distortion of the triangles.
    """

    areas: Numbers
    cost: Numbers
    shape: ShapeTerms


class TransportEnergy:
    """Evaluates the energy of maps of one surface, and its derivatives.

    Args:
        domain: where the vertices move.
        cells: whose areas are kept.
        cost: of every vertex's place.
        shape: distortion of the triangles.
        shape_weight: β.
        cost_weight: factor of the cost; with 0 only the shape counts.
        area_weight: λ of the shape.
        workspace: memory on the host for factorisations and Hessians.

    Attributes:
        surface: what is mapped, V vertices, F faces and E edges.
        device: a Warp device.
        exact_tolerance: largest relative error after :func:`omtwarp.optimal.restoration.restore_areas`.
        has_local_steps: whether :class:`omtwarp.optimal.local.LocalSteps` may move single vertices of the maps; they
            know the energy of :func:`omtwarp.optimal.sphere.energy_on_sphere` alone.
    """

    exact_tolerance = 1e-6

    def __init__(
        self,
        domain: Domain,
        cells: Cells,
        cost: VertexCost,
        shape: Shape,
        shape_weight: float,
        cost_weight: float = 1.0,
        area_weight: float = AREA_WEIGHT,
        *,
        workspace: Workspace | None = None,
    ):
        self.domain, self.cells, self.vertex_cost, self.shape = domain, cells, cost, shape
        self.shape_weight, self.cost_weight, self.area_weight = shape_weight, cost_weight, area_weight
        self.surface, self.device = domain.surface, domain.device
        self.has_local_steps = False
        self._workspace = workspace
        self._sums = TriangleSums.of_surface(domain.surface)
        self._covered = float(cells.wanted.sum())

    @property
    def wanted(self) -> Numbers:
        """The areas that constraints ask for, A_c, shape [N]."""
        return self.cells.wanted

    def saddle_factor(self) -> SaddlePointFactor:
        """Return an object that factorises the matrices of :meth:`blocks`."""
        return self.cells.factor(self._workspace)

    def flip_free_steps(self) -> FlipFreeSteps:
        """Return an object that moves maps along directions without flipping triangles."""
        return self.domain.steps()

    def terms(self, points: wp.array) -> MapTerms:
        """Return the areas of cells, costs of vertices and distortion of a map, shape [V]."""
        areas = self.cells.areas(self.domain.areas(points))
        return MapTerms(areas, self.vertex_cost.values(points), self.shape.terms(points))

    def potential(self, terms: MapTerms, multipliers: Numbers) -> Numbers:
        """Return P_c, p_c plus the mean cost of a cell over Σ A: the potential at its image, shape [N]."""
        return multipliers + self.cost_weight / self._covered * self.cells.means(terms.cost)

    def lagrangian(self, terms: MapTerms, multipliers: Numbers) -> float:
        """Return the Lagrangian C' + Σ p_c (a_c - A_c) + β S."""
        cost = float(self._masses(terms) @ terms.cost)
        return cost + float(multipliers @ self.missing(terms)) + self.shape_weight * terms.shape.total(self.area_weight)

    def missing(self, terms: MapTerms) -> Numbers:
        """Return the error of every constrained area, a_c - A_c, shape [N]."""
        return terms.areas - self.wanted

    def area_errors(self, terms: MapTerms) -> tuple[float, float]:
        """Return the root mean square (weighted by area) and the largest of the relative errors a_c / A_c - 1."""
        relative = self.missing(terms) / self.wanted
        return float(np.sqrt((self.wanted * relative**2).sum() / self.wanted.sum())), float(np.abs(relative).max())

    def cost(self, terms: MapTerms) -> float:
        """Return the transport cost Σ m_v d(x_v, y_v)², where the masses sum to 4π."""
        return float(self.surface.vertex_areas @ terms.cost)

    def gradient(self, points: wp.array, terms: MapTerms, multipliers: Numbers) -> Numbers:
        """Return the gradient of the Lagrangian with respect to the vertices, shape [V, 3], or [V, 2] in the plane."""
        potential = self.cells.on_triangles(self.potential(terms, multipliers))
        transport = self.vertex_cost.gradient(points, self._masses(terms), potential)
        return transport + self.shape_weight * self.shape.gradient(points, terms.shape, self.area_weight).numpy()

    def blocks(self, points: wp.array, terms: MapTerms) -> tuple[Numbers, Numbers, Numbers]:
        """Return the second derivative of the Lagrangian and the first derivatives of the areas, in the points' frames.

        Args:
            points: the map, shape [V].
            terms: the terms of the map.

        Returns:
            The blocks of the vertices, shape [V, 2, 2], and of the edges, shape [E, 2, 2], of a positive semidefinite
            matrix; and the areas' derivatives as :meth:`omtwarp.solvers.cholesky.SaddleFactor.factorise` takes them.
        """
        hessians = self.shape.hessian(points, terms.shape, self.area_weight)
        diagonal, off_diagonal = (self.shape_weight * blocks for blocks in self._sums.assemble(hessians.numpy()))
        diagonal += self.vertex_cost.hessian(points, self._masses(terms), LEAST_EIGENVALUE)
        return diagonal, off_diagonal, self.cells.slopes(self.domain, points)

    def factorise(
        self,
        factor: SaddlePointFactor,
        points: wp.array,
        terms: MapTerms,
        compliance: Numbers,
    ) -> Numbers:
        """Factorise the matrix of a map, with a larger diagonal where rounding made a pivot's sign wrong.

        Args:
            factor: as of :meth:`saddle_factor`.
            points, terms: as of :meth:`blocks`.
            compliance: how far areas may be off, C of the saddle-point system, shape [N].

        Returns:
            The blocks of the vertices, shape [V, 2, 2].

        Raises:
            OmtwarpError: the second derivative is not finite.
        """
        diagonal, off_diagonal, gradients = self.blocks(points, terms)
        own = diagonal[:, [0, 1], [0, 1]]
        for part in STIFFER:
            diagonal[:, [0, 1], [0, 1]] = own * (1.0 + part) + REGULARISATION * own.mean()
            try:
                factor.factorise(diagonal, off_diagonal, gradients, compliance)
            except NotPositiveDefinite:
                continue
            return diagonal
        raise OmtwarpError("the second derivative of the transport cost is not finite")

    def _masses(self, terms: MapTerms) -> Numbers:
        """Return the factor of every vertex's cost in the Lagrangian, shape [V]."""
        return self.cost_weight / SPHERE_AREA * self.cells.masses(terms.areas)


__all__ = ["AREA_WEIGHT", "LEAST_EIGENVALUE", "MapTerms", "TransportEnergy"]
