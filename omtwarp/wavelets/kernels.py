"""Warp kernels of functions on a hierarchy's nodes, and between the nodes and points anywhere on the sphere.

The values of all levels share one array, coarse nodes first.
"""

# mypy: ignore-errors
from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ZERO, wp
from omtwarp.geometry.spherical import TINY, hat_gradient, tangential, triple_product
from omtwarp.location import spherical_coordinates

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def scale_values(
    factors: wp.array[wp.float64],
    # Data in and out:
    values: wp.array[wp.float64],
):
    i = wp.tid()
    values[i] = factors[i] * values[i]


@wp.func
def find_triangle(
    p: wp.vec3d, nodes: wp.array[wp.vec3d], faces: wp.array2d[wp.int32], level_starts: wp.array[wp.int32]
):
    """Return the triangle of the finest level that holds p, as a row of ``faces``.

    It is found by descent through the hierarchy; child 3 of a triangle is the middle one, whose corners are the
    midpoints that separate it from the other three.
    """
    face = int(0)
    best = -LARGE
    for f in range(level_starts[1]):
        w = spherical_coordinates(nodes[faces[f, 0]], nodes[faces[f, 1]], nodes[faces[f, 2]], p)
        inside = wp.min(w[0], wp.min(w[1], w[2]))
        if inside > best:
            best = inside
            face = int(f)
        if best > ZERO:
            break
    for level in range(level_starts.shape[0] - 2):
        middle = level_starts[level + 1] + 4 * face + 3
        ab, bc, ca = nodes[faces[middle, 0]], nodes[faces[middle, 1]], nodes[faces[middle, 2]]
        child = int(3)
        if triple_product(ab, ca, p) > ZERO:
            child = int(0)
        elif triple_product(bc, ab, p) > ZERO:
            child = int(1)
        elif triple_product(ca, bc, p) > ZERO:
            child = int(2)
        face = 4 * face + child
    return level_starts[level_starts.shape[0] - 2] + face


@wp.func
def triangle_near(
    p: wp.vec3d, hint: int, nodes: wp.array[wp.vec3d], faces: wp.array2d[wp.int32], level_starts: wp.array[wp.int32]
):
    """Return the triangle of the finest level that a point lies in, and unnormalised barycentric coordinates there.

    The triangle ``hint`` is tried first, unless it is -1. Round-off may put a point on an edge slightly outside:
    coordinates are clamped.
    """
    g = int(hint)
    w = wp.vec3d()
    if g >= 0:
        w = spherical_coordinates(nodes[faces[g, 0]], nodes[faces[g, 1]], nodes[faces[g, 2]], p)
    if g < 0 or wp.min(w) <= ZERO:
        g = find_triangle(p, nodes, faces, level_starts)
        w = spherical_coordinates(nodes[faces[g, 0]], nodes[faces[g, 1]], nodes[faces[g, 2]], p)
        w = wp.vec3d(wp.max(w[0], ZERO), wp.max(w[1], ZERO), wp.max(w[2], ZERO))
    return g, w


@wp.kernel
def locate_points(
    points: wp.array[wp.vec3d],
    nodes: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    level_starts: wp.array[wp.int32],
    # Data in and out:
    point_faces: wp.array[wp.int32],
    # Data out:
    coordinates: wp.array[wp.vec3d],
):
    i = wp.tid()
    # Points seldom leave their triangle between two steps.
    finest = level_starts[level_starts.shape[0] - 2]
    g, w = triangle_near(wp.normalize(points[i]), finest + point_faces[i], nodes, faces, level_starts)
    point_faces[i] = g - finest
    coordinates[i] = w / (w[0] + w[1] + w[2])


@wp.kernel
def face_rows(
    keys: wp.array[wp.int32],
    count: wp.int32,
    first: wp.int32,
    # Data out:
    row_offsets: wp.array[wp.int32],
):
    """Compute the first place of each face, from a first one on, among the sorted keys, by bisection."""
    f = first + wp.tid()
    place = wp.lower_bound(keys, 0, count, f)
    if keys[place] < f:  # the last key
        place = count
    row_offsets[f] = place


@wp.kernel
def interpolate_at_points(
    faces: wp.array2d[wp.int32],
    point_faces: wp.array[wp.int32],
    coordinates: wp.array[wp.vec3d],
    values: wp.array[wp.float64],
    # Data out:
    at_points: wp.array[wp.float64],
):
    i = wp.tid()
    f, w = point_faces[i], coordinates[i]
    at_points[i] = w[0] * values[faces[f, 0]] + w[1] * values[faces[f, 1]] + w[2] * values[faces[f, 2]]


