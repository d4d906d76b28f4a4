"""The V-cycle: matrices of all levels from the values of the finest, and one cycle as a preconditioner.

On every level one sweep of Gauss and Seidel, colour by colour, goes before the coarse correction, and one with the
colours in reverse after it: the cycle is symmetric and positive definite, whatever the signs of a matrix's entries.
"""

from __future__ import annotations

from omtwarp.device.start import wp
from omtwarp.solvers.multigrid import kernels
from omtwarp.solvers.multigrid.levels import Level

INVERT = {1: kernels.invert_diagonal_b1, 2: kernels.invert_diagonal_b2, 3: kernels.invert_diagonal_b3}
SWEEP = {1: kernels.gauss_seidel_b1, 2: kernels.gauss_seidel_b2, 3: kernels.gauss_seidel_b3}


class LevelMatrix:
    """The matrix of one level.

    Args:
        level: its pattern.
        block: unknowns per node, b.
        device: a Warp device.

    Attributes:
        values: float64, shape [entries b b].
        inverse: of the diagonal blocks, float64, shape [N b b].
        prolongation: P of the next coarser level, float64; None until it was made.
    """

    def __init__(self, level: Level, block: int, device: wp.Device):
        self.level, self.block, self.device = level, block, device
        self.values = wp.empty(level.pattern.entries * block**2, dtype=wp.float64, device=device)
        self.inverse = wp.empty(level.size * block**2, dtype=wp.float64, device=device)
        self.prolongation: wp.array | None = None
        self._rows = [level.pattern.offsets, level.pattern.columns, self.values]

    def fill(self, source: wp.array, diagonal: wp.array, off_diagonal: wp.array) -> None:
        """Set the values from blocks of vertices, [V b b], and edges, [E b b], both flat."""
        inputs = [source, self.block, diagonal, off_diagonal]
        wp.launch(kernels.fill_rows, dim=self.values.size, inputs=inputs, outputs=[self.values], device=self.device)

    def invert_diagonal(self) -> None:
        inputs = [self.level.diagonal, self.values]
        outputs = [self.inverse]
        wp.launch(INVERT[self.block], dim=self.level.size, inputs=inputs, outputs=outputs, device=self.device)

    def multiply(self, x: wp.array, out: wp.array) -> None:
        """Compute out = A x."""
        inputs = [*self._rows, self.block, self.block, x]
        wp.launch(kernels.multiply_rows, dim=out.size, inputs=inputs, outputs=[out], device=self.device)

    def residual(self, right: wp.array, x: wp.array, out: wp.array) -> None:
        """Compute out = right - A x."""
        inputs = [*self._rows, self.block, self.block, wp.float64(-1.0), x, right]
        wp.launch(kernels.multiply_and_add, dim=out.size, inputs=inputs, outputs=[out], device=self.device)

    def sweep(self, right: wp.array, x: wp.array, backwards: bool) -> None:
        """Sweep once over the colours."""
        colours = self.level.colours
        for nodes in reversed(colours) if backwards else colours:
            inputs = [nodes, *self._rows, self.inverse, right]
            wp.launch(SWEEP[self.block], dim=nodes.size, inputs=inputs, outputs=[x], device=self.device)


def coarsen(matrix: LevelMatrix, coarse: LevelMatrix, tentative: wp.array, damping: float) -> None:
    """Smooth the prolongation by one step of Jacobi, and compute the coarse matrix Pᵀ A P.

    Args:
        matrix: of a level, its diagonal inverted.
        coarse: of the next level; its values are overwritten.
        tentative: the tentative prolongation: blocks b by c from a coarse node to the nodes of its aggregate, flat.
        damping: of the step.
    """
    level, b, c, device = matrix.level, matrix.block, coarse.block, matrix.device
    p, product, pattern = level.prolongation, level.product, level.pattern
    assert p is not None and product is not None and level.restriction is not None
    rows = [pattern.offsets, pattern.columns, matrix.values]
    if matrix.prolongation is None:
        matrix.prolongation = wp.empty(p.entries * b * c, dtype=wp.float64, device=device)
    wp.launch(
        kernels.smooth_prolongation,
        dim=p.entries * b * c,
        inputs=[*rows, matrix.inverse, level.aggregates, tentative, wp.float64(damping), b, c, p.rows, p.columns],
        outputs=[matrix.prolongation],
        device=device,
    )
    # Only needed in between: as large as the matrix.
    workspace = wp.empty(product.entries * b * c, dtype=wp.float64, device=device)
    wp.launch(
        kernels.multiply_by_prolongation,
        dim=product.entries * b * c,
        inputs=[product.rows, product.columns, *rows, p.offsets, p.columns, matrix.prolongation, b, c],
        outputs=[workspace],
        device=device,
    )
    below = coarse.level.pattern
    wp.launch(
        kernels.coarse_matrix,
        dim=below.entries * c * c,
        inputs=[
            below.rows,
            below.columns,
            *level.restriction,
            matrix.prolongation,
            product.offsets,
            product.columns,
            workspace,
            b,
            c,
        ],
        outputs=[coarse.values],
        device=device,
    )


