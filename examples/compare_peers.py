"""Our maps beside those of other programs: is there a flip-free one with no more area and no more angle distortion?

    python examples/compare_peers.py DATA_DIR PEERS_CSV --out out/peers
    python examples/compare_peers.py                     # two made shapes, our own curve alone

DATA_DIR holds meshes; PEERS_CSV has a row per mesh (its file name without ending) and program, with the columns
``mesh``, ``peer``, ``flips``, ``area_surface`` and ``angle_surface``: means over triangles, weighted by original area,
of s1 s2 + 1/(s1 s2) and s1/s2 + s2/s1; 2 is perfect. Rows that failed, or whose area is above --most-area, preserve no
area and are left out.

Refinement minimises angle + λ area, so that every weight λ gives a point of a curve. Each map is refined from the one
before it, the first from the transported map. A row is won if one of these maps, judged as it is, without a flipped
triangle, has area and angle no higher than the row's. Between two weights nothing is interpolated: where a row falls
between their maps, further maps are made there, by bisection of λ, until one wins or the row's area is met.

Writes ``comparison.md``, ``peers.csv`` (the rows), ``curve.csv`` (all our maps) and ``area.csv`` (what ``--refine
area`` gives). Meshes are done from the smallest to the largest, and the files written anew after each.
"""

from __future__ import annotations

import argparse
import csv
import platform
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import omtwarp
from omtwarp.device.policy import resolve_device
from omtwarp.metrics import distortion
from omtwarp.metrics.certificate import certify
from omtwarp.refine.solver import Refiner

WEIGHTS = (1000.0, 300.0, 100.0, 50.0, 20.0, 10.0, 5.0, 3.0, 2.0, 1.2, 1.0)
SUFFIXES = (".ply", ".obj", ".off", ".stl", ".npz")
ITERATIONS = 300
TOLERANCE = 1e-6
# The range of λ in which further maps may be made, and how many for one row.
LEAST, MOST = 1e-4, 1e5
FURTHER = 12


@dataclass
class Point:
    """One of our maps: the weight it was refined with, how it was judged, and what it took."""

    weight: float
    area: float
    angle: float
    area_p95: float
    area_max: float
    flips: int
    degree: int
    seconds: float
    iterations: int
    converged: bool
    sphere: np.ndarray = field(repr=False)


class Curve:
    """The trade-off curve of one surface, maps added as they are asked for; kept in the order of falling weight."""

    def __init__(self, surface: omtwarp.Surface, transported: np.ndarray, device: str):
        self.surface = surface
        self.device = device
        self.transported = transported
        self.refiner = Refiner(surface, resolve_device(device))
        self.points: list[Point] = []

    def at(self, weight: float) -> Point:
        """The map of a weight, refined from the map made before whose weight is nearest."""
        known = [point for point in self.points if point.flips == 0]
        nearest = min(known, key=lambda point: abs(np.log(point.weight / weight)), default=None)
        start = self.transported if nearest is None else nearest.sphere
        begun = time.perf_counter()
        # The smaller λ, the closer the curve comes to the conformal map, and the less there is between two maps.
        tolerance = TOLERANCE * min(1.0, weight)
        refined = self.refiner.minimise(start, weight, iterations=ITERATIONS, tolerance=tolerance)
        seconds = time.perf_counter() - begun
        judged = distortion(self.surface.vertices, self.surface.faces, refined.sphere)
        certificate = certify(self.surface.faces, refined.sphere)
        point = Point(
            weight=weight,
            area=judged.area["surface"],
            angle=judged.angle["surface"],
            area_p95=judged.area["p95"],
            area_max=judged.area["max"],
            flips=certificate.flips,
            degree=certificate.degree,
            seconds=seconds,
            iterations=len(refined.history) - 1,
            converged=refined.converged,
            sphere=refined.sphere,
        )
        self.points.append(point)
        self.points.sort(key=lambda p: -p.weight)
        return point

    def against(self, area: float, angle: float) -> Point:
        """A map no worse in either, or the one that comes nearest to it: smallest excess of angle at that area."""
        # Bisection towards the largest area allowed, where angle is smallest.
        for _ in range(FURTHER):
            best = self.best(area, angle)
            if won(best, area, angle):
                return best
            within = [p.weight for p in self.points if p.area <= area]
            beyond = [p.weight for p in self.points if p.area > area]
            if not within:
                weight = 4.0 * max(beyond)
            elif not beyond:
                weight = min(within) / 4.0
            else:
                below, above = min(within), max([w for w in beyond if w < min(within)], default=min(within) / 4.0)
                if below / above < 1.001:
                    break
                weight = float(np.sqrt(below * above))
            if not LEAST <= weight <= MOST:
                break
            self.at(weight)
        return self.best(area, angle)

    def best(self, area: float, angle: float) -> Point:
        fit = [p for p in self.points if p.flips == 0]
        within = [p for p in fit if p.area <= area]
        if within:
            return min(within, key=lambda p: p.angle)
        return min(fit or self.points, key=lambda p: p.area)


