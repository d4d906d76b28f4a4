"""Kernels of a barrier that keeps the strain of every triangle below a limit.

The strain is w = angle distortion + area distortion - 4 = (R + 1/R - 2) + (D + 1/D - 2), with D the ratio of areas and
R that of the two stretches. The barrier is w² / (limit - w): small where w is small, and infinite from the limit on.
"""

from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.refine.kernels import distortion_gradient, distortion_hessian, distortion_terms
from omtwarp.solvers.triangle_newton.newton_kernels import packed
from omtwarp.solvers.triangle_newton.triangle import first_tangent

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def strain(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    angle, d, volume, _needle = distortion_terms(frame, a, b, c)
    if volume <= ZERO:
        return LARGE
    return angle + (d - ONE) * (d - ONE) / d


@wp.func
def barrier_slope(w: wp.float64, limit: wp.float64) -> wp.float64:
    gap = limit - w
    return w * (TWO * limit - w) / (gap * gap)


@wp.func
def barrier_curvature(w: wp.float64, limit: wp.float64) -> wp.float64:
    gap = limit - w
    return TWO * limit * limit / (gap * gap * gap)


@wp.kernel
def strain_terms(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    # Data out:
    strains: wp.array[wp.float64],
):
    """Compute the strain w of every triangle, shape [F]; flipped ones have a very large one."""
    t = wp.tid()
    face = faces[t]
    strains[t] = strain(frames[t], sphere[face[0]], sphere[face[1]], sphere[face[2]])


@wp.kernel
def barrier_gradient(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    limit: wp.float64,
    # Data out:
    corner_gradient: wp.array[wp.vec3d],
):
    """Compute the gradient of A w² / (limit - w) by the corners, shape [3F], where all strains are below the limit."""
    t = wp.tid()
    face = faces[t]
    a = sphere[face[0]]
    b = sphere[face[1]]
    c = sphere[face[2]]
    slope = barrier_slope(strain(frames[t], a, b, c), limit)
    rows = distortion_gradient(frames[t], slope * areas[t], a, b, c, ONE, ONE, ZERO)
    for k in range(3):
        corner_gradient[3 * t + k] = rows[k]


@wp.kernel
def barrier_hessian(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    limit: wp.float64,
    divisor: wp.float64,
    # Data out:
    hessian: wp.array2d[wp.float64],
):
    """Compute the Hessian of A w² / (limit - w) in tangent bases, divided, positive semidefinite, shape [F, 21].

    It is the slope of the barrier times that of w, without its negative part, and its curvature times the square of the
    gradient of w.
    """
    t, _compiled_once = wp.tid()
    face = faces[t]
    frame = frames[t]
    points = wp.matrix_from_rows(sphere[face[0]], sphere[face[1]], sphere[face[2]])
    w = strain(frame, points[0], points[1], points[2])
    share = areas[t] / divisor
    slope = share * barrier_slope(w, limit)
    distortion_hessian(t, frame, slope, points[0], points[1], points[2], ONE, ONE, ZERO, hessian)
    rows = distortion_gradient(frame, ONE, points[0], points[1], points[2], ONE, ONE, ZERO)
    along = wp.vector(dtype=wp.float64, length=6)
    for k in range(3):
        tangent = first_tangent(points[k])
        along[2 * k] = wp.dot(tangent, rows[k])
        along[2 * k + 1] = wp.dot(wp.cross(points[k], tangent), rows[k])
    bend = share * barrier_curvature(w, limit)
    for i in range(6):
        for j in range(i, 6):
            hessian[t, packed(i, j)] = hessian[t, packed(i, j)] + bend * along[i] * along[j]
