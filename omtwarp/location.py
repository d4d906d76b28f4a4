"""Where on a triangulated sphere a point lies: the triangle that holds it, and its barycentric coordinates there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from omtwarp.device.arrays import sent, triangles, vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ONE, THREE, ZERO, wp
from omtwarp.device.threads import Each, each, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.spherical import TINY
from omtwarp.mesh.arrays import Floats, Ints, normalised, real_numbers, whole_numbers

wp.set_module_options(KERNEL_OPTIONS)

# Boxes are kept in single precision, whose unit of roundoff at 1 is 6e-8: they are grown by more than what is lost.
BOX_MARGIN = wp.constant(wp.float64(1e-6))


@wp.func
def spherical_coordinates(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, p: wp.vec3d) -> wp.vec3d:
    """Return unnormalised barycentric coordinates of the point where the ray through ``p`` meets the triangle.

    The triple products are those of p, b, c and so on, with the corners seen from p: of a small triangle near p no
    digits are lost, and at a corner the coordinates of the other two are exactly zero.
    """
    pa, pb, pc = a - p, b - p, c - p
    return wp.vec3d(wp.dot(p, wp.cross(pb, pc)), wp.dot(p, wp.cross(pc, pa)), wp.dot(p, wp.cross(pa, pb)))


@wp.func
def spherical_barycentric(p: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Return the barycentric coordinates of the point where the ray through p meets the plane of a, b, c.

    They sum to one.
    """
    weights = spherical_coordinates(a, b, c, p)
    total = weights[0] + weights[1] + weights[2]
    if total <= ZERO:
        # The plane is behind the point: only the signs, which steer the walk, are kept.
        return weights
    return (ONE / total) * weights


@wp.func
def clamped(weights: wp.vec3d) -> wp.vec3d:
    """Set negative barycentric coordinates to zero and scale the sum to one, so that nothing is extrapolated."""
    inside = wp.vec3d(wp.max(weights[0], ZERO), wp.max(weights[1], ZERO), wp.max(weights[2], ZERO))
    total = wp.max(inside[0] + inside[1] + inside[2], TINY)
    return (ONE / total) * inside


@wp.func(inline=True)
def walk(
    p: wp.vec3d, start: int, points: wp.array[wp.vec3d], faces: wp.array[wp.vec3i], neighbours: wp.array[wp.vec3i]
):
    """Walk from a face to the face that holds p, across the edge that p lies furthest beyond; for moving points."""
    f = int(start)
    weights = wp.vec3d()
    for _ in range(2000):
        face = faces[f]
        weights = spherical_barycentric(p, points[face[0]], points[face[1]], points[face[2]])
        worst = int(wp.argmin(weights))
        # A few thousand units of roundoff outside is on the edge, so that a walk does not go back and forth across it.
        if weights[worst] >= -wp.float64(1e-12):
            break
        # Corner k is opposite to the edge between corners k + 1 and k + 2.
        f = neighbours[f][(worst + 1) % 3]
    return f, clamped(weights)


@wp.func
def single(v: wp.vec3d) -> wp.vec3:
    return wp.vec3(wp.float32(v[0]), wp.float32(v[1]), wp.float32(v[2]))


@wp.func
def reach(v: wp.float64) -> wp.vec3d:
    return wp.vec3d(v, v, v)


@wp.kernel
def box_polygons(
    corners: wp.array2d[wp.vec3d],
    # Data out:
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
):
    """Compute a box around every polygon of arcs, in single precision.

    No point of the flat polygon of diameter D is further than D / √3 from a corner (Jung 1901), so that none is nearer
    to the sphere's centre than √(1 - D² / 3): by what is left to 1 its arcs may bulge out of the flat one's box.
    """
    i = wp.tid()
    low = corners[i, 0]
    high = corners[i, 0]
    diameter = wp.float64(0.0)
    for k in range(4):
        low = wp.min(low, corners[i, k])
        high = wp.max(high, corners[i, k])
        for m in range(4):
            diameter = wp.max(diameter, wp.length_sq(corners[i, k] - corners[i, m]))
    margin = reach(ONE - wp.sqrt(wp.max(ONE - diameter / THREE, ZERO)) + BOX_MARGIN)
    lower[i] = single(low - margin)
    upper[i] = single(high + margin)


