# mypy: ignore-errors
"""Functions of direction that the kernels of several patterns call."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def longitude(d: wp.vec3d):
    return wp.atan2(d[1], d[0])


@wp.func
def latitude(d: wp.vec3d):
    return wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))


@wp.func
def cell_of(value: wp.float64, low: wp.float64, high: wp.float64, count: int):
    """Return which of ``count`` equal cells between two numbers a value falls in, the last one closed."""
    k = int(wp.floor((value - low) / (high - low) * wp.float64(count)))
    return wp.clamp(k, 0, count - 1)


@wp.func
def near_multiple(value: wp.float64, step: wp.float64):
    """Return the distance to the nearest multiple of a step."""
    return wp.abs(value - step * wp.floor(value / step + HALF))


@wp.func
def cube_face(d: wp.vec3d):
    """Return the face of the cube that a direction passes through: +x, +y, -x, -y, +z, -z."""
    ax = wp.abs(d[0])
    ay = wp.abs(d[1])
    az = wp.abs(d[2])
    face = int(0)
    if ax >= ay and ax >= az:
        if d[0] < ZERO:
            face = int(2)
    elif ay >= az:
        face = int(1)
        if d[1] < ZERO:
            face = int(3)
    else:
        face = int(4)
        if d[2] < ZERO:
            face = int(5)
    return face
