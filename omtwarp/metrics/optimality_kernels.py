"""Kernels of the optimality report: the c-transform over a sphere covered by triangles.

The potential ψ is quadratic on every triangle of the image mesh, in the barycentric coordinates b of the flat triangle,

    ψ(b) = Σ_k b_k ψ_k + b_0 b_1 e_0 + b_1 b_2 e_1 + b_2 b_0 e_2,

and the point of the sphere is p / |p| with p = Σ_k b_k y_k. The samples of a triangle are its corners and the middles
of its edges. Triangles, or parts of those with long edges, are the leaves of a tree (:mod:`.tree_kernels`).
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import corners_of, geodesic_distance
from omtwarp.metrics.tree_kernels import SEGMENT, leaves_below, lowest_on_triangle, next_node, potential_at

wp.set_module_options(KERNEL_OPTIONS)

mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
vec6d = wp.types.vector(length=6, dtype=wp.float64)
# Of a node: level, the two slopes and the second derivatives (0,0), (0,1) and (1,1) of its paraboloid, less the
# least and the largest coordinate along both axes, and the largest distance from its centre.
vec11d = wp.types.vector(length=11, dtype=wp.float64)

SAMPLES = wp.constant(6)  # of the potential in a triangle: as many as a quadratic function has coefficients


@wp.struct
class Tree:
    """A potential on the triangles of a mesh, its samples on P leaves, and a paraboloid above it on each of N nodes."""

    points: wp.array[wp.vec3d]  # of the mesh
    faces: wp.array[wp.vec3i]
    nodal: wp.array[wp.float64]  # ψ_k at the points
    edge: wp.array[wp.vec3d]  # e_k of every face
    leaf_count: wp.int32  # a power of two, of which the first P are taken; N is twice this
    triangles: wp.array[wp.int32]  # that each leaf is a part of, [P]
    corners: wp.array[wp.mat33d]  # its own in barycentric coordinates there, as rows, [P]
    places: wp.array[wp.vec3d]  # of the samples of the leaves, one leaf after another, [SAMPLES P]
    values: wp.array[wp.float64]  # ψ there
    centres: wp.array[wp.vec3d]  # of the nodes, [N]
    axes: wp.array[wp.vec3d]
    models: wp.array[vec11d]


@wp.func
def half_squared_distance(x: wp.vec3d, y: wp.vec3d) -> wp.float64:
    """Return the cost c(x, y) = d(x, y)² / 2."""
    d = geodesic_distance(x, y)
    return HALF * d * d


@wp.func
def sample_at(f: int, b: wp.vec3d, tree: Tree):
    """Return the point of the sphere at barycentric coordinates b of a triangle of the mesh, and ψ there."""
    face = tree.faces[f]
    y0, y1, y2 = corners_of(tree.points, face)
    nodal = wp.vec3d(tree.nodal[face[0]], tree.nodal[face[1]], tree.nodal[face[2]])
    return wp.normalize(b[0] * y0 + b[1] * y1 + b[2] * y2), potential_at(nodal, tree.edge[f], b)


@wp.func
def sample_weights(s: int) -> wp.vec3d:
    """Return barycentric coordinates of sample s of a triangle: its corners, then the middles of the edges (k, k+1)."""
    b = wp.vec3d()
    b[s % 3] = HALF
    other = (s + s // 3) % 3  # the corner itself, or the next one
    b[other] = b[other] + HALF
    return b


@wp.func
def solve_definite(matrix: mat66d, right: vec6d) -> vec6d:
    """Return the solution of a symmetric positive definite system of six equations, by Cholesky's factorisation."""
    low = matrix
    x = right
    for j in range(6):
        for k in range(j):
            low[j, j] = low[j, j] - low[j, k] * low[j, k]
        # Squared, of a least-squares system in units of its node: the ridge keeps pivots above.
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
def lowest_on_interval(slope: wp.float64, bend: wp.float64, low: wp.float64, high: wp.float64) -> wp.float64:
    """Return the least value of slope s + bend s²/2 over low <= s <= high."""
    at_low = low * (slope + HALF * bend * low)
    at_high = high * (slope + HALF * bend * high)
    least = wp.min(at_low, at_high)
    if bend > ZERO and slope + bend * low < ZERO and slope + bend * high > ZERO:
        least = -HALF * slope * slope / bend
    return least


@wp.kernel
def sample_triangles(
    # Data in and out:
    tree: Tree,
):
    """Place on the sphere, and potential there, of the six samples of every leaf."""
    leaf = wp.tid()
    for s in range(SAMPLES):
        place, value = sample_at(tree.triangles[leaf], sample_weights(s) @ tree.corners[leaf], tree)
        tree.places[SAMPLES * leaf + s] = place
        tree.values[SAMPLES * leaf + s] = value


