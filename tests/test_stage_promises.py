"""Every stage has its documented properties on a random shape of each kind, and returns no worse a map."""

import sys
from pathlib import Path

import numpy as np
import pytest
from sphere_truths import ring_errors, ring_rms

import omtwarp
from omtwarp.metrics.certificate import certify_triangles
from omtwarp.optimal.cells import MAX_RING_ERROR, MAX_RING_RMS
from omtwarp.transport.cost import area_loss

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from random_shapes import KINDS, random_shape

VERTICES = 600
REFINED = 10.0  # the weight of "balanced"
# The least energy of a flip-free map may be missed by what refinement leaves: its tolerance.
LEFT = 2e-3


@pytest.mark.parametrize("seed", range(len(KINDS)), ids=list(KINDS))
def test_no_stage_makes_a_map_worse(seed):
    """By the measure that the stage is for; and what is said to have converged has."""
    _, surface = random_shape(seed, VERTICES)
    result = omtwarp.map_to_sphere(surface, until="refine", refine=REFINED, device="cpu")
    stages = {stage["name"]: stage for stage in result.report["stages"]}
    moser = omtwarp.map_to_sphere(surface, until="moser", device="cpu").moser
    maps = {"conformal": result.conformal, "moser": moser, "omt": result.transported, "refine": result.sphere}
    for name, sphere in maps.items():
        assert certify_triangles(surface.faces, sphere).bijective, name
        assert np.abs(np.linalg.norm(sphere, axis=1) - 1).max() < 1e-12
    # Moser's flow is for the areas of triangles.
    errors = {name: area_loss(surface, maps[name]) for name in ("conformal", "moser")}
    assert errors["moser"] <= errors["conformal"]
    # Transport is for the areas around vertices, and for the cost among the maps that keep them.
    assert ring_rms(surface, result.transported) <= ring_rms(surface, moser)
    if stages["omt"]["converged"]:
        assert stages["omt"]["ended"] == "optimal"
        assert ring_rms(surface, result.transported) <= MAX_RING_RMS * (1 + 1e-6)
        assert np.abs(ring_errors(surface, result.transported)).max() <= MAX_RING_ERROR * (1 + 1e-6)
    else:
        assert stages["omt"]["ended"] != "optimal"
    # Refinement is for angle plus weighted area distortion.
    energies = [
        stages[name]["angle"]["surface"] - 2 + REFINED * (stages[name]["area"]["surface"] - 2)
        for name in ("conformal", "omt", "refine")
    ]
    assert energies[2] <= min(energies[:2]) + LEFT
    # The report is true of the map that is returned.
    found = result.report["optimality"]
    assert found["lower_bound"] is None or found["lower_bound"] <= found["cost"]
    assert 0.0 <= found["relative_curl"]
