"""Kernels of the optimality report: log maps, and the c-transform over a sphere covered by triangles.

The potential ψ is quadratic on every triangle of the image mesh, in the barycentric coordinates b of the flat triangle,

    ψ(b) = Σ_k b_k ψ_k + b_0 b_1 e_0 + b_1 b_2 e_1 + b_2 b_0 e_2,

and the point of the sphere is p / |p| with p = Σ_k b_k y_k. "Lattice points" are those with multiples of 1/n for b.
Triangles are the leaves of a complete binary tree in heap order: the children of node k are 2k and 2k + 1.
"""
# mypy: ignore-errors

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)

mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
vec6d = wp.types.vector(length=6, dtype=wp.float64)

LARGE = wp.constant(wp.float64(1.0e300))
RIDGE = wp.constant(wp.float64(1.0e-10))
SLACK = wp.constant(wp.float64(1.0e-14))
POLISH_ROUNDS = wp.constant(12)


@wp.func
def angle_between(x: wp.vec3d, y: wp.vec3d) -> wp.float64:
    """Geodesic distance of two unit vectors, accurate at 0 and at π."""
    return wp.atan2(wp.length(wp.cross(x, y)), wp.dot(x, y))


@wp.func
def half_squared_distance(x: wp.vec3d, y: wp.vec3d) -> wp.float64:
    """c(x, y) = d(x, y)² / 2."""
    d = angle_between(x, y)
    return HALF * d * d


@wp.func
def stretch_ratio(cosine: wp.float64) -> wp.float64:
    """θ / sin θ for cos θ = cosine: minus the slope of θ² / 2 as a function of the cosine, which is convex."""
    sine = wp.sqrt(wp.max(ONE - cosine * cosine, ZERO))
    if sine < wp.float64(1.0e-7):
        if cosine > ZERO:
            return ONE
        return LARGE
    return wp.atan2(sine, cosine) / sine


@wp.func
def log_map(base: wp.vec3d, target: wp.vec3d) -> wp.vec3d:
    """The tangent vector at base that points along the shortest arc to target, as long as the arc."""
    tangent = target - wp.dot(base, target) * base
    sine = wp.length(tangent)
    if sine < wp.float64(1.0e-300):
        return wp.vec3d()
    return (angle_between(base, target) / sine) * tangent


@wp.func
def potential_at(nodal: wp.vec3d, edge: wp.vec3d, b: wp.vec3d) -> wp.float64:
    """ψ at barycentric coordinates b."""
    return wp.dot(b, nodal) + b[0] * b[1] * edge[0] + b[1] * b[2] * edge[1] + b[2] * b[0] * edge[2]


@wp.func
def point_at(y0: wp.vec3d, y1: wp.vec3d, y2: wp.vec3d, b: wp.vec3d) -> wp.vec3d:
    return wp.normalize(b[0] * y0 + b[1] * y1 + b[2] * y2)


@wp.func
def lattice(i: int, j: int, n: int) -> wp.vec3d:
    """Barycentric coordinates (n - i - j, i, j) / n."""
    scale = ONE / wp.float64(n)
    return wp.vec3d(wp.float64(n - i - j) * scale, wp.float64(i) * scale, wp.float64(j) * scale)


@wp.kernel
def displacement(
    base: wp.array[wp.vec3d],
    target: wp.array[wp.vec3d],
    # Out:
    log_out: wp.array[wp.vec3d],
):
    i = wp.tid()
    log_out[i] = log_map(base[i], target[i])


@wp.kernel
def face_displacement(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    log: wp.array[wp.vec3d],
    # Out:
    field_out: wp.array[wp.vec3d],
):
    """The mean of the three corners' displacements, in the plane of the flat triangle."""
    f = wp.tid()
    face = faces[f]
    normal = wp.normalize(wp.cross(points[face[1]] - points[face[0]], points[face[2]] - points[face[0]]))
    mean = (log[face[0]] + log[face[1]] + log[face[2]]) / wp.float64(3.0)
    field_out[f] = mean - wp.dot(mean, normal) * normal


