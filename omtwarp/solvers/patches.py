"""Patches small enough that one thread takes all Newton steps of each, in one launch.

Step by step, a patch of fifty vertices takes 2.5 milliseconds for every Newton step, nearly all of it for some twenty
launches; in one launch it takes 0.1. Assembly, solution and lengths of steps are functions of Warp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import sent
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ZERO, wp
from omtwarp.device.threads import core_count, load, run_all
from omtwarp.mesh.patches import Patches, sides_of
from omtwarp.solvers import newton
from omtwarp.solvers.cholesky.envelope import (
    Envelope,
    Envelopes,
    add_block,
    clear_row,
    factorise_envelope,
    solve_envelope,
)
from omtwarp.solvers.newton import packed

wp.set_module_options(KERNEL_OPTIONS)

SUFFICIENT_DECREASE = wp.constant(wp.float64(newton.SUFFICIENT_DECREASE))


@wp.struct
class PatchMeshes:
    """Triangles and matrices of patches, one after another; see :class:`omtwarp.mesh.patches.Patches`.

    The places of all free vertices, patch by patch in the order of elimination, come before those of the fixed ones.
    """

    face_starts: wp.array[wp.int32]  # and its triangles, [count + 1]
    faces: wp.array[wp.vec3i]  # places of their corners, [T]
    frames: wp.array[wp.vec3d]
    areas: wp.array[wp.float64]
    matrix: Envelope  # of the free vertices
    shifts: wp.array[wp.float64]  # of the diagonal, one tried after another


@wp.struct
class PatchScratch:
    """Memory that the threads of a launch share; each works on the part of its patch."""

    gradient: wp.array2d[wp.float64]  # of every triangle by the tangent coordinates of its corners, [T, 6]
    blocks: wp.array2d[wp.float64]  # Hessian of every triangle, [T, 21]
    diagonal: wp.array[wp.mat22d]  # of the matrix, as of omtwarp.solvers.cholesky.envelope, [free]
    slopes: wp.array[wp.float64]  # gradient by the free vertices, two numbers each
    direction: wp.array[wp.float64]


@wp.func
def assemble(p: int, patches: PatchMeshes, growth: wp.float64, scratch: PatchScratch):
    """Sum the Hessians of the triangles, and let the diagonal grow by a share of its mean at each vertex."""
    begin = patches.matrix.starts[p]
    end = patches.matrix.starts[p + 1]
    for i in range(begin, end):
        clear_row(i, 2, patches.matrix)
        scratch.diagonal[i] = wp.mat22d(ZERO, ZERO, ZERO, ZERO)
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        for m in range(3):
            for n in range(m, 3):
                i = face[m]
                j = face[n]
                if i < end and j < end:
                    upper = packed(2 * m, 2 * n)
                    lower = packed(2 * m + 1, 2 * n + 1)
                    right = scratch.blocks[t, upper + 1]
                    left = right
                    if m < n:
                        left = scratch.blocks[t, lower - 1]
                    block = wp.mat22d(scratch.blocks[t, upper], right, left, scratch.blocks[t, lower])
                    add_block(i, j, block, patches.matrix, scratch.diagonal)
    for i in range(begin, end):
        own = scratch.diagonal[i]
        more = growth * HALF * (own[0, 0] + own[1, 1])
        scratch.diagonal[i] = own + wp.mat22d(more, ZERO, ZERO, more)


@wp.func
def find_direction(p: int, patches: PatchMeshes, growth: wp.float64, scratch: PatchScratch) -> wp.float64:
    """Compute the Newton direction of a patch from the derivatives of its triangles, and return the slope along it.

    The slope is not finite where no shift makes the matrix definite.
    """
    begin = patches.matrix.starts[p]
    end = patches.matrix.starts[p + 1]
    for k in range(2 * begin, 2 * end):
        scratch.slopes[k] = ZERO
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        for m in range(3):
            i = patches.faces[t][m]
            if i < end:
                scratch.slopes[2 * i] = scratch.slopes[2 * i] + scratch.gradient[t, 2 * m]
                scratch.slopes[2 * i + 1] = scratch.slopes[2 * i + 1] + scratch.gradient[t, 2 * m + 1]
    definite = bool(False)
    for attempt in range(patches.shifts.shape[0]):
        if not definite:
            assemble(p, patches, growth + patches.shifts[attempt], scratch)
            definite = factorise_envelope(begin, end, patches.matrix, scratch.diagonal)
    if not definite:
        return wp.float64(wp.NAN)
    for k in range(2 * begin, 2 * end):
        scratch.direction[k] = -scratch.slopes[k]
    solve_envelope(begin, end, patches.matrix, scratch.diagonal, scratch.direction)
    slope = ZERO
    for k in range(2 * begin, 2 * end):
        slope += scratch.direction[k] * scratch.slopes[k]
    return slope


@wp.func
def find_descent(p: int, patches: PatchMeshes, scratch: PatchScratch) -> wp.float64:
    """Compute the gradient over the diagonal of the Hessian as the direction, and return the slope along it."""
    assemble(p, patches, ZERO, scratch)
    slope = ZERO
    for i in range(patches.matrix.starts[p], patches.matrix.starts[p + 1]):
        own = scratch.diagonal[i]
        for u in range(2):
            k = 2 * i + u
            scratch.direction[k] = -scratch.slopes[k] / own[u, u]
            if not wp.isfinite(scratch.direction[k]):
                scratch.direction[k] = ZERO
            slope += scratch.direction[k] * scratch.slopes[k]
    return slope


@wp.func
def longest_move(p: int, patches: PatchMeshes, scratch: PatchScratch) -> wp.float64:
    """Return how far the direction moves a vertex at the most, in radians."""
    longest = ZERO
    for i in range(patches.matrix.starts[p], patches.matrix.starts[p + 1]):
        square = scratch.direction[2 * i] * scratch.direction[2 * i]
        square += scratch.direction[2 * i + 1] * scratch.direction[2 * i + 1]
        longest = wp.max(longest, square)
    return wp.sqrt(longest)


# Multiplications of the largest patch's factorisation: beyond some 2,600 vertices the multifrontal one takes less time.
MAX_OPERATIONS = 6e7
MIN_SHARED_TRIANGLES = 500  # with fewer a second thread costs more than it saves
BLOCK = 256  # threads of a block: Warp's own number, for which modules are compiled


@dataclass(frozen=True, eq=False)
class SmallPatches:
    """Patches with their free vertices in the order of elimination, and their triangles patch by patch.

    The host does the work, also where maps are on a CUDA device: there are few patches, of uneven sizes.

    Attributes:
        patches: as they were given.
        envelopes: the order and the storage of their matrices.
        triangles: indices of the patches' triangles sorted by patch, shape [T].
        face_starts: where the triangles of each patch begin among these, and T, int32, shape [count + 1].
    """

    patches: Patches
    envelopes: Envelopes
    triangles: NDArray[np.intp]
    face_starts: NDArray[np.int32]

    @classmethod
    def of(cls, patches: Patches) -> SmallPatches | None:
        """Order the free vertices and the triangles of patches; return None where one of the patches is too large."""
        sides = sides_of(patches.faces)
        sides = sides[(sides[:, 0] < patches.free) & (sides[:, 1] < patches.free)]
        envelopes = Envelopes.of_edges(sides, patches.vertex_patch, patches.count)
        if envelopes.operations.max() > MAX_OPERATIONS:
            return None
        face_starts = np.zeros(patches.count + 1, dtype=np.int32)
        np.cumsum(np.bincount(patches.face_patch, minlength=patches.count), out=face_starts[1:])
        return cls(patches, envelopes, np.argsort(patches.face_patch, kind="stable"), face_starts)

    @property
    def sizes(self) -> NDArray[np.int32]:
        """Free vertices of each patch, shape [count]."""
        return np.diff(self.envelopes.starts)

    def meshes(self, frames: NDArray[np.float64], areas: NDArray[np.float64]) -> PatchMeshes:
        """Return what kernels read of the patches.

        Args:
            frames: of their triangles, shape [T, 3]; see :mod:`omtwarp.solvers.triangle`.
            areas: of their triangles on the surface, shape [T].
        """
        order = self.envelopes.order
        place = np.arange(len(self.patches.vertices), dtype=np.int32)
        place[order] = np.arange(len(order), dtype=np.int32)
        meshes = PatchMeshes()
        meshes.matrix = self.envelopes.upload(2)
        meshes.face_starts = sent(self.face_starts, wp.int32)
        meshes.faces = sent(place[self.patches.faces[self.triangles]], wp.vec3i)
        meshes.frames = sent(frames[self.triangles], wp.vec3d)
        meshes.areas = sent(areas[self.triangles], wp.float64)
        meshes.shifts = sent(np.array(newton.DIAGONAL_SHIFTS), wp.float64)
        return meshes

    def scratch(self) -> PatchScratch:
        """Return memory for one launch."""
        triangles, free = len(self.triangles), self.patches.free
        scratch = PatchScratch()
        scratch.gradient = sent(np.empty((triangles, 6)), wp.float64)
        scratch.blocks = sent(np.empty((triangles, 21)), wp.float64)
        scratch.diagonal = wp.empty(free, dtype=wp.mat22d, device="cpu")
        scratch.slopes, scratch.direction = (sent(np.empty(2 * free), wp.float64) for _ in range(2))
        return scratch

    def launch(
        self, kernel: wp.Kernel, points: NDArray[np.float64], inputs: list[object], outputs: list[object]
    ) -> NDArray[np.float64]:
        """Launch a kernel over all patches, on all cores, and return the free vertices' points, shape [free, 3].

        Args:
            kernel: takes a list of patches, the inputs, the patches' points and those of steps that are tried, both
                with the map at the beginning, and the outputs. A thread works on one patch of the list.
            points: of the patches' vertices, shape [P, 3].
            inputs, outputs: further arguments.
        """
        order = self.envelopes.order
        moved = points.copy()
        moved[: len(order)] = points[order]
        tried = moved.copy()
        state = [sent(moved, wp.vec3d), sent(tried, wp.vec3d), *outputs]
        launch_patches(kernel, np.diff(self.face_starts), inputs, state)
        out = np.empty((len(order), 3))
        out[order] = moved[: len(order)]
        return out


def lanes_on(device: wp.Device) -> int:
    """Return how many threads share a patch: a block of a GPU, one thread of the host."""
    return BLOCK if device.is_cuda else 1


def launch_patches(
    kernel: wp.Kernel,
    sizes: NDArray[np.int32],
    inputs: list[object],
    outputs: list[object],
    device: wp.Device | str = "cpu",
) -> None:
    """Launch a kernel over all patches: a block of a GPU for each, or a thread, on all cores of the host.

    Args:
        kernel: takes a list of patches, the inputs and the outputs; its first index is a place in the list, its second
            the lane.
        sizes: triangles of each patch, shape [count]: every core gets about as many.
        inputs, outputs: further arguments.
        device: where these are.
    """
    where = wp.get_device(device)
    lanes = lanes_on(where)
    order = np.argsort(-sizes, kind="stable").astype(np.int32)
    cores = 1 if lanes > 1 or sizes.sum() < MIN_SHARED_TRIANGLES else min(core_count(), len(sizes))
    work = np.zeros(cores)
    core_of = np.zeros(len(sizes), dtype=np.intp)
    for patch in order:
        core_of[patch] = int(work.argmin())
        work[core_of[patch]] += sizes[patch]
    load(kernel, where)

    def run(group: NDArray[np.int32]) -> None:
        arguments = [sent(group, wp.int32, where), *inputs]
        grid = (len(group), lanes)
        wp.launch(kernel, dim=grid, inputs=arguments, outputs=outputs, device=where, block_dim=BLOCK)

    run_all(run, [order[core_of[order] == k] for k in range(cores)])
