"""Simplification of a closed genus-0 mesh to a tetrahedron, in rounds of independent half-edge collapses.

Every round removes a set of vertices no two of which are neighbours; each star is replaced by a fan from one vertex of
its ring. The rounds, read backwards, are the progressive mesh of Praun and Hoppe, "Spherical parametrization and
remeshing" (2003), section 3, whose vertices are reinserted many at a time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from omtwarp.device.start import LARGE, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import TINY, Floats, Ints
from omtwarp.mesh.surface import Surface
from omtwarp.start.decimation_kernels import MAX_VALENCE, NO_KEY, Vertex, gather_rings, propose_collapses, select_minima


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


def integers(values: NDArray, device: wp.Device) -> wp.array:
    """Copy an integer array to the device as int32."""
    return wp.array(values, dtype=wp.int32, device=device)


def simplify(surface: Surface, device: wp.Device, *, by_distance: bool = False, kinds: Ints | None = None) -> Hierarchy:
    """Remove vertices until four are left, or five where some are on a boundary.

    Args:
        surface: Closed, oriented manifold of genus 0.
        device: Where the rounds' kernels run.
        by_distance: remove the vertices that are nearest to others first, in place of those with the smallest triangles
            around them. Where triangles differ in area by orders of magnitude, needles beside a large triangle would
            stay until last.
        kinds: whether each vertex is inside a surface, on its boundary, or the pole of the fan that closes its hole
            (``INSIDE``, ``RIM`` and ``POLE`` of :mod:`omtwarp.start.decimation_kernels`), shape [V]; all inside by
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
    points: wp.array = wp.array(surface.scaled_vertices, dtype=wp.vec3d, device=device)
    alive = np.arange(count, dtype=np.int32)
    # Share of a star's mass that is divided evenly over its fan, independent of areas in space.
    # The same where vertices are removed by distance: large triangles lose it to every small one beside them. Areas of
    # a drawn box's coarse levels differ by at most 1 % of the whole from the surface's with this, by up to 31 % with
    # 0.2.
    even_share = 1e-6 if by_distance else 0.2
    device_kinds = integers(np.full(count, Vertex.INSIDE) if kinds is None else kinds, device)
    fewest = 4 if kinds is None else 5
    levels: list[Level] = []
    removals: list[Removal] = []
    while True:
        offsets, heads, thirds, half_edge_faces = _half_edges(faces, count)
        compact = np.append(offsets[alive], offsets[-1])
        levels.append(Level(alive, compact, heads, thirds, half_edge_faces, masses))
        if len(alive) == fewest:
            break
        adjacency = [integers(x, device) for x in (offsets, heads, thirds, half_edge_faces)]
        device_masses: wp.array = wp.array(masses, dtype=wp.float64, device=device)
        device_alive = integers(alive, device)
        cost, target = _propose(device_alive, device_kinds, adjacency, device_masses, points, by_distance, device)
        chosen = _select(cost, alive, count, len(removals), device_alive, adjacency, device)
        valences = np.diff(offsets)[alive[chosen]]
        rings, fan_masses = _rings(alive[chosen], target[chosen], adjacency, device_masses, points, even_share, device)
        keep = _without_repeated_diagonals(rings, valences, count)
        chosen, rings, valences, fan_masses = chosen[keep], rings[keep], valences[keep], fan_masses[keep]
        removal = Removal(alive[chosen], rings, valences)
        faces, masses = _refan(faces, masses, removal, fan_masses, count)
        alive = np.delete(alive, chosen)
        removals.append(removal)
    return Hierarchy(levels, removals, faces)


def _require_sphere_topology(faces: Ints, count: int) -> None:
    """Require each edge once in each direction, no unused vertex and Euler's number 2."""
    tails, heads = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    if len(faces) == 0 or not (np.bincount(tails, minlength=count) > 0).all():
        raise OmtwarpError("the mesh has vertices that no face uses: remove them with --repair")
    forward = np.sort(tails * count + heads)
    backward = np.sort(heads * count + tails)
    if (forward[1:] == forward[:-1]).any() or not np.array_equal(forward, backward):
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


def _propose(
    alive: wp.array,
    kinds: wp.array,
    adjacency: list[wp.array],
    masses: wp.array,
    points: wp.array,
    by_distance: bool,
    device: wp.Device,
) -> tuple[Floats, Ints]:
    cost: wp.array = wp.empty(len(alive), dtype=wp.float64, device=device)
    target: wp.array = wp.empty(len(alive), dtype=wp.int32, device=device)
    wp.launch(
        propose_collapses,
        dim=len(alive),
        inputs=[alive, kinds, *adjacency, masses, points, by_distance],
        outputs=[cost, target],
        device=device,
    )
    return cost.numpy(), target.numpy()