@wp.kernel
def find_faces(
    queries: wp.array[wp.vec3d],
    boxes: wp.uint64,
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    holding: wp.array[wp.int32],
    coordinates: wp.array[wp.vec3d],
):
    """Compute the triangle in which each point lies deepest (the first among equals), and its coordinates there.

    The triangle is -1 for none. Single precision only selects candidates; float64 decides.
    """
    i, _compiled_once = wp.tid()
    p = wp.normalize(queries[i])
    best = -LARGE
    best_face = int(-1)
    best_weights = wp.vec3d()
    margin = reach(BOX_MARGIN)
    query = wp.bvh_query_aabb(boxes, single(p - margin), single(p + margin))
    f = int(0)
    while wp.bvh_query_next(query, f):
        face = faces[f]
        weights = spherical_coordinates(points[face[0]], points[face[1]], points[face[2]], p)
        total = weights[0] + weights[1] + weights[2]
        if total > ZERO:
            inside = wp.min(weights) / total
            if inside > best or (inside == best and f < best_face):
                best = inside
                best_face = int(f)
                best_weights = weights / total
    holding[i] = best_face
    coordinates[i] = clamped(best_weights)


@wp.func
def closest_on_edge(a: wp.vec3d, b: wp.vec3d, p: wp.vec3d) -> wp.float64:
    """Return the place of the point nearest to p on the edge from a (0) to b (1)."""
    along = b - a
    return wp.clamp(wp.dot(p - a, along) / wp.max(wp.dot(along, along), TINY), ZERO, ONE)


@wp.func
def closest_on_triangle(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, p: wp.vec3d) -> wp.vec3d:
    """Return the barycentric coordinates of the point of a flat triangle that is nearest to p."""
    normal = wp.cross(b - a, c - a)
    size = wp.dot(normal, normal)
    if size > ZERO:
        w = wp.vec3d(
            wp.dot(wp.cross(c - b, p - b), normal),
            wp.dot(wp.cross(a - c, p - c), normal),
            wp.dot(wp.cross(b - a, p - a), normal),
        )
        if wp.min(w) >= ZERO:
            return w / (w[0] + w[1] + w[2])
    ab, bc, ca = closest_on_edge(a, b, p), closest_on_edge(b, c, p), closest_on_edge(c, a, p)
    best = wp.vec3d(ONE - ab, ab, ZERO)
    least = wp.length_sq(p - a - ab * (b - a))
    second = wp.length_sq(p - b - bc * (c - b))
    if second < least:
        least = second
        best = wp.vec3d(ZERO, ONE - bc, bc)
    if wp.length_sq(p - c - ca * (a - c)) < least:
        best = wp.vec3d(ca, ZERO, ONE - ca)
    return best


@wp.func
def distance_at(points: wp.array[wp.vec3d], face: wp.vec3i, weights: wp.vec3d, p: wp.vec3d) -> wp.float64:
    return wp.length(p - weights[0] * points[face[0]] - weights[1] * points[face[1]] - weights[2] * points[face[2]])


@wp.kernel
def find_closest(
    queries: wp.array[wp.vec3d],
    boxes: wp.uint64,
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data in and out:
    nearest: wp.array[wp.int32],
    coordinates: wp.array[wp.vec3d],
):
    """Compute the flat triangle nearest to each point, and the coordinates of its nearest point.

    The triangle that holds the point (``nearest`` and ``coordinates`` as inputs) bounds the search.
    """
    i, _compiled_once = wp.tid()
    best_face = nearest[i]
    if best_face < 0:
        return
    p = wp.normalize(queries[i])
    best_weights = coordinates[i]
    least = distance_at(points, faces[best_face], best_weights, p)
    margin = reach(least + BOX_MARGIN)
    query = wp.bvh_query_aabb(boxes, single(p - margin), single(p + margin))
    f = int(0)
    while wp.bvh_query_next(query, f):
        face = faces[f]
        weights = closest_on_triangle(points[face[0]], points[face[1]], points[face[2]], p)
        distance = distance_at(points, face, weights, p)
        if distance < least or (distance == least and f < best_face):
            least = distance
            best_face = int(f)
            best_weights = weights
    nearest[i] = best_face
    coordinates[i] = best_weights


def boxes_around(corners: Floats, device: wp.Device) -> tuple[wp.array, wp.array, wp.array]:
    """Return polygons of arcs on a device, of four corners each, with the lower and the upper ends of their boxes.

    Args:
        corners: unit vectors, shape [N, 4, 3]; a triangle repeats one.
        device: a Warp device.
    """
    polygons = sent(corners, wp.vec3d, device)
    lower, upper = (wp.empty(len(corners), dtype=wp.vec3, device=device) for _ in range(2))
    wp.launch(box_polygons, dim=len(corners), inputs=[polygons], outputs=[lower, upper], device=device)
    return polygons, lower, upper


