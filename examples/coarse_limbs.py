"""Whether a mesh has vertices enough around its limbs for a map that keeps area.

    python examples/coarse_limbs.py MESH [MESH ...]        # the thinnest ring of every mesh, and what its map reaches
    python examples/coarse_limbs.py                        # made tubes, regular and irregular, from short to long

Three points of the unit sphere lie on a circle of radius at most 1, so that their flat triangle with edges a, b and c
has an area of at least abc / 4. Triangles that share 4π evenly among F therefore need abc <= 16π / F. A closed ring of
n vertices that cuts the share s of the area off is about 4π sqrt(s (1 - s)) long on the sphere, or longer, so its edges
are about c = 4π sqrt(s (1 - s)) / n long. Where the vertices of the next ring lie halfway along them, a = b = c / 2;
that is only possible if

    n >= 4π sqrt(s (1 - s)) (F / 64π)^(1/3) = 2.145 sqrt(s (1 - s)) F^(1/3).

With fewer, the vertices of neighbouring rings have to lie almost on top of each other, all along the limb: every
triangle is a needle with one edge far shorter than the others, and its neighbours must be such needles too. Regular
meshes allow that. Irregular ones have places where two rows of needles part, with triangles between them that have two
short edges and so hardly any area.

Printed are, of the ring with the smallest ratio, its vertices, those needed, and the share it cuts off; then the area
distortion of the refined map, its 95th percentile and the angle distortion.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components, dijkstra

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface
from omtwarp.pipeline import as_surface

LEVELS = 60
LEAST_SHARE = 0.01  # smaller caps have few triangles
LENGTHS = (4.0, 12.0, 24.0)


def vertices_needed(share: float | np.ndarray, face_count: int) -> float | np.ndarray:
    """How many vertices a ring needs that cuts off this share of the area of a mesh of so many faces."""
    return 4.0 * np.pi * np.sqrt(share * (1.0 - share)) * (face_count / (64.0 * np.pi)) ** (1.0 / 3.0)


def rings(surface: Surface) -> Iterator[tuple[float, float]]:
    """Vertices and share of area cut off, of the rings at even distances from an end of the surface.

    What lies farther than a distance falls into pieces, one for every limb, each with one ring around it. The edges
    that cross the ring are as many as there are vertices on both its sides together.
    """
    start, end = surface.edges.astype(np.int64).T
    count = surface.vertex_count
    lengths = np.linalg.norm(surface.vertices[start] - surface.vertices[end], axis=1)
    graph = sparse.csr_matrix((lengths, (start, end)), shape=(count, count))
    pole = int(np.argmax(dijkstra(graph, directed=False, indices=0)))
    distance = dijkstra(graph, directed=False, indices=pole)
    areas = surface.vertex_areas / surface.vertex_areas.sum()
    for level in np.linspace(0.0, distance.max(), LEVELS + 2)[1:-1]:
        far = distance >= level
        inside = far[start] & far[end]
        kept = sparse.csr_matrix((np.ones(inside.sum()), (start[inside], end[inside])), shape=(count, count))
        pieces, piece = connected_components(kept, directed=False)
        crossing = far[start] != far[end]
        outer = np.where(far[start], start, end)[crossing]
        shares = np.bincount(piece[far], areas[far], minlength=pieces)
        crossings = np.bincount(piece[outer], minlength=pieces)
        for k in np.flatnonzero((shares > LEAST_SHARE) & (shares < 1.0 - LEAST_SHARE)):
            yield crossings[k] / 2.0, float(shares[k])


def thinnest_ring(surface: Surface) -> tuple[float, float, float]:
    """Vertices, vertices needed and share of the ring for which these two compare worst."""
    found = np.array(list(rings(surface)))
    needed = vertices_needed(found[:, 1], surface.face_count)
    worst = int(np.argmin(found[:, 0] / needed))
    return float(found[worst, 0]), float(needed[worst]), float(found[worst, 1])


def read_surfaces(paths: list[str]) -> Iterator[tuple[str, Surface]]:
    for path in paths:
        mesh = omtwarp.read_mesh(path)
        yield Path(path).stem, as_surface((mesh.vertices, mesh.faces))


def made_tubes(face_count: int) -> Iterator[tuple[str, Surface]]:
    for length in LENGTHS:
        regular = shapes.tube(length, face_count=face_count)
        yield f"tube of {length:g} girths, regular", regular
        yield f"tube of {length:g} girths, irregular", shapes.flip_edges(regular, rounds=4, seed=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", metavar="MESH")
    parser.add_argument("--faces", type=int, default=1500, help="of the made tubes")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    given = read_surfaces(options.meshes) if options.meshes else made_tubes(options.faces)
    print(f"{'':34s} vertices needed ratio share     area    p95  angle")
    for name, surface in given:
        around, needed, share = thinnest_ring(surface)
        judged = omtwarp.map_to_sphere(surface, device=options.device).distortion()
        print(
            f"{name[-34:]:34s} {around:8.1f} {needed:6.1f} {around / needed:5.2f} {share:5.3f} "
            f"{judged.area['surface']:8.4f} {judged.area['p95']:6.3f} {judged.angle['surface']:6.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
