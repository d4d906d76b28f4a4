"""Newton's method on small patches, one thread for each, as Warp functions: assembly, solution and lengths of steps."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ZERO, wp
from omtwarp.solvers.cholesky.envelope_kernels import (
    add_block,
    clear_row,
    factorise_envelope,
    solve_envelope,
)
from omtwarp.solvers.triangle_newton import line_search
from omtwarp.solvers.triangle_newton.newton_kernels import packed

wp.set_module_options(KERNEL_OPTIONS)

SUFFICIENT_DECREASE = wp.constant(wp.float64(line_search.SUFFICIENT_DECREASE))


@wp.struct
class PatchMeshes:
    """Triangles and matrices of patches, one after another; see :class:`omtwarp.mesh.patches.Patches`.

    The places of all free vertices, patch by patch in the order of elimination, come before those of the fixed ones.
    """

    starts: wp.array[wp.int32]  # where the free vertices of every patch begin, [count + 1]
    face_starts: wp.array[wp.int32]  # and its triangles, [count + 1]
    faces: wp.array[wp.vec3i]  # places of their corners, [T]
    frames: wp.array[wp.vec3d]
    areas: wp.array[wp.float64]
    first: wp.array[wp.int32]  # as of omtwarp.solvers.cholesky.envelope_kernels, [free]
    last: wp.array[wp.int32]
    rows: wp.array[wp.int64]
    shifts: wp.array[wp.float64]  # of the diagonal, one tried after another


@wp.struct
class PatchScratch:
    """Memory that the threads of a launch share; each works on the part of its patch."""

    gradient: wp.array2d[wp.float64]  # of every triangle by the tangent coordinates of its corners, [T, 6]
    blocks: wp.array2d[wp.float64]  # Hessian of every triangle, [T, 21]
    diagonal: wp.array[wp.mat22d]  # of the matrix, as of omtwarp.solvers.cholesky.envelope_kernels, [free]
    left: wp.array[wp.float64]
    slopes: wp.array[wp.float64]  # gradient by the free vertices, two numbers each
    direction: wp.array[wp.float64]


@wp.func
def assemble(p: int, patches: PatchMeshes, growth: wp.float64, scratch: PatchScratch):
    """Sum the Hessians of the triangles, and let the diagonal grow by a share of its mean at each vertex."""
    begin = patches.starts[p]
    end = patches.starts[p + 1]
    for i in range(begin, end):
        clear_row(i, 2, patches.first, patches.rows, scratch.left)
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
                    add_block(i, j, block, patches.first, patches.rows, scratch.diagonal, scratch.left)
    for i in range(begin, end):
        own = scratch.diagonal[i]
        more = growth * HALF * (own[0, 0] + own[1, 1])
        scratch.diagonal[i] = own + wp.mat22d(more, ZERO, ZERO, more)


@wp.func
def find_direction(p: int, patches: PatchMeshes, growth: wp.float64, scratch: PatchScratch) -> wp.float64:
    """Compute the Newton direction of a patch from the derivatives of its triangles, and return the slope along it.

    The slope is not finite where no shift makes the matrix definite.
    """
    begin = patches.starts[p]
    end = patches.starts[p + 1]
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
            definite = factorise_envelope(begin, end, patches.first, patches.rows, scratch.diagonal, scratch.left)
    if not definite:
        return wp.float64(wp.NAN)
    for k in range(2 * begin, 2 * end):
        scratch.direction[k] = -scratch.slopes[k]
    first = patches.first
    solve_envelope(begin, end, first, patches.last, patches.rows, scratch.diagonal, scratch.left, scratch.direction)
    slope = ZERO
    for k in range(2 * begin, 2 * end):
        slope += scratch.direction[k] * scratch.slopes[k]
    return slope


@wp.func
def find_descent(p: int, patches: PatchMeshes, scratch: PatchScratch) -> wp.float64:
    """Compute the gradient over the diagonal of the Hessian as the direction, and return the slope along it."""
    assemble(p, patches, ZERO, scratch)
    slope = ZERO
    for i in range(patches.starts[p], patches.starts[p + 1]):
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
    for i in range(patches.starts[p], patches.starts[p + 1]):
        square = scratch.direction[2 * i] * scratch.direction[2 * i]
        square += scratch.direction[2 * i + 1] * scratch.direction[2 * i + 1]
        longest = wp.max(longest, square)
    return wp.sqrt(longest)


__all__ = [
    "SUFFICIENT_DECREASE",
    "PatchMeshes",
    "PatchScratch",
    "find_descent",
    "find_direction",
    "longest_move",
]
