"""Make Tables 1, 2 and 3 of the paper for any meshes, with our figures and the paper's.

    python examples/paper_tables.py MESH [MESH ...] --out out/tables
    python examples/paper_tables.py                              # three small made shapes

Writes ``tables.md``, ``distortion.csv``, ``performance.csv`` and ``tradeoff.csv``. The paper's figures are given for
meshes whose file name begins with that of one of its models (gargoyle, maxplanck, skull, bunny, squirrel); a mesh of
that name need not be the paper's mesh.

Columns: Tutte and mean-value weights (Gotsman et al. 2003), Haker et al. (2000), Moser, the optimal transport map (MK
in the paper), its refinement, and with ``--paper-scheme`` Algorithms 1 and 2 as written. Both weightings are given:
'sphere', by area on the sphere, with which the paper's tables agree, and 'surface', by original area, which counts the
surface that a map crowds together.

Three trade-off curves lead from the conformal map to an area-preserving one: two displacement interpolations
x -> exp_x(t log_x(y)), that is, the optimal and the refined map stopped on their way at t, and the maps of the density
μ^t, a density exponent between 0 and 1. Angle distortion grows as area distortion falls. Where ours has the lower area
distortion, the curves say what angle distortion they have at the paper's.
"""

from __future__ import annotations

import argparse
import csv
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import omtwarp
from omtwarp.metrics import Distortion, distortion

