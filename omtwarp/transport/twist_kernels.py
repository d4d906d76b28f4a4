"""Kernels that measure by how much a map turns triangles against the optimal map."""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.geometry.spherical import first_tangent
from omtwarp.transport.polish_kernels import THIRD

wp.set_module_options(KERNEL_OPTIONS)

# Radians: triangles that moved by less have no direction of their own, and need none, as d / sin d is 1.
SHORTEST = wp.constant(wp.float64(1e-8))


@wp.func
def turn_of(x0: wp.vec3d, x1: wp.vec3d, x2: wp.vec3d, y0: wp.vec3d, y1: wp.vec3d, y2: wp.vec3d) -> wp.float64:
    """Return the angle that a triangle is turned by against the optimal map, in radians; 0 where x is flipped.

    In bases along and across the geodesic from x to y, diag(1, d / sin d) times the derivative of the optimal map is
    the second derivative of a potential at x, symmetric and positive. The angle is that of the rotation in the polar
    decomposition of this product, which does not depend on the size of the triangle at x.
    """
    x, y = wp.normalize(x0 + x1 + x2), wp.normalize(y0 + y1 + y2)
    normal = wp.cross(x, y)
    sine = wp.length(normal)
    across = first_tangent(x)
    stretch = ONE
    if sine > SHORTEST:
        across = normal / sine
        stretch = wp.atan2(sine, wp.dot(x, y)) / sine
    at_x, at_y = wp.cross(across, x), wp.cross(across, y)
    p, q, r, s = wp.dot(at_x, x1 - x0), wp.dot(at_x, x2 - x0), wp.dot(across, x1 - x0), wp.dot(across, x2 - x0)
    if p * s - q * r <= ZERO:
        return ZERO
    # The product times the determinant of the edges at x, which is positive.
    a, b, c, d = wp.dot(at_y, y1 - y0), wp.dot(at_y, y2 - y0), wp.dot(across, y1 - y0), wp.dot(across, y2 - y0)
    turned = stretch * (c * s - d * r) - (b * p - a * q)
    kept = a * s - b * r + stretch * (d * p - c * q)
    return wp.atan2(turned, kept)


@wp.kernel
def triangle_turns(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    turn: wp.array[wp.float64],
):
    f = wp.tid()
    i, j, k = faces[f][0], faces[f][1], faces[f][2]
    turn[f] = turn_of(start[i], start[j], start[k], points[i], points[j], points[k])


@wp.kernel
def turns_at_vertices(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    turn: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    # Data out:
    source: wp.array[wp.float64],
):
    """Compute ∫ 2 turn φ: twice the turn is the curl of the velocity that turns everything back in unit time."""
    v = wp.tid()
    total = ZERO
    for k in range(offsets[v], offsets[v + 1]):
        f = corners[k] // 3
        p0 = points[faces[f][0]]
        double_area = wp.length(wp.cross(points[faces[f][1]] - p0, points[faces[f][2]] - p0))
        total += THIRD * turn[f] * double_area
    source[v] = total
