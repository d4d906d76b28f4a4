"""Splitting of edges that a map makes long, where triangles have no room to keep their areas.

Where a limb of few vertices around opens into the rest of a surface, the map of a half stretches these few edges along
the equator: 28 over the whole of it where an arm of an octopus is cut. Plates of CAD parts have sides as long, with
many flat triangles along them. Rows of triangles along such edges cannot be as low as their areas ask for, as great
circles between their ends bulge by more than that. Split at their midpoints, they have room; like inner edges between
vertices of the boundary, see :func:`omtwarp.topology.doubling.split_chords`, they stay split in the result.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.topology.doubling import Double, double, split_at

Floats = NDArray[np.float64]
Places = NDArray[np.int64]

# Edges of the map above this, in radians, and above this many times the side of an equilateral triangle of the mean
# area, are split. With 0.2 in place of 0.15 an octopus cut at a quarter of its height has 1,708 edges split in place of
# 2,854 and ends at an area distortion of 2.0035 in place of 2.0027. Where only edges of triangles with wrong areas are
# split, it ends at 2.008 after three times: chords of their neighbours' long edges then lie across them.
LONG, LONG_SIDES = 0.15, 4.0


@dataclass(frozen=True)
class SplitClosed:
    """A closed surface some of whose edges were split at their midpoints.

    Attributes:
        surface: W' vertices and F' faces.
        ends: the vertices before that each vertex lies halfway between, twice the same for old ones, shape [W', 2].
        face_origin: the face before that each face is a part of, shape [F'].
    """

    surface: Surface
    ends: Places
    face_origin: Places

    @property
    def vertex_origin(self) -> Places:
        """The vertex before that each vertex is, -1 for new ones, shape [W']."""
        return _old_vertices(self.ends)

    def on_sphere(self, points: Floats) -> Floats:
        """Return a map of the surface before, shape [W, 3], with new vertices in the middle of great circles."""
        known = self.vertex_origin >= 0
        middles = self.interpolated(points)
        lengths = np.linalg.norm(middles, axis=1)
        return middles / np.where(known | (lengths == 0.0), 1.0, lengths)[:, None]

    def interpolated(self, values: Floats) -> Floats:
        """Return values at the vertices, shape [W] or [W, K], with the mean of the two ends at new ones."""
        first, second = self.ends.T
        return np.where(first == second, values[first].T, 0.5 * (values[first] + values[second]).T).T


@dataclass(frozen=True)
class SplitDouble(SplitClosed):
    """A double some of whose edges were split, on both sides alike.

    Attributes:
        double: the surface and its copy; the surface's new vertices follow its old ones.
    """

    double: Double


def split_long_edges(surface: Surface, sphere: Floats) -> SplitClosed | None:
    """Split the edges of a closed surface that a map makes long; return None where there are none.

    Args:
        surface: W vertices, with the areas that its triangles are to have.
        sphere: the map, shape [W, 3].
    """
    long = _long(surface.edges, sphere, surface.face_count)
    if not len(long):
        return None
    split = split_at(surface.vertices, surface.faces, long)
    ends = np.concatenate([_themselves(surface.vertex_count), split.split_edges])
    finer = _finer(surface, split.vertices, split.faces, ends, split.face_origin)
    return SplitClosed(finer, ends, split.face_origin)


def split_long_edges_of_double(halves: Double, surface: Surface, sphere: Floats) -> SplitDouble | None:
    """Split the edges of a double that a symmetric map makes long; return None where there are none.

    Args:
        halves: the surface and its copy, W vertices.
        surface: the double as a surface, with the areas that its triangles are to have.
        sphere: the map, shape [W, 3].
    """
    count, own = len(halves.half), len(halves.faces) // 2
    long = _long(surface.edges[(surface.edges < count).all(axis=1)], sphere, 2 * own)
    if not len(long):
        return None
    split = split_at(surface.vertices[:count], halves.faces[:own], long)
    finer = double(split.vertices, split.faces)
    ends = np.concatenate([_themselves(count), split.split_edges])
    copied = np.flatnonzero(finer.copied)
    ends = np.concatenate([ends, halves.mirror[ends[finer.mirror[copied]]]])
    origin = np.concatenate([split.face_origin, own + split.face_origin])
    return SplitDouble(_finer(surface, finer.vertices, finer.faces, ends, origin), ends, origin, finer)


def _long(edges: NDArray[np.int32], sphere: Floats, face_count: int) -> NDArray[np.int32]:
    """Return those edges that are long on the sphere, their lower ends first, shape [K, 2]."""
    side = np.sqrt(4.0 / np.sqrt(3.0) * 4.0 * np.pi / face_count)
    chords = np.linalg.norm(sphere[edges[:, 0]] - sphere[edges[:, 1]], axis=1)
    return np.sort(edges[chords > 2.0 * np.sin(0.5 * min(max(LONG, LONG_SIDES * side), np.pi))], axis=1)


def _themselves(count: int) -> Places:
    """Return the ends of vertices that are not new, shape [V, 2]."""
    return np.repeat(np.arange(count)[:, None], 2, axis=1)


def _old_vertices(ends: Places) -> Places:
    """Return the vertex that each vertex was before, by its ends, -1 for new ones, shape [V']."""
    return np.where(ends[:, 0] == ends[:, 1], ends[:, 0], -1)


def _finer(surface: Surface, vertices: Floats, faces: NDArray, ends: Places, origin: Places) -> Surface:
    """Return the surface of parts, with the areas and names that they get from a surface's triangles and vertices."""
    areas = None
    if surface.weighted:
        parts = triangle_areas(vertices, faces)
        whole = np.bincount(origin, parts, surface.face_count)
        areas = surface.face_areas[origin] * parts / whole[origin]
    found = Surface(vertices, faces, areas)
    found.checked = surface.checked
    if surface.names is not None:
        found.names = surface.names.of(_old_vertices(ends), origin)
    return found


__all__ = ["SplitClosed", "SplitDouble", "split_long_edges", "split_long_edges_of_double"]
