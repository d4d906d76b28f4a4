"""A start for long thin shapes, where the conformal map underflows: latitude by area, longitude by a harmonic function.

A tube of length L and girth C shrinks by exp(-2πL/C) under a conformal map to the sphere. Here the latitude is spread
by area instead, so that nothing shrinks exponentially, after the polar parametrisation of Brechbühler, Gerig and Kübler
("Parametrization of closed surfaces for 3-D shape description", 1995).
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra

from omtwarp.geometry.axes import order_by_place
from omtwarp.mesh.surface import Surface
from omtwarp.solvers.poisson import Factorization

SMALLEST_WEIGHT = 1e-3  # of the mean weight: keeps both harmonic functions free of extrema off the poles
LEVEL_TIE = 1e-10  # levels nearer than this, relative to the range, share their latitude


def tube_map(surface: Surface) -> NDArray[np.float64]:
    """Map a genus-0 surface to the sphere by area-equalised latitude and harmonic longitude.

    Two sparse systems are solved, one for each function. The map covers the sphere once but may contain flipped
    triangles: :func:`omtwarp.untangling.untangle.untangle` removes them.

    Args:
        surface: a valid closed surface of genus 0, V vertices.

    Returns:
        Unit vectors, float64, shape [V, 3], in vertex order.
    """
    if surface.vertex_count == 4:
        return _regular_tetrahedron(surface.faces)
    south, north = poles(surface)
    edges = surface.edges
    weights = positive_cotangent_weights(surface)
    level = _level_function(surface.vertex_count, edges, weights, south, north)
    height = area_latitude(level, surface.vertex_areas)
    longitude = _longitude(surface, edges, weights, level, south, north)
    height[south], height[north] = -1.0, 1.0
    radius = np.sqrt(np.maximum(1.0 - height**2, 0.0))
    sphere = np.stack([radius * np.cos(longitude), radius * np.sin(longitude), height], axis=1)
    return sphere / np.linalg.norm(sphere, axis=1, keepdims=True)


def poles(surface: Surface) -> tuple[int, int]:
    """Return the ends of a longest shortest path over edges, found by sweeping from the farthest vertex found so far.

    The two are never neighbours: a longitude needs a ring of vertices between its poles.
    """
    edges = surface.edges
    points = surface.scaled_vertices
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    count = surface.vertex_count
    graph = sparse.csr_matrix((lengths, (edges[:, 0], edges[:, 1])), shape=(count, count))
    south = north = int(order_by_place(surface)[0])  # wherever vertex 0 is, the same
    best = -1.0
    for _ in range(4):
        distance = dijkstra(graph, directed=False, indices=north)
        far = int(np.argmax(distance))
        if distance[far] <= best:
            break
        best, south, north = float(distance[far]), north, far
    if np.any((edges == min(south, north))[:, 0] & (edges == max(south, north))[:, 1]):
        hops = dijkstra(graph, directed=False, indices=south, unweighted=True)
        if hops.max() < 2:  # a vertex next to all others: the farthest pair that is not joined lies elsewhere
            south = int(np.argmin(np.bincount(edges.ravel(), minlength=count)))
            hops = dijkstra(graph, directed=False, indices=south, unweighted=True)
        north = int(np.argmax(hops))
    return south, north


def positive_cotangent_weights(surface: Surface) -> NDArray[np.float64]:
    """Return the cotangent weight of every edge, raised to stay positive for the maximum principle, shape [E]."""
    points, faces = surface.scaled_vertices, surface.faces
    count = np.int64(surface.vertex_count)
    corner = points[faces]
    keys, values = [], []
    for k in range(3):
        a, b = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        sine = np.linalg.norm(np.cross(a, b), axis=1)
        values.append(0.5 * np.einsum("ij,ij->i", a, b) / np.maximum(sine, np.finfo(float).tiny))
        pair = np.sort(faces[:, [(k + 1) % 3, (k + 2) % 3]], axis=1).astype(np.int64)
        keys.append(pair[:, 0] * count + pair[:, 1])
    edges = surface.edges.astype(np.int64)
    slot = np.searchsorted(edges[:, 0] * count + edges[:, 1], np.concatenate(keys))
    weights = np.bincount(slot, weights=np.concatenate(values), minlength=len(edges))
    typical = np.median(np.abs(weights))
    return np.clip(weights, SMALLEST_WEIGHT * typical, typical / SMALLEST_WEIGHT)


def weighted_laplacian(count: int, edges: NDArray[np.int32], weights: NDArray[np.float64]) -> sparse.csr_matrix:
    """Return the graph Laplacian of weighted edges, shape [V, V], positive semidefinite."""
    i, j = edges[:, 0], edges[:, 1]
    off = sparse.coo_matrix((np.r_[weights, weights], (np.r_[i, j], np.r_[j, i])), shape=(count, count)).tocsr()
    return (sparse.diags(np.asarray(off.sum(axis=1)).ravel()) - off).tocsr()


def _level_function(count, edges, weights, south: int, north: int) -> NDArray[np.float64]:
    """Return the harmonic function from 0 at the south pole to 1 at the north pole, shape [V]."""
    laplacian = weighted_laplacian(count, edges, weights)
    free = np.setdiff1d(np.arange(count), [south, north])
    level = np.zeros(count)
    level[north] = 1.0
    inner = laplacian[free]
    level[free] = Factorization(inner[:, free]).solve(-(inner[:, [north]].toarray().ravel()))
    return level


def area_latitude(level: NDArray[np.float64], vertex_areas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height z of every vertex at which each band keeps its area, -1 + 2 (area below) / (total), [V]."""
    order = np.argsort(level, kind="stable")
    ranked = level[order]
    below = np.cumsum(vertex_areas[order])
    start = np.flatnonzero(np.r_[True, np.diff(ranked) > LEVEL_TIE * (ranked[-1] - ranked[0])])
    group = np.zeros(len(level), dtype=np.intp)
    group[start[1:]] = 1
    group = np.cumsum(group)
    low = np.r_[0.0, below[start[1:] - 1]]
    high = np.r_[below[start[1:] - 1], below[-1]]
    height = np.empty(len(level))
    height[order] = (low + high)[group] / below[-1] - 1.0
    return height


