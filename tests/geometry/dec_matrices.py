"""Operators of the discrete exterior calculus as matrices, which the package's kernels are compared with."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from omtwarp.geometry import circumcentric_coordinates, corner_cotangents
from omtwarp.geometry.operators import _corner_points
from omtwarp.mesh.arrays import TINY, Floats


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> Floats:
    """Return the unit normal of every triangle, shape [F, 3], outward where faces run counter-clockwise.

    It is zero for a triangle without area.
    """
    _, _, (a, b, c) = _corner_points(vertices, faces)
    n = np.cross(b - a, c - a)
    return n / np.maximum(np.linalg.norm(n, axis=1), TINY)[:, None]


def rotation_matrix(vertices: np.ndarray, faces: np.ndarray) -> sparse.csr_matrix:
    """Return J, the turn by +90 degrees about each outward normal, as a matrix [3F, 3F] (section 2.3, equation 10)."""
    n = face_normals(vertices, faces)
    zero = np.zeros(len(n))
    blocks = np.stack([zero, -n[:, 2], n[:, 1], n[:, 2], zero, -n[:, 0], -n[:, 1], n[:, 0], zero], axis=1)
    base = 3 * np.arange(len(n))[:, None]
    rows, columns = base + np.repeat(np.arange(3), 3), base + np.tile(np.arange(3), 3)
    size = 3 * len(n)
    return sparse.csr_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size))


def rotate(field: np.ndarray, normals: np.ndarray) -> Floats:
    """Apply J to vectors: turn each by +90 degrees about its unit normal, n × v, shape [n, 3].

    On the sphere the normal at x is x itself, so J v = x × v (section 2.5).
    """
    return np.cross(np.asarray(normals, dtype=np.float64), np.asarray(field, dtype=np.float64))


def dual_edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> Floats:
    """Return the signed length of each dual edge inside each triangle, shape [F, 3] (appendix B, before equation 24).

    Column ``k`` belongs to the edge opposite corner ``k``: l_c = (c / 2) cot(gamma), the distance from the edge to the
    circumcentre. It is negative where the opposite angle is obtuse and the circumcentre lies beyond the edge; the
    sign is what keeps the identities of appendix B true for obtuse triangles (the paper writes the length |T ∩
    e^perp| unsigned in appendix A.2, which holds for acute triangles only).
    """
    _, _, p = _corner_points(vertices, faces)
    lengths = np.stack([np.linalg.norm(p[(k + 2) % 3] - p[(k + 1) % 3], axis=1) for k in range(3)], axis=1)
    return 0.5 * lengths * corner_cotangents(vertices, faces)


def circumcentres(vertices: np.ndarray, faces: np.ndarray) -> Floats:
    """Return the circumcentre of every triangle, in its plane, shape [F, 3].

    They are the vertices of the dual mesh (section 4.3).
    """
    _, _, p = _corner_points(vertices, faces)
    weights = circumcentric_coordinates(vertices, faces)
    return sum((weights[:, k, None] * p[k] for k in range(3)), np.zeros_like(p[0]))


def _hat_gradients(vertices: np.ndarray, faces: np.ndarray) -> Floats:
    """Return the gradients of the three hat functions of each triangle, shape [F, 3 corners, 3]."""
    _, _, p = _corner_points(vertices, faces)
    n = np.cross(p[1] - p[0], p[2] - p[0])
    squared = np.maximum(np.einsum("ij,ij->i", n, n), TINY)[:, None]
    return np.stack([np.cross(n, p[k - 1] - p[k - 2]) / squared for k in range(3)], axis=1)


def gradient_matrix(vertices: np.ndarray, faces: np.ndarray) -> sparse.csr_matrix:
    """Return the matrix [3F, V] of gradients of functions at vertices, constant in each triangle (A.1, equation 19).

    The gradient of a hat function is normal to the opposite edge and has length 1 / height. Exact on functions that are
    linear in space (their tangential part). Rows ``3 f + d`` hold component ``d`` in triangle ``f``.
    """
    points, triangles, _ = _corner_points(vertices, faces)
    hats = _hat_gradients(vertices, faces)
    count = len(triangles)
    rows = (3 * np.arange(count)[:, None, None] + np.arange(3)[None, None, :]).repeat(3, axis=1)
    columns = np.broadcast_to(triangles[:, :, None], (count, 3, 3))
    return sparse.csr_matrix((hats.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, len(points)))


def divergence_matrix(
    vertices: np.ndarray, faces: np.ndarray, *, integrated: bool = True, areas: np.ndarray | None = None
) -> sparse.csr_matrix:
    """Return the divergence at vertices of a field constant in each triangle, as a matrix [V, 3F] (appendix A.2).

    Outflow through the boundary of the Voronoi cell: the sum over edges and their two triangles of
    V(T) · e^ |T ∩ e^perp|, with the signed dual lengths of :func:`dual_edge_lengths`. In one triangle the two terms
    at a corner add up to the opposite edge turned by -90 degrees and halved (equation 23 with the circumcentre's
    properties); the matrix holds that sum, whose round-off does not grow with cotangents that cancel. It is minus the
    transpose of the gradient weighted by triangle areas.

    Args:
        vertices: positions, shape [V, 3].
        faces: triangles, shape [F, 3].
        integrated: give the outflow of each cell (a 2-form, the default); else divide by ``areas``, as in the paper.
        areas: cell areas, shape [V], where it is not integrated.
    """
    points, triangles, p = _corner_points(vertices, faces)
    normals = face_normals(vertices, faces)
    turned = np.stack([0.5 * np.cross(p[k - 1] - p[k - 2], normals) for k in range(3)], axis=1)
    count = len(triangles)
    columns = (3 * np.arange(count)[:, None, None] + np.arange(3)[None, None, :]).repeat(3, axis=1)
    rows = np.broadcast_to(triangles[:, :, None], (count, 3, 3))
    matrix = sparse.csr_matrix((turned.ravel(), (rows.ravel(), columns.ravel())), shape=(len(points), 3 * count))
    if integrated:
        return matrix
    return sparse.csr_matrix(sparse.diags(1.0 / np.asarray(areas, dtype=np.float64)) @ matrix)