@wp.kernel
def edge_bulges(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    log: wp.array[wp.vec3d],
    # Out:
    edge_out: wp.array[wp.vec3d],
):
    """The quadratic terms e of ψ on the edges (k, k+1) from the slopes -log at their ends: those that a quadratic with
    these slopes has, its two ends averaged."""
    f = wp.tid()
    face = faces[f]
    out = wp.vec3d()
    for k in range(3):
        a = face[k]
        b = face[(k + 1) % 3]
        out[k] = HALF * wp.dot(log[b] - log[a], points[b] - points[a])
    edge_out[f] = out


@wp.kernel
def admissible_differences(
    sources: wp.array[wp.vec3d],
    images: wp.array[wp.vec3d],
    edges: wp.array[wp.vec2i],
    # Out:
    low_out: wp.array[wp.float64],
    high_out: wp.array[wp.float64],
):
    """Between which two numbers ψ_b - ψ_a has to lie for the pairs a and b not to gain by swapping partners."""
    e = wp.tid()
    a = edges[e][0]
    b = edges[e][1]
    low_out[e] = half_squared_distance(sources[b], images[b]) - half_squared_distance(sources[b], images[a])
    high_out[e] = half_squared_distance(sources[a], images[b]) - half_squared_distance(sources[a], images[a])


@wp.func
def solve_definite(matrix: mat66d, right: vec6d) -> vec6d:
    """The solution of a symmetric positive definite system of six equations, by Cholesky's factorisation."""
    low = matrix
    x = right
    for j in range(6):
        for k in range(j):
            low[j, j] = low[j, j] - low[j, k] * low[j, k]
        low[j, j] = wp.sqrt(wp.max(low[j, j], wp.float64(1.0e-30)))
        for i in range(j + 1, 6):
            for k in range(j):
                low[i, j] = low[i, j] - low[i, k] * low[j, k]
            low[i, j] = low[i, j] / low[j, j]
    for i in range(6):
        for k in range(i):
            x[i] = x[i] - low[i, k] * x[k]
        x[i] = x[i] / low[i, i]
    for m in range(6):
        i = 5 - m
        for k in range(i + 1, 6):
            x[i] = x[i] - low[k, i] * x[k]
        x[i] = x[i] / low[i, i]
    return x


@wp.func
def lowest_on_interval(slope: wp.float64, bend: wp.float64, radius: wp.float64) -> wp.float64:
    """The least value of bend s²/2 - slope s over 0 <= s <= radius, for slope >= 0."""
    s = radius
    if bend * radius > slope:
        s = slope / bend
    return HALF * bend * s * s - slope * s


