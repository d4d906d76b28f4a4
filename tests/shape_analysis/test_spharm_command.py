"""``omtwarp spharm``."""

import json

import numpy as np
import pytest

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.mesh.shapes import blob
from omtwarp.shape_analysis.expansion import read_coef


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    surface = blob(2, amplitude=0.15, degree=3, sphere=720)
    omtwarp.map_to_sphere(surface, until="moser", device="cpu").save("map.npz")
    return tmp_path


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main([*words])
    return ended.value.code or 0


def test_three_formats_hold_the_same_coefficients(desk, capsys):
    for suffix in ("coef", "csv", "npz"):
        assert run("spharm", "map.npz", "-o", f"a.{suffix}", "--degree", "6", "-q") == 0
    found = read_coef("a.coef").coefficients
    np.testing.assert_allclose(np.load("a.npz")["coefficients"], found, rtol=1e-13, atol=1e-15)
    table = np.genfromtxt("a.csv", delimiter=",", names=True)
    np.testing.assert_allclose(np.stack([table["x"], table["y"], table["z"]], axis=1), found, rtol=1e-13, atol=1e-15)
    assert table["degree"].tolist()[:4] == [0, 1, 1, 1]
    assert table["order"].tolist()[:4] == [0, -1, 0, 1]
    assert capsys.readouterr().out == ""


def test_the_reconstruction_misses_by_the_error_that_is_told(desk, capsys):
    words = ["--degree", "8", "--fit", "quadrature", "--reconstruction", "again.ply", "--json"]
    assert run("spharm", "--map", "map.npz", "-o", "a.coef", *words) == 0
    told = json.loads(capsys.readouterr().out)
    result = omtwarp.MapResult.load("map.npz")
    again = omtwarp.read_mesh("again.ply")
    areas = omtwarp.Surface(result.vertices, result.faces).vertex_areas
    error = np.sqrt(areas @ ((np.asarray(again.vertices) - result.vertices) ** 2).sum(axis=1) / areas.sum())
    assert told["rms_error"] == pytest.approx(error, rel=1e-3)
    assert len(told["power"]) == 9
    assert error < 0.05


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["-o", "a.txt"], 1, "unknown suffix"),
        (["-o", "a.coef", "--degree", "60"], 1, "do not determine the 3721 coefficients"),
        (["-o", "a.coef", "--degree", "-1"], 2, "degree"),
        (["-o", "a.coef", "--fit", "guess"], 2, "guess"),
    ],
)
def test_requests_that_cannot_be_met(desk, capsys, words, status, message):
    assert run("spharm", "map.npz", *words) == status
    assert message in capsys.readouterr().err
    assert not (desk / "a.coef").exists()
