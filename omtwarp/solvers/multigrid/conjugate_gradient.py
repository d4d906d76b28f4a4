"""Conjugate gradients preconditioned by a multigrid cycle, all on the device.

Step lengths, sums and the decision to stop stay on the device. On CUDA the whole loop is one graph with a conditional
node, recorded when it first runs and replayed for every right-hand side after that, of this or later values of the
matrix (:mod:`omtwarp.device.graphs`).
"""

from __future__ import annotations

from dataclasses import dataclass

from omtwarp.device.graphs import Graph
from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum
from omtwarp.solvers.multigrid import iteration_kernels as kernels
from omtwarp.solvers.multigrid.cycle import VCycle
from omtwarp.solvers.multigrid.hierarchy import SCALAR_DAMPING, MeshHierarchy

# Blocks of the Newton matrix couple more than the entries of a Laplacian: D^-1 A has eigenvalues near 3.
BLOCK_DAMPING = 0.5
MOST_ITERATIONS = 500


@dataclass(frozen=True)
class Outcome:
    """How a solve ended.

    Attributes:
        iterations: how many there were.
        converged: whether the tolerance was reached.
    """

    iterations: int
    converged: bool


class MultigridSolver:
    """Solves A x = b for symmetric positive (semi)definite matrices on the vertices and edges of a mesh.

    Every result has the same bits on every run.

    Args:
        hierarchy: levels for the mesh; see :class:`MeshHierarchy`.
        block: unknowns per vertex: 1, or 2 for coordinates in tangent planes of a sphere.
        most: iterations after which a solve is given up.
        record: whether the loop is recorded, see :class:`omtwarp.device.graphs.Graph`.
        laplacian: whether A annihilates constants; b has to have mean zero then, and so has x.

    Attributes:
        matrix: A, its entries where ``hierarchy.source`` says.
    """

    def __init__(
        self,
        hierarchy: MeshHierarchy,
        block: int = 1,
        most: int = MOST_ITERATIONS,
        record: bool | None = None,
        laplacian: bool = False,
    ):
        device = hierarchy.device
        self.device, self.hierarchy, self.block, self.most = device, hierarchy, block, most
        coarse, damping = (1, SCALAR_DAMPING) if block == 1 else (3, BLOCK_DAMPING)
        self._cycle = VCycle(hierarchy.levels, device, block, coarse, damping)
        self.matrix = self._cycle.matrices[0]
        count = hierarchy.levels[0].size
        self._ones = wp.full(count, 1.0, dtype=wp.float64, device=device) if block == 1 else None
        self._x, self._residual, self._direction, self._image = (
            wp.empty(count * block, dtype=wp.float64, device=device) for _ in range(4)
        )
        self._smoothed = self._image  # never needed at the same time
        self._scalars = wp.zeros(4, dtype=wp.float64, device=device)
        self._counters = wp.zeros(3, dtype=wp.int32, device=device)
        self._running = self._counters[:1]  # Warp reads a condition into an array of one element
        self._tolerance = wp.zeros(1, dtype=wp.float64, device=device)
        self._sum = DeviceSum(device, count * block)
        self._total = wp.empty(1, dtype=wp.float64, device=device) if laplacian else None
        self._loop = Graph(self._run, device, record)

    def refresh(self, diagonal: wp.array, off_diagonal: wp.array, tentative: wp.array | None = None) -> None:
        """Set the values of the matrix.

        Args:
            diagonal: the blocks of the vertices, flat float64 on the device, shape [V b b].
            off_diagonal: the block of every edge, rows of its first end, columns of its second, shape [E b b].
            tentative: for two unknowns per vertex, how a rotation of the sphere moves them: blocks 2 by 3, shape [6 V].
        """
        self.matrix.fill(self.hierarchy.source, diagonal, off_diagonal)
        self.refresh_levels(tentative)

    def refresh_levels(self, tentative: wp.array | None = None) -> None:
        """Compute the coarse levels after the values of :attr:`matrix` were written in place."""
        self._cycle.refresh(self._ones if tentative is None else tentative)

    def solve(self, right: wp.array, out: wp.array, tolerance: float) -> Outcome:
        """Solve for one right-hand side.

        Args:
            right: flat float64 on the device, shape [V b].
            out: the solution, the same shape.
            tolerance: what the error is to be reduced to in the norm of the energy, as the preconditioner measures it.

        Returns:
            How it ended. Without convergence ``out`` is the last iterate.
        """
        self.enqueue(right, out, tolerance)
        return self.outcome()

    def enqueue(self, right: wp.array, out: wp.array, tolerance: float) -> None:
        """Start a solve without waiting for its result; also while a graph is being recorded. See :meth:`solve`."""
        self._tolerance.fill_(tolerance)
        wp.copy(self._residual, right)
        self._loop()
        wp.copy(out, self._x)

    def outcome(self) -> Outcome:
        """Wait for the last solve, and return how it ended."""
        _, done, broken = self._counters.numpy().tolist()
        return Outcome(done, broken == 0)

    def _run(self) -> None:
        """Iterate from zero, for the right-hand side that the residual has been set to."""
        self._x.zero_()
        self._smooth(self._direction)
        wp.launch(
            kernels.cg_start,
            dim=1,
            inputs=[self._sum.products(self._residual, self._direction), self._tolerance],
            outputs=[self._scalars, self._counters],
            device=self.device,
        )
        wp.capture_while(self._running, self._iterate)

    def _smooth(self, out: wp.array) -> None:
        """Run one cycle for the residual."""
        self._cycle.apply(self._residual, out)
        if self._total is not None:
            # Constants have no energy and grow from cycle to cycle, until the other parts of a direction are lost in
            # round-off.
            self._sum.remove_mean(out, self._total)

    def _iterate(self) -> None:
        """Run one iteration."""
        device, state = self.device, [self._scalars, self._counters]
        size = self._x.size
        self.matrix.multiply(self._direction, self._image)
        inputs = [self._sum.products(self._direction, self._image)]
        wp.launch(kernels.cg_alpha, dim=1, inputs=inputs, outputs=state, device=device)
        inputs, outputs = [self._scalars, self._direction, self._image], [self._x, self._residual]
        wp.launch(kernels.cg_advance, dim=size, inputs=inputs, outputs=outputs, device=device)
        self._smooth(self._smoothed)
        inputs = [self._sum.products(self._residual, self._smoothed), self.most]
        wp.launch(kernels.cg_beta, dim=1, inputs=inputs, outputs=state, device=device)
        inputs = [self._scalars, self._smoothed]
        wp.launch(kernels.cg_direction, dim=size, inputs=inputs, outputs=[self._direction], device=device)


__all__ = ["MultigridSolver", "Outcome"]
