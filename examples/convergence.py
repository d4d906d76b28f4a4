"""How fast the transport flows converge: the plain flow, the paper's V-cycles and the default.

    python examples/convergence.py MESH [MESH ...] --out out/convergence
    python examples/convergence.py                               # a small made shape

Writes ``convergence.md``, ``convergence.csv`` (every iteration) and ``convergence.png``. All flows lower the squared
geodesic cost from the same map:

* ``moser``: Moser's map of the conformal one, where the paper starts. It is within a per cent or two of the optimal
  cost already.
* ``twisted``: that map with every parallel of the sphere turned by an angle of its own, which keeps areas and costs
  more: farther from optimal, where multiresolution can make a difference.

The three are ``plain`` (equation 12: H is the curl itself, in the space the mesh resolves), ``paper`` (Algorithms 1 and
2 with the V-cycle 1, 2, 3, 4, 5, 4, 3, 2, 1) and ``default`` (the curl preconditioned in the wavelet basis, and
conjugate directions). Every flow ends where areas would no longer be kept. "Within 1 %" is
given twice: of the final cost itself, which Moser's map often reaches at the start, and of the possible gain. The
final cost is that of the default flow; one that ends below it has lost area.
"""

from __future__ import annotations

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import numpy as np

import omtwarp
from omtwarp.flips.exact import count_flips
from omtwarp.metrics import distortion
from omtwarp.transport.flow import optimal_transport
from omtwarp.transport.paper import paper_flow

SCHEMES = ("plain", "paper", "default")
COLORS = {"plain": "#2f5d73", "paper": "#d6a037", "default": "#c2183a"}
WITHIN = 0.01


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="*", type=Path, help="mesh files; none: a small made shape")
    parser.add_argument("--out", type=Path, default=Path("out/convergence"), help="folder for the results")
    parser.add_argument("--twist", type=float, default=0.25, help="largest turn of a parallel, about, in radians")
    parser.add_argument("--iterations", type=int, help="most iterations of the plain flow; 1000, 200 without meshes")
    parser.add_argument("--device", default="auto")
    options = parser.parse_args()
    most = options.iterations or (1000 if options.meshes else 200)
    runs: list[dict[str, Any]] = []
    for name, surface in subjects(options.meshes):
        print(f"{name}: {surface.vertex_count} vertices", flush=True)
        result = omtwarp.map_to_sphere(surface, until="moser", device=options.device)
        assert result.moser is not None
        starts = {"moser": result.moser, "twisted": twisted(result.moser, options.twist)}
        for label, initial in starts.items():
            if count_flips(initial, surface.faces):
                print(f"  {label}: left out, it has flips", flush=True)
                continue
            for scheme in SCHEMES:
                runs.append(run(name, surface, result.conformal, initial, label, scheme, most, options.device))
    options.out.mkdir(parents=True, exist_ok=True)
    text = markdown(runs)
    (options.out / "convergence.md").write_text(text, encoding="utf-8")
    write_csv(options.out / "convergence.csv", runs)
    draw(options.out / "convergence.png", runs)
    print(text)


def subjects(paths: list[Path]) -> list[tuple[str, omtwarp.Surface]]:
    """Names and surfaces of the meshes asked for."""
    if not paths:
        return [("blob", omtwarp.shapes.blob(seed=2, sphere=2000))]
    out = []
    for path in paths:
        mesh = omtwarp.read_mesh(path)
        out.append((path.name.split(".")[0], omtwarp.Surface(mesh.vertices, mesh.faces)))
    return out


def twisted(points: np.ndarray, amount: float) -> np.ndarray:
    """Every parallel turned about the z axis by an angle that varies smoothly from pole to pole; areas are kept."""
    z, longitude = points[:, 2], np.arctan2(points[:, 1], points[:, 0])
    longitude = longitude + amount * np.sin(np.pi * z)
    radius = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], axis=1)


