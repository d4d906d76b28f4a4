"""Maps of which some vertices stay where they are, such as the boundary of a disk."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.optimal.cells import MeasuredRings, TriangleCells
from omtwarp.optimal.domain import Domain, Shape, VertexCost
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.optimal.sphere import Sphere
from omtwarp.solvers.mesh_factor import SaddlePointFactor
from omtwarp.solvers.saddle_matrix import COORDINATES, SaddleMatrix
from omtwarp.untangling.steps import FlipFreeSteps

NO_CELLS = np.empty((0, 1), dtype=np.int32)
SETTLED = 1e-9  # largest relative error at which areas are right; corrections converge quadratically


class HeldSphere(Sphere):
    """The sphere as the domain of maps to a part of it."""

    def steps(self) -> FlipFreeSteps:
        """Return an object that holds vertices back where triangles would flip, as patches are for whole spheres."""
        return HeldSteps(self.surface, self.device)


class HeldSteps(FlipFreeSteps):
    """Moves maps to a part of the sphere."""

    def untangled(self, moved: wp.array, marks: wp.array, weight: float) -> tuple[wp.array, int] | None:
        """Return None: untangling knows whole spheres alone."""
        return None


class HeldEnergy(TransportEnergy):
    """The distortion of maps of a mesh whose boundary stays.

    Args:
        domain: where the vertices move.
        held: vertices that stay, shape [V].
        cells: whose areas are kept, or those around vertices, which are measured.
        cost: counts nothing.
        shape: the distortion of the triangles.
        area_weight: λ, of area against angle distortion.
    """

    exact_tolerance = SETTLED

    def __init__(
        self,
        domain: Domain,
        held: NDArray[np.bool_],
        cells: TriangleCells | MeasuredRings,
        cost: VertexCost,
        shape: Shape,
        area_weight: float = 1.0,
    ):
        super().__init__(domain, cells, cost, shape, shape_weight=1.0, cost_weight=0.0, area_weight=area_weight)
        self._held, self._of_cells = held, cells.vertices if isinstance(cells, TriangleCells) else NO_CELLS

    def cost(self, terms: MapTerms) -> float:
        """Return 4π, a mean of 1: gains are compared with the distortion, not with a cost."""
        return SPHERE_AREA

    def saddle_factor(self) -> SaddlePointFactor:
        """Return what factorises matrices in which the boundary does not move."""
        return HeldFactor(super().saddle_factor(), self._held, self.surface.edges, self._of_cells)


class HeldFactor:
    """Factorises matrices with a multiplier for every cell, or with none, without the coordinates of some vertices.

    Args:
        factor: of all coordinates.
        held: vertices that stay, shape [V].
        edges: shape [E, 2].
        cells: the vertices of every cell, shape [N, K].
    """

    def __init__(
        self, factor: SaddlePointFactor, held: NDArray[np.bool_], edges: NDArray[np.int32], cells: NDArray[np.int32]
    ):
        self._factor, self._held = factor, held
        self._touching: NDArray[np.bool_] = np.asarray(held[edges].any(axis=1))
        self._in_cells = held[cells]

    def factorise(self, matrix: SaddleMatrix) -> None:
        """Factorise one matrix; see :class:`omtwarp.solvers.mesh_factor.SaddlePointFactor`."""
        own, others, slopes, compliance = matrix.on_host()
        own[self._held] = 0.5 * np.trace(own, axis1=1, axis2=2).mean() * np.eye(2)
        others = np.where(self._touching[:, None, None], 0.0, others)
        slopes = np.where(self._in_cells[..., None], 0.0, slopes.reshape(*self._in_cells.shape, COORDINATES))
        self._factor.factorise(SaddleMatrix.of(own, others, slopes, compliance))

    def solve(self, right: wp.array) -> wp.array:
        """Solve for a right-hand side; coordinates of vertices that stay are 0."""
        numbers = right.numpy().copy()
        numbers[: COORDINATES * len(self._held)].reshape(-1, COORDINATES)[self._held] = 0.0
        return self._factor.solve(wp.array(numbers, dtype=wp.float64, device=right.device))