METHODS = ("tutte", "mean-value", "haker", "moser", "omt", "refined", "paper")
TITLES = {
    "tutte": "Tutte",
    "mean-value": "Mean value",
    "haker": "Haker",
    "moser": "Moser",
    "omt": "Optimal (MK)",
    "refined": "Refined",
    "paper": "Algorithm 2",
}
# Tables 1 (angle), 2 (area) and 3 (iterations, seconds) of the paper, in the order of its columns.
PAPER_COLUMNS = ("tutte", "mean-value", "haker", "moser", "omt")
PAPER: dict[str, dict[str, tuple[float, ...]]] = {
    "gargoyle": {
        "angle": (2.53, 2.458, 2.153, 2.97, 2.33),
        "area": (4.03, 4.16, 3.78, 2.51, 2.61),
        "run": (1687, 1451),
    },
    "maxplanck": {
        "angle": (2.62, 2.15, 2.004, 2.38, 2.29),
        "area": (2.67, 2.32, 2.37, 2.004, 2.007),
        "run": (2120, 2460),
    },
    "skull": {"angle": (2.55, 2.12, 2.11, 2.23, 2.2), "area": (2.71, 2.4, 2.39, 2.01, 2.01), "run": (1371, 2132)},
    "bunny": {"angle": (2.65, 2.52, 2.02, 3.17, 2.76), "area": (3.47, 3.65, 3.26, 2.57, 2.66), "run": (2530, 3093)},
    "squirrel": {"run": (814, 971)},
}
STEPS = 21
DENSITY_WEIGHT = 10.0  # of area against angle in the refinement, enough to keep the areas that are prescribed
EXPONENTS = (0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
CURVES = {"omt": "optimal, stopped at t", "refined": "refined, stopped at t", "exponent": "density μ^t"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", type=Path, help="mesh files; none: small made shapes")
    parser.add_argument("--out", type=Path, default=Path("out/tables"), help="folder for the tables")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--refine", default="area", help="weight of the refinement; none leaves it out")
    parser.add_argument("--paper-scheme", action="store_true", help="run Algorithms 1 and 2 as written too (minutes)")
    parser.add_argument("--optimality", action="store_true", help="measure how far from optimal the maps are")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    for name, surface in subjects(options.meshes):
        print(f"{name}: {surface.vertex_count} vertices", flush=True)
        new, maps = measure(name, surface, options)
        rows += new
        curves += tradeoff(name, surface, maps, options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    write_csv(options.out / "distortion.csv", [{k: v for k, v in row.items() if k not in RUN} for row in rows])
    write_csv(options.out / "performance.csv", [{k: row.get(k) for k in ("mesh", "method", *RUN)} for row in rows])
    write_csv(options.out / "tradeoff.csv", curves)
    text = markdown(rows, curves)
    (options.out / "tables.md").write_text(text, encoding="utf-8")
    print(text)


def subjects(paths: list[Path]) -> list[tuple[str, omtwarp.Surface]]:
    """Names and surfaces of the meshes asked for."""
    if not paths:
        shapes = omtwarp.shapes
        return [
            ("blob", shapes.blob(seed=2, sphere=2000)),
            ("limbs", shapes.limbs()),
            ("demo", shapes.demo_shape(4000)),
        ]
    out = []
    for path in paths:
        mesh = omtwarp.read_mesh(path)
        out.append((path.name.split(".")[0], omtwarp.Surface(mesh.vertices, mesh.faces)))
    return out


RUN = ("vertices", "faces", "iterations", "seconds", "paper_iterations", "paper_seconds", "relative_curl", "gap")


def measure(
    name: str, surface: omtwarp.Surface, options: argparse.Namespace
) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """One row per method, and the maps."""
    from omtwarp.baselines import barycentric_map

    rows: list[dict[str, Any]] = []
    maps: dict[str, np.ndarray] = {}

    def add(method: str, sphere: np.ndarray, iterations: int, seconds: float, note: str = "") -> None:
        judged = distortion(surface, sphere)
        maps[method] = sphere
        rows.append(row(name, surface, method, judged, iterations, seconds) | {"note": note})
        print(f"  {TITLES[method]}: {judged}", flush=True)

    for weights in ("tutte", "mean-value"):
        begun = time.perf_counter()
        solved = barycentric_map(surface, weights=weights, device=options.device)
        note = f"residual {solved.residual:.1e}"
        add(weights, solved.sphere, solved.iterations, time.perf_counter() - begun, note)
    last = "omt" if options.refine == "none" else "refine"
    result = omtwarp.map_to_sphere(surface, until=last, refine=options.refine, device=options.device)
    stages = {stage["name"]: stage for stage in result.report["stages"]}
    route = result.report["start"]["route"]
    even = omtwarp.map_to_sphere(surface, until="moser", device=options.device)
    stages["moser"] = next(stage for stage in even.report["stages"] if stage["name"] == "moser")
    kept = {"haker": ("conformal", result.conformal), "moser": ("moser", even.moser)}
    kept |= {"omt": ("omt", result.transported), "refined": ("refine", result.sphere)}
    for method, (stage, sphere) in kept.items():
        if stage in stages and sphere is not None:
            done = stages[stage]
            note = f"start: {route}" if method == "haker" else ""
            add(method, sphere, done["iterations"], done["seconds"], note)
    if options.paper_scheme:
        paper = omtwarp.map_to_sphere(surface, scheme="paper", cost="geodesic", until="omt", device=options.device)
        done = next(stage for stage in paper.report["stages"] if stage["name"] == "omt")
        add("paper", paper.sphere, done["iterations"], done["seconds"])
    if options.optimality:
        from omtwarp.metrics.optimality import optimality

        source = result.conformal if result.source is None else result.source  # what the flows transport
        for entry in rows:
            if entry["method"] in ("moser", "omt"):
                report = optimality(surface, maps[entry["method"]], start=source, device=options.device)
                entry |= {"relative_curl": report.relative_curl, "gap": report.gap}
    maps["start"] = result.conformal
    return rows, maps


def row(
    name: str, surface: omtwarp.Surface, method: str, judged: Distortion, iterations: int, seconds: float
) -> dict[str, Any]:
    """Everything known about one map."""
    paper = paper_of(name)
    out: dict[str, Any] = {
        "mesh": name,
        "method": method,
        "flips": judged.flips,
        "angle_sphere": judged.angle["sphere"],
        "area_sphere": judged.area["sphere"],
        "angle_surface": judged.angle["surface"],
        "area_surface": judged.area["surface"],
        "paper_angle": None,
        "paper_area": None,
        "vertices": surface.vertex_count,
        "faces": surface.face_count,
        "iterations": iterations,
        "seconds": seconds,
        "paper_iterations": None,
        "paper_seconds": None,
        "relative_curl": None,
        "gap": None,
    }
    like = {"refined": "omt", "paper": "omt"}.get(method, method)
    if "angle" in paper:
        column = PAPER_COLUMNS.index(like)
        out |= {"paper_angle": paper["angle"][column], "paper_area": paper["area"][column]}
    if "run" in paper and method in ("omt", "paper"):
        out |= {"paper_iterations": paper["run"][0], "paper_seconds": paper["run"][1]}
    return out


def paper_of(name: str) -> dict[str, tuple[float, ...]]:
    plain = name.lower().replace("-", "").replace("_", "")
    return next((figures for model, figures in PAPER.items() if plain.startswith(model)), {})


def interpolate(start: np.ndarray, end: np.ndarray, t: float) -> np.ndarray:
    """Points a part t of the way along the arcs from start to end, shape [V, 3]."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, (start * end).sum(axis=1))
    unit = axis / np.maximum(sine, 1e-300)[:, None]
    turned = np.cos(t * angle)[:, None] * start + np.sin(t * angle)[:, None] * np.cross(unit, start)
    return np.where((sine > 1e-15)[:, None], turned, end)


def map_with_density_exponent(
    surface: omtwarp.Surface, conformal: np.ndarray, exponent: float, device: str
) -> np.ndarray:
    """Map a surface so that areas lie between those of the conformal map and those of the surface, shape [V, 3].

    A triangle of area A that covers the area a on the conformal sphere is to cover a part of the sphere proportional to
    A^p a^(1-p). Moser's flow makes the map, and refinement evens it out, which only lowers the angle distortion.

    Raises:
        OmtwarpError: flips could not be undone.
    """
    from omtwarp.mesh.surface import triangle_areas
    from omtwarp.optimal.refinement import least_distortion

    # In logarithms, since an area on the sphere may be as good as zero.
    on_sphere = np.log(np.maximum(triangle_areas(conformal, surface.faces), 1e-300))
    target = surface.with_areas(np.exp(exponent * np.log(surface.face_areas) + (1.0 - exponent) * on_sphere))
    sphere = omtwarp.moser_map(target, conformal, device=device).sphere
    if not omtwarp.certify(surface, sphere).bijective:
        sphere = omtwarp.untangle(target, sphere, device=device).sphere
    given = {"iterations": 100, "tolerance": 1e-4, "device": device}
    return least_distortion(target, sphere, DENSITY_WEIGHT, **given).sphere


def tradeoff(name: str, surface: omtwarp.Surface, maps: dict[str, np.ndarray], device: str) -> list[dict[str, Any]]:
    """Area against angle on the way from the conformal map to ours, and at the paper's area distortion."""

    def stopped(method: str) -> Callable[[float], np.ndarray]:
        return lambda t: interpolate(maps["start"], maps[method], t)

    def of_density(t: float) -> np.ndarray:
        return map_with_density_exponent(surface, maps["start"], t, device)

    out: list[dict[str, Any]] = []
    paper = paper_of(name)
    ways = [(method, stopped(method), np.linspace(0.0, 1.0, STEPS)) for method in ("omt", "refined") if method in maps]
    for method, way, values in [*ways, ("exponent", of_density, np.array([0.0, *EXPONENTS]))]:
        curve = [(float(t), judged) for t in values if (judged := judge(surface, maps["start"], way, float(t)))]
        out += [record(name, method, t, judged, "curve") for t, judged in curve]
        if "area" not in paper:
            continue
        area, angle = paper["area"][-1], paper["angle"][-1]
        below = [(t, judged) for t, judged in curve if judged.area["sphere"] <= area]
        if not below or below[0][0] == 0.0:
            continue
        # Area falls along the way: halve the interval that holds the paper's.
        high, judged = below[0]
        low = max(t for t, _ in curve if t < high)
        for _ in range(7 if method == "exponent" else 40):
            middle = (low + high) / 2.0
            found = judge(surface, maps["start"], way, middle)
            if found is None or found.area["sphere"] > area:
                low = middle
            else:
                high, judged = middle, found
        out.append(record(name, method, high, judged, "paper's area") | {"paper_area": area, "paper_angle": angle})
    return out


def judge(
    surface: omtwarp.Surface, start: np.ndarray, way: Callable[[float], np.ndarray], t: float
) -> Distortion | None:
    """Distortion at t; None where no map without flips was found."""
    try:
        return distortion(surface, way(t) if t > 0.0 else start)
    except omtwarp.OmtwarpError:
        return None


def record(name: str, method: str, t: float, judged: Distortion, kind: str) -> dict[str, Any]:
    return {
        "mesh": name,
        "method": method,
        "kind": kind,
        "t": t,
        "area_sphere": judged.area["sphere"],
        "angle_sphere": judged.angle["sphere"],
        "area_surface": judged.area["surface"],
        "angle_surface": judged.angle["surface"],
        "flips": judged.flips,
        "paper_area": None,
        "paper_angle": None,
    }


def markdown(rows: list[dict[str, Any]], curves: list[dict[str, Any]]) -> str:
    """The three tables, and what the trade-off says, as Markdown."""
    names = list(dict.fromkeys(entry["mesh"] for entry in rows))
    methods = [m for m in METHODS if any(entry["method"] == m for entry in rows)]
    found = {(entry["mesh"], entry["method"]): entry for entry in rows}
    lines = [f"Made by `examples/paper_tables.py` on {machine()}. Ours / the paper's; 2 is perfect.", ""]

    def table(title: str, cell: Any, columns: list[str] = methods) -> None:
        lines.extend([f"## {title}", "", "| mesh | faces | " + " | ".join(TITLES[m] for m in columns) + " |"])
        lines.append("|---|---|" + "---|" * len(columns))
        for name in names:
            cells = [cell(found[name, m]) if (name, m) in found else "" for m in columns]
            faces = next(entry["faces"] for entry in rows if entry["mesh"] == name)
            lines.append(f"| {name} | {faces} | " + " | ".join(cells) + " |")
        lines.append("")

    def against(ours: str, paper: str) -> Any:
        return lambda e: f"{e[ours]:.4g}" + (f" / {e[paper]:g}" if e[paper] is not None else "")

    table("Table 1: angle distortion, by area on the sphere", against("angle_sphere", "paper_angle"))
    table("Table 2: area distortion, by area on the sphere", against("area_sphere", "paper_area"))
    table("Table 1, by area on the surface", lambda e: f"{e['angle_surface']:.4g}")
    table("Table 2, by area on the surface", lambda e: f"{e['area_surface']:.4g}")
    table("Flipped triangles", lambda e: str(e["flips"]))

    def run(entry: dict[str, Any]) -> str:
        ours = f"{entry['iterations']} it, {entry['seconds']:.2f} s"
        paper = entry["paper_iterations"]
        return ours + (f" / {paper} it, {entry['paper_seconds']} s" if paper is not None else "")

    table("Table 3: iterations and seconds of each stage", run)
    if any(entry["gap"] is not None for entry in rows):
        table(
            "Relative curl left over, and cost over its lower bound",
            lambda e: f"{e['relative_curl']:.4f}, {100 * e['gap']:.3f} %" if e["gap"] is not None else "",
            [m for m in methods if m in ("moser", "omt")],
        )
    points = [entry for entry in curves if entry["kind"] == "paper's area"]
    if points:
        lines += ["## At the paper's area distortion", ""]
        lines.append("| mesh | curve | t | paper's area | our area | our angle | paper's angle | flips |")
        lines.append("|---|---|---|---|---|---|---|---|")
        for p in points:
            lines.append(
                f"| {p['mesh']} | {CURVES[p['method']]} | {p['t']:.3f} | {p['paper_area']:g} | {p['area_sphere']:.4f} "
                f"| {p['angle_sphere']:.4f} | {p['paper_angle']:g} | {p['flips']} |"
            )
        lines.append("")
    return "\n".join(lines)


def machine() -> str:
    """The processor and the versions of what counts."""
    import os

    import scipy

    from omtwarp.device.start import wp

    processor = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        processor = models[0] if models else processor
    return (
        f"{processor}, {len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else os.cpu_count()} cores, "
        f"{platform.system()}, omtwarp {omtwarp.__version__}, Python {platform.python_version()}, "
        f"NumPy {np.__version__}, SciPy {scipy.__version__}, Warp {wp.config.version}"
    )


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
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
