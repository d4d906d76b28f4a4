"""Kernels of the coarse-to-fine embedding: insertion of vertices, and moves that cannot flip a triangle."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import first_tangent
from omtwarp.start.decimation import MAX_VALENCE, Vertex

wp.set_module_options(KERNEL_OPTIONS)

Normals = wp.types.matrix(shape=(MAX_VALENCE, 3), dtype=wp.float64)
# det[a, b, c] evaluated in float64 from unit vectors is right to about 3e-16: no move may bring a triangle nearer to 0
# than this, unless it is already nearer.
_SAFE_DETERMINANT = wp.constant(wp.float64(1.0e-12))
_SUFFICIENT_DECREASE = wp.constant(wp.float64(1.0e-4))

_HALVINGS = wp.constant(12)  # of a step of Newton's method at one vertex: shorter than 1/4096 of it is not worth a try


@wp.func
def least_dot(x: wp.vec3d, normals: Normals, count: wp.int32) -> wp.float64:
    """Return the sine of the angle between ``x`` and the nearest of the great circles with these normals, signed."""
    least = wp.float64(2.0)
    for k in range(count):
        least = wp.min(least, wp.dot(x, normals[k]))
    return least


@wp.func
def middle_of_kernel(
    rings: wp.array2d[wp.int32], row: wp.int32, count: wp.int32, sphere: wp.array[wp.vec3d]
) -> wp.vec3d:
    """Return the centre of the largest cap inside the kernel of a ring.

    The kernel of a spherical polygon is where all its edges' great circles are on the left. Its largest cap is centred
    where the smallest cap around the edges' unit normals is: a point that two or three of the normals determine. All of
    these are tried, so that rounding in a nearly degenerate one does no harm.
    """
    normals = Normals()
    for k in range(count):
        a = sphere[rings[row, k]]
        b = sphere[rings[row, (k + 1) % count]]
        normals[k] = wp.normalize(wp.cross(a, b - a))
    best = wp.vec3d()
    best_margin = wp.float64(-2.0)
    for p in range(count):
        first = normals[p]
        for q in range(p + 1, count):
            second = normals[q]
            for r in range(q, count):  # two normals, then three
                x = wp.normalize(first + second)
                if r > q:
                    x = wp.normalize(wp.cross(second - first, normals[r] - first))
                if wp.dot(x, first) < ZERO:
                    x = -x
                margin = least_dot(x, normals, count)
                if margin > best_margin:
                    best_margin = margin
                    best = x
    return best


@wp.func
def middle_of_arc(
    rings: wp.array2d[wp.int32], row: wp.int32, count: wp.int32, pole: wp.int32, sphere: wp.array[wp.vec3d]
) -> wp.vec3d:
    """Return where a vertex of the boundary goes on the arc of the equator between its neighbours there.

    One of them is the first of the ring, from which a part of the arc sees the whole ring: the vertex goes to the
    middle of that part. The other one is on the other side of the pole, which is the second or the last of the ring.
    """
    other = count - 2
    if rings[row, 1] == pole:
        other = 2
    first = sphere[rings[row, 0]]
    second = sphere[rings[row, other]]
    far = ONE
    for k in range(count):
        a = sphere[rings[row, k]]
        b = sphere[rings[row, (k + 1) % count]]
        normal = wp.cross(a, b - a)
        begin = wp.dot(first, normal)
        end = wp.dot(second, normal)
        if end < ZERO and begin > ZERO:
            far = wp.min(far, begin / (begin - end))
    share = HALF * far
    best = wp.normalize((ONE - share) * first + share * second)
    return wp.vec3d(best[0], best[1], ZERO)


@wp.kernel
def insert_vertices(
    removed: wp.array[wp.int32],
    rings: wp.array2d[wp.int32],
    valences: wp.array[wp.int32],
    kinds: wp.array[wp.int32],
    pole: int,
    # Data in and out:
    sphere: wp.array[wp.vec3d],
    colours: wp.array[wp.int32],
    # Data out:
    least_determinants: wp.array[wp.float64],
):
    """Put every vertex inside its ring, or on the equator where it is of the boundary, and colour it unlike its ring.

    The least determinant is that of the triangles between it and the sides of the ring.
    """
    i, _compiled_once = wp.tid()
    v = removed[i]
    count = valences[i]
    used = int(0)
    for k in range(count):
        used = used | (1 << colours[rings[i, k]])
    colour = int(0)
    while ((used >> colour) & 1) == 1:
        colour += 1
    colours[v] = colour

    x = wp.vec3d()
    if kinds[v] == Vertex.RIM:
        x = middle_of_arc(rings, i, count, pole, sphere)
    else:
        x = middle_of_kernel(rings, i, count, sphere)
    sphere[v] = x
    least = wp.float64(2.0)
    for k in range(count):
        least = wp.min(least, wp.dot(x, wp.cross(sphere[rings[i, k]], sphere[rings[i, (k + 1) % count]])))
    least_determinants[i] = least


@wp.func
def star_energy(
    x: wp.vec3d,
    begin: wp.int32,
    end: wp.int32,
    heads: wp.array[wp.int32],
    thirds: wp.array[wp.int32],
    coefficients: wp.array[wp.vec4d],
    sphere: wp.array[wp.vec3d],
    area_weight: wp.float64,
    least_determinant: wp.float64,
    pole: wp.int32,
) -> wp.float64:
    """Return the energy of the triangles around a vertex at ``x``, without those at the pole.

    It is infeasible where a determinant is not above the bound, at the pole too.

    A triangle of target area A contributes A (|J|^2 + w (D^2 + 1)) / D with D = det / (2A) and A |J|^2 half the sum of
    cotangents times squared opposite edges. det and not the area is linear in ``x`` and negative where flipped; the two
    agree for small triangles.
    """
    energy = wp.float64(0.0)
    for h in range(begin, end):
        a = sphere[heads[h]]
        b = sphere[thirds[h]]
        k = coefficients[h]
        det = wp.dot(x, wp.cross(a, b - a))
        if det <= least_determinant:
            # Infeasible, energy of a ring with a flipped triangle: more than any other
            return wp.float64(1.0e300)
        if heads[h] != pole and thirds[h] != pole:
            stretch = k[0] * wp.length_sq(b - a) + k[1] * wp.length_sq(x - b) + k[2] * wp.length_sq(x - a)
            energy += k[3] * (stretch + TWO * area_weight * k[3]) / det + HALF * area_weight * det
    return energy


@wp.kernel
def relax_vertices(
    slots: wp.array[wp.int32],
    vertices: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    heads: wp.array[wp.int32],
    thirds: wp.array[wp.int32],
    coefficients: wp.array[wp.vec4d],
    kinds: wp.array[wp.int32],
    pole: int,
    area_weight: wp.float64,
    # Data in and out:
    sphere: wp.array[wp.vec3d],
):
    """Take a Newton step with a line search for vertices of which no two are neighbours.

    Those of the boundary move on the equator, others anywhere but the pole, which is -1 for a closed surface. The
    energy of ``star_energy`` is a sum of quadratics over positive linear functions of ``x``, hence convex: its Hessian
    needs no modification and the step is a descent direction.
    """
    slot, _compiled_once = wp.tid()
    i = slots[slot]
    v = vertices[i]
    if v == pole:
        return
    on_equator = kinds[v] == Vertex.RIM
    begin = offsets[i]
    end = offsets[i + 1]
    x = sphere[v]
    energy = wp.float64(0.0)
    gradient = wp.vec3d()
    hessian = wp.mat33d()
    least = wp.float64(2.0)
    for h in range(begin, end):
        a = sphere[heads[h]]
        b = sphere[thirds[h]]
        k = coefficients[h]
        normal = wp.cross(a, b - a)
        det = wp.dot(x, normal)
        least = wp.min(least, det)
        if heads[h] == pole or thirds[h] == pole:
            continue
        stretch = k[0] * wp.length_sq(b - a) + k[1] * wp.length_sq(x - b) + k[2] * wp.length_sq(x - a)
        top = k[3] * (stretch + TWO * area_weight * k[3])
        slope = TWO * k[3] * (k[1] * (x - b) + k[2] * (x - a))
        inverse = ONE / det
        energy += top * inverse + HALF * area_weight * det
        gradient += inverse * slope + (HALF * area_weight - top * inverse * inverse) * normal
        cross_term = wp.outer(slope, normal)
        hessian += inverse * (
            TWO * k[3] * (k[1] + k[2]) * wp.identity(n=3, dtype=wp.float64)
            - inverse * (cross_term + wp.transpose(cross_term))
            + (TWO * top * inverse * inverse) * wp.outer(normal, normal)
        )
    if least <= ZERO:
        return
    t1 = first_tangent(x)
    if on_equator:
        t1 = wp.vec3d(-x[1], x[0], ZERO)
    t2 = wp.cross(x, t1)
    g1 = wp.dot(gradient, t1)
    g2 = wp.dot(gradient, t2)
    # The sphere bends away from the tangent plane: the radial part of the gradient is curvature, used where it helps.
    bend = wp.max(-wp.dot(gradient, x), ZERO)
    h11 = wp.dot(t1, hessian * t1) + bend
    h12 = wp.dot(t1, hessian * t2)
    h22 = wp.dot(t2, hessian * t2) + bend
    if on_equator:
        g2, h12, h22 = ZERO, ZERO, ONE
    det2 = h11 * h22 - h12 * h12
    if not (det2 > ZERO):
        return
    s1 = (h12 * g2 - h22 * g1) / det2
    s2 = (h12 * g1 - h11 * g2) / det2
    descent = s1 * g1 + s2 * g2
    if not (descent < ZERO):
        return
    direction = s1 * t1 + s2 * t2
    bound = wp.min(_SAFE_DETERMINANT, HALF * least)
    step = ONE / wp.max(ONE, wp.length(direction))
    for _ in range(_HALVINGS):
        trial = wp.normalize(x + step * direction)
        value = star_energy(trial, begin, end, heads, thirds, coefficients, sphere, area_weight, bound, pole)
        if value < energy + _SUFFICIENT_DECREASE * step * descent:
            sphere[v] = trial
            return
        step *= HALF
