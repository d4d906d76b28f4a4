"""Kernels of the spherical barycentric maps: edge weights, the vertex sweep, and the Newton matrix.

Every kernel gathers: a thread owns one face, one vertex or one stored matrix entry, so sums have one order.
"""
# mypy: ignore-errors

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.geometry.spherical import tangential

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def half_angle_tangent(u: wp.vec3d, v: wp.vec3d) -> wp.float64:
    """Return tan(θ/2) of the angle θ between u and v; sin/(1 + cos) stays accurate at both ends."""
    return wp.length(wp.cross(u, v)) / (wp.length(u) * wp.length(v) + wp.dot(u, v))


@wp.kernel
def mean_value_edge_weights(
    # Mesh:
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    # Data out:
    weights_out: wp.array2d[wp.float64],
):
    """Compute the part of each face in the symmetric weight of its edges (k, k+1): the mean of both directed ones."""
    f = wp.tid()
    p0 = vertices[faces[f, 0]]
    p1 = vertices[faces[f, 1]]
    p2 = vertices[faces[f, 2]]
    t0 = half_angle_tangent(p1 - p0, p2 - p0)
    t1 = half_angle_tangent(p2 - p1, p0 - p1)
    t2 = half_angle_tangent(p0 - p2, p1 - p2)
    weights_out[f, 0] = HALF * (t0 + t1) / wp.length(p1 - p0)
    weights_out[f, 1] = HALF * (t1 + t2) / wp.length(p2 - p1)
    weights_out[f, 2] = HALF * (t2 + t0) / wp.length(p0 - p2)


@wp.kernel
def sweep_vertices(
    # Weights as compressed rows:
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    # Map:
    x: wp.array[wp.vec3d],
    # Data out:
    force_out: wp.array[wp.vec3d],
    tension_out: wp.array[wp.float64],
    deviation_out: wp.array[wp.float64],
):
    """Sweep over the vertices: s_i = Σ w_ij x_j, its tangential part (force), α_i = s_i·x_i (tension) and the
    distance from x_i to s_i / |s_i| (deviation: zero where x_i is the normalised mean of its neighbours)."""
    i = wp.tid()
    s = wp.vec3d()
    for k in range(offsets[i], offsets[i + 1]):
        s += weights[k] * x[columns[k]]
    tension_out[i] = wp.dot(s, x[i])
    force_out[i] = tangential(s, x[i])
    size = wp.length(s)
    deviation = wp.float64(2.0)
    if size > ZERO:
        deviation = wp.length(x[i] - s / size)
    deviation_out[i] = deviation


@wp.kernel
def newton_blocks(
    # Weights as compressed rows; row of every stored entry:
    rows: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    # Tangent frames:
    frame_u: wp.array[wp.vec3d],
    frame_v: wp.array[wp.vec3d],
    # Data out:
    blocks_out: wp.array[wp.mat22d],
):
    """Compute -w_ij times the 2 x 2 matrix that takes tangent coordinates at x_j to those at x_i."""
    k = wp.tid()
    i = rows[k]
    j = columns[k]
    w = weights[k]
    blocks_out[k] = wp.mat22d(
        -w * wp.dot(frame_u[i], frame_u[j]),
        -w * wp.dot(frame_u[i], frame_v[j]),
        -w * wp.dot(frame_v[i], frame_u[j]),
        -w * wp.dot(frame_v[i], frame_v[j]),
    )


@wp.kernel
def tangent_frames(
    x: wp.array[wp.vec3d],
    # Data out:
    frame_u_out: wp.array[wp.vec3d],
    frame_v_out: wp.array[wp.vec3d],
):
    """Compute an orthonormal frame (u, v) with u × v = x at every point."""
    i = wp.tid()
    p = x[i]
    axis = wp.vec3d(ONE, ZERO, ZERO)
    if wp.abs(p[1]) < wp.abs(p[0]):
        axis = wp.vec3d(ZERO, ONE, ZERO)
    if wp.abs(p[2]) < wp.min(wp.abs(p[0]), wp.abs(p[1])):
        axis = wp.vec3d(ZERO, ZERO, ONE)
    u = wp.normalize(wp.cross(axis, p))
    frame_u_out[i] = u
    frame_v_out[i] = wp.cross(p, u)


@wp.kernel
def move_on_sphere(
    x: wp.array[wp.vec3d],
    direction: wp.array[wp.vec3d],
    step: wp.float64,
    # Data out:
    x_out: wp.array[wp.vec3d],
):
    """Step along the tangential part of a direction and return to the sphere."""
    i = wp.tid()
    x_out[i] = wp.normalize(x[i] + step * tangential(direction[i], x[i]))
