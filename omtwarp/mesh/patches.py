"""Patches: pieces of a surface whose vertices may move while all others stay."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.arrays import Floats, Ints, marked, norms
from omtwarp.mesh.validate import components_of


def grow(faces: Ints, seed: NDArray[np.bool_], rings: int) -> NDArray[np.bool_]:
    """Return a mask, shape [V], of the vertices within ``rings`` edges of the seed vertices."""
    mask = seed.copy()
    for _ in range(rings):
        wider = mask.copy()
        wider[faces[touching(faces, mask)].ravel()] = True
        if wider.sum() == mask.sum():
            break
        mask = wider
    return mask


def touching(faces: Ints, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask, shape [F], of the triangles with a corner among the chosen vertices."""
    corners = chosen.take(faces)
    touched: NDArray[np.bool_] = corners[:, 0] | corners[:, 1] | corners[:, 2]  # NumPy reduces rows of three slowly
    return touched


def sides_of(faces: Ints) -> Ints:
    """Return the pairs of corners along the sides of triangles [T, 3], shape [3 T, 2]."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


@dataclass(frozen=True, eq=False)
class Patches:
    """The freed vertices of a surface, in pieces that share no edge, and the triangles around them.

    Attributes:
        vertices: of the surface, the freed ones first, then their fixed neighbours, shape [P].
        free: how many of them are freed.
        triangles: of the surface, those with a freed corner, shape [T].
        faces: their corners by place in ``vertices``, int32, shape [T, 3].
        vertex_patch: the piece of every freed vertex, shape [free].
        face_patch: the piece of every triangle, shape [T]: its freed corners all lie in one.
        count: number of pieces.
    """

    vertices: NDArray[np.intp]
    free: int
    triangles: NDArray[np.intp]
    faces: Ints
    vertex_patch: NDArray[np.intp]
    face_patch: NDArray[np.intp]
    count: int

    @classmethod
    def of_vertices(cls, faces: Ints, freed: NDArray[np.bool_]) -> "Patches":
        """Return the patches of all freed vertices.

        Args:
            faces: of the surface, shape [F, 3].
            freed: which of its vertices, shape [V]; at least one.
        """
        triangles = np.flatnonzero(touching(faces, freed))
        corners = faces[triangles]
        beside = marked(len(freed), corners) & ~freed
        vertices = np.concatenate([np.flatnonzero(freed), np.flatnonzero(beside)])
        local = np.full(len(freed), -1, dtype=np.int32)
        local[vertices] = np.arange(len(vertices), dtype=np.int32)
        own = np.ascontiguousarray(local[corners])
        free = int(freed.sum())
        pairs = sides_of(own)
        pairs = pairs[(pairs[:, 0] < free) & (pairs[:, 1] < free)]
        count, label = components_of(free, pairs)
        of_corner = np.full(len(vertices), -1, dtype=np.intp)
        of_corner[:free] = label
        first, second, third = (of_corner[own[:, k]] for k in range(3))
        face_patch = np.maximum(np.maximum(first, second), third)
        return cls(vertices, free, triangles, own, of_corner[:free], face_patch, count)

    def sum_of_vertices(self, values: Floats) -> Floats:
        """Sum values at the freed vertices, shape [free], over every piece; returns shape [count]."""
        return np.bincount(self.vertex_patch, values, minlength=self.count).astype(np.float64, copy=False)

    def sum_of_faces(self, values: Floats) -> Floats:
        """Sum values on the triangles, shape [T], over every piece; returns shape [count]."""
        return np.bincount(self.face_patch, values, minlength=self.count).astype(np.float64, copy=False)

    def longest(self, vectors: Floats) -> Floats:
        """Return the largest length of the freed vertices' vectors [free, ...] in every piece, shape [count]."""
        lengths = np.zeros(self.count)
        np.maximum.at(lengths, self.vertex_patch, norms(vectors))
        return lengths