def _longitude(surface: Surface, edges, weights, level, south: int, north: int) -> NDArray[np.float64]:
    """Return the longitude, a harmonic function that grows by 2π around the poles, in radians, shape [V].

    It is 0 at the poles themselves.
    """
    count = surface.vertex_count
    touches_pole = np.isin(edges, [south, north]).any(axis=1)
    kept = np.flatnonzero(~touches_pole)
    kept_edges, kept_weights = edges[kept], weights[kept]
    tail, head = _edges_left_of(surface, _ascent(surface.vertex_count, edges, level, south, north))
    key = edges.astype(np.int64)[:, 0] * count + edges[:, 1]
    slot = np.searchsorted(key, np.minimum(tail, head) * np.int64(count) + np.maximum(tail, head))
    jump = np.zeros(len(edges))
    jump[slot] = np.where(tail < head, 1.0, -1.0)
    flow = 2.0 * np.pi * jump[kept] * kept_weights
    right = np.bincount(kept_edges[:, 1], flow, count) - np.bincount(kept_edges[:, 0], flow, count)
    laplacian = weighted_laplacian(count, kept_edges, kept_weights)
    # Both poles are cut off from the rest; one more vertex is pinned to fix the rotation.
    free = np.setdiff1d(np.arange(count), [south, north])[1:]
    longitude = np.zeros(count)
    longitude[free] = Factorization(laplacian[free][:, free]).solve(right[free])
    return longitude


def _ascent(count: int, edges, level, south: int, north: int) -> NDArray[np.int64]:
    """Return the vertices of the steepest-ascent edge path from the south pole to the north pole."""
    tail, head = np.r_[edges[:, 0], edges[:, 1]], np.r_[edges[:, 1], edges[:, 0]]
    order = np.lexsort((level[head], tail))
    last = np.cumsum(np.bincount(tail, minlength=count)) - 1
    upward = head[order[last]]
    path = [south]
    while path[-1] != north:
        step = int(upward[path[-1]])
        if level[step] <= level[path[-1]]:  # flat to round-off: finish along a shortest path
            return np.array(path[:-1] + _shortest_path(count, edges, path[-1], north), dtype=np.int64)
        path.append(step)
    return np.array(path, dtype=np.int64)


def _regular_tetrahedron(faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the map of a tetrahedron, the only closed surface in which all vertices are neighbours."""
    corners = np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]) / np.sqrt(3.0)
    return corners if np.linalg.det(corners[faces[0]]) > 0 else -corners


def _shortest_path(count: int, edges, start: int, end: int) -> list[int]:
    graph = sparse.csr_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, previous = dijkstra(graph, directed=False, indices=end, return_predecessors=True, unweighted=True)
    path = [start]
    while path[-1] != end:
        path.append(int(previous[path[-1]]))
    return path


def _edges_left_of(surface: Surface, path: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the tails and heads of the half-edges that leave the path's inner vertices to its left.

    All inner vertices turn through their fans together: from the next vertex of the path counter-clockwise to the
    previous one.
    """
    count = np.int64(surface.vertex_count)
    faces = surface.faces.astype(np.int64)
    tail, head, apex = faces.ravel(), np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()
    order = np.argsort(tail * count + head)
    keys, apexes = (tail * count + head)[order], apex[order]
    centre, spoke, stop = path[1:-1], path[2:], path[:-2]
    tails, heads = [], []
    while len(centre):
        # The face left of the half-edge centre -> spoke has the next spoke, counter-clockwise, as its third vertex.
        spoke = apexes[np.searchsorted(keys, centre * count + spoke)]
        going = spoke != stop
        centre, spoke, stop = centre[going], spoke[going], stop[going]
        tails.append(centre)
        heads.append(spoke)
    if not tails:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    return np.concatenate(tails), np.concatenate(heads)