class VCycle:
    """A symmetric V-cycle for matrices on the levels of one mesh.

    Args:
        levels: from the mesh to the coarsest.
        device: where they live.
        block: unknowns per vertex, 1 or 2.
        coarse_block: unknowns per node of the coarser levels: 1, or 3 for the rotations of the sphere.
        damping: see :func:`coarsen`.
    """

    def __init__(self, levels: list[Level], device: wp.Device, block: int, coarse_block: int, damping: float):
        self.device, self.damping = device, damping
        blocks = [block] + [coarse_block] * (len(levels) - 1)
        self.matrices = [LevelMatrix(level, b, device) for level, b in zip(levels, blocks, strict=True)]
        self._tentative = []  # of all levels but the first
        for matrix in self.matrices[1:-1]:
            one = wp.empty(matrix.level.size * coarse_block**2, dtype=wp.float64, device=device)
            wp.launch(kernels.identity_blocks, dim=one.size, inputs=[coarse_block], outputs=[one], device=device)
            self._tentative.append(one)
        sizes = [matrix.level.size * matrix.block for matrix in self.matrices]
        self._residual: list[wp.array] = [wp.empty(size, dtype=wp.float64, device=device) for size in sizes[:-1]]
        # Of all levels but the first.
        self._right, self._x = ([wp.empty(n, dtype=wp.float64, device=device) for n in sizes[1:]] for _ in range(2))
        self._dense, self._other = (wp.zeros((sizes[-1], sizes[-1]), dtype=wp.float64, device=device) for _ in range(2))
        self._scale = wp.empty(sizes[-1], dtype=wp.float64, device=device)

    def refresh(self, tentative: wp.array) -> None:
        """Recompute the coarse levels after the finest matrix has changed.

        Args:
            tentative: see :func:`coarsen`, for the finest level.
        """
        self.matrices[0].invert_diagonal()
        for k in range(len(self.matrices) - 1):
            meaning = tentative if k == 0 else self._tentative[k - 1]
            coarsen(self.matrices[k], self.matrices[k + 1], meaning, self.damping)
            self.matrices[k + 1].invert_diagonal()
        last = self.matrices[-1]
        pattern = last.level.pattern
        # Steps go from one to the other of two matrices; the last one ends where a captured graph looks for it.
        count = self._scale.size
        before, after = (self._dense, self._other) if count % 2 == 0 else (self._other, self._dense)
        before.zero_()
        wp.launch(
            kernels.scatter_dense,
            dim=last.values.size,
            inputs=[pattern.rows, pattern.columns, last.values, last.block],
            outputs=[before, self._scale],
            device=self.device,
        )
        for pivot in range(count):
            inputs = [pivot, self._scale, before]
            wp.launch(kernels.eliminate_pivot, dim=before.shape, inputs=inputs, outputs=[after], device=self.device)
            before, after = after, before

    def apply(self, right: wp.array, out: wp.array) -> None:
        """Run one cycle from zero for a right-hand side, shape [V b]; without allocations, for a graph."""
        self._descend(0, right, out)

    def _descend(self, k: int, right: wp.array, x: wp.array) -> None:
        matrix, device = self.matrices[k], self.device
        if k == len(self.matrices) - 1:
            inputs = [self._dense, right]
            wp.launch(kernels.multiply_dense, dim=x.size, inputs=inputs, outputs=[x], device=device)
            return
        level, b, c = matrix.level, matrix.block, self.matrices[k + 1].block
        assert level.prolongation is not None and level.restriction is not None
        x.zero_()
        matrix.sweep(right, x, backwards=False)
        matrix.residual(right, x, self._residual[k])
        below, found = self._right[k], self._x[k]
        inputs = [*level.restriction, matrix.prolongation, b, c, self._residual[k]]
        wp.launch(kernels.restrict_to_coarse, dim=below.size, inputs=inputs, outputs=[below], device=device)
        self._descend(k + 1, below, found)
        p = level.prolongation
        inputs = [p.offsets, p.columns, matrix.prolongation, b, c, wp.float64(1.0), found, x]
        wp.launch(kernels.multiply_and_add, dim=x.size, inputs=inputs, outputs=[x], device=device)
        matrix.sweep(right, x, backwards=True)


__all__ = ["LevelMatrix", "VCycle", "coarsen"]