def _select(
    cost: Floats,
    alive: Ints,
    count: int,
    round_index: int,
    device_alive: wp.array,
    adjacency: list[wp.array],
    device: wp.Device,
) -> NDArray[np.int64]:
    """Choose an independent set of vertices that are cheap to remove; return their positions in ``alive``."""
    legal = np.flatnonzero(cost < float(LARGE))
    if len(legal) == 0:
        raise OmtwarpError(
            f"simplification stopped at {len(alive)} vertices: the mesh is not one closed manifold of genus 0"
        )
    # Below this many vertices one goes at a time: independent removals of tiny meshes can produce the same face twice.
    if len(alive) <= 8:
        return legal[[np.argmin(cost[legal])]].astype(np.int64)
    # Only the cheaper part of the candidates takes part in a round: order by cost, at the price of more rounds.
    bound = np.quantile(cost[legal], 0.6)
    candidates = legal[cost[legal] <= bound]
    # Equal costs up to 20 % are put in random order: strictly by cost, local minima are few and the rounds many.
    classes = np.floor(4.0 * np.log2(np.maximum(cost[candidates], TINY))).astype(np.int64) + (1 << 15)
    keys = np.full(count, int(NO_KEY), dtype=np.int64)
    keys[alive[candidates]] = (classes << 32) | _scramble(alive[candidates], round_index)
    selected: wp.array = wp.empty(len(alive), dtype=wp.bool, device=device)
    wp.launch(
        select_minima,
        dim=len(alive),
        inputs=[device_alive, adjacency[0], adjacency[1], wp.array(keys, dtype=wp.int64, device=device)],
        outputs=[selected],
        device=device,
    )
    return np.flatnonzero(selected.numpy())


def _scramble(indices: Ints, round_index: int) -> NDArray[np.int64]:
    """Return distinct pseudo-random 32-bit numbers for distinct indices (the finaliser of MurmurHash3, a bijection)."""
    x = indices.astype(np.uint32) ^ np.uint32((round_index * 0x9E3779B9) & 0xFFFFFFFF)
    x = (x ^ (x >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    x = (x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    return (x ^ (x >> np.uint32(16))).astype(np.int64)


def _rings(
    removed: Ints,
    targets: Ints,
    adjacency: list[wp.array],
    masses: wp.array,
    points: wp.array,
    even_share: float,
    device: wp.Device,
) -> tuple[Ints, Floats]:
    rings: wp.array = wp.zeros((len(removed), MAX_VALENCE), dtype=wp.int32, device=device)
    fan_masses: wp.array = wp.zeros((len(removed), MAX_VALENCE - 2), dtype=wp.float64, device=device)
    wp.launch(
        gather_rings,
        dim=len(removed),
        inputs=[integers(removed, device), integers(targets, device), *adjacency, masses, points, even_share],
        outputs=[rings, fan_masses],
        device=device,
    )
    return rings.numpy(), fan_masses.numpy()


def _without_repeated_diagonals(rings: Ints, valences: Ints, count: int) -> NDArray[np.int64]:
    """Return the rows of ``rings`` such that no two fans add the same edge; of two that would, the first stays."""
    slots = np.arange(2, MAX_VALENCE - 1)
    row, column = np.nonzero(slots[None, :] < (valences - 1)[:, None])
    ends = np.sort(np.stack([rings[row, 0], rings[row, slots[column]]], axis=1), axis=1).astype(np.int64)
    keys = ends[:, 0] * count + ends[:, 1]
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    clashing = np.unique(row[first[inverse] != np.arange(len(keys))])
    return np.delete(np.arange(len(rings)), clashing)


def _refan(faces: Ints, masses: Floats, removal: Removal, fan_masses: Floats, count: int) -> tuple[Ints, Floats]:
    """Return the faces and masses after fans have replaced the stars of the removed vertices."""
    gone = np.zeros(count, dtype=bool)
    gone[removal.vertices] = True
    kept = ~gone[faces].any(axis=1)
    slots = np.arange(1, MAX_VALENCE - 1)
    row, column = np.nonzero(slots[None, :] < (removal.valences - 1)[:, None])
    slot = slots[column]
    fans = np.stack([removal.rings[row, 0], removal.rings[row, slot], removal.rings[row, slot + 1]], axis=1)
    return np.concatenate([faces[kept], fans]), np.concatenate([masses[kept], fan_masses[row, column]])
