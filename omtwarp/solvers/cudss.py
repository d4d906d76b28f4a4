"""Direct factorisations on a GPU by NVIDIA's cuDSS, as a member beside the built-in one for the host.

The order of elimination is the mesh's nested dissection, so that cuDSS analyses a pattern once and runs no ordering of
its own. Matrices are symmetric and quasi-definite: they need no pivoting, and the signs of their pivots are known. Its
deterministic mode gives the same bits on every run.

The library and its binding are the optional extra ``omtwarp[cuda]``.
"""

from __future__ import annotations

import weakref
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import Workspace
from omtwarp.device.policy import solver_device
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats
from omtwarp.solvers.cholesky.dissection import Dissection
from omtwarp.solvers.factor import Factor, MeshMatrix, NotPositiveDefinite

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def gather_entries(
    given: wp.array[wp.float64],
    source: wp.array[wp.int32],
    # Data out:
    entries_out: wp.array[wp.float64],
):
    """Take every entry of a sparse matrix from its place in a list of blocks."""
    i = wp.tid()
    entries_out[i] = given[source[i]]


def load_library() -> ModuleType:
    """Import the binding of cuDSS.

    Raises:
        OmtwarpError: it is not installed.
    """
    try:
        from nvmath.bindings import cudss
    except ImportError as error:
        raise OmtwarpError("the solver cudss needs NVIDIA's library: pip install 'omtwarp[cuda]'") from error
    return cudss


