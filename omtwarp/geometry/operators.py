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

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.geometry import kernels
from omtwarp.mesh.arrays import TINY
from omtwarp.mesh.surface import Surface

Array = NDArray[np.float64]


def _corner_points(vertices: ArrayLike, faces: ArrayLike) -> tuple[Array, NDArray[np.int64], list[Array]]:
    points = np.asarray(vertices, dtype=np.float64)
    triangles = np.asarray(faces, dtype=np.int64)
    if points.ndim != 2 or points.shape[1] != 3 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise OmtwarpError(f"expected vertices [V, 3] and faces [F, 3], got {points.shape} and {triangles.shape}")
    return points, triangles, [points[triangles[:, k]] for k in range(3)]


def face_normals(vertices: ArrayLike, faces: ArrayLike) -> Array:
    """Return the unit normal of every triangle, shape [F, 3], outward where faces run counter-clockwise.

    It is zero for a triangle without area.
    """
    _, _, (a, b, c) = _corner_points(vertices, faces)
    n = np.cross(b - a, c - a)
    return n / np.maximum(np.linalg.norm(n, axis=1), TINY)[:, None]


def corner_cotangents(vertices: ArrayLike, faces: ArrayLike) -> Array:
    """Return the cotangent of the angle at every corner, shape [F, 3]; negative where the angle is obtuse."""
    _, _, p = _corner_points(vertices, faces)
    doubled = np.maximum(np.linalg.norm(np.cross(p[1] - p[0], p[2] - p[0]), axis=1), TINY)
    dots = [np.einsum("ij,ij->i", p[(k + 1) % 3] - p[k], p[(k + 2) % 3] - p[k]) for k in range(3)]
    return np.stack(dots, axis=1) / doubled[:, None]


def voronoi_areas(vertices: ArrayLike, faces: ArrayLike) -> Array:
    """Return the circumcentric (Voronoi) cell area A_i of every vertex, shape [V] (appendix A.2).

    The sum is the surface's area. Each triangle gives (|e_ij|^2 cot(k) + |e_ik|^2 cot(j)) / 8. Departure: areas are
    signed. In an obtuse triangle the circumcentre is outside and the cells at its acute corners get negative shares, so
    a vertex of a badly shaped mesh can have an area that is zero or negative; the sum, and the identities, stay exact.
    Divide by :attr:`Surface.vertex_areas` (thirds) where a positive area is needed.
    """
    points, triangles, p = _corner_points(vertices, faces)
    cotangents = corner_cotangents(vertices, faces)
    areas = np.zeros(len(points))
    squared = [np.einsum("ij,ij->i", e, e) for e in (p[2] - p[1], p[0] - p[2], p[1] - p[0])]
    share = 0.125 * np.stack([squared[k] * cotangents[:, k] for k in range(3)], axis=1)
    for k in range(3):  # corner k owns shares of its two edges, which lie opposite the other two corners
        areas += np.bincount(triangles[:, k], weights=share[:, k - 1] + share[:, k - 2], minlength=len(points))
    return areas


def circumcentric_coordinates(vertices: ArrayLike, faces: ArrayLike) -> Array:
    """Return the barycentric coordinates of every triangle's circumcentre, its dual vertex, shape [F, 3].

    They sum to 1.

    A coordinate is negative where the angle at that corner is obtuse (the circumcentre is outside).
    """
    cotangents = corner_cotangents(vertices, faces)
    # The sum over pairs of cot cot is 1 in every triangle, so these add up to 1 without a division.
    return 0.5 * np.stack([cotangents[:, k] * (cotangents[:, k - 1] + cotangents[:, k - 2]) for k in range(3)], axis=1)


def rotation_matrix(vertices: ArrayLike, faces: ArrayLike) -> sparse.csr_matrix:
    """Return J, the turn by +90 degrees about each outward normal, as a matrix [3F, 3F] (section 2.3, equation 10)."""
    n = face_normals(vertices, faces)
    zero = np.zeros(len(n))
    blocks = np.stack([zero, -n[:, 2], n[:, 1], n[:, 2], zero, -n[:, 0], -n[:, 1], n[:, 0], zero], axis=1)
    base = 3 * np.arange(len(n))[:, None]
    rows, columns = base + np.repeat(np.arange(3), 3), base + np.tile(np.arange(3), 3)
    size = 3 * len(n)
    return sparse.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))


def rotate(field: ArrayLike, normals: ArrayLike) -> Array:
    """Apply J to vectors: turn each by +90 degrees about its unit normal, n × v, shape [n, 3].

    On the sphere the normal at x is x itself, so J v = x × v (section 2.5).
    """
    return np.cross(np.asarray(normals, dtype=np.float64), np.asarray(field, dtype=np.float64))


