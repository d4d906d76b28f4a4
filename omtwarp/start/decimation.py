"""Simplification of a closed genus-0 mesh to a tetrahedron, in rounds of independent half-edge collapses.

Every round removes a set of vertices no two of which are neighbours; each star is replaced by a fan from one vertex of
its ring. The rounds, read backwards, are the progressive mesh of Praun and Hoppe, "Spherical parametrization and
remeshing" (2003), section 3, whose vertices are reinserted many at a time.

Kernels find which vertices can be removed, at which cost, and which at the same time. A mesh is given by its half-edges
sorted by (tail, head): row ``v`` of ``offsets`` holds the half-edges that leave ``v``, with ``heads`` their other end
and ``thirds`` the vertex opposite in their face (v, head, third), which is also the neighbour of ``v`` that follows
``head`` counter-clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy import sparse

from omtwarp.device.arrays import sent
from omtwarp.device.start import KERNEL_OPTIONS, LARGE, ONE, TWO, wp
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.spherical import TINY
from omtwarp.mesh.arrays import Floats, Indices, Ints, edge_keys, marked
from omtwarp.mesh.patches import touching
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.mesh.validate import Topology

wp.set_module_options(KERNEL_OPTIONS)

# Vertices of higher degree wait until neighbours have been removed. A closed triangulation of the sphere always has a
# vertex of degree at most 5, and one of degree at most 5 can always be removed, so that waiting ends.
MAX_VALENCE = 12
_MAX_VALENCE = wp.constant(MAX_VALENCE)
Ring = wp.types.vector(length=MAX_VALENCE, dtype=wp.int32)

# Share of a star's mass that is divided evenly over its fan, the rest by area in space: more evens out the areas of
# coarse levels, less follows those of the surface. Of 56 made surfaces the tenth with the worst areas begins at a
# distortion of 2.34 with 0.001 and of 2.32 with this; their means are the same.
EVEN_SHARE = 0.2
# Candidates that take part in a round, the cheapest of all: more take fewer rounds, and go out of order (a person's
# angle distortion is 10.66 with this, 11.25 with all).
CHEAPER_SHARE = 0.6
# Degrees up to which a vertex is not crowded; twelve fit the arrays. More leaves coarse levels less regular (a person's
# area distortion is 2.029 with this, 2.033 without crowding).
FREE_VALENCE = wp.constant(8)
# Times the shape measure of an equilateral triangle: worse ones count as this, or one needle would outweigh its ring.
# On scans of 6,000 and 20,000 triangles 200 decimates as 20 does.
WORST_SHAPE = wp.constant(wp.float64(20.0))


class Vertex(IntEnum):
    """Kinds of vertices of a surface with a boundary whose hole a fan around one vertex closes."""

    INSIDE = 0
    RIM = 1
    POLE = 2


@wp.func
def row_find(sorted_heads: wp.array[wp.int32], begin: wp.int32, end: wp.int32, value: wp.int32) -> wp.int32:
    """Return the index of ``value`` in one row of sorted heads, -1 where it is absent."""
    if begin < end:
        place = wp.lower_bound(sorted_heads, begin, end, value)
        if sorted_heads[place] == value:
            return place
    return -1


@wp.func
def connected(u: wp.int32, v: wp.int32, offsets: wp.array[wp.int32], heads: wp.array[wp.int32]) -> bool:
    """Return whether ``u`` and ``v`` share an edge; looks in the shorter row."""
    if offsets[u + 1] - offsets[u] > offsets[v + 1] - offsets[v]:
        return row_find(heads, offsets[v], offsets[v + 1], u) >= 0
    return row_find(heads, offsets[u], offsets[u + 1], v) >= 0


@wp.func
def ring_of(begin: wp.int32, end: wp.int32, heads: wp.array[wp.int32], thirds: wp.array[wp.int32]) -> Ring:
    """Collect a vertex's neighbours counter-clockwise from its first half-edge ``begin``.

    Entry 0 is -1 where the faces are not one closed fan.
    """
    ring = Ring()
    slot = int(begin)
    for k in range(end - begin):
        if slot < 0 or (k > 0 and slot == begin):
            ring[0] = -1
            return ring
        ring[k] = heads[slot]
        slot = row_find(heads, begin, end, thirds[slot])
    if slot != begin:
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
    shape = wp.min(TWO * squares / wp.max(wp.float64(6.928203230275509) * double_area, TINY), WORST_SHAPE)
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
    star_masses: wp.array[wp.float64],
    points: wp.array[wp.vec3d],
    # Data out:
    cost: wp.array[wp.float64],
    rings: wp.array2d[wp.int32],
):
    """Find the cheapest legal half-edge collapse of every vertex.

    The outputs are its cost, which grows with the mass of the star, and the vertex's ring, the vertex kept first.
    """
    i, _compiled_once = wp.tid()
    v = alive[i]
    begin = offsets[v]
    end = offsets[v + 1]
    valence = end - begin
    best = LARGE  # of a removal that would break the mesh
    first = int(0)  # entry of the ring that is kept
    if valence >= 3 and valence <= _MAX_VALENCE:
        ring = ring_of(begin, end, heads, thirds)
        if ring[0] >= 0:
            star_normal = wp.vec3d()
            for k in range(valence):
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
                    crowd = wp.float64(wp.max(0, offsets[w + 1] - offsets[w] + valence - 4 - FREE_VALENCE))
                    total = star_masses[v] * shape / wp.float64(valence - 2) * (ONE + crowd * crowd)
                    if total < best:
                        best = total
                        first = apex
            for k in range(valence):
                rings[i, k] = ring[(first + k) % valence]
    cost[i] = best


@dataclass
class Level:
    """One mesh of the hierarchy, its vertices numbered as in the input.

    Attributes:
        vertices: Vertices of this level in ascending order, int32, shape [n].
        offsets: Row of every vertex of ``vertices`` in the half-edge arrays, int32, shape [n + 1].
        heads: Other end of every half-edge, sorted in each row, int32, shape [3f].
        thirds: Opposite vertex in the half-edge's face (vertex, head, third), int32, shape [3f].
        half_edge_faces: The half-edge's face, int32, shape [3f].
        face_masses: Area every face shall have on the sphere, sum 4π, shape [f].
    """

    vertices: Ints
    offsets: Ints
    heads: Ints
    thirds: Ints
    half_edge_faces: Ints
    face_masses: Floats


@dataclass
class Removal:
    """Vertices that went from one level to the next coarser one.

    Attributes:
        vertices: int32, shape [m]; no two are neighbours.
        rings: Their neighbours counter-clockwise, the vertex they collapsed to first, int32, shape [m, MAX_VALENCE].
        valences: Length of every ring, int32, shape [m].
    """

    vertices: Ints
    rings: Ints
    valences: Ints


@dataclass
class Hierarchy:
    """Levels from the input (first) to the coarsest, mostly a tetrahedron.

    Attributes:
        levels: the meshes.
        removals: of vertices; number k leads from level k to level k + 1.
        coarsest: faces of the last level, shape [4, 3], or [6, 3] where some vertices are on a boundary.
    """

    levels: list[Level]
    removals: list[Removal]
    coarsest: Ints


def simplify(surface: Surface, device: wp.Device, *, kinds: Ints | None = None) -> Hierarchy:
    """Remove vertices until four are left, or five where some are on a boundary.

    Args:
        surface: Closed, oriented manifold of genus 0.
        device: Where the rounds' kernels run.
        kinds: whether each vertex is inside a surface, on its boundary, or the pole of the fan that closes its hole
            (``INSIDE``, ``RIM`` and ``POLE`` of :mod:`omtwarp.start.decimation`), shape [V]; all inside by
            default. The boundary stays a loop without chords, of three vertices in the end, and the pole stays.

    Raises:
        OmtwarpError: the mesh is not closed, oriented, manifold, connected or not of genus 0.
    """
    count = surface.vertex_count
    faces = surface.faces
    _require_sphere_topology(faces, count)
    # Least mass of a face, relative to the mean: the mass of a sliver would be no barrier against its flip.
    masses = np.maximum(surface.face_areas, 1e-3 * surface.face_areas.mean())
    masses *= 4.0 * np.pi / masses.sum()
    points = sent(surface.scaled_vertices, wp.vec3d, device)
    alive = np.arange(count, dtype=np.int32)
    kinds = np.full(count, Vertex.INSIDE) if kinds is None else kinds
    device_kinds = sent(kinds, wp.int32, device)
    fewest = 5 if Vertex.POLE in kinds else 4
    levels: list[Level] = []
    removals: list[Removal] = []
    while True:
        offsets, heads, thirds, half_edge_faces = _half_edges(faces, count)
        compact = np.append(offsets[alive], offsets[-1])
        levels.append(Level(alive, compact, heads, thirds, half_edge_faces, masses))
        if len(alive) == fewest:
            break
        star_masses = np.bincount(np.repeat(np.arange(count), np.diff(offsets)), masses[half_edge_faces], count)
        adjacency = [sent(x, wp.int32, device) for x in (offsets, heads, thirds)]
        cost: wp.array = wp.empty(len(alive), dtype=wp.float64, device=device)
        of_vertices: wp.array = wp.zeros((len(alive), MAX_VALENCE), dtype=wp.int32, device=device)
        vertices, stars = sent(alive, wp.int32, device), sent(star_masses, wp.float64, device)
        inputs = [vertices, device_kinds, *adjacency, stars, points]
        wp.launch(propose_collapses, dim=len(alive), inputs=inputs, outputs=[cost, of_vertices], device=device)
        rings, valences = of_vertices.numpy(), np.diff(compact)
        chosen = _select(cost.numpy(), levels[-1], count, len(removals))
        chosen = _without_repeated_diagonals(chosen, rings, valences, count)
        removal = Removal(alive[chosen], rings[chosen], valences[chosen])
        fans, shares, star = _fans(surface.scaled_vertices, removal)
        kept = ~touching(faces, marked(count, removal.vertices))
        faces = np.concatenate([faces[kept], fans])
        masses = np.concatenate([masses[kept], star_masses[removal.vertices[star]] * shares])
        alive = np.delete(alive, chosen)
        removals.append(removal)
    return Hierarchy(levels, removals, faces)


def _require_sphere_topology(faces: Ints, count: int) -> None:
    """Require each edge once in each direction, no unused vertex and Euler's number 2."""
    if len(faces) == 0 or not marked(count, faces).all():
        raise OmtwarpError("the mesh has vertices that no face uses: remove them with omtwarp.repair")
    topology = Topology(faces.astype(np.int64), count)
    if (topology.edge_face_count != 2).any() or topology.clashing_edges.any():
        raise OmtwarpError("the mesh is not a closed, oriented manifold: a sphere map needs every edge in two faces")
    euler = count - len(faces) // 2
    if euler != 2:
        raise OmtwarpError(f"the mesh has Euler number {euler}, a sphere has 2: it has handles or several components")


