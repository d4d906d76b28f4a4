"""Map random surfaces with holes, of several parts and with the defects of scans, and certify every map.

    python examples/mixed_topology.py                     # 200 surfaces of up to 20,000 faces
    python examples/mixed_topology.py --seed 137 --count 1  # surface 137 again
    python examples/mixed_topology.py --most-faces 2000

A surface is known by its seed alone. It has 0 to 12 boundary loops of any size, 1 to 20 parts, and every fourth one has
the defects of scans: faces on top of one another, fins on edges, surfaces that touch in a vertex, faces turned over,
flat faces, vertices that are not numbers. Each is mapped with a fitting option. Either the map is one to one, decided
exactly, or the surface is refused in one line; the status is non-zero otherwise, and where one takes over a minute.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

import omtwarp
from omtwarp.mesh import shapes
from omtwarp.mesh.surface import Surface

LEAST_FACES, MOST_FACES = 300, 20_000
LONGEST = 60.0  # seconds of processor time for one surface


@dataclass
class Mixed:
    """A surface that may be anything, and how it is to be mapped.

    Attributes:
        words: what it is.
        vertices: shape [V, 3].
        faces: shape [F, 3].
        domain, fill_area: as of :func:`omtwarp.map_surface`.
        repair: whether it has defects and is repaired first.
    """

    words: str
    vertices: np.ndarray
    faces: np.ndarray
    domain: str
    fill_area: str
    repair: bool


def mixed_surface(seed: int, most_faces: int = MOST_FACES) -> Mixed:
    """The surface of a seed; fewer faces give another, smaller one of the same kind."""
    rng = np.random.default_rng([seed, 20_070_604])
    # Most are small, and one in 25 as large as may be.
    size = LEAST_FACES * (most_faces / LEAST_FACES) ** (1.0 if seed % 25 == 24 else rng.random() ** 4)
    many = rng.random() < 0.3
    parts = int(rng.integers(2, 21)) if many else 1
    junk = seed % 4 == 3
    made, words = [], []
    for k in range(parts):
        surface, name = closed_part(rng, max(200, round(size / parts)))
        loops = int(rng.integers(1, 13)) if (not many or rng.random() < 0.5) else 0
        vertices, faces, cut = with_holes(rng, surface, loops)
        made.append((vertices + 4.0 * np.array([k % 5, k // 5, 0.0]), faces))
        words.append(f"{name} with {cut} holes" if cut else name)
    vertices, faces = together(made)
    found = f"{parts} parts: " + ", ".join(sorted(set(words)))[:60] if many else words[0]
    if junk:
        vertices, faces, kinds = with_junk(rng, vertices, faces)
        found += "; " + ", ".join(kinds)
    order = rng.permutation(len(faces))
    domains = ["sphere"] if many else ["sphere", "hemisphere", "disk", "cap"]
    domain, filling = str(rng.choice(domains)), str(rng.choice(["natural", "small"]))
    return Mixed(found, vertices, faces[order], domain, filling, junk)


def closed_part(rng: np.random.Generator, faces: int) -> tuple[Surface, str]:
    """A closed surface of genus 0 and its name."""
    base = shapes.random_sphere(2 * (faces // 2), int(rng.integers(1 << 30)), float(rng.uniform(0.0, 0.7)))
    kind = rng.integers(4)
    if kind == 0:
        return shapes.blob(int(rng.integers(1 << 30)), float(rng.uniform(0.1, 0.6)), int(rng.integers(2, 12)), base), (
            "blob"
        )
    if kind == 1:
        directions = rng.normal(size=(int(rng.integers(1, 7)), 3))
        return shapes.limbs(directions, float(rng.uniform(0.3, 2.0)), float(rng.uniform(6.0, 25.0)), base), "limbs"
    if kind == 2:
        blob = shapes.blob(int(rng.integers(1 << 30)), 0.15, int(rng.integers(10, 20)), base)
        return shapes.noisy(blob, float(rng.uniform(0.05, 0.3)), int(rng.integers(1 << 30))), "wrinkles"
    return shapes.tube(float(rng.uniform(2.0, 8.0)), 1.0, 0.0, float(rng.uniform(0.4, 1.0)), faces), "tube"


def with_holes(rng: np.random.Generator, surface: Surface, loops: int) -> tuple[np.ndarray, np.ndarray, int]:
    """What is left of a surface without some disks of faces, grown face by face from random ones that do not touch."""
    faces = surface.faces.astype(np.int64)
    gone, taken = np.zeros(len(faces), dtype=bool), np.zeros(surface.vertex_count, dtype=bool)
    cut = 0
    for _ in range(loops):
        size = max(1, round(0.3 * len(faces) / loops * rng.random() ** 3))
        start = int(rng.integers(len(faces)))
        centre = surface.vertices[faces[start]].mean(axis=0)
        distance = np.linalg.norm(surface.vertices[faces].mean(axis=1) - centre, axis=1)
        inside = np.zeros(len(faces), dtype=bool)
        inside[start] = True
        if taken[faces[start]].any():
            continue
        for _ in range(200):  # the ball around the first face, grown through shared edges
            near = np.zeros(surface.vertex_count, dtype=np.int64)
            np.add.at(near, faces[inside].ravel(), 1)
            reached = (near[faces] > 0).sum(axis=1) >= 2
            wider = reached & (distance <= np.sort(distance)[min(size, len(faces) - 1)]) & ~taken[faces].any(axis=1)
            if not (wider & ~inside).any():
                break
            inside |= wider
        candidate = gone | inside
        left = faces[~candidate]
        defects = {d.kind for d in omtwarp.check(*compact(surface.vertices, left))} if len(left) > 50 else {"small"}
        if defects <= {"open-boundary", "inward-orientation"}:
            gone = candidate
            ring = np.zeros(surface.vertex_count, dtype=bool)
            ring[faces[inside]] = True
            taken |= ring
            taken[faces[ring[faces].any(axis=1)]] = True
            cut += 1
    return *compact(surface.vertices, faces[~gone]), cut


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    used, numbered = np.unique(faces, return_inverse=True)
    return vertices[used], numbered.reshape(-1, 3)


def together(meshes: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one."""
    first = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    faces = [faces + first[k] for k, (_, faces) in enumerate(meshes)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def with_junk(
    rng: np.random.Generator, vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """A mesh with some of the defects of scans, and their names."""
    names = ["doubled faces", "fins", "touching", "turned", "flat", "not numbers", "unused", "crumbs"]
    chosen = rng.choice(names, size=int(rng.integers(1, 4)), replace=False).tolist()
    scale = float(np.ptp(vertices, axis=0).max())
    edge = float(np.linalg.norm(vertices[faces[0, 0]] - vertices[faces[0, 1]]))
    some = rng.choice(len(faces), size=3, replace=False)
    count = len(vertices)
    if "doubled faces" in chosen:
        faces = np.concatenate([faces, np.roll(faces[some], 1, axis=1)])
    if "fins" in chosen:
        tips = vertices[faces[some, 0]] + edge * rng.normal(size=(3, 3))
        fins = np.stack([faces[some, 1], faces[some, 0], len(vertices) + np.arange(3)], axis=1)
        vertices, faces = np.concatenate([vertices, tips]), np.concatenate([faces, fins])
    if "touching" in chosen:
        new = len(vertices) + np.arange(2)
        tips = vertices[faces[some[0], 0]] + edge * rng.normal(size=(2, 3))
        vertices = np.concatenate([vertices, tips])
        faces = np.concatenate([faces, [[faces[some[0], 0], *new]]])
    if "turned" in chosen:
        turned = rng.random(count)[faces[:, 0]] < 0.02
        faces = np.where(turned[:, None], faces[:, ::-1], faces)
    if "flat" in chosen:
        faces = np.concatenate([faces, [[faces[some[1], 0], faces[some[1], 1], faces[some[1], 1]]]])
    if "not numbers" in chosen:
        vertices = np.concatenate([vertices, np.full((1, 3), np.nan)])
        faces = np.concatenate([faces, [[faces[some[2], 0], faces[some[2], 1], len(vertices) - 1]]])
    if "unused" in chosen:
        vertices = np.concatenate([vertices, scale * rng.normal(size=(4, 3))])
    if "crumbs" in chosen:
        for _ in range(3):
            first = len(vertices)
            vertices = np.concatenate([vertices, scale * rng.normal(size=3) + edge * rng.normal(size=(3, 3))])
            faces = np.concatenate([faces, [[first, first + 1, first + 2]]])
    return vertices, faces, chosen


def examine(mixed: Mixed) -> dict[str, Any]:
    """Map a surface as it asks for: what the map is like, or the line that refuses it."""
    begun = time.process_time()
    row: dict[str, Any] = {"words": mixed.words, "faces": len(mixed.faces), "domain": mixed.domain}
    vertices, faces = mixed.vertices, mixed.faces
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", omtwarp.OmtwarpWarning)
            if mixed.repair:
                repaired = omtwarp.repair(vertices, faces, whole=False)
                vertices, faces = repaired.vertices, repaired.faces
            result = omtwarp.map_surface((vertices, faces), domain=mixed.domain, fill_area=mixed.fill_area)
        measured = result.distortion()
        row |= {"flips": measured.flips, "area": measured.area["surface"], "angle": measured.angle["surface"]}
        row |= {"warnings": len(caught), "ok": result.certificate.bijective and measured.flips == 0}
    except omtwarp.OmtwarpError as error:
        row |= {"refused": str(error), "ok": bool(str(error)) and "\n" not in str(error)}
    return row | {"seconds": time.process_time() - begun}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="the first surface")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--most-faces", type=int, default=MOST_FACES)
    options = parser.parse_args()
    failed = refused = 0
    for seed in range(options.seed, options.seed + options.count):
        row = examine(mixed_surface(seed, options.most_faces))
        failed += not row["ok"] or row["seconds"] > LONGEST
        refused += "refused" in row
        about = row.get("refused") or f"area {row['area']:.4f} angle {row['angle']:.3f} warnings {row['warnings']}"
        line = f"{seed:4d} {row['faces']:6d} {row['domain']:10s} {row['seconds']:6.1f} s  {row['words']}: {about}"
        print(line if row["ok"] else f"{line}  FAILED", flush=True)
    print(f"{options.count} surfaces, {refused} refused, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
