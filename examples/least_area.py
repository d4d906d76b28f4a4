"""Look for the least area distortion that a mesh allows: from several starts, and with areas around vertices kept.

    python examples/least_area.py MESH        # a drawn part, say
    python examples/least_area.py             # a prism whose caps are fans of triangles without a vertex inside

Area distortion of triangles counts more and more against angle distortion, from maps of the hierarchical start in
several variants, of Moser's flow, and of the two barycentric systems. Starts that end at the same distortion under
the first weights, and none below the least under the last, are evidence, not proof, that there is no better map. From
the best of them, areas around vertices are then brought back by a penalty on their errors.

Drawn parts are often far from 2, as triangles that are flat in their side of the part are not on the sphere: three
points of an arc of length L span an area of at least L^3 t (1 - t) / 4 if the middle one is at the share t of it,
however small the triangle is on the surface.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator

import numpy as np

import omtwarp
from omtwarp.mesh.surface import Surface, as_surface
from omtwarp.optimal.refinement import least_distortion

SIDES, HEIGHT = 24, 1.0  # of the prism
WEIGHTS, STEPS, TOLERANCE = (1e1, 1e2, 1e3, 1e4, 1e5, 1e6), 200, 1e-7  # of area distortion against angle distortion
VARIANTS = ({}, {"area_weight": 1.0}, {"area_weight": 1000.0})
RING_PENALTIES, RING_STEPS = (1.0, 3.0, 10.0), 150  # relative to the weight of area distortion


def prism() -> Surface:
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(SIDES)], axis=1)
    i = np.arange(SIDES)
    j = (i + 1) % SIDES
    sides = [np.stack([i, j, SIDES + j], axis=1), np.stack([i, SIDES + j, SIDES + i], axis=1)]
    k = np.arange(1, SIDES - 1)
    bottom = np.stack([np.zeros_like(k), k + 1, k], axis=1)
    return Surface(
        np.concatenate([circle, circle + [0.0, 0.0, HEIGHT]]), np.concatenate([*sides, bottom, SIDES + bottom[:, ::-1]])
    )


def starts(surface: Surface) -> Iterator[tuple[str, np.ndarray]]:
    for variant in VARIANTS:
        named = " ".join(f"{name} {value:g}" for name, value in variant.items())
        yield f"hierarchical {named}", omtwarp.hierarchical_embedding(surface, **variant, device="cpu").sphere
    for method in ("moser", "tutte", "mean-value"):
        try:
            yield method, omtwarp.map_to_sphere(surface, method=method, optimality=False, device="cpu").sphere
        except omtwarp.OmtwarpError:
            print(f"{method}: flips triangles")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="?", metavar="MESH")
    options = parser.parse_args()
    warnings.simplefilter("ignore", omtwarp.OmtwarpWarning)
    mesh = omtwarp.read_mesh(options.mesh) if options.mesh else None
    surface = prism() if mesh is None else as_surface((mesh.vertices, mesh.faces))
    print(f"{'area weight':>28s} " + " ".join(f"{weight:7.0e}" for weight in WEIGHTS) + "   angle")
    best, least = None, np.inf
    for name, sphere in starts(surface):
        areas = []
        for weight in WEIGHTS:
            given = {"iterations": STEPS, "tolerance": TOLERANCE, "device": "cpu"}
            sphere = least_distortion(surface, sphere, weight, **given).sphere
            judged = omtwarp.distortion(surface, sphere, device="cpu")
            areas.append(judged.area["surface"])
        print(
            f"{name:>28s} " + " ".join(f"{area:7.4f}" for area in areas) + f" {judged.angle['surface']:7.2f}",
            flush=True,
        )
        if areas[-1] < least:
            best, least = sphere, areas[-1]
    assert best is not None
    print(f"{'penalty on rings':>28s}    area  ring rms   angle")
    for penalty in RING_PENALTIES:
        weight = WEIGHTS[-2]
        given = {"of_rings": 0.5 * penalty * weight, "iterations": RING_STEPS, "tolerance": 1e-6 * weight}
        found = least_distortion(surface, best, weight, **given, device="cpu")
        last = found.history[-1]
        print(f"{penalty:28g} {last['area']:7.4f} {last['ring_rms']:9.4f} {last['angle']:7.2f}", flush=True)
        best = found.sphere


if __name__ == "__main__":
    try:
        main()
    except omtwarp.OmtwarpError as error:
        raise SystemExit(f"error: {error}") from None
