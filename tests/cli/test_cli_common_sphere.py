"""The commands ``align`` and ``resample``: files in, files out, streams, JSON, and one line for bad input."""

from __future__ import annotations

import io
import json
import sys

import numpy as np
import pytest
from scipy import sparse
from sphere_truths import random_rotation

from omtwarp.cli import main
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.result import MapResult

SPHERE = shapes.icosphere(10)
BLOB = shapes.blob(seed=3, sphere=SPHERE)
COUNT = SPHERE.vertex_count


def a_map(rotation: np.ndarray) -> MapResult:
    """A map of the blob as the command line reads it: the sphere that it was made from, turned."""
    points = SPHERE.vertices @ rotation.T
    return MapResult(BLOB.vertices, BLOB.faces, points, points, np.ones(COUNT))


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    a_map(random_rotation(1)).save("lh.npz")
    a_map(random_rotation(2)).save("template.npz")
    write_mesh("lh.sphere.ply", 100 * SPHERE.vertices, SPHERE.faces)
    write_mesh("lh.white.ply", BLOB.vertices, BLOB.faces)
    np.save("thickness.npy", np.linspace(1.0, 2.0, COUNT))
    return tmp_path


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(word) for word in words])
    return int(end.value.code or 0)


def test_align_to_another_map_and_back_again(desk, capsys):
    assert run("align", "lh.npz", "--to", "template.npz", "-o", "out.npz", "--by", "features", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    expected = random_rotation(2) @ random_rotation(1).T
    np.testing.assert_allclose(record["rotation"], expected, atol=1e-6)
    found = MapResult.load("out.npz")
    np.testing.assert_allclose(found.sphere, SPHERE.vertices @ random_rotation(2).T, atol=1e-6)
    assert found.report["alignment"]["method"] == "features"
    first = (desk / "out.npz").read_bytes()
    assert run("align", "lh.npz", "--to", "template.npz", "-o", "out.npz", "--by", "features", "-q") == 0
    np.testing.assert_array_equal(MapResult.load("out.npz").sphere, found.sphere)
    assert len(first) == len((desk / "out.npz").read_bytes()) and capsys.readouterr().out == ""


def test_align_by_axes_writes_a_sphere_of_radius_100(desk, capsys):
    assert run("align", "lh.sphere.ply", "--surface", "lh.white.ply", "-o", "lh.axes.ply", "--radius", "100") == 0
    assert "by axes" in capsys.readouterr().out
    np.testing.assert_allclose(np.linalg.norm(read_mesh("lh.axes.ply").vertices, axis=1), 100.0)


def test_resample_writes_data_surface_sphere_and_matrix(desk, capsys):
    words = ["--data", "thickness.npy", "-o", "there.npy", "--matrix", "weights.npz", "--json"]
    assert run("resample", "lh.npz", "--to", "healpix:4", *words) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["matrix"]["rows"] == 192 and record["method"] == "barycentric"
    matrix = sparse.load_npz("weights.npz")
    np.testing.assert_array_equal(np.load("there.npy"), matrix @ np.load("thickness.npy"))
    assert run("resample", "lh.npz", "--to", "ico3", "-o", "lh_ico3.ply", "--sphere", "ico3.ply") == 0
    surface, sphere = read_mesh("lh_ico3.ply"), read_mesh("ico3.ply")
    np.testing.assert_array_equal(surface.faces, sphere.faces)
    assert len(surface.vertices) == 642


def test_resample_in_a_pipe(desk, monkeypatch, capsysbinary):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO((desk / "thickness.npy").read_bytes())))
    words = ["--data", "-", "-o", "-", "--method", "conservative"]
    assert run("resample", "lh.npz", "--to", "equiangular:8x16", *words) == 0
    found = np.load(io.BytesIO(capsysbinary.readouterr().out))
    assert found.shape == (128,) and 1.0 <= found.min() <= found.max() <= 2.0


def test_map_beside_its_surface_in_ply(desk):
    assert run("map", "lh.white.ply", "-o", "both.ply", "--beside", "--until", "conformal", "-q") == 0
    assert run("resample", "both.ply", "--to", "ico3", "-o", "same.ply", "-q") == 0
    assert run("map", "lh.white.ply", "-o", "map.npz", "--until", "conformal", "-q") == 0
    assert run("resample", "map.npz", "--to", "ico3", "-o", "other.ply", "-q") == 0
    np.testing.assert_array_equal(read_mesh("same.ply").vertices, read_mesh("other.ply").vertices)


def test_labels_keep_their_keys(desk):
    np.save("regions.npy", np.random.default_rng(0).choice([0, 5, 9], size=COUNT))
    assert run("resample", "lh.npz", "--to", "ico2", "--data", "regions.npy", "--labels", "-o", "out.npy", "-q") == 0
    assert set(np.load("out.npy")) <= {0, 5, 9}


def test_fsaverage_sphere_in_the_fields_formats(desk, capsys):
    nibabel = pytest.importorskip("nibabel")
    words = ["--data", "thickness.npy", "-o", "lh.thickness.shape.gii", "--sphere", "lh.sphere"]
    assert run("resample", "lh.npz", "--to", "fsaverage3", *words) == 0
    image = nibabel.load("lh.thickness.shape.gii")
    assert image.meta["AnatomicalStructurePrimary"] == "CortexLeft" and image.darrays[0].data.shape == (642,)
    assert nibabel.freesurfer.read_geometry("lh.sphere")[0].shape == (642, 3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resample", "lh.npz", "--to", "ico3", "--data", "short.npy", "-o", "x.npy"], "the data have 7 where"),
        (["resample", "lh.npz", "--to", "ico3", "--data", "holes.npy", "-o", "x.npy"], "not finite at 1 of"),
        (["resample", "lh.white.ply", "--to", "ico3", "-o", "x.ply"], "not a sphere about the origin"),
        (["resample", "lh.npz", "--to", "ico99", "-o", "x.ply"], "there is no sphere 'ico99'"),
        (["resample", "lh.npz", "--to", "rh.template.ply", "-o", "x.ply"], "same hemisphere"),
        (["resample", "lh.npz", "--to", "ico3", "--data", "thickness.npy", "-o", "x.label.gii"], "without a table"),
        (["resample", "lh.npz", "--to", "healpix:4", "-o", "x.ply"], "no triangles"),
        (["resample", "lh.npz", "--to", "ico3", "-o", "-"], "it needs --data"),
        (["align", "lh.sphere.ply", "-o", "x.ply"], "has no axes"),
        (["align", "lh.sphere.ply", "--to", "lh.npz", "-o", "x.npz"], "needs a map"),
        (["align", "lh.npz", "--to", "rh.template.ply", "-o", "x.npz"], "same hemisphere"),
        (["align", "lh.npz", "--to", "ico3", "-o", "x.npz"], "no features of its own"),
        (["align", "lh.npz", "--to", "template.npz", "--feature", "thickness.npy", "-o", "x.npz"], "as many"),
    ],
)
def test_bad_input_is_one_line(desk, capsys, words, message):
    np.save("short.npy", np.ones(7))
    np.save("holes.npy", np.where(np.arange(COUNT) == 3, np.nan, 1.0))
    write_mesh("rh.template.ply", SPHERE.vertices, SPHERE.faces)
    assert run(*words) == 1
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not list(desk.glob("x.*"))


@pytest.mark.parametrize("command", ["align", "resample"])
def test_help_has_an_example(command, capsys):
    assert run(command, "--help") == 0
    assert f"Example: omtwarp {command}" in " ".join(capsys.readouterr().out.split())
