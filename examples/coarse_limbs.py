"""Check whether a mesh has enough vertices around its limbs for a map that keeps area.

    python examples/coarse_limbs.py MESH [MESH ...]        # the thinnest ring of every mesh, and what its map reaches
    python examples/coarse_limbs.py                        # generated tubes, regular and irregular, from short to long

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
distortion of the map with the areas of its triangles as right as they can be made, its 95th percentile and the angle
distortion. The optimal map itself keeps the areas around vertices, for which rings may be smaller.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import omtwarp
from omtwarp.geometry.limbs import thinnest_ring, vertices_needed
from omtwarp.mapping.pipeline import as_surface
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface
from omtwarp.optimal.refinement import least_distortion

LENGTHS = (4.0, 12.0, 24.0)
TRIANGLE_WEIGHT, STEPS, TOLERANCE = 1000.0, 200, 2e-3  # of area against angle distortion, both of triangles


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
        ring = thinnest_ring(surface)
        if ring is None:
            print(f"{name[-34:]:34s} no ring cuts off more than a hundredth of the area")
            continue
        around, share = ring.around, ring.share
        needed = vertices_needed(share, surface.face_count)
        moser = omtwarp.map_to_sphere(surface, until="moser", device=options.device)
        given = {"iterations": STEPS, "tolerance": TOLERANCE, "device": options.device}
        refined = least_distortion(surface, moser.sphere, TRIANGLE_WEIGHT, **given)
        judged = omtwarp.distortion(surface, refined.sphere)
        print(
            f"{name[-34:]:34s} {around:8.1f} {needed:6.1f} {around / needed:5.2f} {share:5.3f} "
            f"{judged.area['surface']:8.4f} {judged.area['p95']:6.3f} {judged.angle['surface']:6.2f}",
            flush=True,
        )


if __name__ == "__main__":
    try:
        main()
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
