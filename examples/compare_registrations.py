"""Compare registrations of maps to a target: rotation alone, omtwarp, and other programs where they are installed.

    python examples/compare_registrations.py LEFT.npz OTHER.npz --to fsaverage5-left --out registrations.md
    python examples/compare_registrations.py             # a made cortex and a smooth warp of it

A row has the correlation of sulcal depth and curvature at the target's vertices, by one recipe for all surfaces; the
strain of the sphere after against before, below which 95 % of its area is, and the largest: of areas, |log2 J|, and of
stretches, log2 R; triangles turned over; and seconds of CPU. Other programs start from the same rotated sphere:
``CAT_SurfWarp`` of cat-surf and ``msm`` or ``newmsm`` of MSM, with their own settings, if they are on the PATH.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import omtwarp
from omtwarp.flips.exact import flipped_faces
from omtwarp.geometry.harmonics import real_harmonics
from omtwarp.mesh.data import VertexData, write_data
from omtwarp.mesh.surface import triangle_areas
from omtwarp.mesh.write import write_mesh
from omtwarp.registration.sides import Side, two_sides
from omtwarp.registration.strain import octaves
from omtwarp.resampling import SpherePoints
from omtwarp.spheres import mesh_grid

RADIUS = 100.0  # of the spheres that other programs get
COLUMNS = ("surface", "program", "sulc", "curv", "\\|log2 J\\|", "largest", "log2 R", "largest", "flips", "CPU s")
Program = Callable[[Side, Side, Path], np.ndarray]


def made_pair() -> tuple[SpherePoints, SpherePoints]:
    """Return a ball with folds, and the same surface with its sphere warped by a flow that moves up to 10 degrees."""
    ball = omtwarp.shapes.icosphere(16)
    height = real_harmonics(ball.vertices, 14)[:, 1:] @ np.random.default_rng(0).normal(size=224)
    surface = ball.vertices * np.exp(0.15 * np.tanh(height / height.std()))[:, None]
    warped = ball.vertices
    for _ in range(20):
        x, y, z = warped.T
        warped = warped + 0.01 * np.column_stack([y, x, -z])
        warped /= np.linalg.norm(warped, axis=1, keepdims=True)
    first, second = (SpherePoints(mesh_grid(sphere, ball.faces), surface) for sphere in (ball.vertices, warped))
    return first, second


def with_cat(moving: Side, target: Side, folder: Path) -> np.ndarray:
    """Run Spherical Demons of cat-surf."""
    files = write_sides(moving, target, folder)
    words = ["-i", files["surface"], "-is", files["sphere"], "-t", files["to_surface"], "-ts", files["to_sphere"]]
    subprocess.run(["CAT_SurfWarp", *words, "-ws", str(folder / "out.gii")], check=True, capture_output=True)
    return omtwarp.read_mesh(folder / "out.gii").vertices


def with_msm(moving: Side, target: Side, folder: Path) -> np.ndarray:
    """Run MSM on sulcal depth."""
    files = write_sides(moving, target, folder)
    words = [f"--inmesh={files['sphere']}", f"--refmesh={files['to_sphere']}"]
    words += [f"--indata={files['sulc']}", f"--refdata={files['to_sulc']}", f"--out={folder / 'out.'}"]
    program = shutil.which("msm") or shutil.which("newmsm") or "msm"
    subprocess.run([program, *words], check=True, capture_output=True)
    return omtwarp.read_mesh(folder / "out.sphere.reg.surf.gii").vertices


PROGRAMS: dict[str, tuple[Program, tuple[str, ...]]] = {
    "cat-surf": (with_cat, ("CAT_SurfWarp",)),
    "MSM": (with_msm, ("msm", "newmsm")),
}


def write_sides(moving: Side, target: Side, folder: Path) -> dict[str, str]:
    """Write surfaces, spheres and depth of both sides as GIFTI, and return the files."""
    files = {}
    for prefix, side in (("", moving), ("to_", target)):
        faces = side.points.grid.triangles
        for name, points in (("surface", side.points.vertices), ("sphere", RADIUS * side.points.grid.points)):
            files[prefix + name] = str(folder / f"{prefix}{name}.surf.gii")
            write_mesh(Path(files[prefix + name]), points, faces)
        files[prefix + "sulc"] = str(folder / f"{prefix}sulc.shape.gii")
        write_data(Path(files[prefix + "sulc"]), VertexData(side.features["sulc"][:, None], ("sulc",)))
    return files


def percentile(strain: np.ndarray, areas: np.ndarray) -> float:
    """Return the strain below which 95 % of the area is."""
    order = np.argsort(strain)
    sums = np.cumsum(areas[order])
    return float(strain[order][np.searchsorted(sums, 0.95 * sums[-1])])


def judged(before: Side, target: Side, sphere: np.ndarray, seconds: float) -> list[str]:
    """Return the numbers of a row."""
    sphere = sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    start, faces = before.points.grid.points, before.points.grid.own_triangles
    agreement, areas = before.moved(sphere).agreement(target), triangle_areas(start, faces)
    by_area, by_stretch = octaves(start, sphere, faces)
    numbers = [agreement["sulc"], agreement["curv"]]
    for strain in (np.abs(by_area), by_stretch):
        numbers += [percentile(strain, areas), float(strain.max())]
    flips = int(flipped_faces(sphere, faces).sum())
    return [*(f"{number:.3f}" for number in numbers), str(flips), f"{seconds:.1f}"]


def spent() -> float:
    """Return the seconds of CPU of this process and of those that it waited for."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def rows(name: str, moving: SpherePoints, target: SpherePoints | str) -> list[list[str]]:
    """Return the rows of a pair."""
    here, there = two_sides(moving, target, None, None)
    begun = spent()
    given = {"features": here.own, "to_features": there.own, "check": False}
    rotation = omtwarp.align(here.points, there.points, **given).rotation
    turned = here.moved(here.points.grid.points @ rotation.T)
    found = [[name, "rotation", *judged(turned, there, turned.points.grid.points, spent() - begun)]]
    begun = spent()
    registered = omtwarp.register(moving, target)
    before = here.moved(here.points.grid.points @ registered.start.rotation.T)
    found.append([name, "omtwarp", *judged(before, there, registered.closed_sphere, spent() - begun)])
    for program, (run, commands) in PROGRAMS.items():
        if not any(map(shutil.which, commands)):
            continue
        begun = spent()
        with tempfile.TemporaryDirectory() as folder:
            sphere = run(turned, there, Path(folder))
        found.append([name, program, *judged(turned, there, sphere, spent() - begun)])
    return found


def main() -> None:
    """Register every map with every program, and write or print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("maps", nargs="*", type=Path, help="maps (.npz) with their surfaces")
    parser.add_argument("--to", default="fsaverage5-left", help="a map, or an average that is installed")
    parser.add_argument("--out", type=Path, help="file of the table; printed if left out")
    given = parser.parse_args()
    table = []
    for file in given.maps:
        begun = time.time()
        table += rows(file.name.partition(".")[0], omtwarp.resampling.as_points(file), given.to)
        print(f"{file.name}: {time.time() - begun:.0f} s", flush=True)
    if not given.maps:
        table = rows("made", *made_pair())
    absent = [name for name, (_, commands) in PROGRAMS.items() if not any(map(shutil.which, commands))]
    table += [["", program, "not installed", *[""] * (len(COLUMNS) - 3)] for program in absent]
    lines = [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS), *(f"| {' | '.join(row)} |" for row in table)]
    text = "\n".join(lines) + "\n"
    if given.out is None:
        print(text, end="")
    else:
        given.out.write_text(text, "utf-8")


if __name__ == "__main__":
    try:
        main()
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
