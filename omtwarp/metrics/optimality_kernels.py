"""Kernels of the optimality report: the c-transform over a sphere or a flat torus covered by triangles.

The potential ψ on every triangle of the image mesh, in the barycentric coordinates b of the flat triangle, is

    ψ(b) = Σ_k b_k ψ_k + b_k b_k+1 (e_k + (b_k - b_k+1) (s_k - ψ_k+1 + ψ_k + (b_k - b_k+1) t_k)).

On the edge (k, k+1) ψ has a given slope at each end, and in the middle the value of a cubic of the arc's length: s_k is
the mean of the slopes, e_k half of what the slope by the arc's length falls from one end to the other, and t_k what the
same by the edge's length is more. On a torus the terms with b_k - b_k+1 are left out.

The place there is p = Σ_k b_k y_k in the plane, of a torus's universal cover, and p / |p| on the sphere. The samples of
a triangle are its corners and the middles of its edges. Triangles, or parts of those with long edges, are the leaves of
a tree (:mod:`.tree_kernels`).
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import geodesic_distance
from omtwarp.metrics.tree_kernels import leaves_below, lowest_on_triangle, next_node, potential_at

wp.set_module_options(KERNEL_OPTIONS)

mat66d = wp.types.matrix(shape=(6, 6), dtype=wp.float64)
vec6d = wp.types.vector(length=6, dtype=wp.float64)

NOTHING = vec6d(-LARGE, 0.0, 0.0, 0.0, 0.0, 0.0)  # extremes without triangles
SAMPLES = wp.constant(6)  # of the potential in a triangle: as many as a quadratic function has coefficients


@wp.struct
class Potential:
    """ψ on F triangles: what is passed for every place, apart from the tree, as structs are copied."""

    flat: wp.bool  # whether the triangles lie in a plane, or else on the sphere
    images: wp.array[wp.mat33d]  # corners of the triangles, as rows, [F]
    faces: wp.array[wp.vec3i]
    nodal: wp.array[wp.float64]  # ψ at the vertices
    edge: wp.array[wp.vec3d]  # e_k of every face
    mean: wp.array[wp.vec3d]  # s_k
    bend: wp.array[wp.vec3d]  # t_k


@wp.struct
class Tree:
    """A potential, its samples on P leaves, and a paraboloid above it on each of N nodes.

    With a_k = w · axis_k at a place z = c + w below a node with the centre c, ψ(z) is at most
    level + s_0 a_0 + s_1 a_1 + b_00 a_0² / 2 + b_01 a_0 a_1 + b_11 a_1² / 2.
    """

    potential: Potential
    leaf_count: wp.int32  # a power of two, of which the first P are taken; N is twice this
    triangles: wp.array[wp.int32]  # that each leaf is a part of, [P]
    corners: wp.array[wp.mat33d]  # its own in barycentric coordinates there, as rows, [P]
    places: wp.array[wp.vec3d]  # of the samples of the leaves, one leaf after another, [SAMPLES P]
    values: wp.array[wp.float64]  # ψ there
    bulges: wp.array[wp.float64]  # how far ψ may exceed the quadratic through the samples of a leaf, [P]
    centres: wp.array[wp.vec3d]  # of the nodes, [N]
    axes: wp.array[wp.vec3d]  # the first one, orthogonal to the normal; the second is orthogonal to both
    models: wp.array[vec6d]  # any number, s_0, s_1, b_00, b_01, b_11
    extremes: wp.array[vec6d]  # the level, -LARGE without triangles, and the largest -a_0, a_0, -a_1, a_1 and |w|²


@wp.func
def cost_of(x: wp.vec3d, z: wp.vec3d, flat: bool) -> wp.float64:
    """Return the cost c(x, z), half the squared distance in the plane or on the sphere."""
    if flat:
        return HALF * wp.length_sq(x - z)
    d = geodesic_distance(x, z)
    return HALF * d * d


@wp.func
def slope_part(nodal: wp.vec3d, mean: wp.vec3d, bend: wp.vec3d, b: wp.vec3d) -> wp.float64:
    """Return what gives ψ its slopes at the ends of edges; it is zero at corners and in the middles of edges."""
    part = ZERO
    for k in range(3):
        after = (k + 1) % 3
        apart = b[k] - b[after]
        part += b[k] * b[after] * apart * (mean[k] - nodal[after] + nodal[k] + apart * bend[k])
    return part


@wp.func
def sample_at(f: int, b: wp.vec3d, psi: Potential):
    """Return the place at barycentric coordinates b of a triangle of the mesh, and ψ there."""
    face = psi.faces[f]
    place = b @ psi.images[f]
    nodal = wp.vec3d(psi.nodal[face[0]], psi.nodal[face[1]], psi.nodal[face[2]])
    value = potential_at(nodal, psi.edge[f], b)
    if not psi.flat:
        place = wp.normalize(place)
        value += slope_part(nodal, psi.mean[f], psi.bend[f], b)
    return place, value


@wp.func
def sample_weights(s: int) -> wp.vec3d:
    """Return barycentric coordinates of sample s of a triangle: its corners, then the middles of the edges (k, k+1)."""
    b = wp.vec3d()
    b[s % 3] = HALF
    other = (s + s // 3) % 3  # the corner itself, or the next one
    b[other] = b[other] + HALF
    return b


@wp.kernel
def sample_triangles(
    begin: int,
    # Data in and out:
    tree: Tree,
):
    """Find the places of the six samples of every leaf, and the potential there.

    A quarter along an edge a cubic is within 3 % as far from the quadratic through its ends and middle as anywhere.
    """
    leaf = begin + wp.tid()
    face = tree.triangles[leaf]
    part = tree.corners[leaf]
    sampled = vec6d()
    for s in range(SAMPLES):
        place, value = sample_at(face, sample_weights(s) @ part, tree.potential)
        tree.places[SAMPLES * leaf + s] = place
        tree.values[SAMPLES * leaf + s] = value
        sampled[s] = value
    bulge = ZERO
    for k in range(3):
        after = (k + 1) % 3
        _, value = sample_at(face, part[k] + HALF * HALF * (part[after] - part[k]), tree.potential)
        through = wp.float64(0.125) * (wp.float64(3.0) * sampled[k] - sampled[after] + wp.float64(6.0) * sampled[k + 3])
        bulge += wp.float64(1.03) * wp.abs(value - through)
    tree.bulges[leaf] = bulge


@wp.func
def solve_definite(matrix: mat66d, right: vec6d) -> vec6d:
    """Return the solution of a symmetric positive definite system of six equations, by Gauss and Jordan's method."""
    left = matrix
    x = right
    for j in range(6):
        # Of a least-squares system in units of its node: the ridge keeps pivots above.
        pivot = wp.max(left[j, j], wp.float64(1.0e-30))
        x[j] = x[j] / pivot
        for k in range(j + 1, 6):
            left[j, k] = left[j, k] / pivot
        for i in range(6):
            if i != j:
                x[i] = x[i] - left[i, j] * x[j]
                for k in range(j + 1, 6):
                    left[i, k] = left[i, k] - left[i, j] * left[j, k]
    return x


