"""Binary trees of triangles, in which the least value of a function over all of them is looked for.

Triangles, or parts of them, are the leaves of a complete binary tree in heap order, in which node k has the children 2k
and 2k + 1. On a triangle the function is quadratic in barycentric coordinates b,

    Σ_k b_k f_k + b_0 b_1 e_0 + b_1 b_2 e_1 + b_2 b_0 e_2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.space_order import in_strips
from omtwarp.mesh.arrays import Floats, Ints, normalised, norms, row_maxima

wp.set_module_options(KERNEL_OPTIONS)

LONGEST_EDGE = 0.12
"""Longest edge of a leaf of the tree, an arc: bounds of nodes err by the third power of their radii."""


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


def leaf_count(items: int) -> int:
    """Return the smallest power of two that is at least 2 and at least ``items``."""
    return 1 << max(items - 1, 1).bit_length()


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
        places = normalised(corners @ points.take(faces[triangles], axis=0))
        arcs = 2.0 * np.arcsin(np.minimum(0.5 * norms(places - np.roll(places, -1, axis=1)), 1.0))
        arc = row_maxima(arcs)
        long = arc > LONGEST_EDGE
        finished.append((triangles[~long], corners[~long]))
        triangles, corners = triangles[long], corners[long]
        if len(triangles) == 0:
            break
        arc = arc[long]
        counts = np.ceil(arc / LONGEST_EDGE).astype(np.int64)
        step = arc / counts

        def equal_arcs(strip: NDArray[np.int64], of: NDArray[np.intp], counts=counts, step=step) -> Floats:
            ahead, behind = np.sin(strip * step[of]), np.sin((counts[of] - strip) * step[of])
            return ahead / np.maximum(ahead + behind, np.finfo(float).tiny)

        of, corners = in_strips(corners, arcs[long].argmin(axis=1), counts, equal_arcs)
        triangles = triangles[of]
    finished.append((triangles, corners))
    return np.concatenate([part for part, _ in finished]), np.concatenate([part for _, part in finished])
