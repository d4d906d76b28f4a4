"""One optimum, whatever the start: from the conformal map and from the coarse-to-fine embedding."""

import numpy as np
import pytest
from sphere_truths import SHARED

import omtwarp
from omtwarp.mapping import pipeline
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.shapes import blob, demo_shape

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

    monkeypatch.setattr(pipeline, "nested_start", refused)
    other = omtwarp.map_to_sphere(mesh, device="cpu")
    roads = [next(s["road"] for s in r.report["stages"] if s["name"] == "omt") for r in (usual, other)]
    assert roads == ["nested", "embedded"]
    np.testing.assert_allclose(other.source, usual.source, atol=1e-12)  # both transport the conformal map's points
    first, second = (result.report["optimality"]["cost"] for result in (usual, other))
    assert second == pytest.approx(first, rel=1e-3)
    weights = omtwarp.Surface(usual.vertices, usual.faces).vertex_areas
    squares = ((usual.sphere - other.sphere) ** 2).sum(axis=1)
    assert np.sqrt((weights @ squares) / weights.sum()) < LIMITS[name]
