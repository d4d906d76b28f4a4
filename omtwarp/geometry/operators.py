"""Discrete exterior calculus on closed triangle meshes (paper, section 3.2 and appendices A and B).

Every operator comes twice: as a SciPy sparse matrix, for one-off solves on the host, and as a Warp kernel behind
:class:`DifferentialOperators`, for what is applied at each step. The two agree to round-off.

Scalars live at vertices (primal 0-forms). Vector fields are constant in each triangle and live at its dual vertex, the
circumcentre, shape [F, 3]. Vectors are those of R^3; matrices order them as rows ``3 f + d``.

Misprints of the paper's appendix B, none of which affects its result:

* the two gradients before equation (21) are exchanged: the gradient of phi_B is normal to the edge b = AC, hence
  b^perp / (a sin(gamma)), and that of phi_C is c^perp / (a sin(beta)), as (21) itself uses them;
* in (24), first line, cot(gamma) cot(alpha) should read cot(gamma) cos(alpha).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.geometry.spherical import TINY
from omtwarp.mesh.arrays import Floats, cross, norms, real_numbers, whole_numbers
from omtwarp.mesh.surface import Surface

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def dual_flux_vector(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Return the sum of (dual length) x (unit edge) over the two edges leaving ``a``.

    Its product with a field is the outflow at ``a``. With l_c = (c / 2) cot(gamma) and l_b = (b / 2) cot(beta), the sum
    l_c c^ + l_b b^ of equation (23) is the edge ``bc`` turned by -90 degrees and halved. It is evaluated in that form:
    the cotangents of a sliver are huge and cancel, the turned edge is not.
    """
    n = wp.cross(b - a, c - a)
    return HALF * wp.cross(c - b, n / wp.max(wp.length(n), TINY))  # of no length where the triangle has no area


@wp.kernel
def vertex_divergence(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    field: wp.array[wp.vec3d],
    # Data out:
    flux_out: wp.array[wp.float64],
):
    i = wp.tid()
    flux = wp.float64(0.0)
    for n in range(corner_offsets[i], corner_offsets[i + 1]):
        f = corners[n] // 3
        s = corners[n] - 3 * f
        b = vertices[faces[f, (s + 1) % 3]]
        c = vertices[faces[f, (s + 2) % 3]]
        flux += wp.dot(dual_flux_vector(vertices[i], b, c), field[f])
    flux_out[i] = flux


@wp.kernel
def interpolate_at_vertices(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    corner_offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    field: wp.array[wp.vec3d],
    # Data out:
    interpolated_out: wp.array[wp.vec3d],
):
    i = wp.tid()
    total = wp.vec3d(ZERO, ZERO, ZERO)
    weights = wp.float64(0.0)
    a = vertices[i]
    for n in range(corner_offsets[i], corner_offsets[i + 1]):
        f = corners[n] // 3
        s = corners[n] - 3 * f
        p, q = vertices[faces[f, (s + 1) % 3]] - a, vertices[faces[f, (s + 2) % 3]] - a
        weight = wp.length(wp.cross(p, q)) / wp.max(wp.length_sq(p) * wp.length_sq(q), TINY)
        total += weight * field[f]
        weights += weight
    interpolated_out[i] = total * (ONE / wp.max(weights, TINY))


def _corner_points(vertices: ArrayLike, faces: ArrayLike) -> tuple[Floats, NDArray[np.int64], list[Floats]]:
    points = real_numbers(vertices, "vertices", (None, 3), finite=False)
    triangles = whole_numbers(faces, "faces", (None, 3), below=len(points))
    return points, triangles, list(points.take(triangles.T, axis=0))


def corner_cotangents(vertices: ArrayLike, faces: ArrayLike) -> Floats:
    """Return the cotangent of the angle at every corner, shape [F, 3]; negative where the angle is obtuse."""
    _, _, p = _corner_points(vertices, faces)
    doubled = np.maximum(norms(cross(p[1] - p[0], p[2] - p[0])), float(TINY))
    dots = [np.einsum("ij,ij->i", p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]) for k in range(3)]
    return np.stack(dots, axis=1) / doubled[:, None]


def circumcentric_coordinates(vertices: ArrayLike, faces: ArrayLike) -> Floats:
    """Return the barycentric coordinates of every triangle's circumcentre, its dual vertex, shape [F, 3].

    They sum to 1.

    A coordinate is negative where the angle at that corner is obtuse (the circumcentre is outside).
    """
    cotangents = corner_cotangents(vertices, faces)
    # The sum over pairs of cot cot is 1 in every triangle, so these add up to 1 without a division.
    return 0.5 * np.stack([cotangents[:, k] * (cotangents[:, k - 1] + cotangents[:, k - 2]) for k in range(3)], axis=1)


