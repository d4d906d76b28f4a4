"""A map to the sphere made smooth between its vertices, so that the lines of a texture have no corners at edges.

A map is known at the vertices of a mesh. If it is linear inside every triangle, the image of a circle has a
corner at every edge that it crosses. Here the map is cubic between the vertices, after Clough and Tocher: every
triangle is cut into three at its middle, with one cubic polynomial in each, and the derivative across an edge is the
same from both sides [1]_. The derivatives at the vertices are those for which the curves over all edges bend least
[2]_. The cubic map is taken at the points of a regular grid in every triangle, and linear between these.

A map that keeps the area around every vertex may oscillate from one vertex to the next, above all along limbs with few
vertices around them. A low-pass filter removes waves of two or three edges by moving the images of the vertices by a
fraction of an edge [3]_. The map itself does not change, only the texture coordinates.

Where a triangle of the grid would be flipped, the map is blended with the linear one as far as necessary, by a share
that changes linearly from vertex to vertex.

.. [1] P. Alfeld, "A trivariate Clough-Tocher scheme for tetrahedral data", Comput. Aided Geom. Design 1 (1984), with
   the two-dimensional scheme in section 2.
.. [2] G. Nielson, "A method for interpolating scattered data based upon a minimum norm network", Math. Comp. 40 (1983).
.. [3] G. Taubin, T. Zhang and G. Golub, "Optimal surface smoothing as filter design", ECCV (1996).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import cg

from omtwarp.flips.exact import flipped_faces
from omtwarp.geometry.operators import corner_cotangents
from omtwarp.location import combined
from omtwarp.mesh.arrays import Floats, Ints, marked, mean_edge_lengths, normalised, summed
from omtwarp.mesh.polygons import grid_shares, grid_triangles
from omtwarp.mesh.surface import unit_normals, vertex_normals
from omtwarp.mesh.validate import Topology

HALVINGS = 4  # of the difference from the linear map, before the map is linear there


@dataclass(frozen=True)
class SmoothMap:
    """A map of a mesh that is divided evenly, each triangle into n² parts.

    Attributes:
        parts: n, into how many parts every edge is divided.
        sphere: unit vectors of all points: the mesh's vertices first, then those on edges and inside, shape [N, 3].
        grid: the points of every triangle as :func:`omtwarp.mesh.polygons.grid_points` lists them, int32, shape [F, K].
        corners: vertices of the triangles, shape [F, 3].
        count: of the vertices, V.
    """

    parts: int
    sphere: Floats
    grid: Ints
    corners: Ints
    count: int

    @cached_property
    def weights(self) -> sparse.csr_matrix:
        """Return the sparse matrix of every point as a combination of vertices, shape [N, V].

        ``weights @ x`` carries over what is linear on triangles, such as the surface itself.
        """
        share = grid_shares(self.parts)
        place = np.zeros(len(self.sphere), dtype=np.int64)
        place[self.grid] = np.arange(self.grid.size).reshape(self.grid.shape)
        face, point = np.divmod(place[self.count :], len(share))
        added = combined(self.corners[face], share[point], self.count)
        return sparse.vstack([sparse.identity(self.count), added], format="csr")

    @property
    def faces(self) -> Ints:
        """The parts of all triangles, those of triangle f from f n² on, int32, shape [F n², 3]."""
        return self.grid[:, grid_triangles(self.parts)].reshape(-1, 3)


def smooth_map(vertices: Floats, faces: Ints, sphere: Floats, parts: int) -> SmoothMap:
    """Divide a mesh and its map, with new points where the smooth map has them.

    Args:
        vertices: the surface, shape [V, 3].
        faces: triangles; where they form no manifold, or have no area, the result is still a map.
        sphere: unit vectors, shape [V, 3].
        parts: into how many parts every edge is divided, 1 or more.

    Returns:
        The divided map. Its triangles are flipped only where the mesh's triangle that they are parts of is, or is so
        thin that rounding decides.

    Example:
        >>> from omtwarp.mesh import shapes
        >>> from omtwarp.texturing.smooth import smooth_map
        >>> ball = shapes.icosphere(1)
        >>> smooth_map(ball.vertices, ball.faces, ball.vertices, 3).sphere.shape
        (92, 3)
    """
    return smooth_curves(vertices, faces, sphere, filtered=parts > 1).divided(parts)


def smooth_curves(vertices: Floats, faces: Ints, sphere: Floats, *, filtered: bool = True) -> "SmoothCurves":
    """Return the curves that the smooth map has over the edges of a mesh, from which it is known everywhere.

    Args:
        vertices, faces, sphere: as in :func:`smooth_map`.
        filtered: whether waves of a few edges are taken out; False keeps the images of the vertices.
    """
    faces = np.asarray(faces, dtype=np.int32)
    topology = Topology(faces.astype(np.int64), len(vertices))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    places = (vertices - low) / max(float((high - low).max()), np.finfo(float).tiny)
    still = _without_waves(places, faces, sphere) if filtered else sphere
    towards = _edge_derivatives(places, faces, still, topology.edges)
    return SmoothCurves(places, faces, sphere, still, topology.edges, topology.face_edges, towards)


@dataclass(frozen=True)
class SmoothCurves:
    """A smooth map by its cubic curves over the edges of a mesh.

    Attributes:
        places: the surface, in a box of length one, shape [V, 3].
        faces: its triangles, shape [F, 3].
        given: the map at its vertices, shape [V, 3].
        sphere: the same, waves of a few edges taken out, shape [V, 3].
        ends: the vertices of every edge, the lower number first, shape [E, 2].
        edge_of: the edge from every corner of a triangle to the next, shape [F, 3].
        towards: derivatives at both ends of every edge, from the first to the second, shape [E, 2, 3].
    """

    places: Floats
    faces: Ints
    given: Floats
    sphere: Floats
    ends: NDArray[np.int64]
    edge_of: NDArray[np.int64]
    towards: Floats

    @cached_property
    def bend(self) -> Floats:
        """Return a bound on the angle by which the edges of every triangle leave straight ones, shape [F].

        With the derivatives' differences from the chord, a and b, the two differ by t (1 - t)² a - t² (1 - t) b.
        """
        apart = self.towards - (self.sphere[self.ends[:, 1]] - self.sphere[self.ends[:, 0]])[:, None]
        middle = normalised(self.sphere[self.ends].sum(axis=1))
        apart -= np.einsum("esj,ej->es", apart, middle)[..., None] * middle[:, None]
        largest: Floats = (4.0 / 27.0 * np.linalg.norm(apart, axis=2).sum(axis=1))[self.edge_of].max(axis=1)
        return largest

    def divided(self, parts: int, which: NDArray[np.int64] | None = None) -> SmoothMap:
        """Divide the triangles of the map: all of them, or some that are given by number."""
        if which is not None:
            kept = marked(len(self.ends), self.edge_of[which])
            edge_of = (np.cumsum(kept) - 1)[self.edge_of[which]]
            ends, towards = self.ends[kept], self.towards[kept]
            return replace(self, faces=self.faces[which], edge_of=edge_of, ends=ends, towards=towards).divided(parts)
        sphere, faces, ends, towards = self.sphere, self.faces, self.ends, self.towards
        share = grid_shares(parts)
        on_edge = np.isclose(share, 0.0)
        inner = np.flatnonzero(~on_edge.any(axis=1))
        count, steps = len(sphere), np.arange(1, parts)
        first_inner = count + len(ends) * (parts - 1)
        grid = np.empty((len(faces), len(share)), dtype=np.int32)
        grid[:, inner] = first_inner + np.arange(len(faces))[:, None] * len(inner) + np.arange(len(inner))
        for k in range(3):
            grid[:, np.flatnonzero(share[:, k] == 1.0)[0]] = faces[:, k]
            # Points between corners k and k + 1, in the order in which they follow from k.
            between = np.flatnonzero(on_edge[:, (k + 2) % 3] & (share.max(axis=1) < 1.0))
            between = between[np.argsort(share[between, (k + 1) % 3])]
            forward = (faces[:, k] == ends[self.edge_of[:, k], 0])[:, None]
            step = np.where(forward, steps - 1, parts - 1 - steps)
            grid[:, between] = count + self.edge_of[:, k, None] * (parts - 1) + step

        t = (steps / parts)[None, :, None]
        one, other = sphere[ends[:, 0], None], sphere[ends[:, 1], None]
        edge_line = (1.0 - t) * one + t * other
        edge_curve = (
            (1.0 - t) ** 3 * one
            + 3.0 * t * (1.0 - t) ** 2 * (one + towards[:, 0, None] / 3.0)
            + 3.0 * t**2 * (1.0 - t) * (other - towards[:, 1, None] / 3.0)
            + t**3 * other
        )
        inside_line = np.einsum("kc,fcj->fkj", share[inner], sphere[faces])
        inside_curve = self._inside(share[inner])
        lines = np.concatenate([edge_line.reshape(-1, 3), inside_line.reshape(-1, 3)])
        added = np.concatenate([edge_curve.reshape(-1, 3), inside_curve.reshape(-1, 3)]) - lines
        result = _without_flips(sphere, faces, lines, added, grid, share, parts)
        return SmoothMap(parts, result, grid, faces, count)

    def _inside(self, share: Floats) -> Floats:
        """Evaluate the cubic map in every triangle at points given by barycentric coordinates [K, 3].

        The result has the shape [F, K, 3].
        """
        corner, value = self.places[self.faces], self.sphere[self.faces]
        # Derivatives along the sides of each triangle: out[k] from corner k to the next, back[k] from k + 1 to k.
        forward = (self.faces == self.ends[self.edge_of, 0])[..., None]
        start, end = np.moveaxis(self.towards[self.edge_of], 2, 0)
        out, back = np.where(forward, start, -end), np.where(forward, -end, start)
        after, before = value + out / 3.0, np.roll(value, -1, axis=1) + back / 3.0
        # Control points next to the corners, on the lines from these to the middle.
        near = (value + after + np.roll(before, 1, axis=1)) / 3.0

        side = np.roll(corner, -1, axis=1) - corner
        square = np.maximum(np.einsum("fkj,fkj->fk", side, side), np.finfo(float).tiny)
        middle = corner.mean(axis=1, keepdims=True) - 0.5 * (corner + np.roll(corner, -1, axis=1))
        along = np.einsum("fkj,fkj->fk", middle, side) / square
        across = middle - along[..., None] * side
        height = np.maximum(np.linalg.norm(across, axis=2), np.finfo(float).tiny)
        # Derivative across each side, at its two ends, per unit of length and inwards, as this triangle has it.
        third = np.roll(corner, -2, axis=1) - corner
        along_third = np.einsum("fkj,fkj->fk", third, side) / square
        altitude = np.maximum(np.linalg.norm(third - along_third[..., None] * side, axis=2), np.finfo(float).tiny)
        at_start = np.roll(back, 1, axis=1) - along_third[..., None] * out
        at_end = np.roll(out, -1, axis=1) - (1.0 - along_third)[..., None] * back
        inwards = 0.5 * (at_start + at_end) / altitude[..., None]
        # The same from both triangles of an edge: the mean of the two, seen from each as inwards.
        sign = np.where(forward[..., 0], 1.0, -1.0)
        flat = self.edge_of.ravel()
        number = np.maximum(np.bincount(flat, minlength=len(self.ends)), 1)
        mean = summed((sign[..., None] * inwards).reshape(-1, 3), flat, len(self.ends)) / number[:, None]
        inwards = sign[..., None] * mean[self.edge_of]
        # Derivative from the middle of each side towards that of the triangle, and the control point that gives it.
        speed = 3.0 / 4.0 * (np.roll(value, -1, axis=1) + before - after - value)
        wanted = along[..., None] * speed + height[..., None] * inwards
        ahead = np.roll(near, -1, axis=1)
        outer = 0.5 * (value + after), 0.5 * (before + np.roll(value, -1, axis=1))
        crossing = 0.5 * (after + before) + 2.0 * (wanted / 3.0 - 0.25 * (near - outer[0]) - 0.25 * (ahead - outer[1]))
        # Side k lies between corners k and k + 1; two sides meet at each corner.
        inner = (near + crossing + np.roll(crossing, 1, axis=1)) / 3.0
        centre = inner.mean(axis=1)

        # Control points of the third at side k, in the order of the polynomials below.
        ends = value, after, before, np.roll(value, -1, axis=1)
        inside = near, crossing, ahead, inner, np.roll(inner, -1, axis=1)
        net = np.stack([*ends, *inside, np.broadcast_to(centre[:, None], value.shape)], axis=2)
        curve = np.empty((len(self.faces), len(share), 3))
        for index, part in enumerate(share):
            lone = int(np.argmin(part))  # the corner opposite to the side whose third the point lies in
            k, w = (lone + 1) % 3, 3.0 * part[lone]
            a, b = part[k] - part[lone], part[(k + 1) % 3] - part[lone]
            on_side = a**3, 3.0 * a * a * b, 3.0 * a * b * b, b**3
            off_side = 3.0 * a * a * w, 6.0 * a * b * w, 3.0 * b * b * w, 3.0 * a * w * w, 3.0 * b * w * w, w**3
            curve[:, index] = np.einsum("c,fcj->fj", [*on_side, *off_side], net[:, k])
        return curve


def _without_waves(places: Floats, faces: Ints, sphere: Floats) -> Floats:
    """Filter waves of a few edges' length out of the vertices' images without a new flip; unit vectors [V, 3]."""
    # The filter 1 / (1 + a x^p) of the eigenvalues x of the mesh's Laplacian, 0 to 2: a row of evenly spaced vertices
    # has x = 1 - cos(2 pi / w) for waves of w edges, on even triangles two thirds of that. Where x is 1 or more, a
    # tenth or less of a wave's amplitude remains; at x = 0.5 it is 0.86, and below 0.3 all of it.
    filter_strength, filter_power = 10.0, 6
    filter_degree = 24  # of the polynomial that approximates it to 0.0002
    low, high = 0.1, 5.0  # weights of edges are kept in these bounds, so that all are positive
    count = len(places)
    with np.errstate(over="ignore"):
        cotangents = np.clip(corner_cotangents(places, faces), low, high)
    weight = np.roll(cotangents, 1, axis=1).T.ravel()  # of the edges that begin at the first corners, then the second
    pairs = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).transpose(1, 0, 2).reshape(-1, 2)
    upper = sparse.csr_matrix((weight, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    both = upper + upper.T
    root = np.sqrt(np.maximum(np.asarray(both.sum(axis=1)).ravel(), np.finfo(float).tiny))
    mean = sparse.diags_array(1.0 / root) @ both @ sparse.diags_array(1.0 / root)  # 1 minus the Laplacian: -1 to 1
    nodes = np.polynomial.chebyshev.chebpts1(filter_degree + 1)
    kept_of = 1.0 / (1.0 + filter_strength * (1.0 - nodes) ** filter_power)
    series = np.polynomial.chebyshev.chebfit(nodes, kept_of, filter_degree)
    before, now = root[:, None] * sphere, mean @ (root[:, None] * sphere)
    total = series[0] * before + series[1] * now
    for coefficient in series[2:]:
        before, now = now, 2.0 * (mean @ now) - before
        total += coefficient * now
    filtered = normalised(total / root[:, None])

    edge = mean_edge_lengths(sphere, pairs)
    moved = filtered - sphere
    # In mean edges of a vertex on the sphere: its image is moved no farther.
    moved *= np.minimum(1.0, 0.3 * edge / np.maximum(np.linalg.norm(moved, axis=1), np.finfo(float).tiny))[:, None]
    kept, allowed = np.ones(count), flipped_faces(sphere, faces)
    for rounds in range(count):
        points = normalised(sphere + kept[:, None] * moved)
        touched = np.unique(faces[flipped_faces(points, faces) & ~allowed])
        touched = touched[kept[touched] > 0.0]
        if not len(touched):
            return points
        kept[touched] = 0.5 * kept[touched] if rounds < HALVINGS else 0.0
    return sphere


def _edge_derivatives(places: Floats, faces: Ints, sphere: Floats, ends: NDArray[np.int64]) -> Floats:
    """Return the derivatives along every edge at its two ends, from first to second, per whole edge, [E, 2, 3]."""
    count = len(places)
    first, second = _tangents(unit_normals(vertex_normals(places, faces)))
    edge = places[ends[:, 1]] - places[ends[:, 0]]
    length = np.maximum(np.linalg.norm(edge, axis=1), 1e-9)  # in extents: divisions by it do not overflow
    # Unit direction of the edge in the tangent plane of each end: the bending of the surface itself is left out.
    way = np.empty((len(ends), 2, 2))
    for side in range(2):
        flat = np.stack([np.einsum("ij,ij->i", edge, axes[ends[:, side]]) for axes in (first, second)], axis=1)
        size = np.linalg.norm(flat, axis=1, keepdims=True)
        # Of an edge's length: where its part in a vertex's tangent plane is shorter it has no direction there.
        way[:, side] = np.where(size > 1e-9 * length[:, None], normalised(flat), (1.0, 0.0))
    # What each edge is multiplied by, at either end: its direction there, in the columns of that vertex.
    columns = 2 * ends[:, :, None] + np.arange(2)
    at_start, at_end = (combined(columns[:, side], way[:, side], 2 * count) for side in range(2))
    over_length = sparse.diags_array(1.0 / length)
    both = at_start + at_end
    matrix = at_start.T @ over_length @ at_start + at_end.T @ over_length @ at_end + both.T @ over_length @ both
    right = both.T @ (3.0 * (sphere[ends[:, 1]] - sphere[ends[:, 0]]) / length[:, None] ** 2)
    # The system is as well conditioned as that of a spline: each step of the iteration gains a digit or so, and a line
    # moves by less than the relative residual times an edge. What no edge determines is 0.
    scale = sparse.diags_array(1.0 / np.maximum(matrix.diagonal(), np.finfo(float).tiny))
    slopes = np.column_stack([cg(matrix, one, rtol=1e-6, maxiter=200, M=scale)[0] for one in right.T])
    return np.stack([length[:, None] * (one @ slopes) for one in (at_start, at_end)], axis=1)


def _tangents(normals: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors at right angles to each unit normal, and to one another."""
    first = normalised(np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)]))
    return first, np.cross(normals, first)


