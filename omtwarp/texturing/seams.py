"""Texture coordinates from a map to the sphere, without distorted triangles at poles or visible seams.

One pair of texture coordinates per mesh vertex cannot describe a sphere: longitude jumps, a pole has every longitude,
and the six charts of a cube do not meet. So the mesh is cut along the borders of the charts (exactly: triangles that
cross a border are divided there), the poles become vertices, and where the picture's coordinates are too far from
linear over a triangle (always next to a pole) the triangle is divided until the error is a fraction of a texel.

A map to the sphere is linear inside every triangle before normalisation to unit length: the point with
barycentric coordinates b lies in the direction of ``b0 s0 + b1 s1 + b2 s2``. The point before normalisation is called
the chord point here. Every vertex that is added is a fixed combination of the vertices of **one** original triangle,
the same one for the surface and for the chord points; so neither the surface nor the map changes, and because edges are
split (never faces alone) both triangles of an edge always agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from omtwarp.location import combined
from omtwarp.mesh.arrays import ROUND_OFF, Floats, Ints, cross, edge_keys, marked, normalised, norms
from omtwarp.mesh.polygons import cut_at_middles
from omtwarp.texturing.atlas import ON_CUT, Arc, Atlas

# Corners, edge midpoints and the centroid, where the linear coordinates are compared with the exact ones.
PROBES = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [1 / 3, 1 / 3, 1 / 3]])


@dataclass
class Unwrapped:
    """A mesh whose faces are divided along the charts of an atlas, with texture coordinates at their corners.

    The first V vertices are the original ones in their order; the vertices made by cuts follow.

    Attributes:
        faces: int32, shape [M, 3].
        uv: of the corners, float64, shape [M, 3, 2], v up.
        sphere: unit vectors in the frame of the map (not turned), shape [N, 3].
        source_face: the original face that each face is a part of, shape [M].
        chart: chart of each face, shape [M].
        weights: sparse, shape [N, V]: each vertex as a combination of original ones; ``weights @ x`` carries any
            quantity from the original vertices to all.
    """

    faces: Ints
    uv: Floats
    sphere: Floats
    source_face: Ints
    chart: Ints
    weights: sparse.csr_matrix


def unwrap(sphere: Floats, faces: Ints, atlas: Atlas, *, rotation: Floats | None = None) -> Unwrapped:
    """Cut a spherical mesh along the borders of an atlas and give every corner its texture coordinates.

    Args:
        sphere: the map, unit vectors, shape [V, 3].
        faces: shape [F, 3].
        atlas: where the charts are.
        rotation: turns the texture on the sphere, shape [3, 3].

    Returns:
        The cut mesh, in which linear texture coordinates give the map's direction to a third of a texel. Its
        surface and its map are the same as before, to round-off.
    """
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    sphere = np.asarray(sphere, dtype=np.float64)
    mesh = CutMesh(sphere @ turn if rotation is not None else sphere, faces)
    for corner in atlas.corners:
        mesh.insert(np.asarray(corner) / np.linalg.norm(corner))
    for arc in atlas.arcs:
        mesh.cut(arc)
    _refine(mesh, atlas)
    chart = _face_charts(mesh, atlas)
    uv, directions = atlas.corner_uv(mesh.points[mesh.faces], chart), normalised(mesh.points) @ turn.T
    return Unwrapped(mesh.faces, uv, directions, mesh.source_face, chart, mesh.weights)


def shares_of_corners(cut: Unwrapped, faces: Ints) -> Floats:
    """Return the corners of parts of faces, shape [F, 3], as combinations of these faces' corners, shape [M, 3, 3]."""
    rows, whole = cut.faces.ravel(), faces[np.repeat(cut.source_face, 3)]
    return np.stack([np.asarray(cut.weights[rows, column]).ravel() for column in whole.T], axis=1).reshape(-1, 3, 3)


def _face_charts(mesh: "CutMesh", atlas: Atlas, which: NDArray | slice = slice(None)) -> Ints:
    return atlas.charts(mesh.points[mesh.faces[which]].sum(axis=1))