@wp.kernel
def build_nodes(
    # Mesh, faces in the order of the leaves:
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    nodal: wp.array[wp.float64],
    edge: wp.array[wp.vec3d],
    leaf_count: int,
    divisions: int,
    # Out:
    centre_out: wp.array[wp.vec3d],
    axis_out: wp.array[wp.vec3d],
    slope_out: wp.array[wp.vec2d],
    bends_out: wp.array[wp.vec2d],
    level_out: wp.array[wp.float64],
    radius_out: wp.array[wp.float64],
):
    """Of every node, a ball that holds the lattice points below it and a paraboloid above the potential there.

    With w the part of z - c tangent at the centre c, in the frame (axis, c × axis), every lattice point z below the
    node has |z - c| <= radius and ψ(z) <= level + slope · w + (bends_0 w_0² + bends_1 w_1²) / 2. Frame, slope and bends
    come from a fit; level is raised until the inequality holds.
    """
    node, _ = wp.tid()
    if node == 0:
        level_out[node] = -LARGE
        return
    # The leaves below a node: shift it down to the last level on both sides.
    first = int(node)
    last = int(node)
    while first < leaf_count:
        first = 2 * first
        last = 2 * last + 1
    first = first - leaf_count
    last = wp.min(last - leaf_count, faces.shape[0] - 1)
    if first > last:
        level_out[node] = -LARGE
        return

    total = wp.vec3d()
    for f in range(first, last + 1):
        face = faces[f]
        total += wp.normalize(points[face[0]] + points[face[1]] + points[face[2]])
    c = wp.normalize(total)
    if wp.length(total) < wp.float64(1.0e-9):
        c = points[faces[first][0]]
    u = wp.vec3d(ONE, ZERO, ZERO)
    if wp.abs(c[0]) > wp.float64(0.6):
        u = wp.vec3d(ZERO, ONE, ZERO)
    u = wp.normalize(wp.cross(u, c))
    v = wp.cross(c, u)

    size = wp.float64(1.0e-30)
    for f in range(first, last + 1):
        face = faces[f]
        for k in range(3):
            size = wp.max(size, wp.length(points[face[k]] - c))
    # Least squares over corners and edge midpoints, in units of the node's size. On one triangle it interpolates.
    gram = mat66d()
    right = vec6d()
    for k in range(6):
        gram[k, k] = RIDGE * wp.float64(last - first + 1)
    for f in range(first, last + 1):
        face = faces[f]
        values = wp.vec3d(nodal[face[0]], nodal[face[1]], nodal[face[2]])
        for s in range(6):
            b = wp.vec3d()
            if s < 3:
                b[s] = ONE
            else:
                b[s - 3] = HALF
                b[(s - 2) % 3] = HALF
            w = (point_at(points[face[0]], points[face[1]], points[face[2]], b) - c) / size
            a0 = wp.dot(w, u)
            a1 = wp.dot(w, v)
            row = vec6d(ONE, a0, a1, HALF * a0 * a0, a0 * a1, HALF * a1 * a1)
            value = potential_at(values, edge[f], b)
            for k in range(6):
                for l in range(6):
                    gram[k, l] = gram[k, l] + row[k] * row[l]
                right[k] = right[k] + value * row[k]
    fit = solve_definite(gram, right)
    # Principal axes of the fitted second derivative.
    turn = HALF * wp.atan2(TWO * fit[4], fit[3] - fit[5])
    cosine = wp.cos(turn)
    sine = wp.sin(turn)
    axis = cosine * u + sine * v
    across = wp.cross(c, axis)
    slope = wp.vec2d(cosine * fit[1] + sine * fit[2], cosine * fit[2] - sine * fit[1]) / size
    mixed = TWO * cosine * sine * fit[4]
    bends = wp.vec2d(
        cosine * cosine * fit[3] + mixed + sine * sine * fit[5],
        sine * sine * fit[3] - mixed + cosine * cosine * fit[5],
    ) / (size * size)
    if not (wp.abs(bends[0]) + wp.abs(bends[1]) < wp.float64(1.0e12)):
        bends = wp.vec2d()
        slope = wp.vec2d()

    level = -LARGE
    radius = ZERO
    for f in range(first, last + 1):
        face = faces[f]
        values = wp.vec3d(nodal[face[0]], nodal[face[1]], nodal[face[2]])
        for i in range(divisions + 1):
            for j in range(divisions + 1 - i):
                b = lattice(i, j, divisions)
                w = point_at(points[face[0]], points[face[1]], points[face[2]], b) - c
                a0 = wp.dot(w, axis)
                a1 = wp.dot(w, across)
                radius = wp.max(radius, wp.dot(w, w))
                model = slope[0] * a0 + slope[1] * a1 + HALF * (bends[0] * a0 * a0 + bends[1] * a1 * a1)
                level = wp.max(level, potential_at(values, edge[f], b) - model)
    centre_out[node] = c
    axis_out[node] = axis
    slope_out[node] = slope
    bends_out[node] = bends
    level_out[node] = level
    radius_out[node] = wp.sqrt(radius)


@wp.func
def node_bound(
    x: wp.vec3d,
    c: wp.vec3d,
    axis: wp.vec3d,
    slope: wp.vec2d,
    bends: wp.vec2d,
    level: wp.float64,
    radius: wp.float64,
) -> wp.float64:
    """A number that c(x, z) - ψ(z) does not go below at any lattice point z of a node.

    θ²/2 is a convex function of x · z, so it lies above its tangent at the centre: c(x, z) >= c(x, c) - κ x · (z - c)
    with κ = θ/sin θ. Since z - c = w - |z - c|² c / 2 with w tangent at c, and |z - c|² >= |w|², what is left is a
    quadratic in w, with w_0 and w_1 apart from each other: each is at least its least value over |w_k| <= radius.
    """
    cosine = wp.min(wp.max(wp.dot(x, c), -ONE), ONE)
    kappa = stretch_ratio(cosine)
    if kappa > wp.float64(1.0e6) or radius > ONE:
        return -LARGE  # next to the antipode the tangent is vertical and says nothing
    normal = kappa * cosine
    if normal < ZERO:
        normal = normal / (ONE - wp.float64(0.25) * radius * radius)  # |z - c|² = |w|² / (1 - |z - c|² / 4)
    first = wp.abs(kappa * wp.dot(x, axis) + slope[0])
    second = wp.abs(kappa * wp.dot(x, wp.cross(c, axis)) + slope[1])
    angle = angle_between(x, c)
    least = lowest_on_interval(first, normal - bends[0], radius) + lowest_on_interval(second, normal - bends[1], radius)
    return HALF * angle * angle - level + least


