"""Kernels of the discrete optimal map: cost, areas around vertices, their derivatives, and the metric of the cost.

The map takes x_v on the conformal sphere to y_v; a_v is the solid angle of the triangles around v, its ring, which has
to be 3 m_v; P_v is the potential of the target at y_v. See :mod:`omtwarp.optimal.energy`.
"""

# mypy: ignore-errors
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import TINY, logarithm, oriented_volume
from omtwarp.solvers.newton import ends_in
from omtwarp.solvers.triangle import first_tangent, tangent_coordinates

wp.set_module_options(KERNEL_OPTIONS)

# Added to the diagonal of the normal equations of a vertex's neighbours, per neighbour, so that they can be solved
# where all neighbours lie on one line.
LINE = wp.constant(wp.float64(1e-9))

Fit = wp.types.vector(length=8, dtype=wp.float64)
"""Sums over neighbours: a11, a12, a22, b11, b12, b21, b22 of the normal equations of dx = J dy; their number."""


@wp.func
def area_gradient(points: wp.array[wp.vec3d], face: wp.vec3i, k: int) -> wp.vec3d:
    """Return the gradient of a triangle's solid angle by its corner k, tangent to the sphere there."""
    own, p, q = points[face[k]], points[face[(k + 1) % 3]], points[face[(k + 2) % 3]]
    normal = wp.cross(p, q)
    towards = p + q
    # Six times the volume, computed from differences so that small triangles lose no digits.
    volume = oriented_volume(own, p, q)
    dots = ONE + wp.dot(own, p) + wp.dot(own, q) + wp.dot(p, q)
    gradient = TWO / (volume * volume + dots * dots) * (dots * normal - volume * towards)
    return gradient - wp.dot(gradient, own) * own


@wp.func
def moving_cost(distance: wp.float64, softness: wp.float64) -> wp.float64:
    """Return d², or with a softness the soft distance sqrt(d² + softness²) - softness."""
    if softness > ZERO:
        return distance * distance / (wp.sqrt(distance * distance + softness * softness) + softness)
    return distance * distance


@wp.func
def cost_slope(distance: wp.float64, softness: wp.float64) -> wp.float64:
    """Return the derivative of :func:`moving_cost` by d²."""
    if softness > ZERO:
        return HALF / wp.sqrt(distance * distance + softness * softness)
    return ONE


@wp.func
def along_share(distance: wp.float64, softness: wp.float64) -> wp.float64:
    """Return the second derivative of :func:`moving_cost` along the geodesic, relative to that across it."""
    if softness > ZERO:
        return softness * softness / (distance * distance + softness * softness)
    return ONE


@wp.kernel
def vertex_costs(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    softness: wp.float64,
    # Data out:
    cost: wp.array[wp.float64],
):
    """Compute the cost of moving every vertex from its start, shape [V]."""
    v = wp.tid()
    _pull, distance = logarithm(points[v], start[v])
    cost[v] = moving_cost(distance, softness)