@wp.kernel
def gather_scalars_to_faces(
    row_offsets: wp.array[wp.int32],
    order: wp.array[wp.int32],
    coordinates: wp.array[wp.vec3d],
    at_points: wp.array[wp.float64],
    # Data out:
    corner_sums: wp.array[wp.vec3d],
):
    f = wp.tid()
    total = wp.vec3d(ZERO, ZERO, ZERO)
    for n in range(row_offsets[f], row_offsets[f + 1]):
        i = order[n]
        total += at_points[i] * coordinates[i]
    corner_sums[f] = total


@wp.kernel
def gather_corners_to_nodes(
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    corner_sums: wp.array[wp.vec3d],
    # Data out:
    at_nodes: wp.array[wp.float64],
):
    k = wp.tid()
    total = wp.float64(0.0)
    for n in range(corner_offsets[k], corner_offsets[k + 1]):
        f = corners[n] // 3
        total += corner_sums[f][corners[n] - 3 * f]
    at_nodes[k] = total


@wp.func
def face_weight(nodes: wp.array[wp.vec3d], faces: wp.array2d[wp.int32], f: wp.int32) -> wp.float64:
    a = nodes[faces[f, 0]]
    return wp.length(wp.cross(nodes[faces[f, 1]] - a, nodes[faces[f, 2]] - a))


@wp.func
def corner_products(nodes: wp.array[wp.vec3d], faces: wp.array2d[wp.int32], f: wp.int32, v: wp.vec3d) -> wp.vec3d:
    """Return the inner products of a vector with the gradients of the three corners' hat functions."""
    a, b, c = nodes[faces[f, 0]], nodes[faces[f, 1]], nodes[faces[f, 2]]
    n = wp.cross(b - a, c - a)
    turned = wp.cross(v, n) / wp.max(wp.dot(n, n), TINY)  # v · (n × e) is (v × n) · e
    return wp.vec3d(wp.dot(turned, c - b), wp.dot(turned, a - c), wp.dot(turned, b - a))


@wp.kernel
def level_face_gradients(
    faces: wp.array2d[wp.int32],
    nodes: wp.array[wp.vec3d],
    values: wp.array[wp.float64],
    # Data out:
    face_gradients: wp.array[wp.vec3d],
):
    """Compute the gradient in each triangle, times twice its area."""
    f = wp.tid()
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = nodes[i], nodes[j], nodes[k]
    gradient = (values[j] - values[i]) * hat_gradient(b, c, a) + (values[k] - values[i]) * hat_gradient(c, a, b)
    face_gradients[f] = face_weight(nodes, faces, f) * gradient


@wp.kernel
def mean_node_gradients(
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    nodes: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    face_gradients: wp.array[wp.vec3d],
    # Data out:
    node_gradients: wp.array[wp.vec3d],
):
    """Compute the mean of the weighted gradients around each node, in its tangent plane."""
    k = wp.tid()
    total = wp.vec3d(ZERO, ZERO, ZERO)
    for n in range(corner_offsets[k], corner_offsets[k + 1]):
        total += face_gradients[corners[n] // 3]
    node_gradients[k] = tangential(total / weights[k], nodes[k])


@wp.kernel
def gather_corner_vectors(
    row_offsets: wp.array[wp.int32],
    order: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    coordinates: wp.array[wp.vec3d],
    field: wp.array[wp.vec3d],
    # Data out:
    corner_vectors: wp.array2d[wp.vec3d],
):
    f = wp.tid()
    total = wp.mat33d()
    for n in range(row_offsets[f], row_offsets[f + 1]):
        i = order[n]
        total += wp.outer(coordinates[i], tangential(field[i], points[i]))
    for k in range(3):
        corner_vectors[f, k] = total[k]


@wp.kernel
def mean_node_vectors(
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    nodes: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    corner_vectors: wp.array2d[wp.vec3d],
    # Data out:
    node_vectors: wp.array[wp.vec3d],
):
    k = wp.tid()
    total = wp.vec3d(ZERO, ZERO, ZERO)
    for n in range(corner_offsets[k], corner_offsets[k + 1]):
        f = corners[n] // 3
        total += corner_vectors[f, corners[n] - 3 * f]
    node_vectors[k] = tangential(total, nodes[k]) / weights[k]


@wp.kernel
def spread_to_faces(
    faces: wp.array2d[wp.int32],
    nodes: wp.array[wp.vec3d],
    node_vectors: wp.array[wp.vec3d],
    # Data out:
    face_products: wp.array[wp.vec3d],
):
    f = wp.tid()
    total = node_vectors[faces[f, 0]] + node_vectors[faces[f, 1]] + node_vectors[faces[f, 2]]
    face_products[f] = corner_products(nodes, faces, f, face_weight(nodes, faces, f) * total)


@wp.kernel
def mean_values(
    sums: wp.array[wp.float64],
    masses: wp.array[wp.float64],
    smallest: wp.float64,
    # Data in and out:
    values: wp.array[wp.float64],
):
    """Compute the mean where there is mass; elsewhere ``values`` stays as it is."""
    k = wp.tid()
    if masses[k] > smallest:
        values[k] = sums[k] / masses[k]
