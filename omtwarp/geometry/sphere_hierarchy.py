"""Nested triangulations of the sphere from the icosahedron (paper, section 3.1 and figure 2).

Every level splits each triangle into four by the midpoints of its edges, pushed out to the sphere. In the paper's
words, K(j) are the nodes of level j, M(j) the midpoints that level j + 1 adds, and K(j + 1) = K(j) ∪ M(j). Nodes are
numbered coarse first, so K(j) is the first ``node_counts[j]`` nodes of any finer level and a transform can work in
place.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from omtwarp.mesh.arrays import Floats, Ints, cross, edge_keys, normalised, norms, whole_number
from omtwarp.mesh.surface import face_neighbours

HIGHEST_LEVEL = 10  # of an icosahedron that has 10 · 4¹⁰ + 2 nodes, ten million


def triangle_solid_angles(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the signed areas of spherical triangles with unit corners, [M, 3] each (Van Oosterom, Strackee 1983)."""
    triple = np.einsum("ij,ij->i", a, cross(b - a, c - a))  # differences: small triangles keep their digits
    dots = [np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a))]
    return np.asarray(2.0 * np.arctan2(triple, 1.0 + dots[0] + dots[1] + dots[2]))


def icosahedron() -> tuple[Floats, Ints]:
    """Return the vertices of an icosahedron on the unit sphere, shape [12, 3], and its outward faces, shape [20, 3]."""
    signs = [(s, t * (1 + np.sqrt(5.0)) / 2) for s in (-1.0, 1.0) for t in (-1, 1)]
    corners = [[0, s, t] for s, t in signs] + [[s, t, 0] for s, t in signs] + [[t, 0, s] for s, t in signs]
    vertices = np.array(corners)
    near = np.isclose(norms(vertices[:, None] - vertices[None]), 2.0)
    faces = []
    for i, j, k in combinations(range(len(vertices)), 3):
        if near[i, j] and near[j, k] and near[i, k]:
            outward = np.linalg.det(vertices[[i, j, k]]) > 0
            faces.append((i, j, k) if outward else (i, k, j))
    return normalised(vertices), np.array(faces, dtype=np.int32)


@dataclass(frozen=True, eq=False)
class SphereHierarchy:
    """Nested triangulations of the unit sphere, levels 0 (the icosahedron) to ``level``.

    Build one with :func:`sphere_hierarchy`.

    Attributes:
        vertices: nodes of the finest level on the unit sphere, coarse first, shape [N, 3].
        node_counts: number of nodes |K(j)| of each level, ``level + 1`` of them.
        level_faces: triangles of each level, shape [F_j, 3]; triangle ``f`` has children ``4 f + c`` on the next level,
            where c = 0, 1, 2 keeps corner c (as corner c of the child) and 3 is the middle one.
        level_parents: the two ends in K(j) of the edge that each node of M(j) halves, shape [M_j, 2].
        level_wings: the six other nodes of the butterfly around that edge, shape [M_j, 6]: two opposite the edge in its
            triangles, then four opposite those triangles' other edges.
    """

    vertices: Floats
    node_counts: tuple[int, ...]
    level_faces: tuple[Ints, ...]
    level_parents: tuple[Ints, ...]
    level_wings: tuple[Ints, ...]

    @property
    def level(self) -> int:
        """The finest level."""
        return len(self.node_counts) - 1

    @property
    def node_count(self) -> int:
        """Number of nodes of the finest level."""
        return self.node_counts[-1]

    @property
    def faces(self) -> Ints:
        """Triangles of the finest level, shape [F, 3]."""
        return self.level_faces[-1]

    @cached_property
    def node_areas(self) -> Floats:
        """A third of the spherical triangles' areas around each node of the finest level, shape [N]; the sum is 4π.

        This is the quadrature with respect to which the wavelets' integrals vanish: ∫ f = sum of node_areas * f(node).
        """
        shares = np.repeat(triangle_solid_angles(*self.vertices.take(self.faces.T, axis=0)) / 3, 3)
        return np.bincount(self.faces.ravel(), weights=shares, minlength=self.node_count).astype(np.float64)

    def node_spacing(self, level: int) -> float:
        """Return the spacing of a level's nodes in radians, as if all triangles were equilateral and equal."""
        return float(np.sqrt(4 * np.pi / len(self.level_faces[level]) * 4 / np.sqrt(3)))

    def refinement_matrix(self, level: int, *, butterfly: bool = False) -> sparse.csr_matrix:
        """Return the subdivision matrix from values at K(level) to those at K(level + 1) (section 3.1, refinement)."""
        stencil, weights = predict_stencil(self, level, butterfly=butterfly)
        coarse, added = self.node_counts[level], len(stencil)
        rows = np.concatenate([np.arange(coarse), coarse + np.repeat(np.arange(added), len(weights))])
        columns = np.concatenate([np.arange(coarse), stencil.ravel()])
        data = np.concatenate([np.ones(coarse), np.tile(weights, added)])
        return sparse.csr_matrix((data, (rows, columns)), shape=(coarse + added, coarse))


