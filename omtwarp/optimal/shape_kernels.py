"""Kernels of the distortion energy: value, gradient and Hessian of every triangle, and steps that cannot flip.

With c1, c2 the columns of a triangle's Jacobian, fro = |c1|² + |c2|² and D = |c1 × c2| its flat area ratio; ``scale``
brings the image's total flat area to 4π. Angle distortion is fro / D, area distortion scale D + 1 / (scale D).
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, THREE, TWO, ZERO, wp
from omtwarp.geometry.spherical import corners_of, oriented_volume
from omtwarp.mesh import surface
from omtwarp.solvers.newton import packed
from omtwarp.solvers.triangle import column_weights, columns, first_tangents

wp.set_module_options(KERNEL_OPTIONS)

# Below this cosine between a triangle's plane and the sphere's the needle barrier sets in.
STEEP_COSINE = wp.constant(wp.float64(0.5))


@wp.func
def needle(cosine: wp.float64) -> wp.float64:
    """Return a barrier against flips that flat areas do not detect, 0 above ``STEEP_COSINE``.

    The flat triangle of a needle whose height is far below the sagitta of its long edge stands nearly upright: its
    volume can vanish while its flat area does not.
    """
    gap = wp.max(STEEP_COSINE - cosine, ZERO)
    return gap * gap * gap / cosine


@wp.func
def needle_slope(cosine: wp.float64) -> wp.float64:
    gap = wp.max(STEEP_COSINE - cosine, ZERO)
    return -(THREE * cosine + gap) * gap * gap / (cosine * cosine)


@wp.func
def needle_curvature(cosine: wp.float64) -> wp.float64:
    gap = wp.max(STEEP_COSINE - cosine, ZERO)
    share = gap / cosine
    return TWO * share * (THREE + THREE * share + share * share)


@wp.func
def half_angle(x: wp.float64, y: wp.float64) -> wp.vec2d:
    """Return the cosine and sine of half the angle of the vector (x, y), between -90 and 90 degrees; 0 has none."""
    length = wp.sqrt(x * x + y * y)
    if length == ZERO:
        return wp.vec2d(ONE, ZERO)
    if x >= ZERO:
        cosine = wp.sqrt(HALF * (length + x) / length)
        return wp.vec2d(cosine, HALF * y / (length * cosine))
    sine = wp.sqrt(HALF * (length - x) / length)
    if y < ZERO:
        sine = -sine
    return wp.vec2d(HALF * y / (length * sine), sine)


@wp.func
def distortion_terms(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Return the angle distortion less 2, D, det[s0, s1, s2] and needle barrier of a triangle."""
    c1, c2 = columns(frame, a, b, c)
    d = wp.length(wp.cross(c1, c2))
    # (s1 - s2)² / (s1 s2): no digits are lost where the map is nearly conformal.
    square = wp.dot(c1, c1) - wp.dot(c2, c2)
    shear = wp.dot(c1, c2)
    fro = wp.dot(c1, c1) + wp.dot(c2, c2)
    angle = (square * square + wp.float64(4.0) * shear * shear) / (d * (fro + TWO * d))
    solid = oriented_volume(a, b, c)
    return angle, d, solid, needle(solid * frame[0] * frame[2] / d)


@wp.kernel
def triangle_terms(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    # Data out:
    angle_excess: wp.array[wp.float64],
    ratio: wp.array[wp.float64],
    volume: wp.array[wp.float64],
    steepness: wp.array[wp.float64],
):
    """Compute the angle distortion less 2, D, det[s0, s1, s2] and needle barrier of every triangle, shape [F] each."""
    t = wp.tid()
    a, b, c = corners_of(sphere, faces[t])
    angle, d, solid, steep = distortion_terms(frames[t], a, b, c)
    angle_excess[t] = angle
    ratio[t] = d
    volume[t] = solid
    steepness[t] = steep