@wp.kernel
def c_transform(
    # Queries:
    sources: wp.array[wp.vec3d],
    seeds: wp.array[wp.float64],
    # Mesh, faces in the order of the leaves:
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    nodal: wp.array[wp.float64],
    edge: wp.array[wp.vec3d],
    leaf_count: int,
    divisions: int,
    tolerance: wp.float64,
    # Tree:
    centres: wp.array[wp.vec3d],
    axes: wp.array[wp.vec3d],
    slopes: wp.array[wp.vec2d],
    bends: wp.array[wp.vec2d],
    levels: wp.array[wp.float64],
    radii: wp.array[wp.float64],
    # Out:
    value_out: wp.array[wp.float64],
    proven_out: wp.array[wp.float64],
    leaf_out: wp.array[wp.int32],
    weights_out: wp.array[wp.vec3d],
    visited_out: wp.array[wp.int32],
):
    """φ(x) = min of c(x, z) - ψ(z) over all lattice points z, and then downhill from the best one inside its triangle.

    A branch is left out where its bound proves that it holds nothing lower than the best value so far minus the
    tolerance. ``value`` is the least value found, ``proven`` the lower of it and all bounds that were relied upon:
    no lattice point has a value below ``proven``, which is at most the tolerance below the true minimum.
    """
    i, _ = wp.tid()
    x = sources[i]
    best = seeds[i]
    best_leaf = int(-1)
    best_weights = wp.vec3d()
    relied = LARGE
    visited = int(0)
    node = int(1)
    while node > 0:
        visited += 1
        inside = bool(False)
        if levels[node] > -LARGE:
            bound = node_bound(x, centres[node], axes[node], slopes[node], bends[node], levels[node], radii[node])
            inside = bound < best - tolerance
            if not inside:
                relied = wp.min(relied, bound - SLACK)
        if inside and node < leaf_count:
            node = 2 * node
        else:
            if inside:
                f = node - leaf_count
                face = faces[f]
                values = wp.vec3d(nodal[face[0]], nodal[face[1]], nodal[face[2]])
                for k in range(divisions + 1):
                    for l in range(divisions + 1 - k):
                        b = lattice(k, l, divisions)
                        z = point_at(points[face[0]], points[face[1]], points[face[2]], b)
                        value = half_squared_distance(x, z) - potential_at(values, edge[f], b)
                        if value < best:
                            best = value
                            best_leaf = f
                            best_weights = b
            # To the next subtree: up while this is a right child, then over to the right.
            while node % 2 == 1 and node > 1:
                node = node // 2
            if node == 1:
                node = 0
            else:
                node = node + 1
    if best_leaf >= 0:
        face = faces[best_leaf]
        values = wp.vec3d(nodal[face[0]], nodal[face[1]], nodal[face[2]])
        step = HALF / wp.float64(divisions)
        for _ in range(POLISH_ROUNDS):
            centre = best_weights
            for k in range(6):
                move = wp.vec3d()
                grow = k // 2
                shrink = (grow + 1 + k % 2) % 3
                move[grow] = step
                move[shrink] = -step
                b = centre + move
                if wp.min(b) >= ZERO:
                    z = point_at(points[face[0]], points[face[1]], points[face[2]], b)
                    value = half_squared_distance(x, z) - potential_at(values, edge[best_leaf], b)
                    if value < best:
                        best = value
                        best_weights = b
            if wp.length(best_weights - centre) == ZERO:
                step = step * HALF
    value_out[i] = best
    proven_out[i] = wp.min(best, relied)
    leaf_out[i] = best_leaf
    weights_out[i] = best_weights
    visited_out[i] = visited
