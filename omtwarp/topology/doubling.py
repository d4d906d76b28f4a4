"""The double of a surface with a boundary: the surface glued to its mirror copy along the boundary.

The double of a disk is a closed surface of genus 0 with a mirror symmetry that fixes exactly the boundary. For it to be
a triangle mesh, no edge inside the surface may have both ends on the boundary: its two copies would be one edge of four
triangles. Such edges are split at their midpoints first, which does not change the surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.arrays import Floats, Ints, edge_keys
from omtwarp.mesh.origins import Derived
from omtwarp.mesh.quarter import QuarteredSurface
from omtwarp.topology.kind import boundary_half_edges


def split_chords(vertices: Floats, faces: NDArray, loop: NDArray[np.int64] | None = None) -> Derived:
    """Split every edge inside the surface whose two ends lie on the boundary, at its midpoint.

    Args:
        vertices: float64, shape [V, 3].
        faces: an oriented manifold mesh, shape [F, 3].
        loop: vertices of the one boundary loop that counts; all of the boundary by default.
    """
    count = len(vertices)
    triangles = np.asarray(faces, dtype=np.int64)
    half = boundary_half_edges(triangles, count)
    on_boundary = np.zeros(count, dtype=bool)
    on_boundary[half if loop is None else loop] = True
    tail, head = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    keys = low * count + high
    chord = on_boundary[tail] & on_boundary[head] & ~np.isin(keys, edge_keys(half, count))
    split = np.unique(keys[chord])
    return split_at(vertices, triangles, np.stack([split // count, split % count], axis=1))


def split_at(vertices: Floats, faces: NDArray, edges: NDArray) -> Derived:
    """Split edges at their midpoints.

    Args:
        vertices: float64, shape [V, 3].
        faces: shape [F, 3].
        edges: pairs of vertices, the lower first and in ascending order, shape [K, 2].
    """
    count = len(vertices)
    triangles, ends = np.asarray(faces, dtype=np.int64), np.asarray(edges, dtype=np.int64)
    split = edge_keys(ends, count)
    keys = edge_keys(np.stack([triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()], axis=1), count)
    number = np.searchsorted(split, keys)
    number[number == len(split)] = 0
    known = split[number] == keys if len(split) else np.zeros(len(keys), dtype=bool)
    midpoint = np.where(known, count + number, -1)
    cut, face_origin = _subdivided(triangles, midpoint.reshape(-1, 3))
    return Derived(
        np.r_[np.arange(count), np.full(len(ends), -1)],
        face_origin,
        np.concatenate([vertices, 0.5 * vertices[ends[:, 0]] + 0.5 * vertices[ends[:, 1]]]),
        cut,
        split_edges=ends,
        given=count,
    )


def _subdivided(faces: NDArray[np.int64], midpoint: NDArray[np.int64]) -> tuple[Ints, NDArray[np.int64]]:
    """Return the faces cut through midpoints of edges (k, k+1), -1 where one stays whole, and the face each is of."""
    whole = (midpoint < 0).all(axis=1)
    parts, origins = [faces[whole]], [np.flatnonzero(whole)]
    for split_count in (1, 2, 3):
        for first in range(3):
            # Rotated so that the split edges come first; an edge that stays whole is the last of two, or of three.
            turned = np.roll(faces, -first, axis=1)
            middle = np.roll(midpoint, -first, axis=1)
            pattern = (middle >= 0) == (np.arange(3) < split_count)
            here = np.flatnonzero(pattern.all(axis=1))
            if not len(here) or (split_count == 3 and first > 0):
                continue
            (a, b, c), (p, q, r) = turned[here].T, middle[here].T
            pieces = {
                1: [(a, p, c), (p, b, c)],
                2: [(p, b, q), (a, p, q), (a, q, c)],
                3: [(a, p, r), (p, b, q), (r, q, c), (p, q, r)],
            }[split_count]
            for piece in pieces:
                parts.append(np.stack(piece, axis=1))
                origins.append(here)
    origin = np.concatenate(origins)
    order = np.argsort(origin, kind="stable")
    return np.concatenate(parts)[order].astype(np.int32), origin[order]


@dataclass(frozen=True, eq=False)
class Double(Derived):
    """A surface glued to its mirror copy along the boundary.

    Attributes:
        vertices: those of the surface first, then the copies of those inside, float64, shape [W, 3].
        faces: those of the surface first, then the copies, turned over, int32, shape [2F, 3].
        mirror: the copy of every vertex, shape [W]; a vertex of the boundary is its own.
        on_boundary: which vertices those are, shape [W].
        copied: which vertices belong to the copy alone, shape [W].
    """

    mirror: NDArray[np.int64]
    on_boundary: NDArray[np.bool_]
    copied: NDArray[np.bool_]

    @property
    def half(self) -> NDArray[np.int64]:
        """The vertices of the surface itself, with its boundary, ascending, shape [H]."""
        return np.flatnonzero(~self.copied)


def double(vertices: Floats, faces: NDArray) -> Double:
    """Glue a surface to its mirror copy along its boundary; the copy lies where the surface lies.

    Args:
        vertices: float64, shape [V, 3].
        faces: an oriented manifold mesh without an inner edge between boundary vertices (see :func:`split_chords`),
            shape [F, 3].
    """
    count = len(vertices)
    on_boundary = np.zeros(count, dtype=bool)
    on_boundary[boundary_half_edges(faces, count)] = True
    inside = np.flatnonzero(~on_boundary)
    copy = np.arange(count)
    copy[inside] = count + np.arange(len(inside))
    return Double(
        np.r_[np.arange(count), inside],
        np.tile(np.arange(len(faces)), 2),
        np.concatenate([vertices, vertices[inside]]),
        np.concatenate([faces, copy[faces][:, ::-1]]).astype(np.int32),
        np.concatenate([copy, inside]),
        np.concatenate([on_boundary, np.zeros(len(inside), dtype=bool)]),
        np.arange(count + len(inside)) >= count,
    )


def quartered_double(whole: Double, quartered: QuarteredSurface) -> Double:
    """Return the double whose triangles are the parts of another's.

    Args:
        whole: a surface and its mirror copy, W vertices and 2F faces.
        quartered: the same with every triangle cut into four, the surface's own first.
    """
    count, ends = len(whole.mirror), quartered.ends.astype(np.int64)
    images = np.sort(whole.mirror[ends], axis=1)
    keys, wanted = edge_keys(ends, count), images[:, 0] * count + images[:, 1]
    order = np.argsort(keys)
    image = order[np.searchsorted(keys, wanted, sorter=order)]
    own = np.zeros(len(ends), dtype=bool)
    own[quartered.middles[: len(quartered.middles) // 2] - count] = True
    made = whole.compose(quartered.origins)
    return Double(
        made.vertex_origin,
        made.face_origin,
        quartered.surface.vertices,
        quartered.surface.faces,
        np.concatenate([whole.mirror, count + image]),
        np.concatenate([whole.on_boundary, image == np.arange(len(ends))]),
        np.concatenate([whole.copied, ~own]),
    )