@wp.kernel
def fit_nodes(
    chosen: wp.array[wp.int32],
    # Data in and out:
    tree: Tree,
):
    """Choose the centre c and the frame (axis, c × axis) of a node, and fit a paraboloid to the potential there.

    With w the part of z - c tangent at c, every sample z below the node will have w in the node's rectangle and
    ψ(z) <= level + slope · w + w · B w / 2. Slope and B are fitted to some of the triangles. The level is -LARGE, as it
    stays for nodes without triangles.
    """
    place, _compiled_once = wp.tid()
    node = chosen[place]
    model = vec11d()
    model[0] = -LARGE
    tree.models[node] = model
    if node == 0:
        return
    first, last = leaves_below(node, tree.leaf_count, tree.triangles.shape[0])
    if first > last:
        return

    count = last - first + 1
    # Triangles of a node that its paraboloid is fitted to; the level that makes it a bound uses all of them.
    fitted = wp.min(count, 4)
    total = wp.vec3d()
    for k in range(fitted):
        f = first + ((2 * k + 1) * count) // (2 * fitted)
        total += tree.places[SAMPLES * f] + tree.places[SAMPLES * f + 1] + tree.places[SAMPLES * f + 2]
    c = wp.normalize(total)
    # Length of the sum of a node's directions: less where they cancel, as over a whole great circle.
    if wp.length(total) < wp.float64(1.0e-9):
        c = tree.places[SAMPLES * first]
    u = wp.vec3d(ONE, ZERO, ZERO)
    # Of a unit vector's x: another axis helps to make a frame where it is larger. Anything from 0.58 to 1 leaves one to
    # take.
    if wp.abs(c[0]) > wp.float64(0.6):
        u = wp.vec3d(ZERO, ONE, ZERO)
    u = wp.normalize(wp.cross(u, c))
    v = wp.cross(c, u)

    # The first axis is the direction in which the node is longest.
    # Squared radius: a node of one point is no smaller, so that it can be divided by.
    size = wp.float64(1.0e-30)
    stretch = wp.vec2d()
    for k in range(fitted):
        f = first + ((2 * k + 1) * count) // (2 * fitted)
        for s in range(3):
            w = tree.places[SAMPLES * f + s] - c
            a0 = wp.dot(w, u)
            a1 = wp.dot(w, v)
            stretch += wp.vec2d(a0 * a0 - a1 * a1, TWO * a0 * a1)
            size = wp.max(size, wp.length_sq(w))
    size = wp.sqrt(size)
    angle = HALF * wp.atan2(stretch[1], stretch[0])
    u = wp.cos(angle) * u + wp.sin(angle) * v
    v = wp.cross(c, u)
    # Least squares over samples, in units of the node's size. On one triangle it interpolates.
    gram = mat66d()
    right = vec6d()
    for k in range(6):
        # Relative, added to the diagonal of the normal equations of a fit, which few or collinear points leave
        # singular.
        gram[k, k] = wp.float64(1.0e-10) * wp.float64(fitted)
    for k in range(fitted):
        f = first + ((2 * k + 1) * count) // (2 * fitted)
        for s in range(SAMPLES):
            w = (tree.places[SAMPLES * f + s] - c) / size
            a0 = wp.dot(w, u)
            a1 = wp.dot(w, v)
            row_of = vec6d(ONE, a0, a1, HALF * a0 * a0, a0 * a1, HALF * a1 * a1)
            value = tree.values[SAMPLES * f + s]
            for i in range(6):
                for j in range(i + 1):
                    gram[i, j] = gram[i, j] + row_of[i] * row_of[j]
                right[i] = right[i] + value * row_of[i]
    fit = solve_definite(gram, right)
    for k in range(3):
        fit[3 + k] = fit[3 + k] / (size * size)
    for k in range(1, 3):
        fit[k] = fit[k] / size
    # Second derivatives of a fit: more is a fit through rounding, and a constant bounds better.
    if not (wp.abs(fit[3]) + wp.abs(fit[4]) + wp.abs(fit[5]) < wp.float64(1.0e12)):
        fit = vec6d()
    tree.centres[node] = c
    tree.axes[node] = u
    for k in range(1, 6):
        model[k] = fit[k]
    tree.models[node] = model


