"""Kernels that add up the angle by which the neighbours of every vertex turn around it."""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)

SCALE = wp.constant(wp.float64(2.0**40))  # steps of a radian: sums of 10^6 angles fit int64, and a step is 1e-12


@wp.kernel
def add_turning_angles(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    signs: wp.array[wp.int8],
    direction_error: wp.float64,
    angle_error: wp.float64,
    # Data out:
    angles: wp.array[wp.int64],
    errors: wp.array[wp.int64],
):
    """Add every triangle's signed angle to each of its corners, with a bound on its rounding error.

    The direction from p towards a is that of the normal p x (a - p) of the great circle through both. Angles are added
    as whole multiples of 1 / SCALE radians, whose sum does not depend on the order.
    """
    f, _compiled_once = wp.tid()
    face = faces[f]
    for k in range(3):
        p = points[face[k]]
        towards_a = points[face[(k + 1) % 3]] - p
        towards_b = points[face[(k + 2) % 3]] - p
        a = wp.cross(p, towards_a)
        b = wp.cross(p, towards_b)
        length_a, length_b = wp.length(a), wp.length(b)
        error = direction_error * wp.length(p) * (wp.length(towards_a) / length_a + wp.length(towards_b) / length_b)
        angle = wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))
        if signs[f] < wp.int8(0):
            angle = -angle
        elif signs[f] == wp.int8(0):
            angle = ZERO
        error += angle_error + ONE / SCALE
        if not error < ONE:  # also where a length is 0
            error = ONE
            angle = ZERO
        wp.atomic_add(angles, face[k], wp.int64(wp.rint(SCALE * angle)))
        wp.atomic_add(errors, face[k], wp.int64(wp.ceil(SCALE * error)))