def won(point: Point, area: float, angle: float) -> bool:
    return point.flips == 0 and point.degree == 1 and point.area <= area and point.angle <= angle


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path, help="folder of meshes; none: two made shapes, our curve alone")
    parser.add_argument("peers", nargs="?", type=Path, help="CSV of other programs' maps of these meshes")
    parser.add_argument("--out", type=Path, default=Path("out/peers"), help="folder for the tables")
    parser.add_argument("--meshes", nargs="+", help="names of the meshes to take; all when left out")
    parser.add_argument("--weights", nargs="+", type=float, default=list(WEIGHTS), help="weights λ of the curve")
    parser.add_argument("--most-area", type=float, default=2.3, help="leave out rows with a larger area distortion")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    peers = read_peers(options.peers, options.most_area) if options.peers else []
    rows: list[dict[str, Any]] = []
    curve_rows: list[dict[str, Any]] = []
    area_rows: list[dict[str, Any]] = []
    for name, surface in subjects(options.data, options.meshes):
        print(f"{name}: {surface.face_count} faces", flush=True)
        result = omtwarp.map_to_sphere(surface, refine="area", device=options.device)
        area_rows.append(area_row(name, surface, result))
        print(f"  refined by area: {area_rows[-1]}", flush=True)
        assert result.transported is not None
        curve = Curve(surface, result.transported, options.device)
        for weight in sorted(options.weights, reverse=True):
            print(f"  {describe(curve.at(weight))}", flush=True)
        for peer in (entry for entry in peers if entry["mesh"] == name):
            rows.append(compare(peer, curve))
            print(f"  {rows[-1]['peer']}: {'won' if rows[-1]['won'] else 'LOST'}", flush=True)
        curve_rows += [curve_row(name, point) for point in curve.points]
        write_csv(options.out / "area.csv", area_rows)
        write_csv(options.out / "curve.csv", curve_rows)
        write_csv(options.out / "peers.csv", rows)
        text = markdown(area_rows, rows, curve_rows, options)
        (options.out / "comparison.md").write_text(text, encoding="utf-8")
    print(text)


def subjects(folder: Path | None, names: list[str] | None) -> list[tuple[str, omtwarp.Surface]]:
    """Names and surfaces, smallest first."""
    if folder is None:
        shapes = omtwarp.shapes
        found = [("blob", shapes.blob(seed=2, sphere=2000)), ("demo", shapes.demo_shape(4000))]
    else:
        paths = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
        found = []
        for path in sorted(paths):
            if names is None or path.stem in names:
                mesh = omtwarp.read_mesh(path)
                found.append((path.stem, omtwarp.Surface(mesh.vertices, mesh.faces)))
    return sorted(found, key=lambda entry: (entry[1].face_count, entry[0]))


def read_peers(path: Path, most_area: float) -> list[dict[str, Any]]:
    """The rows of other programs that preserve area at least somewhat, by mesh and area."""
    out = []
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["area_surface"] and float(row["area_surface"]) <= most_area:
                out.append(
                    {
                        "mesh": row["mesh"],
                        "peer": row["peer"],
                        "flips": int(row["flips"]),
                        "area": float(row["area_surface"]),
                        "angle": float(row["angle_surface"]),
                    }
                )
    return sorted(out, key=lambda row: (row["mesh"], row["area"]))


def compare(peer: dict[str, Any], curve: Curve) -> dict[str, Any]:
    """A row of theirs and our map against it."""
    ours = curve.against(peer["area"], peer["angle"])
    return peer | {
        "weight": ours.weight,
        "our_flips": ours.flips,
        "our_area": ours.area,
        "our_angle": ours.angle,
        "won": won(ours, peer["area"], peer["angle"]),
    }