@wp.func
def distortion_gradient(frame: wp.vec3d, area: wp.float64, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, pressures: wp.vec3d):
    """Return the gradient of A [fro / D + p0 D + p1 / D + p2 needle], p the pressures, by the corners, one per row."""
    c1, c2 = columns(frame, a, b, c)
    normal = wp.cross(c1, c2)
    d = wp.length(normal)
    normal = normal / d
    fro = wp.dot(c1, c1) + wp.dot(c2, c2)
    by_fro = TWO * area / d
    by_det = area * (pressures[0] - (fro + pressures[1]) / (d * d))
    scale = frame[0] * frame[2]
    cosine = oriented_volume(a, b, c) * scale / d
    upright = area * pressures[2] * needle_slope(cosine) / d
    # The cosine is the ratio of the volume to D: its derivative by D joins that of the energy.
    by_det -= upright * cosine
    g1 = by_fro * c1 + by_det * wp.cross(c2, normal)
    g2 = by_fro * c2 + by_det * wp.cross(normal, c1)
    first, second = column_weights(frame)
    upright *= scale
    return wp.matrix_from_rows(
        first[0] * g1 + second[0] * g2 + upright * wp.cross(b, c),
        first[1] * g1 + second[1] * g2 + upright * wp.cross(c, a),
        first[2] * g1 + second[2] * g2 + upright * wp.cross(a, b),
    )


@wp.kernel
def triangle_gradient(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    pressures: wp.vec3d,
    # Data out:
    corner_gradient: wp.array[wp.vec3d],
):
    """Compute the gradient of A [fro / D + p0 D + p1 / D + p2 needle], p the pressures, by the corners, shape [3F]."""
    t = wp.tid()
    a, b, c = corners_of(sphere, faces[t])
    rows = distortion_gradient(frames[t], areas[t], a, b, c, pressures)
    for k in range(3):
        corner_gradient[3 * t + k] = rows[k]


@wp.kernel
def gather_tangent(
    sphere: wp.array[wp.vec3d],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    corner_gradient: wp.array[wp.vec3d],
    divisor: wp.float64,
    first: int,
    # Data out:
    gradient: wp.array[wp.vec3d],
):
    """Sum the values at the corners around every vertex, from a first one on, keep the tangent part, and divide it."""
    i = first + wp.tid()
    total = wp.vec3d(ZERO, ZERO, ZERO)
    for k in range(offsets[i], offsets[i + 1]):
        total = total + corner_gradient[corners[k]]
    y = sphere[i]
    gradient[i] = (total - wp.dot(total, y) * y) / divisor


