"""Map random shapes through the whole pipeline and certify the map of every stage.

    python examples/random_shapes.py                          # 200 shapes of 500 to 50,000 vertices
    python examples/random_shapes.py --seed 137 --count 1     # shape 137 again
    python examples/random_shapes.py --stage transported --most-vertices 2000

A shape is known by its seed alone: its kind is the seed modulo the number of kinds, and its sizes and its mesh are
drawn from it. Most shapes are small. After the start (conformal or its substitute), Moser's map, transport and
refinement, no triangle may be flipped and the degree must be 1, decided exactly; the status is non-zero otherwise.
Refined maps whose area distortion is above --area are listed but are no failure unless --strict is given.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import check
from omtwarp.metrics.certificate import certify

LEAST_VERTICES, MOST_VERTICES = 500, 50_000
STAGES = {"conformal": "conformal", "transported": "omt", "sphere": "refine"}
ATTEMPTS = 30


# --- Shapes ---------------------------------------------------------------------------------------------------------


def random_shape(seed: int, most_vertices: int = MOST_VERTICES) -> tuple[str, Surface]:
    """Name and surface of a seed; limiting the vertices gives another, smaller shape of the same kind."""
    kind = list(KINDS)[seed % len(KINDS)]
    rng = np.random.default_rng([seed, 20_030_727])
    # The third power of a uniform number: half of the shapes lie in the lowest eighth of the logarithmic range. Kinds
    # with regular meshes round the size down to the next that they can have.
    least = 1.13 * LEAST_VERTICES
    size = least * (most_vertices / least) ** (rng.random() ** 3)
    for _ in range(ATTEMPTS):  # a grid may join two limbs, noise may flatten a triangle: draw again
        surface = KINDS[kind](rng, round(2 * size))
        if surface.vertex_count <= 1.25 * most_vertices and not check(surface.vertices, surface.faces):
            return kind, surface
    raise RuntimeError(f"no valid {kind} in {ATTEMPTS} attempts, seed {seed}")


def random_base(rng: np.random.Generator, faces: int) -> Surface:
    """A sphere, regularly or irregularly triangulated."""
    choice = rng.integers(4)
    if choice == 0:
        return shapes.icosphere_near(faces)
    if choice == 1:
        return shapes.fibonacci_sphere(2 * (faces // 2))
    return shapes.random_sphere(2 * (faces // 2), int(rng.integers(1 << 30)), float(rng.uniform(0.0, 1.0)))


def blob(rng: np.random.Generator, faces: int) -> Surface:
    amplitude, degree = rng.uniform(0.1, 0.7), int(rng.integers(2, 16))
    return shapes.blob(int(rng.integers(1 << 30)), float(amplitude), degree, random_base(rng, faces))


def spikes(rng: np.random.Generator, faces: int) -> Surface:
    """A ball with star-shaped limbs."""
    directions = rng.normal(size=(int(rng.integers(1, 12)), 3))
    length, sharpness = rng.uniform(0.5, 4.0), np.exp(rng.uniform(np.log(10.0), np.log(80.0)))
    return shapes.limbs(directions, float(length), float(sharpness), random_base(rng, faces))


def creature(rng: np.random.Generator, faces: int) -> Surface:
    """Metaballs: a body with thin limbs of several joints, some of which end in fingers."""
    cones = [[-0.5, 0.0, 0.0, rng.uniform(0.2, 0.5), 0.5, 0.0, 0.0, rng.uniform(0.2, 0.5)]]
    limbs = int(rng.integers(3, 11))
    for direction in shapes.fibonacci_sphere(2 * max(limbs, 4) - 4).vertices[:limbs]:
        foot = np.array([rng.uniform(-0.5, 0.5), 0.0, 0.0])
        grow(cones, rng, foot, direction + 0.2 * rng.normal(size=3), rng.uniform(0.06, 0.2), rng.uniform(0.5, 1.5), 2)
        if rng.random() < 0.3:
            tip, end = np.array(cones[-1][4:7]), cones[-1][7]
            for _ in range(int(rng.integers(2, 6))):
                grow(cones, rng, tip, direction + 0.7 * rng.normal(size=3), 0.8 * end, rng.uniform(0.2, 0.4), 1)
    return metaball_surface(np.array(cones), rng, faces)


def serpent(rng: np.random.Generator, faces: int) -> Surface:
    """Metaballs: a long winding body with a few short limbs."""
    joints = int(rng.integers(5, 10))
    turn, radius = rng.uniform(0.3, 0.9), rng.uniform(0.12, 0.25)
    angles = turn * np.sin(np.arange(joints) * rng.uniform(0.8, 2.0))
    steps = 0.7 * np.stack([np.cos(angles), np.sin(angles), 0.2 * rng.normal(size=joints)], axis=1)
    spine = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    sizes = radius * np.linspace(1.0, rng.uniform(0.4, 1.0), len(spine))
    cones = [[*spine[k], sizes[k], *spine[k + 1], sizes[k + 1]] for k in range(joints)]
    for k in rng.choice(joints, size=int(rng.integers(0, 5)), replace=False):
        grow(cones, rng, spine[k], rng.normal(size=3), 0.6 * sizes[k], rng.uniform(0.4, 0.8), 2)
    return metaball_surface(np.array(cones), rng, faces)


def grow(
    cones: list[list[float]],
    rng: np.random.Generator,
    foot: np.ndarray,
    direction: np.ndarray,
    radius: float,
    length: float,
    joints: int,
) -> None:
    """Add a limb to a list of rounded cones, thinning and bending from joint to joint."""
    direction = direction / np.linalg.norm(direction)
    for _ in range(joints):
        end = foot + length / joints * direction
        thinner = radius * rng.uniform(0.6, 1.0)
        cones.append([*foot, radius, *end, thinner])
        foot, radius = end, thinner
        direction = direction + 0.4 * rng.normal(size=3)
        direction /= np.linalg.norm(direction)


def metaball_surface(cones: np.ndarray, rng: np.random.Generator, faces: int) -> Surface:
    """The surface of melted rounded cones with roughly as many faces as asked for."""
    # Marching fills a box: finer than this many faces, the triangles of a coarser mesh are cut instead.
    rounds = max(0, int(np.ceil(np.log(faces / 12_000.0) / np.log(4.0))))
    wanted = faces / 4**rounds
    blend = rng.uniform(0.02, 0.05)
    lengths = np.linalg.norm(cones[:, 4:7] - cones[:, :3], axis=1)
    area = (np.pi * (cones[:, 3] + cones[:, 7]) * (lengths + cones[:, 3])).sum()
    cell = np.sqrt(5.0 * area / wanted)
    for _ in range(2):  # limbs overlap, and thin ones are thickened: the first surface tells the right size of a cell
        thick = cones.copy()
        thick[:, [3, 7]] = np.maximum(cones[:, [3, 7]], 0.85 * cell)  # the grid would cut thinner ones off
        margin = thick[:, [3, 7]].max() + 3.0 * cell
        ends = thick.reshape(-1, 4)[:, :3]
        low, high = ends.min(axis=0) - margin, ends.max(axis=0) + margin
        surface = shapes.implicit_surface(shapes.metaballs(thick, blend), low, high, cell)
        cell *= np.sqrt(surface.face_count / wanted)
    for _ in range(rounds):
        surface = quartered(surface)
    return surface


def quartered(surface: Surface) -> Surface:
    """Every triangle cut into four, new vertices in the middle of edges and then drawn towards their neighbours."""
    ends = surface.edges.astype(np.int64)
    count = surface.vertex_count
    keys = ends[:, 0] * count + ends[:, 1]
    faces = surface.faces.astype(np.int64)
    following = np.roll(faces, -1, axis=1)
    wanted = np.minimum(faces, following) * count + np.maximum(faces, following)
    order = np.argsort(keys)
    middle = count + order[np.searchsorted(keys[order], wanted)]  # of the edges from corner k to k + 1
    a, b, c = faces.T
    ab, bc, ca = middle.T
    cut = [[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]
    points = np.concatenate([surface.vertices, surface.vertices[ends].mean(axis=1)])
    fine = Surface(points, np.concatenate([np.stack(corners, axis=1) for corners in cut]))
    i, j = fine.edges.T
    pairs = sparse.coo_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(len(points),) * 2).tocsr()
    degree = np.asarray(pairs.sum(axis=1))
    for share in (0.5, -0.53):  # Taubin's smoothing: rounds the facets without shrinking
        points = points + share * (pairs @ points / degree - points)
    return Surface(points, fine.faces)


def tube(rng: np.random.Generator, faces: int) -> Surface:
    length = np.exp(rng.uniform(np.log(2.0), np.log(30.0)))
    bend = rng.choice([0.0, rng.uniform(0.0, 5.0)])
    surface = shapes.tube(float(length), 1.0, float(min(bend, length)), float(rng.uniform(0.3, 1.0)), faces)
    return shapes.flip_edges(surface, 4, int(rng.integers(1 << 30))) if rng.random() < 0.3 else surface


def plate(rng: np.random.Generator, faces: int) -> Surface:
    thickness = np.exp(rng.uniform(np.log(0.02), np.log(0.5)))
    return shapes.plate(float(rng.uniform(1.0, 6.0)), float(rng.uniform(1.0, 4.0)), float(thickness), faces)


def needle(rng: np.random.Generator, faces: int) -> Surface:
    length = float(np.exp(rng.uniform(np.log(3.0), np.log(30.0))))
    if rng.random() < 0.5:
        return shapes.needle(length, faces)
    base = random_base(rng, faces)
    return Surface(base.vertices * [1.0, rng.uniform(0.5, 1.0), length], base.faces)


def noise(rng: np.random.Generator, faces: int) -> Surface:
    """Another shape with heavy noise on its vertices: rough, folded over in places."""
    makers = (blob, spikes, tube, plate, creature)
    surface = makers[rng.integers(len(makers))](rng, faces)
    return shapes.noisy(surface, float(rng.uniform(0.1, 0.6)), int(rng.integers(1 << 30)))


def slivers(rng: np.random.Generator, faces: int) -> Surface:
    """Triangles far longer than wide: few rings and many segments, or the reverse, on a blob."""
    rings = int(np.exp(rng.uniform(np.log(4.0), np.log(faces / 16.0))))
    globe = shapes.uv_sphere(rings, max(4, faces // (2 * rings)))
    return shapes.blob(int(rng.integers(1 << 30)), float(rng.uniform(0.1, 0.4)), int(rng.integers(2, 6)), globe)


def obtuse(rng: np.random.Generator, faces: int) -> Surface:
    """Random edges flipped: obtuse angles, negative cotangents."""
    makers = (blob, spikes, needle, creature)
    surface = makers[rng.integers(len(makers))](rng, faces)
    return shapes.flip_edges(surface, int(rng.integers(2, 30)), int(rng.integers(1 << 30)))


def decimated(rng: np.random.Generator, faces: int) -> Surface:
    """A finer shape with random edges collapsed."""
    makers = (blob, spikes, creature, tube)
    share = rng.uniform(0.2, 0.8)
    surface = makers[rng.integers(len(makers))](rng, round(faces / share))
    return collapse_edges(surface, round(share * surface.vertex_count), int(rng.integers(1 << 30)))


def cortex(rng: np.random.Generator, faces: int) -> Surface:
    """A deeply wrinkled ball, its surface several times that of the ball."""
    base = random_base(rng, faces)
    degree = int(rng.integers(10, 24))
    return shapes.blob(int(rng.integers(1 << 30)), float(rng.uniform(0.08, 0.2)), degree, base)


KINDS: dict[str, Callable[[np.random.Generator, int], Surface]] = {
    "blob": blob,
    "spikes": spikes,
    "creature": creature,
    "serpent": serpent,
    "tube": tube,
    "plate": plate,
    "needle": needle,
    "noise": noise,
    "slivers": slivers,
    "obtuse": obtuse,
    "decimated": decimated,
    "cortex": cortex,
}


def collapse_edges(surface: Surface, vertex_count: int, seed: int) -> Surface:
    """Collapse random edges into one of their ends until no more vertices are left than asked for.

    In a round, edges are collapsed no two of which share a neighbour. An edge may collapse if its ends share just two
    neighbours and these keep at least three, and no triangle is turned over.
    """
    rng = np.random.default_rng(seed)
    points, faces = surface.vertices, surface.faces.astype(np.int64)
    for _ in range(200):
        count = len(points)
        if count <= vertex_count:
            break
        edges = Surface(points, faces).edges.astype(np.int64)
        kept, gone = rng.permuted(edges, axis=1).T
        both = np.r_[kept, gone]
        pairs = sparse.coo_matrix((np.ones(2 * len(kept)), (both, np.r_[gone, kept])), shape=(count, count)).tocsr()
        degree = np.diff(pairs.indptr)
        common = np.asarray(pairs[kept].multiply(pairs[gone]).sum(axis=1)).ravel()
        third = pairs[kept].multiply(pairs[gone])
        thinnest = third.multiply(degree[None, :]).tocsr()
        least = np.array(np.minimum.reduceat(np.r_[thinnest.data, np.inf], thinnest.indptr[:-1]))
        allowed = np.flatnonzero((common == 2) & (least > 3) & (degree[kept] + degree[gone] - 4 >= 3))
        priority = rng.permutation(len(allowed)) + 1
        best = np.zeros(count)
        for end in (kept, gone):
            np.maximum.at(best, end[allowed], priority)
        near = best.copy()
        np.maximum.at(near, kept, best[gone])
        np.maximum.at(near, gone, best[kept])
        for end in (kept, gone):  # none within two edges may have a better claim
            alone = near[end[allowed]] == priority
            allowed, priority = allowed[alone], priority[alone]
        allowed = allowed[: count - vertex_count]
        place = np.arange(count)
        place[gone[allowed]] = kept[allowed]
        moved = place[faces]
        lost = (moved == np.roll(moved, -1, axis=1)).any(axis=1)
        before, after = normals(points, faces), normals(points, moved)
        turned = ~lost & (np.einsum("ij,ij->i", before, after) <= 0.05 * (before**2).sum(axis=1))
        refused = np.zeros(count, dtype=bool)
        refused[faces[turned].ravel()] = True
        place[refused] = np.arange(count)[refused]
        moved = place[faces]
        lost = (moved == np.roll(moved, -1, axis=1)).any(axis=1)
        used, faces = np.unique(moved[~lost], return_inverse=True)
        faces = faces.reshape(-1, 3)
        points = points[used]
    return Surface(points, faces)


def normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (points[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


# --- Maps -----------------------------------------------------------------------------------------------------------


def examine(surface: Surface, last: str = "sphere", device: str = "cpu") -> dict[str, Any]:
    """Map a surface and certify every stage up to the last one: flips and degrees by stage, area, seconds."""
    begun = time.perf_counter()
    refine = "area" if last == "sphere" else "none"
    result = omtwarp.map_to_sphere(surface, until=STAGES[last], refine=refine, device=device)
    seconds = time.perf_counter() - begun
    wanted = list(STAGES)[: list(STAGES).index(last) + 1]
    maps = {stage: getattr(result, stage) for stage in wanted}
    certificates = {stage: certify(surface, sphere, device=device) for stage, sphere in maps.items()}
    done = {stage["name"]: stage for stage in result.report["stages"]}
    judged = done[STAGES[last]]
    return {
        "start": result.report["start"]["route"],
        "flips": "/".join(str(certificates[stage].flips) for stage in wanted),
        "degrees": "/".join(f"{certificates[stage].degree}" for stage in wanted),
        "repaired": "/".join(str(done[STAGES[stage]].get("repaired", 0)) for stage in wanted),
        "bijective": all(certificate.bijective for certificate in certificates.values()),
        "area": judged["area"]["surface"],
        "area_p95": judged["area"]["p95"],
        "area_max": judged["area"]["max"],
        "angle": judged["angle"]["surface"],
        "converged": judged.get("converged", True),
        "stage_seconds": "/".join(f"{done[STAGES[stage]]['seconds']:.2f}" for stage in wanted),
        "seconds": seconds,
        "error": "",
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="of the first shape; the others count up from it")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), help="these kinds alone")
    parser.add_argument("--stage", choices=list(STAGES), default="sphere", help="the last stage")
    parser.add_argument("--most-vertices", type=int, default=MOST_VERTICES)
    parser.add_argument("--area", type=float, default=2.002, help="list refined maps with a larger area distortion")
    parser.add_argument("--strict", action="store_true", help="such maps are failures too")
    parser.add_argument("--out", type=Path, help="write all figures to this CSV file")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    kinds = list(KINDS)
    wanted = options.kinds or kinds
    chosen = (seed for seed in range(options.seed, 1 << 30) if kinds[seed % len(kinds)] in wanted)
    rows: list[dict[str, Any]] = []
    for number, seed in zip(range(options.count), chosen, strict=False):
        row: dict[str, Any] = {"seed": seed}
        try:
            kind, surface = random_shape(seed, options.most_vertices)
            row |= {"kind": kind, "vertices": surface.vertex_count}
            row |= examine(surface, options.stage, options.device)
            verdict = "ok" if row["bijective"] else "FAILED"
            text = (
                f"{verdict}  {row['start']}, flips {row['flips']}, degrees {row['degrees']}, area {row['area']:.5f} "
                f"(p95 {row['area_p95']:.4f}), angle {row['angle']:.3f}, {row['stage_seconds']} s"
                f"{'' if row['converged'] else ', not converged'}"
            )
        except Exception as error:
            row |= {"error": f"{type(error).__name__}: {error}", "bijective": False}
            text = f"FAILED  {row['error']}"
            traceback.print_exc()
        rows.append(row)
        print(
            f"{number + 1:4d}/{options.count}  seed {seed:<6d} {row.get('kind', kinds[seed % len(kinds)]):10s} "
            f"{row.get('vertices', 0):6d} vertices  {text}",
            flush=True,
        )
        if options.out:
            write_csv(options.out, rows)
    return summarise(rows, options)


def summarise(rows: list[dict[str, Any]], options: argparse.Namespace) -> int:
    """Print what went well and what did not; the exit status."""
    failed = [row for row in rows if not row["bijective"]]
    mapped = [row for row in rows if not row["error"]]
    refined = options.stage == "sphere"
    wide = [row for row in mapped if refined and row["area"] > options.area]
    print(f"\n{len(rows) - len(failed)} of {len(rows)} shapes bijective at every stage", end="")
    if mapped:
        areas = np.array([row["area"] for row in mapped])
        slowest = max(mapped, key=lambda row: row["seconds"])
        print(
            f"; area median {np.median(areas):.5f}, largest {areas.max():.5f}; "
            f"{sum(row['seconds'] for row in mapped):.0f} s in all, slowest seed {slowest['seed']} "
            f"({slowest['kind']}, {slowest['vertices']} vertices, {slowest['seconds']:.1f} s)"
        )
    for title, found in (("failed", failed), (f"area above {options.area:g}", wide)):
        if found:
            print(f"{title}: {len(found)}, seeds {' '.join(str(row['seed']) for row in found)}")
    return 1 if failed or (options.strict and wide) else 0


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=names)
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(main())