def cotangent_laplacian(
    vertices: ArrayLike, faces: ArrayLike, bounds: tuple[float, float] | None = None
) -> sparse.csr_matrix:
    """Return the matrix D of section 4.1: D_PQ = -(cot R + cot S) / 2, rows that sum to zero; [V, V], symmetric.

    Sign: positive semi-definite on every mesh, D = -div grad with the integrated divergence of equation 23; u · D u is
    the Dirichlet energy of u. Nothing is divided by areas: weak form.

    Args:
        vertices: positions, shape [V, 3].
        faces: triangles, shape [F, 3].
        bounds: the least and the largest cotangent that is taken as it is; all are by default.
    """
    points, triangles, _ = _corner_points(vertices, faces)
    cotangents = corner_cotangents(vertices, faces)
    half = 0.5 * (cotangents if bounds is None else np.clip(cotangents, *bounds))
    i, j = triangles[:, [1, 2, 0]].ravel(), triangles[:, [2, 0, 1]].ravel()
    size = len(points)
    weights = sparse.csr_matrix((half.ravel(), (i, j)), shape=(size, size))
    weights = sparse.csr_matrix(weights + weights.T)
    return sparse.csr_matrix(sparse.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights)


class DifferentialOperators:
    """The differential operators as Warp kernels, for a mesh kept on a device.

    Methods take NumPy or Warp arrays. NumPy in gives NumPy out; a Warp array must live on this device and gives a Warp
    array.

    Args:
        vertices: positions, shape [V, 3].
        faces: triangles, shape [F, 3], of a closed oriented mesh.
        device: ``auto``, ``cpu`` or ``cuda:N``.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, *, device: str = "auto"):
        surface = Surface(vertices, faces)
        self.device = resolve_device(device)
        self.vertex_count, self.face_count = surface.vertex_count, surface.face_count
        self.vertices = wp.array(surface.vertices, dtype=wp.vec3d, device=self.device)
        self.faces = wp.array(surface.faces, dtype=wp.int32, device=self.device)
        self._around = surface.on(self.device).vertex_corners

    def _run(self, kernel: wp.Kernel, field: ArrayLike | wp.array, dtype: type) -> wp.array:
        from_numpy = not isinstance(field, wp.array)
        if from_numpy:
            source = wp.array(real_numbers(field, "field", (self.face_count, 3)), dtype=wp.vec3d, device=self.device)
        out = wp.empty(self.vertex_count, dtype=dtype, device=self.device)
        inputs = [self.vertices, self.faces, *self._around, source if from_numpy else field]
        wp.launch(kernel, dim=len(out), inputs=inputs, outputs=[out], device=self.device)
        return out.numpy() if from_numpy else out

    def divergence(self, field: ArrayLike | wp.array) -> wp.array:
        """Return the outflow of each vertex's cell, [F, 3] -> [V]: equation 23 (appendix A.2)."""
        return self._run(vertex_divergence, field, wp.float64)

    def interpolate_dual(self, field: ArrayLike | wp.array) -> wp.array:
        """Interpolate vectors from dual vertices linearly to the primal ones, [F, 3] -> [V, 3] (Algorithm 1, line 7).

        The vertex lies in the polygon of the circumcentres around it, whose sides bisect the edges. Its Wachspress
        coordinates there are area(T) / (|e_ij|^2 |e_ik|^2), normalised: always positive, and exact on linear
        functions of a flat neighbourhood whether or not triangles are obtuse. The paper says "linear interpolation"
        and no more.
        """
        return self._run(interpolate_at_vertices, field, wp.vec3d)


def cotangent_edge_weights(surface: Surface, points: Floats) -> Floats:
    """Return the weight of every edge in the matrix D of section 4.1, (cot R + cot S) / 2, shape [E].

    Minus the entries of :func:`omtwarp.geometry.cotangent_laplacian` off the diagonal, in the order of
    :attr:`Surface.edges`.

    Args:
        surface: a closed surface.
        points: positions of its vertices, shape [V, 3].
    """
    one, other = corner_cotangents(points, surface.faces).take(surface.edge_corners.T)
    return np.asarray(0.5 * (one + other))