def _without_flips(
    sphere: Floats, faces: Ints, lines: Floats, added: Floats, grid: Ints, share: Floats, parts: int
) -> Floats:
    """Return the points of the grid with as much of the curves as flips nothing.

    How much is a number at every vertex and linear between them. If each edge and triangle had its own, a triangle with
    less than its neighbours would flip these, and those the next: along a limb that the map stretches ten to one, the
    map would be linear in every third triangle where one in forty needs it.

    Args:
        sphere: the map at the vertices, shape [V, 3].
        faces: the triangles that are divided, shape [F, 3].
        lines: the grid's other points on the linear map, shape [N, 3].
        added: from these to the curves, shape [N, 3].
        grid: the points of every triangle, shape [F, K].
        share: their barycentric coordinates, shape [K, 3].
        parts: into how many parts every edge is divided.
    """
    kept = np.ones(len(sphere))
    triangles = grid_triangles(parts)
    points = np.concatenate([sphere, lines + added])
    sound = ~flipped_faces(sphere, faces)
    open_faces, rounds = np.flatnonzero(sound), 0
    while len(open_faces):
        corners = grid[open_faces][:, triangles].reshape(-1, 3)
        flipped = flipped_faces(points, corners).reshape(len(open_faces), -1).any(axis=1)
        touched = np.unique(faces[open_faces[flipped]])
        touched = touched[kept[touched] > 0.0]
        kept[touched] = 0.5 * kept[touched] if rounds < HALVINGS else 0.0
        around = np.flatnonzero(marked(len(sphere), touched)[faces].any(axis=1))
        number = grid[around] - len(sphere)
        new = number >= 0
        number, scale = number[new], (kept[faces[around]] @ share.T)[new]
        points[len(sphere) + number] = lines[number] + scale[:, None] * added[number]
        open_faces, rounds = around[sound[around]], rounds + 1
    points[len(sphere) :] /= np.linalg.norm(points[len(sphere) :], axis=1, keepdims=True)
    return points