def run(
    name: str,
    surface: omtwarp.Surface,
    start: np.ndarray,
    initial: np.ndarray,
    label: str,
    scheme: str,
    most: int,
    device: str,
) -> dict[str, Any]:
    """One flow from one start: cost and time of every iteration, and the areas at the end."""
    clock: list[float] = []

    def tick(*_: Any) -> None:
        clock.append(time.perf_counter())

    begun = time.perf_counter()
    if scheme == "paper":
        flow = paper_flow(surface, initial, start=start, cost="squared", device=device, progress=tick)
        costs = np.array([entry["cost"] for entry in flow.history])
        sphere, seconds = flow.sphere, np.array([0.0, *(t - begun for t in clock)])
        seconds = seconds[: len(costs)]
        # Algorithm 2 takes the cost at the circumcentres, the others at the centres of triangles: slightly different
        # numbers for the same map. The start is known in both.
        costs = costs * (omtwarp.transport_cost(surface, initial, start=start) / costs[0])
    else:
        limit = most if scheme == "plain" else None
        moved = optimal_transport(
            surface, initial, start=start, scheme=scheme, iterations=limit, device=device, progress=tick
        )
        sphere = moved.sphere
        costs, seconds = np.array([entry["cost"] for entry in moved.history]), np.array(clock) - begun
    before, after = (distortion(surface, y).area["sphere"] for y in (initial, sphere))
    print(f"  {label}, {scheme}: {len(costs) - 1} iterations, cost {costs[0]:.6g} -> {costs[-1]:.6g}", flush=True)
    out = {"mesh": name, "vertices": surface.vertex_count, "start": label, "scheme": scheme}
    return out | {"costs": costs, "seconds": seconds, "area_before": before, "area_after": after}


def finals(runs: list[dict[str, Any]]) -> dict[tuple[str, str], float]:
    """The default's final cost from every start."""
    return {
        (entry["mesh"], entry["start"]): float(entry["costs"][-1]) for entry in runs if entry["scheme"] == "default"
    }


def reached(entry: dict[str, Any], level: float) -> str:
    """Iterations and seconds until the cost is at or below a level."""
    below = np.flatnonzero(entry["costs"] <= level)
    if not len(below):
        return "not reached"
    return f"{below[0]} it, {entry['seconds'][below[0]] if below[0] else 0.0:.2f} s"


def markdown(runs: list[dict[str, Any]]) -> str:
    from paper_tables import machine

    lines = [
        f"Made by `examples/convergence.py` on {machine()}. Area distortion by area on the sphere.",
        "",
        "| mesh | start | flow | iterations | cost | within 1 % of the final cost | within 1 % of the gain | area |",
        "|---|---|---|---|---|---|---|---|",
    ]
    last = finals(runs)
    for entry in runs:
        final = last[entry["mesh"], entry["start"]]
        first = float(entry["costs"][0])
        cells = [
            entry["mesh"],
            entry["start"],
            entry["scheme"],
            f"{len(entry['costs']) - 1} it, {entry['seconds'][-1]:.2f} s",
            f"{first:.5g} → {entry['costs'][-1]:.5g}",
            reached(entry, (1.0 + WITHIN) * final),
            reached(entry, final + WITHIN * (first - final)) if first > final else "starts below",
            f"{entry['area_before']:.4f} → {entry['area_after']:.4f}",
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join([*lines, ""])


def write_csv(path: Path, runs: list[dict[str, Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["mesh", "start", "scheme", "iteration", "seconds", "cost"])
        for entry in runs:
            for k, (seconds, cost) in enumerate(zip(entry["seconds"], entry["costs"], strict=True)):
                key = [entry["mesh"], entry["start"], entry["scheme"]]
                writer.writerow([*key, k, f"{seconds:.4f}", f"{cost:.10g}"])


def draw(path: Path, runs: list[dict[str, Any]]) -> None:
    """Cost over the default's final one against iterations and against time, a row for every start of every mesh."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    last = finals(runs)
    figure, axes = pyplot.subplots(
        len(last), 2, figsize=(10, 2.8 * len(last)), layout="constrained", squeeze=False, sharey="row"
    )
    for row, (mesh, start) in zip(axes, last, strict=True):
        for entry in runs:
            if (entry["mesh"], entry["start"]) != (mesh, start):
                continue
            over = 100.0 * (entry["costs"] / last[mesh, start] - 1.0)
            for axis, across in zip(row, (np.arange(len(over)), entry["seconds"]), strict=True):
                axis.plot(across, over, color=COLORS[entry["scheme"]], label=entry["scheme"])
        for axis, unit, linear in zip(row, ("iteration", "seconds"), (10.0, 0.1), strict=True):
            axis.axhspan(-100.0 * WITHIN, 100.0 * WITHIN, color="0.92", zorder=0)
            axis.axhline(0.0, color="0.6", linewidth=0.8)
            axis.set_yscale("symlog", linthresh=0.1)
            axis.set_xscale("symlog", linthresh=linear)
            axis.set_xlim(left=0.0)
            axis.set(xlabel=unit, title=f"{mesh}, from " + ("Moser's map" if start == "moser" else "the twisted map"))
        row[0].set_ylabel("cost over the final one [%]")
        row[0].legend(fontsize="small")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    try:
        main()
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
