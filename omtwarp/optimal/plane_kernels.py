"""Kernels of maps to a flat torus: triangles in the universal cover, cost, areas around vertices, their derivatives.

The corner k of face f lies at ``points[faces[f][k]] + shift[f, k]`` in the plane.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.mesh import arrays
from omtwarp.optimal.kernels import Fit, raised_fit, weighted_fit
from omtwarp.solvers.triangle_newton.motion_kernels import keeps_volume

wp.set_module_options(KERNEL_OPTIONS)

SMALLEST = wp.constant(wp.float64(arrays.TINY))


@wp.func
def turned(v: wp.vec2d) -> wp.vec2d:
    """Return a vector turned by +90 degrees."""
    return wp.vec2d(-v[1], v[0])


@wp.func
def area_by_corner(p: wp.vec2d, q: wp.vec2d) -> wp.vec2d:
    """Return the gradient of the area of the triangle (own, p, q) by its first corner."""
    return HALF * turned(q - p)


@wp.func
def corner_place(points: wp.array[wp.vec2d], shift: wp.array2d[wp.vec2d], faces: wp.array[wp.vec3i], f: int, k: int):
    """Return where the corner k of a triangle lies in the plane."""
    return points[faces[f][k]] + shift[f, k]


@wp.func
def sides(points: wp.array[wp.vec2d], shift: wp.array2d[wp.vec2d], faces: wp.array[wp.vec3i], f: int):
    """Return the second and the third corner of a triangle as seen from the first."""
    a = corner_place(points, shift, faces, f, 0)
    b = corner_place(points, shift, faces, f, 1) - a
    c = corner_place(points, shift, faces, f, 2) - a
    return b, c


@wp.func
def jacobian(frame: wp.vec3d, b: wp.vec2d, c: wp.vec2d):
    """Return the two columns of the Jacobian of a triangle with sides b and c, and its determinant."""
    one = frame[0] * b
    two = frame[1] * b + frame[2] * c
    return one, two, one[0] * two[1] - one[1] * two[0]


@wp.kernel
def plane_triangles(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    # Data out:
    areas: wp.array[wp.float64],
    angle: wp.array[wp.float64],
    area: wp.array[wp.float64],
):
    """Compute every triangle's signed area, and its distortions of angle and of area, each less 2.

    Distortion is infinite where the triangle is turned over.
    """
    f = wp.tid()
    frame = frames[f]
    b, c = sides(points, shift, faces, f)
    one, two, d = jacobian(frame, b, c)
    areas[f] = HALF * (b[0] * c[1] - b[1] * c[0])
    if d > ZERO:
        # The distortion above 2, without cancellation where it is close to 0.
        sheer = one - wp.vec2d(two[1], -two[0])
        angle[f] = wp.dot(sheer, sheer) / d
        area[f] = (d - ONE) * (d - ONE) / d
    else:
        angle[f] = wp.float64(wp.inf)
        area[f] = wp.float64(wp.inf)


@wp.kernel
def plane_gradients(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    area_weight: wp.float64,
    # Data out:
    gradients: wp.array2d[wp.vec2d],
):
    """Compute the gradient of weighted distortion by the corners, shape [F, 3]."""
    f = wp.tid()
    frame = frames[f]
    b, c = sides(points, shift, faces, f)
    one, two, d = jacobian(frame, b, c)
    square = wp.dot(one, one) + wp.dot(two, two)
    by_ratio = -square / (d * d) + area_weight * (ONE - ONE / (d * d))
    by_one = weights[f] * (TWO / d * one - by_ratio * turned(two))
    by_two = weights[f] * (TWO / d * two + by_ratio * turned(one))
    by_b = frame[0] * by_one + frame[1] * by_two
    by_c = frame[2] * by_two
    gradients[f, 0] = -(by_b + by_c)
    gradients[f, 1] = by_b
    gradients[f, 2] = by_c


@wp.kernel
def plane_hessians(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    weights: wp.array[wp.float64],
    area_weight: wp.float64,
    # Data out:
    hessians: wp.array2d[wp.float64],
):
    """Compute positive semidefinite Hessians of the distortion, entries on and above the diagonal, shape [F, 21].

    With the Jacobian J and its determinant D the energy is |J|² / D + λ (D + 1 / D). Both terms are convex in (J, D);
    the Hessian leaves out the curvature of D, which is not.
    """
    f = wp.tid()
    frame = frames[f]
    b, c = sides(points, shift, faces, f)
    one, two, d = jacobian(frame, b, c)
    square = wp.dot(one, one) + wp.dot(two, two)
    twice = TWO * area_weight / (d * d * d)
    at = int(0)
    for p in range(6):
        k = p // 2
        x = p - 2 * k
        first, second = -frame[0], -frame[1] - frame[2]
        if k == 1:
            first, second = frame[0], frame[1]
        elif k == 2:
            first, second = ZERO, frame[2]
        slope = first * two[1] - second * one[1]  # of the determinant
        if x == 1:
            slope = second * one[0] - first * two[0]
        along = first * one[x] + second * two[x]
        for q in range(p, 6):
            m = q // 2
            y = q - 2 * m
            first_q, second_q = -frame[0], -frame[1] - frame[2]
            if m == 1:
                first_q, second_q = frame[0], frame[1]
            elif m == 2:
                first_q, second_q = ZERO, frame[2]
            slope_q = first_q * two[1] - second_q * one[1]
            if y == 1:
                slope_q = second_q * one[0] - first_q * two[0]
            along_q = first_q * one[y] + second_q * two[y]
            both = ZERO
            if x == y:
                both = first * first_q + second * second_q
            mixed = both - (along * slope_q + along_q * slope) / d + square * slope * slope_q / (d * d)
            hessians[f, at] = weights[f] * (TWO * mixed / d + twice * slope * slope_q)
            at += 1


@wp.kernel
def sum_at_vertices(
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    values: wp.array[wp.vec2d],
    # Data out:
    sums: wp.array[wp.vec2d],
):
    """Sum the values of the corners around every vertex."""
    v = wp.tid()
    total = wp.vec2d()
    for k in range(offsets[v], offsets[v + 1]):
        total += values[corners[k]]
    sums[v] = total


@wp.kernel
def plane_areas(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    # Data out:
    areas: wp.array[wp.float64],
):
    """Compute every triangle's signed area, shape [F]."""
    f = wp.tid()
    b, c = sides(points, shift, faces, f)
    areas[f] = HALF * (b[0] * c[1] - b[1] * c[0])