@wp.func
def normal_at(place: wp.vec3d, flat: bool) -> wp.vec3d:
    """Return the normal of the plane or the sphere."""
    if flat:
        return wp.vec3d(ZERO, ZERO, ONE)
    return place


@wp.func
def terms_at(w: wp.vec3d, axis: wp.vec3d, other: wp.vec3d) -> vec6d:
    """Return what the coefficients of a paraboloid are multiplied by: 1, a_0, a_1, a_0² / 2, a_0 a_1 and a_1² / 2."""
    a0 = wp.dot(w, axis)
    a1 = wp.dot(w, other)
    return vec6d(ONE, a0, a1, HALF * a0 * a0, a0 * a1, HALF * a1 * a1)


@wp.kernel
def fit_nodes(
    begin: int,
    # Data in and out:
    tree: Tree,
):
    """Choose the centre of a node and its axes, and fit a paraboloid to the potential there; nodes begin at 1."""
    place, _compiled_once = wp.tid()
    node = begin + place + 1
    first, last = leaves_below(node, tree.leaf_count, tree.triangles.shape[0])
    if first > last:
        return
    count = last - first + 1
    # Triangles of a node that its paraboloid is fitted to; the level that makes it a bound uses all of them.
    fitted = wp.min(count, 4)
    c = wp.vec3d()
    for k in range(fitted):
        f = first + ((2 * k + 1) * count) // (2 * fitted)
        for s in range(3):
            c += tree.places[SAMPLES * f + s] / wp.float64(3 * fitted)
    if not tree.potential.flat:
        # Length of the mean of a node's directions: less where they cancel, as over a whole great circle.
        if wp.length(c) < wp.float64(1.0e-9):
            c = tree.places[SAMPLES * first]
        c = wp.normalize(c)
    normal = normal_at(c, tree.potential.flat)
    axis = wp.vec3d(ONE, ZERO, ZERO)
    # Of a unit vector's x: another axis helps to make a frame where it is larger. Anything from 0.58 to 1 leaves one to
    # take.
    if wp.abs(normal[0]) > wp.float64(0.6):
        axis = wp.vec3d(ZERO, ONE, ZERO)
    axis = wp.normalize(wp.cross(axis, normal))
    other = wp.cross(normal, axis)
    # The first axis is the direction in which the node is longest.
    # Squared radius: a node of one point is no smaller, so that it can be divided by.
    size = wp.float64(1.0e-30)
    stretch = wp.vec2d()
    for k in range(fitted):
        f = first + ((2 * k + 1) * count) // (2 * fitted)
        for s in range(3):
            w = tree.places[SAMPLES * f + s] - c
            a0 = wp.dot(w, axis)
            a1 = wp.dot(w, other)
            stretch += wp.vec2d(a0 * a0 - a1 * a1, TWO * a0 * a1)
            size = wp.max(size, wp.length_sq(w))
    size = wp.sqrt(size)
    angle = HALF * wp.atan2(stretch[1], stretch[0])
    axis = wp.cos(angle) * axis + wp.sin(angle) * other
    other = wp.cross(normal, axis)
    # Least squares over samples, in units of the node's size. On one triangle it interpolates. Relative, added to the
    # diagonal of the normal equations of a fit, which few or collinear points leave singular.
    gram = wp.identity(n=6, dtype=wp.float64) * (wp.float64(1.0e-10) * wp.float64(fitted))
    right = vec6d()
    for k in range(fitted):
        f = first + ((2 * k + 1) * count) // (2 * fitted)
        for s in range(SAMPLES):
            row = terms_at((tree.places[SAMPLES * f + s] - c) / size, axis, other)
            gram += wp.outer(row, row)
            right += tree.values[SAMPLES * f + s] * row
    scale = ONE / size
    square = scale * scale
    fit = wp.cw_mul(solve_definite(gram, right), vec6d(ONE, scale, scale, square, square, square))
    # Second derivatives of a fit: more is a fit through rounding, and a constant bounds better.
    if not (wp.abs(fit[3]) + wp.abs(fit[4]) + wp.abs(fit[5]) < wp.float64(1.0e12)):
        fit = vec6d()
    fit[0] = ZERO
    tree.centres[node] = c
    tree.axes[node] = axis
    tree.models[node] = fit


