"""Kernels of untangling: the energy of every triangle with its derivatives, and all Newton steps of a small patch.

Per triangle of original area A, with fro = |J|² and D = det[s0, s1, s2] / (2 A) the signed area ratio, the energy is a
smooth polynomial of the three points,

    A [fro + λ (D² + 1)] / χ(D, ε)

(Garanzha, Kaporin, Kudryavtseva, Protais, Ray, Sokolov: "Foldover-free maps in 50 lines of code", 2021).

:mod:`omtwarp.refine.kernels` begins with the same columns of the Jacobian, from :mod:`omtwarp.solvers.triangle`; its D
has no sign and its terms other derivatives, so that a common kernel would be two behind a switch.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import corners_of, oriented_volume, solid_angle
from omtwarp.mesh import surface
from omtwarp.solvers.newton import packed
from omtwarp.solvers.patches import (
    SUFFICIENT_DECREASE,
    PatchMeshes,
    PatchScratch,
    find_descent,
    find_direction,
    longest_move,
)
from omtwarp.solvers.triangle import (
    barrier,
    barrier_curvature,
    barrier_slope,
    first_column,
    first_tangent,
    first_weights,
    in_tangent,
    second_column,
    second_weights,
)

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def signed_ratio(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    return oriented_volume(a, b, c) * frame[0] * frame[2]


@wp.func
def untangle_energy(
    frame: wp.vec3d, area: wp.float64, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, eps: wp.float64, weight: wp.float64
) -> wp.float64:
    c1 = first_column(frame, a, b)
    c2 = second_column(frame, a, b, c)
    d = signed_ratio(frame, a, b, c)
    fro = wp.dot(c1, c1) + wp.dot(c2, c2)
    return area * (fro + weight * (d * d + ONE)) / barrier(d, eps)


@wp.kernel
def untangle_value(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    epsilon: wp.array[wp.float64],
    weight: wp.float64,
    # Data out:
    value: wp.array[wp.float64],
    solid: wp.array[wp.float64],
):
    """Compute the energy of every triangle and its signed solid angle."""
    t = wp.tid()
    a, b, c = corners_of(sphere, faces[t])
    value[t] = untangle_energy(frames[t], areas[t], a, b, c, epsilon[t], weight)
    solid[t] = solid_angle(a, b, c)


@wp.kernel
def solid_angles(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    solid: wp.array[wp.float64],
):
    """Compute the signed solid angle of every triangle."""
    t = wp.tid()
    solid[t] = solid_angle(sphere[faces[t][0]], sphere[faces[t][1]], sphere[faces[t][2]])


# Unlike in triangle_hessian of refinement, which is built from eigenvectors, the area ratio is signed and the barrier a
# function of it: the two share only the columns of the Jacobian and the tangent bases.
@wp.func
def untangle_derivatives(
    t: int,
    frame: wp.vec3d,
    area: wp.float64,
    a: wp.vec3d,
    b: wp.vec3d,
    c: wp.vec3d,
    eps: wp.float64,
    weight: wp.float64,
    # Data out:
    gradient: wp.array2d[wp.float64],
    hessian: wp.array2d[wp.float64],
):
    """Compute row t of the gradient and the Hessian, as :func:`untangle_newton` describes them."""
    c1 = first_column(frame, a, b)
    c2 = second_column(frame, a, b, c)
    scale = frame[0] * frame[2]
    d = oriented_volume(a, b, c) * scale
    fro = wp.dot(c1, c1) + wp.dot(c2, c2)
    chi = barrier(d, eps)
    slope = barrier_slope(d, eps)
    curve = barrier_curvature(d, eps)
    top = fro + weight * (d * d + ONE)

    # Derivatives of f(J, D) = (|J|² + λ (D² + 1)) / χ(D); jointly convex in (J, D) once the two negative parts, of χ''
    # and of the second derivative of (D² + 1) / χ, are cut off. The curvature of D itself is left out.
    by_fro = ONE / chi
    by_det = TWO * weight * d / chi - top * slope / (chi * chi)
    mixed = -TWO * slope / (chi * chi)
    bowl = TWO / chi - wp.float64(4.0) * d * slope / (chi * chi)
    bowl += (d * d + ONE) * (TWO * slope * slope / (chi * chi * chi) - curve / (chi * chi))
    by_det_twice = TWO * fro * slope * slope / (chi * chi * chi) + weight * wp.max(bowl, ZERO)

    first = first_weights(frame)
    second = second_weights(frame)
    points = wp.matrix_from_rows(a, b, c)
    normals = wp.matrix_from_rows(scale * wp.cross(b, c), scale * wp.cross(c, a), scale * wp.cross(a, b))
    bases = wp.matrix(dtype=wp.float64, shape=(6, 3))
    by_columns = wp.matrix(dtype=wp.float64, shape=(6, 2))  # along bases: |J|² / 2, and D
    for i in range(3):
        yi = points[i]
        pull = first[i] * c1 + second[i] * c2
        basis = first_tangent(yi)
        for u in range(2):
            if u == 1:
                basis = wp.cross(yi, basis)
            k = 2 * i + u
            bases[k, 0] = basis[0]
            bases[k, 1] = basis[1]
            bases[k, 2] = basis[2]
            by_columns[k, 0] = wp.dot(basis, pull)
            by_columns[k, 1] = wp.dot(basis, normals[i])
            gradient[t, k] = area * (TWO * by_fro * by_columns[k, 0] + by_det * by_columns[k, 1])
    for k in range(6):
        i = k // 2
        fi = by_columns[k, 0]
        di = by_columns[k, 1]
        for m in range(k, 6):
            j = m // 2
            fj = by_columns[m, 0]
            dj = by_columns[m, 1]
            entry = TWO * by_fro * (first[i] * first[j] + second[i] * second[j]) * wp.dot(bases[k], bases[m])
            entry += mixed * (fi * dj + di * fj) + by_det_twice * di * dj
            hessian[t, packed(k, m)] = area * entry


@wp.kernel
def untangle_newton(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    frames: wp.array[wp.vec3d],
    areas: wp.array[wp.float64],
    epsilon: wp.array[wp.float64],
    weight: wp.float64,
    # Data out:
    gradient: wp.array2d[wp.float64],
    hessian: wp.array2d[wp.float64],
):
    """Compute gradient [F, 6] and Hessian [F, 21], see :func:`packed`, in the tangent bases of the three corners."""
    t, _compiled_once = wp.tid()
    a, b, c = corners_of(sphere, faces[t])
    untangle_derivatives(t, frames[t], areas[t], a, b, c, epsilon[t], weight, gradient, hessian)


@wp.kernel
def move_in_tangent(
    sphere: wp.array[wp.vec3d],
    step: wp.array2d[wp.float64],
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Move points by coordinates [V, 2] in their tangent bases, and project them to the sphere."""
    i = wp.tid()
    moved[i] = in_tangent(sphere[i], step[i, 0], step[i, 1])


