"""Warp kernels of the discrete exterior calculus on triangle meshes (paper, section 3.2 and appendices A and B).

Mathematics of one triangle is in ``wp.func``s; kernels only index. Sums at vertices gather over the corners around each
vertex, in one order, so that the same input gives the same bits.
"""

# mypy: ignore-errors
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.geometry.spherical import TINY

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def unit_normal(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Return the unit normal of a triangle; a triangle without area has none and gives zero."""
    n = wp.cross(b - a, c - a)
    return n / wp.max(wp.length(n), TINY)


@wp.func
def dual_flux_vector(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Return the sum of (dual length) x (unit edge) over the two edges leaving ``a``.

    Its product with a field is the outflow at ``a``. With l_c = (c / 2) cot(gamma) and l_b = (b / 2) cot(beta), the sum
    l_c c^ + l_b b^ of equation (23) is the edge ``bc`` turned by -90 degrees and halved. It is evaluated in that form:
    the cotangents of a sliver are huge and cancel, the turned edge is not.
    """
    return HALF * wp.cross(c - b, unit_normal(a, b, c))


@wp.func
def corner_cotangent(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """Return the cotangent of the angle at ``a``."""
    return wp.dot(b - a, c - a) / wp.max(wp.length(wp.cross(b - a, c - a)), TINY)


@wp.kernel
def rotate_in_faces(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    field: wp.array[wp.vec3d],
    # Data out:
    rotated_out: wp.array[wp.vec3d],
):
    f = wp.tid()
    n = unit_normal(vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]])
    rotated_out[f] = wp.cross(n, field[f])


@wp.kernel
def vertex_divergence(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    field: wp.array[wp.vec3d],
    # Data out:
    flux_out: wp.array[wp.float64],
):
    i = wp.tid()
    flux = wp.float64(0.0)
    for n in range(corner_offsets[i], corner_offsets[i + 1]):
        f = corners[n] // 3
        s = corners[n] - 3 * f
        b = vertices[faces[f, (s + 1) % 3]]
        c = vertices[faces[f, (s + 2) % 3]]
        flux += wp.dot(dual_flux_vector(vertices[i], b, c), field[f])
    flux_out[i] = flux


@wp.kernel
def interpolate_at_vertices(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    field: wp.array[wp.vec3d],
    # Data out:
    interpolated_out: wp.array[wp.vec3d],
):
    i = wp.tid()
    total = wp.vec3d(ZERO, ZERO, ZERO)
    weights = wp.float64(0.0)
    a = vertices[i]
    for n in range(corner_offsets[i], corner_offsets[i + 1]):
        f = corners[n] // 3
        s = corners[n] - 3 * f
        p, q = vertices[faces[f, (s + 1) % 3]] - a, vertices[faces[f, (s + 2) % 3]] - a
        weight = wp.length(wp.cross(p, q)) / wp.max(wp.length_sq(p) * wp.length_sq(q), TINY)
        total += weight * field[f]
        weights += weight
    interpolated_out[i] = total * (ONE / wp.max(weights, TINY))


@wp.func
def cotangent_at(corner: int, points: wp.array[wp.vec3d], faces: wp.array[wp.vec3i]) -> wp.float64:
    face = faces[corner // 3]
    k = corner % 3
    return corner_cotangent(points[face[k]], points[face[(k + 1) % 3]], points[face[(k + 2) % 3]])


@wp.kernel
def edge_weights_of_corners(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    corners: wp.array[wp.vec2i],
    # Data out:
    weights: wp.array[wp.float64],
):
    e = wp.tid()
    weights[e] = HALF * (cotangent_at(corners[e][0], points, faces) + cotangent_at(corners[e][1], points, faces))
