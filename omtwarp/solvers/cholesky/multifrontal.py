"""Sparse Cholesky factors by dense eliminations in a tree of fronts (Duff and Reid 1983; Liu 1992).

SuperLU, which SciPy brings, treats a symmetric matrix as a general one, orders it for every factorisation and works
with small dense blocks. Here the order is computed once for a mesh, dense Cholesky of LAPACK does the work, and
independent fronts run on as many threads as there are cores, with the same bits on any number of them. LAPACK and BLAS
are called by address: kernels do so from compiled code, and wrappers would copy every block.
"""

from __future__ import annotations

import contextlib
import ctypes
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cython_blas, cython_lapack

from omtwarp.device.arrays import Workspace, sent
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads, core_count, load, run_all
from omtwarp.mesh.arrays import TINY, Floats
from omtwarp.solvers.cholesky.dissection import Dissection
from omtwarp.solvers.cholesky.kernels import Fronts, factorise_fronts, solve_triangular, subtract_product
from omtwarp.solvers.factor import Factor, MeshMatrix, NotPositiveDefinite

SINGLE: np.dtype[np.floating] = np.dtype(np.float32)
DOUBLE: np.dtype[np.floating] = np.dtype(np.float64)
PREFIXES = {SINGLE: "s", DOUBLE: "d"}  # of the names of LAPACK's and BLAS's routines


@lru_cache
def routine(name: str) -> int:
    """Return the address of a routine that SciPy offers to compiled code: ``dpotrf``, ``spotrf``, or one of BLAS."""
    capsule = (cython_lapack if name.endswith("potrf") else cython_blas).__pyx_capi__[name]
    get_name = ctypes.pythonapi.PyCapsule_GetName
    get_name.restype, get_name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    get_pointer = ctypes.pythonapi.PyCapsule_GetPointer
    get_pointer.restype, get_pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    signature = get_name(capsule)
    if b"int *" not in signature:  # a build with another integer
        raise ImportError(f"unknown signature of {name}")
    return int(get_pointer(capsule, signature))


# Total operations below which a second thread costs more than it saves.
MIN_PARALLEL_OPERATIONS = 1e7
MIN_SHARED_NUMBERS = 1e6  # of a factor below which the same holds for its solves
# Total operations from which on setting a library's number of threads takes no time that counts.
MIN_LIMITED_OPERATIONS = 5e7
# Branches of the tree for every thread: with several of them their work evens out.
BRANCHES_PER_THREAD = 4


# Relative error of refined solutions, at most: Newton's steps need no more digits. Scans end with the same maps with
# 1e-5, by one correction, and 1e-7, by up to three.
ACCURACY = 1e-5
REFINEMENTS = 8  # most corrections of a solution