SPHERE_AREA = wp.constant(wp.float64(surface.SPHERE_AREA))


@wp.struct
class Untangling:
    """Parameters of an attempt and of its steps: the numbers of :mod:`omtwarp.untangling.untangle`."""

    factor: wp.float64
    largest: wp.float64
    smallest: wp.float64
    weight: wp.float64
    damping: wp.float64
    settled_gain: wp.float64
    steps: wp.int32
    halvings: wp.int32
    most: wp.int32  # Newton steps of a patch


@wp.func
def sheets_of(p: int, patches: PatchMeshes, share: wp.float64, points: wp.array[wp.vec3d]) -> wp.float64:
    """Return how many whole spheres a patch covers besides its share."""
    covered = ZERO
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        covered += solid_angle(points[face[0]], points[face[1]], points[face[2]])
    return wp.rint(covered / SPHERE_AREA - share)


@wp.func
def is_tangled(p: int, patches: PatchMeshes, points: wp.array[wp.vec3d]) -> bool:
    """Return whether a triangle is flipped in floating point, which may be wrong for one that is nearly flat."""
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        face = patches.faces[t]
        if not oriented_volume(points[face[0]], points[face[1]], points[face[2]]) > ZERO:
            return True
    return False


@wp.func
def energy_of(
    p: int,
    patches: PatchMeshes,
    share: wp.float64,
    points: wp.array[wp.vec3d],
    eps: wp.float64,
    weight: wp.float64,
    sheets: wp.float64,
) -> wp.float64:
    """Return the energy of a patch; LARGE where it covers the sphere more often than ``sheets`` says."""
    if wp.abs(sheets_of(p, patches, share, points)) > wp.abs(sheets):
        return LARGE
    energy = ZERO
    for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
        a, b, c = corners_of(points, patches.faces[t])
        energy += untangle_energy(patches.frames[t], patches.areas[t], a, b, c, eps, weight)
    return energy


