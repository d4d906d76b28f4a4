"""Checks of every condition that the maps rely on; each defect is one line with its position and its remedy.

Every test is independent of scale: coordinates are moved to the bounding box's centre and divided by its extent before
anything is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse import csgraph

from omtwarp.errors import OmtwarpError, naming
from omtwarp.mesh import arrays
from omtwarp.mesh.arrays import ROUND_OFF, Floats, HasTriangles, Ints, cross, marked, norms, real_numbers, whole_numbers

REPAIR = "omtwarp.repair"
"""How the remedies name the package's own repair."""


@dataclass(frozen=True)
class Defect:
    """One kind of defect of a mesh.

    Attributes:
        kind: a short, stable name: ``not-a-triangle-mesh``, ``empty``, ``non-finite``, ``index-out-of-range``,
            ``duplicate-faces``, ``zero-area``, ``unused-vertices``, ``non-manifold-edges``, ``non-manifold-vertices``,
            ``open-boundary``, ``not-orientable``, ``inconsistent-orientation``, ``several-components``, ``genus`` or
            ``inward-orientation``.
        count: how many there are.
        where: index of the first one (a vertex or a face, as the message says); -1 where there is none to name.
        message: the defect, how many, where the first one is.
        remedy: how to repair it.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.icosphere(2)
        >>> defect = omtwarp.check(surface.vertices, surface.faces[1:])[0]
        >>> defect.kind, defect.count
        ('open-boundary', 3)
    """

    kind: str
    count: int
    where: int
    message: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}"


MeshLike: TypeAlias = HasTriangles | tuple[ArrayLike, ArrayLike]
"""A surface in any of the forms that public functions take."""


def mesh_arrays(mesh: MeshLike | ArrayLike, faces: ArrayLike | None = None) -> tuple[ArrayLike, ArrayLike]:
    """Return the vertices and faces of a mesh in any of the accepted forms, or of two arrays, unexamined.

    Raises:
        OmtwarpError: the value is no mesh.
    """
    if faces is not None:
        return cast("ArrayLike", mesh), faces
    if isinstance(mesh, tuple | list) and len(mesh) == 2:
        return mesh[0], mesh[1]
    try:
        given = cast("HasTriangles", mesh)
        return given.vertices, given.faces
    except AttributeError:
        raise OmtwarpError(f"expected a trimesh.Trimesh or (vertices, faces), got {type(mesh).__name__}") from None


def check(mesh: MeshLike | ArrayLike, faces: ArrayLike | None = None) -> list[Defect]:
    """List everything that keeps a mesh from being mapped to the sphere; an empty list means that nothing does.

    Args:
        mesh: what :func:`omtwarp.read_mesh` returns, a ``trimesh.Trimesh``, ``(vertices, faces)``, or vertices alone,
            in any unit, shape [V, 3].
        faces: with vertices alone the vertex indices of the triangles, counter-clockwise seen from outside, shape
            [F, 3].

    Returns:
        The defects, the most basic first. Conditions that only make sense on a sounder mesh (an inside for an open
        one) are left out until the others are repaired.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.icosphere(2)
        >>> omtwarp.check(surface)
        []
        >>> [defect.kind for defect in omtwarp.check((surface.vertices, surface.faces[1:]))]
        ['open-boundary']
    """
    try:
        points, triangles = as_arrays(*mesh_arrays(mesh, faces))
    except OmtwarpError as error:
        return [Defect("not-a-triangle-mesh", 1, -1, str(error), "give vertices [V, 3] and triangles [F, 3]")]
    if len(points) == 0 or len(triangles) == 0:
        text = f"empty mesh: {number(len(points), 'vertex', 'vertices')} and {number(len(triangles), 'face')}"
        return [Defect("empty", 1, -1, text, "give a mesh with faces")]
    out_of_range = ((triangles < 0) | (triangles >= len(points))).any(axis=1)
    if out_of_range.any():
        first = int(np.argmax(out_of_range))
        text = (
            f"{number(out_of_range.sum(), 'face')} with a vertex index out of range, first face {first} "
            f"{tuple(triangles[first].tolist())} of a mesh with {number(len(points), 'vertex', 'vertices')}"
        )
        remedy = f"write the file anew, or drop them with {REPAIR}"
        return [Defect("index-out-of-range", int(out_of_range.sum()), first, text, remedy)]
    defects = _geometric_defects(points, triangles)
    if not (triangles == np.roll(triangles, -1, axis=1)).any():  # a face that repeats a vertex has no proper edges
        defects += _topological_defects(points, triangles, sound=not defects)
    return defects


