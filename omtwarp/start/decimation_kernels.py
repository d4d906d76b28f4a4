"""Kernels of one round of simplification: which vertices can be removed, at which cost, and which at the same time.

A mesh is given by its half-edges sorted by (tail, head): row ``v`` of ``offsets`` holds the half-edges that leave
``v``, with ``heads`` their other end and ``thirds`` the vertex opposite in their face (v, head, third), which is also
the neighbour of ``v`` that follows ``head`` counter-clockwise.
"""

from enum import IntEnum

from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ONE, TWO, ZERO, wp
from omtwarp.geometry.spherical import TINY

wp.set_module_options(KERNEL_OPTIONS)

# Vertices of higher degree wait until neighbours have been removed. A closed triangulation of the sphere always has a
# vertex of degree at most 5, and one of degree at most 5 can always be removed, so that waiting ends.
MAX_VALENCE = 12
_MAX_VALENCE = wp.constant(MAX_VALENCE)
Ring = wp.types.vector(length=MAX_VALENCE, dtype=wp.int32)

NO_KEY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))  # the largest int64, after every key


class Vertex(IntEnum):
    """Kinds of vertices of a surface with a boundary whose hole a fan around one vertex closes."""

    INSIDE = 0
    RIM = 1
    POLE = 2


@wp.func
def row_find(sorted_heads: wp.array[wp.int32], begin: wp.int32, end: wp.int32, value: wp.int32) -> wp.int32:
    """Return the index of ``value`` in one row of sorted heads, -1 where it is absent."""
    low = int(begin)
    high = int(end)
    while low < high:
        middle = (low + high) // 2
        if sorted_heads[middle] < value:
            low = middle + 1
        else:
            high = middle
    if low < end and sorted_heads[low] == value:
        return low
    return -1


@wp.func
def connected(u: wp.int32, v: wp.int32, offsets: wp.array[wp.int32], heads: wp.array[wp.int32]) -> bool:
    """Return whether ``u`` and ``v`` share an edge; looks in the shorter row."""
    if offsets[u + 1] - offsets[u] > offsets[v + 1] - offsets[v]:
        return row_find(heads, offsets[v], offsets[v + 1], u) >= 0
    return row_find(heads, offsets[u], offsets[u + 1], v) >= 0


@wp.func
def ring_from(
    start: wp.int32, begin: wp.int32, end: wp.int32, heads: wp.array[wp.int32], thirds: wp.array[wp.int32]
) -> Ring:
    """Collect a vertex's neighbours counter-clockwise from half-edge ``start``.

    Entry 0 is -1 where the faces are not one closed fan.
    """
    ring = Ring()
    slot = int(start)
    for k in range(end - begin):
        if k > 0 and slot == start:
            ring[0] = -1
            return ring
        ring[k] = heads[slot]
        slot = row_find(heads, begin, end, thirds[slot])
        if slot < 0:
            ring[0] = -1
            return ring
    if slot != start:
        ring[0] = -1
    return ring


@wp.func
def fan_is_new(
    ring: Ring, valence: wp.int32, apex: wp.int32, offsets: wp.array[wp.int32], heads: wp.array[wp.int32]
) -> bool:
    """Return whether the link condition holds.

    No diagonal of the fan from ring entry ``apex`` may be an edge already.
    """
    for k in range(2, valence - 1):
        if connected(ring[apex], ring[(apex + k) % valence], offsets, heads):
            return False
    return True


@wp.func
def shape_penalty(p: wp.vec3d, q: wp.vec3d, r: wp.vec3d, star_normal: wp.vec3d) -> wp.float64:
    """Return a triangle's penalty of shape: 1 if equilateral in the plane of the star, more for slivers and folds."""
    normal = wp.cross(q - p, r - p)
    double_area = wp.length(normal)
    squares = wp.length_sq(q - p) + wp.length_sq(r - q) + wp.length_sq(p - r)
    # Four root three: Σ of squared sides over area, if equilateral
    # Times the shape measure of an equilateral triangle: worse ones count as this, or one needle would outweigh its
    # ring. On scans of 6,000 and 20,000 triangles 200 decimates as 20 does, and 3 changes the embedding's mean angle by
    # 0.5 %.
    shape = wp.min(TWO * squares / wp.max(wp.float64(6.928203230275509) * double_area, TINY), wp.float64(20.0))
    fold = ONE - wp.dot(normal, star_normal) / wp.max(double_area * wp.length(star_normal), TINY)
    return shape * (ONE + fold)


@wp.func
def may_become(removed: wp.int32, kept: wp.int32) -> bool:
    """Return whether a vertex of one kind may be removed towards one of another.

    A boundary keeps its loop where its vertices go along it, and gets no chord where others stay away from it.
    """
    return removed == kept and (removed == Vertex.INSIDE or removed == Vertex.RIM)


