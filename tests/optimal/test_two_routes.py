"""One optimum, whatever the start: from the conformal map and from the coarse-to-fine embedding."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sphere_truths import SHARED

import omtwarp
from omtwarp.mapping import pipeline
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.shapes import blob, demo_shape
from omtwarp.optimal import nested, optimal_map

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from random_shapes import random_shape

MADE = {"blob": lambda: blob(seed=3, amplitude=0.3, degree=5, sphere=2000), "creature": lambda: demo_shape(4000)}
# Radians, root mean square: next to limbs of few triangles the shape term leaves more than one minimum.
LIMITS = {"blob": 0.0005, "creature": 0.05} | dict.fromkeys(["bunny_70k", "skull_40k", "gargoyle_20k", "spot_6k"], 0.02)


@pytest.mark.parametrize("name", list(LIMITS))
def test_two_routes_end_in_the_same_map(name, monkeypatch):
    file = SHARED / "data" / f"{name}.ply"
    if name not in MADE and not file.is_file():
        pytest.skip(f"{name}.ply is not there")
    mesh = MADE[name]() if name in MADE else read_mesh(file)
    usual = omtwarp.map_to_sphere(mesh, device="cpu")
    assert usual.report["start"]["route"].startswith("conformal")

    def refused(*arguments, **options):
        raise omtwarp.OmtwarpError("not wanted here")

    monkeypatch.setattr(nested, "nested_start", refused)
    other = omtwarp.map_to_sphere(mesh, device="cpu")
    roads = [next(s["road"] for s in r.report["stages"] if s["name"] == "omt") for r in (usual, other)]
    assert roads == ["nested", "embedded"]
    np.testing.assert_allclose(other.source, usual.source, atol=1e-12)  # both transport the conformal map's points
    first, second = (result.report["optimality"]["cost"] for result in (usual, other))
    assert second == pytest.approx(first, rel=1e-3)
    weights = omtwarp.Surface(usual.vertices, usual.faces).vertex_areas
    squares = ((usual.sphere - other.sphere) ** 2).sum(axis=1)
    assert np.sqrt((weights @ squares) / weights.sum()) < LIMITS[name]


@pytest.mark.parametrize(("seed", "turn"), [(192, None), (916, 2), (916, 5)])
def test_what_has_no_optimum_near_the_nested_map_has_one_near_the_embedded(seed, turn):
    _, surface = random_shape(seed, 3000)
    vertices = surface.vertices
    if turn is not None:
        vertices = vertices @ Rotation.random(random_state=turn).as_matrix().T
    result = omtwarp.map_to_sphere((vertices, surface.faces), device="cpu")
    stage = next(one for one in result.report["stages"] if one["name"] == "omt")
    assert stage["road"] == "embedded" and stage["converged"]
    assert "from the nested map" in stage["gave_up"] and stage["area"]["surface"] < 2.05
    assert result.report["warnings"] == []


def test_of_two_minimisations_without_an_optimum_the_nearer_in_areas_is_taken(monkeypatch):
    found = []

    def stopped(*arguments, **options):
        optimal = optimal_map(*arguments, **options)
        found.append(replace(optimal, converged=False, ended="stopped"))
        if len(found) == 2:
            worse = dict(found[0].history[-1], ring_rms=1.0)
            found[1] = replace(found[1], history=(*found[1].history, worse))
        return found[-1]

    monkeypatch.setattr(pipeline, "optimal_map", stopped)
    stage = omtwarp.map_to_sphere(MADE["blob"](), device="cpu").report["stages"][-2]
    assert len(found) == 2 and stage["road"] == "nested" and stage["ended"] == "stopped"