@wp.kernel
def raise_paraboloids(
    begin: int,
    tree: Tree,
    # Data in and out:
    extremes: wp.array[vec6d],
):
    """Raise the paraboloids of the nodes above a leaf so that they bound the potential there, and widen the nodes.

    They are upper bounds at all samples, and between them to third order, as far as the residual of ψ is a quadratic in
    barycentric coordinates.
    """
    leaf = begin + wp.tid()
    bulge = tree.bulges[leaf]
    node = tree.leaf_count + leaf
    while node > 0:
        c = tree.centres[node]
        axis = tree.axes[node]
        other = wp.cross(normal_at(c, tree.potential.flat), axis)
        most = vec6d(-LARGE, ZERO, ZERO, ZERO, ZERO, ZERO)
        above = wp.vec3d()
        for s in range(SAMPLES):
            w = tree.places[SAMPLES * leaf + s] - c
            terms = terms_at(w, axis, other)
            over = tree.values[SAMPLES * leaf + s] - wp.dot(tree.models[node], terms)
            most = wp.max(most, vec6d(over, -terms[1], terms[1], -terms[2], terms[2], wp.length_sq(w)))
            if s < 3:
                above[s] = over
            else:
                # No quadratic on the triangle exceeds its coefficients in Bernstein's form.
                most[0] = wp.max(most[0], TWO * over - HALF * (above[s - 3] + above[(s - 2) % 3]))
        most[0] = most[0] + bulge
        wp.atomic_max(extremes, node, most)
        node = node // 2


