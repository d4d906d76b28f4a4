"""A kernel that takes all local steps of a small patch; see :mod:`omtwarp.optimal.local`.

The unknowns of every vertex are its two tangent coordinates and its multiplier. A fixed vertex next to a patch has a
multiplier alone, since the area around it changes too.

The lanes of a patch are the threads that share it: one on the host, a block on a GPU. What is summed over triangles is
gathered by vertex, and what is summed over a patch the first lane adds in one order, so that the bits of a result do
not depend on the number of lanes.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import corners_of, logarithm, oriented_volume
from omtwarp.optimal import energy
from omtwarp.optimal.kernels import Fit, area_gradient, cost_slope, moving_cost, neighbour_fit, raised_fit
from omtwarp.optimal.shape_kernels import SPHERE_AREA, distortion_gradient, distortion_hessian, distortion_terms
from omtwarp.solvers import newton
from omtwarp.solvers.cholesky.envelope import Envelope, add_block, clear_row, meet, solve_envelope
from omtwarp.solvers.motion_kernels import keeps_volume
from omtwarp.solvers.newton import corner_block
from omtwarp.solvers.triangle import first_tangents, in_tangent, tangent_coordinates
from omtwarp.untangling.kernels import solid_angle

wp.set_module_options(KERNEL_OPTIONS)

LEAST = wp.constant(wp.float64(energy.LEAST_EIGENVALUE))
SUFFICIENT_DECREASE = wp.constant(wp.float64(newton.SUFFICIENT_DECREASE))
MAX_HALVINGS = wp.constant(12)  # of a patch's step before the patch stays where it is
# Added to the diagonal, relative to each entry, as the second derivative is only semidefinite.
REGULARISATION = wp.constant(wp.float64(1e-6))
# Places in the numbers of a patch: whether its matrix has a factor, the merit, the expected gain, and a step's length.
DEFINITE, MERIT, EXPECTED, LENGTH = wp.constant(0), wp.constant(1), wp.constant(2), wp.constant(3)


@wp.struct
class LocalProblem:
    """Patches one after another, the energy that they have of :mod:`omtwarp.optimal.energy`, and memory.

    Vertices are free or fixed, in the order of elimination. The threads of a launch share the memory; each works on the
    part of its patch.
    """

    face_starts: wp.array[wp.int32]  # where the triangles of every patch begin, [count + 1]
    faces: wp.array[wp.vec3i]  # places of their corners, [T]
    offsets: wp.array[wp.int32]  # where the corners at every vertex begin in ``corners``, [P + 1]
    corners: wp.array[wp.int32]  # 3 t + k of corner k of triangle t, vertex by vertex, [3 T]
    frames: wp.array[wp.vec3d]
    areas: wp.array[wp.float64]
    matrix: Envelope  # of their vertices
    free: wp.array[wp.bool]  # which vertices move, [P]
    start: wp.array[wp.vec3d]  # x of the vertices
    points: wp.array[wp.vec3d]  # their images, which steps move
    tried: wp.array[wp.vec3d]  # where a step leads to
    wanted: wp.array[wp.float64]  # areas around them
    whole: wp.array[wp.float64]  # areas around them in the map at the beginning
    multipliers: wp.array[wp.float64]  # of these areas, which steps change
    stiffness: wp.array[wp.float64]  # weights of squared area errors
    pressures: wp.vec3d  # as of omtwarp.optimal.shape.DistortionEnergy.pressures
    shape_weight: wp.float64
    cost_factor: wp.float64  # of ring times cost
    softness: wp.float64
    enough: wp.float64  # gain of a step after which a patch takes no more
    steps: wp.int32
    constrained: wp.bool
    gates: wp.array[wp.int32]  # as of omtwarp.solvers.cholesky.envelope.meet
    numbers: wp.array2d[wp.float64]  # of every patch, [count, 4]
    shape: wp.array[wp.float64]  # distortion of every triangle, [T]
    solid: wp.array[wp.float64]  # its solid angle
    blocks: wp.array2d[wp.float64]  # its Hessian, [T, 21]
    bends: wp.array2d[wp.vec2d]  # gradient of its solid angle by the tangent coordinates of its corners, [T, 3]
    pulls: wp.array2d[wp.vec3d]  # gradient of the energy by its corners, [T, 3]
    outside: wp.array[wp.float64]  # areas around vertices in triangles outside the patch, [P]
    ring: wp.array[wp.float64]  # areas around vertices
    cost: wp.array[wp.float64]
    worth: wp.array[wp.float64]  # what a vertex adds to the merit
    right: wp.array[wp.vec3d]
    step: wp.array[wp.vec3d]
    diagonal: wp.array[wp.mat33d]  # of the matrix, as of omtwarp.solvers.cholesky.envelope, [P]


@wp.func
def solid_angles_at(i: int, here: LocalProblem) -> wp.float64:
    """Sum the solid angles of a patch's triangles around a vertex."""
    total = ZERO
    for k in range(here.offsets[i], here.offsets[i + 1]):
        total += here.solid[here.corners[k] // 3]
    return total


@wp.func
def find_outside(p: int, lane: int, lanes: int, here: LocalProblem):
    """Compute what the triangles outside a patch, which stay, add to the areas around its fixed vertices."""
    for t in range(here.face_starts[p] + lane, here.face_starts[p + 1], lanes):
        a, b, c = corners_of(here.points, here.faces[t])
        here.solid[t] = solid_angle(a, b, c)
    meet(p, lane, lanes, here.gates)
    for i in range(here.matrix.starts[p] + lane, here.matrix.starts[p + 1], lanes):
        here.outside[i] = ZERO
        if not here.free[i]:
            here.outside[i] = here.whole[i] - solid_angles_at(i, here)


@wp.func
def merit_of(p: int, lane: int, lanes: int, here: LocalProblem, points: wp.array[wp.vec3d]) -> wp.float64:
    """Compute areas and costs, and return the merit; LARGE where a triangle lost nearly all the volume it has.

    Args:
        p: the patch.
        lane: the thread, one of so many ``lanes`` that share the patch.
        here: the patches.
        points: the images of their vertices, or where a step leads to.
    """
    begin = here.matrix.starts[p]
    end = here.matrix.starts[p + 1]
    meet(p, lane, lanes, here.gates)
    for t in range(here.face_starts[p] + lane, here.face_starts[p + 1], lanes):
        face = here.faces[t]
        a, b, c = corners_of(points, face)
        angle, d, volume, steep = distortion_terms(here.frames[t], a, b, c)
        had = oriented_volume(here.points[face[0]], here.points[face[1]], here.points[face[2]])
        here.solid[t] = solid_angle(a, b, c)
        here.shape[t] = LARGE
        if keeps_volume(volume, had):
            distortion = angle + here.pressures[0] * d + here.pressures[1] / d + here.pressures[2] * steep
            here.shape[t] = here.areas[t] * distortion
    meet(p, lane, lanes, here.gates)
    for i in range(begin + lane, end, lanes):
        ring = here.outside[i] + solid_angles_at(i, here)
        _pull, distance = logarithm(points[i], here.start[i])
        cost = moving_cost(distance, here.softness)
        missing = ring - here.wanted[i]
        here.ring[i] = ring
        here.cost[i] = cost
        pressed = here.multipliers[i] * missing
        here.worth[i] = here.cost_factor * ring * cost + pressed + HALF * here.stiffness[i] * missing * missing
    meet(p, lane, lanes, here.gates)
    if lane == 0:
        shape = ZERO
        for t in range(here.face_starts[p], here.face_starts[p + 1]):
            shape += here.shape[t]
        merit = here.shape_weight * shape / SPHERE_AREA
        for i in range(begin, end):
            merit += here.worth[i]
        here.numbers[p, MERIT] = wp.where(shape < LARGE, merit, LARGE)
    meet(p, lane, lanes, here.gates)
    return here.numbers[p, MERIT]


@wp.func
def differentiate(p: int, lane: int, lanes: int, here: LocalProblem):
    """Compute the gradients and Hessians of triangles, and the gradients of their areas.

    :func:`merit_of` has computed areas and costs at these points.
    """
    for t in range(here.face_starts[p] + lane, here.face_starts[p + 1], lanes):
        face = here.faces[t]
        a, b, c = corners_of(here.points, face)
        frame = here.frames[t]
        share = here.shape_weight * here.areas[t] / SPHERE_AREA
        rows = distortion_gradient(frame, share, a, b, c, here.pressures)
        distortion_hessian(t, frame, share, a, b, c, first_tangents(a, b, c), here.pressures, here.blocks)
        potential = ZERO
        for k in range(3):
            potential += here.multipliers[face[k]] + here.cost_factor * here.cost[face[k]]
        for k in range(3):
            bend = area_gradient(here.points, face, k)
            here.bends[t, k] = tangent_coordinates(here.points[face[k]], bend)
            here.pulls[t, k] = potential * bend + rows[k]
    meet(p, lane, lanes, here.gates)


@wp.func
def saddle_block(
    t: int, m: int, n: int, one: wp.bool, other: wp.bool, blocks: wp.array2d[wp.float64], bends: wp.array2d[wp.vec2d]
) -> wp.mat33d:
    """Return what triangle t adds to the matrix, rows of its corner m and columns of its corner n, each free or not.

    Of the patches it takes the arrays that it reads: their struct would be copied for every block.
    """
    block = wp.mat33d()
    if one and other:
        own = corner_block(t, m, n, blocks)
        for k in range(4):
            block[k // 2, k % 2] = own[k]
    for k in range(2):
        if m != n and one:
            block[k, 2] = bends[t, m][k]
        if m != n and other:
            block[2, k] = bends[t, n][k]
    return block


@wp.func
def assemble_row(i: int, here: LocalProblem):
    """Sum the blocks of a vertex with itself and those eliminated before it, and its right-hand side."""
    clear_row(i, here.matrix)
    y = here.points[i]
    x = here.start[i]
    pull, distance = logarithm(y, x)
    scale = TWO * here.cost_factor * here.ring[i] * cost_slope(distance, here.softness)
    slope = -scale * pull
    fit = Fit()
    block = wp.mat33d()
    free = here.free[i]
    for k in range(here.offsets[i], here.offsets[i + 1]):
        t = here.corners[k] // 3
        m = here.corners[k] - 3 * t
        face = here.faces[t]
        block = block + saddle_block(t, m, m, free, free, here.blocks, here.bends)
        for turn in range(1, 3):
            n = (m + turn) % 3
            j = face[n]
            if j < i and (free or here.free[j]):
                add_block(i, j, saddle_block(t, m, n, free, here.free[j], here.blocks, here.bends), here.matrix)
        if free:
            after = face[(m + 1) % 3]
            slope = slope + here.pulls[t, m]
            fit = fit + neighbour_fit(y, x, here.softness, here.points[after], here.start[after])
    right = wp.vec3d(ZERO, ZERO, here.wanted[i] - here.ring[i])
    if free:
        metric = scale * raised_fit(fit, LEAST)
        block[0, 0] = (ONE + REGULARISATION) * (block[0, 0] + metric[0])
        block[0, 1] = block[0, 1] + metric[1]
        block[1, 0] = block[1, 0] + metric[1]
        block[1, 1] = (ONE + REGULARISATION) * (block[1, 1] + metric[3])
        downhill = -tangent_coordinates(y, slope)
        right = wp.vec3d(downhill[0], downhill[1], right[2])
    else:
        block[0, 0] = ONE
        block[1, 1] = ONE
    block[2, 2] = -ONE / here.stiffness[i]
    here.diagonal[i] = block
    here.right[i] = right
    here.step[i] = right


@wp.func
def expect(p: int, here: LocalProblem):
    """Note the gain expected of the step, and the length to begin with: no vertex moves farther than half a radian."""
    expected = ZERO
    reach = ZERO
    for i in range(here.matrix.starts[p], here.matrix.starts[p + 1]):
        u = here.step[i]
        missing = -here.right[i][2]
        expected += here.right[i][0] * u[0] + here.right[i][1] * u[1]
        expected += missing * (here.stiffness[i] * missing - u[2])
        reach = wp.max(reach, wp.sqrt(u[0] * u[0] + u[1] * u[1]))
    here.numbers[p, EXPECTED] = expected
    here.numbers[p, LENGTH] = ZERO
    if expected > ZERO:
        here.numbers[p, LENGTH] = ONE / wp.max(ONE, TWO * reach)


@wp.func
def mean_change(p: int, here: LocalProblem) -> wp.float64:
    """Return the mean of the multipliers' steps, weighted by the areas wanted."""
    total = ZERO
    change = ZERO
    for i in range(here.matrix.starts[p], here.matrix.starts[p + 1]):
        total += here.wanted[i]
        change += here.wanted[i] * here.step[i][2]
    return change / total


@wp.kernel
def settle_small_patches(
    group: wp.array[wp.int32],
    first_lane: int,
    lanes: int,
    # Data in and out:
    here: LocalProblem,
):
    """Take Newton steps of a patch until the expected gain is small."""
    place, thread = wp.tid()
    p = group[place]
    lane = first_lane + thread
    begin = here.matrix.starts[p]
    end = here.matrix.starts[p + 1]
    find_outside(p, lane, lanes, here)
    left = int(here.steps)
    while left > 0:
        left -= 1
        merit = merit_of(p, lane, lanes, here, here.points)
        differentiate(p, lane, lanes, here)
        for i in range(begin + lane, end, lanes):
            assemble_row(i, here)
        solve_envelope(p, lane, lanes, here.matrix, here.gates, here.diagonal, here.step, here.numbers)
        length = ZERO
        expected = ZERO
        if here.numbers[p, DEFINITE] > ZERO:
            if lane == 0:
                expect(p, here)
            meet(p, lane, lanes, here.gates)
            expected = here.numbers[p, EXPECTED]
            length = here.numbers[p, LENGTH]
        trials = int(MAX_HALVINGS)
        taken = ZERO
        while trials > 0 and length > ZERO:
            trials -= 1
            for i in range(begin + lane, end, lanes):
                if here.free[i]:
                    here.tried[i] = in_tangent(here.points[i], length * here.step[i][0], length * here.step[i][1])
            after = merit_of(p, lane, lanes, here, here.tried)
            if after <= merit - SUFFICIENT_DECREASE * length * expected:
                taken = length
                length = ZERO
            else:
                length = HALF * length
        if taken > ZERO:
            # With its boundary fixed the area of a patch cannot change, so that its multipliers are determined up to a
            # constant, to which the patch's total area error would add at every step.
            constant = mean_change(p, here)
            for i in range(begin + lane, end, lanes):
                here.points[i] = here.tried[i]
                if here.constrained:
                    here.multipliers[i] = here.multipliers[i] + taken * (here.step[i][2] - constant)
        if not taken * expected > here.enough:
            left = int(0)
