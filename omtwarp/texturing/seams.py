"""Texture coordinates from a map to the sphere, without distorted triangles at poles or visible seams.

One pair of texture coordinates per mesh vertex cannot describe a sphere: longitude jumps, a pole has every longitude,
and the six charts of a cube do not meet. So the mesh is cut along the borders of the charts (exactly: triangles that
cross a border are divided there), the poles become vertices, and where the picture's coordinates are too far from
linear over a triangle (always next to a pole) the triangle is divided until the error is a fraction of a texel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray

from omtwarp.texturing.atlas import Atlas
from omtwarp.texturing.cutting import CutMesh, lengths, normalised
from omtwarp.texturing.export import split_corners
from omtwarp.texturing.openness import face_openness

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

# Corners, edge midpoints and the centroid, where the linear coordinates are compared with the exact ones.
PROBES = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [1 / 3, 1 / 3, 1 / 3]])


@dataclass
class Unwrapped:
    """A mesh cut along the charts of an atlas, with one pair of texture coordinates per vertex.

    The first V vertices are the original ones in their order; their copies and the vertices made by cuts follow.

    Attributes:
        faces: int32, shape [M, 3].
        uv: float64, shape [N, 2], v up.
        sphere: unit vectors in the frame of the map (not turned), shape [N, 3].
        source_vertex: the original vertex that each vertex is or is a copy of, -1 for one made by a cut, shape [N].
        source_face: the original face that each face is a part of, shape [M].
        chart: chart of each face, shape [M].
        welded: for each vertex the vertex of the uncut mesh (original ones first, then those made), shape [N]: vertices
            with the same number lie at the same place and differ only in their texture coordinates.
        weights: sparse, shape [N, V]: each vertex as a combination of original ones; ``weights @ x`` carries any
            quantity from the original vertices to all.
    """

    faces: Ints
    uv: Floats
    sphere: Floats
    source_vertex: Ints
    source_face: Ints
    chart: Ints
    welded: Ints
    weights: sparse.csr_matrix


def unwrap(sphere: Floats, faces: Ints, atlas: Atlas, *, rotation: Floats | None = None) -> Unwrapped:
    """Cut a spherical mesh along the borders of an atlas and give every vertex its texture coordinates.

    Args:
        sphere: the map, unit vectors, shape [V, 3].
        faces: shape [F, 3].
        atlas: where the charts are.
        rotation: turns the texture on the sphere, shape [3, 3].

    Returns:
        The cut mesh, in which linear texture coordinates give the map's direction to a third of a texel. Its
        surface and its map are the same as before, to round-off.
    """
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=np.float64)
    sphere = np.asarray(sphere, dtype=np.float64)
    mesh = CutMesh(sphere @ turn if rotation is not None else sphere, faces)
    for corner in atlas.corners:
        mesh.insert(np.asarray(corner) / np.linalg.norm(corner))
    for arc in atlas.arcs:
        mesh.cut(arc)
    _refine(mesh, atlas)
    chart = _face_charts(mesh, atlas)
    corner_uv = atlas.corner_uv(mesh.points[mesh.faces], chart)
    rows, welded, uv = split_corners(mesh.faces, corner_uv, len(mesh.points))
    return Unwrapped(
        faces=rows,
        uv=uv,
        sphere=(normalised(mesh.points) @ turn.T)[welded],
        source_vertex=np.where(welded < len(sphere), welded, -1).astype(np.int32),
        source_face=mesh.source_face,
        chart=chart,
        welded=welded,
        weights=mesh.weights[welded],
    )


def _face_charts(mesh: CutMesh, atlas: Atlas, which: NDArray | slice = slice(None)) -> Ints:
    return atlas.charts(mesh.points[mesh.faces[which]].sum(axis=1))


def _refine(mesh: CutMesh, atlas: Atlas) -> None:
    """Divide triangles until texture coordinates are linear over each to within a third of a texel."""
    most_passes = 24
    # Faces that are added to four times the mesh's, at most: room for coarse meshes, while a folded or collapsed map is
    # not refined without end.
    limit = 4 * len(mesh.faces) + 100_000
    fresh = np.ones(len(mesh.faces), dtype=bool)
    for _ in range(most_passes):
        which = np.flatnonzero(fresh)
        points = mesh.points[mesh.faces[which]]
        chart = _face_charts(mesh, atlas, which)
        uv = atlas.corner_uv(points, chart)
        error = np.empty((len(which), len(PROBES)))
        for k, bary in enumerate(PROBES):
            got = atlas.uv_directions(np.einsum("k,fkj->fj", bary, uv), chart)
            want = normalised(np.einsum("k,fkj->fj", bary, points))
            error[:, k] = lengths(got - want)
        bad = error > atlas.texel_angle / 3.0
        edges = bad[:, :3]
        directions = normalised(points)
        # Longest edge, radians: above this the probes could miss how far from linear the coordinates are
        edges |= lengths(directions - np.roll(directions, -1, axis=1)) > 0.25
        # Only the middle is wrong: the longest edge is divided.
        long = lengths(points - np.roll(points, -1, axis=1))
        alone = bad[:, 3] & ~edges.any(axis=1)
        edges[alone, np.argmax(long[alone], axis=1)] = True
        face, corner = np.nonzero(edges)
        if len(face) == 0 or len(mesh.faces) > limit:
            return
        fresh = mesh.split_half_edges(which[face], corner, np.full(len(face), 0.5))


def least_visible_meridian(vertices: Floats, faces: Ints, sphere: Floats) -> float:
    """Return the longitude of the meridian that shows least on the surface, in radians in (-π, π].

    The measure is the length of the meridian's image on the surface, weighted by the openness of the space around each
    piece: short lines in folds are preferred to long lines on exposed parts.

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        sphere: the map, in the frame in which longitude is meant, shape [V, 3].
    """
    meridians = 180  # compared for the seam, evenly spaced
    # Least openness, added to every face's: where nothing is hidden the shortest seam wins; 0 lets it wander in folds
    weight = 0.1 + face_openness(vertices, faces)
    scale = np.ptp(vertices, axis=0).max()
    x = (vertices - vertices.min(axis=0)) / scale
    longitudes = (np.arange(meridians) + 1) / meridians * 2.0 * np.pi - np.pi
    costs = np.empty(meridians)
    for k, longitude in enumerate(longitudes):
        c, s = np.cos(longitude), np.sin(longitude)
        height = sphere[:, 1] * c - sphere[:, 0] * s
        along = sphere[:, 0] * c + sphere[:, 1] * s
        side = (height >= 0)[faces]
        crossing = np.flatnonzero(side.any(axis=1) & ~side.all(axis=1))
        crossing = crossing[along[faces[crossing]].sum(axis=1) > 0]
        corner = faces[crossing]
        lonely = np.where(side[crossing].sum(axis=1) == 1, np.argmax(side[crossing], 1), np.argmin(side[crossing], 1))
        rows = np.arange(len(crossing))
        tip, a, b = corner[rows, lonely], corner[rows, (lonely + 1) % 3], corner[rows, (lonely + 2) % 3]
        ends = []
        for other in (a, b):
            t = (height[tip] / (height[tip] - height[other]))[:, None]
            ends.append((1.0 - t) * x[tip] + t * x[other])
        costs[k] = (np.linalg.norm(ends[0] - ends[1], axis=1) * weight[crossing]).sum()
    return float(longitudes[np.argmin(costs)])