def combined(vertices: NDArray[np.integer], shares: Floats, count: int) -> sparse.csr_matrix:
    """Return the matrix of points as combinations of vertices, shape [N, count].

    Args:
        vertices: that each point is a combination of, shape [N, K].
        shares: of these, shape [N, K].
        count: of all vertices.
    """
    rows = np.arange(0, vertices.size + 1, vertices.shape[1])
    return sparse.csr_matrix((shares.ravel(), vertices.ravel(), rows), shape=(len(vertices), count))


@dataclass(frozen=True)
class Found:
    """Triangles that hold points, and where in them the points lie.

    Attributes:
        faces: triangle of every point, int32, shape [P].
        coordinates: barycentric coordinates there, not negative, sum 1, float64, shape [P, 3].
    """

    faces: Ints
    coordinates: Floats

    def matrix(self, faces: Ints, vertex_count: int) -> sparse.csr_matrix:
        """Return the matrix of linear interpolation from the triangulation's vertices to the points, shape [P, V].

        Args:
            faces: the triangulation's, shape [F, 3].
            vertex_count: V.
        """
        matrix = combined(faces[self.faces], self.coordinates, vertex_count).sorted_indices()  # a copy
        matrix.eliminate_zeros()
        return matrix

    def on_sphere(self, faces: Ints, sphere: Floats) -> Floats:
        """Return where a map of the triangulation to the sphere takes the points, linearly, shape [P, 3].

        Args:
            faces: the triangulation's, shape [F, 3].
            sphere: the map, unit vectors, shape [V, 3].
        """
        return normalised(np.einsum("ij,ijk->ik", self.coordinates, sphere[faces[self.faces]]))


class Locator:
    """Finds where on a triangulated sphere points lie.

    A hierarchy of boxes in single precision selects candidate triangles, and barycentric coordinates in double
    precision decide. Unlike a walk from triangle to triangle, which can go in circles where the triangulation is not
    Delaunay, the search always ends, and triangles may be of any shape.

    Args:
        points: unit vectors, shape [V, 3].
        faces: corners counter-clockwise seen from outside, shape [F, 3]. Triangles that are turned over are never
            found; where a sphere is covered once in all, others lie over them.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Raises:
        OmtwarpError: no triangles, or arrays that are not those of a triangulation.
    """

    def __init__(self, points: ArrayLike, faces: ArrayLike, *, device: str | None = "auto") -> None:
        self.device = resolve_device(device)
        corners = real_numbers(points, "the points", (None, 3))
        faces = whole_numbers(faces, "the triangles", (None, 3), below=len(corners))
        self._points, self._faces = vectors(corners, self.device), triangles(faces, self.device)
        if len(self._faces) == 0:
            raise OmtwarpError("a sphere without triangles: nothing can be located on it")
        self._boxes = wp.Bvh(*boxes_around(corners[faces[:, [0, 1, 2, 2]]], self.device)[1:])

    def find(self, points: ArrayLike | wp.array) -> Found:
        """Return the triangle that holds each point, and where the ray from the centre through the point meets it.

        Args:
            points: of lengths from 1e-150 to 1e150, shape [P, 3]; or a Warp array of vec3d.

        Raises:
            OmtwarpError: a point lies in no triangle, as the triangulation does not cover the sphere or its length is
                none of these.
        """
        return self._search(points, closest=False)

    def find_closest(self, points: ArrayLike | wp.array) -> Found:
        """Return the flat triangle nearest to each point of the unit sphere, and where in it the nearest point lies.

        This is what Connectome Workbench interpolates with. It differs from :meth:`find` in the second order of the
        triangles' size, and is not continuous across their edges.

        Args:
            points: as for :meth:`find`.

        Raises:
            OmtwarpError: as for :meth:`find`.
        """
        return self._search(points, closest=True)

    def _search(self, points: ArrayLike | wp.array, closest: bool) -> Found:
        given = points if isinstance(points, wp.array) else real_numbers(points, "the points", (None, 3))
        queries = vectors(given, self.device)
        count = len(queries)
        triangles = wp.empty(count, dtype=wp.int32, device=self.device)
        coordinates = wp.empty(count, dtype=wp.vec3d, device=self.device)
        arguments = [Each(queries), self._boxes.id, self._points, self._faces], each(triangles, coordinates)
        if count:
            launch_parts(find_faces, count, *arguments, self.device)
            if closest:
                launch_parts(find_closest, count, *arguments, self.device)
        faces = triangles.numpy()
        if count and faces.min() < 0:
            missed = np.flatnonzero(faces < 0)
            raise OmtwarpError(
                f"{len(missed)} of {count} points lie in no triangle, first point {missed[0]}: the triangulation does "
                "not cover the sphere, or the point has no direction"
            )
        return Found(faces, coordinates.numpy().reshape(-1, 3))
