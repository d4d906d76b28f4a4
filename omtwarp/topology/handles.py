"""Handles of a surface: the shortest loops around them and through their holes, and cutting along loops.

Every handle has two kinds of loops that do not separate the surface: around the handle, which leaves two limbs where
it was, and through the hole that it makes, which closes the hole. Either opens the handle. The first are the shortest
there are, so that textures have the shortest seams. The second leave fewer and thicker limbs, and limbs need vertices
around them to keep their areas, see :mod:`omtwarp.geometry.limbs`.

A spanning tree of the edges and a spanning tree of the dual graph that avoids it leave 2g edges of a surface of genus
g [1]_. Each of these and the dual tree close a loop of triangles, and a closed curve of edges separates the surface
exactly if it crosses each of these 2g loops an even number of times. The tree and the 2g edges,
without dead ends, cut the surface open to a disk, so that every curve that does not separate passes through one of
its vertices. The shortest such curve is hence the least, over these vertices, of the shortest ones through a vertex;
and the shortest one through a vertex follows two shortest paths from it and one edge [2]_.

.. [1] D. Eppstein, "Dynamic generators of topologically embedded graphs", SODA (2003).
.. [2] J. Erickson, S. Har-Peled, "Optimally cutting a surface into a disk", Discrete Comput. Geom. 31 (2004).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from omtwarp.errors import OmtwarpError
from omtwarp.geometry.limbs import rings, vertices_needed
from omtwarp.mesh.arrays import Floats, edge_keys, marked, norms
from omtwarp.mesh.origins import Derived
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import components_of, spanning_forest
from omtwarp.options import CutAlong
from omtwarp.topology.closing import fill_holes
from omtwarp.topology.kind import boundary_loops, on_boundary


@dataclass(frozen=True, eq=False)
class CutSurface(Derived):
    """A surface cut along loops around its handles.

    Attributes:
        vertices: the given ones, then copies of those on the loops, float64, shape [V + K, 3].
        faces: in the given order, int32, shape [F, 3].
        sides: the two boundary loops that each cut makes.
    """

    sides: list[tuple[NDArray[np.int64], NDArray[np.int64]]]


def cut_handles(
    vertices: Floats, faces: NDArray, genus: int, loops: list[NDArray[np.int64]] | None = None, *, thorough: bool = True
) -> CutSurface:
    """Cut a surface along one loop around each handle, the shortest there is each time; what is left has genus 0.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented manifold mesh, shape [F, 3].
        genus: number of its handles.
        loops: where to cut, closed loops of vertices that do not touch; they are sought by default.
        thorough: whether those sought are to be the shortest: see :func:`shortest_handle_loop`.

    Raises:
        OmtwarpError: the mesh is too coarse for loops that do not touch.
    """
    points, triangles, origin = vertices, faces, np.arange(len(vertices))
    sides = []
    for number in range(genus):
        loop = shortest_handle_loop(points, triangles, thorough=thorough) if loops is None else loops[number]
        if loop is None:
            raise OmtwarpError(
                f"no loop around handle {number + 1} of {genus} keeps clear of holes and other cuts: use a finer mesh"
            )
        cut = _cut_along(Surface(points, triangles), loop)
        points, triangles, origin = cut.vertices, cut.faces, origin[cut.vertex_origin]
        one, other = (side for side in boundary_loops(triangles, len(points)) if origin[loop[0]] in origin[side])
        sides.append((one, other))
    return CutSurface(origin, np.arange(len(faces)), points, triangles.astype(np.int32), sides, given=len(vertices))


def slit_open(vertices: Floats, faces: NDArray, share: float = 1.0) -> Derived:
    """Cut a closed surface open along a path between two vertices that are far from each other.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented, closed manifold mesh, shape [F, 3].
        share: of the path that is cut, from its end.

    Returns:
        The surface with one boundary loop.
    """
    surface, count, root = Surface(vertices, faces), len(vertices), int(faces[0, 0])
    edges, lengths = surface.edges, _edge_lengths(vertices, surface.edges)
    # Far sweeps, from the farthest vertex to the one farthest from it
    for _ in range(3):
        steps, before = _shortest_paths(edges, lengths, count, root)
        root = int(np.argmax(np.where(np.isfinite(steps), steps, -1.0)))
    path = _path_to(root, before)
    if len(path) < 3:  # a path of one edge opens nothing: go on to any neighbour of its end that is not its beginning
        path.append(int(np.setdiff1d(edges[(edges == path[-1]).any(axis=1)], path)[0]))
    return _cut_along(surface, np.array(path[: max(3, round(share * len(path)))]), closed=False)


def shortest_handle_loop(vertices: Floats, faces: NDArray, *, thorough: bool = True) -> NDArray[np.int64] | None:
    """Find the shortest closed loop of edges that does not separate a surface and touches no boundary.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented manifold mesh, shape [F, 3].
        thorough: whether it is to be the shortest; otherwise the shortest through any of a few vertices is taken.

    Returns:
        The vertices of the loop, in order; None where there is no such loop.
    """
    graph = _LoopGraph(Surface(vertices, faces))
    roots = graph.roots()
    # Roots: vertices through which a short loop is sought where it need not be the shortest
    first = np.unique(roots[:: max(1, len(roots) // 6)])
    graph.search(first)
    if thorough or graph.loop is None:
        graph.search(roots[~np.isin(roots, first)])
    return graph.loop


def _edge_lengths(vertices: Floats, ends: NDArray) -> Floats:
    """Return the lengths of edges, none of them 0, for graphs."""
    lengths = norms(vertices[ends[:, 0]] - vertices[ends[:, 1]])
    return np.maximum(lengths, np.finfo(float).eps * lengths.max())


def _shortest_paths(
    edges: NDArray, lengths: Floats, count: int, roots: int | NDArray[np.int64], limit: float = np.inf
) -> tuple[Floats, NDArray]:
    """Return how far vertices are from roots along edges, none above a limit, and the vertex before each on its way."""
    graph = sparse.csr_array((lengths, edges.T), shape=(count, count))
    return csgraph.dijkstra(graph, directed=False, indices=roots, return_predecessors=True, limit=limit)


def _path_to(end: int, before: NDArray) -> list[int]:
    """Return the vertices of the shortest path to one, from there back to the root, which has none before it."""
    path = [end]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return path


class _LoopGraph:
    """The edges of a surface and of its dual, in which the hole in each boundary loop is a face.

    Attributes:
        length: of the shortest loop found so far; infinite before one is found.
        loop: its vertices in order.
    """

    def __init__(self, surface: Surface):
        self.length = float(np.inf)
        self.loop: NDArray[np.int64] | None = None
        self.count, self.edges = surface.vertex_count, surface.edges.astype(np.int64)
        self._keys = edge_keys(self.edges, self.count)
        self.lengths = _edge_lengths(surface.vertices, self.edges)
        loops = boundary_loops(surface.faces, self.count)
        around = np.full(self.count, -1)
        for number, loop in enumerate(loops):
            around[loop] = surface.face_count + number
        self.forbidden = around >= 0
        self.dual = surface.side_corners.astype(np.int64) // 3  # -1 beyond the boundary
        self.dual[:, 1] = np.where(self.dual[:, 1] < 0, around[self.edges[:, 0]], self.dual[:, 1])
        self.dual_count = surface.face_count + len(loops)
        self._before, cotree, self._left = self._tree_and_cotree()
        self._crossed = self._crossings(cotree)

    def roots(self) -> NDArray[np.int64]:
        """Return the vertices, none on the boundary, of which every loop that does not separate passes through one.

        They follow paths, so that those that are searched from together lie near each other.
        """
        ends = self.edges[self._left].ravel().tolist()
        on_paths = list(dict.fromkeys(vertex for end in ends for vertex in _path_to(end, self._before)))
        return np.array(on_paths, dtype=np.int64)[~self.forbidden[on_paths]]

    def search(self, roots: NDArray[np.int64]) -> None:
        """Take the shortest loop through each of the roots, where it is shorter than the one found so far."""
        free = np.flatnonzero(~self.forbidden[self.edges].any(axis=1))
        graph = sparse.csr_array((self.lengths[free], self.edges[free].T), shape=(self.count, self.count))
        # Chunk: edges times roots at once, which bounds the memory
        size = max(1, 4_000_000 // max(len(free), 1))
        for start in range(0, len(roots), size):
            group = roots[start : start + size]
            # A loop through a root lies within half its length of it: only vertices so near to one are numbered.
            far = csgraph.dijkstra(graph, directed=False, indices=group, limit=0.5 * self.length, min_only=True)
            reached = np.isfinite(far)
            near, number = np.flatnonzero(reached), np.cumsum(reached) - 1
            kept = free[reached[self.edges[free]].all(axis=1)]
            ends = number[self.edges[kept]]
            steps, before = _shortest_paths(ends, self.lengths[kept], len(near), number[group], 0.5 * self.length)
            place, parity = self._parities(steps, before, near)
            through = steps[:, ends[:, 0]] + steps[:, ends[:, 1]] + self.lengths[kept]
            # Shorter, of a length: a difference above rounding
            row, edge = np.nonzero(through < (1.0 - 1e-12) * self.length)
            one, other = (parity[place[row, ends[edge, k]]] for k in (0, 1))
            around = np.flatnonzero((one ^ other ^ self._crossed[kept[edge]]).any(axis=1))
            if len(around):
                best = around[np.argmin(through[row[around], edge[around]])]
                self._take([near[_path_to(end, before[row[best]])].tolist() for end in ends[edge[best]].tolist()])

    def _number(self, tail: NDArray, head: NDArray) -> NDArray[np.int64]:
        """Return the numbers of the edges with these ends."""
        return np.searchsorted(self._keys, edge_keys(np.stack([tail, head], axis=1), self.count))

    def _tree_and_cotree(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
        """Find shortest paths, a tree of the dual that avoids their edges, and the other edges.

        Returns:
            The vertex before each on its path, negative at the root, shape [V]; the edges that the dual tree crosses;
            the edges in neither tree.
        """
        steps, before = _shortest_paths(self.edges, self.lengths, self.count, 0)
        child = np.flatnonzero(before >= 0)
        left = np.ones(len(self.edges), dtype=bool)
        left[self._number(child, before[child])] = False
        # The tree of the dual takes the edges of the longest loops first, which leaves short ones.
        others = np.flatnonzero(left & (self.dual[:, 0] != self.dual[:, 1]))
        through = steps[self.edges[others]].sum(axis=1) + self.lengths[others]
        others = others[np.argsort(-through, kind="stable")]
        first = np.unique(edge_keys(self.dual[others], self.dual_count), return_index=True)[1]
        others = others[np.sort(first)]
        cotree = others[spanning_forest(self.dual_count, self.dual[others])]
        left[cotree] = False
        return before.astype(np.int64), cotree, np.flatnonzero(left)

    def _crossings(self, cotree: NDArray[np.int64]) -> NDArray[np.uint64]:
        """Return, as bits, which of the 2g loops of triangles cross each edge, shape [E, words]."""
        crossed = np.zeros((len(self.edges), max(1, -(-len(self._left) // 64))), dtype=np.uint64)
        size = self.dual_count
        # The edge that each link of the dual tree crosses, found by the link's two ends.
        links = sparse.csr_array((cotree + 1, self.dual[cotree].T), shape=(size, size))
        _, before = csgraph.breadth_first_order(links, 0, directed=False)
        upwards = np.full(size, -1, dtype=np.int64)
        one, other = self.dual[cotree].T
        down = before[other] == one
        upwards[np.where(down, other, one)] = cotree
        for number, edge in enumerate(self._left.tolist()):
            word, bit = number // 64, np.uint64(1) << np.uint64(number % 64)
            crossed[edge, word] ^= bit
            for face in self.dual[edge].tolist():
                crossed[upwards[_path_to(face, before)[:-1]], word] ^= bit
        return crossed

    def _parities(
        self, steps: Floats, before: NDArray, near: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
        """Return which loops of triangles are crossed an odd number of times by the path from each root to each vertex.

        Args:
            steps, before: of paths from the roots to some vertices, shape [R, K].
            near: the vertices, shape [K].

        Returns:
            A number for each root and vertex, -1 where there is no path, shape [R, K]; and bits by that number.
        """
        row, vertex = np.nonzero(np.isfinite(steps))
        place = np.full(steps.shape, -1, dtype=np.int64)
        place[row, vertex] = np.arange(len(row))
        last = before[row, vertex]
        begin = last < 0
        parent = np.where(begin, np.arange(len(row)), place[row, np.maximum(last, 0)])
        parity = self._crossed[self._number(near[vertex], near[np.where(begin, vertex, last)]) % len(self.edges)]
        parity[begin] = 0
        while not begin[parent].all():  # every round doubles the stretch of the path that is added up
            parity ^= parity[parent]
            parent = parent[parent]
        return place, parity

    def _take(self, paths: list[list[int]]) -> None:
        """Keep the loop of an edge and the paths from its ends to one root, from where these part."""
        while len(paths[0]) > 1 and len(paths[1]) > 1 and paths[0][-2] == paths[1][-2]:
            for path in paths:
                path.pop()
        self.loop = np.array(paths[0] + paths[1][-2::-1], dtype=np.int64)
        self.length = float(self.lengths[self._number(self.loop, np.roll(self.loop, -1))].sum())


def _cut_along(surface: Surface, loop: NDArray[np.int64], closed: bool = True) -> Derived:
    """Return a surface cut open along a loop or a path: its vertices, then copies of those on the cut."""
    count, sides = surface.vertex_count, surface.side_corners
    ends = np.stack([loop, np.roll(loop, -1)], axis=1)[: None if closed else -1]
    whole = (sides[:, 1] >= 0) & ~np.isin(edge_keys(surface.edges, count), edge_keys(ends, count))
    # Corners at one vertex belong together where their faces share an edge at it that is not cut.
    after, before = (sides[whole] // 3 * 3 + (sides[whole] + turn) % 3 for turn in (1, 2))
    joined = np.concatenate([np.stack([after[:, k], before[:, 1 - k]], axis=1) for k in (0, 1)])
    _, label = components_of(surface.faces.size, joined)
    _, first = np.unique(label, return_index=True)
    owner = surface.faces.ravel()[first].astype(np.int64)
    kept = marked(len(first), np.unique(owner, return_index=True)[1])
    origin, number = np.r_[np.arange(count), owner[~kept]], np.where(kept, owner, 0)
    number[~kept] = np.arange(count, len(origin))
    opened = number[label].reshape(-1, 3).astype(np.int32)
    return Derived(origin, np.arange(len(opened)), surface.vertices[origin], opened, given=count)


def cut_open(
    vertices: Floats, faces: NDArray, genus: int, along: CutAlong = CutAlong.AUTO
) -> tuple[CutSurface, list[str]]:
    """Cut a surface along one loop for each handle, so that genus 0 is left.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented manifold mesh, shape [F, 3].
        genus: number of its handles.
        along: ``handles``, the shortest loops; ``holes``, for each of them the shortest that crosses it once and no
            other, where one keeps clear of the others; ``auto``, those of either kind that leave thicker limbs.

    Returns:
        The surface cut open, and the kind of each loop, ``handles`` or ``holes``.

    Raises:
        OmtwarpError: the mesh is too coarse for loops that do not touch.
    """
    cut = cut_handles(vertices, faces, genus)
    around = [cut.vertex_origin[one] for one, _ in cut.sides]
    if genus == 0 or along == CutAlong.HANDLES:
        return cut, [CutAlong.HANDLES] * genus
    thinness = _thinness(cut) if along == CutAlong.AUTO else np.inf
    through = loops_through_holes(cut)
    taken, known = np.zeros(genus, dtype=bool), np.array([each is not None for each in through])
    # All loops through holes first, then each handle by itself.
    alone = np.eye(genus, dtype=bool)[known] if along == CutAlong.AUTO and genus > 1 else ()
    for turned in (known, *alone):
        crossing = taken ^ turned
        pairs = zip(around, through, crossing, strict=True)
        loops = [other if across and other is not None else own for own, other, across in pairs]
        candidate = cut_handles(vertices, faces, genus, loops)
        thin = _thinness(candidate) if along == CutAlong.AUTO else 0.0
        if thin < thinness:
            cut, taken, thinness = candidate, crossing, thin
    return cut, [CutAlong.HOLES if each else CutAlong.HANDLES for each in taken]


def loops_through_holes(cut: CutSurface) -> list[NDArray[np.int64] | None]:
    """Find for each cut the shortest loop of edges that crosses it once and no other.

    Args:
        cut: a surface cut along loops around its handles.

    Returns:
        The given vertices of the loops, in order, which touch neither each other, nor other cuts, nor the boundary;
        None for a cut that none such crosses.
    """
    closed = on_boundary(cut.faces, len(cut.vertices))
    loops: list[NDArray[np.int64] | None] = []
    for sides in cut.sides:
        chosen = list(loops_across(cut, sides, closed))
        if chosen:
            closed |= np.isin(cut.vertex_origin, chosen[-1])
        loops.append(chosen[-1] if chosen else None)
    return loops


def loops_across(
    cut: CutSurface, sides: tuple[NDArray[np.int64], NDArray[np.int64]], closed: NDArray[np.bool_]
) -> Iterator[NDArray[np.int64]]:
    """Find loops of edges that cross a cut once, each shorter than the one before.

    Args:
        cut: a surface cut along loops around its handles.
        sides: of the cut to be crossed.
        closed: vertices that no loop may pass but where it crosses, shape [V + K].

    Yields:
        The given vertices of a loop, in order.
    """
    count, origin = len(cut.vertices), cut.vertex_origin
    ends = Surface(cut.vertices, cut.faces).edges
    lengths = _edge_lengths(cut.vertices, ends)
    partner = dict(zip(origin[sides[1]].tolist(), sides[1].tolist(), strict=True))
    shortest = np.inf
    for start in sides[0].tolist():
        end = partner[int(origin[start])]
        free = ~closed
        free[[start, end]] = True
        kept = free[ends].all(axis=1)
        steps, before = _shortest_paths(ends[kept], lengths[kept], count, start, shortest)
        if steps[end] < shortest:
            shortest = float(steps[end])
            yield origin[np.array(_path_to(end, before)[:-1])]


def _thinness(cut: CutSurface) -> float:
    """Return how thin the limbs of a cut surface are, all its holes filled: Σ (vertices needed / vertices around)².

    The sum is over rings around all limbs. Of 13 surfaces of 2 to 5 handles and 2,600 to 13,200 faces, each cut in 4 to
    12 ways, the way with the least sum has the least area distortion; by the thinnest ring alone three have .002 to
    .015 more.
    """
    filled = fill_holes(cut.vertices, cut.faces, boundary_loops(cut.faces, len(cut.vertices)))
    surface = Surface(filled.vertices, filled.faces)
    return sum((vertices_needed(ring.share, surface.face_count) / ring.around) ** 2 for ring in rings(surface))
