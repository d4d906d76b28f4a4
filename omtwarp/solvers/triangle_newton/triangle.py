"""One triangle of a map from a surface to the sphere: its Jacobian, as pure Warp functions.

A triangle of the surface laid flat has its first edge (l, 0) and its second (x, h). With e1, e2 the same edges of the
image, the columns of the Jacobian are c1 = e1 / l and c2 = (e2 - (x / l) e1) / h: linear in the image, and a sum of
squares when squared, so that slivers lose no digits to cancelling cotangents. The three numbers 1/l, -x/(l h), 1/h are
the triangle's frame.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ZERO, wp
from omtwarp.geometry.spherical import first_tangent

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def first_column(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d) -> wp.vec3d:
    return frame[0] * (b - a)


@wp.func
def second_column(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    return frame[1] * (b - a) + frame[2] * (c - a)


@wp.func
def first_weights(frame: wp.vec3d) -> wp.vec3d:
    """Return the derivative of the first column by the three corners."""
    return wp.vec3d(-frame[0], frame[0], ZERO)


@wp.func
def second_weights(frame: wp.vec3d) -> wp.vec3d:
    """Return the derivative of the second column by the three corners."""
    return wp.vec3d(-frame[1] - frame[2], frame[1], frame[2])


@wp.func
def in_tangent(y: wp.vec3d, x0: wp.float64, x1: wp.float64) -> wp.vec3d:
    """Move a point by coordinates in its tangent basis, and project it to the sphere."""
    t = first_tangent(y)
    return wp.normalize(y + x0 * t + x1 * wp.cross(y, t))


@wp.func
def barrier(d: wp.float64, eps: wp.float64) -> wp.float64:
    """Return χ(D, ε) = (D + sqrt(D² + ε²)) / 2 of Garanzha et al. (2021).

    It is positive, and near D where D is well above ε.
    """
    root = wp.sqrt(d * d + eps * eps)
    if d >= ZERO:
        return HALF * (d + root)
    return HALF * eps * eps / (root - d)


@wp.func
def barrier_slope(d: wp.float64, eps: wp.float64) -> wp.float64:
    return barrier(d, eps) / wp.sqrt(d * d + eps * eps)


@wp.func
def barrier_curvature(d: wp.float64, eps: wp.float64) -> wp.float64:
    square = d * d + eps * eps
    return HALF * eps * eps / (square * wp.sqrt(square))


__all__ = [
    "barrier",
    "barrier_curvature",
    "barrier_slope",
    "first_column",
    "first_tangent",
    "first_weights",
    "in_tangent",
    "second_column",
    "second_weights",
]
