"""The command line from a file to a map, a textured model and a picture, with the real pipeline on a small mesh."""

from __future__ import annotations

import json

import numpy as np
import pytest
from test_cli_bad_input import bad_meshes

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.mesh import shapes
from omtwarp.mesh.write import write_mesh
from omtwarp.texturing.atlas import LARGEST_UNASKED, sharp_size


def run(*arguments) -> int:
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A blob in a shuffled order, and its map with a report."""
    place = tmp_path_factory.mktemp("whole-way")
    blob = shapes.shuffled(shapes.blob(seed=3, sphere=500), seed=4)
    write_mesh(place / "blob.ply", blob.vertices, blob.faces)
    options = ["--report", place / "report.json", "--until", "omt", "--device", "cpu", "--quiet"]
    assert run("map", place / "blob.ply", "-o", place / "map.npz", *options) == 0
    return place


def test_the_map_covers_the_sphere_once_in_the_order_of_the_input(folder):
    blob = shapes.shuffled(shapes.blob(seed=3, sphere=500), seed=4)
    with np.load(folder / "map.npz") as arrays:
        np.testing.assert_array_equal(arrays["vertices"], blob.vertices)
        np.testing.assert_array_equal(arrays["faces"], blob.faces)
        for name in ("sphere", "conformal", "density"):
            assert arrays[name].dtype == np.float64 and len(arrays[name]) == blob.vertex_count
        a, b, c = (arrays["sphere"][blob.faces[:, k]] for k in range(3))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    assert (triple > 0).all()
    dots = 1 + sum(np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    assert 2 * np.arctan2(triple, dots).sum() == pytest.approx(4 * np.pi, rel=1e-9)


def test_the_report_lists_the_stages(folder):
    report = json.loads((folder / "report.json").read_text())
    assert [stage["name"] for stage in report["stages"]] == ["conformal", "omt", "optimality"]
    for stage in report["stages"]:
        assert {"seconds", "iterations", "flips", "degree", "area", "angle", "transport_cost"} <= set(stage)
        assert {"mean", "surface", "sphere"} <= set(stage["area"])
    assert report["device"] == "cpu" and report["seconds"] > 0 and report["versions"]["omtwarp"]


def test_a_second_run_gives_the_same_bits(folder, tmp_path):
    assert run("map", folder / "blob.ply", "-o", tmp_path / "again.npz", "--until", "omt", "--device", "cpu", "-q") == 0
    with np.load(folder / "map.npz") as first, np.load(tmp_path / "again.npz") as second:
        for name in ("sphere", "conformal", "density"):
            np.testing.assert_array_equal(first[name], second[name])


def test_texture_and_picture_from_the_finished_map(folder, tmp_path):
    model, picture = tmp_path / "model.glb", tmp_path / "picture.png"
    options = ["--pattern", "checker", "--size", "64", "--device", "cpu", "-q"]
    assert run("texture", "--map", folder / "map.npz", "-o", model, *options) == 0
    # A map may also stand where a mesh stands.
    assert run("texture", folder / "map.npz", "-o", tmp_path / "same.glb", *options) == 0
    assert model.read_bytes() == (tmp_path / "same.glb").read_bytes()
    assert run("preview", model, "-o", picture, "--size", "64", "--backend", "warp", "--device", "cpu", "-q") == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model.glb", "picture.png", "same.glb"]


def test_the_size_follows_the_stretch_where_none_is_given(folder, tmp_path, capsys):
    """Without --size the texture is as large as the stretch needs, which for this map is less than the largest size."""
    finished = omtwarp.MapResult.load(folder / "map.npz")
    sharp, coarse = sharp_size(finished.vertices, finished.faces, finished.sphere, "cube")
    assert 1000 < sharp[0] <= LARGEST_UNASKED and coarse == 0.0
    model = tmp_path / "model.glb"
    options = ["--pattern", "checker", "--device", "cpu", "--json"]
    capsys.readouterr()
    assert run("texture", "--map", folder / "map.npz", "-o", model, *options) == 0
    (picture,) = json.loads(capsys.readouterr().out)["pictures"]
    assert (picture["width"], picture["height"]) == sharp


def test_obj_brings_its_companions(folder, tmp_path):
    options = ["--pattern", "checker", "--size", "64", "--device", "cpu", "-q"]
    assert run("texture", "--map", folder / "map.npz", "-o", tmp_path / "model.obj", *options) == 0
    assert {path.suffix for path in tmp_path.iterdir()} == {
        ".obj",
        ".mtl",
        ".png",
        ".json",
    }  # the last records what was written


@pytest.mark.parametrize("name", bad_meshes())
def test_python_says_the_same(name):
    vertices, faces, defect, remedy = bad_meshes()[name]
    with pytest.raises(omtwarp.OmtwarpError) as caught:
        omtwarp.map_to_sphere((vertices, faces), device="cpu")
    message, remedy = str(caught.value), remedy.replace("--repair", "omtwarp.repair")
    assert defect in message and remedy in message and "\n" not in message


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_extreme_scales_are_mapped_right(scale):
    blob = shapes.blob(seed=3, sphere=320)
    usual = omtwarp.map_to_sphere((blob.vertices, blob.faces), until="conformal", device="cpu")
    extreme = omtwarp.map_to_sphere((blob.vertices * scale, blob.faces), until="conformal", device="cpu")
    np.testing.assert_allclose(extreme.sphere, usual.sphere, atol=1e-9)
    np.testing.assert_allclose(extreme.density, usual.density, rtol=1e-8)
