"""Surfaces with a boundary made closed: doubled with their mirror copy, or their holes filled.

The double of a disk, the surface glued to its mirror copy along the boundary, is a closed surface of genus 0 with a
mirror symmetry that fixes exactly the boundary. For it to be a triangle mesh, no edge inside the surface may have both
ends on the boundary: its two copies would be one edge of four triangles. Such edges are split at their midpoints first,
which does not change the surface.

Holes are filled with well-shaped triangles that span a surface of small area. A loop of n vertices gets rings of
vertices that become fewer towards the middle, so that triangles stay near equilateral and grow by at most a quarter
from ring to ring; the middle is a fan. No new edge joins two vertices of the loop, so that the result is a triangle
mesh whatever edges the surface has. Positions are those of a discrete minimal surface [1]_: the harmonic membrane in
the loop, its weights renewed from its own shape a few times.

.. [1] U. Pinkall, K. Polthier, "Computing discrete minimal surfaces and their conjugates", Exp. Math. 2 (1993).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from omtwarp.geometry.operators import cotangent_laplacian
from omtwarp.mesh.arrays import Floats, edge_keys, marked, norms
from omtwarp.mesh.origins import Derived
from omtwarp.mesh.polygons import cut_at_middles
from omtwarp.mesh.quarter import QuarteredSurface
from omtwarp.mesh.surface import Surface
from omtwarp.topology.kind import on_boundary


def split_chords(vertices: Floats, faces: NDArray, loop: NDArray[np.int64] | None = None) -> Derived:
    """Split every edge inside the surface whose two ends lie on the boundary, at its midpoint.

    Args:
        vertices: float64, shape [V, 3].
        faces: an oriented manifold mesh, shape [F, 3].
        loop: vertices of the one boundary loop that counts; all of the boundary by default.
    """
    count = len(vertices)
    surface = Surface(vertices, faces)
    on_loop = on_boundary(faces, count) if loop is None else marked(count, loop)
    chord = on_loop[surface.edges].all(axis=1) & (surface.side_corners[:, 1] >= 0)
    ends, opposite = surface.edges[chord].astype(np.int64), surface.side_corners[chord]
    midpoint = np.full(surface.faces.size, -1)
    # A corner lies opposite to the edge that begins at the next one.
    midpoint[opposite // 3 * 3 + (opposite + 1) % 3] = count + np.arange(len(ends))[:, None]
    parts, face_origin = cut_at_middles(surface.faces, midpoint.reshape(-1, 3))
    order = np.argsort(face_origin, kind="stable")  # parts of a face stay where the face was
    return Derived(
        np.r_[np.arange(count), np.full(len(ends), -1)],
        face_origin[order],
        np.concatenate([vertices, 0.5 * vertices[ends[:, 0]] + 0.5 * vertices[ends[:, 1]]]),
        parts[order],
        split_edges=ends,
        given=count,
    )


@dataclass(frozen=True, eq=False)
class Double(Derived):
    """A surface glued to its mirror copy along the boundary.

    Attributes:
        vertices: those of the surface first, then the copies of those inside, float64, shape [W, 3].
        faces: those of the surface first, then the copies, turned over, int32, shape [2F, 3].
        mirror: the copy of every vertex, and of every copy the vertex, which comes before it, shape [W]; a vertex of
            the boundary is its own.
    """

    mirror: NDArray[np.int64]

    @cached_property
    def on_boundary(self) -> NDArray[np.bool_]:
        """Which vertices lie on the boundary, shape [W]."""
        return self.mirror == np.arange(len(self.mirror))

    @cached_property
    def copied(self) -> NDArray[np.bool_]:
        """Which vertices belong to the copy alone, shape [W]."""
        return self.mirror < np.arange(len(self.mirror))

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
    inside = np.flatnonzero(~on_boundary(faces, count))
    copy = np.arange(count)
    copy[inside] = count + np.arange(len(inside))
    origin, face_origin = np.r_[np.arange(count), inside], np.tile(np.arange(len(faces)), 2)
    glued = np.concatenate([faces, copy[faces][:, ::-1]]).astype(np.int32)
    return Double(origin, face_origin, vertices[origin], glued, np.concatenate([copy, inside]))


def quartered_double(whole: Double, quartered: QuarteredSurface) -> Double:
    """Return the double whose triangles are the parts of another's.

    Args:
        whole: a surface and its mirror copy, W vertices and 2F faces.
        quartered: the same with every triangle cut into four, the surface's own first.
    """
    count, ends = len(whole.mirror), quartered.split_edges
    # An edge comes before its copy, as its vertices do.
    image = count + np.searchsorted(edge_keys(ends, count), edge_keys(whole.mirror[ends], count))
    surface, origins = quartered.surface, whole.compose(quartered)
    return Double(
        **vars(origins), vertices=surface.vertices, faces=surface.faces, mirror=np.append(whole.mirror, image)
    )


def fill_loop(points: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Fill a closed loop; the filling is the same, to the bit, whichever vertex of the loop comes first.

    Args:
        points: the loop's vertices, three or more, in the direction in which the surface's faces run through them,
            shape [n, 3].

    Returns:
        The new vertices, shape [K, 3]; and triangles by the vertices of the loop, 0 to n - 1, and the new ones, n to
        n + K - 1, shape [P, 3].
    """
    count, far = len(points), norms(points - points.mean(axis=0))
    # Equally far: difference of distances, over the largest, that may be round-off of another order or position
    nearest = np.flatnonzero(far <= far.min() + 1e-9 * far.max())
    # It begins at the vertex that is nearest to its middle, of equally near ones the first along x, y and z.
    begin = int(nearest[np.lexsort(points[nearest, ::-1].T)[0]])
    points = np.roll(points, -begin, axis=0)
    # In the unit of the loop: weights and tolerances are then free of scale.
    centre = points.mean(axis=0)
    extent = max(float(np.abs(points - centre).max()), np.finfo(float).tiny)
    loop = (points - centre) / extent
    steps = norms(np.roll(loop, -1, axis=0) - loop)
    turns = np.concatenate([[0.0], np.cumsum(steps)[:-1]]) / max(float(steps.sum()), np.finfo(float).tiny)
    places, faces = _rings(turns)
    # A membrane, and five renewals of its weights; the area then changes by less than a per cent
    for _ in range(6):
        laplacian = cotangent_laplacian(places, faces, (1e-3, 1e3))  # positive: a vertex lies among its neighbours
        inner = spsolve(laplacian[count:, count:].tocsc(), -(laplacian[count:, :count] @ loop)).reshape(-1, 3)
        places = np.concatenate([loop, inner])
    return places[count:] * extent + centre, np.where(faces < count, (faces + begin) % count, faces)


