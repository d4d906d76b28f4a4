"""Handles of a surface: short loops around them, and cutting along loops.

A shortest-path tree of the edges from a root and a spanning tree of the dual graph that avoids it leave 2g edges of a
surface of genus g. Each closes a loop with the two paths to the root, and no combination of these loops bounds a part
of the surface [1]_. A dual tree that takes the edges of the longest loops first leaves the shortest loops there are
through the root [2]_.

.. [1] D. Eppstein, "Dynamic generators of topologically embedded graphs", SODA (2003).
.. [2] J. Erickson, K. Whittlesey, "Greedy optimal homotopy and homology generators", SODA (2005).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from omtwarp.errors import OmtwarpError
from omtwarp.topology.boundary import boundary_loops

FAR_SWEEPS = 3  # from the farthest vertex to the one farthest from it
ROOTS = 6  # vertices that loops are sought through: the first, far ones, and one on the best loop so far


@dataclass(frozen=True)
class CutSurface:
    """A surface cut along loops around its handles.

    Attributes:
        vertices: the given ones, then copies of those on the loops, float64, shape [V + K, 3].
        faces: in the given order, int32, shape [F, 3].
        vertex_origin: the given vertex that each vertex is or is a copy of, shape [V + K].
        sides: the two boundary loops that each cut makes.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    vertex_origin: NDArray[np.int64]
    sides: list[tuple[NDArray[np.int64], NDArray[np.int64]]]


def cut_handles(
    vertices: NDArray[np.float64], faces: NDArray, genus: int, loops: list[NDArray[np.int64]] | None = None
) -> CutSurface:
    """Cut a surface along one short loop around each handle; what is left has genus 0.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented manifold mesh, shape [F, 3].
        genus: number of its handles.
        loops: where to cut, closed loops of vertices that do not touch; short ones are sought by default.

    Raises:
        OmtwarpError: the mesh is too coarse for loops that do not touch.
    """
    points, triangles, origin = vertices, np.asarray(faces, dtype=np.int64), np.arange(len(vertices))
    sides = []
    for number in range(genus):
        loop = shortest_handle_loop(points, triangles) if loops is None else loops[number]
        if loop is None:
            raise OmtwarpError(
                f"no loop around handle {number + 1} of {genus} keeps clear of holes and other cuts: use a finer mesh"
            )
        triangles, copied = _cut_along(triangles, loop, len(points))
        points, origin = np.concatenate([points, points[copied]]), np.concatenate([origin, origin[copied]])
        first = set(loop.tolist())
        own = [side for side in boundary_loops(triangles, len(points)) if first & set(side.tolist())]
        copies = set(range(len(points) - len(copied), len(points)))
        own += [side for side in boundary_loops(triangles, len(points)) if copies & set(side.tolist())]
        sides.append((own[0], own[1]))
    return CutSurface(points, triangles.astype(np.int32), origin, sides)


def slit_open(vertices: NDArray[np.float64], faces: NDArray, share: float = 1.0) -> CutSurface:
    """Cut a closed surface open along a path between two vertices that are far from each other.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented, closed manifold mesh, shape [F, 3].
        share: of the path that is cut, from its end.

    Returns:
        The surface with one boundary loop, and no ``sides``.
    """
    triangles, count = np.asarray(faces, dtype=np.int64), len(vertices)
    tail, head = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    one_way = tail < head
    lengths = np.linalg.norm(vertices[tail[one_way]] - vertices[head[one_way]], axis=1)
    lengths = np.maximum(lengths, np.finfo(float).eps * lengths.max())
    graph = sparse.csr_array((lengths, (tail[one_way], head[one_way])), shape=(count, count))
    root = int(tail[0])
    for _ in range(FAR_SWEEPS):
        steps, before = csgraph.dijkstra(graph, directed=False, indices=root, return_predecessors=True)
        far, last = int(np.argmax(np.where(np.isfinite(steps), steps, -1.0))), root
        root = far
    path = [far]
    while path[-1] != last:
        path.append(int(before[path[-1]]))
    if len(path) < 3:  # a path of one edge opens nothing: go on to any neighbour of its end that is not its beginning
        beside = np.unique(np.concatenate([head[tail == last], tail[head == last]]))
        path.append(int(beside[~np.isin(beside, path)][0]))
    kept = path[: max(3, round(share * len(path)))]
    opened, copied = _cut_along(triangles, np.array(kept), count, closed=False)
    origin = np.concatenate([np.arange(count), copied])
    return CutSurface(vertices[origin], opened.astype(np.int32), origin, [])


