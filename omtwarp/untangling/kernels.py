"""Kernels of the untangling energy: value, gradient and a positive semidefinite Hessian of every triangle.

Per triangle of original area A, with fro = |J|² and D = det[s0, s1, s2] / (2 A) the signed area ratio, a smooth
polynomial of the three points,

    A [fro + λ (D² + 1)] / χ(D, ε)

(Garanzha, Kaporin, Kudryavtseva, Protais, Ray, Sokolov: "Foldover-free maps in 50 lines of code", 2021).

:mod:`omtwarp.refine.kernels` begins with the same columns of the Jacobian, from
:mod:`omtwarp.triangle_newton.triangle`; its D has no sign and its terms other derivatives, so that a common kernel
would be two behind a switch.
"""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import oriented_volume
from omtwarp.triangle_newton.newton_kernels import packed
from omtwarp.triangle_newton.triangle import (
    barrier,
    barrier_curvature,
    barrier_slope,
    first_column,
    first_tangent,
    first_weights,
    second_column,
    second_weights,
)

wp.set_module_options(KERNEL_OPTIONS)

FOUR = wp.constant(wp.float64(4.0))


@wp.func
def signed_ratio(frame: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    return oriented_volume(a, b, c) * frame[0] * frame[2]


@wp.func
def solid_angle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.float64:
    """Return the signed solid angle of a triangle (van Oosterom and Strackee 1983)."""
    return TWO * wp.atan2(oriented_volume(a, b, c), ONE + wp.dot(a, b) + wp.dot(b, c) + wp.dot(c, a))


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
    face = faces[t]
    a = sphere[face[0]]
    b = sphere[face[1]]
    c = sphere[face[2]]
    c1 = first_column(frames[t], a, b)
    c2 = second_column(frames[t], a, b, c)
    d = signed_ratio(frames[t], a, b, c)
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
    solid[t] = solid_angle(sphere[faces[t][0]], sphere[faces[t][1]], sphere[faces[t][2]])


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
    face = faces[t]
    frame = frames[t]
    a = sphere[face[0]]
    b = sphere[face[1]]
    c = sphere[face[2]]
    c1 = first_column(frame, a, b)
    c2 = second_column(frame, a, b, c)
    scale = frame[0] * frame[2]
    d = oriented_volume(a, b, c) * scale
    fro = wp.dot(c1, c1) + wp.dot(c2, c2)
    eps = epsilon[t]
    chi = barrier(d, eps)
    slope = barrier_slope(d, eps)
    curve = barrier_curvature(d, eps)
    top = fro + weight * (d * d + ONE)

    # Derivatives of f(J, D) = (|J|² + λ (D² + 1)) / χ(D); jointly convex in (J, D) once the two negative parts, of χ''
    # and of the second derivative of (D² + 1) / χ, are cut off. The curvature of D itself is left out.
    by_fro = ONE / chi
    by_det = TWO * weight * d / chi - top * slope / (chi * chi)
    mixed = -TWO * slope / (chi * chi)
    bowl = TWO / chi - FOUR * d * slope / (chi * chi)
    bowl += (d * d + ONE) * (TWO * slope * slope / (chi * chi * chi) - curve / (chi * chi))
    by_det_twice = TWO * fro * slope * slope / (chi * chi * chi) + weight * wp.max(bowl, ZERO)

    first = first_weights(frame)
    second = second_weights(frame)
    points = wp.matrix_from_rows(a, b, c)
    normals = wp.matrix_from_rows(scale * wp.cross(b, c), scale * wp.cross(c, a), scale * wp.cross(a, b))
    for i in range(3):
        yi = wp.vec3d(points[i, 0], points[i, 1], points[i, 2])
        ti = first_tangent(yi)
        ni = wp.vec3d(normals[i, 0], normals[i, 1], normals[i, 2])
        pull = first[i] * c1 + second[i] * c2
        for u in range(2):
            bi = ti
            if u == 1:
                bi = wp.cross(yi, ti)
            fi = wp.dot(bi, pull)
            di = wp.dot(bi, ni)
            gradient[t, 2 * i + u] = areas[t] * (TWO * by_fro * fi + by_det * di)
            for j in range(i, 3):
                yj = wp.vec3d(points[j, 0], points[j, 1], points[j, 2])
                tj = first_tangent(yj)
                nj = wp.vec3d(normals[j, 0], normals[j, 1], normals[j, 2])
                pull_j = first[j] * c1 + second[j] * c2
                for v in range(2):
                    bj = tj
                    if v == 1:
                        bj = wp.cross(yj, tj)
                    fj = wp.dot(bj, pull_j)
                    dj = wp.dot(bj, nj)
                    entry = TWO * by_fro * (first[i] * first[j] + second[i] * second[j]) * wp.dot(bi, bj)
                    entry += mixed * (fi * dj + di * fj) + by_det_twice * di * dj
                    if 2 * i + u <= 2 * j + v:
                        hessian[t, packed(2 * i + u, 2 * j + v)] = areas[t] * entry


@wp.kernel
def move_in_tangent(
    sphere: wp.array[wp.vec3d],
    step: wp.array2d[wp.float64],
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Move points by coordinates [V, 2] in their tangent bases, and project them to the sphere."""
    i = wp.tid()
    y = sphere[i]
    t = first_tangent(y)
    moved[i] = wp.normalize(y + step[i, 0] * t + step[i, 1] * wp.cross(y, t))