def _rings(turns: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """Triangulate the unit disk, its first vertices on the circle at the turns given, in [0, 1), ascending."""
    rings, radii = [turns], [1.0]
    # Fan: a ring of so few vertices is closed by one vertex in the middle
    while len(rings[-1]) > 7:
        around = len(rings[-1])
        # Near-equilateral triangles: the next ring is sqrt(3)/2 of an edge further in.
        radii.append(radii[-1] * (1.0 - np.sqrt(3.0) * np.pi / around))
        fewer = round(0.8 * around)  # so that triangles grow by at most a quarter from ring to ring
        rings.append((np.arange(fewer) + 0.5) / fewer)
    angle = 2 * np.pi * np.concatenate(rings)
    radius = np.repeat(radii, [len(ring) for ring in rings])[:, None]
    points = radius * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    rows, first = [], 0
    for outer, inner in pairwise(rings):
        rows.append(_strip(outer, inner, first, first + len(outer)))
        first += len(outer)
    last = np.arange(len(rings[-1]))
    rows.append(np.stack([first + last, first + np.roll(last, -1), np.full(len(last), first + len(last))], axis=1))
    # The surface's faces run along the loop, so that the patch has to run against it.
    return np.concatenate([points, np.zeros((1, 3))]), np.concatenate(rows)[:, ::-1].copy()


def _strip(outer: Floats, inner: Floats, first: int, second: int) -> NDArray[np.int64]:
    """Return triangles between two rings of vertices, counter-clockwise: each advances the ring that lags behind."""
    start = int(np.argmin(np.abs(inner - outer[0])))
    ahead, behind = np.append(outer[1:], outer[0] + 1.0), np.append(inner[start + 1 :], inner[: start + 1] + 1.0)
    outwards = np.argsort(np.concatenate([ahead, behind]), kind="stable") < len(outer)
    i: NDArray[np.int64] = np.cumsum(outwards) - outwards
    j = np.arange(len(outwards)) - i
    a, b = first + i % len(outer), second + (start + j) % len(inner)
    after = np.where(outwards, first + (i + 1) % len(outer), second + (start + j + 1) % len(inner))
    return np.stack([a, after, b], axis=1)


@dataclass(frozen=True, eq=False)
class FilledSurface(Derived):
    """A surface whose holes were filled.

    Attributes:
        vertices: those of the surface, then those of the filling, float64, shape [W, 3].
        faces: those of the surface, then those of the filling, int32, shape [G, 3].
        patch: the loop that each face fills, -1 for the surface's own, shape [G].
    """

    patch: NDArray[np.int64]


def fill_holes(vertices: Floats, faces: NDArray, loops: list[NDArray[np.int64]]) -> FilledSurface:
    """Fill loops of the boundary of a surface, each with a patch of its own.

    Args:
        vertices: float64, shape [V, 3].
        faces: an oriented manifold mesh, shape [F, 3].
        loops: boundary loops, see :func:`omtwarp.topology.kind.boundary_loops`; others stay open.
    """
    points, triangles, count = [vertices], [np.asarray(faces, dtype=np.int64)], len(vertices)
    for loop in loops:
        filling, corners = fill_loop(vertices[loop])
        points.append(filling)
        triangles.append(np.concatenate([loop, count + np.arange(len(filling))])[corners])
        count += len(filling)
    patches = np.repeat(np.arange(-1, len(loops)), [len(rows) for rows in triangles])
    return FilledSurface(
        np.r_[np.arange(len(vertices)), np.full(count - len(vertices), -1)],
        np.where(patches < 0, np.arange(len(patches)), -1),
        np.concatenate(points),
        np.concatenate(triangles).astype(np.int32),
        patches,
        given=len(vertices),
    )