def _half_edges(faces: Ints, count: int) -> tuple[Ints, ...]:
    """Return half-edges sorted by (tail, head): offsets [V + 1], heads, thirds and faces [3F]."""
    half_edges = np.arange(faces.size, dtype=np.int32)
    rows = sparse.csr_matrix((half_edges, (faces.ravel(), np.roll(faces, -1, axis=1).ravel())), shape=(count, count))
    order = rows.data
    thirds = np.roll(faces, -2, axis=1).ravel()[order]
    return rows.indptr.astype(np.int32), rows.indices.astype(np.int32), thirds, order // np.int32(3)


def _select(cost: Floats, level: Level, count: int, round_index: int) -> Indices:
    """Choose an independent set of vertices that are cheap to remove; return their positions in the level's."""
    alive = level.vertices
    legal = np.flatnonzero(cost < float(LARGE))
    if len(legal) == 0:
        raise OmtwarpError(
            f"simplification stopped at {len(alive)} vertices: the mesh is not one closed manifold of genus 0"
        )
    # Below this many vertices one goes at a time: independent removals of tiny meshes can produce the same face twice.
    if len(alive) <= 8:
        return legal[[np.argmin(cost[legal])]].astype(np.int64)
    # Only the cheaper part of the candidates takes part in a round: order by cost, at the price of more rounds.
    bound = np.quantile(cost[legal], CHEAPER_SHARE)
    candidates = legal[cost[legal] <= bound]
    # Equal costs up to 20 % are put in random order: strictly by cost, local minima are few and the rounds many.
    classes = np.floor(4.0 * np.log2(np.maximum(cost[candidates], float(TINY)))).astype(np.int64) + (1 << 15)
    keys = np.full(count, np.iinfo(np.int64).max)
    keys[alive[candidates]] = (classes << 32) | _scramble(alive[candidates], round_index)
    # A vertex goes whose key is below that of every neighbour: no two neighbours go together.
    return np.flatnonzero(keys[alive] < np.minimum.reduceat(keys[level.heads], level.offsets[:-1]))


