"""The energy that the discrete optimal map minimises, and its derivatives.

Vertex v of the surface has mass m_v (a third of the area of the triangles around it, 4π in all), lies at x_v on the
conformal sphere and is mapped to y_v. With a_v(y) the solid angle of the triangles around v, the discrete problem is

    minimise  C(y) + β S(y)   subject to   a_v(y) = 3 m_v for every vertex,    C = Σ m_v d(x_v, y_v)² / 4π,

where S is angle plus area distortion of the triangles (:mod:`omtwarp.optimal.shape`) and β is small. Some modes of a
mesh change neither C nor these areas; S determines them. The formulas are the same where other cells than the triangles
around vertices keep their areas (:mod:`omtwarp.optimal.cells`).

The cost is written with the areas of the image in place of the masses, C' = Σ a_v d(x_v, y_v)² / 12π. On maps that keep
the areas C' = C, so that the problem is the same. But the multipliers p_v of C' belong to the points x_v, and do not
change when y moves: they are -1/6π times Kantorovich's potential at x_v, while P_v = p_v + d(x_v, y_v)² / 12π is the
potential at y_v. With the multipliers of C, which belong to y_v, the second derivative of the Lagrangian has large
indefinite terms of first order. With those of C' these terms cancel up to the error of the mesh. What remains is, at
each vertex,

    H_v = a_v / 6π · (second derivative of d²/2 - ψ) = a_v / 6π · (derivative of the inverse map y -> x),

symmetric and positive at the optimum (Ma, Trudinger and Wang 2005): :func:`omtwarp.optimal.kernels.cost_metric`.

Where vertices move, what their places cost and how triangles are shaped are three protocols, of which a sphere
(:mod:`omtwarp.optimal.sphere`) and the plane (:mod:`omtwarp.optimal.plane`) have each a class. Points and vectors of
vertices are arrays on the device, of vec3d on the sphere and vec2d in the plane. Every point has a frame, two
directions of unit length at right angles: matrices are written in coordinates along them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import Workspace, empty, sent
from omtwarp.device.start import wp
from omtwarp.device.sums import Reading, combine, scaled, sums_for
from omtwarp.device.threads import Each, each, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.cells import Cells, RingCells
from omtwarp.optimal.kernels import area_errors, raise_diagonal
from omtwarp.optimal.shape import DistortionEnergy, ShapeTerms
from omtwarp.solvers.cholesky.saddle import COORDINATES, SaddleMatrix
from omtwarp.solvers.factor import NotPositiveDefinite
from omtwarp.solvers.mesh_factor import SaddlePointFactor
from omtwarp.solvers.newton import gather_blocks
from omtwarp.solvers.triangle import AREA_WEIGHT


class Domain(Protocol):
    """Where the vertices of one surface's maps move: V vertices, F triangles, D coordinates a point.

    Attributes:
        surface: what is mapped.
        device: a Warp device.
    """

    surface: Surface
    device: wp.Device

    def sent(self, values: Floats) -> wp.array:
        """Return points or vectors of the vertices, shape [V, D], as an array on the device."""

    def flipped(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask of the triangles that are turned over, shape [F]."""

    def areas(self, points: wp.array) -> wp.array:
        """Return the area of every triangle, negative where it is turned over, float64, shape [F]."""

    def area_slopes(self, points: wp.array) -> wp.array:
        """Return the derivatives of every area by its corners, in their frames, vec2d, shape [F, 3]."""

    def coordinates(self, points: wp.array, vectors: wp.array) -> wp.array:
        """Return vectors, shape [V], in the frames at ``points``, float64, shape [V, 2]."""

    def vectors(self, points: wp.array, coordinates: wp.array) -> wp.array:
        """Return the vectors with these coordinates, float64, shape [V, 2], in the frames at ``points``, shape [V]."""

    def moved(self, points: wp.array, direction: wp.array, share: wp.array, length: float) -> wp.array:
        """Return the points after a step along vectors, of which every vertex takes its share, float64, shape [V]."""

    def spoilt(self, moved: wp.array, volume: wp.array) -> wp.array:
        """Return 1 for every triangle that a step turns over or nearly flattens, 0 for others, float64, shape [F].

        Args:
            moved: the points after the step.
            volume: ``d_volume`` of the map before it: see :class:`ShapeTerms`.
        """

    def factor(self, cells: Cells, workspace: Workspace | None) -> SaddlePointFactor:
        """Return what factorises matrices with a multiplier for every cell: what the cells have, by default."""
        return cells.factor(workspace)


class VertexCost(Protocol):
    """A cost of every vertex's place; arrays are float64 on the device."""

    def values(self, points: wp.array) -> wp.array:
        """Return the cost of every vertex, shape [V]."""

    def gradient(
        self, points: wp.array, masses: wp.array, potential: wp.array, further: wp.array, weight: float
    ) -> wp.array:
        """Return the gradient of Σ masses_v cost_v + Σ potential_f area_f by the vertices, shape [V].

        Masses, shape [V], and the potential of every triangle, shape [F], are taken as constant. ``weight`` times a
        further gradient is added.
        """

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return the second derivative of what :meth:`gradient` differentiates, at the optimum, shape [V, 4].

        Of each 2x2 matrix row by row, in the frame of the point. Eigenvalues are raised to ``least`` times twice the
        mass.
        """


class Shape(Protocol):
    """The distortion of the triangles of one surface's maps."""

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Floats], ShapeTerms]:
        """Begin to measure the distortion of a map; return what makes its terms of the numbers that are read."""

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient by the vertices of the total of ``terms``."""

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return every triangle's Hessian in its corners' frames, semidefinite: on and above the diagonal, [F, 21]."""