def require_valid(vertices: ArrayLike, faces: ArrayLike, name: str = "") -> tuple[Floats, Ints]:
    """Return the arrays of a mesh that can be mapped; raise an error with the reason for any other.

    Args:
        vertices: coordinates in any unit, shape [V, 3].
        faces: vertex indices of the triangles, shape [F, 3].
        name: what to call the mesh in the message, such as its file's name.

    Returns:
        Vertices, float64 [V, 3], and faces, int32 [F, 3], in the order given.

    Raises:
        OmtwarpError: the first defect, how many, where the first is, how to repair it, and the other kinds of defect.
    """
    if defects := check(vertices, faces):
        raise OmtwarpError(describe(defects, name))
    points, triangles = as_arrays(vertices, faces)
    return points, triangles.astype(np.int32)


def describe(defects: list[Defect], name: str = "") -> str:
    """Sum up a list of defects in one line: the first in full, the kinds of the others in brackets."""
    others = ", ".join(defect.kind for defect in defects[1:])
    return (f"{name}: " if name else "") + str(defects[0]) + (f" (also: {others})" if others else "")


def as_arrays(vertices: ArrayLike, faces: ArrayLike) -> tuple[Floats, NDArray[np.int64]]:
    """Convert vertices to float64 [V, 3] and faces to int64 [F, 3] without changing a number.

    Raises:
        OmtwarpError: other shapes, faces with more than three corners, or indices that are not whole numbers.
    """
    with naming("not a triangle mesh"):
        points = real_numbers(vertices, "vertices", (None, 3), finite=False)
        triangles = whole_numbers(faces, "faces", (None, None))
        if triangles.size and triangles.shape[1] != 3:
            advice = ", triangulate them" if triangles.shape[1] > 3 else ""
            raise OmtwarpError(f"{len(triangles)} faces with {triangles.shape[1]} corners{advice}")
    return points, triangles.reshape(-1, 3)


