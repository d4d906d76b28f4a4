"""The numbers of vertices around the limbs of a surface, and the numbers that a map that keeps area needs there.

Three points of the unit sphere lie on a circle of radius at most 1, so that their flat triangle with edges a, b and c
has an area of at least abc / 4. Triangles that share 4π evenly among F therefore need abc <= 16π / F. A closed ring of
n vertices that cuts the share s of the area off is about 4π sqrt(s (1 - s)) long on the sphere, or longer, so its edges
are about c = 4π sqrt(s (1 - s)) / n long. Where the vertices of the next ring lie halfway along them, a = b = c / 2;
that is only possible if

    n >= 4π sqrt(s (1 - s)) (F / 64π)^(1/3) = 2.145 sqrt(s (1 - s)) F^(1/3).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from omtwarp.mesh.arrays import Floats, norms
from omtwarp.mesh.surface import Surface


@dataclass(frozen=True)
class Ring:
    """A ring of vertices around a limb.

    Attributes:
        around: how many vertices it has.
        share: of the surface's area, how much it cuts off.
        vertex: one vertex of it.
    """

    around: float
    share: float
    vertex: int


def vertices_needed(share: float, face_count: int) -> float:
    """Return the number of vertices needed on a ring that cuts off this share of the area of a mesh."""
    return float(4.0 * np.pi * np.sqrt(share * (1.0 - share)) * (face_count / (64.0 * np.pi)) ** (1.0 / 3.0))


def rings(surface: Surface) -> Iterator[Ring]:
    """Find the rings at even distances from an end of the surface, along its edges.

    The vertices farther than a distance form pieces, one for every limb, each with one ring around it. As many edges
    cross the ring as there are vertices on both of its sides together.
    """
    least_share = 0.01  # smaller caps have few triangles
    start, end = surface.edges.astype(np.int64).T
    count = surface.vertex_count
    points = surface.scaled_vertices
    graph = _graph(norms(points[start] - points[end]), start, end, count)
    pole = int(np.argmax(dijkstra(graph, directed=False, indices=0)))
    distance = dijkstra(graph, directed=False, indices=pole)
    areas = surface.sum_to_vertices(surface.own_areas)
    areas = areas / areas.sum()
    # Levels: distances at which rings are measured, in equal steps of 1/61 of the longest
    for level in np.linspace(0.0, distance.max(), 60 + 2)[1:-1]:
        far = distance >= level
        inside = far[start] & far[end]
        kept = _graph(np.ones(int(inside.sum())), start[inside], end[inside], count)
        pieces, piece = connected_components(kept, directed=False)
        crossing = far[start] != far[end]
        outer = np.where(far[start], start, end)[crossing]
        shares = np.bincount(piece[far], areas[far], minlength=pieces)
        crossings = np.bincount(piece[outer], minlength=pieces)
        for k in np.flatnonzero((shares > least_share) & (shares < 1.0 - least_share)):
            yield Ring(float(crossings[k]) / 2.0, float(shares[k]), int(outer[np.argmax(piece[outer] == k)]))


def thinnest_ring(surface: Surface) -> Ring | None:
    """Find the ring with the smallest ratio of vertices to vertices needed; None where no ring cuts off enough area."""
    return min(
        rings(surface), key=lambda ring: ring.around / vertices_needed(ring.share, surface.face_count), default=None
    )


def _graph(weights: Floats, start: NDArray[np.int64], end: NDArray[np.int64], count: int) -> sparse.csr_matrix:
    return sparse.csr_matrix((weights, (start, end)), shape=(count, count))
