"""Geometry of the sphere and of triangles for kernels: distances, directions, products, each in one place."""

# mypy: ignore-errors
from omtwarp.device.start import KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.mesh import arrays

wp.set_module_options(KERNEL_OPTIONS)

TINY = wp.constant(wp.float64(arrays.TINY))


@wp.func
def geodesic_distance(x: wp.vec3d, y: wp.vec3d) -> wp.float64:
    """Return the angle between unit vectors, accurate at 0 and at π, where arccos(x · y) is not."""
    return wp.atan2(wp.length(wp.cross(x, y)), wp.dot(x, y))


@wp.func
def logarithm(y: wp.vec3d, x: wp.vec3d):
    """Return log_y(x), the tangent vector at y that points to x and is as long as their distance; and that distance."""
    cosine = wp.dot(x, y)
    across = wp.length(wp.cross(y, x))
    distance = wp.atan2(across, cosine)
    return distance / wp.max(across, TINY) * (x - cosine * y), distance


@wp.func
def tangential(v: wp.vec3d, x: wp.vec3d) -> wp.vec3d:
    """Return the part of v that is tangent to the unit sphere at x."""
    return v - wp.dot(v, x) * x


@wp.func
def first_tangent(y: wp.vec3d) -> wp.vec3d:
    """Return a unit vector orthogonal to y, from the axis least aligned with it."""
    axis = wp.vec3d(ONE, ZERO, ZERO)
    if wp.abs(y[1]) < wp.abs(y[0]) and wp.abs(y[1]) <= wp.abs(y[2]):
        axis = wp.vec3d(ZERO, ONE, ZERO)
    elif wp.abs(y[2]) < wp.abs(y[0]):
        axis = wp.vec3d(ZERO, ZERO, ONE)
    return wp.normalize(wp.cross(y, axis))


@wp.func
def hat_gradient(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Return the gradient of the function that is 1 at ``a`` and 0 at ``b`` and ``c``, linear on the triangle.

    It is normal to ``bc`` and of length 1 / height.
    """
    n = wp.cross(b - a, c - a)
    return wp.cross(n, c - b) / wp.max(wp.dot(n, n), TINY)


@wp.func
def triple_product(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """Return a · (b × c); accurate where no two of the vectors are close to each other."""
    return wp.dot(a, wp.cross(b, c))


@wp.func
def oriented_volume(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """Return det[a, b, c], positive for an outward triangle on the sphere, to full relative precision if it is small.

    It is six times the volume of the triangle and the centre; differences come first.
    """
    return wp.dot(a, wp.cross(b - a, c - a))


@wp.func
def solid_angle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the signed solid angle of a spherical triangle (van Oosterom and Strackee 1983), however small it is."""
    return TWO * wp.atan2(oriented_volume(a, b, c), ONE + wp.dot(a, b) + wp.dot(b, c) + wp.dot(c, a))


@wp.func
def corners_of(points: wp.array[wp.vec3d], face: wp.vec3i):
    """Return where the three corners of a triangle are."""
    return points[face[0]], points[face[1]], points[face[2]]