def unit_coordinates(points: Floats) -> Floats:
    """Move points to their bounding box's centre and divide them by half its largest side.

    The result is zero if they all coincide.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high / 2 - low / 2).max())
    centred = points - (low / 2 + high / 2)
    return centred / extent if extent > 0 else np.zeros_like(centred)


def zero_area_faces(unit: Floats, faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return a mask of the faces whose area is zero up to rounding, shape [F]; ``unit`` is of :func:`unit_coordinates`.

    Coordinates near 1 are rounded at 1e-16, which moves twice the area by that times the longest edge: areas
    below a few times this count as zero.
    """
    corners = unit.take(faces, axis=0)
    edges = norms(np.roll(corners, -1, axis=1) - corners)
    twice_area = norms(cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    reach = arrays.row_maxima(arrays.row_maxima(np.abs(unit)).take(faces))
    return ~(twice_area > 4 * np.finfo(np.float64).eps * arrays.row_maxima(edges) * reach)


def duplicate_faces(faces: NDArray[np.int64], vertex_count: int) -> NDArray[np.bool_]:
    """Return a mask of the faces that have the vertices of an earlier face, in any order, shape [F]."""
    low, middle, high = np.sort(faces, axis=1).T
    edge = low * vertex_count + middle
    order = np.lexsort((high, edge)) if vertex_count >= 2**21 else np.argsort(edge * vertex_count + high, kind="stable")
    same = (edge[order[1:]] == edge[order[:-1]]) & (high[order[1:]] == high[order[:-1]])
    return marked(len(faces), order[1:][same])


def _geometric_defects(points: Floats, faces: NDArray[np.int64]) -> list[Defect]:
    """Find coordinates that are no numbers, degenerate faces, and vertices in no face."""
    finite = np.isfinite(points).all(axis=1)
    flat = zero_area_faces(unit_coordinates(points), faces) if finite.all() else np.zeros(len(faces), dtype=bool)
    write_anew = f"write the file anew, or drop them with {REPAIR}"
    cases = [
        ("non-finite", ~finite, "vertex", " with NaN or infinite coordinates", write_anew),
        ("duplicate-faces", duplicate_faces(faces, len(points)), "duplicate face", "", f"drop them with {REPAIR}"),
        ("zero-area", flat, "face", " of zero area", f"drop or flip them with {REPAIR}"),
        ("unused-vertices", ~marked(len(points), faces), "vertex", " in no face", f"drop them with {REPAIR}"),
    ]
    defects = []
    for kind, wrong, name, words, remedy in cases:
        if wrong.any():
            first, count = int(np.argmax(wrong)), int(wrong.sum())
            what = number(count, name, "vertices" if name == "vertex" else "")
            where = f"vertex {first}" if name == "vertex" else f"face {first} {tuple(faces[first].tolist())}"
            defects.append(Defect(kind, count, first, f"{what}{words}, first {where}", remedy))
    return defects


def _topological_defects(points: Floats, faces: NDArray[np.int64], sound: bool) -> list[Defect]:
    """Find defects of connectivity: manifold, closed, oriented, in one piece, of genus 0, outward.

    ``sound`` says that the faces by themselves have no defects, which genus and inside need.
    """
    topology = Topology(faces, len(points))
    crowded, pinched, clashing = topology.edge_face_count > 2, topology.fans > 1, topology.clashing_edges
    orientable = not clashing.any() or topology.orientation[0]
    two_sided = orientable or bool(crowded.any())
    defects = []
    if crowded.any():
        a, b = topology.edges[np.argmax(crowded)].tolist()
        text = f"{number(crowded.sum(), 'non-manifold edge')} (more than two faces), first between vertices {a} and {b}"
        defects.append(Defect("non-manifold-edges", int(crowded.sum()), a, text, f"drop the extra faces with {REPAIR}"))
    if pinched.any():
        first, several = int(np.argmax(pinched)), number(pinched.sum(), "non-manifold vertex", "non-manifold vertices")
        text = f"{several} (several fans of faces meet in a point), first vertex {first}"
        defects.append(Defect("non-manifold-vertices", int(pinched.sum()), first, text, f"split them with {REPAIR}"))
    if (topology.edge_face_count == 1).any():
        defects.append(_open_boundary(points, topology, two_sided))
    if clashing.any():
        a, b = topology.edges[np.argmax(clashing)].tolist()
        kind, count = "not-orientable", 1
        remedy = "no repair is possible: only surfaces with an inside map to the sphere"
        text = f"not orientable: a one-sided surface, its sides meet first between vertices {a} and {b}"
        if two_sided:
            kind, count, remedy = "inconsistent-orientation", int(clashing.sum()), f"turn the faces with {REPAIR}"
            edges = f"{number(count, 'edge')} between faces that turn opposite ways"
            text = f"inconsistent orientation: {edges}, first between vertices {a} and {b}"
        defects.append(Defect(kind, count, a, text, remedy))
    pieces, labels = topology.components
    if pieces > 1:
        sizes = np.bincount(labels)
        first = int(np.argmax(labels != np.argmax(sizes)))
        largest = f"the largest with {sizes.max()} of {len(labels)} faces"
        text = f"{pieces} components, {largest}, first face of another is {first}"
        remedy = f"use map_surface with components=True, or keep the largest with {REPAIR}"
        defects.append(Defect("several-components", pieces, first, text, remedy))
    if sound and orientable and not crowded.any() and not pinched.any() and topology.genus > 0:
        defects.append(_handles(topology))
    if sound and not defects and signed_volume(points, faces) < 0:
        text = f"inward orientation: all {number(len(faces), 'face')} are clockwise seen from outside, first face 0"
        defects.append(Defect("inward-orientation", len(faces), 0, text, f"turn them with {REPAIR}"))
    return defects


def _open_boundary(points: Floats, topology: Topology, two_sided: bool) -> Defect:
    """Return the defect of edges with one face, of which there are some.

    Args:
        points: the vertices, shape [V, 3].
        topology: of the mesh.
        two_sided: whether the surface may have two sides, without which no option takes it.
    """
    lone = topology.edge_face_count == 1
    count, size, vertex = topology.holes
    # Where more than two faces meet, a boundary may end; without ends it consists of loops.
    ends_there = bool((np.bincount(topology.edges[lone].ravel()) % 2).any())
    what, form = ("line", "a path") if ends_there else ("hole", "a loop")
    first = ("the first " if count > 1 else "") + f"{form} of {number(size, 'edge')} at vertex {vertex}"
    text = f"open boundary: {number(lone.sum(), 'edge')} with one face, in {number(count, what)}, {first}"
    ends = np.unique(topology.edges[lone])
    copies = len(ends) - len(np.unique(points[ends], axis=0))  # exactly where another one is
    if copies:
        remedy = f"{number(copies, 'vertex lies', 'vertices lie')} on another one, merge them with {REPAIR}"
    elif ends_there:
        remedy = f"drop the extra faces with {REPAIR}"
    elif not two_sided:
        remedy = "the surface has one side, which no repair and no option changes"
    else:
        remedy = f"fill small holes with {REPAIR}, or use map_surface with domain='hemisphere' or domain='sphere'"
    return Defect("open-boundary", int(lone.sum()), vertex, text, remedy)


def _handles(topology: Topology) -> Defect:
    """Return the defect of a surface of higher genus."""
    genus, (a, b) = topology.genus, topology.handle_edge.tolist()
    handles = number(genus, "handle")
    text = f"genus {genus}, not 0: {handles}, a loop around the first runs through vertices {a} and {b}"
    closed = topology.components[0] == 1 and not (topology.edge_face_count == 1).any()
    torus = ", or map to a torus with domain='torus'" if genus == 1 and closed else ""
    remedy = f"only genus 0 maps to the sphere: cut the handles, by map_surface with cut=True{torus}"
    return Defect("genus", genus, a, text, remedy)


class Topology:
    """Edges of a triangle mesh that need not be manifold, and what follows from how faces meet in them.

    Attributes:
        faces: int64, shape [F, 3], every index in range.
        edges: every undirected edge once, smaller vertex first, shape [E, 2], sorted.
        edge_face_count: number of faces at every edge, shape [E].
        face_edges: index of the edge (k, k+1) of every face, shape [F, 3].
    """

    def __init__(self, faces: NDArray[np.int64], vertex_count: int):
        self.faces = faces
        self.vertex_count = vertex_count
        tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        keys = np.minimum(tail, head) * vertex_count + np.maximum(tail, head)
        order = np.argsort(keys, kind="stable")  # half-edges, those of one edge side by side, in the order of faces
        same = keys[order[1:]] == keys[order[:-1]]
        starts = np.flatnonzero(np.concatenate([[True], ~same]))
        self.edge_face_count = np.diff(starts, append=len(keys))
        self.edges = np.stack([np.minimum(tail, head)[order[starts]], np.maximum(tail, head)[order[starts]]], axis=1)
        self._forward = tail < head
        self._half_edge_edge = np.empty(len(keys), dtype=np.int64)
        self._half_edge_edge[order] = np.repeat(np.arange(len(starts)), self.edge_face_count)
        self.face_edges = self._half_edge_edge.reshape(-1, 3)
        # Pairs of half-edges that lie side by side in one edge; an edge of n faces gives n - 1 of them.
        self._pairs = np.stack([order[:-1][same], order[1:][same]], axis=1)

    @property
    def on_boundary(self) -> NDArray[np.bool_]:
        """The vertices of edges that one face alone has, shape [V]."""
        return marked(self.vertex_count, self.edges[self.edge_face_count == 1])

    @cached_property
    def clashing_edges(self) -> NDArray[np.bool_]:
        """Edges of two faces that both run through them in the same direction, shape [E]."""
        forward = np.bincount(self._half_edge_edge, weights=self._forward, minlength=len(self.edges))
        return (self.edge_face_count == 2) & (forward != 1)

    @cached_property
    def components(self) -> tuple[int, Ints]:
        """Number of pieces joined through edges and the piece of every face, shape [F]."""
        return components_of(len(self.faces), self._pairs // 3)

    @cached_property
    def fan_of_corner(self) -> Ints:
        """A number for every corner of every face, equal where faces share edges at a vertex, shape [3 F]."""
        first, second = self._pairs[:, 0], self._pairs[:, 1]
        following = np.arange(self.faces.size).reshape(-1, 3)[:, [1, 2, 0]].ravel()  # corner at the head
        aligned = self._forward[first] == self._forward[second]
        low = np.stack([first, np.where(aligned, second, following[second])], axis=1)
        high = np.stack([following[first], np.where(aligned, following[second], second)], axis=1)
        return components_of(self.faces.size, np.concatenate([low, high]))[1]

    @cached_property
    def fans(self) -> NDArray[np.int64]:
        """Number of fans of faces, joined through edges, around every vertex, shape [V]; 0 where a vertex is unused."""
        middle = np.empty(self.fan_of_corner.max(initial=-1) + 1, dtype=np.int64)
        middle[self.fan_of_corner] = self.faces.ravel()
        return np.bincount(middle, minlength=self.vertex_count)

    @cached_property
    def orientation(self) -> tuple[bool, NDArray[np.bool_]]:
        """Whether the faces can be turned to agree, and which to turn for it so that each piece's first face stays.

        The faces are doubled into (face, as it is) and (face, turned), and joined so that joined ones agree: the
        surface is orientable exactly where no face is joined to its own turned copy.
        """
        count = len(self.faces)
        two = self.edge_face_count[self._half_edge_edge[self._pairs[:, 0]]] == 2
        first, second = (self._pairs[two] // 3).T
        clash = self._forward[self._pairs[two, 0]] == self._forward[self._pairs[two, 1]]
        straight = np.stack([first, second + count * clash], axis=1)
        turned = np.stack([first + count, second + count * ~clash], axis=1)
        _, labels = components_of(2 * count, np.concatenate([straight, turned]))
        orientable = bool((labels[:count] != labels[count:]).all())
        pieces, piece = components_of(count, np.stack([first, second], axis=1))
        leader = np.full(pieces, count)
        np.minimum.at(leader, piece, np.arange(count))
        return orientable, labels[:count] != labels[leader[piece]]

    @cached_property
    def holes(self) -> tuple[int, int, int]:
        """How many connected pieces the boundary has, how many edges the first of them, and its smallest vertex."""
        ends, renumbered = np.unique(self.edges[self.edge_face_count == 1], return_inverse=True)
        if not len(ends):
            return 0, 0, -1
        pairs = renumbered.reshape(-1, 2)
        count, labels = components_of(len(ends), pairs)
        return count, int((labels[pairs[:, 0]] == labels[0]).sum()), int(ends[0])

    @cached_property
    def genus(self) -> int:
        """Handles of all pieces together, holes counted as filled: Euler's V - E + F = 2 (pieces - genus)."""
        used = int(marked(self.vertex_count, self.faces).sum())
        euler = used - len(self.edges) + len(self.faces) + self.holes[0]
        return self.components[0] - euler // 2

    @cached_property
    def handle_edge(self) -> NDArray[np.int64]:
        """An edge that closes a loop around a handle: the first in neither a spanning tree nor a cotree, shape [2].

        Source: D. Eppstein, Dynamic generators of topologically embedded graphs, 2003 (tree-cotree decomposition).
        """
        in_tree = spanning_forest(self.vertex_count, self.edges)
        inner = np.flatnonzero((self.edge_face_count == 2) & ~in_tree)
        faces_of = np.full((len(self.edges), 2), -1)
        faces_of[self._half_edge_edge[self._pairs[:, 0]]] = self._pairs // 3
        left = inner[~spanning_forest(len(self.faces), faces_of[inner])]
        return self.edges[left[0]] if len(left) else self.edges[0]


def components_of(count: int, links: NDArray) -> tuple[int, Ints]:
    """Return the number of a graph's connected components, and the component of every node, shape [count]."""
    graph = sparse.coo_array((np.ones(len(links), dtype=np.int8), (links[:, 0], links[:, 1])), shape=(count, count))
    pieces, labels = csgraph.connected_components(graph, directed=False)
    return int(pieces), labels


def spanning_forest(count: int, links: NDArray) -> NDArray[np.bool_]:
    """Return a mask of the links that make up a spanning forest of a graph, shape [len(links)]."""
    # The weight of a link is its own number, so that the tree's entries say which links were taken.
    number = np.arange(1, len(links) + 1, dtype=np.float64)
    graph = sparse.csr_array((number, (links[:, 0], links[:, 1])), shape=(count, count))
    return marked(len(links), np.round(csgraph.minimum_spanning_tree(graph).data).astype(np.int64) - 1)


def signed_volume(points: Floats, faces: NDArray[np.integer]) -> float:
    """Return the enclosed volume, in units of half the extent cubed; 0 where it is smaller than its rounding error."""
    p0, p1, p2 = unit_coordinates(points)[faces.T]
    each = np.einsum("ij,ij->i", p0, cross(p1, p2)) / 6.0
    volume = float(each.sum())
    return volume if abs(volume) > ROUND_OFF * float(np.abs(each).sum()) else 0.0


def number(count: int | np.integer, one: str, many: str = "") -> str:
    """Write a number with its noun: ``1 face``, ``7 faces``."""
    return f"{int(count)} {one if count == 1 else many or one + 's'}"
