"""Kernels of untangling: the energy of every triangle with its derivatives.

Per triangle of original area A, with fro = |J|² and D = det[s0, s1, s2] / (2 A) the signed area ratio, the energy is a
smooth polynomial of the three points,

    A [fro + λ (D² + 1)] / χ(D, ε)

(Garanzha, Kaporin, Kudryavtseva, Protais, Ray, Sokolov: "Foldover-free maps in 50 lines of code", 2021).

:mod:`omtwarp.optimal.shape_kernels` begins with the same columns of the Jacobian, from
:mod:`omtwarp.solvers.triangle`; its D has no sign and its terms other derivatives, so that a common kernel would be two
behind a switch.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import corners_of, oriented_volume, solid_angle
from omtwarp.solvers.newton import packed
from omtwarp.solvers.triangle import barrier, column_weights, columns, first_tangent, in_tangent

wp.set_module_options(KERNEL_OPTIONS)


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
    c1, c2 = columns(frames[t], a, b, c)
    d = oriented_volume(a, b, c) * frames[t][0] * frames[t][2]
    fro = wp.dot(c1, c1) + wp.dot(c2, c2)
    value[t] = areas[t] * (fro + weight * (d * d + ONE)) / barrier(d, epsilon[t])
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
    a, b, c = corners_of(sphere, faces[t])
    solid[t] = solid_angle(a, b, c)


# Unlike in triangle_hessian of refinement, which is built from eigenvectors, the area ratio is signed and the barrier a
# function of it: the two share only the columns of the Jacobian and the tangent bases.
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
    frame = frames[t]
    area = areas[t]
    eps = epsilon[t]
    c1, c2 = columns(frame, a, b, c)
    scale = frame[0] * frame[2]
    d = oriented_volume(a, b, c) * scale
    fro = wp.dot(c1, c1) + wp.dot(c2, c2)
    chi = barrier(d, eps)
    square = d * d + eps * eps
    slope = chi / wp.sqrt(square)
    curve = HALF * eps * eps / (square * wp.sqrt(square))
    top = fro + weight * (d * d + ONE)

    # Derivatives of f(J, D) = (|J|² + λ (D² + 1)) / χ(D); jointly convex in (J, D) once the two negative parts, of χ''
    # and of the second derivative of (D² + 1) / χ, are cut off. The curvature of D itself is left out.
    by_fro = ONE / chi
    by_det = TWO * weight * d / chi - top * slope / (chi * chi)
    mixed = -TWO * slope / (chi * chi)
    bowl = TWO / chi - wp.float64(4.0) * d * slope / (chi * chi)
    bowl += (d * d + ONE) * (TWO * slope * slope / (chi * chi * chi) - curve / (chi * chi))
    by_det_twice = TWO * fro * slope * slope / (chi * chi * chi) + weight * wp.max(bowl, ZERO)

    first, second = column_weights(frame)
    points = wp.matrix_from_rows(a, b, c)
    normals = wp.matrix_from_rows(scale * wp.cross(b, c), scale * wp.cross(c, a), scale * wp.cross(a, b))
    bases = wp.matrix(dtype=wp.float64, shape=(6, 3))
    by_columns = wp.matrix(dtype=wp.float64, shape=(6, 2))  # along bases: |J|² / 2, and D
    for i in range(3):
        pull = first[i] * c1 + second[i] * c2
        basis = first_tangent(points[i])
        for u in range(2):
            if u == 1:
                basis = wp.cross(points[i], basis)
            k = 2 * i + u
            bases[k] = basis
            by_columns[k] = wp.vec2d(wp.dot(basis, pull), wp.dot(basis, normals[i]))
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
def move_in_tangent(
    sphere: wp.array[wp.vec3d],
    step: wp.array2d[wp.float64],
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Move points by coordinates [V, 2] in their tangent bases, and project them to the sphere."""
    i = wp.tid()
    moved[i] = in_tangent(sphere[i], step[i, 0], step[i, 1])