SHAPE_WEIGHT = 0.01  # β: on scans the optimal cost rises by some 0.04 %, and the map is smooth
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

    Arrays are float64 on the device, numbers are on the host.

    Attributes:
        areas: of the cells, a_c, shape [N].
        missing: errors of the areas, a_c - A_c, shape [N].
        relative: the same over A_c, shape [N].
        cost: of moving every vertex, d(x_v, y_v)² or the soft distance, shape [V].
        shape: terms of the distortion of the triangles.
        moved: Σ m_v cost_v, where the masses sum to 4π.
        charged: Σ a_c times the mean cost of the cell.
        squares: Σ (a_c - A_c)² / A_c.
        largest: the largest relative error of an area.
        pressed: Σ p_c (a_c - A_c) with the multipliers that the terms were asked for with; 0 without.
    """

    areas: wp.array
    missing: wp.array
    relative: wp.array
    cost: wp.array
    shape: ShapeTerms
    moved: float
    charged: float
    squares: float
    largest: float
    pressed: float


class TransportEnergy:
    """Evaluates the energy of maps of one surface, and its derivatives.

    Args:
        domain: where the vertices move.
        cells: whose areas are kept; the triangles around vertices where it is None.
        cost: of every vertex's place.
        shape: distortion of the triangles.
        shape_weight: β.
        cost_weight: factor of the cost; with 0 only the shape counts.
        area_weight: λ of the shape.

    Attributes:
        surface: what is mapped, V vertices, F faces and E edges.
        device: a Warp device.
        wanted: the areas that constraints ask for, A_c, shape [N].
        reading: numbers on their way from the device.
        matrix: of the last Newton step.
        exact_tolerance: largest relative error after :func:`omtwarp.optimal.exact.restore_areas`.
        has_local_steps: whether :class:`omtwarp.optimal.local.LocalSteps` may move single vertices of the maps; they
            know the energy of :func:`omtwarp.optimal.sphere.energy_on_sphere` alone.
    """

    exact_tolerance = 1e-6

    def __init__(
        self,
        domain: Domain,
        cells: Cells | None,
        cost: VertexCost,
        shape: Shape,
        shape_weight: float,
        cost_weight: float = 1.0,
        area_weight: float = AREA_WEIGHT,
    ):
        cells = RingCells(domain.surface, domain.device) if cells is None else cells
        self.domain, self.cells, self.vertex_cost, self.shape = domain, cells, cost, shape
        self.shape_weight, self.cost_weight, self.area_weight = shape_weight, cost_weight, area_weight
        self.surface, self.device = domain.surface, domain.device
        self.has_local_steps = False
        self.reading = Reading(self.device)
        self._workspace = shape.workspace if isinstance(shape, DistortionEnergy) else None
        self.wanted, self._covered = cells.wanted, float(cells.wanted.sum())
        self._wanted = sent(cells.wanted, wp.float64, self.device)
        self._masses = self.surface.on(self.device).vertex_areas
        sizes = self.surface.vertex_count, len(self.surface.edges), cells.multipliers, cells.slope_count
        self.matrix = SaddleMatrix(*sizes, self.device)
        self._total = wp.zeros(1, dtype=wp.float64, device=self.device)

    @cached_property
    def factor(self) -> SaddlePointFactor:
        """What factorises the matrices of :meth:`blocks`, made when it is first used."""
        return self.saddle_factor()

    def saddle_factor(self) -> SaddlePointFactor:
        """Make what factorises the matrices of :meth:`blocks`."""
        return self.domain.factor(self.cells, self._workspace)

    def terms(self, points: wp.array, multipliers: wp.array | None = None) -> MapTerms:
        """Return the areas of cells, costs of vertices and distortion of a map, shape [V].

        Args:
            points: the map.
            multipliers: p_c, float64 on the device, shape [N].
        """
        return self.begin(points, multipliers)(self.reading.read())

    def begin(self, points: wp.array, multipliers: wp.array | None = None) -> Callable[[Floats], MapTerms]:
        """Begin to compute what :meth:`terms` returns; return a function of the numbers that :attr:`reading` reads."""
        areas = self.cells.areas(self.domain.areas(points))
        missing, relative = (empty(areas.size, wp.float64, self.device) for _ in range(2))
        launch_parts(area_errors, areas.size, each(areas, self._wanted), each(missing, relative), self.device)
        cost, shape, reading = self.vertex_cost.values(points), self.shape.begin(points, self.reading), self.reading
        moved, charged = reading.dot(self._masses, cost), reading.dot(areas, self.cells.means(cost))
        squares, largest = reading.dot(missing, relative), reading.largest(relative)
        pressed = reading.place()[0] if multipliers is None else reading.dot(multipliers, missing)
        places = [moved, charged, squares, largest, pressed]
        return lambda numbers: MapTerms(areas, missing, relative, cost, shape(numbers), *numbers[places].tolist())

    def potential(self, terms: MapTerms, multipliers: wp.array) -> wp.array:
        """Return P_c, p_c plus the mean cost of a cell over Σ A: the potential at its image, shape [N]."""
        return combine(1.0, multipliers, self.cost_weight / self._covered, self.cells.means(terms.cost))

    def lagrangian(self, terms: MapTerms) -> float:
        """Return the Lagrangian C' + Σ p_c (a_c - A_c) + β S with the multipliers that the terms were asked for."""
        cost = self.cost_weight / self._covered * terms.charged
        return cost + terms.pressed + self.shape_weight * terms.shape.total(self.area_weight)

    def area_rms(self, terms: MapTerms) -> float:
        """Return the root mean square of the relative errors a_c / A_c - 1, weighted by area."""
        return float(np.sqrt(terms.squares / self._covered))

    def cost(self, terms: MapTerms) -> float:
        """Return the transport cost Σ m_v d(x_v, y_v)², where the masses sum to 4π."""
        return terms.moved

    def gradient(self, points: wp.array, terms: MapTerms, multipliers: wp.array) -> wp.array:
        """Return the gradient of the Lagrangian by the vertices, vec3d, or vec2d in the plane, shape [V]."""
        potential = self.cells.on_triangles(self.potential(terms, multipliers))
        masses = self.cells.masses(terms.areas, self.cost_weight / SPHERE_AREA)
        further = self.shape.gradient(points, terms.shape, self.area_weight)
        return self.vertex_cost.gradient(points, masses, potential, further, self.shape_weight)

    def blocks(self, points: wp.array, terms: MapTerms) -> None:
        """Write the second derivative of the Lagrangian and the areas' first derivatives to :attr:`matrix`.

        Both are in the points' frames; of the second derivative a positive semidefinite part is taken.

        Args:
            points: the map, shape [V].
            terms: the terms of the map.
        """
        matrix, mesh = self.matrix, self.surface.on(self.device)
        matrix.points = points
        hessians = self.shape.hessian(points, terms.shape, self.area_weight)
        masses = self.cells.masses(terms.areas, self.cost_weight / SPHERE_AREA)
        metric = self.vertex_cost.hessian(points, masses, LEAST_EIGENVALUE).view(wp.vec4d)
        sides = [Each(mesh.edges), mesh.faces, Each(mesh.edge_corners)]
        gather_blocks(matrix, mesh.vertex_corners, sides, hessians, self.shape_weight, metric)
        if matrix.slopes.size:
            self.cells.slopes(self.domain.area_slopes(points), matrix.slopes)

    def factorise(self, points: wp.array, terms: MapTerms, compliance: wp.array) -> None:
        """Factorise the matrix of a map, with a larger diagonal where rounding made a pivot's sign wrong.

        Args:
            points, terms: as of :meth:`blocks`.
            compliance: how far areas may be off, C of the saddle-point system, float64 on the device, shape [N].

        Raises:
            OmtwarpError: the second derivative is not finite.
        """
        self.blocks(points, terms)
        matrix = self.matrix
        if matrix.compliance.size:
            scaled(compliance, -1.0, matrix.compliance)
        sums_for(self.device).total(matrix.diagonal, self._total)
        count, added = matrix.diagonal.size, REGULARISATION
        for part in STIFFER:
            inputs = [self._total, wp.float64(added / count), wp.float64(part)]
            wp.launch(raise_diagonal, dim=count, inputs=inputs, outputs=[matrix.diagonal], device=self.device)
            try:
                self.factor.factorise(matrix)
                return
            except NotPositiveDefinite:
                added = 0.0
        raise OmtwarpError("the second derivative of what is minimised is not finite")

    def newton_step(self, gradient: wp.array | None, missing: wp.array | None) -> tuple[wp.array, wp.array]:
        """Return the right-hand side and the solution of a system: coordinates, multipliers, [2 V + N].

        Coordinates are in the frames of the map that :meth:`factorise` was called for.

        Args:
            gradient: with its sign turned the first right-hand side, shape [V]; none for 0.
            missing: the second, likewise, shape [N].
        """
        first, size = COORDINATES * self.surface.vertex_count, self._wanted.size
        right = wp.zeros(first + size, dtype=wp.float64, device=self.device)
        if gradient is not None:
            coordinates = self.domain.coordinates(self.matrix.points, gradient)
            scaled(coordinates.flatten(), -1.0, right[:first])
        if missing is not None:
            scaled(missing, -1.0, right[first:])
        return right, self.factor.solve(right)

    def direction(self, solution: wp.array) -> wp.array:
        """Return the step of every vertex, vec3d, or vec2d in the plane, shape [V], from a system's solution."""
        first = COORDINATES * self.surface.vertex_count
        return self.domain.vectors(self.matrix.points, solution[:first].reshape((-1, COORDINATES)))