def shortest_handle_loop(vertices: NDArray[np.float64], faces: NDArray) -> NDArray[np.int64] | None:
    """A short closed loop of edges that does not separate a surface and touches no boundary.

    Args:
        vertices: float64, shape [V, 3].
        faces: a connected, oriented manifold mesh, shape [F, 3].

    Returns:
        The vertices of the loop, in order; None where there is no such loop.
    """
    graph = _LoopGraph(vertices, np.asarray(faces, dtype=np.int64))
    best: tuple[float, NDArray[np.int64]] | None = None
    allowed = np.flatnonzero(~graph.forbidden)
    if not len(allowed):
        return None
    distance = np.full(len(vertices), np.inf)
    root = int(allowed[0])
    for number in range(ROOTS):
        found = graph.shortest_loop(root, distance)
        if found is not None and (best is None or found[0] < best[0]):
            best = found
        reached = allowed[np.isfinite(distance[allowed])]
        root = int(reached[np.argmax(distance[reached])]) if len(reached) else root
        if best is not None and number == ROOTS - 2:
            root = int(best[1][len(best[1]) // 2])
    return None if best is None else best[1]


class _LoopGraph:
    """The edges of a surface and of its dual, boundary loops taken as faces of the dual."""

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int64]):
        self.count = len(vertices)
        tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        keys = np.minimum(tail, head) * self.count + np.maximum(tail, head)
        unique, edge = np.unique(keys, return_inverse=True)
        self.edges = np.stack([unique // self.count, unique % self.count], axis=1)
        self.lengths = np.linalg.norm(vertices[self.edges[:, 0]] - vertices[self.edges[:, 1]], axis=1)
        self.lengths = np.maximum(self.lengths, np.finfo(float).eps * self.lengths.max())
        self.forbidden = np.zeros(self.count, dtype=bool)
        loops = boundary_loops(faces, self.count)
        order = np.argsort(edge, kind="stable")
        starts = np.searchsorted(edge[order], np.arange(len(unique) + 1))
        self.dual = np.full((len(unique), 2), -1, dtype=np.int64)
        self.dual[:, 0] = order[starts[:-1]] // 3
        double = np.diff(starts) == 2
        self.dual[double, 1] = order[starts[:-1][double] + 1] // 3
        around = np.full(self.count, -1)
        for number, loop in enumerate(loops):
            self.forbidden[loop] = True
            around[loop] = len(faces) + number
        self.dual[~double, 1] = around[self.edges[~double, 0]]
        self.dual_count = len(faces) + len(loops)

    def shortest_loop(self, root: int, distance: NDArray[np.float64]) -> tuple[float, NDArray[np.int64]] | None:
        """The shortest handle loop through a root and its length; ``distance`` takes the least from all roots."""
        free = ~self.forbidden[self.edges].any(axis=1)
        a, b = self.edges[free].T
        graph = sparse.csr_array((self.lengths[free], (a, b)), shape=(self.count, self.count))
        steps, before = csgraph.dijkstra(graph, directed=False, indices=root, return_predecessors=True)
        np.minimum(distance, steps, out=distance)
        in_tree = self._tree_edges(before)
        through = steps[self.edges[:, 0]] + steps[self.edges[:, 1]] + self.lengths
        # First the edges that no loop may use, then those of the longest loops; the minimum tree takes low ranks first.
        wanted = np.where(np.isfinite(through) & free, through, np.inf)
        others = np.flatnonzero(~in_tree & (self.dual[:, 0] != self.dual[:, 1]))
        others = others[np.argsort(-wanted[others], kind="stable")]
        low, high = self.dual[others].min(axis=1), self.dual[others].max(axis=1)
        _, first = np.unique(low * self.dual_count + high, return_index=True)
        chosen = np.sort(first)
        weights = np.arange(1.0, len(chosen) + 1.0)
        links = sparse.csr_array((weights, (low[chosen], high[chosen])), shape=(self.dual_count, self.dual_count))
        taken = np.round(csgraph.minimum_spanning_tree(links).data).astype(np.int64) - 1
        left = np.ones(len(self.edges), dtype=bool)
        left[in_tree] = False
        left[others[chosen[taken]]] = False
        candidates = np.flatnonzero(left & np.isfinite(wanted))
        if not len(candidates):
            return None
        edge = candidates[np.argmin(wanted[candidates])]
        paths = []
        for end in self.edges[edge]:
            path = [int(end)]
            while path[-1] != root:
                path.append(int(before[path[-1]]))
            paths.append(path)
        while len(paths[0]) > 1 and len(paths[1]) > 1 and paths[0][-2] == paths[1][-2]:
            for path in paths:
                path.pop()
        loop = np.array(paths[0] + paths[1][-2::-1], dtype=np.int64)
        ends = np.stack([loop, np.roll(loop, -1)], axis=1)
        return float(self._length(ends)), loop

    def _length(self, ends: NDArray[np.int64]) -> float:
        keys = self.edges[:, 0] * self.count + self.edges[:, 1]
        return float(self.lengths[np.searchsorted(keys, ends.min(axis=1) * self.count + ends.max(axis=1))].sum())

    def _tree_edges(self, before: NDArray) -> NDArray[np.bool_]:
        """The edges of the shortest paths, and one edge for each vertex that no path may use, shape [E]."""
        keys = self.edges[:, 0] * self.count + self.edges[:, 1]
        child = np.flatnonzero(before >= 0)
        low, high = np.minimum(child, before[child]), np.maximum(child, before[child])
        tree = np.zeros(len(self.edges), dtype=bool)
        tree[np.searchsorted(keys, low * self.count + high)] = True
        # A spanning tree in which the edges above weigh least contains them all.
        weights = np.where(tree, 1.0, 2.0)
        graph = sparse.csr_array((weights, self.edges.T), shape=(self.count, self.count))
        spanning = csgraph.minimum_spanning_tree(graph).tocoo()
        low, high = np.minimum(spanning.row, spanning.col), np.maximum(spanning.row, spanning.col)
        tree = np.zeros(len(self.edges), dtype=bool)
        tree[np.searchsorted(keys, low.astype(np.int64) * self.count + high)] = True
        return tree


def _cut_along(
    faces: NDArray[np.int64], loop: NDArray[np.int64], count: int, closed: bool = True
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Faces cut open along a loop or a path, and the vertices that were copied, in the order of the copies."""
    ends = np.stack([loop, np.roll(loop, -1)], axis=1)[: None if closed else -1]
    cut = np.unique(ends.min(axis=1) * count + ends.max(axis=1))
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    corner = np.arange(len(tail))
    following = corner.reshape(-1, 3)[:, [1, 2, 0]].ravel()
    # Corners at one vertex belong together where their faces share an edge at it that is not cut.
    sorter = np.argsort(tail * count + head)
    ranked = (tail * count + head)[sorter]
    place = np.minimum(np.searchsorted(ranked, head * count + tail), len(ranked) - 1)
    twin = np.where(ranked[place] == head * count + tail, sorter[place], -1)
    joined = (twin >= 0) & ~np.isin(np.minimum(tail, head) * count + np.maximum(tail, head), cut)
    links = np.stack([corner[joined], following[twin[joined]]], axis=1)
    graph = sparse.coo_array((np.ones(len(links), dtype=np.int8), links.T), shape=(len(tail), len(tail)))
    _, label = csgraph.connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    owner = tail[first]
    kept = np.zeros(len(first), dtype=bool)
    kept[np.unique(owner, return_index=True)[1]] = True
    number = np.where(kept, owner, 0)
    number[~kept] = count + np.arange(int((~kept).sum()))
    return number[label].reshape(-1, 3), owner[~kept]


__all__ = ["CutSurface", "cut_handles", "shortest_handle_loop", "slit_open"]
