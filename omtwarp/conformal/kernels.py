"""Kernels of the conformal map: inverse stereographic projection, Möbius transformations and moments for centring."""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, TWO, wp
from omtwarp.device.sums import GROUP, LANES, first_row

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def inverse_stereographic(x: wp.float64, y: wp.float64):
    """Map x + iy to (2x, 2y, 2r^2) / (1 + r^2) - (0, 0, 1) (section 4.1), without overflow at large r."""
    r2 = x * x + y * y
    if r2 <= ONE:
        s = ONE / (ONE + r2)
        return wp.vec3d(TWO * x * s, TWO * y * s, (r2 - ONE) * s)
    q = ONE / r2
    s = ONE / (ONE + q)
    return wp.vec3d(TWO * x * q * s, TWO * y * q * s, (ONE - q) * s)


@wp.func
def ball_inversion(p: wp.vec3d, c: wp.vec3d):
    """Apply the Möbius transformation of the unit ball of Baden, Crane and Kazhdan (2018) to a unit vector."""
    shifted = p + c
    return wp.normalize((ONE - wp.dot(c, c)) / wp.dot(shifted, shifted) * shifted + c)


@wp.kernel
def project_to_sphere(
    x: wp.array[wp.float64],
    y: wp.array[wp.float64],
    shift: wp.vec2d,
    scale: wp.float64,
    # Data out:
    sphere: wp.array[wp.vec3d],
):
    v = wp.tid()
    z = scale * (wp.vec2d(x[v], y[v]) - shift)
    sphere[v] = inverse_stereographic(z[0], z[1])


@wp.kernel
def apply_ball_inversion(
    sphere: wp.array[wp.vec3d],
    centre: wp.vec3d,
    # Data out:
    moved: wp.array[wp.vec3d],
):
    v = wp.tid()
    moved[v] = ball_inversion(sphere[v], centre)


@wp.kernel
def weighted_moments(
    points: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    # Data out:
    sums: wp.array2d[wp.float64],
):
    """Compute weighted sums over GROUP points p each: Σ w p in three columns, Σ w p p' row by row in the others."""
    thread, column = wp.tid()
    row = column // 3 - 1
    total = wp.float64(0.0)
    i = first_row(thread)
    for _ in range(GROUP):
        if i < points.shape[0]:
            part = weights[i] * points[i][column % 3]
            if row >= 0:
                part = part * points[i][row]
            total += part
        i += LANES
    sums[thread, column] = total
