"""Warp kernels of the paper's own flow (Algorithm 1): one thread per triangle or per vertex of the conformal mesh."""

# mypy: ignore-errors
from omtwarp.device.start import KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import TINY, geodesic_distance, hat_gradient

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def rotated_cost_gradient(x: wp.vec3d, g: wp.vec3d, squared: wp.int32, smallest: wp.float64) -> wp.vec3d:
    """Return J Phi_x(x, g) in the tangent plane at x.

    It is that of section 2.5 for Phi = theta, and 2 theta times that for theta squared.

    ``smallest`` bounds the denominator |x × g| from below, smoothly: Phi = theta has no gradient where g = x.
    """
    turned = wp.cross(x, g)
    sine = wp.length(turned)
    if squared != 0:
        # theta / sin(theta) is 1 at coincident points and unbounded at antipodal ones, where no direction is shortest.
        ratio = ONE
        if sine > smallest or wp.dot(x, g) < ZERO:
            ratio = geodesic_distance(x, g) / wp.max(sine, smallest)
        return -TWO * ratio * turned
    return -turned / wp.max(wp.sqrt(sine * sine + smallest * smallest), TINY)


@wp.kernel
def rotated_cost_gradients(
    dual_points: wp.array[wp.vec3d],
    dual_map: wp.array[wp.vec3d],
    squared: wp.int32,
    smallest: wp.float64,
    # Data out:
    field: wp.array[wp.vec3d],
):
    f = wp.tid()
    field[f] = rotated_cost_gradient(dual_points[f], dual_map[f], squared, smallest)


@wp.kernel
def dual_costs(
    dual_points: wp.array[wp.vec3d],
    dual_map: wp.array[wp.vec3d],
    masses: wp.array[wp.float64],
    squared: wp.int32,
    # Data out:
    cost: wp.array[wp.float64],
):
    f = wp.tid()
    distance = geodesic_distance(dual_points[f], dual_map[f])
    if squared != 0:
        distance = distance * distance
    cost[f] = masses[f] * distance


@wp.kernel
def average_to_dual(
    faces: wp.array2d[wp.int32],
    weights: wp.array[wp.vec3d],
    at_vertices: wp.array[wp.vec3d],
    # Data out:
    at_dual: wp.array[wp.vec3d],
):
    f = wp.tid()
    w = weights[f]
    mean = w[0] * at_vertices[faces[f, 0]] + w[1] * at_vertices[faces[f, 1]] + w[2] * at_vertices[faces[f, 2]]
    at_dual[f] = wp.normalize(mean)


@wp.kernel
def newly_flipped(
    faces: wp.array2d[wp.int32],
    before: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    # Data out:
    flipped: wp.array[wp.int32],
):
    f = wp.tid()
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    was = wp.dot(before[i], wp.cross(before[j], before[k]))
    now = wp.dot(after[i], wp.cross(after[j], after[k]))
    flipped[f] = wp.where(was > ZERO and now <= ZERO, 1, 0)


@wp.kernel
def mark_vertices(
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    flipped: wp.array[wp.int32],
    # Data out:
    marked: wp.array[wp.int32],
):
    i = wp.tid()
    found = int(0)
    for n in range(corner_offsets[i], corner_offsets[i + 1]):
        if flipped[corners[n] // 3] != 0:
            found = 1
    marked[i] = found


@wp.kernel
def hold_faces(
    faces: wp.array2d[wp.int32],
    marked: wp.array[wp.int32],
    # Data in and out:
    held: wp.array[wp.int32],
):
    f = wp.tid()
    if marked[faces[f, 0]] + marked[faces[f, 1]] + marked[faces[f, 2]] > 0:
        held[f] = 1


@wp.kernel
def area_distortions(
    faces: wp.array2d[wp.int32],
    image: wp.array[wp.vec3d],
    masses: wp.array[wp.float64],
    # Data out:
    weighted: wp.array[wp.float64],
    areas: wp.array[wp.float64],
):
    """Compute the image area times (r + 1/r), r the ratio of image area to surface area, and the image area."""
    f = wp.tid()
    a = image[faces[f, 0]]
    area = wp.length(wp.cross(image[faces[f, 1]] - a, image[faces[f, 2]] - a)) / TWO
    weighted[f] = area * area / masses[f] + masses[f]
    areas[f] = area


@wp.kernel
def correct_and_normalise(
    correction: wp.array[wp.vec3d],
    # Data in and out:
    field: wp.array[wp.vec3d],
):
    i = wp.tid()
    field[i] = wp.normalize(field[i] + correction[i])


@wp.kernel
def dual_velocity(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    sphere_areas: wp.array[wp.float64],
    masses: wp.array[wp.float64],
    hamiltonian: wp.array[wp.float64],
    # Data out:
    velocity: wp.array[wp.vec3d],
    rate: wp.array[wp.float64],
):
    """Compute v = -(1 / mu) x × grad H at dual vertices (line 16), and the triangle sizes it crosses per unit of time.

    At its circumcentre an inscribed triangle's unit normal is the point x itself.
    """
    f = wp.tid()
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = vertices[i], vertices[j], vertices[k]
    slope = (hamiltonian[j] - hamiltonian[i]) * hat_gradient(b, c, a)
    slope += (hamiltonian[k] - hamiltonian[i]) * hat_gradient(c, a, b)
    normal = wp.normalize(wp.cross(b - a, c - a))
    v = -(sphere_areas[f] / masses[f]) * wp.cross(normal, slope)
    if wp.dot(normal, a) <= ZERO:
        v = wp.vec3d(ZERO, ZERO, ZERO)  # a flipped triangle of the conformal image has no density to move
    velocity[f] = v
    rate[f] = wp.length(v) / wp.max(wp.sqrt(sphere_areas[f]), TINY)


@wp.kernel
def advance_map(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    velocity: wp.array[wp.vec3d],
    rate: wp.array[wp.float64],
    largest_rate: wp.float64,
    held: wp.array[wp.int32],
    step: wp.float64,
    map_at_vertices: wp.array[wp.vec3d],
    dual_map: wp.array[wp.vec3d],
    # Data out:
    advanced: wp.array[wp.vec3d],
):
    """Compute g - dt grad g · v (line 17), the Jacobian from the map at the vertices by the gradient of appendix A."""
    f = wp.tid()
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = vertices[i], vertices[j], vertices[k]
    # A bound on the few triangles far beyond the Courant condition, so that they do not hold back all the others.
    v = velocity[f] * wp.min(ONE, largest_rate / wp.max(rate[f], TINY))
    if held[f] != 0:
        v = wp.vec3d(ZERO, ZERO, ZERO)
    g = map_at_vertices[i]
    change = wp.dot(hat_gradient(b, c, a), v) * (map_at_vertices[j] - g)
    change += wp.dot(hat_gradient(c, a, b), v) * (map_at_vertices[k] - g)
    advanced[f] = wp.normalize(dual_map[f] - step * change)