@wp.kernel
def untangle_small_patches(
    group: wp.array[wp.int32],
    patches: PatchMeshes,
    shares: wp.array[wp.float64],
    given: Untangling,
    # Data in and out:
    points: wp.array[wp.vec3d],
    tried: wp.array[wp.vec3d],
    scratch: PatchScratch,
    # Data out:
    taken: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
):
    """Lower ε until no triangle of the patch is flipped, with some Newton steps for every value.

    ``shares`` are the parts of the sphere that patches have to cover, shape [count]; ``taken`` and ``rounds`` count
    Newton steps and values of ε.
    """
    thread, _compiled_once = wp.tid()
    p = group[thread]
    begin = patches.matrix.starts[p]
    end = patches.matrix.starts[p + 1]
    share = shares[p]
    eps = given.largest
    sheets = sheets_of(p, patches, share, points)
    steps = int(0)
    done = int(0)
    going = bool(True)
    while going:
        done += 1
        left = int(given.steps)
        while left > 0:
            left -= 1
            steps += 1
            for t in range(patches.face_starts[p], patches.face_starts[p + 1]):
                a, b, c = corners_of(points, patches.faces[t])
                frame = patches.frames[t]
                area = patches.areas[t]
                untangle_derivatives(t, frame, area, a, b, c, eps, given.weight, scratch.gradient, scratch.blocks)
            slope = find_direction(p, patches, given.damping, scratch)
            if not wp.isfinite(slope):
                slope = find_descent(p, patches, scratch)
            energy = energy_of(p, patches, share, points, eps, given.weight, sheets)
            if -slope <= given.settled_gain * energy or steps >= given.most:
                left = int(0)
            length = ZERO
            if slope < ZERO:
                # No vertex moves farther than a radian: beyond that its tangent plane does not approximate the sphere.
                length = ONE / wp.max(ONE, longest_move(p, patches, scratch))
            trials = int(given.halvings)
            while trials > 0 and length > ZERO:
                trials -= 1
                for i in range(begin, end):
                    x0 = length * scratch.direction[2 * i]
                    x1 = length * scratch.direction[2 * i + 1]
                    tried[i] = in_tangent(points[i], x0, x1)
                after = energy_of(p, patches, share, tried, eps, given.weight, sheets)
                if after <= energy + SUFFICIENT_DECREASE * length * slope:
                    for i in range(begin, end):
                        points[i] = tried[i]
                    length = ZERO
                else:
                    length = HALF * length
        sheets = sheets_of(p, patches, share, points)
        going = is_tangled(p, patches, points) or sheets != ZERO
        if not eps > given.smallest or steps >= given.most:
            going = bool(False)
        eps = wp.max(eps * given.factor, given.smallest)
    taken[p] = steps
    rounds[p] = done