@wp.func
def lowest_on_interval(slope: wp.float64, bend: wp.float64, low: wp.float64, high: wp.float64) -> wp.float64:
    """Return the least value of slope s + bend s²/2 over low <= s <= high."""
    at_low = low * (slope + HALF * bend * low)
    at_high = high * (slope + HALF * bend * high)
    least = wp.min(at_low, at_high)
    if bend > ZERO and slope + bend * low < ZERO and slope + bend * high > ZERO:
        least = -HALF * slope * slope / bend
    return least


@wp.func
def node_bound(x: wp.vec3d, node: int, enough: wp.float64, tree: Tree) -> wp.float64:
    """Return a lower bound on c(x, z) - ψ(z) over all samples z of a node.

    With v = |x - z|²/2, c = v in a plane, and c = Σ (2v)^n / (n² C(2n, n)) on the sphere, which grows with v as all its
    derivatives do: c lies above the parabola with its value and slope κ at the centre's v and with its second
    derivative at the least v within the node, of which four terms of the series are a lower bound. With w = z - c,
    v - v(c) = (c - x) · w + |w|²/2, where on the sphere c · w = -|w|²/2; what is left is a quadratic in w, whose least
    value over the rectangle is inside or on a side, and a remainder of third order. Where a bound by the first
    derivative alone reaches ``enough``, that is returned.
    """
    c = tree.centres[node]
    extremes = tree.extremes[node]
    model = tree.models[node]
    squared = extremes[5]
    radius = wp.sqrt(squared)
    away = c - x
    v = HALF * wp.length_sq(away)
    base = v - extremes[0]
    kappa = ONE
    curve = ZERO
    normal = normal_at(c, tree.potential.flat)
    if not tree.potential.flat:
        # 1 - cos θ, a thousandth of a radian short of the antipode, where the squared distance has no second
        # derivative.
        if radius > ONE or v > wp.float64(1.999999):
            return -LARGE  # next to the antipode the slope is infinite
        sine = wp.sqrt(v * (TWO - v))
        angle = TWO * wp.asin(wp.sqrt(HALF * v))
        # Smallest sine, below, θ / sin θ is 1 to the last digit
        if sine > wp.float64(1.0e-12):
            kappa = angle / sine
        least = wp.max(v - radius * (sine + HALF * radius * wp.max(v - ONE, ZERO)), ZERO)
        curve = wp.float64(1.0 / 3.0) + least * (
            wp.float64(4.0 / 15.0) + least * (wp.float64(6.0 / 35.0) + wp.float64(32.0 / 315.0) * least)
        )
        base += HALF * angle * angle - v - HALF * curve * sine * radius * squared * wp.abs(ONE - v)
    own = kappa * (ONE - wp.dot(away, normal))
    if own < ZERO:
        own /= ONE - wp.float64(0.25) * squared  # |w|² is the square of its part along the sphere over 1 - |w|²/4
    t0 = wp.dot(away, tree.axes[node])
    t1 = wp.dot(away, wp.cross(normal, tree.axes[node]))
    g0 = kappa * t0 - model[1]
    g1 = kappa * t1 - model[2]
    h00 = own + curve * t0 * t0 - model[3]
    h01 = curve * t0 * t1 - model[4]
    h11 = own + curve * t1 * t1 - model[5]
    half = HALF * (h00 - h11)
    bent = HALF * (h00 + h11) - wp.sqrt(half * half + h01 * h01)
    simple = base - radius * wp.sqrt(g0 * g0 + g1 * g1) + HALF * wp.min(bent, ZERO) * squared
    if simple >= enough:
        return simple
    low0, high0 = -extremes[1], extremes[2]
    low1, high1 = -extremes[3], extremes[4]
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
    copies: wp.array[wp.vec3d],
    tolerance: wp.float64,
    tree: Tree,
    # Data out:
    proven_out: wp.array[wp.float64],
    triangle_out: wp.array[wp.int32],
    weights_out: wp.array[wp.vec3d],
):
    """Compute φ(x) = min of c(x, z) - ψ(z) over all triangles, or in a plane over the copies of all.

    A branch is skipped where its bound proves that it has no value below the best so far minus the tolerance. In a
    triangle that is not skipped the quadratic through the values at the six samples says where the
    least value is, and the value there is taken. ``proven`` is the lower of the least value found and of all bounds
    that were relied upon: no sample has a value below it, and it is at most the tolerance below what was found.
    """
    i, _compiled_once = wp.tid()
    best = seeds[i]
    best_leaf = int(-1)
    best_weights = wp.vec3d()
    relied = LARGE
    # Of the nodes of a sphere's tree above this one, wide as they are, hardly any can be skipped.
    top = wp.where(tree.potential.flat, 1, wp.min(16, tree.leaf_count))
    for copy in range(copies.shape[0]):
        x = sources[i] - copies[copy]
        node = int(top)
        while node > 0:
            inside = bool(False)
            if tree.extremes[node][0] > -LARGE:
                enough = best - tolerance
                bound = node_bound(x, node, enough, tree)
                inside = bound < enough
                if not inside:
                    # Slack: lowers bounds of numbers of size 1 by fifty times float64's round-off
                    relied = wp.min(relied, bound - wp.float64(1.0e-14))
            if inside and node >= tree.leaf_count:
                leaf = node - tree.leaf_count
                sampled = vec6d()
                for s in range(SAMPLES):
                    one = SAMPLES * leaf + s
                    sampled[s] = cost_of(x, tree.places[one], tree.potential.flat) - tree.values[one]
                    if sampled[s] < best:
                        best = sampled[s]
                        best_leaf = leaf
                        best_weights = sample_weights(s)
                corner = wp.vec3d(sampled[0], sampled[1], sampled[2])
                bulge = wp.vec3d()
                for k in range(3):
                    bulge[k] = wp.float64(4.0) * sampled[k + 3] - TWO * (corner[k] + corner[(k + 1) % 3])
                b = lowest_on_triangle(corner, bulge)
                if potential_at(corner, bulge, b) < best:
                    z, psi = sample_at(tree.triangles[leaf], b @ tree.corners[leaf], tree.potential)
                    value = cost_of(x, z, tree.potential.flat) - psi
                    if value < best:
                        best = value
                        best_leaf = leaf
                        best_weights = b
            node = next_node(node, inside, tree.leaf_count)
            while node > 0 and node < top:
                node = 2 * node
    proven_out[i] = wp.min(best, relied)
    triangle_out[i] = -1
    if best_leaf >= 0:
        triangle_out[i] = tree.triangles[best_leaf]
        best_weights = best_weights @ tree.corners[best_leaf]
    weights_out[i] = best_weights