def cotangent_laplacian(vertices: ArrayLike, faces: ArrayLike) -> sparse.csr_matrix:
    """Return the matrix D of section 4.1: D_PQ = -(cot R + cot S) / 2, rows that sum to zero; [V, V], symmetric.

    Sign: positive semi-definite on every mesh, D = -div grad with the integrated divergence of equation 23; u · D u is
    the Dirichlet energy of u. Nothing is divided by areas: weak form.

    Args:
        vertices: positions, shape [V, 3].
        faces: triangles, shape [F, 3].
    """
    points, triangles, _ = _corner_points(vertices, faces)
    half = 0.5 * corner_cotangents(vertices, faces)
    i, j = triangles[:, [1, 2, 0]].ravel(), triangles[:, [2, 0, 1]].ravel()
    size = len(points)
    weights = sparse.csr_matrix((half.ravel(), (i, j)), shape=(size, size))
    weights = sparse.csr_matrix(weights + weights.T)
    diagonal = np.asarray(weights.sum(axis=1)).ravel()
    return sparse.csr_matrix(sparse.diags(diagonal) - weights)


class DifferentialOperators:
    """The differential operators as Warp kernels, for a mesh kept on a device.

    Methods take NumPy or Warp arrays. NumPy in gives NumPy out; a Warp array must live on this device and gives a Warp
    array (``out`` may be given to write into).

    Args:
        vertices: positions, shape [V, 3].
        faces: triangles, shape [F, 3], of a closed oriented mesh.
        device: ``auto``, ``cpu`` or ``cuda:N``.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike, *, device: str = "auto"):
        surface = Surface(vertices, faces)
        self.device = resolve_device(device)
        self.vertex_count, self.face_count = surface.vertex_count, surface.face_count
        offsets, corners = surface.vertex_corners
        self.vertices = wp.array(surface.vertices, dtype=wp.vec3d, device=self.device)
        self.faces = wp.array(surface.faces, dtype=wp.int32, device=self.device)
        self.corner_offsets = wp.array(offsets, dtype=wp.int32, device=self.device)
        self.corners = wp.array(corners, dtype=wp.int32, device=self.device)

    def _run(
        self,
        kernel: wp.Kernel,
        at_faces: bool,
        value: ArrayLike | wp.array | None,
        in_dtype: type | None,
        out_dtype: type,
        out: wp.array | None,
        gather: bool,
    ) -> wp.array:
        from_numpy = value is not None and not isinstance(value, wp.array)
        source = (
            wp.array(np.asarray(value, dtype=np.float64), dtype=in_dtype, device=self.device) if from_numpy else value
        )
        size = self.face_count if at_faces else self.vertex_count
        if out is None:
            out = wp.empty(size, dtype=out_dtype, device=self.device)
        rows = [self.corner_offsets, self.corners] if gather else []
        inputs = [self.vertices, self.faces, *rows, *([] if source is None else [source])]
        wp.launch(kernel, dim=size, inputs=inputs, outputs=[out], device=self.device)
        return out.numpy() if from_numpy else out

    def gradient(self, values: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Return the gradient in each triangle, [V] -> [F, 3]: equation 19 (appendix A.1)."""
        return self._run(kernels.face_gradients, True, values, wp.float64, wp.vec3d, out, False)

    def rotate(self, field: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Apply J, a turn by +90 degrees, in each triangle, [F, 3] -> [F, 3]: :func:`rotation_matrix` (equation 10)."""
        return self._run(kernels.rotate_in_faces, True, field, wp.vec3d, wp.vec3d, out, False)

    def divergence(self, field: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Return the outflow of each vertex's cell, [F, 3] -> [V]: equation 23 (appendix A.2)."""
        return self._run(kernels.vertex_divergence, False, field, wp.vec3d, wp.float64, out, True)

    def laplacian(self, values: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Apply :func:`cotangent_laplacian`, [V] -> [V] (section 4.1's D; positive semi-definite)."""
        return self._run(kernels.vertex_laplacian, False, values, wp.float64, wp.float64, out, True)

    def interpolate_dual(self, field: ArrayLike | wp.array, out: wp.array | None = None) -> wp.array:
        """Interpolate vectors from dual vertices linearly to the primal ones, [F, 3] -> [V, 3] (Algorithm 1, line 7).

        The vertex lies in the polygon of the circumcentres around it, whose sides bisect the edges. Its Wachspress
        coordinates there are area(T) / (|e_ij|^2 |e_ik|^2), normalised: always positive, and exact on linear
        functions of a flat neighbourhood whether or not triangles are obtuse. The paper says "linear interpolation"
        and no more.
        """
        return self._run(kernels.interpolate_at_vertices, False, field, wp.vec3d, wp.vec3d, out, True)

    def voronoi_areas(self) -> wp.array:
        """Compute :func:`voronoi_areas` by a kernel, as a Warp array [V]."""
        return self._run(kernels.vertex_voronoi_areas, False, None, None, wp.float64, None, True)


def cotangent_edge_weights(surface: Surface, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weight of every edge in the matrix D of section 4.1, (cot R + cot S) / 2, shape [E].

    Minus the entries of :func:`omtwarp.geometry.cotangent_laplacian` off the diagonal, in the order of
    :attr:`Surface.edges`.

    Args:
        surface: a closed surface.
        points: positions of its vertices, shape [V, 3].
    """
    mesh = surface.on("cpu")
    weights = wp.empty(len(mesh.edge_corners), dtype=wp.float64, device="cpu")
    inputs = [vectors(points, weights.device), mesh.faces, mesh.edge_corners]
    wp.launch(kernels.edge_weights_of_corners, dim=weights.size, inputs=inputs, outputs=[weights], device="cpu")
    return weights.numpy()
