"""Compare our maps with those of other programs: is there one without flips and with no more area and angle distortion?

    python examples/compare_peers.py DATA_DIR PEERS_CSV --out out/peers
    python examples/compare_peers.py DATA_DIR PEERS_CSV --smoothness SMOOTHNESS_CSV
    python examples/compare_peers.py                     # two made shapes, our own maps alone

DATA_DIR holds meshes; PEERS_CSV has a row per mesh (its file name without ending) and program, with the columns
``mesh``, ``peer``, ``flips``, ``area_surface`` and ``angle_surface``: means over triangles, weighted by original area,
of s1 s2 + 1/(s1 s2) and s1/s2 + s2/s1; 2 is perfect. Rows that failed, or whose area is above --most-area, preserve no
area and are left out. SMOOTHNESS_CSV has the columns ``mesh``, ``peer``, ``flips``, ``area_surface`` and ``jump``.

Our maps are the default one, which is the optimal map, and refinements of it, each from the map made before whose
weight is nearest. A row is won if one of these maps, judged as it is, without a flipped triangle, has area and angle no
higher than the row's. The default map and the refinements that have names come first; where a row falls between two of
our maps, further maps are made there, by bisection of the weight, until one wins or the row's area is reached; the last
one is that of ``match:AREA``.

Writes ``comparison.md``, ``peers.csv`` (the rows), ``smoothness.csv``, ``curve.csv`` (all our maps) and ``default.csv``
(what the default gives). Meshes are done from the smallest to the largest, and the files written anew after each.
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
from omtwarp.metrics import distortion
from omtwarp.metrics.certificate import certify
from omtwarp.optimal.refinement import WEIGHTS as NAMED

DEFAULT = "default"
WEIGHTS = (1000.0, 300.0, 100.0, 50.0, 20.0, 10.0, 5.0, 3.0, 2.0, 1.0)
SUFFIXES = (".ply", ".obj", ".off", ".stl", ".npz")
ITERATIONS = 200
TOLERANCE = 1e-4
# The range of λ in which further maps may be made, and how many for one row.
LEAST, MOST = 1e-4, 1e5
FURTHER = 12


@dataclass
class Point:
    """One of our maps: the weight it was refined with (infinite for the default), how it was judged, what it took."""

    name: str
    weight: float
    area: float
    angle: float
    area_p95: float
    area_max: float
    jump: float
    flips: int
    degree: int
    seconds: float
    iterations: int
    converged: bool
    sphere: np.ndarray = field(repr=False)


class Curve:
    """The maps of one surface between area and angle, added as they are asked for, in the order of falling weight.

    Args:
        surface: the surface.
        result: its default map.
        device: where kernels run.
        tolerance: of refinement; with a weight below 1, times that weight.
    """

    def __init__(self, surface: omtwarp.Surface, result: omtwarp.MapResult, device: str, tolerance: float):
        self.surface, self.device, self.tolerance = surface, device, tolerance
        omt = next(stage for stage in result.report["stages"] if stage["name"] == "omt")
        record = (result.report["seconds"], omt["iterations"], omt["converged"])
        self.points = [self._judge(DEFAULT, np.inf, result.sphere, *record)]
        self.matches: list[Point] = []  # maps that ``match:AREA`` found

    def _judge(
        self, name: str, weight: float, sphere: np.ndarray, seconds: float, iterations: int, converged: bool
    ) -> Point:
        judged = distortion(self.surface, sphere)
        certificate = certify(self.surface, sphere)
        return Point(
            name=name,
            weight=weight,
            area=judged.area["surface"],
            angle=judged.angle["surface"],
            area_p95=judged.area["p95"],
            area_max=judged.area["max"],
            jump=metric_jump(self.surface, sphere),
            flips=certificate.flips,
            degree=certificate.degree,
            seconds=seconds,
            iterations=iterations,
            converged=converged,
            sphere=sphere,
        )

    def at(self, weight: float) -> Point:
        """The map of a weight, refined from the map made before whose weight is nearest."""
        known = [point for point in self.points if point.flips == 0]
        nearest = min(known, key=lambda point: abs(np.log(min(point.weight, MOST) / weight)))
        named = next((str(name) for name, value in NAMED.items() if value == weight), None)
        begun = time.perf_counter()
        # The smaller λ, the closer the curve comes to the conformal map, and the less there is between two maps.
        tolerance = self.tolerance * min(1.0, weight)
        refined = omtwarp.refine_map(
            self.surface,
            nearest.sphere,
            weight=named or weight,
            iterations=ITERATIONS,
            tolerance=tolerance,
            device=self.device,
        )
        seconds = time.perf_counter() - begun
        steps = len(refined.history) - 1
        point = self._judge(named or f"{weight:.4g}", weight, refined.sphere, seconds, steps, refined.converged)
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
            weights = [p for p in self.points if np.isfinite(p.weight)]
            within = [p.weight for p in weights if p.area <= area]
            beyond = [p.weight for p in weights if p.area > area]
            if not within:
                # From about 100 on a larger weight keeps the areas around vertices better, and those of triangles less.
                least = [w for w, _ in sorted(((p.weight, p.area) for p in weights), key=lambda pair: pair[1])[:2]]
                if max(least) / min(least) < 1.05:
                    break
                weight = float(np.sqrt(least[0] * least[1]))
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
        best = self.best(area, angle)
        if won(best, area, angle):
            return best
        matched = self.matched(area)
        return matched if won(matched, area, angle) else best

    def matched(self, area: float) -> Point:
        """The map that ``match:AREA`` finds, from the map with the least area distortion."""
        least = min((p for p in self.points if p.flips == 0), key=lambda p: p.area, default=self.points[0])
        name, begun = f"match:{area:.5f}", time.perf_counter()
        refined = omtwarp.refine_map(self.surface, least.sphere, weight=name, iterations=ITERATIONS, device=self.device)
        seconds, steps = time.perf_counter() - begun, len(refined.history) - 1
        point = self._judge(name, refined.weight, refined.sphere, seconds, steps, refined.converged)
        self.matches.append(point)
        return point

    def best(self, area: float, angle: float) -> Point:
        """The best map made so far; where one with a name is good enough, that."""
        fit = [p for p in self.points if p.flips == 0]
        for point in fit:
            if point.name in (DEFAULT, *map(str, NAMED)) and won(point, area, angle):
                return point
        within = [p for p in fit if p.area <= area]
        if within:
            return min(within, key=lambda p: p.angle)
        return min(fit or self.points, key=lambda p: p.area)

    def smoothest(self, area: float) -> Point:
        """Of the maps with no more than an area distortion the smoothest; of none such the one with the least."""
        within = [p for p in self.points + self.matches if p.flips == 0 and p.area <= area]
        return min(within, key=lambda p: p.jump) if within else min(self.points, key=lambda p: p.area)


def won(point: Point, area: float, angle: float) -> bool:
    return point.flips == 0 and point.degree == 1 and point.area <= area and point.angle <= angle


def metric_jump(surface: omtwarp.Surface, sphere: np.ndarray) -> float:
    """How much the metric G of the map differs between the two triangles of an edge: 0 for a map that is smooth.

    The mean over edges of |G1 - G2| / (|G1| + |G2|), weighted by the area of the two triangles, which are unfolded into
    one plane for it.
    """
    vertices, faces = surface.vertices, surface.faces
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    order = np.lexsort((ends[:, 1], ends[:, 0]))  # every edge twice in a row
    pairs = order.reshape(-1, 2)
    i, j = ends[pairs[:, 0]].T
    apex = np.concatenate([faces[:, 2], faces[:, 0], faces[:, 1]])

    def metric(k: np.ndarray, side: float) -> np.ndarray:
        edge, arm = vertices[j] - vertices[i], vertices[k] - vertices[i]
        base = np.linalg.norm(edge, axis=1)[:, None]
        foot = (arm * edge).sum(axis=1, keepdims=True) / base
        height = side * np.linalg.norm(arm - foot / base * edge, axis=1, keepdims=True)
        along = (sphere[j] - sphere[i]) / base
        across = (sphere[k] - sphere[i] - foot * along) / height
        parts = [along * along, np.sqrt(2.0) * along * across, across * across]
        return np.stack([part.sum(axis=1) for part in parts], axis=1)

    first, second = metric(apex[pairs[:, 0]], 1.0), metric(apex[pairs[:, 1]], -1.0)
    size = np.linalg.norm(first, axis=1) + np.linalg.norm(second, axis=1)
    area = surface.face_areas[pairs % len(faces)].sum(axis=1)
    return float((np.linalg.norm(first - second, axis=1) / size * area).sum() / area.sum())


def ring_error(surface: omtwarp.Surface, sphere: np.ndarray) -> float:
    """Root mean square of the relative errors of the areas around vertices, weighted by these areas."""
    a, b, c = (sphere[surface.faces[:, k]] for k in range(3))
    below = 1.0 + (a * b).sum(axis=1) + (b * c).sum(axis=1) + (c * a).sum(axis=1)
    solid = 2.0 * np.arctan2((a * np.cross(b, c)).sum(axis=1), below)
    image = np.bincount(surface.faces.ravel(), np.repeat(solid, 3))
    wanted = 3.0 * surface.vertex_areas
    return float(np.sqrt((wanted * (image / wanted - 1.0) ** 2).sum() / wanted.sum()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="?", type=Path, help="folder of meshes; none: two made shapes, our maps alone")
    parser.add_argument("peers", nargs="?", type=Path, help="CSV of other programs' maps of these meshes")
    parser.add_argument("--out", type=Path, default=Path("out/peers"), help="folder for the tables")
    parser.add_argument("--meshes", nargs="+", help="names of the meshes to take; all when left out")
    parser.add_argument("--weights", nargs="+", type=float, default=list(WEIGHTS), help="weights λ of the curve")
    parser.add_argument("--smoothness", type=Path, help="CSV of how smooth other programs' maps are")
    parser.add_argument("--tolerance", type=float, default=TOLERANCE, help="of refinement")
    parser.add_argument("--most-area", type=float, default=2.3, help="leave out rows with a larger area distortion")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    peers = read_peers(options.peers, options.most_area) if options.peers else []
    smoothness = read_smoothness(options.smoothness, options.most_area) if options.smoothness else []
    rows: list[dict[str, Any]] = []
    smooth_rows: list[dict[str, Any]] = []
    curve_rows: list[dict[str, Any]] = []
    default_rows: list[dict[str, Any]] = []
    for name, surface in subjects(options.data, options.meshes):
        print(f"{name}: {surface.face_count} faces", flush=True)
        result = omtwarp.map_to_sphere(surface, device=options.device)
        curve = Curve(surface, result, options.device, options.tolerance)
        default_rows.append(default_row(name, surface, result, curve.points[0]))
        print(f"  {describe(curve.points[0])}", flush=True)
        for weight in sorted(options.weights, reverse=True):
            print(f"  {describe(curve.at(weight))}", flush=True)
        for peer in (entry for entry in peers if entry["mesh"] == name):
            rows.append(compare(peer, curve))
            print(f"  {rows[-1]['peer']}: {'won' if rows[-1]['won'] else 'LOST'}", flush=True)
        for peer in (entry for entry in smoothness if entry["mesh"] == name):
            ours = curve.smoothest(peer["area"])
            found = {"ours": ours.name, "our_area": ours.area, "our_jump": ours.jump}
            smooth_rows.append(peer | found | {"won": ours.area <= peer["area"] and ours.jump <= peer["jump"]})
        curve_rows += [curve_row(name, point) for point in curve.points]
        write_csv(options.out / "default.csv", default_rows)
        write_csv(options.out / "curve.csv", curve_rows)
        write_csv(options.out / "peers.csv", rows)
        write_csv(options.out / "smoothness.csv", smooth_rows)
        text = markdown(default_rows, rows, smooth_rows, curve_rows, options)
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


def read_smoothness(path: Path, most_area: float) -> list[dict[str, Any]]:
    """How smooth the maps of other programs are that have no flips, by mesh and area."""
    with path.open(newline="", encoding="utf-8") as file:
        out = [
            {"mesh": row["mesh"], "peer": row["peer"], "area": float(row["area_surface"]), "jump": float(row["jump"])}
            for row in csv.DictReader(file)
            if int(row["flips"]) == 0 and float(row["area_surface"]) <= most_area
        ]
    return sorted(out, key=lambda row: (row["mesh"], row["area"]))


def compare(peer: dict[str, Any], curve: Curve) -> dict[str, Any]:
    """A row of theirs and our map against it."""
    ours = curve.against(peer["area"], peer["angle"])
    return peer | {
        "ours": ours.name,
        "our_flips": ours.flips,
        "our_area": ours.area,
        "our_angle": ours.angle,
        "won": won(ours, peer["area"], peer["angle"]),
    }


def default_row(name: str, surface: omtwarp.Surface, result: omtwarp.MapResult, point: Point) -> dict[str, Any]:
    """What the default, the optimal map, gives, and the flips of the stages before it."""
    stages = {stage["name"]: stage for stage in result.report["stages"]}
    optimality = result.report["optimality"]
    return {
        "mesh": name,
        "faces": surface.face_count,
        "start": result.report["start"]["route"],
        "flips": "/".join(str(stages[stage]["flips"]) for stage in ("conformal", "omt")),
        "degree": point.degree,
        "area": point.area,
        "area_p95": point.area_p95,
        "area_max": point.area_max,
        "angle": point.angle,
        "ring": ring_error(surface, point.sphere),
        "jump": point.jump,
        "gap": optimality["gap"],
        "relative_curl": optimality["relative_curl"],
        "ended": stages["omt"]["ended"],
    }


def curve_row(name: str, point: Point) -> dict[str, Any]:
    return {"mesh": name} | {key: value for key, value in vars(point).items() if key != "sphere"}


def describe(point: Point) -> str:
    return (
        f"{point.name}: area {point.area:.5f}, angle {point.angle:.5f}, flips {point.flips}, "
        f"{point.iterations} steps, {point.seconds:.1f} s{'' if point.converged else ', not converged'}"
    )


def markdown(
    defaults: list[dict[str, Any]],
    rows: list[dict[str, Any]],
    smooth: list[dict[str, Any]],
    curve: list[dict[str, Any]],
    options: argparse.Namespace,
) -> str:
    """All tables."""
    import scipy
    import warp as wp

    lines = [
        "The tables of maps are made by `python examples/compare_peers.py DATA_DIR PEERS_CSV "
        f"--smoothness SMOOTHNESS_CSV`, these on {processor()}, {platform.system()}, device {options.device}, "
        f"Python {platform.python_version()}, NumPy {np.__version__}, SciPy {scipy.__version__}, "
        f"Warp {wp.config.version}.",
        "",
        "## The default map",
        "",
        "Flips: of the conformal and the optimal map. Ring: root mean square error of the areas around "
        "vertices. Jump: how much the metric differs between neighbouring triangles. Gap: how far the cost is above "
        "the lower bound on the cost of every map.",
        "",
        "| mesh | faces | start | flips | degree | area | 95 % below | largest | angle | ring | jump | gap | curl |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for a in defaults:
        gap = "none" if a["gap"] is None else f"{100 * a['gap']:.3f} %"
        lines.append(
            f"| {a['mesh']} | {a['faces']} | {a['start']} | {a['flips']} | {a['degree']} | {a['area']:.5f} "
            f"| {a['area_p95']:.4f} | {a['area_max']:.4g} | {a['angle']:.4f} | {a['ring']:.1e} | {a['jump']:.4f} "
            f"| {gap} | {a['relative_curl']:.4f} |"
        )
    if rows:
        count, total = sum(row["won"] for row in rows), len(rows)
        lines += ["", "## Row by row", "", f"{count} of {total} rows won.", ""]
        lines += ["| mesh | program | flips | area | angle | ours | our flips | our area | our angle | |"]
        lines += ["|---|---|---|---|---|---|---|---|---|---|"]
        for row in rows:
            lines.append(
                f"| {row['mesh']} | {row['peer']} | {row['flips']} | {row['area']:.5f} | {row['angle']:.5f} "
                f"| {row['ours']} | {row['our_flips']} | {row['our_area']:.5f} | {row['our_angle']:.5f} "
                f"| {'won' if row['won'] else '**lost**'} |"
            )
    if smooth:
        count, total = sum(row["won"] for row in smooth), len(smooth)
        lines += ["", "## Smoothness", ""]
        lines += ["Of our maps with no more area distortion the smoothest, beside other programs' maps without flips: "]
        lines[-1] += f"{count} of {total} are smoother than theirs."
        lines += [
            "",
            "| mesh | program | area | jump | ours | our area | our jump | |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for row in smooth:
            lines.append(
                f"| {row['mesh']} | {row['peer']} | {row['area']:.5f} | {row['jump']:.4f} | {row['ours']} "
                f"| {row['our_area']:.5f} | {row['our_jump']:.4f} | {'won' if row['won'] else '**lost**'} |"
            )
    flipped = sum(entry["flips"] > 0 for entry in curve)
    which = f"All {len(curve)} maps" if flipped == 0 else f"{len(curve) - flipped} of {len(curve)} maps"
    lines += ["", "## The trade-off", ""]
    lines += [f"Area / angle distortion of our maps, the default and by weight λ. {which} made are without flips."]
    weights = sorted(options.weights, reverse=True)
    lines += ["", "| mesh | default | " + " | ".join(f"λ = {weight:g}" for weight in weights) + " |"]
    lines += ["|---|---|" + "---|" * len(weights)]
    for name in dict.fromkeys(entry["mesh"] for entry in curve):
        found = {entry["weight"]: entry for entry in curve if entry["mesh"] == name}
        cells = [f"{found[w]['area']:.4f} / {found[w]['angle']:.3f}" if w in found else "" for w in [np.inf, *weights]]
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
    try:
        main()
    except (OSError, omtwarp.OmtwarpError) as error:
        raise SystemExit(f"error: {error}") from None