class CudssFactor(Factor[MeshMatrix, Floats]):
    """Factorises matrices with ``block`` unknowns per vertex whose pattern is a mesh's edges, on a GPU.

    Args:
        dissection: the order of elimination.
        block: unknowns per vertex, 1 or 2.
        workspace: not used; that of the host's factorisation.
        negative: how many of every front's own unknowns have negative pivots, shape [N]; none by default.

    Raises:
        OmtwarpError: cuDSS is not installed, or finds no GPU.
    """

    def __init__(
        self,
        dissection: Dissection,
        block: int = 1,
        workspace: Workspace | None = None,
        negative: NDArray[np.int32] | None = None,
    ):
        self.device = device = solver_device()
        self._size = size = block * dissection.vertex_count
        self._negative = 0 if negative is None else int(negative.sum())
        offsets, columns, source = upper_entries(dissection.vertex_count, dissection.edges, block)
        self._offsets = wp.array(offsets, dtype=wp.int32, device=device)
        self._columns = wp.array(columns, dtype=wp.int32, device=device)
        self._source = wp.array(source, dtype=wp.int32, device=device)
        self._values = wp.empty(len(columns), dtype=wp.float64, device=device)
        self._order = np.repeat(block * dissection.order, block).reshape(-1, block) + np.arange(block)
        self._order = np.ascontiguousarray(self._order.ravel(), dtype=np.int32)
        self._given, self._solution = (wp.zeros(size, dtype=wp.float64, device=device) for _ in range(2))
        self._analysed = False
        self._library = library = load_library()
        with wp.ScopedDevice(device):
            try:
                self._handle = library.create()
            except RuntimeError as error:
                raise OmtwarpError(f"cuDSS does not start: {error}") from error
            self._config, self._data = library.config_create(), library.data_create(self._handle)
            self._set(library.ConfigParam.DETERMINISTIC_MODE, 1)
            self._set(library.ConfigParam.PIVOT_TYPE, library.PivotType.PIVOT_NONE)
            order, param = self._order, library.DataParam.USER_PERM
            library.data_set(self._handle, self._data, param, order.ctypes.data, order.nbytes)
            kinds = (library.DataType.R_32I, library.DataType.R_32I, library.DataType.R_64F)
            shape = (library.MatrixType.SYMMETRIC, library.MatrixViewType.UPPER, library.IndexBase.ZERO)
            pointers = (self._offsets.ptr, 0, self._columns.ptr, self._values.ptr)
            self._matrix = library.matrix_create_csr(size, size, len(columns), *pointers, *kinds, *shape)
            layout = (library.DataType.R_64F, library.Layout.COL_MAJOR)
            self._x, self._b = (
                library.matrix_create_dn(size, 1, size, array.ptr, *layout) for array in (self._solution, self._given)
            )
        held = (self._handle, self._config, self._data, self._matrix, self._x, self._b)
        weakref.finalize(self, _release, library, *held)

    def _set(self, name: int, value: int) -> None:
        number = np.array([value], dtype=np.int32)
        self._library.config_set(self._config, name, number.ctypes.data, number.nbytes)

    def factorise(self, matrix: MeshMatrix) -> None:
        """Factorise one matrix.

        Raises:
            NotPositiveDefinite: a pivot has the wrong sign, to round-off.
        """
        flat = np.concatenate([np.ravel(part) for part in matrix])
        self.factorise_entries(wp.array(flat, dtype=wp.float64, device="cpu", copy=False))

    def factorise_entries(self, entries: wp.array) -> None:
        """Factorise a matrix whose diagonal and couplings are in one array, on any device.

        Raises:
            NotPositiveDefinite: a pivot has the wrong sign, to round-off.
        """
        inputs = [entries.to(self.device), self._source]
        wp.launch(gather_entries, dim=len(self._values), inputs=inputs, outputs=[self._values], device=self.device)
        phase = self._library.Phase
        if not self._analysed:
            self._run(phase.ANALYSIS)
            self._analysed = True
        self._run(phase.FACTORIZATION)
        inertia = self._read(self._library.DataParam.INERTIA, 2)
        if inertia.tolist() != [self._size - self._negative, self._negative]:
            raise NotPositiveDefinite(
                f"{inertia[0]} pivots are positive and {inertia[1]} negative, "
                f"in place of {self._size - self._negative} and {self._negative}"
            )

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides, shape [V, b] or [V, b, K]; [V] or [V, K] for one unknown per vertex.

        One after another, as cuDSS's deterministic mode takes no more at once.
        """
        columns = np.ascontiguousarray(np.asarray(right, dtype=np.float64).reshape(self._size, -1).T)
        solved = np.empty_like(columns)
        for column, out in zip(columns, solved, strict=True):
            wp.copy(self._given, wp.array(column, dtype=wp.float64, device="cpu", copy=False))
            self._run(self._library.Phase.SOLVE)
            out[:] = self._solution.numpy()
        return np.ascontiguousarray(solved.T).reshape(np.shape(right))

    def solve_entries(self, right: wp.array) -> wp.array:
        """Solve for a right-hand side of all unknowns, on its device."""
        wp.copy(self._given, right)
        self._run(self._library.Phase.SOLVE)
        solved = wp.empty(self._size, dtype=wp.float64, device=right.device)
        wp.copy(solved, self._solution)
        return solved

    def _run(self, phase: int) -> None:
        library = self._library
        with wp.ScopedDevice(self.device):
            library.set_stream(self._handle, self.device.stream.cuda_stream or 0)
            library.execute(self._handle, phase, self._config, self._data, self._matrix, self._x, self._b)

    def _read(self, name: int, count: int) -> NDArray[np.int32]:
        """Return some whole numbers about the factorisation, when it is finished."""
        numbers, written = np.zeros(count, dtype=np.int32), np.zeros(1, dtype=np.uint64)
        wp.synchronize_device(self.device)
        self._library.data_get(self._handle, self._data, name, numbers.ctypes.data, numbers.nbytes, written.ctypes.data)
        return numbers


def _release(library: ModuleType, handle: int, config: int, data: int, *matrices: int) -> None:
    """Free what cuDSS holds for a factorisation."""
    for matrix in matrices:
        library.matrix_destroy(matrix)
    library.data_destroy(handle, data)
    library.config_destroy(config)
    library.destroy(handle)


def upper_entries(
    count: int, edges: NDArray[np.int32], block: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """List the entries on and above the diagonal of a matrix with blocks at vertices and edges, row by row.

    Args:
        count: number of vertices V.
        edges: every edge (i, j) once, shape [E, 2].
        block: unknowns per vertex, b.

    Returns:
        Where every row begins, shape [V b + 1], the column of every entry, and its place in the blocks of the vertices
        followed by those of the edges, flat; rows of an edge's block are those of i.
    """
    vertices = np.arange(count, dtype=np.int64)
    inner = np.arange(block)
    ends = np.concatenate([np.stack([vertices, vertices], axis=1), edges])[:, None, None, :]
    i, j = block * ends[..., 0] + inner[:, None], block * ends[..., 1] + inner
    pairs = np.stack(np.broadcast_arrays(i, j), axis=-1).reshape(-1, 2)
    source = np.arange(len(pairs))
    inside = source < count * block * block
    kept = ~inside | (pairs[:, 0] <= pairs[:, 1])  # of a vertex's symmetric block, the upper half
    rows, columns = pairs[kept].min(axis=1), pairs[kept].max(axis=1)
    sorted_by_row = np.lexsort((columns, rows))
    offsets = np.searchsorted(rows[sorted_by_row], np.arange(block * count + 1))
    lists = (offsets, columns[sorted_by_row], source[kept][sorted_by_row])
    first, second, third = (array.astype(np.int32) for array in lists)
    return first, second, third