@wp.kernel
def transport_gradient(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    masses: wp.array[wp.float64],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    softness: wp.float64,
    further: wp.array[wp.vec3d],
    weight: wp.float64,
    first: int,
    # Data out:
    gradient: wp.array[wp.vec3d],
):
    """Compute the gradient of Σ masses_v cost_v + Σ P_f area_f by the vertices, tangent to the sphere, shape [V].

    ``masses`` and ``potential``, P_f of every triangle, are taken as constant; ``weight`` times a further gradient is
    added.
    """
    v, _compiled_once = wp.tid()
    v += first
    y = points[v]
    pull, distance = logarithm(y, start[v])
    total = -(TWO * masses[v] * cost_slope(distance, softness)) * pull
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        total += potential[corner // 3] * area_gradient(points, faces[corner // 3], corner % 3)
    gradient[v] = total + weight * further[v]


@wp.kernel
def area_slopes(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    slopes: wp.array2d[wp.vec2d],
):
    """Compute the derivatives of every solid angle by its corners, in their tangent bases, shape [F, 3]."""
    f, _compiled_once = wp.tid()
    for k in range(3):
        slopes[f, k] = tangent_coordinates(points[faces[f][k]], area_gradient(points, faces[f], k))


@wp.kernel
def edge_slopes(
    slopes: wp.array2d[wp.vec2d],
    faces: wp.array[wp.vec3i],
    edges: wp.array[wp.vec2i],
    edge_corners: wp.array[wp.vec2i],
    first: int,
    # Data out:
    of_edges: wp.array2d[wp.vec2d],
):
    """Sum the derivatives of triangles' areas to those of the areas around the ends of every edge, shape [2, E].

    First come the derivatives of the first end's area by the second end's coordinates, then those of the second end's
    area by the first end's coordinates. Both are sums over the two triangles of the edge.
    """
    e = first + wp.tid()
    by_first, by_second = wp.vec2d(), wp.vec2d()
    for k in range(2):
        corner = edge_corners[e][k]
        if corner >= 0:
            one, other = ends_in(corner, edges[e][0], faces)
            by_first += slopes[corner // 3, one]
            by_second += slopes[corner // 3, other]
    of_edges[0, e] = by_second
    of_edges[1, e] = by_first


@wp.kernel
def area_errors(
    areas: wp.array[wp.float64],
    wanted: wp.array[wp.float64],
    # Data out:
    missing: wp.array[wp.float64],
    relative: wp.array[wp.float64],
):
    """Compute the errors of areas, and the same over the wanted areas."""
    c = wp.tid()
    missing[c] = areas[c] - wanted[c]
    relative[c] = missing[c] / wanted[c]


@wp.kernel
def raise_diagonal(
    total: wp.array[wp.float64],
    of_total: wp.float64,
    share: wp.float64,
    # Data in and out:
    diagonal: wp.array[wp.float64],
):
    """Add a share of the diagonal's sum to every entry, and a share of the entry itself."""
    i = wp.tid()
    diagonal[i] = diagonal[i] * (ONE + share) + of_total * total[0]


@wp.kernel
def single_gains(
    relative: wp.array[wp.float64],
    missing: wp.array[wp.float64],
    stiffness: wp.float64,
    gradient: wp.array2d[wp.float64],
    diagonal: wp.array2d[wp.float64],
    inner: wp.array[wp.float64],
    # Data out:
    gains: wp.array[wp.float64],
):
    """Compute what a Newton step of each vertex alone would gain, and the penalty on the area around it."""
    v = wp.tid()
    g0, g1, off = gradient[v, 0], gradient[v, 1], inner[v]
    h00, h11 = diagonal[v, 0], diagonal[v, 1]
    alone = (g0 * g0 * h11 - TWO * g0 * g1 * off + g1 * g1 * h00) / (h00 * h11 - off * off)
    gains[v] = alone + stiffness * missing[v] * relative[v]


@wp.func
def turned_back(vector: wp.vec3d, y: wp.vec3d, x: wp.vec3d) -> wp.vec3d:
    """Rotate a vector by the rotation that takes x to y along their geodesic."""
    axis = wp.cross(x, y)
    cosine = wp.dot(x, y)
    return cosine * vector + wp.cross(axis, vector) + wp.dot(axis, vector) / wp.max(ONE + cosine, TINY) * axis


@wp.func
def weighted_fit(weight: wp.float64, d1: wp.float64, d2: wp.float64, e1: wp.float64, e2: wp.float64) -> Fit:
    """Return what a neighbour with dy = d and dx = e adds to the normal equations."""
    b1, b2 = weight * e1, weight * e2
    return Fit(weight * d1 * d1, weight * d1 * d2, weight * d2 * d2, b1 * d1, b1 * d2, b2 * d1, b2 * d2, ONE)


@wp.func
def neighbour_fit(
    y: wp.vec3d, x: wp.vec3d, softness: wp.float64, neighbour: wp.vec3d, neighbour_start: wp.vec3d
) -> Fit:
    """Return what a neighbour adds to the fit at y, which comes from x, weighted by one over its squared distance."""
    t = first_tangent(y)
    s = wp.cross(y, t)
    pull, distance = logarithm(y, x)
    pull = pull / wp.max(distance, TINY)
    d = neighbour - y
    e = turned_back(neighbour_start - x, y, x)
    e = e + (along_share(distance, softness) - ONE) * wp.dot(e, pull) * pull
    d1, d2 = wp.dot(d, t), wp.dot(d, s)
    weight = ONE / wp.max(d1 * d1 + d2 * d2, TINY)
    return weighted_fit(weight, d1, d2, wp.dot(e, t), wp.dot(e, s))


@wp.func
def raised_fit(fit: Fit, least: wp.float64) -> wp.vec4d:
    """Solve J A = B for the neighbours, make J symmetric and raise its eigenvalues to ``least``.

    Returns the entries of J, row by row.
    """
    held11, held22 = fit[0] + LINE * fit[7], fit[2] + LINE * fit[7]
    det = held11 * held22 - fit[1] * fit[1]
    j11 = (fit[3] * held22 - fit[4] * fit[1]) / det
    j12 = (fit[4] * held11 - fit[3] * fit[1]) / det
    j21 = (fit[5] * held22 - fit[6] * fit[1]) / det
    j22 = (fit[6] * held11 - fit[5] * fit[1]) / det
    mean, gap, off = HALF * (j11 + j22), HALF * (j11 - j22), HALF * (j12 + j21)
    radius = wp.sqrt(gap * gap + off * off)
    high, low = wp.max(mean + radius, least), wp.max(mean - radius, least)
    cosine, sine = wp.float64(1.0), wp.float64(0.0)
    if radius > TINY:
        cosine, sine = gap / radius, off / radius
    centre, spread = HALF * (high + low), HALF * (high - low)
    return wp.vec4d(centre + spread * cosine, spread * sine, spread * sine, centre - spread * cosine)


@wp.kernel
def cost_metric(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    masses: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    least: wp.float64,
    softness: wp.float64,
    first: int,
    # Data out:
    metric: wp.array[wp.vec4d],
):
    """Compute the second derivative of cost plus potential at every vertex, 2x2 in its tangent basis, shape [V].

    At the optimum of the squared distance it is 2 masses_v times the derivative of the inverse map y -> x, which is
    symmetric and positive there. This kernel fits that derivative to the neighbours of the vertex, makes it symmetric
    and raises its eigenvalues to ``least``. With another cost c(d), moves of x along the geodesic count c''/2, across
    it c'/2d.
    """
    v, _compiled_once = wp.tid()
    v += first
    y, x = points[v], start[v]
    fit = Fit()
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        w = faces[corner // 3][(corner + 1) % 3]
        fit += neighbour_fit(y, x, softness, points[w], start[w])
    _pull, distance = logarithm(y, x)
    metric[v] = TWO * masses[v] * cost_slope(distance, softness) * raised_fit(fit, least)
