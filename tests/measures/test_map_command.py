"""``omtwarp map`` with weights and a target."""

import json

import numpy as np
import pytest
from PIL import Image

from omtwarp.commands._cli import main
from omtwarp.mesh.data import VertexData, write_data
from omtwarp.mesh.shapes import blob
from omtwarp.mesh.write import write_mesh

SURFACE = blob(2, sphere=700)


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_mesh(tmp_path / "mesh.ply", SURFACE.vertices, SURFACE.faces)
    return tmp_path


def run(*words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        main([*words])
    return ended.value.code or 0


def test_weights_from_text_and_arrays_give_the_same_map(desk):
    weights = 1.0 + (SURFACE.vertices[:, 2] > 0)
    np.save("w.npy", weights)
    (desk / "w.csv").write_text("weight\n" + "\n".join(f"{w!r}," for w in weights.tolist()))
    for name in ("w.npy", "w.csv"):
        assert run("map", "mesh.ply", "-o", f"{name}.npz", "--weights", name, "--device", "cpu", "-q") == 0
    first, second = (np.load(f"{name}.npz") for name in ("w.npy", "w.csv"))
    np.testing.assert_array_equal(first["sphere"], second["sphere"])
    above = SURFACE.vertices[SURFACE.faces].mean(axis=1)[:, 2] > 0.1
    assert first["measure"][above].sum() / first["measure"].sum() > 1.2 * SURFACE.face_areas[above].sum() / (4 * np.pi)


def test_weights_follow_a_mesh_that_is_repaired(desk):
    """Weights of the file's vertices are reordered where repair removes an unused vertex and turns faces."""
    faces = SURFACE.faces.copy()
    faces[::9] = faces[::9, ::-1]
    vertices = np.vstack([[9.0, 9.0, 9.0], SURFACE.vertices])
    write_mesh(desk / "broken.ply", vertices, faces + 1)
    weights = 1.0 + (SURFACE.vertices[:, 2] > 0)
    np.save("w.npy", np.r_[50.0, weights])
    np.save("v.npy", weights)
    common = ["--device", "cpu", "-q", "--until", "moser"]
    assert run("map", "broken.ply", "-o", "broken.npz", "--repair", "--weights", "w.npy", *common) == 0
    assert run("map", "mesh.ply", "-o", "mesh.npz", "--weights", "v.npy", *common) == 0
    broken, whole = np.load("broken.npz"), np.load("mesh.npz")
    np.testing.assert_allclose(np.sort(broken["measure"]), np.sort(whole["measure"]), rtol=1e-6)


def test_a_picture_as_the_target(desk):
    Image.fromarray(np.tile(np.linspace(0, 255, 64).astype(np.uint8), (32, 1))).save("t.png")
    words = ["map", "mesh.ply", "-o", "t.npz", "--target", "t.png", "--until", "moser", "--device", "cpu", "-q"]
    assert run(*words) == 1
    assert run(*words, "--target-floor", "0.2", "--report", "t.json") == 0
    sphere, target = np.load("t.npz")["sphere"], np.load("t.npz")["target"]
    assert np.corrcoef(np.arctan2(sphere[:, 1], sphere[:, 0]), target)[0, 1] > 0.8
    assert json.loads((desk / "t.json").read_text())["mass"]["mean"] < 2.12


@pytest.mark.parametrize(
    ("content", "message"),
    [("1\n2\nx\n", "no list of numbers"), ("1\n2\n", "the weights have shape [2]"), ("0\n" * 362, "not positive")],
)
def test_weights_that_cannot_be_used(desk, capsys, content, message):
    (desk / "w.txt").write_text(content)
    assert run("map", "mesh.ply", "-o", "x.npz", "--weights", "w.txt", "--device", "cpu") == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (desk / "x.npz").exists()
    assert run("map", "mesh.ply", "-o", "x.npz", "--weights", "missing.npy") == 1


def test_weights_of_every_format_of_data_are_the_same(desk):
    """Of a CIFTI file those of the mesh's hemisphere; a row of two numbers is refused."""
    nibabel = pytest.importorskip("nibabel")
    write_mesh("lh.mesh.ply", SURFACE.vertices, SURFACE.faces)
    count = SURFACE.vertex_count
    weights = (1.0 + np.arange(count) % 5).astype(np.float32)
    np.save("w.npy", weights)
    write_data(desk / "w.shape.gii", VertexData(weights[:, None].astype(float), ("w",)))
    nibabel.save(nibabel.freesurfer.MGHImage(weights.reshape(count, 1, 1), np.eye(4)), "w.mgh")
    axes = nibabel.cifti2.cifti2_axes
    sides = [f"CIFTI_STRUCTURE_CORTEX_{side}" for side in ("LEFT", "RIGHT")]
    models = [axes.BrainModelAxis.from_surface(np.arange(count), count, side) for side in sides]
    both = np.concatenate([weights, weights[::-1]])[None]
    nibabel.save(nibabel.Cifti2Image(both, (axes.ScalarAxis(["w"]), models[0] + models[1])), "w.dscalar.nii")
    common = ["--device", "cpu", "-q", "--until", "moser"]
    found = []
    for name in ("w.npy", "w.shape.gii", "w.mgh", "w.dscalar.nii"):
        assert run("map", "lh.mesh.ply", "-o", "x.npz", "--weights", name, *common) == 0
        found.append(np.load("x.npz")["measure"])
    for measure in found[1:]:
        np.testing.assert_allclose(measure, found[0], rtol=1e-6)
    np.save("two.npy", np.ones((count, 2)))
    assert run("map", "lh.mesh.ply", "-o", "y.npz", "--weights", "two.npy", *common) == 1


def test_weights_of_a_surface_with_as_many_vertices_as_triangles_need_an_option(desk, capsys):
    rows = ["v 1 1 1", "v 1 -1 -1", "v -1 1 -1", "v -1 -1 1", "f 1 2 3", "f 1 4 2", "f 1 3 4", "f 2 4 3"]
    (desk / "four.obj").write_text("\n".join(rows))
    (desk / "w.txt").write_text("4\n1\n1\n1\n")
    words = ["map", "four.obj", "-o", "four.npz", "--weights", "w.txt", "--device", "cpu"]
    assert run(*words) == 1
    assert "--weights-at" in capsys.readouterr().err
    for at, expected in (("triangles", [4, 1, 1, 1]), ("vertices", [2, 2, 2, 1])):
        assert run(*words, "--weights-at", at) == 0
        np.testing.assert_allclose(np.load("four.npz")["measure"] / (4 * np.pi), np.array(expected) / 7, rtol=1e-12)
