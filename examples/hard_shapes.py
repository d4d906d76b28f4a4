"""Compare the time of hard shapes with the median of ordinary shapes of as many triangles.

    python examples/hard_shapes.py                        # made shapes
    python examples/hard_shapes.py box.ply octopus.ply    # and meshes of your own

The made hard shapes are a tetrahedron with one face cut into 729, whose vertices crowd in its corners, and a sphere
with 50 vertices drawn out to spines. Ordinary shapes are smooth and noisy blobs, an ellipsoid, a body with limbs, a
bent tube, and a blob with irregular triangles. Printed are processor seconds of all threads for a whole map, the median
of the ordinary shapes, the quotient, and what each stage of the hard shape's map gave up.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface, as_surface

ROUNDS, SPINES, SPINE_LENGTH, SPHERE_FREQUENCY = 6, 50, 3.0, 16
ORDINARY: dict[str, Callable[[int], Surface]] = {
    "blob": lambda faces: shapes.blob(seed=0, sphere=shapes.icosphere_near(faces)),
    "finer blob": lambda faces: shapes.blob(seed=5, degree=10, sphere=shapes.icosphere_near(faces)),
    "noisy blob": lambda faces: shapes.noisy(shapes.blob(seed=1, sphere=shapes.icosphere_near(faces)), 0.2),
    "irregular blob": lambda faces: shapes.flip_edges(
        shapes.blob(seed=2, sphere=shapes.icosphere_near(faces)), rounds=2
    ),
    "ellipsoid": lambda faces: shapes.ellipsoid((1.0, 0.6, 0.4), faces),
    "limbs": lambda faces: shapes.limbs(length=1.5, sphere=shapes.icosphere_near(faces)),
    "tube": lambda faces: shapes.tube(2.0, bend=1.0, face_count=faces),
}


def tetrahedron_with_a_fine_face(rounds: int) -> Surface:
    """A tetrahedron, one face of which is cut into three at its centre, again and again."""
    points = [np.array(corner) for corner in ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, -1.0, -1.0))]
    fine = [(1, 2, 3)]
    for _ in range(rounds):
        cut = []
        for a, b, c in fine:
            points.append((points[a] + points[b] + points[c]) / 3.0)
            middle = len(points) - 1
            cut += [(a, b, middle), (b, c, middle), (c, a, middle)]
        fine = cut
    return as_surface((np.array(points), np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), *fine])))


def urchin(spines: int, length: float, frequency: int) -> Surface:
    """A sphere with single vertices drawn out to so many times its radius."""
    sphere = shapes.icosphere(frequency)
    radius = np.ones(sphere.vertex_count)
    radius[np.random.default_rng(0).choice(sphere.vertex_count, spines, replace=False)] = length
    return as_surface((sphere.vertices * radius[:, None], sphere.faces))


def mapped(surface: Surface) -> tuple[float, list[str]]:
    """Return processor seconds of a map, and what its stages gave up."""
    begun = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", omtwarp.OmtwarpWarning)
        report = omtwarp.map_to_sphere(surface, device="cpu").report
    seconds = time.process_time() - begun
    notes = [report["start"]["reason"]] if report["start"].get("reason") else []
    for stage in report["stages"]:
        notes += [f"{stage['name']}: {stage['gave_up']}"] if stage.get("gave_up") else []
        notes += [f"{stage['name']}: {stage['ended']}"] if stage.get("converged") is False else []
    return seconds, notes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", metavar="MESH")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="in which the tetrahedron's face is cut")
    parser.add_argument("--frequency", type=int, default=SPHERE_FREQUENCY, help="of the sphere with spines")
    options = parser.parse_args()
    hard = {
        "tetrahedron, one fine face": tetrahedron_with_a_fine_face(options.rounds),
        f"sphere with {SPINES} spines": urchin(SPINES, SPINE_LENGTH, options.frequency),
    }
    for path in options.meshes:
        mesh = omtwarp.read_mesh(path)
        hard[Path(path).stem] = as_surface((mesh.vertices, mesh.faces))
    mapped(tetrahedron_with_a_fine_face(3))  # loads the kernels
    print("| shape | faces | CPU s | median of ordinary shapes | quotient | given up |")
    print("|:--|--:|--:|--:|--:|:--|")
    for name, surface in hard.items():
        seconds, notes = mapped(surface)
        median = float(np.median([mapped(make(surface.face_count))[0] for make in ORDINARY.values()]))
        row = [name, str(surface.face_count), f"{seconds:.3g}", f"{median:.3g}", f"{seconds / median:.3g}"]
        print(f"| {' | '.join(row)} | {'; '.join(notes)} |", flush=True)


if __name__ == "__main__":
    try:
        main()
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