@wp.kernel
def propose_collapses(
    alive: wp.array[wp.int32],
    kinds: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    heads: wp.array[wp.int32],
    thirds: wp.array[wp.int32],
    half_edge_faces: wp.array[wp.int32],
    face_masses: wp.array[wp.float64],
    points: wp.array[wp.vec3d],
    by_distance: wp.bool,
    # Data out:
    cost: wp.array[wp.float64],
    target: wp.array[wp.int32],
):
    """Find the cheapest legal half-edge collapse of every vertex.

    The outputs are its cost, and the half-edge towards the vertex kept. Cost grows with the mass of the star, or with
    the squared distance to the vertex kept.
    """
    i, _compiled_once = wp.tid()
    v = alive[i]
    begin = offsets[v]
    end = offsets[v + 1]
    valence = end - begin
    best = LARGE  # of a removal that would break the mesh
    best_target = int(-1)
    if valence >= 3 and valence <= _MAX_VALENCE:
        ring = ring_from(begin, begin, end, heads, thirds)
        if ring[0] >= 0:
            mass = wp.float64(0.0)
            star_normal = wp.vec3d()
            for k in range(valence):
                mass += face_masses[half_edge_faces[begin + k]]
                star_normal += wp.cross(points[ring[k]] - points[v], points[ring[(k + 1) % valence]] - points[v])
            for apex in range(valence):
                w = ring[apex]
                if may_become(kinds[v], kinds[w]) and fan_is_new(ring, valence, apex, offsets, heads):
                    shape = wp.float64(0.0)
                    for k in range(1, valence - 1):
                        q = points[ring[(apex + k) % valence]]
                        r = points[ring[(apex + k + 1) % valence]]
                        shape += shape_penalty(points[w], q, r, star_normal)
                    # Valences stay low, so that rings fit the arrays of fixed size and their kernels stay large.
                    # Max free valence: degrees up to which a vertex is not crowded; twelve fit the arrays
                    crowd = wp.float64(wp.max(0, offsets[w + 1] - offsets[w] + valence - 4 - wp.int32(8)))
                    size = mass
                    if by_distance:
                        size = wp.length_sq(points[w] - points[v])
                    total = size * shape / wp.float64(valence - 2) * (ONE + crowd * crowd)
                    if total < best:
                        best = total
                        best_target = row_find(heads, begin, end, w)
    cost[i] = best
    target[i] = best_target


@wp.kernel
def select_minima(
    alive: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    heads: wp.array[wp.int32],
    keys: wp.array[wp.int64],
    # Data out:
    selected: wp.array[wp.bool],
):
    """Mark the vertices to remove in this round: their key is below that of every neighbour.

    No two neighbours are removed together.
    """
    i = wp.tid()
    v = alive[i]
    key = keys[v]
    lowest = key < NO_KEY
    for h in range(offsets[v], offsets[v + 1]):
        if keys[heads[h]] <= key:
            lowest = False
    selected[i] = lowest


@wp.kernel
def gather_rings(
    removed: wp.array[wp.int32],
    targets: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    heads: wp.array[wp.int32],
    thirds: wp.array[wp.int32],
    half_edge_faces: wp.array[wp.int32],
    face_masses: wp.array[wp.float64],
    points: wp.array[wp.vec3d],
    even_share: wp.float64,
    # Data out:
    rings: wp.array2d[wp.int32],
    fan_masses: wp.array2d[wp.float64],
):
    """Compute the ring of every removed vertex, the vertex kept first, and its star's mass shared out over the new fan.

    Shares go by area in space, plus an even part that leaves no triangle without mass.
    """
    i = wp.tid()
    v = removed[i]
    begin = offsets[v]
    end = offsets[v + 1]
    valence = end - begin
    ring = ring_from(targets[i], begin, end, heads, thirds)
    mass = wp.float64(0.0)
    for k in range(valence):
        rings[i, k] = ring[k]
        mass += face_masses[half_edge_faces[begin + k]]
    total = wp.float64(0.0)
    for k in range(1, valence - 1):
        total += wp.length(wp.cross(points[ring[k]] - points[ring[0]], points[ring[k + 1]] - points[ring[0]]))
    even = even_share / wp.float64(valence - 2)
    for k in range(1, valence - 1):
        area = wp.length(wp.cross(points[ring[k]] - points[ring[0]], points[ring[k + 1]] - points[ring[0]]))
        share = ONE / wp.float64(valence - 2)
        if total > ZERO:
            share = (ONE - even_share) * area / total + even
        fan_masses[i, k - 1] = mass * share