def area_row(name: str, surface: omtwarp.Surface, result: omtwarp.MapResult) -> dict[str, Any]:
    """What the refinement by area, the default, gives, and the flips of the stages before it."""
    stages = {stage["name"]: stage for stage in result.report["stages"]}
    last = stages["refine"]
    certificate = result.report["certificate"]
    flips = [stages[stage]["flips"] for stage in ("conformal", "moser", "omt", "refine")]
    return {
        "mesh": name,
        "faces": surface.face_count,
        "start": result.report["start"]["route"],
        "flips": "/".join(str(count) for count in flips),
        "degree": certificate["degree"],
        "bijective": certificate["bijective"],
        "area": last["area"]["surface"],
        "area_p95": last["area"]["p95"],
        "area_max": last["area"]["max"],
        "angle": last["angle"]["surface"],
        "converged": last["converged"],
        "refine_seconds": last["seconds"],
        "seconds": result.report["seconds"],
    }


def curve_row(name: str, point: Point) -> dict[str, Any]:
    return {"mesh": name} | {key: value for key, value in vars(point).items() if key != "sphere"}


def describe(point: Point) -> str:
    return (
        f"λ {point.weight:g}: area {point.area:.5f}, angle {point.angle:.5f}, flips {point.flips}, "
        f"{point.iterations} steps, {point.seconds:.1f} s{'' if point.converged else ', not converged'}"
    )


def markdown(
    areas: list[dict[str, Any]],
    rows: list[dict[str, Any]],
    curve: list[dict[str, Any]],
    options: argparse.Namespace,
) -> str:
    """All tables."""
    import scipy
    import warp as wp

    lines = [
        f"Made by `examples/compare_peers.py` on {processor()}, {platform.system()}, device {options.device}, "
        f"Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}, "
        f"Warp {wp.config.version}.",
        "",
        "## Refined by area",
        "",
        "Flips: of the start, Moser's map, the transported and the refined map.",
        "",
        "| mesh | faces | start | flips | degree | area | area p95 | area max | angle | refinement | all |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for a in areas:
        lines.append(
            f"| {a['mesh']} | {a['faces']} | {a['start']} | {a['flips']} | {a['degree']} | {a['area']:.5f} "
            f"| {a['area_p95']:.4f} | {a['area_max']:.4g} | {a['angle']:.4f} "
            f"| {a['refine_seconds']:.1f} s | {a['seconds']:.1f} s |"
        )
    if rows:
        count, total = sum(row["won"] for row in rows), len(rows)
        lines += ["", "## Row by row", "", f"{count} of {total} rows won.", ""]
        lines += ["| mesh | program | flips | area | angle | our λ | our flips | our area | our angle | |"]
        lines += ["|---|---|---|---|---|---|---|---|---|---|"]
        for row in rows:
            lines.append(
                f"| {row['mesh']} | {row['peer']} | {row['flips']} | {row['area']:.5f} | {row['angle']:.5f} "
                f"| {row['weight']:.4g} | {row['our_flips']} | {row['our_area']:.5f} | {row['our_angle']:.5f} "
                f"| {'won' if row['won'] else '**lost**'} |"
            )
    flipped = sum(entry["flips"] > 0 for entry in curve)
    which = f"All {len(curve)} maps" if flipped == 0 else f"{len(curve) - flipped} of {len(curve)} maps"
    lines += ["", "## The trade-off", ""]
    lines += [f"Area / angle distortion of our maps by the weight λ of area. {which} made are without flips."]
    weights = sorted(options.weights, reverse=True)
    lines += ["", "| mesh | " + " | ".join(f"λ = {weight:g}" for weight in weights) + " |"]
    lines += ["|---|" + "---|" * len(weights)]
    for name in dict.fromkeys(entry["mesh"] for entry in curve):
        found = {entry["weight"]: entry for entry in curve if entry["mesh"] == name}
        cells = [f"{found[w]['area']:.4f} / {found[w]['angle']:.3f}" if w in found else "" for w in weights]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def processor() -> str:
    """The processor's name and how many cores may be used."""
    import os

    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        name = models[0] if models else name
    return f"{name}, {os.cpu_count()} cores"


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    if not rows:
        return
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
