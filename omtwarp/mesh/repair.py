"""Repair a mesh without new vertices, and record what was done and where vertices and faces came from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import validate
from omtwarp.mesh.arrays import TINY, WELD, Floats, InOneLine, cross, edge_keys, marked, mean_edge_lengths, norms
from omtwarp.mesh.origins import Derived
from omtwarp.mesh.validate import MeshLike, Topology, check, components_of, number

LARGEST_HOLE = 64
"""Holes with more edges than this are left open: their filling would be arbitrary."""

NOTED_LOSS = 0.01  # share of the area above which the repair says how much of it is gone


@dataclass(frozen=True, eq=False, repr=False)
class Repaired(InOneLine, Derived):
    """A repaired mesh, with what its vertices and faces are in the input; faces that fill holes are new.

    Attributes:
        vertices: float64, shape [V, 3].
        faces: int64, shape [F, 3].
        actions: what was done, in words and in order; empty if nothing was changed.
        loss: share of the input's area that is gone; where more than :data:`NOTED_LOSS`, the last action says it.
    """

    actions: list[str]
    loss: float


def repair(mesh: MeshLike | ArrayLike, faces: ArrayLike | None = None, *, whole: bool = True) -> Repaired:
    """Repair the defects that need no new shape; no vertex is moved but to one that it is merged with.

    In this order: faces with impossible vertices are dropped; vertices on the boundary or at faces of zero area are
    merged with equal ones, and with those nearer than a thousandth of the edges there; faces of zero area and
    duplicates are dropped or flipped away; where more than two faces meet in an edge, those connected to the surface
    by it alone are dropped, or else all of them; a vertex in which the surface touches itself is split; faces are
    turned to agree; unused vertices are dropped. A mesh without defects is returned unchanged. A repaired mesh can
    still have defects, which :func:`omtwarp.mesh.validate.check` lists.

    Of a surface that is to be whole the largest component is kept, holes of at most :data:`LARGEST_HOLE` edges are
    filled, and the surface is turned outward; another keeps its holes, and its parts of more than eight faces.

    Args:
        mesh: what :func:`omtwarp.read_mesh` returns, a ``trimesh.Trimesh``, ``(vertices, faces)``, or vertices alone,
            shape [V, 3].
        faces: with vertices alone the vertex indices, shape [F, 3].
        whole: whether the surface is to be closed and of one part.

    Returns:
        The mesh, what was done, and where its vertices and faces come from.

    Raises:
        OmtwarpError: the arrays are not those of a triangle mesh, or its faces count from another number than 0, so
            that a repair would scramble the surface.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.icosphere(2)
        >>> repaired = omtwarp.repair((surface.vertices, surface.faces[1:]))
        >>> omtwarp.check(repaired)
        []
    """
    points, triangles = validate.as_arrays(*validate.mesh_arrays(mesh, faces))
    work = _Work(points, triangles)
    if check(points, triangles):
        _require_counted_from_zero(triangles, len(points))
        steps = [
            work.drop_impossible_faces, work.merge_coincident_vertices, work.drop_repeated_faces, work.flip_flat_faces,
            work.drop_fins, work.split_touching_vertices,
            work.keep_largest_component if whole else work.drop_crumbs,
            work.turn_to_agree, *([work.fill_holes, work.turn_outward] if whole else []),
        ]  # fmt: skip
        for step in steps:
            if len(work.faces):
                step()
        work.drop_unused_vertices()
        work.measure_loss(points, triangles)
    origins = work.vertex_origin, work.face_origin
    return Repaired(*origins, work.points, work.faces, work.actions, work.loss, given=len(points))


def _require_counted_from_zero(faces: NDArray[np.int64], count: int) -> None:
    """Refuse faces whose numbers are all one too high or one too low, as of files that count otherwise.

    Raises:
        OmtwarpError: the faces count from 1, or from -1 as those of an OBJ that counts from 0 are read.
    """
    if not faces.size:
        return
    low, high = int(faces.min()), int(faces.max())
    if (low, high) in ((1, count), (-1, count - 2)):
        raise OmtwarpError(
            f"faces are numbered from {low} to {high} in a mesh of {count} vertices, which are numbered from 0 to "
            f"{count - 1}: all are one too {'high' if low > 0 else 'low'}, and dropping some would scramble the surface"
        )


class _Work:
    """A mesh under repair; every method repairs one kind of defect and notes what it did."""

    def __init__(self, points: Floats, faces: NDArray[np.int64]):
        self.points, self.faces = points, faces.copy()
        self.vertex_origin, self.face_origin = np.arange(len(points)), np.arange(len(faces))
        self.actions: list[str] = []
        self.loss = 0.0
        self.repeated = np.zeros(len(faces), dtype=bool)  # faces of the input that another one covers

    def keep(self, faces: NDArray[np.bool_], words: str) -> None:
        """Keep some faces and say how many others were dropped."""
        dropped = int((~faces).sum())
        if dropped:
            self.faces, self.face_origin = self.faces[faces], self.face_origin[faces]
            self.actions.append(f"dropped {number(dropped, 'face')} {words}")

    def drop_impossible_faces(self) -> None:
        known = (self.faces >= 0) & (self.faces < len(self.points))
        self.keep(np.all(known, axis=1), "with a vertex index out of range")
        self.keep(np.all(np.isfinite(self.points[self.faces]), axis=(1, 2)), "with NaN or infinite coordinates")

    def _unit(self) -> Floats:
        """Return the points that faces have, in the unit of their extent, and zeros for the others, shape [V, 3]."""
        used, unit = np.unique(self.faces), np.zeros_like(self.points)
        unit[used] = validate.unit_coordinates(self.points[used])
        return unit

    def merge_coincident_vertices(self) -> None:
        """Merge vertices at one place where that can repair a defect; elsewhere two may share a position."""
        topology = Topology(self.faces, len(self.points))
        candidate, unit = topology.on_boundary, self._unit()
        candidate[self.faces[validate.zero_area_faces(unit, self.faces)]] = True
        among = np.flatnonzero(candidate)
        if not len(among):
            return
        target = np.arange(len(self.points))
        target[among] = among[_first_at_place(unit, topology.edges, among)]
        merged = np.flatnonzero(target != np.arange(len(target)))
        if len(merged):
            self.faces = target[self.faces]
            near = bool((self.points[merged] != self.points[target[merged]]).any())
            other = f"one nearer than {WELD:g} of the edges there" if near else "an equal one"
            self.actions.append(f"merged {number(len(merged), 'vertex', 'vertices')} with {other}")

    def drop_repeated_faces(self) -> None:
        self.keep((self.faces != np.roll(self.faces, -1, axis=1)).all(axis=1), "with a repeated vertex")
        again = validate.duplicate_faces(self.faces, len(self.points))
        if again.any():
            # A face on top of a valid mesh is dropped alone. Two faces that form a flap, without which no edge would
            # lack a face, are both dropped.
            before = validate.duplicate_faces(self.faces[::-1], len(self.points))[::-1]
            topology = Topology(self.faces, len(self.points))
            flap = (again ^ before) & (topology.edge_face_count[topology.face_edges] % 2 == 0).all(axis=1)
            self.repeated[self.face_origin[again | flap]] = True
            self.keep(~(again | flap), "that were there twice")

    def flip_flat_faces(self) -> None:
        """Flip the longest edge of every triangle without area, so that the neighbour is split at the vertex on it."""
        flipped = 0
        # Rounds of exchanged edges, so that they end: each round repairs one triangle of every row of flat ones.
        for _ in range(1000):
            unit = self._unit()
            flat = np.flatnonzero(validate.zero_area_faces(unit, self.faces))
            if not any(self._flip(unit, int(face)) for face in flat):
                break
            flipped += 1
        if flipped:
            self.actions.append(f"flipped the longest edge of {number(flipped, 'face')} of zero area")

    def _flip(self, unit: Floats, face: int) -> bool:
        corners = unit[self.faces[face]]
        k = int(np.argmax(norms(np.roll(corners, -1, axis=0) - corners)))
        a, b, c = (int(self.faces[face, (k + j) % 3]) for j in range(3))
        beside = np.flatnonzero((self.faces == a).any(axis=1) & (self.faces == b).any(axis=1))
        if len(beside) != 2:
            return False
        other = int(beside[beside != face][0])
        d = int(self.faces[other].sum()) - a - b
        row = self.faces[other].tolist()
        if row[(row.index(b) + 1) % 3] != a or ((self.faces == c).any(axis=1) & (self.faces == d).any(axis=1)).any():
            return False
        self.faces[face], self.faces[other] = (c, d, b), (c, a, d)
        return True

    def keep_largest_component(self) -> None:
        pieces, labels = Topology(self.faces, len(self.points)).components
        if pieces > 1:
            self.keep(labels == np.argmax(np.bincount(labels)), f"in {number(pieces - 1, 'smaller component')}")

    def drop_fins(self) -> None:
        """Drop faces that only an edge of more than two faces connects to the surface; or else all at the edge."""
        fins = others = 0
        while len(self.faces):
            topology = Topology(self.faces, len(self.points))
            counts = topology.edge_face_count[topology.face_edges]
            crowded = (counts > 2).any(axis=1)
            if not crowded.any():
                break
            hanging = crowded & (counts == 1).any(axis=1)
            gone = hanging if hanging.any() else crowded
            fins, others = fins + int(hanging.sum()), others + int((gone & ~hanging).sum())
            self.faces, self.face_origin = self.faces[~gone], self.face_origin[~gone]
        if fins:
            self.actions.append(f"dropped {number(fins, 'face')} that hung by an edge of two others")
        if others:
            self.actions.append(f"dropped {number(others, 'face')} at edges of more than two")

    def drop_crumbs(self) -> None:
        # Parts of at most so many faces are dropped from a surface that may have several: artefacts of scanners.
        crumbs = 8
        _, labels = Topology(self.faces, len(self.points)).components
        sizes = np.bincount(labels)
        self.keep((sizes[labels] > crumbs) | (sizes[labels] == sizes.max()), "in tiny components")

    def split_touching_vertices(self) -> None:
        """Give every fan of faces around a vertex a vertex of its own."""
        topology = Topology(self.faces, len(self.points))
        _, first, fan = np.unique(topology.fan_of_corner, return_index=True, return_inverse=True)
        owner = self.faces.ravel()[first]  # the vertex of every fan, which the first of its fans keeps
        order = np.argsort(owner, kind="stable")
        more = order[1:][owner[order[1:]] == owner[order[:-1]]]
        if not len(more):
            return
        copies = owner[more]
        owner[more] = len(self.points) + np.arange(len(more))
        self.faces = owner[fan].reshape(-1, 3)
        self.points = np.concatenate([self.points, self.points[copies]])
        self.vertex_origin = np.concatenate([self.vertex_origin, self.vertex_origin[copies]])
        several = number(len(np.unique(copies)), "vertex", "vertices")
        self.actions.append(f"split {several} where the surface touches itself")

    def turn_to_agree(self) -> None:
        topology = Topology(self.faces, len(self.points))
        orientable, turn = topology.orientation
        if orientable and turn.any():
            _, labels = topology.components
            turn = turn ^ (np.bincount(labels, turn)[labels] > 0.5 * np.bincount(labels)[labels])  # the fewer of a part
            self.faces[turn] = self.faces[turn][:, ::-1]
            self.actions.append(f"turned {number(turn.sum(), 'face')} to agree with the others")

    def fill_holes(self) -> None:
        """Fill one hole after the other where that keeps the surface manifold."""
        topology = Topology(self.faces, len(self.points))
        lone = topology.edge_face_count == 1
        if not lone.any() or topology.clashing_edges.any():
            return
        half = np.stack([self.faces.ravel(), np.roll(self.faces, -1, axis=1).ravel()], axis=1)
        boundary = np.isin(edge_keys(half, len(self.points)), edge_keys(topology.edges[lone], len(self.points)))
        known = set(map(tuple, topology.edges.tolist()))
        # A face without neighbours would be closed by itself, turned over.
        alone = set(map(frozenset, self.faces[boundary.reshape(-1, 3).all(axis=1)].tolist()))
        filled, faces_added = 0, 0
        for loop in _loops(half[boundary]):
            patch = _patch(self.points, loop, known) if len(loop) <= LARGEST_HOLE else None
            if patch is None or frozenset(loop) in alone:
                continue
            known.update((min(e), max(e)) for t in patch for e in zip(t, t[1:] + t[:1], strict=True))
            self.faces = np.concatenate([self.faces, np.array(patch)])
            self.face_origin = np.concatenate([self.face_origin, np.full(len(patch), -1)])
            filled, faces_added = filled + 1, faces_added + len(patch)
        if filled:
            self.actions.append(f"filled {number(filled, 'hole')} with {number(faces_added, 'face')}")

    def turn_outward(self) -> None:
        used, faces = np.unique(self.faces, return_inverse=True)
        if any(defect.kind == "inward-orientation" for defect in check(self.points[used], faces.reshape(-1, 3))):
            self.faces = self.faces[:, ::-1].copy()
            self.actions.append("turned all faces outward")

    def measure_loss(self, points: Floats, faces: NDArray[np.int64]) -> None:
        """Measure which share of the input's area is gone, and say it where it is not small.

        Of faces that are there twice, one counts.
        """
        valid: NDArray[np.bool_] = np.all((faces >= 0) & (faces < len(points)), axis=1)
        valid[np.flatnonzero(valid)] = np.isfinite(points[faces[valid]]).all(axis=(1, 2))
        corners = points[faces[valid]] / np.abs(points[faces[valid]]).max(initial=TINY)
        areas = np.zeros(len(faces))
        areas[valid] = norms(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        areas[self.repeated] = 0.0
        gone = ~marked(len(faces), self.face_origin[self.face_origin >= 0])
        self.loss = float(areas[gone].sum() / max(float(areas.sum()), TINY))
        if self.loss > NOTED_LOSS:
            self.actions.append(f"dropped {100 * self.loss:.3g} % of the area")

    def drop_unused_vertices(self) -> None:
        used, faces = np.unique(self.faces, return_inverse=True)
        dropped = len(self.points) - len(used)
        if dropped:
            self.points, self.vertex_origin = self.points[used], self.vertex_origin[used]
            self.faces = faces.reshape(-1, 3)
            self.actions.append(f"dropped {number(dropped, 'unused vertex', 'unused vertices')}")


def _first_at_place(unit: Floats, edges: NDArray[np.int64], among: NDArray[np.int64]) -> NDArray[np.int64]:
    """Find vertices that lie at one place: nearer than a share of the mean length of their edges, or equal.

    Args:
        unit: the positions of all vertices, shape [V, 3].
        edges: their edges, shape [E, 2].
        among: the vertices that are compared, shape [N].

    Returns:
        For each of these the first at its place, an index into them, shape [N].
    """
    from scipy.spatial import cKDTree

    places, first, inverse = np.unique(unit[among] + 0.0, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    reach = np.full(len(places), np.inf)
    np.minimum.at(reach, inverse, WELD * mean_edge_lengths(unit, edges)[among])
    # Neighbours, places next to one that are compared with it: more than the faces around most vertices
    far, near = cKDTree(places).query(places, k=min(16, len(places)))
    near = near.reshape(len(places), -1)
    one, neighbour = np.nonzero(far.reshape(len(places), -1) <= np.minimum(reach[:, None], reach[near]))
    _, labels = components_of(len(places), np.stack([one, near[one, neighbour]], axis=1))
    first_of_label = np.full(len(places), len(among))
    np.minimum.at(first_of_label, labels, first)
    return first_of_label[labels[inverse]]


def _loops(half_edges: NDArray[np.int64]) -> list[list[int]]:
    """Find the closed loops around the holes, against the direction of the boundary's half-edges.

    Loops that touch themselves are left out.
    """
    following: dict[int, int] = {}
    pinched = set()
    for tail, head in half_edges.tolist():
        if head in following:
            pinched.add(head)
        following[head] = tail
    loops, seen = [], set()
    for start in following:
        loop, at = [], start
        while at not in seen and at in following:
            seen.add(at)
            loop.append(at)
            at = following[at]
        if len(loop) >= 3 and at == start and not pinched.intersection(loop):
            loops.append(loop)
    return loops


def _patch(points: Floats, loop: list[int], known: set[tuple[int, int]]) -> list[tuple[int, int, int]] | None:
    """Find the triangulation of a loop with the least area whose inner edges are all new; None where there is none.

    Source: G. Barequet and M. Sharir, Filling gaps in the boundary of a polyhedron, CAGD 12 (1995).
    """
    n = len(loop)
    corners = validate.unit_coordinates(points[loop])

    def free(i: int, j: int) -> bool:
        return j - i == 1 or (i == 0 and j == n - 1) or (min(loop[i], loop[j]), max(loop[i], loop[j])) not in known

    best = np.zeros((n, n))
    split = np.zeros((n, n), dtype=int)
    for gap in range(2, n):
        for i in range(n - gap):
            j = i + gap
            if not free(i, j):
                best[i, j] = np.inf
                continue
            between = np.arange(i + 1, j)
            area = norms(cross(corners[between] - corners[i], corners[j] - corners[i]))
            # A triangle without area would be another defect.
            # Least area, twice the area of a triangle that fills a hole, in units of the hole's size squared: less is
            # none
            cost = best[i, between] + best[between, j] + np.where(area > 1e-12, area, np.inf)
            split[i, j] = between[np.argmin(cost)]
            best[i, j] = cost.min()
    if not np.isfinite(best[0, n - 1]):
        return None
    patch, open_spans = [], [(0, n - 1)]
    while open_spans:
        i, j = open_spans.pop()
        if j - i >= 2:
            k = int(split[i, j])
            patch.append((loop[i], loop[k], loop[j]))
            open_spans += [(i, k), (k, j)]
    return patch
