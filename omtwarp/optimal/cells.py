"""The optimal map of a quartered mesh that keeps the area of every triangle of the original mesh.

The cells whose areas are kept are the triangles c of the mesh, each the sum of four parts (the element P1-iso-P2/P0 of
incompressible elasticity, which does not lock). A cell's mass A_c lies on its six vertices, a twelfth on each corner
and a quarter on each middle of an edge, so that the vertices' masses are those of the quartered mesh. As in
:mod:`omtwarp.optimal.energy` the cost is written with the areas of the image, C' = Σ a_c Σ w_cv d(x_v, y_v)² / 4π, and
the multipliers p_c belong to cells of the mesh, which do not change when the map moves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import cut, launch_parts
from omtwarp.mesh.checks import as_unit_vectors
from omtwarp.mesh.quarter import QuarteredSurface
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.cell_kernels import cell_couplings, cell_gradient, vertex_costs
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.optimal.kernels import cost_metric
from omtwarp.optimal.restoration import restore_areas
from omtwarp.optimal.solver import PENALTY, SHAPE_WEIGHT, OptimalMap, minimise, softness
from omtwarp.options import Cost, Progress, Record
from omtwarp.solvers.mesh_factor import SaddlePointFactor, cell_saddle_factor
from omtwarp.untangling.kernels import solid_angles

Numbers = NDArray[np.float64]

CORNER_SHARE, MIDDLE_SHARE = 1.0 / 12.0, 1.0 / 4.0  # of a cell's mass, on each of its six vertices
ITERATIONS = 60  # largest number of steps; a map that needs more reports that it has not converged
# Root mean square and largest relative error of the triangles' areas at which the minimisation may end.
MAX_CELL_RMS, MAX_CELL_ERROR = 1e-3, 0.05
# Where the root mean square error of the areas is larger to begin with, the first steps would ask slivers for several
# times their area, and those after them are shortened to a sixteenth. Rounds with light penalties then come first:
# weight of area errors beside cost, and most steps. Two bodies with thin limbs (0.1 and more) and a toy of large ears
# (0.074) come to exact areas and a gap of 0.04 to 0.2 % with them, where without the last of them two end short of the
# optimum; a gargoyle (0.055) needs none.
MAX_START_RMS = 0.06
LIGHT_PENALTIES = ((3.0, 12), (30.0, 12), (300.0, 12))
CELL_GAIN = (
    1e-4  # share of the cost that the last step would gain: the valleys of cost and shape are longer than at rings
)
EXACT = 1e-6  # largest relative error after the remaining errors were corrected


def exact_map(
    quartered: QuarteredSurface,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    shape_weight: float = SHAPE_WEIGHT,
    multipliers: ArrayLike | None = None,
    iterations: int = ITERATIONS,
    gain: float = CELL_GAIN,
    cost: str = Cost.SQUARED,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> OptimalMap:
    """Minimise the transport cost over the maps of a quartered mesh that keep the area of every original triangle.

    Args:
        quartered: the F triangles of a mesh in four parts each, V vertices in all.
        sphere: a map without flips to begin with, unit vectors, shape [V, 3].
        start: the points x that are transported, unit vectors, shape [V, 3].
        shape_weight: weight of angle and area distortion of the parts relative to the mean squared distance.
        multipliers: initial multipliers, shape [F], such as those of a map with another shape weight.
        iterations: largest number of steps with each weight of area errors.
        gain: end where the expected gain of a step falls below this share of the cost, and areas are kept to 1e-6.
        cost: as of :func:`omtwarp.optimal_map`.
        device: where the kernels run.
        progress: called after every step as ``progress("omt", step, most, record)``.

    Returns:
        The map, whose energy is at most that of the one given; its multipliers belong to the triangles, shape [F].

    Raises:
        OmtwarpError: the map given has flipped triangles.
    """
    where = resolve_device(device)
    given, x = (as_unit_vectors(points, quartered.surface.vertex_count) for points in (sphere, start))
    soft = softness(quartered.surface.vertex_areas, given, x, cost)
    energy = CellEnergy(quartered, vectors(x, where), where, shape_weight, soft)
    return minimise_cells(energy, given, multipliers=multipliers, gain=gain, iterations=iterations, progress=progress)


def minimise_cells(
    energy: CellEnergy,
    sphere: Numbers,
    *,
    multipliers: ArrayLike | None = None,
    gain: float,
    iterations: int,
    progress: Progress | None,
) -> OptimalMap:
    """Minimise an energy of cells, then correct their areas to 1e-6; arguments and result as of :func:`exact_map`."""
    history: list[Record] = []
    rms, _ = energy.ring_errors(energy.terms(vectors(sphere, energy.device)))
    light = LIGHT_PENALTIES if multipliers is None and rms > MAX_START_RMS else ()
    for penalty, steps in (*light, (PENALTY, iterations)):
        found = minimise(
            energy,
            sphere,
            area_penalty=penalty,
            multipliers=multipliers,
            gain=gain,
            iterations=min(steps, iterations),
            progress=progress,
        )
        sphere, multipliers = found.sphere, found.multipliers
        history += found.history

    def notify(number: int, terms: MapTerms) -> None:
        rms, largest = energy.ring_errors(terms)
        history.append({**history[-1], "cost": energy.cost(terms), "ring_rms": rms, "ring_largest": largest})
        if progress is not None:
            progress("omt", min(len(history) - 1, iterations), iterations, history[-1])

    restored, right = restore_areas(energy, found.sphere, notify=notify)
    ended = found.ended if right else f"{found.ended}; areas are not right to {EXACT:g}"
    return replace(found, sphere=restored, history=tuple(history), converged=found.converged and right, ended=ended)


class CellEnergy(TransportEnergy):
    """Evaluates maps of a quartered surface as its base class does, with areas of original triangles as constraints.

    Args:
        quartered: the mesh's triangles in four parts each.
        start: x, unit vectors, vec3d, shape [V], on the device.
        device: a Warp device.
        shape_weight: β, the weight of the distortion of the parts.
        softness: as of :class:`TransportEnergy`.
    """

    local_steps = False  # they need constraints on areas around vertices
    first_curvature_share = 1.0  # areas of triangles start farther off than those around vertices
    area_tolerances = (MAX_CELL_RMS, MAX_CELL_ERROR)
    exact_tolerance = EXACT

    def __init__(
        self,
        quartered: QuarteredSurface,
        start: wp.array,
        device: wp.Device,
        shape_weight: float,
        softness: float = 0.0,
    ):
        super().__init__(quartered.surface, start, device, shape_weight, softness=softness)
        self._quartered = quartered
        parts = quartered.surface.faces.reshape(-1, 4, 3)
        self.cells = np.ascontiguousarray(np.concatenate([parts[:, :3, 0], quartered.middles], axis=1))
        self._cells = wp.array(self.cells, dtype=wp.int32, device=device)
        self.wanted = quartered.sum_of_parts(quartered.surface.face_areas)
        self._shares = np.repeat([CORNER_SHARE, MIDDLE_SHARE], 3)
        self._couplings = wp.empty(self.cells.shape, dtype=wp.vec2d, device=device)
        self._factor: SaddlePointFactor | None = None

    def saddle_factor(self) -> SaddlePointFactor:
        """Return an object that factorises the matrices of :meth:`blocks`: the same one at every call."""
        if self._factor is None:
            self._factor = cell_saddle_factor(self.surface, self.cells)
        return self._factor

    def terms(self, points: wp.array) -> MapTerms:
        """Return the terms of a map, with the areas of the cells, shape [F], in place of those around vertices."""
        cost = wp.empty(self.surface.vertex_count, dtype=wp.float64, device=self.device)

        def of_triangles(part: slice) -> tuple[list[object], list[object]]:
            return [points, cut(self._mesh.faces, part)], [cut(self._solid, part)]

        def of_vertices(part: slice) -> tuple[list[object], list[object]]:
            return [self._start[part], points[part], self.softness], [cost[part]]

        launch_parts(solid_angles, self.surface.face_count, of_triangles, self.device)
        launch_parts(vertex_costs, self.surface.vertex_count, of_vertices, self.device)
        areas = self._quartered.sum_of_parts(self._solid.numpy())
        return MapTerms(areas, cost.numpy(), self.shape.terms(points))

    def potential(self, terms: MapTerms, multipliers: Numbers) -> Numbers:
        """Return P_c, the potential on each cell's image: p_c plus the mean cost over 4π, shape [F]."""
        return multipliers + self.cost_weight / SPHERE_AREA * self._means(terms)

    def lagrangian(self, terms: MapTerms, multipliers: Numbers) -> float:
        """Return the Lagrangian C' + Σ p_c (a_c - A_c) + β S."""
        cost = self.cost_weight * float(terms.ring @ self._means(terms)) / SPHERE_AREA
        return cost + float(multipliers @ self.missing(terms)) + self.shape_weight * terms.shape.total(self.area_weight)

    def gradient(self, points: wp.array, terms: MapTerms, multipliers: Numbers) -> Numbers:
        """Return the gradient of the Lagrangian with respect to the vertices, tangent to the sphere, shape [V, 3]."""
        count, device = self.surface.vertex_count, self.device
        mass = wp.array(self._masses(terms), dtype=wp.float64, device=device, copy=False)
        potential = wp.array(self.potential(terms, multipliers), dtype=wp.float64, device=device, copy=False)
        gradient = wp.empty(count, dtype=wp.vec3d, device=device)
        factor = wp.float64(self.cost_weight * 2.0 / SPHERE_AREA)

        def around(part: slice) -> tuple[list[object], list[object]]:
            mesh = [self._start, points, self._mesh.faces, mass, potential, *self._rows]
            inputs = [*mesh, factor, self.softness, part.start]
            return inputs, [gradient]

        launch_parts(cell_gradient, count, around, device)
        shape = self.shape.gradient(points, terms.shape, self.area_weight)
        return gradient.numpy() + self.shape_weight * shape.numpy()

    def blocks(
        self, points: wp.array, terms: MapTerms, curvature_share: float, least: float
    ) -> tuple[Numbers, Numbers, Numbers]:
        """Return the blocks of the matrix, and the derivatives of cells' areas by their vertices, shape [F, 6, 2]."""
        count, device = self.surface.vertex_count, self.device
        hessians = self.shape.hessian(points, terms.shape, self.area_weight, curvature_share)
        diagonal, off_diagonal = (self.shape_weight * blocks for blocks in self._newton.assemble(hessians.numpy()))
        mass = wp.array(self._masses(terms), dtype=wp.float64, device=device, copy=False)
        numbers = [wp.float64(self.cost_weight * 2.0 / SPHERE_AREA), wp.float64(least), self.softness]

        def around(part: slice) -> tuple[list[object], list[object]]:
            inputs = [self._start, points, self._mesh.faces, mass, *self._rows, *numbers, part.start]
            return inputs, [self._metric]

        def of_cells(part: slice) -> tuple[list[object], list[object]]:
            return [points, self._cells, part.start], [self._couplings[part]]

        launch_parts(cost_metric, count, around, device)
        launch_parts(cell_couplings, len(self.cells), of_cells, device)
        diagonal += self._metric.numpy().reshape(-1, 2, 2)
        return diagonal, off_diagonal, self._couplings.numpy()

    def _means(self, terms: MapTerms) -> Numbers:
        """Return the mean cost over the mass of every cell, shape [F]."""
        return terms.cost[self.cells] @ self._shares

    def _masses(self, terms: MapTerms) -> Numbers:
        """Divide the areas of the cells on the sphere among their vertices in the shares of mass, shape [V]."""
        shares = terms.ring[:, None] * self._shares
        return np.bincount(self.cells.ravel(), shares.ravel(), self.surface.vertex_count).astype(np.float64)