@wp.kernel
def measure_segments(
    offsets: wp.array[wp.int32],
    segments: wp.array[wp.vec2i],
    tree: Tree,
    # Data out:
    extremes_out: wp.array[vec6d],
):
    """Find what the samples of some of a node's triangles need: level, rectangle and squared radius.

    A segment is a node and a number: it stands for as many as ``SEGMENT`` of the node's triangles, so that no thread
    goes through those of half a mesh. The level makes the paraboloid an upper bound at all samples, and between them to
    third order, as far as the residual of ψ is a quadratic in barycentric coordinates.
    """
    place, _compiled_once = wp.tid()
    node = segments[place][0]
    number = segments[place][1]
    most = vec6d(-LARGE, ZERO, ZERO, ZERO, ZERO, ZERO)
    if node > 0:
        first, last = leaves_below(node, tree.leaf_count, tree.triangles.shape[0])
        first += SEGMENT * number
        last = wp.min(last, first + SEGMENT - 1)
        c = tree.centres[node]
        u = tree.axes[node]
        v = wp.cross(c, u)
        fit = tree.models[node]
        for f in range(first, last + 1):
            above = wp.vec3d()
            for s in range(SAMPLES):
                k = SAMPLES * f + s
                w = tree.places[k] - c
                a0 = wp.dot(w, u)
                a1 = wp.dot(w, v)
                bent = HALF * (fit[3] * a0 * a0 + fit[5] * a1 * a1) + fit[4] * a0 * a1
                over = tree.values[k] - (fit[1] * a0 + fit[2] * a1 + bent)
                most = wp.max(most, vec6d(over, -a0, a0, -a1, a1, wp.length_sq(w)))
                if s < 3:
                    above[s] = over
                else:
                    # No quadratic on the triangle exceeds its coefficients in Bernstein's form.
                    most[0] = wp.max(most[0], TWO * over - HALF * (above[s - 3] + above[(s - 2) % 3]))
    extremes_out[offsets[node] + number] = most


@wp.kernel
def bound_nodes(
    offsets: wp.array[wp.int32],
    extremes: wp.array[vec6d],
    # Data in and out:
    tree: Tree,
):
    """Set level, rectangle and radius of a node to the largest that its segments need."""
    node, _compiled_once = wp.tid()
    most = extremes[offsets[node]]
    for k in range(offsets[node] + 1, offsets[node + 1]):
        most = wp.max(most, extremes[k])
    bounded = tree.models[node]
    bounded[0] = most[0]
    for k in range(4):
        bounded[6 + k] = most[1 + k]
    bounded[10] = wp.sqrt(most[5])
    tree.models[node] = bounded


@wp.func
def node_bound(x: wp.vec3d, c: wp.vec3d, axis: wp.vec3d, model: vec11d, enough: wp.float64) -> wp.float64:
    """Return a lower bound on c(x, z) - ψ(z) over all samples z of a node.

    With v = 1 - x · z, θ²/2 = Σ (2v)^n / (n² C(2n, n)): it and all its derivatives grow with v. So it lies above the
    parabola with its value and slope κ = θ / sin θ at the centre's v and with its second derivative at the least v
    within the node, of which four terms of the series are a lower bound. With w the part of z - c tangent at c and
    q = |z - c|² >= |w|², x · (z - c) = t · w - q (x · c) / 2; what is left is a quadratic in w, whose least value over
    the rectangle is inside or on a side, and a remainder of third order. Where a bound by the first derivative alone
    reaches ``enough``, that is returned.
    """
    radius = model[10]
    cosine = wp.dot(x, c)
    v = HALF * wp.length_sq(x - c)
    # 1 - cos θ, a thousandth of a radian short of the antipode, where the squared distance has no second derivative.
    if radius > ONE or v > wp.float64(1.999999):
        return -LARGE  # next to the antipode the slope is infinite
    sine = wp.sqrt(v * (TWO - v))
    angle = TWO * wp.asin(wp.sqrt(HALF * v))
    kappa = ONE
    # Smallest sine, below, θ / sin θ is 1 to the last digit
    if sine > wp.float64(1.0e-12):
        kappa = angle / sine
    t0 = wp.dot(x, axis)
    t1 = wp.dot(x, wp.cross(c, axis))
    down = wp.max(-cosine, ZERO)
    least = wp.max(v - radius * (sine + HALF * radius * down), ZERO)
    curve = wp.float64(1.0 / 3.0) + least * (
        wp.float64(4.0 / 15.0) + least * (wp.float64(6.0 / 35.0) + wp.float64(32.0 / 315.0) * least)
    )
    normal = kappa * cosine
    if normal < ZERO:
        normal = normal / (ONE - wp.float64(0.25) * radius * radius)  # q = |w|² / (1 - q / 4)
    base = HALF * angle * angle - model[0] - HALF * curve * sine * radius * radius * radius * wp.abs(cosine)
    g0 = -(kappa * t0 + model[1])
    g1 = -(kappa * t1 + model[2])
    h00 = normal + curve * t0 * t0 - model[3]
    h01 = curve * t0 * t1 - model[4]
    h11 = normal + curve * t1 * t1 - model[5]
    mean = HALF * (h00 + h11)
    half = HALF * (h00 - h11)
    spread = wp.sqrt(half * half + h01 * h01)
    simple = base - radius * wp.sqrt(g0 * g0 + g1 * g1) + HALF * wp.min(mean - spread, ZERO) * radius * radius
    if simple >= enough:
        return simple
    low0, high0 = -model[6], model[7]
    low1, high1 = -model[8], model[9]
    det = h00 * h11 - h01 * h01
    if h00 > ZERO and det > ZERO:
        w0 = (h01 * g1 - h11 * g0) / det
        w1 = (h01 * g0 - h00 * g1) / det
        if w0 >= low0 and w0 <= high0 and w1 >= low1 and w1 <= high1:
            return base + HALF * (g0 * w0 + g1 * w1)
    value = low0 * (g0 + HALF * h00 * low0) + lowest_on_interval(g1 + h01 * low0, h11, low1, high1)
    value = wp.min(value, high0 * (g0 + HALF * h00 * high0) + lowest_on_interval(g1 + h01 * high0, h11, low1, high1))
    value = wp.min(value, low1 * (g1 + HALF * h11 * low1) + lowest_on_interval(g0 + h01 * low1, h00, low0, high0))
    value = wp.min(value, high1 * (g1 + HALF * h11 * high1) + lowest_on_interval(g0 + h01 * high1, h00, low0, high0))
    return base + value