class MultifrontalCholesky(Factor[MeshMatrix, Floats]):
    """Factorises matrices with ``block`` unknowns per vertex whose pattern is the mesh's edges.

    Args:
        dissection: the order of elimination.
        block: unknowns per vertex, 1 or 2.
        threads: shares that independent fronts are cut into; one per core by default.
        workspace: memory for the fronts; by default it is allocated for each factorisation and freed after it.
        negative: how many of every front's own unknowns, the last ones, have negative pivots, shape [N]; none by
            default. With them the matrix is quasi-definite instead of positive definite.
        single: factorise in float32, in half of the memory and time, and refine solutions in float64, for one unknown
            per vertex; from the first matrix on for which that fails, in float64 (as LAPACK's ``dsposv``). The matrix
            must stay as it was given until it is solved.
    """

    def __init__(
        self,
        dissection: Dissection,
        block: int = 1,
        threads: int | None = None,
        workspace: Workspace | None = None,
        negative: NDArray[np.int32] | None = None,
        single: bool = False,
    ):
        self.dissection = dissection
        count = len(dissection.owned)
        self._negative = np.zeros(count, dtype=np.int32) if negative is None else negative
        self.block = block
        self.threads = threads or core_count()
        sizes = block * dissection.sizes
        own = block * dissection.owned
        self._sizes, self._own = sizes, own
        self._factor_offsets = np.cumsum(own * sizes) - own * sizes
        self._factor_length = int((own * sizes).sum())
        costs = own**3 / 3 + own**2 * (sizes - own) + own * (sizes - own) ** 2
        self._operations = float(costs.sum())
        self._jobs, self._trunk = self._divide(costs)
        self._offsets, self._length = self._places()
        self._workspace = workspace
        self._carried = workspace or Workspace()
        self._x = np.empty((0, dissection.vertex_count, block))  # right-hand sides and solutions, in the order
        self._negative_places = self._find_negative() if negative is not None else None
        # What is launched at once: the jobs, the pieces of the trunk's depths, and for solves all of the trunk, or of a
        # small factor everything.
        pieces = [np.array_split(fronts, min(self.threads, len(fronts))) for fronts in self._trunk]
        branches, trunk = self._jobs, [np.concatenate(self._trunk)] if self._trunk else []
        if self._factor_length < MIN_SHARED_NUMBERS:
            branches, trunk = [dissection.postorder.astype(np.int32)], []
        groups = [*self._jobs, *(piece for depth in pieces for piece in depth), *branches, *trunk]
        numbers = iter(range(len(groups)))
        self._of_jobs = [next(numbers) for _ in self._jobs]
        self._of_depths = [[next(numbers) for _ in depth] for depth in pieces]
        self._of_branches = [next(numbers) for _ in branches]
        self._of_trunk = list(numbers)
        self._failed = np.empty(len(groups), dtype=np.int32)
        self._groups = [wp.array(fronts, dtype=wp.int32, device="cpu", copy=False) for fronts in groups]
        self._upload()
        self._take(SINGLE if single else DOUBLE)

    def _take(self, kind: np.dtype[np.floating]) -> None:
        """Factorise in numbers of a kind from now on."""
        self._kind = kind
        self._factor = np.empty(0)  # frees the old one
        self._factor = np.empty(self._doubles(self._factor_length))
        routines = [routine(PREFIXES[kind] + name) for name in ("potrf", "trsm", "syrk")]
        self._tree.single, self._tree.factor = kind == SINGLE, sent(self._factor, wp.float64)
        self._tree.routines = wp.array(routines, dtype=wp.uint64, device="cpu")
        if self._workspace is not None:
            self._workspace.numbers(self._doubles(self._length))  # now: what is asked for sooner would leave a hole

    def _doubles(self, count: int) -> int:
        """Return how many float64 take the memory of so many numbers."""
        return -(-count * self._kind.itemsize // DOUBLE.itemsize)

    def _divide(self, costs: NDArray[np.float64]) -> tuple[list[NDArray[np.int32]], list[NDArray[np.int32]]]:
        """Divide the fronts into jobs, each of whole branches of the tree, and the trunk above them by depth."""
        d = self.dissection
        every = d.postorder.astype(np.int32)
        if self.threads == 1 or self._operations < MIN_PARALLEL_OPERATIONS:
            return [every], []
        depth_of = d.front_depths
        wanted = BRANCHES_PER_THREAD * self.threads
        enough = [k for k, depth in enumerate(d.depths) if depth.stop - depth.start >= wanted]
        if not enough:
            return [every], []
        top = max(enough)  # depths are deepest first
        # The branch of a front: that of its parent, or its own where the trunk begins above it.
        branch = np.arange(len(costs))
        for k in reversed(range(len(d.depths))):
            fronts = np.arange(d.depths[k].start, d.depths[k].stop)
            if k < top:
                parents = d.parent[fronts]
                branch[fronts] = np.where(parents >= 0, branch[parents], fronts)
        inside = depth_of <= top
        work = np.bincount(branch[inside], costs[inside], minlength=len(costs))
        thread_of = np.zeros(len(costs), dtype=np.int64)
        load = np.zeros(self.threads)
        roots = np.unique(branch[inside])
        for root in roots[np.argsort(-work[roots], kind="stable")]:
            thread_of[root] = int(load.argmin())
            load[thread_of[root]] += work[root]
        jobs = [every[(inside & (thread_of[branch] == t))[every]] for t in range(self.threads)]
        trunk = [np.arange(depth.start, depth.stop, dtype=np.int32) for depth in d.depths[top + 1 :]]
        return [job for job in jobs if len(job)], trunk

    def _places(self) -> tuple[NDArray[np.int64], int]:
        """Compute where fronts begin in the workspace, and how large it is.

        A job does branch after branch in postorder, so that few fronts exist at a time, mostly in cache. They lie on
        two stacks, one for even depths and one for odd: a front is assembled on one from its children on top of the
        other. The trunk is done by depth, behind the jobs' stacks and, where those are read no more, in their place by
        turns.
        """
        d = self.dissection
        squares = self._sizes**2
        odd = d.front_depths % 2 == 1
        of_children = np.zeros(len(squares), dtype=np.int64)
        inner = d.parent >= 0
        np.add.at(of_children, d.parent[inner], squares[inner])
        offsets = np.zeros(len(squares), dtype=np.int64)
        length = 0
        for job in self._jobs:
            for parity in (False, True):
                here = odd[job] == parity
                put = np.where(here, squares[job], 0)
                taken = np.where(here, 0, of_children[job])
                tops = np.cumsum(put - taken)
                offsets[job[here]] = (length + tops - put)[here]
                length += int(tops[here].max(initial=0))
        ends = [np.cumsum(squares[fronts]) for fronts in self._trunk]
        behind = max([length, *(int(end[-1]) for end in ends[1::2])])
        for k, fronts in enumerate(self._trunk):
            offsets[fronts] = (behind if k % 2 == 0 else 0) + ends[k] - squares[fronts]
        return offsets, behind + max((int(end[-1]) for end in ends[::2]), default=0)

    def _find_negative(self) -> NDArray[np.intp]:
        """Return the places of the unknowns with negative pivots in the order of elimination."""
        d, block = self.dissection, self.block
        place = np.arange(block * d.vertex_count)
        end = np.repeat(block * (d.first + d.owned), block * d.owned)
        return np.flatnonzero(place >= end - np.repeat(self._negative, block * d.owned))

    def _upload(self) -> None:
        d, tree = self.dissection, Fronts()
        family_starts, families = d.families
        tree.block = self.block
        for name, values in (
            ("first", d.first),
            ("owned", d.owned),
            ("negative", self._negative),
            ("rows", d.rows),
            ("upward", d.upward),
            ("family_starts", family_starts),
            ("families", families),
            ("order", d.order),
            ("edge_starts", d.edge_starts),
            ("edges", d.entering),
            ("edge_rows", d.edge_row),
            ("edge_columns", d.edge_column),
        ):
            setattr(tree, name, sent(values.astype(np.int32, copy=False), wp.int32))
        tree.starts, tree.offsets, tree.factor_offsets = (
            sent(values.astype(np.int64, copy=False), wp.int64)
            for values in (d.starts, self._offsets, self._factor_offsets)
        )
        tree.turned = sent(d.edge_turned, wp.bool)
        self._tree, self._w_failed = tree, sent(self._failed, wp.int32)

    def factorise(self, matrix: MeshMatrix) -> None:
        """Factorise one matrix, with the edges of the dissection.

        Raises:
            NotPositiveDefinite: a pivot has the wrong sign, to round-off.
        """
        values = [np.ascontiguousarray(array, dtype=np.float64).ravel() for array in matrix]
        self._matrix = [wp.array(array, device="cpu", copy=False) for array in values]
        failed = self._failing_front()
        if failed >= 0 and self._kind == SINGLE:
            self._take(DOUBLE)
            failed = self._failing_front()
        if failed >= 0:
            raise NotPositiveDefinite(f"pivot of front {failed} of {len(self._own)} is not positive")

    def _failing_front(self) -> int:
        """Factorise the matrix at hand; return the first front with a pivot of the wrong sign, or -1."""
        workspace = (self._workspace or Workspace()).numbers(self._doubles(self._length))
        data = [*self._matrix, wp.array(workspace, device="cpu", copy=False)]
        load(factorise_fronts, "cpu")

        def run(group: int) -> int:
            inputs = [self._groups[group], *data, self._tree, self._w_failed[group : group + 1]]
            wp.launch(factorise_fronts, dim=1, inputs=inputs, device="cpu")
            return int(self._failed[group])

        with blas_threads(1) if self._operations > MIN_LIMITED_OPERATIONS else contextlib.nullcontext():
            failed = max(run_all(run, self._of_jobs))
            for groups in self._of_depths:
                if failed < 0:
                    failed = max(run_all(run, groups))
        return failed

    def factorise_entries(self, entries: wp.array) -> None:
        """Factorise a matrix with one unknown per vertex whose diagonal and couplings are in one array, on any device.

        Raises:
            NotPositiveDefinite: it is not, to round-off.
        """
        numbers, count = entries.numpy(), self.dissection.vertex_count
        self.factorise(MeshMatrix(numbers[:count], numbers[count:]))

    def solve_entries(self, right: wp.array) -> wp.array:
        """Solve for a right-hand side, shape [V], with one unknown per vertex, on its device."""
        return wp.array(self.solve(right.numpy()), dtype=wp.float64, device=right.device, copy=False)

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for right-hand sides, shape [V, 2] or [V, 2, K]; [V] or [V, K] for one unknown per vertex."""
        d, block = self.dissection, self.block
        flat = np.asarray(right, dtype=np.float64).reshape(d.vertex_count, block, -1)
        count = flat.shape[2]
        if self._x.shape[0] != count:
            self._x = np.empty((count, d.vertex_count, block))
        np.take(flat.transpose(2, 0, 1), d.order, axis=1, out=self._x, mode="clip")  # unbuffered
        given = self._x.copy() if self._kind == SINGLE else None
        self._substitute()
        if given is not None and not self._refined(given):
            self._take(DOUBLE)
            self._failing_front()
            self._x[:] = given
            self._substitute()
        out = np.empty_like(flat)
        out[d.order] = self._x.transpose(1, 2, 0)
        return out.reshape(np.shape(right))

    def _refined(self, given: NDArray[np.float64]) -> bool:
        """Correct solutions by what they leave of the right-hand sides given; return whether they are accurate then."""
        solved, last = self._x.copy(), 1.0
        for _ in range(REFINEMENTS):
            self._x[:] = given
            inputs = [self.dissection.vertex_count, self._tree, *self._matrix, sent(solved.ravel(), wp.float64)]
            rest = sent(self._x.ravel(), wp.float64)
            wp.launch(subtract_product, dim=(len(given), 1), inputs=inputs, outputs=[rest], device="cpu")
            self._substitute()
            solved += self._x
            size = float(np.linalg.norm(self._x)) / max(float(np.linalg.norm(solved)), TINY)
            if size * size <= ACCURACY * last:  # as much smaller than this one the next would be
                self._x[:] = solved
                return True
            last = size
        return False

    def _substitute(self) -> None:
        """Replace right-hand sides in the order of elimination by the solutions that the factor gives."""
        d, block = self.dissection, self.block
        count, stride = self._x.shape[0], block * len(d.rows)
        carried = wp.array(self._carried.numbers(count * stride), dtype=wp.float64, device="cpu", copy=False)
        x = wp.array(self._x.ravel(), dtype=wp.float64, device="cpu", copy=False)
        load(solve_triangular, "cpu")
        inputs = [block * d.vertex_count, stride, self._tree, carried, x]

        def run(group: int, transposed: int) -> None:
            own = [self._groups[group], transposed, *inputs]
            wp.launch(solve_triangular, dim=count, inputs=own, device="cpu")

        run_all(partial(run, transposed=0), self._of_branches)
        for trunk in self._of_trunk:
            run(trunk, 0)
        if self._negative_places is not None:
            self._x.reshape(count, -1)[:, self._negative_places] *= -1.0
        for trunk in self._of_trunk:
            run(trunk, 1)
        run_all(partial(run, transposed=1), self._of_branches)
