"""Kernels of the Lagrangian transport flow: its cost, its force, the motion along a stream function, and its descent.

The descent decides on the device: inner products, directions, and acceptance of steps.
"""

from enum import IntEnum

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.device.sums import column_sum
from omtwarp.geometry.spherical import TINY, corners_of, logarithm
from omtwarp.wavelets.kernels import triangle_near

wp.set_module_options(KERNEL_OPTIONS)


class Ending(IntEnum):
    """Why a descent ended; 0 while it goes on."""

    SMALL_CURL = 1
    SETTLED = 2
    NO_STEP = 3
    AREAS = 4
    ITERATIONS = 5


@wp.struct
class FlowState:
    """The state and the parameters of a descent; a single one, on the device."""

    # Set at the start:
    most: wp.int32  # iterations
    conjugate: wp.int32  # 0 for steepest descent
    tolerance: wp.float64  # of the relative curl
    cost_tolerance: wp.float64  # three steps that together lower the cost by less than this share of it end the descent
    negligible: wp.float64  # share of the cost that a step has to be expected to gain
    scale: wp.float64  # of the preconditioned gradient: the second derivative of the cost along it
    longest: wp.float64
    first_cost: wp.float64
    largest_error: wp.float64  # bound on the area error, without any gain
    # Changes during the descent:
    cost: wp.float64
    area_error: wp.float64
    last_gain: wp.float64  # of cost, by the step before
    last_gains: wp.float64  # by the two before
    gains: wp.float64  # by the three before
    step: wp.float64
    square: wp.float64  # of the gradient
    slope: wp.float64  # of the cost along the direction
    factor: wp.float64  # of the last direction in this one
    iteration: wp.int32
    trials: wp.int32
    shortened: wp.int32  # trials refused for their areas
    accepted: wp.int32
    ended: wp.int32  # an Ending


@wp.kernel
def begin_iteration(
    products: wp.array[wp.float64],
    held: wp.array[wp.int32],
    # Data in and out:
    state: wp.array[FlowState],
    # Data out:
    records: wp.array2d[wp.float64],
    running: wp.array[wp.int32],
    searching: wp.array[wp.int32],
):
    """Write the record, test for the end, and choose the direction.

    Polak and Ribière's conjugate directions, restarted when they stop pointing downhill. The products are those of the
    gradient with preconditioned gradient, ascent and last direction, and of the previous gradient with ascent.
    """
    s = state[0]
    size, square = products[0], products[1]
    curl = wp.sqrt(wp.max(size / s.scale, ZERO) / wp.max(s.scale * s.cost, TINY))
    row = s.iteration % records.shape[0]
    records[row, 0] = s.cost
    records[row, 1] = curl
    records[row, 2] = s.step
    records[row, 3] = wp.float64(held[0])
    records[row, 4] = s.area_error

    s.accepted = 0
    s.trials = 0
    s.shortened = 0
    # A cost below fifty times the round-off of float64 is none.
    if curl <= s.tolerance or s.cost <= wp.float64(1e-14) or size <= ZERO:
        s.ended = Ending.SMALL_CURL
    elif s.gains <= s.cost_tolerance * s.cost:
        s.ended = Ending.SETTLED
    elif s.iteration == s.most:
        s.ended = Ending.ITERATIONS
    searching[0] = wp.where(s.ended == 0, 1, 0)

    s.factor = ZERO
    if s.iteration > 0 and s.conjugate == 1:
        s.factor = wp.max(ZERO, (square - products[3]) / s.square)
    s.slope = s.factor * products[2] - square
    if s.slope > -wp.float64(0.1) * square:
        s.factor = ZERO
        s.slope = -square
    s.square = square
    s.iteration = s.iteration + 1
    # Where the records are full, let the host read them.
    running[0] = wp.where(s.ended == 0 and s.iteration % records.shape[0] != 0, 1, 0)
    state[0] = s


@wp.kernel
def turn_direction(
    gradient: wp.array[wp.float64],
    ascent: wp.array[wp.float64],
    state: wp.array[FlowState],
    # Data in and out:
    direction: wp.array[wp.float64],
    # Data out:
    previous: wp.array[wp.float64],
):
    """Compute direction <- factor * direction - ascent; and the gradient becomes the previous one."""
    i = wp.tid()
    direction[i] = state[0].factor * direction[i] - ascent[i]
    previous[i] = gradient[i]


@wp.kernel
def judge_step(
    measured: wp.array2d[wp.float64],
    total_area: wp.float64,
    # Data in and out:
    state: wp.array[FlowState],
    # Data out:
    running: wp.array[wp.int32],
    searching: wp.array[wp.int32],
):
    """Accept a step, or choose the length of the next trial, or give up."""
    s = state[0]
    cost = column_sum(measured, 0)
    # The minimum of the parabola through the cost, its slope and the trial is the next length.
    bend = (cost - s.cost - s.slope * s.step) / (s.step * s.step)
    best = TWO * s.step
    if bend > ZERO:
        best = -s.slope / (TWO * bend)
    s.trials = s.trials + 1
    over = int(0)
    # A step has to reach this share of the gain by the slope (Armijo).
    if cost <= s.cost + wp.float64(0.1) * s.slope * s.step:
        s.area_error = column_sum(measured, 1) / total_area
        price = wp.float64(0.02)  # how much the bound on the area error grows for a gain of the whole cost
        if s.area_error <= s.largest_error + price * (ONE - cost / s.first_cost):
            s.accepted = 1
            over = 1
        elif s.shortened == 3:  # steps that lose too much area are halved so often
            over = 1
        else:
            # The area error of a step grows with the square of its length, the gain with the length.
            s.shortened = s.shortened + 1
            s.step = HALF * s.step
    else:
        s.step = wp.max(wp.min(best, HALF * s.step), wp.float64(0.1) * s.step)
        if -s.slope * s.step < s.negligible * s.cost:
            over = 1
    # Step trials, lengths of a step, at most: halved so often, it is below 1e-9 of the first
    if s.trials == 30:
        over = 1
    if over == 1:
        searching[0] = 0
        if s.accepted == 1:
            gain = s.cost - cost
            s.gains = s.last_gains + gain
            s.last_gains = s.last_gain + gain
            s.last_gain = gain
            s.cost = cost
            s.step = wp.min(wp.min(wp.max(best, HALF * s.step), TWO * s.step), s.longest)
        else:
            # Either the area error is too large, or no step along the best direction lowers the cost.
            running[0] = 0
            s.ended = Ending.AREAS
            if s.shortened == 0:
                s.ended = Ending.NO_STEP
    state[0] = s


