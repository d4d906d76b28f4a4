"""Cut closed meshes by planes, map what is above each plane to the hemisphere, and print a table.

    python examples/cut_by_planes.py bust.ply cortex.ply          # cut at 1/4, 1/2 and 3/4 of the longest axis
    python examples/cut_by_planes.py bust.ply --heights 0.3 --domain disk
    python examples/cut_by_planes.py bust.ply --exact             # every triangle keeps its area
    python examples/cut_by_planes.py                              # a made shape

Only whole triangles are kept, the largest piece of those above the plane, so that boundaries are as jagged as those of
scans. Smaller holes are filled. The status is non-zero where a map is not one to one, the boundary is off its circle by
1e-12, or a surface is refused.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np

import omtwarp
from omtwarp.mesh.surface import triangle_areas
from omtwarp.topology.kind import boundary_loops, parts_of

ON_CIRCLE = 1e-12


def above(vertices: np.ndarray, faces: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """The largest piece of the triangles above a plane across the longest axis, at a height from 0 to 1."""
    axis = int(np.argmax(np.ptp(vertices, axis=0)))
    level = (vertices[:, axis] - vertices[:, axis].min()) / np.ptp(vertices[:, axis])
    kept = omtwarp.repair(vertices, faces[(level[faces] > height).all(axis=1)], whole=False)
    largest = max(parts_of(kept.vertices, kept.faces), key=lambda part: len(part.faces))
    return largest.vertices, largest.faces


def area_distortion(result: omtwarp.SurfaceMap, image: np.ndarray, count: int) -> float:
    """Mean of r + 1/r over the area of a surface of so many triangles, r the share of the image over that of the area.

    Areas on the sphere are those of flat triangles; parts of one triangle are added up.
    """
    sizes = [
        np.bincount(result.face_origin, triangle_areas(points, result.faces), count)
        for points in (result.vertices, image)
    ]
    own, image = (size / size.sum() for size in sizes)
    return float((own * (image / own + own / image)).sum())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--heights", nargs="+", type=Fraction, default=[Fraction(k, 4) for k in (1, 2, 3)])
    parser.add_argument("--domain", default="hemisphere", choices=["hemisphere", "disk", "cap"])
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--refine", default="none")
    options = parser.parse_args()
    ball = omtwarp.shapes.limbs(sphere=1280)
    files = [(path.stem, omtwarp.read_mesh(path)) for path in options.meshes]
    meshes = [(name, file.vertices, file.faces) for name, file in files]
    failed = 0
    print("| mesh | height of the cut | triangles | area | angle | gap to the lower bound | CPU seconds |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, vertices, faces in meshes or [("limbs", ball.vertices, ball.faces)]:
        for height in options.heights:
            begun = time.process_time()
            piece = above(np.asarray(vertices), np.asarray(faces), float(height))
            row = f"| {name} | {height} | {len(piece[1])} |"
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", omtwarp.OmtwarpWarning)
                    result = omtwarp.map_surface(
                        piece, domain=options.domain, exact=options.exact, refine=options.refine
                    )
            except omtwarp.OmtwarpError as error:
                failed += 1
                print(f"{row} refused: {error} |", flush=True)
                continue
            seconds = time.process_time() - begun
            flat = options.domain == "disk"
            measured = result.distortion("disk" if flat else "sphere")
            rim = boundary_loops(result.faces, len(result.vertices))
            image = np.pad(result.disk, ((0, 0), (0, 1))) if flat else result.sphere
            area = area_distortion(result, image, len(piece[1]))
            off_circle = min(np.ptp(result.sphere[loop, 2]) for loop in rim)  # smaller holes are filled
            wrong = measured.flips or not result.certificate.bijective or off_circle > ON_CIRCLE
            failed += bool(wrong)
            gap = (result.report.get("optimality") or {}).get("gap")
            bound = "" if gap is None else f"{gap:.2%}"
            numbers = f"{area:.4f} | {measured.angle['surface']:.3f} | {bound} | {seconds:.1f}"
            print(f"{row} {numbers} |{' FAILED' if wrong else ''}", flush=True)
            for finding in result.report["warnings"]:
                print(f"{name} {height}: {finding['text']}", file=sys.stderr, flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