def _refine(mesh: "CutMesh", atlas: Atlas) -> None:
    """Divide triangles until texture coordinates are linear over each to within a third of a texel."""
    # Faces that are added to four times the mesh's, at most: room for coarse meshes, while a folded or collapsed map is
    # not refined without end.
    limit = 4 * len(mesh.faces) + 100_000
    fresh = np.ones(len(mesh.faces), dtype=bool)
    for _ in range(24):  # passes at the most
        which = np.flatnonzero(fresh)
        points = mesh.points[mesh.faces[which]]
        chart = _face_charts(mesh, atlas, which)
        uv = atlas.corner_uv(points, chart)
        error = np.empty((len(which), len(PROBES)))
        for k, bary in enumerate(PROBES):
            got = atlas.uv_directions(np.einsum("k,fkj->fj", bary, uv), chart)
            error[:, k] = norms(got - normalised(np.einsum("k,fkj->fj", bary, points)))
        bad = error > atlas.texel_angle / 3.0
        edges = bad[:, :3]
        directions = normalised(points)
        # Longest edge, radians: above this the probes could miss how far from linear the coordinates are
        edges |= norms(directions - np.roll(directions, -1, axis=1)) > 0.25
        # Only the middle is wrong: the longest edge is divided.
        long = norms(points - np.roll(points, -1, axis=1))
        alone = bad[:, 3] & ~edges.any(axis=1)
        edges[alone, np.argmax(long[alone], axis=1)] = True
        face, corner = np.nonzero(edges)
        if len(face) == 0 or len(mesh.faces) > limit:
            return
        fresh = mesh.split_half_edges(which[face], corner, np.full(len(face), 0.5))


