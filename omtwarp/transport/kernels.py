"""Kernels of the Lagrangian transport flow: its cost, its force and the motion along a stream function."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, wp
from omtwarp.geometry.spherical import logarithm
from omtwarp.transport.cost import area_error, centre
from omtwarp.transport.descent_kernels import FlowState
from omtwarp.wavelets.kernels import triangle_near

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def face_centres(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    centres: wp.array[wp.vec3d],
):
    f = wp.tid()
    centres[f] = centre(points, faces[f])


@wp.kernel
def longest_edges(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    squares: wp.array[wp.float64],
):
    """Compute the square of the longest edge of every triangle."""
    f = wp.tid()
    a, b, c = points[faces[f][0]], points[faces[f][1]], points[faces[f][2]]
    squares[f] = wp.max(wp.max(wp.length_sq(b - a), wp.length_sq(c - b)), wp.length_sq(a - c))


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

    ``shares`` is the area that a unit of mass is to cover at every vertex, or empty where that is 1.
    """
    f = wp.tid()
    face = faces[f]
    y = centre(points, face)
    centres[f] = y
    pull, distance = logarithm(y, start_centres[f])
    mass = masses[f]
    wanted = mass
    if shares.shape[0] > 0:
        wanted = mass * (shares[face[0]] + shares[face[1]] + shares[face[2]]) / wp.float64(3.0)
    measured[f, 1] = area_error(points, face, wanted, largest_error)
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


@wp.kernel
def divide_by_area(
    weak: wp.array[wp.float64],
    areas: wp.array[wp.float64],
    # Data out:
    strong: wp.array[wp.float64],
):
    i = wp.tid()
    strong[i] = weak[i] * (ONE / areas[i])