def _scramble(indices: Ints, round_index: int) -> Indices:
    """Return distinct pseudo-random 32-bit numbers for distinct indices (the finaliser of MurmurHash3, a bijection)."""
    x = indices.astype(np.uint32) ^ np.uint32((round_index * 0x9E3779B9) & 0xFFFFFFFF)
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    x = (x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    return (x ^ (x >> np.uint32(16))).astype(np.int64)


def _without_repeated_diagonals(chosen: Indices, rings: Ints, valences: Ints, count: int) -> Indices:
    """Return the chosen rows of ``rings`` such that no two fans add the same edge; of two, the first stays."""
    row, k = np.nonzero(np.arange(MAX_VALENCE - 3) < (valences[chosen] - 3)[:, None])
    keys = edge_keys(np.stack([rings[chosen[row], 0], rings[chosen[row], k + 2]], axis=1), count)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return np.delete(chosen, np.unique(row[first[inverse] != np.arange(len(keys))]))


def _fans(points: Floats, removal: Removal) -> tuple[Ints, Floats, Indices]:
    """Return the fans that replace the stars of removed vertices.

    Shares go by area in space, plus an even part that leaves no triangle without mass.

    Returns:
        Their faces, shape [P, 3], the share of its star's mass that each gets, and the number of that star, shape [P].
    """
    star, k = np.nonzero(np.arange(MAX_VALENCE - 2) < (removal.valences - 2)[:, None])
    fans = np.stack([removal.rings[star, 0], removal.rings[star, k + 1], removal.rings[star, k + 2]], axis=1)
    areas, count = triangle_areas(points, fans), (removal.valences - 2)[star]
    total = np.bincount(star, areas)[star]
    by_area = (1.0 - EVEN_SHARE) * areas / np.where(total > 0.0, total, 1.0) + EVEN_SHARE / count
    return fans, np.where(total > 0.0, by_area, 1.0 / count), star