def predict_stencil(hierarchy: SphereHierarchy, level: int, *, butterfly: bool) -> tuple[Ints, Floats]:
    """Return the nodes, shape [M_j, 2 or 8], and weights from which the value at each midpoint of a level is predicted.

    Linear: half of each end. Butterfly: the eight-point rule of Dyn, Levin and Gregory (1990) with tension 1/16, as in
    Schröder and Sweldens (1995).
    """
    if not butterfly:
        return hierarchy.level_parents[level], np.array([0.5, 0.5])
    stencil = np.concatenate([hierarchy.level_parents[level], hierarchy.level_wings[level]], axis=1)
    return np.ascontiguousarray(stencil), np.array([8.0, 8, 2, 2, -1, -1, -1, -1]) / 16


def _halve_edges(faces: Ints, node_count: int) -> tuple[Ints, Ints, Ints]:
    """Return the edges' ends [E, 2], butterfly wings [E, 6], and the edge (k, k + 1) of every triangle [F, 3]."""
    keys = edge_keys(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), node_count)
    unique, first, edge = np.unique(keys, return_index=True, return_inverse=True)
    parents = np.stack([unique // node_count, unique % node_count], axis=1).astype(np.int32)
    neighbours = face_neighbours(faces, node_count)

    def opposite(face: NDArray[np.int64], tails: NDArray[np.int64], heads: NDArray[np.int64]) -> NDArray[np.int64]:
        return faces[face].astype(np.int64).sum(axis=1) - tails - heads  # the corner that is neither end

    face, side = first // 3, first % 3
    twin = neighbours[face, side].astype(np.int64)
    ends = [faces[face, side].astype(np.int64), faces[face, (side + 1) % 3].astype(np.int64)]
    wings = []
    outer = []
    for triangle in (face, twin):
        wing = opposite(triangle, *ends)
        wings.append(wing)
        for end in ends:
            corner = (faces[triangle] != (ends[0] + ends[1] - end)[:, None]).argmin(axis=1)  # the other end's corner
            across = neighbours[triangle, (corner + 1) % 3].astype(np.int64)  # beyond the edge that leaves it out
            outer.append(opposite(across, end, wing))
    return parents, np.stack(wings + outer, axis=1).astype(np.int32), edge.reshape(faces.shape).astype(np.int32)


@lru_cache(maxsize=16)
def sphere_hierarchy(level: int) -> SphereHierarchy:
    """Subdivide an icosahedron ``level`` times, to 10 · 4^level + 2 nodes.

    The result is kept, and shared between callers.

    Raises:
        OmtwarpError: a level outside 0 to 10.
    """
    level = whole_number(level, "level of the sphere's subdivision", most=HIGHEST_LEVEL)
    vertices, faces = icosahedron()
    levels, halved = [(len(vertices), faces)], []
    for _ in range(level):
        parents, wings, edge = _halve_edges(faces, len(vertices))
        a, b, c = faces.T
        ab, bc, ca = (edge + len(vertices)).astype(np.int32).T
        faces = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        vertices = np.concatenate([vertices, normalised(vertices[parents[:, 0]] + vertices[parents[:, 1]])])
        levels.append((len(vertices), faces))
        halved.append((parents, wings))
    counts, all_faces = zip(*levels, strict=True)
    return SphereHierarchy(vertices, counts, all_faces, *(tuple(each[k] for each in halved) for k in (0, 1)))


def level_for(node_budget: float, lowest: int = 0) -> int:
    """Return the highest level whose nodes are at most ``node_budget``, at least ``lowest``."""
    level = whole_number(lowest, "lowest")
    while level < HIGHEST_LEVEL and 10 * 4 ** (level + 1) + 2 <= node_budget:
        level += 1
    return level
