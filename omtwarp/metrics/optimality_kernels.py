"""Kernels of the optimality report: log maps, and the c-transform over a sphere covered by triangles.

The potential ψ is quadratic on every triangle of the image mesh, in the barycentric coordinates b of the flat triangle,

    ψ(b) = Σ_k b_k ψ_k + b_0 b_1 e_0 + b_1 b_2 e_1 + b_2 b_0 e_2,

and the point of the sphere is p / |p| with p = Σ_k b_k y_k. "Lattice points" are those with multiples of 1/n for b.
Triangles are the leaves of a complete binary tree in heap order: the children of node k are 2k and 2k + 1.
"""
# mypy: ignore-errors

from omtwarp._warp import HALF, ONE, ZERO, wp

wp.set_module_options({"enable_backward": False})

LARGE = wp.constant(wp.float64(1.0e300))
RIDGE = wp.constant(wp.float64(1.0e-6))
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
    slope_out: wp.array[wp.vec3d],
    curvature_out: wp.array[wp.float64],
    level_out: wp.array[wp.float64],
    radius_out: wp.array[wp.float64],
):
    """Of every node, a ball that holds the lattice points below it and a paraboloid above the potential there.

    |z - c| <= radius and ψ(z) <= level + slope · (z - c) + curvature |z - c|² / 2 for every lattice point z: slope and
    curvature are a fit, and level is raised until the inequality holds.
    """
    node = wp.tid()
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
    # Least squares over corners and edge midpoints, in units of the node's size.
    gram = wp.identity(n=4, dtype=wp.float64) * (RIDGE * wp.float64(last - first + 1))
    right = wp.vec4d()
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
            row = wp.vec4d(ONE, wp.dot(w, u), wp.dot(w, v), HALF * wp.dot(w, w))
            gram += wp.outer(row, row)
            right += potential_at(values, edge[f], b) * row
    fit = wp.inverse(gram) * right
    slope = (fit[1] * u + fit[2] * v) / size
    curvature = fit[3] / (size * size)
    if not (wp.abs(curvature) < wp.float64(1.0e12)):
        curvature = ZERO
        slope = wp.vec3d()

    level = -LARGE
    radius = ZERO
    for f in range(first, last + 1):
        face = faces[f]
        values = wp.vec3d(nodal[face[0]], nodal[face[1]], nodal[face[2]])
        for i in range(divisions + 1):
            for j in range(divisions + 1 - i):
                b = lattice(i, j, divisions)
                w = point_at(points[face[0]], points[face[1]], points[face[2]], b) - c
                squared = wp.dot(w, w)
                radius = wp.max(radius, squared)
                level = wp.max(level, potential_at(values, edge[f], b) - wp.dot(slope, w) - HALF * curvature * squared)
    centre_out[node] = c
    slope_out[node] = slope
    curvature_out[node] = curvature
    level_out[node] = level
    radius_out[node] = wp.sqrt(radius)


@wp.func
def node_bound(
    x: wp.vec3d,
    c: wp.vec3d,
    slope: wp.vec3d,
    curvature: wp.float64,
    level: wp.float64,
    radius: wp.float64,
) -> wp.float64:
    """A number that c(x, z) - ψ(z) does not go below at any lattice point z of a node.

    θ²/2 is a convex function of x · z, so it lies above its tangent at the centre: c(x, z) >= c(x, c) - κ x · (z - c)
    with κ = θ/sin θ. With q = κ x + slope and z - c = w - |z - c|² c / 2, w tangent at c, what is left is a quadratic
    in s = |z - c|: at least -|q_t| s + (q·c - curvature) s²/2, over 0 <= s <= radius.
    """
    cosine = wp.min(wp.max(wp.dot(x, c), -ONE), ONE)
    kappa = stretch_ratio(cosine)
    if kappa > wp.float64(1.0e6):
        return -LARGE  # next to the antipode the tangent is vertical and says nothing
    q = kappa * x + slope
    normal = wp.dot(q, c)
    q_t = wp.length(q - normal * c)
    bend = normal - curvature
    s = radius
    if bend * radius > q_t:
        s = q_t / bend
    angle = angle_between(x, c)
    return HALF * angle * angle - level - q_t * s + HALF * bend * s * s


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
    # Tree:
    centres: wp.array[wp.vec3d],
    slopes: wp.array[wp.vec3d],
    curvatures: wp.array[wp.float64],
    levels: wp.array[wp.float64],
    radii: wp.array[wp.float64],
    # Out:
    value_out: wp.array[wp.float64],
    leaf_out: wp.array[wp.int32],
    weights_out: wp.array[wp.vec3d],
    visited_out: wp.array[wp.int32],
):
    """φ(x) = min of c(x, z) - ψ(z) over all lattice points z (exact), and then downhill from the best one inside its
    triangle. A branch is left out only where its bound proves that it holds nothing below the best value so far."""
    i = wp.tid()
    x = sources[i]
    best = seeds[i]
    best_leaf = int(-1)
    best_weights = wp.vec3d()
    visited = int(0)
    node = int(1)
    while node > 0:
        visited += 1
        inside = bool(False)
        if levels[node] > -LARGE:
            bound = node_bound(x, centres[node], slopes[node], curvatures[node], levels[node], radii[node])
            inside = bound < best + SLACK
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
    leaf_out[i] = best_leaf
    weights_out[i] = best_weights
    visited_out[i] = visited