@wp.kernel
def keep_accepted(
    trial: wp.array[wp.vec3d],
    state: wp.array[FlowState],
    # Data in and out:
    points: wp.array[wp.vec3d],
):
    i = wp.tid()
    if state[0].accepted == 1:
        points[i] = trial[i]


@wp.kernel
def cost_and_force(
    start_centres: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    masses: wp.array[wp.float64],
    shares: wp.array[wp.float64],
    geodesic: int,
    softening: wp.float64,
    largest_error: wp.float64,
    # Data out:
    measured: wp.array2d[wp.float64],
    turned: wp.array[wp.vec3d],
    centres: wp.array[wp.vec3d],
):
    """Compute cost and area error of every triangle, and c × y with c the cost's derivative by its centre y.

    The error is the area times D + 1/D - 2, D that of the flat image over its own, at most ``largest_error``.
    ``shares`` is the area that a unit of mass is to cover at every vertex, or empty where that is 1.
    """
    f = wp.tid()
    face = faces[f]
    p0, p1, p2 = corners_of(points, face)
    y = wp.normalize(p0 + p1 + p2)
    centres[f] = y
    pull, distance = logarithm(y, start_centres[f])
    mass = masses[f]
    wanted = mass
    if shares.shape[0] > 0:
        wanted = mass * (shares[face[0]] + shares[face[1]] + shares[face[2]]) / wp.float64(3.0)
    # Least ratio, of areas: its reciprocal, and that times an area, stay finite
    ratio = wp.max(HALF * wp.length(wp.cross(p1 - p0, p2 - p0)) / wanted, wp.float64(1e-150))
    measured[f, 1] = wanted * wp.min(ratio + ONE / ratio - TWO, largest_error)
    if geodesic == 1:
        # The gradient of the distance jumps at y = x; within the softening length it is taken as linear.
        soft = wp.sqrt(distance * distance + softening * softening)
        measured[f, 0] = mass * distance
        turned[f] = wp.cross(-mass / soft * pull, y)
    else:
        measured[f, 0] = mass * distance * distance
        turned[f] = wp.cross(-TWO * mass * pull, y)


@wp.func(inline=True)
def stream_velocity(
    p: wp.vec3d,
    hint: int,
    nodes: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    level_starts: wp.array[wp.int32],
    gradients: wp.array[wp.vec3d],
):
    """Return J ∇H at p: p × ∇H, with ∇H linear between the nodes of the finest level; and the triangle that p is in.

    The triangle of a point nearby, where one is known, is tried first.
    """
    g, w = triangle_near(p, hint, nodes, faces, level_starts)
    slope = w[0] * gradients[faces[g, 0]] + w[1] * gradients[faces[g, 1]] + w[2] * gradients[faces[g, 2]]
    return wp.cross(p, slope / (w[0] + w[1] + w[2])), g


@wp.kernel
def advect_points(
    points: wp.array[wp.vec3d],
    state: wp.array[FlowState],
    nodes: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    level_starts: wp.array[wp.int32],
    gradients: wp.array[wp.vec3d],
    # Data in and out:
    hints: wp.array[wp.int32],
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Take a fourth-order Runge-Kutta step of dy/dt = J ∇H(y), of the length in the state.

    ``hints`` remembers in which triangle it ended, where the next one is likely to begin; -1 where nothing is known.
    """
    v, _compiled_once = wp.tid()
    p = points[v]
    step = state[0].step
    half = HALF * step
    k1, f1 = stream_velocity(p, hints[v], nodes, faces, level_starts, gradients)
    k2, f2 = stream_velocity(wp.normalize(p + half * k1), f1, nodes, faces, level_starts, gradients)
    k3, f3 = stream_velocity(wp.normalize(p + half * k2), f2, nodes, faces, level_starts, gradients)
    k4, f4 = stream_velocity(wp.normalize(p + step * k3), f3, nodes, faces, level_starts, gradients)
    hints[v] = f4
    moved[v] = wp.normalize(p + step * wp.float64(1.0 / 6.0) * (k1 + TWO * k2 + TWO * k3 + k4))


@wp.kernel
def values_at_points(
    points: wp.array[wp.vec3d],
    hints: wp.array[wp.int32],
    nodes: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    level_starts: wp.array[wp.int32],
    values: wp.array[wp.float64],
    # Data out:
    holding: wp.array[wp.float64],
):
    """Interpolate a function of the nodes linearly; ``hints`` as in :func:`advect_points`."""
    v = wp.tid()
    p = points[v]
    g, w = triangle_near(p, hints[v], nodes, faces, level_starts)
    total = w[0] * values[faces[g, 0]] + w[1] * values[faces[g, 1]] + w[2] * values[faces[g, 2]]
    holding[v] = total / (w[0] + w[1] + w[2])
