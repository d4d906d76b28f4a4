"""Binary trees of triangles, in which the least value of a function over all of them is looked for; those of the plane.

Triangles, or parts of them, are the leaves of a complete binary tree in heap order, in which node k has the children 2k
and 2k + 1. On a triangle the function is quadratic in barycentric coordinates b,

    Σ_k b_k f_k + b_0 b_1 e_0 + b_1 b_2 e_1 + b_2 b_0 e_2.

In the plane, of a torus's universal cover, the potential ψ is such a function on every image triangle with corners p_k.
With U = |z|²/2 - ψ(z), which has the same form, |x - z|²/2 - ψ(z) = |x|²/2 + U(z) - x · z: to find its least value is
to minimise U less a linear function.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.space_order import in_strips
from omtwarp.mesh.arrays import Floats, Ints, normalised, norms

wp.set_module_options(KERNEL_OPTIONS)

LONGEST_EDGE = 0.25
"""Longest edge of a leaf of the tree, an arc: bounds of nodes err by the third power of their radii."""
SEGMENT = wp.constant(256)  # triangles below a node that one thread goes through at most, a power of two
# Of a node: a slope, the least value of U less the slope, and the least and the largest coordinate along both axes.
vec7d = wp.types.vector(length=7, dtype=wp.float64)


@wp.func
def leaves_below(node: int, leaf_count: int, item_count: int):
    """Return the first and the last leaf below a node, counted from 0; the last is before the first where none is."""
    first = int(node)
    last = int(node)
    while first < leaf_count:
        first = 2 * first
        last = 2 * last + 1
    return first - leaf_count, wp.min(last - leaf_count, item_count - 1)


@wp.func
def next_node(node: int, inside: bool, leaf_count: int) -> int:
    """Return the first node below one of a binary tree in heap order, or after it: from a leaf, or if not inside.

    The root is node 1; 0 comes after the last one.
    """
    if inside and node < leaf_count:
        return 2 * node
    after = int(node)
    while after % 2 == 1 and after > 1:  # up while this is a right child
        after = after // 2
    if after == 1:
        return 0
    return after + 1


@wp.func
def potential_at(nodal: wp.vec3d, edge: wp.vec3d, b: wp.vec3d) -> wp.float64:
    """Return the potential ψ at barycentric coordinates b of a triangle."""
    return wp.dot(b, nodal) + b[0] * b[1] * edge[0] + b[1] * b[2] * edge[1] + b[2] * b[0] * edge[2]


@wp.func
def lowest_on_edge(from_value: wp.float64, to_value: wp.float64, edge: wp.float64) -> wp.float64:
    """Return where (1 - r) from + r to + r (1 - r) edge is least over 0 <= r <= 1."""
    if edge < ZERO:
        r = HALF * (to_value - from_value + edge) / edge
        return wp.min(wp.max(r, ZERO), ONE)
    if to_value < from_value:
        return ONE
    return ZERO


@wp.func
def lowest_on_triangle(nodal: wp.vec3d, edge: wp.vec3d) -> wp.vec3d:
    """Return the barycentric coordinates where Σ b_k nodal_k + Σ b_k b_k+1 edge_k is least over the triangle."""
    # With b = (1 - s - t, s, t).
    mixed = edge[1] - edge[0] - edge[2]
    det = wp.float64(4.0) * edge[0] * edge[2] - mixed * mixed
    if edge[0] < ZERO and det > ZERO:
        p = nodal[1] - nodal[0] + edge[0]
        q = nodal[2] - nodal[0] + edge[2]
        s = (TWO * edge[2] * p + mixed * q) / det
        t = (TWO * edge[0] * q + mixed * p) / det
        if s >= ZERO and t >= ZERO and s + t <= ONE:
            return wp.vec3d(ONE - s - t, s, t)
    best = LARGE
    out = wp.vec3d()
    for k in range(3):
        r = lowest_on_edge(nodal[k], nodal[(k + 1) % 3], edge[k])
        b = wp.vec3d()
        b[k] = ONE - r
        b[(k + 1) % 3] = r
        value = potential_at(nodal, edge, b)
        if value < best:
            best = value
            out = b
    return out


def order_by_halves(points: Floats) -> Ints:
    """Order points so that those below each node of a complete binary tree in heap order lie close together.

    Each node's points are halved along the longest side of their bounding box, by SciPy's k-d tree; points beside them
    fill the last leaves, so that its medians are those of the complete tree.

    Args:
        points: shape [N, 3].

    Returns:
        The order, shape [N]; the order's first N leaves of 2^k, the least such number that is at least N, are taken.
    """
    from scipy.spatial import cKDTree  # takes a twentieth of a second to import

    beside = np.zeros((leaf_count(len(points)) - len(points), 3))
    beside[:, 0] = points[:, 0].max() + np.ptp(points[:, 0]) * np.linspace(1.0, 2.0, len(beside)) + 1.0
    order = cKDTree(np.concatenate([points, beside]), leafsize=1).indices
    return order[order < len(points)].astype(np.int32)


def interleaved(count: int, parts: int) -> Ints:
    """Return the numbers below ``count``, first every ``parts``-th one, then those that follow them, and so on."""
    return np.concatenate([np.arange(first, count, parts, dtype=np.int32) for first in range(parts)])


def tree_segments(leaves: int) -> tuple[Ints, Ints]:
    """Cut the leaves below every node of a complete binary tree in heap order into segments.

    Args:
        leaves: a power of two.

    Returns:
        The first segment of every node, and the number of all segments at the end, shape [2 leaves + 1]; and of every
        segment its node and its number there, shape [S, 2].
    """
    nodes = np.arange(2 * leaves)
    below = leaves >> np.frexp(np.maximum(nodes, 1))[1] - 1
    counts = np.maximum(below // int(SEGMENT), 1)
    counts[0] = 1  # no node
    offsets = np.concatenate([[0], np.cumsum(counts)])
    node = np.repeat(nodes, counts)
    segments = np.stack([node, np.arange(len(node)) - offsets[node]], axis=1)
    return offsets.astype(np.int32), segments.astype(np.int32)


def leaf_count(items: int) -> int:
    """Return the smallest power of two that is at least 2 and at least ``items``."""
    return 1 << max(items - 1, 1).bit_length()


@wp.func
def lowered(x: wp.vec2d, corners: wp.array2d[wp.vec2d], heights: wp.array[wp.vec3d], f: int) -> wp.vec3d:
    """Return U(z) - x · z at the corners of a triangle."""
    return heights[f] - wp.vec3d(wp.dot(x, corners[f, 0]), wp.dot(x, corners[f, 1]), wp.dot(x, corners[f, 2]))


@wp.kernel
def build_plane_nodes(
    corners: wp.array2d[wp.vec2d],
    heights: wp.array[wp.vec3d],
    bulges: wp.array[wp.vec3d],
    slopes: wp.array[wp.vec2d],
    face_count: int,
    leaf_count: int,
    # Data out:
    nodes: wp.array[vec7d],
):
    """Find a rectangle that holds the triangles below a node, and a linear function below U on them."""
    node = wp.tid()
    model = vec7d()
    model[2] = LARGE
    nodes[node] = model
    if node == 0:
        return
    first, last = leaves_below(node, leaf_count, face_count)
    if first > last:
        return
    slope = wp.vec2d()
    for f in range(first, last + 1):
        slope += slopes[f]
    slope = slope / wp.float64(last - first + 1)
    least = LARGE
    low = corners[first, 0]
    high = corners[first, 0]
    for f in range(first, last + 1):
        above = lowered(slope, corners, heights, f)
        least = wp.min(least, potential_at(above, bulges[f], lowest_on_triangle(above, bulges[f])))
        for k in range(3):
            low = wp.min(low, corners[f, k])
            high = wp.max(high, corners[f, k])
    nodes[node] = vec7d(slope[0], slope[1], least, low[0], high[0], low[1], high[1])


@wp.kernel
def best_images(
    points: wp.array[wp.vec2d],
    seeds: wp.array[wp.float64],
    copies: wp.array[wp.vec2d],
    corners: wp.array2d[wp.vec2d],
    heights: wp.array[wp.vec3d],
    bulges: wp.array[wp.vec3d],
    nodes: wp.array[vec7d],
    leaf_count: int,
    tolerance: wp.float64,
    # Data out:
    proven: wp.array[wp.float64],
    leaf: wp.array[wp.int32],
    shares: wp.array[wp.vec3d],
):
    """Compute φ(x), the least |x - z|²/2 - ψ(z) over the copies of all triangles.

    A branch is skipped where its bound proves that it has no value below the best so far less the tolerance. ``proven``
    is the lower of the least value found and of all bounds that were relied upon. ``leaf`` is -1 where nothing lower
    than the seed was found.
    """
    i = wp.tid()
    best = seeds[i] + ZERO
    best_leaf = int(-1)
    best_shares = wp.vec3d()
    relied = LARGE
    for copy in range(copies.shape[0]):
        x = points[i] - copies[copy]
        own = HALF * wp.dot(x, x)
        node = int(1)
        while node > 0:
            inside = bool(False)
            model = nodes[node]
            if model[2] < LARGE:
                dx = model[0] - x[0]
                dy = model[1] - x[1]
                bound = own + model[2] + wp.min(dx * model[3], dx * model[4]) + wp.min(dy * model[5], dy * model[6])
                inside = bound < best - tolerance
                if not inside:
                    relied = wp.min(relied, bound - wp.float64(1.0e-14))  # that rounding may add
            if inside and node >= leaf_count:
                f = node - leaf_count
                above = lowered(x, corners, heights, f)
                at = lowest_on_triangle(above, bulges[f])
                value = own + potential_at(above, bulges[f], at)
                if value < best:
                    best = value
                    best_leaf = f
                    best_shares = at
            node = next_node(node, inside, leaf_count)
    proven[i] = wp.min(best, relied)
    leaf[i] = best_leaf
    shares[i] = best_shares


def narrow_parts(points: Floats, faces: Ints) -> tuple[NDArray[np.int64], Floats]:
    """Cut triangles of a sphere in strips along their shortest edge until no edge is longer than ``LONGEST_EDGE``.

    Args:
        points: unit vectors, shape [V, 3].
        faces: shape [F, 3].

    Returns:
        The triangle that every part is of, shape [P], and the parts' corners in barycentric coordinates there, shape
        [P, 3, 3].
    """
    triangles, corners = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3))
    finished: list[tuple[NDArray[np.int64], Floats]] = []
    # Rounds: two cut a triangle both ways, others what is uneven; more need ends of edges that are nearly opposite
    for _ in range(8):
        places = normalised(corners @ points[faces[triangles]])
        arcs = 2.0 * np.arcsin(np.minimum(0.5 * norms(places - np.roll(places, -1, axis=1)), 1.0))
        long = arcs.max(axis=1) > LONGEST_EDGE
        finished.append((triangles[~long], corners[~long]))
        triangles, corners = triangles[long], corners[long]
        if len(triangles) == 0:
            break
        arc = arcs[long].max(axis=1)
        counts = np.ceil(arc / LONGEST_EDGE).astype(np.int64)
        step = arc / counts

        def equal_arcs(strip: NDArray[np.int64], of: NDArray[np.intp], counts=counts, step=step) -> Floats:
            ahead, behind = np.sin(strip * step[of]), np.sin((counts[of] - strip) * step[of])
            return ahead / np.maximum(ahead + behind, np.finfo(float).tiny)

        of, corners = in_strips(corners, arcs[long].argmin(axis=1), counts, equal_arcs)
        triangles = triangles[of]
    finished.append((triangles, corners))
    return np.concatenate([part for part, _ in finished]), np.concatenate([part for _, part in finished])
