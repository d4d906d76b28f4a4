"""The energy of registration at vertices: squared differences between features that move and features that stay."""

import numpy as np

from omtwarp.location import Locator
from omtwarp.mesh.arrays import Floats, cross, dots
from omtwarp.mesh.surface import Surface
from omtwarp.registration.warp_shape import VertexDerivatives


class FeatureField:
    """Features on a triangulated sphere, read anywhere on it, with the exact gradients of what is read.

    Where the ray from the centre meets the flat triangle at p = Σ w_k v_k, a feature is Σ w_k (f_k + g_k (p - v_k) / 2)
    with f_k and g_k its values and gradients at the corners: continuous, exact for quadratic functions of p, and nearly
    as smooth as the feature, so that Newton's steps and line searches do not end at the edges of triangles.

    Args:
        grid: the sphere, N vertices.
        features: shape [N, K].
    """

    def __init__(self, grid: Surface, features: Floats):
        self._faces, self._features, self._points = grid.faces, features, grid.vertices
        self._locator = Locator(grid.vertices, grid.faces, device="cpu")
        weighted = _slopes(grid, features) * grid.face_areas[:, None, None]
        around = np.stack([grid.sum_to_vertices(column) for column in weighted.reshape(grid.face_count, -1).T], axis=1)
        self._gradients = (around / grid.sum_to_vertices(grid.face_areas)[:, None]).reshape(grid.vertex_count, 3, -1)

    def at(self, points: Floats) -> tuple[Floats, Floats]:
        """Return features, shape [P, K], and their gradients, [P, 3, K], at unit vectors, [P, 3]."""
        place = self._locator.find(points)
        corners, shares = self._faces[place.faces], place.coordinates
        places, slopes = self._points[corners], self._gradients[corners]
        flat = np.einsum("pk,pkd->pd", shares, places)
        halves = 0.5 * np.einsum("pkd,pkdc->pkc", flat[:, None] - places, slopes)
        at_corners = self._features[corners] + halves
        values = np.einsum("pk,pkc->pc", shares, at_corners)
        # w_k = n_k x / n x, n_k the cross product of the other corners, n their sum: its slope is (n_k - w_k n) / n x.
        mean = 0.5 * np.einsum("pk,pkdc->pdc", shares, slopes)
        factors = at_corners + np.einsum("pkd,pdc->pkc", places, mean)
        normals = np.stack([cross(places[:, k - 2], places[:, k - 1]) for k in range(3)], axis=1)
        whole = normals.sum(axis=1)
        change = np.einsum("pkd,pkc->pdc", normals, factors)
        change -= whole[:, :, None] * np.einsum("pk,pkc->pc", shares, factors)[:, None]
        return values, change / dots(whole, points)[:, None, None]


def _slopes(surface: Surface, values: Floats) -> Floats:
    """Return the gradients of functions at vertices, [N, K], that are linear in each triangle, shape [F, 3, K]."""
    corner = surface.vertices[surface.faces]
    normal = cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    square = dots(normal, normal)[:, None, None]
    across = [cross(normal, corner[:, k - 1] - corner[:, k - 2])[:, :, None] for k in range(3)]
    return np.asarray(sum(across[k] * values[surface.faces[:, k]][:, None, :] / square for k in range(3)))


class FeatureTerm:
    """Σ_k weight_k mean known(x) (t_k(x) - m_k)²: features m of what moves, the field t where its vertices x are.

    ``known`` is 1 unless the field has it as its last function, so that places where features are not known count for
    nothing. It is a :class:`omtwarp.registration.warp_shape.VertexTerm`. The Hessian is that of Gauss and Newton,
    without the curvature of the field.

    Args:
        moving: features of the vertices that move, shape [V, K].
        areas: what each counts, sum 1, shape [V].
        field: of the sphere that stays.
        weights: of the features, shape [K].
    """

    def __init__(self, moving: Floats, areas: Floats, field: FeatureField, weights: Floats):
        self._moving, self._areas, self._field, self._weights = moving, areas, field, weights

    def at(self, points: Floats) -> VertexDerivatives:
        """Return the term and its derivatives at a map, unit vectors, shape [V, 3]."""
        values, slopes = self._field.at(points)
        count = self._moving.shape[1]
        known = values[:, count:].sum(axis=1) if values.shape[1] > count else np.ones(len(points))
        apart, areas = values[:, :count] - self._moving, (self._areas * known)[:, None]
        squares = self._areas * (self._weights * apart**2).sum(axis=1)
        value = float(known @ squares)
        gradient = squares[:, None] * slopes[:, :, count:].sum(axis=2)
        slopes = slopes[:, :, :count]
        gradient += 2.0 * areas * np.einsum("vk,vdk->vd", self._weights * apart, slopes)
        hessian = 2.0 * areas[:, :, None] * np.einsum("vdk,vek->vde", self._weights * slopes, slopes)
        return VertexDerivatives(value, gradient, hessian)