@wp.func
def distortion_hessian(
    t: int,
    frame: wp.vec3d,
    share: wp.float64,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    axes: wp.mat33d,
    pressures: wp.vec3d,
    # Data out:
    hessian: wp.array2d[wp.float64],
):
    """Compute row t of the Hessian as :func:`triangle_hessian` describes it, as a share of Σ m mᵀ over modes m.

    Args:
        t: the row.
        frame: of the triangle.
        share: area over divisor.
        a, b, c: its corners.
        axes: what the first coordinate of each corner moves it along, as rows; the second one moves it across.
        pressures: as of :func:`triangle_hessian`.
        hessian: its entries on and above the diagonal.
    """
    c1, c2 = columns(frame, a, b, c)
    normal = wp.cross(c1, c2)
    ratio = wp.length(normal)
    normal = wp.normalize(normal)
    # Right singular vectors from the angle that diagonalises JᵀJ, left ones from J and the normal.
    p = wp.dot(c1, c1)
    q = wp.dot(c2, c2)
    r = wp.dot(c1, c2)
    turn = half_angle(p - q, TWO * r)
    cosine = turn[0]
    sine = turn[1]
    long_image = cosine * c1 + sine * c2
    s1 = wp.length(long_image)
    u1 = long_image / s1
    u2 = wp.cross(normal, u1)
    s2 = wp.dot(u2, cosine * c2 - sine * c1)
    d = s1 * s2
    fro = s1 * s1 + s2 * s2

    by_det = pressures[0] - (fro + pressures[1]) / (d * d)
    of_twist = wp.sqrt(HALF * wp.max(TWO / d + by_det, ZERO))
    of_flip = wp.sqrt(HALF * wp.max(TWO / d - by_det, ZERO))
    h11 = TWO * (s2 * s2 + pressures[1]) / (s1 * s1 * d)
    h22 = TWO * (s1 * s1 + pressures[1]) / (s2 * s2 * d)
    h12 = TWO * pressures[1] / (d * d) + by_det
    half_sum = HALF * (h11 + h22)
    half_gap = wp.sqrt(HALF * HALF * (h11 - h22) * (h11 - h22) + h12 * h12)
    lean = half_angle(h11 - h22, TWO * h12)
    of_stiff = wp.sqrt(half_sum + half_gap) * lean
    of_soft = wp.sqrt(wp.max(half_sum - half_gap, ZERO)) * lean

    scale = frame[0] * frame[2]
    tilt = oriented_volume(a, b, c) * scale / ratio
    upright = wp.sqrt(pressures[2] * needle_curvature(tilt)) / ratio
    normals = wp.matrix_from_rows(scale * wp.cross(b, c), scale * wp.cross(c, a), scale * wp.cross(a, b))
    others = wp.matrix_from_rows(wp.cross(a, axes[0]), wp.cross(b, axes[1]), wp.cross(c, axes[2]))
    first, second = column_weights(frame)
    modes = wp.spatial_matrixd()  # a row for every coordinate
    for i in range(3):
        along = cosine * first[i] + sine * second[i]
        across = cosine * second[i] - sine * first[i]
        for u in range(2):
            k = 2 * i + u
            axis = axes[i]
            if u == 1:
                axis = others[i]
            m11 = wp.dot(axis, u1) * along
            m12 = wp.dot(axis, u1) * across
            m21 = wp.dot(axis, u2) * along
            m22 = wp.dot(axis, u2) * across
            modes[k, 0] = of_twist * (m21 - m12)
            modes[k, 1] = of_flip * (m21 + m12)
            modes[k, 2] = of_stiff[0] * m11 + of_stiff[1] * m22
            modes[k, 3] = of_soft[0] * m22 - of_soft[1] * m11
            modes[k, 4] = upright * (wp.dot(axis, normals[i]) - tilt * (s2 * m11 + s1 * m22))
    for i in range(6):
        for j in range(i, 6):
            entry = ZERO
            for k in range(5):
                entry += modes[i, k] * modes[j, k]
            hessian[t, packed(i, j)] = share * entry


@wp.kernel
def triangle_hessian(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    pressures: wp.vec3d,
    divisor: wp.float64,
    flat: bool,
    # Data out:
    hessian: wp.array2d[wp.float64],
):
    """Compute the Hessian of A [fro / D + p0 D + p1 / D + p2 needle] in tangent bases, divided, shape [F, 21].

    Where corners are ``flat``, at height 1 over a plane, the axes of the plane stand in place of tangent bases.

    The energy depends on the singular values of the Jacobian alone, so that its second derivative by the Jacobian has
    known eigenvectors (Smith, De Goes, Kim: "Analytic eigensystems for isotropic distortion energies", 2019): twist,
    flip and two scalings. Negative eigenvalues are cut off, which makes the matrix positive semidefinite.
    """
    t, _compiled_once = wp.tid()
    a, b, c = corners_of(sphere, faces[t])
    axes = first_tangents(a, b, c)
    if flat:
        axis = wp.vec3d(ONE, ZERO, ZERO)
        axes = wp.matrix_from_rows(axis, axis, axis)
    distortion_hessian(t, frames[t], areas[t] / divisor, a, b, c, axes, pressures, hessian)


SPHERE_AREA = wp.constant(wp.float64(surface.SPHERE_AREA))  # of the unit sphere, 4π


@wp.kernel
def distortion_summands(
    ratio: wp.array[wp.float64],
    total: wp.array[wp.float64],
    # Data out:
    excess: wp.array[wp.float64],
    inverse: wp.array[wp.float64],
):
    """Compute r + 1/r - 2 without cancellation, r the area ratio scaled by the image's total area, and 1/ratio.

    Neither is multiplied by the areas yet.
    """
    t = wp.tid()
    scaled = SPHERE_AREA / total[0] * ratio[t]
    excess[t] = (scaled - ONE) * (scaled - ONE) / scaled
    inverse[t] = ONE / ratio[t]