@wp.kernel
def plane_area_slopes(
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    # Data out:
    slopes: wp.array2d[wp.vec2d],
):
    """Compute the derivatives of every area by its corners, shape [F, 3]."""
    f = wp.tid()
    for k in range(3):
        after = corner_place(points, shift, faces, f, (k + 1) % 3)
        slopes[f, k] = area_by_corner(after, corner_place(points, shift, faces, f, (k + 2) % 3))


@wp.kernel
def plane_transport_gradient(
    start: wp.array[wp.vec2d],
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    masses: wp.array[wp.float64],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    further: wp.array[wp.vec2d],
    weight: wp.float64,
    # Data out:
    gradient: wp.array[wp.vec2d],
):
    """Compute the gradient of Σ masses_v |y_v - x_v|² + Σ P_f area_f by the vertices, shape [V].

    ``weight`` times a further gradient is added.
    """
    v = wp.tid()
    total = TWO * masses[v] * (points[v] - start[v])
    for c in range(offsets[v], offsets[v + 1]):
        f = corners[c] // 3
        k = corners[c] - 3 * f
        after = corner_place(points, shift, faces, f, (k + 1) % 3)
        total += potential[f] * area_by_corner(after, corner_place(points, shift, faces, f, (k + 2) % 3))
    gradient[v] = total + weight * further[v]


@wp.kernel
def plane_costs(
    start: wp.array[wp.vec2d],
    points: wp.array[wp.vec2d],
    # Data out:
    costs: wp.array[wp.float64],
):
    """Compute the squared distance that every vertex moves, shape [V]."""
    v = wp.tid()
    costs[v] = wp.length_sq(points[v] - start[v])


@wp.kernel
def taken_apart(
    vectors: wp.array[wp.vec2d],
    # Data out:
    numbers: wp.array2d[wp.float64],
):
    """Write the two coordinates of every vector, shape [V, 2]."""
    v = wp.tid()
    numbers[v, 0] = vectors[v][0]
    numbers[v, 1] = vectors[v][1]


@wp.kernel
def put_together(
    numbers: wp.array2d[wp.float64],
    # Data out:
    vectors: wp.array[wp.vec2d],
):
    """Make a vector of every two coordinates, shape [V]."""
    v = wp.tid()
    vectors[v] = wp.vec2d(numbers[v, 0], numbers[v, 1])


@wp.kernel
def move_in_plane(
    points: wp.array[wp.vec2d],
    direction: wp.array[wp.vec2d],
    share: wp.array[wp.float64],
    length: wp.float64,
    # Data out:
    moved: wp.array[wp.vec2d],
):
    """Move every vertex by its share of a step."""
    v = wp.tid()
    moved[v] = points[v] + length * share[v] * direction[v]


@wp.kernel
def plane_trouble(
    areas: wp.array[wp.float64],
    before: wp.array[wp.float64],
    # Data out:
    trouble: wp.array[wp.float64],
):
    """Mark with 1 where a step turns a triangle over or takes nearly all its area, shape [F]."""
    f = wp.tid()
    trouble[f] = ZERO
    if not keeps_volume(areas[f], before[f]):
        trouble[f] = ONE


@wp.kernel
def plane_cost_metric(
    start: wp.array[wp.vec2d],
    points: wp.array[wp.vec2d],
    shift: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    masses: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    least: wp.float64,
    # Data out:
    metric: wp.array2d[wp.float64],
):
    """Compute the derivative of the inverse map y -> x at every vertex, fitted to its neighbours, scaled, shape [V, 4].

    It is made symmetric and its eigenvalues raised to ``least``: see :func:`omtwarp.optimal.kernels.cost_metric`.
    """
    v = wp.tid()
    fit = Fit()
    for k in range(offsets[v], offsets[v + 1]):
        f = corners[k] // 3
        own = corners[k] - 3 * f
        other = (own + 1) % 3
        w = faces[f][other]
        apart = shift[f, other] - shift[f, own]
        d = points[w] - points[v] + apart
        e = start[w] - start[v] + apart
        weight = ONE / wp.max(wp.dot(d, d), SMALLEST)
        fit += weighted_fit(weight, d[0], d[1], e[0], e[1])
    entries = TWO * masses[v] * raised_fit(fit, least)
    metric[v, 0] = entries[0]
    metric[v, 1] = entries[1]
    metric[v, 2] = entries[1]
    metric[v, 3] = entries[2]