@wp.kernel
def c_transform(
    sources: wp.array[wp.vec3d],
    seeds: wp.array[wp.float64],
    tolerance: wp.float64,
    tree: Tree,
    # Data out:
    proven_out: wp.array[wp.float64],
    triangle_out: wp.array[wp.int32],
    weights_out: wp.array[wp.vec3d],
):
    """Compute φ(x) = min of c(x, z) - ψ(z) over the sphere.

    A branch is skipped where its bound proves that it has no value below the best so far minus the tolerance. In a
    triangle that is not skipped the quadratic through the values at the six samples says where the
    least value is, and the value there is taken. ``proven`` is the lower of the least value found and of all bounds
    that were relied upon: no sample has a value below it, and it is at most the tolerance below what was found.
    """
    i, _compiled_once = wp.tid()
    x = sources[i]
    best = seeds[i]
    best_leaf = int(-1)
    best_weights = wp.vec3d()
    relied = LARGE
    node = int(1)
    while node > 0:
        inside = bool(False)
        model = tree.models[node]
        if model[0] > -LARGE:
            enough = best - tolerance
            bound = node_bound(x, tree.centres[node], tree.axes[node], model, enough)
            inside = bound < enough
            if not inside:
                # Slack: lowers bounds of numbers of size 1 by fifty times float64's round-off
                relied = wp.min(relied, bound - wp.float64(1.0e-14))
        if inside and node >= tree.leaf_count:
            leaf = node - tree.leaf_count
            corner = wp.vec3d()
            middle = wp.vec3d()
            for k in range(3):
                one = SAMPLES * leaf + k
                corner[k] = half_squared_distance(x, tree.places[one]) - tree.values[one]
                middle[k] = half_squared_distance(x, tree.places[one + 3]) - tree.values[one + 3]
            bulge = wp.vec3d()
            for k in range(3):
                bulge[k] = wp.float64(4.0) * middle[k] - TWO * (corner[k] + corner[(k + 1) % 3])
                b = sample_weights(k)
                value = corner[k]
                if middle[k] < value:
                    value = middle[k]
                    b = sample_weights(k + 3)
                if value < best:
                    best = value
                    best_leaf = leaf
                    best_weights = b
            b = lowest_on_triangle(corner, bulge)
            if potential_at(corner, bulge, b) < best:
                z, psi = sample_at(tree.triangles[leaf], b @ tree.corners[leaf], tree)
                value = half_squared_distance(x, z) - psi
                if value < best:
                    best = value
                    best_leaf = leaf
                    best_weights = b
        node = next_node(node, inside, tree.leaf_count)
    proven_out[i] = wp.min(best, relied)
    triangle_out[i] = -1
    if best_leaf >= 0:
        triangle_out[i] = tree.triangles[best_leaf]
        best_weights = best_weights @ tree.corners[best_leaf]
    weights_out[i] = best_weights
