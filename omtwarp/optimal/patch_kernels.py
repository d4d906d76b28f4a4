"""A kernel that takes all local steps of a small patch in one thread; see :mod:`omtwarp.optimal.local`.

The unknowns of every vertex are its two tangent coordinates and its multiplier. A fixed vertex next to a patch has a
multiplier alone, since the area around it changes too.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import logarithm, oriented_volume
from omtwarp.mesh import surface
from omtwarp.optimal.kernels import Fit, area_gradient, cost_slope, moving_cost, neighbour_fit, raised_fit
from omtwarp.refine.kernels import distortion_gradient, distortion_hessian, distortion_terms
from omtwarp.solvers.cholesky.envelope_kernels import (
    add_saddle_block,
    clear_envelope,
    factorise_saddle_envelope,
    solve_saddle_envelope,
)
from omtwarp.solvers.triangle_newton.motion_kernels import keeps_volume
from omtwarp.solvers.triangle_newton.newton_kernels import packed
from omtwarp.solvers.triangle_newton.patch_kernels import SUFFICIENT_DECREASE
from omtwarp.solvers.triangle_newton.triangle import first_tangent, in_tangent
from omtwarp.untangling.kernels import solid_angle

wp.set_module_options(KERNEL_OPTIONS)

SPHERE_AREA = wp.constant(wp.float64(surface.SPHERE_AREA))


@wp.struct
class SaddlePatches:
    """Patches one after another; vertices are free or fixed, in the order of elimination."""

    starts: wp.array[wp.int32]  # where the vertices of every patch begin, [count + 1]
    face_starts: wp.array[wp.int32]  # and its triangles, [count + 1]
    faces: wp.array[wp.vec3i]  # places of their corners, [T]
    frames: wp.array[wp.vec3d]
    areas: wp.array[wp.float64]
    first: wp.array[wp.int32]  # as of omtwarp.solvers.cholesky.envelope_kernels, [P]
    rows: wp.array[wp.int64]
    free: wp.array[wp.bool]  # which vertices move, [P]
    start: wp.array[wp.vec3d]  # x of the vertices
    wanted: wp.array[wp.float64]  # areas around them
    whole: wp.array[wp.float64]  # areas around them in the map at the beginning
    stiffness: wp.array[wp.float64]  # weights of squared area errors


@wp.struct
class LocalEnergy:
    """The energy of :mod:`omtwarp.optimal.energy`, and how its steps are taken."""

    linear: wp.float64  # factors of omtwarp.refine.energy.DistortionEnergy.pressures
    inverse: wp.float64
    barrier: wp.float64
    shape_weight: wp.float64
    cost_factor: wp.float64  # of ring times cost
    softness: wp.float64
    least: wp.float64  # as of omtwarp.optimal.kernels.cost_metric
    regularisation: wp.float64
    enough: wp.float64  # gain of a step after which a patch takes no more
    steps: wp.int32
    halvings: wp.int32
    constrained: wp.bool


@wp.struct
class LocalScratch:
    """Memory that the threads of a launch share; each works on the part of its patch."""

    blocks: wp.array2d[wp.float64]  # Hessian of every triangle, [T, 21]
    bends: wp.array2d[wp.float64]  # gradient of its solid angle by the tangent coordinates of its corners, [T, 6]
    outside: wp.array[wp.float64]  # areas around vertices in triangles outside the patch
    ring: wp.array[wp.float64]  # areas around vertices
    cost: wp.array[wp.float64]
    fits: wp.array[Fit]
    pull: wp.array[wp.vec3d]  # gradient of the energy by every vertex, and its multiplier's right-hand side
    right: wp.array[wp.vec3d]
    step: wp.array[wp.vec3d]
    diagonal: wp.array[wp.mat33d]  # of the matrix, as of omtwarp.solvers.cholesky.envelope_kernels, [P]
    left: wp.array[wp.float64]


@wp.func
def find_outside(p: int, patches: SaddlePatches, points: wp.array[wp.vec3d], scratch: LocalScratch):
    """Compute what the triangles outside a patch, which stay, add to the areas around its fixed vertices."""
    for i in range(patches.starts[p], patches.starts[p + 1]):
        scratch.outside[i] = wp.where(patches.free[i], ZERO, patches.whole[i])
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        solid = solid_angle(points[face[0]], points[face[1]], points[face[2]])
        for k in range(3):
            if not patches.free[face[k]]:
                scratch.outside[face[k]] = scratch.outside[face[k]] - solid


@wp.func
def merit_of(
    p: int,
    patches: SaddlePatches,
    given: LocalEnergy,
    before: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    multipliers: wp.array[wp.float64],
    scratch: LocalScratch,
) -> wp.float64:
    """Compute areas and costs, and return the merit; LARGE where a triangle lost nearly all the volume it had."""
    begin = patches.starts[p]
    end = patches.starts[p + 1]
    for i in range(begin, end):
        scratch.ring[i] = scratch.outside[i]
    shape = ZERO
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        a = points[face[0]]
        b = points[face[1]]
        c = points[face[2]]
        angle, d, volume, steep = distortion_terms(patches.frames[t], a, b, c)
        had = oriented_volume(before[face[0]], before[face[1]], before[face[2]])
        if not keeps_volume(volume, had):
            return LARGE
        shape += patches.areas[t] * (angle + given.linear * d + given.inverse / d + given.barrier * steep)
        solid = solid_angle(a, b, c)
        for k in range(3):
            scratch.ring[face[k]] = scratch.ring[face[k]] + solid
    merit = given.shape_weight * shape / SPHERE_AREA
    for i in range(begin, end):
        _pull, distance = logarithm(points[i], patches.start[i])
        cost = moving_cost(distance, given.softness)
        scratch.cost[i] = cost
        missing = scratch.ring[i] - patches.wanted[i]
        merit += given.cost_factor * scratch.ring[i] * cost
        merit += multipliers[i] * missing + HALF * patches.stiffness[i] * missing * missing
    return merit


@wp.func
def differentiate(
    p: int,
    patches: SaddlePatches,
    given: LocalEnergy,
    points: wp.array[wp.vec3d],
    multipliers: wp.array[wp.float64],
    scratch: LocalScratch,
):
    """Compute the gradient, the Hessians of triangles, their areas' gradients and the metric of the cost's fits.

    :func:`merit_of` has computed areas and costs at these points.
    """
    begin = patches.starts[p]
    end = patches.starts[p + 1]
    for i in range(begin, end):
        pull, distance = logarithm(points[i], patches.start[i])
        scale = TWO * given.cost_factor * scratch.ring[i] * cost_slope(distance, given.softness)
        scratch.pull[i] = -scale * pull
        scratch.fits[i] = Fit()
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        a = points[face[0]]
        b = points[face[1]]
        c = points[face[2]]
        frame = patches.frames[t]
        share = given.shape_weight * patches.areas[t] / SPHERE_AREA
        rows = distortion_gradient(frame, share, a, b, c, given.linear, given.inverse, given.barrier)
        distortion_hessian(t, frame, share, a, b, c, given.linear, given.inverse, given.barrier, scratch.blocks)
        potential = ZERO
        for k in range(3):
            potential += multipliers[face[k]] + given.cost_factor * scratch.cost[face[k]]
        for k in range(3):
            i = face[k]
            j = face[(k + 1) % 3]
            y = points[i]
            bend = area_gradient(y, points[j], points[face[(k + 2) % 3]])
            tangent = first_tangent(y)
            scratch.bends[t, 2 * k] = wp.dot(tangent, bend)
            scratch.bends[t, 2 * k + 1] = wp.dot(wp.cross(y, tangent), bend)
            if patches.free[i]:
                scratch.pull[i] = scratch.pull[i] + potential * bend + rows[k]
                fit = neighbour_fit(y, patches.start[i], given.softness, points[j], patches.start[j])
                scratch.fits[i] = scratch.fits[i] + fit


@wp.func
def assemble(p: int, patches: SaddlePatches, given: LocalEnergy, points: wp.array[wp.vec3d], scratch: LocalScratch):
    """Sum the saddle-point matrix and the right-hand side."""
    begin = patches.starts[p]
    end = patches.starts[p + 1]
    clear_envelope(begin, end, 3, patches.first, patches.rows, scratch.left)
    for i in range(begin, end):
        scratch.diagonal[i] = wp.mat33d()
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        for m in range(3):
            for n in range(m, 3):
                i = face[m]
                j = face[n]
                block = wp.mat33d()
                if patches.free[i] and patches.free[j]:
                    upper = packed(2 * m, 2 * n)
                    lower = packed(2 * m + 1, 2 * n + 1)
                    block[0, 0] = scratch.blocks[t, upper]
                    block[0, 1] = scratch.blocks[t, upper + 1]
                    block[1, 0] = scratch.blocks[t, upper + 1]
                    if m < n:
                        block[1, 0] = scratch.blocks[t, lower - 1]
                    block[1, 1] = scratch.blocks[t, lower]
                if m < n:
                    if patches.free[i]:
                        block[0, 2] = scratch.bends[t, 2 * m]
                        block[1, 2] = scratch.bends[t, 2 * m + 1]
                    if patches.free[j]:
                        block[2, 0] = scratch.bends[t, 2 * n]
                        block[2, 1] = scratch.bends[t, 2 * n + 1]
                if patches.free[i] or patches.free[j]:
                    add_saddle_block(i, j, block, patches.first, patches.rows, scratch.diagonal, scratch.left)
    for i in range(begin, end):
        block = scratch.diagonal[i]
        right = wp.vec3d(ZERO, ZERO, patches.wanted[i] - scratch.ring[i])
        if patches.free[i]:
            y = points[i]
            _pull, distance = logarithm(y, patches.start[i])
            scale = TWO * given.cost_factor * scratch.ring[i] * cost_slope(distance, given.softness)
            metric = scale * raised_fit(scratch.fits[i], given.least)
            block[0, 0] = (ONE + given.regularisation) * (block[0, 0] + metric[0])
            block[0, 1] = block[0, 1] + metric[1]
            block[1, 0] = block[1, 0] + metric[1]
            block[1, 1] = (ONE + given.regularisation) * (block[1, 1] + metric[2])
            tangent = first_tangent(y)
            right[0] = -wp.dot(tangent, scratch.pull[i])
            right[1] = -wp.dot(wp.cross(y, tangent), scratch.pull[i])
        else:
            block[0, 0] = ONE
            block[1, 1] = ONE
        block[2, 2] = -ONE / patches.stiffness[i]
        scratch.diagonal[i] = block
        scratch.right[i] = right
        scratch.step[i] = right


@wp.kernel
def settle_small_patches(
    group: wp.array[wp.int32],
    patches: SaddlePatches,
    given: LocalEnergy,
    # Data in and out:
    points: wp.array[wp.vec3d],
    tried: wp.array[wp.vec3d],
    multipliers: wp.array[wp.float64],
    scratch: LocalScratch,
):
    """Take Newton steps of a patch until the expected gain is small."""
    thread, _compiled_once = wp.tid()
    p = group[thread]
    begin = patches.starts[p]
    end = patches.starts[p + 1]
    find_outside(p, patches, points, scratch)
    left = int(given.steps)
    while left > 0:
        left -= 1
        merit = merit_of(p, patches, given, points, points, multipliers, scratch)
        differentiate(p, patches, given, points, multipliers, scratch)
        assemble(p, patches, given, points, scratch)
        length = ZERO
        expected = ZERO
        if factorise_saddle_envelope(begin, end, patches.first, patches.rows, scratch.diagonal, scratch.left):
            solve_saddle_envelope(begin, end, patches.first, patches.rows, scratch.diagonal, scratch.left, scratch.step)
            reach = ZERO
            for i in range(begin, end):
                u = scratch.step[i]
                missing = -scratch.right[i][2]
                expected += scratch.right[i][0] * u[0] + scratch.right[i][1] * u[1]
                expected += missing * (patches.stiffness[i] * missing - u[2])
                reach = wp.max(reach, wp.sqrt(u[0] * u[0] + u[1] * u[1]))
            if expected > ZERO:
                # No vertex moves farther than half a radian.
                length = ONE / wp.max(ONE, TWO * reach)
        trials = int(given.halvings)
        taken = ZERO
        while trials > 0 and length > ZERO:
            trials -= 1
            for i in range(begin, end):
                if patches.free[i]:
                    tried[i] = in_tangent(points[i], length * scratch.step[i][0], length * scratch.step[i][1])
            after = merit_of(p, patches, given, points, tried, multipliers, scratch)
            if after <= merit - SUFFICIENT_DECREASE * length * expected:
                taken = length
                length = ZERO
            else:
                length = HALF * length
        if taken > ZERO:
            for i in range(begin, end):
                points[i] = tried[i]
            if given.constrained:
                # With its boundary fixed the area of a patch cannot change, so that its multipliers are determined up
                # to a constant, to which the patch's total area error would add at every step.
                total = ZERO
                change = ZERO
                for i in range(begin, end):
                    total += patches.wanted[i]
                    change += patches.wanted[i] * scratch.step[i][2]
                for i in range(begin, end):
                    multipliers[i] = multipliers[i] + taken * (scratch.step[i][2] - change / total)
        if not taken * expected > given.enough:
            left = int(0)