class CutMesh:
    """A spherical mesh under cutting.

    Attributes:
        points: chord points, float64, shape [N, 3]; the original vertices come first, in their order.
        faces: int32, shape [M, 3], orientation kept.
        source_face: the original face that every face is a part of, int32, shape [M].
        weights: sparse, shape [N, V]: every vertex as a combination of original ones (at most three, of one face).
    """

    def __init__(self, sphere: Floats, faces: Ints):
        self.points: Floats = np.array(sphere, dtype=np.float64)
        self.faces: Ints = np.array(faces, dtype=np.int32)
        self.source_face: Ints = np.arange(len(faces), dtype=np.int32)
        self.weights = sparse.identity(len(sphere), dtype=np.float64, format="csr")

    def _add_vertices(self, combination: sparse.csr_matrix) -> int:
        first = len(self.points)
        self.points = np.concatenate([self.points, combination @ self.points])
        self.weights = sparse.vstack([self.weights, combination @ self.weights], format="csr")
        return first

    def split_half_edges(self, face: NDArray, corner: NDArray, fraction: NDArray) -> NDArray[np.bool_]:
        """Split edges at given fractions, in every face that has them.

        Args:
            face, corner: half-edges (corner, corner + 1) to split, shape [K]; both halves of an edge may be named, and
                naming one is enough: the other face is found.
            fraction: where, from the half-edge's tail (0) to its head (1), shape [K]. Of several for one edge the one
                that comes first counts.

        Returns:
            Which of the new faces were not there before, bool, shape [M].
        """
        count = len(self.points)
        halves = self.faces[face[:, None], (corner[:, None] + [0, 1]) % 3]
        keys, first = np.unique(edge_keys(halves, count), return_index=True)
        if len(keys) == 0:
            return np.zeros(len(self.faces), dtype=bool)
        ends = np.sort(halves[first], axis=1)
        t = np.where(halves[first, 0] == ends[:, 0], fraction[first], 1.0 - fraction[first])
        start = self._add_vertices(combined(ends, np.stack([1.0 - t, t], axis=1), count))

        # A face with such an edge has two of their ends at least: most faces are set aside by that.
        met = np.flatnonzero(marked(len(self.points), ends)[self.faces] @ np.ones(3, dtype=np.int8) >= 2)
        wanted = edge_keys(self.faces[met][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), count).reshape(-1, 3)
        position = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        middle = np.where(keys[position] == wanted, start + position, -1)
        split = (middle >= 0).any(axis=1)
        cut, whole = met[split], ~marked(len(self.faces), met[split])
        parts, origin = cut_at_middles(self.faces[cut], middle[split], self.points)
        faces = np.concatenate([self.faces[whole], parts])
        source = np.concatenate([self.source_face[whole], self.source_face[cut[origin]]])
        return self._set_faces(faces, source, np.arange(len(faces)) >= np.count_nonzero(whole))

    def _set_faces(self, faces: NDArray, source: NDArray, fresh: NDArray[np.bool_]) -> NDArray[np.bool_]:
        order = np.argsort(source, kind="stable")  # parts of a face stay where the face was
        self.faces, self.source_face = faces[order].astype(np.int32), source[order].astype(np.int32)
        return fresh[order]

    def insert(self, direction: Sequence[float]) -> None:
        """Make a direction a vertex: a vertex that is there already, a point of an edge, or a point inside a face.

        Where the map is folded, several faces contain the direction; every one of them gets its vertex.
        """
        d = np.asarray(direction, dtype=np.float64)
        along = self.points @ d
        ahead = self.points[along > 0]
        if np.any(norms(cross(ahead, d)) <= ON_CUT * norms(ahead)):
            return
        bary = np.zeros((len(self.faces), 3))
        inside = np.zeros(len(self.faces), dtype=bool)
        # The triangle is sought near the direction first, and among all only where triangles are huge.
        # Near, cosine of the angle around a direction in which its triangle is looked for first: 26 degrees
        near = (along > 0.9)[self.faces] @ np.ones(3, dtype=np.int8) > 0
        for which in (np.flatnonzero(near), np.flatnonzero(~near)):
            p0, p1, p2 = (self.points[self.faces[which, k]] for k in range(3))
            normals = cross(p1, p2), cross(p2, p0), cross(p0, p1)
            share = np.stack([n @ d for n in normals], axis=1)
            share *= np.sign(np.einsum("ij,ij->i", p0, normals[0]))[:, None]
            total = share.sum(axis=1)
            holds = (total > 0) & np.all(share >= -ROUND_OFF * np.abs(total)[:, None], axis=1)
            bary[which[holds]] = share[holds] / total[holds, None]
            inside[which[holds]] = True
            if holds.any():
                break
        # Barycentric: a point nearer to an edge divides the edge, as parts of a triangle beside it would have no area.
        on_edge = inside & (bary.min(axis=1) < 1e-10)
        edge_faces = self.faces[on_edge]
        interior = np.flatnonzero(inside & ~on_edge)
        if len(interior):
            combination = combined(self.faces[interior], bary[interior], len(self.points))
            new = self._add_vertices(combination) + np.arange(len(interior))
            v0, v1, v2 = self.faces[interior].T
            fan = [np.stack(t, axis=1) for t in ((v0, v1, new), (v1, v2, new), (v2, v0, new))]
            keep = ~marked(len(self.faces), interior)
            faces = np.concatenate([self.faces[keep], *fan])
            source = np.concatenate([self.source_face[keep], *([self.source_face[interior]] * 3)])
            self._set_faces(faces, source, np.zeros(len(faces), dtype=bool))
        if len(edge_faces):  # the half-edges are found again by their vertices: the faces may have moved
            ends = (np.argmin(bary[on_edge], axis=1)[:, None] + np.arange(1, 3)) % 3
            tail, head = np.take_along_axis(edge_faces, ends, axis=1).T
            of_tail, of_head = np.take_along_axis(bary[on_edge], ends, axis=1).T
            fraction = of_head / (of_head + of_tail)
            for k in range(len(edge_faces)):  # one or two, more only where the map is folded
                face, corner = np.nonzero((self.faces == tail[k]) & (np.roll(self.faces, -1, axis=1) == head[k]))
                self.split_half_edges(face, corner, np.full(len(face), fraction[k]))

    def cut(self, arc: Arc) -> None:
        """Split every edge that crosses an arc, exactly where it does."""
        height = self.points @ np.asarray(arc.normal, dtype=np.float64)
        height[np.abs(height) <= ON_CUT * norms(self.points)] = 0.0
        side = np.sign(height).astype(np.int8)[self.faces]
        face, corner = np.nonzero(side * np.roll(side, -1, axis=1) < 0)
        tail, head = self.faces[face, corner], self.faces[face, (corner + 1) % 3]
        forward = tail < head  # one formula per edge, not one per side: both faces get the same bits
        low, high = np.where(forward, tail, head), np.where(forward, head, tail)
        t = height[low] / (height[low] - height[high])
        crossing = (1.0 - t)[:, None] * self.points[low] + t[:, None] * self.points[high]
        active = np.ones(len(face), dtype=bool)
        for h in arc.half_spaces:
            active &= crossing @ np.asarray(h, dtype=np.float64) > 0
        t = np.where(forward, t, 1.0 - t)
        self.split_half_edges(face[active], corner[active], t[active])
