"""Commands on the common sphere: files in, files out, streams, JSON, the same bits twice, one line for bad input."""

from __future__ import annotations

import hashlib
import inspect
import io
import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import sparse
from sphere_truths import random_rotation

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.commands._command import as_command
from omtwarp.commands.spheres import run_register as register
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.data import VertexData, read_data, write_data
from omtwarp.mesh.neuro import structure_of
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.render import films
from omtwarp.shape_analysis import reports

SPHERE = shapes.icosphere(10)
BLOB = shapes.blob(seed=3, sphere=SPHERE)
COUNT = SPHERE.vertex_count


def a_map(rotation: np.ndarray) -> MapResult:
    """Make a map of the blob, in the form the command line reads: the sphere that it was made from, rotated."""
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
    assert record["margin"] == record["score"] - record["runner_up"] > 0.1
    found = MapResult.load("out.npz")
    np.testing.assert_allclose(found.sphere, SPHERE.vertices @ random_rotation(2).T, atol=1e-6)
    assert found.report["alignment"]["method"] == "features"
    first = (desk / "out.npz").read_bytes()
    assert run("align", "lh.npz", "--to", "template.npz", "-o", "out.npz", "--by", "features", "-q") == 0
    np.testing.assert_array_equal(MapResult.load("out.npz").sphere, found.sphere)
    assert len(first) == len((desk / "out.npz").read_bytes()) and capsys.readouterr().out == ""


def test_register_to_another_map(desk, capsys):
    assert run("register", "lh.npz", "--to", "template.npz", "-o", "out.npz", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record["certificate"]["bijective"] and not record["doubtful"]
    found = MapResult.load("out.npz")
    np.testing.assert_allclose(found.sphere, SPHERE.vertices @ random_rotation(2).T, atol=0.02)
    assert found.report["registration"]["correlations"]["sulc"]["after"] > 0.99
    sphere = ["register", "lh.sphere.ply", "--surface", "lh.white.ply", "--to", "template.npz", "-o", "lh.reg.ply"]
    assert run(*sphere, "--radius", "100", "--max-strain", "0.5") == 0
    assert "0 flips, degree 1" in capsys.readouterr().out
    np.testing.assert_allclose(read_mesh("lh.reg.ply").vertices, 100.0 * found.sphere, atol=2.0)


def test_register_has_the_defaults_of_the_function():
    here = {option.name: option for option in as_command(register).params}
    there = inspect.signature(omtwarp.register).parameters
    for name in ("stiffness", "max_strain"):
        assert here[name].default == there[name].default


def test_register_writes_strain_and_weights_features(desk, short_warps, capsys):
    words = ["register", "lh.npz", "--to", "template.npz", "-o", "out.npz", "-q"]
    assert run(*words, "--strain", "lh.strain.csv", "--feature-weight", "1", "--feature-weight", "0") == 0
    strain = read_data(Path("lh.strain.csv"))
    assert strain.names == ("area_log2", "stretch_log2") and strain.values.shape == (COUNT, 2)
    assert 0.0 <= strain.values[:, 1].min() and np.abs(strain.values).max() < 0.1
    depth = MapResult.load("out.npz").report["registration"]["levels"][-1]["energy"]
    assert run(*words, "--feature-weight", "2", "--feature-weight", "0") == 0
    assert MapResult.load("out.npz").report["registration"]["levels"][-1]["energy"] != depth
    assert run(*words, "--feature-weight", "2") == 1
    assert "1 times --feature-weight for 2 features" in capsys.readouterr().err


def test_register_writes_what_workbench_takes(desk, short_warps):
    """The sphere before and after on one mesh, strain at its vertices, each with the part of the brain."""
    pytest.importorskip("nibabel")
    result = replace(a_map(random_rotation(1)), report={"structure": "CortexLeft"})
    result.save("one.npz")
    line = ["register", "one.npz", "--to", "template.npz", "-q", "--radius", "100"]
    extra = ["--before", "before.surf.gii", "--strain", "strain.shape.gii"]
    assert run(*line, "-o", "after.surf.gii", *extra) == 0 == run(*line, "-o", "lh.sphere.reg")
    before, after, theirs = (read_mesh(name) for name in ("before.surf.gii", "after.surf.gii", "lh.sphere.reg"))
    for mesh in (before, after, theirs):
        np.testing.assert_array_equal(mesh.faces, BLOB.faces)
    np.testing.assert_allclose(before.vertices, 100.0 * result.sphere, atol=1e-4)
    np.testing.assert_allclose(after.vertices, 100.0 * SPHERE.vertices @ random_rotation(2).T, atol=2.0)
    np.testing.assert_allclose(theirs.vertices, after.vertices, atol=1e-4)
    parts = [structure_of(Path(name)) for name in ("before.surf.gii", "after.surf.gii", "strain.shape.gii")]
    assert parts == ["CortexLeft"] * 3
    assert read_data(Path("strain.shape.gii")).names == ("area_log2", "stretch_log2")


def test_register_writes_a_page_and_a_film(desk, short_warps, capsys, monkeypatch):
    """The page has features of the target, before and after, and both strains; the film goes to the registered map."""
    monkeypatch.setattr(films, "PROBE_WIDTH", 16)  # motion is measured on few pixels, and few are drawn
    monkeypatch.setattr(reports, "film", partial(films.film, size=(64, 36), seconds=3.0, fps=5))
    words = ["register", "lh.npz", "--to", "template.npz", "-o", "out.npz", "-q"]
    assert run(*words, "--report", "page.html", "--film", "warp.gif") == 0
    page = Path("page.html").read_text("utf-8")
    assert page.count("<img") == 3 * 2 + 2 and "ratios of areas" in page and "http" not in page.split("</style>")[1]
    found = MapResult.load("out.npz").report["registration"]
    assert f"{found['correlations']['curv']['after']:.3f}" in page
    assert Image.open("warp.gif").n_frames > 10
    assert run("register", "lh.sphere.ply", "--surface", "lh.white.ply", *words[2:5], "o.ply", "--film", "a.gif") == 1
    assert "--film needs a map" in capsys.readouterr().err


def test_register_takes_landmarks_from_a_table(desk, capsys):
    Path("places.csv").write_text("label,side,vertex,weight\na,moving,10,exact\na,target,11,\n")
    assert run("register", "lh.npz", "--to", "template.npz", "-o", "out.npz", "--landmarks", "places.csv") == 0
    assert "landmarks within 0.0" in capsys.readouterr().out
    found, target = MapResult.load("out.npz"), MapResult.load("template.npz")
    np.testing.assert_allclose(found.sphere[10], target.sphere[11], atol=2e-3)
    assert found.report["registration"]["landmarks"]["a"]["after"] < 0.1


def test_register_keeps_areas(desk, capsys):
    words = ["register", "lh.npz", "--to", "template.npz", "-o", "out.npz", "--json", "--keep-areas"]
    assert run(*words, "exact") == 0
    assert json.loads(capsys.readouterr().out)["area_changes"]["largest"] <= 1e-6
    assert run(*words, "nearly") == 1
    assert "keep_areas" in capsys.readouterr().err


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


def test_a_grid_with_its_surface_is_aligned_to(desk, capsys):
    assert run("resample", "lh.npz", "--to", "ico3", "-o", "there.ply") == 0
    assert run("align", "template.npz", "--to", "ico3", "--to-surface", "there.ply", "-o", "turned.ply") == 0
    assert np.abs(read_mesh("turned.ply").vertices - MapResult.load("lh.npz").sphere).max() < 0.05


def test_resample_in_a_pipe(desk, monkeypatch, capsysbinary):
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO((desk / "thickness.npy").read_bytes())))
    words = ["--data", "-", "-o", "-", "--method", "conservative"]
    assert run("resample", "lh.npz", "--to", "equiangular:8x16", *words) == 0
    found = np.load(io.BytesIO(capsysbinary.readouterr().out))
    assert found.shape == (128,) and 1.0 <= found.min() <= found.max() <= 2.0


def test_commands_in_a_pipe(desk, monkeypatch, capsysbinary):
    """A map is turned, its surface resampled, expanded and compared, from stream to stream."""

    def piped(given: bytes, *words: str) -> bytes:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(given)))
        assert run(*words) == 0
        return capsysbinary.readouterr().out

    turned = piped((desk / "lh.npz").read_bytes(), "align", "-", "--to", "template.npz", "-o", "-", "--json")
    (desk / "turned.npz").write_bytes(turned)
    np.testing.assert_allclose(MapResult.load("turned.npz").sphere, SPHERE.vertices @ random_rotation(2).T, atol=1e-6)
    (desk / "ico3.ply").write_bytes(piped(turned, "resample", "-", "--to", "ico3", "-o", "-"))
    assert len(read_mesh("ico3.ply").vertices) == 642
    (desk / "again.npz").write_bytes(piped(turned, "align", "lh.npz", "--to", "-", "-o", "-"))
    np.testing.assert_allclose(MapResult.load("again.npz").sphere, MapResult.load("turned.npz").sphere, atol=1e-9)
    table = np.genfromtxt(
        io.BytesIO(piped(turned, "spharm", "-", "-o", "-", "--degree", "3")), delimiter=",", names=True
    )
    assert table["degree"].tolist() == [0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 3, 3]
    apart = json.loads(piped(turned, "distance", "lh.npz", "-", "--degree", "4", "--json"))
    assert apart["coefficients"] < 1e-6
    piped(b"path\nlh.npz\nturned.npz\n", "group", "-", "-o", "study", "--grid", "ico2", "--degree", "4")
    assert (desk / "study" / "table.csv").read_text().count("\n") == 3


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_same_bits_twice(desk, capsys):
    """Two runs give the same bits of every output: maps, data, matrices, tables, pictures and printed lines."""
    pytest.importorskip("nibabel")
    commands = [
        ["align", "lh.npz", "--to", "template.npz", "--mirror", "-o", "out/map.npz", "--json"],
        ["align", "lh.npz", "-o", "out/lh.sphere.surf.gii", "--radius", "100"],
        ["resample", "lh.npz", "--to", "ico3", "-o", "out/s.ply", "--sphere", "out/lh.sphere", "--matrix", "out/w.npz"],
        ["resample", "lh.npz", "--to", "fsaverage3", "--data", "thickness.npy", "-o", "out/t.shape.gii", "--json"],
        *(
            ["resample", "lh.npz", "--to", "healpix:4", "--data", "thickness.npy", "--method", m, "-o", f"out/{m}.npy"]
            for m in ("nearest", "adaptive", "conservative")
        ),
        *(["spharm", "lh.npz", "-o", f"out/a.{kind}", "--degree", "5", "--json"] for kind in ("coef", "csv", "npz")),
        ["group", "lh.npz", "template.npz", "-o", "out/study", "--grid", "ico2", "--degree", "4"],
        ["distance", "lh.npz", "template.npz", "--degree", "4"],
    ]
    found = []
    for _ in range(2):
        (desk / "out").mkdir()
        assert [run(*words) for words in commands] == [0] * len(commands)
        found.append((digests(desk / "out"), capsys.readouterr().out))
        (desk / "out").rename(desk / f"out{len(found)}")
    assert found[0] == found[1]
    assert len(found[0][0]) == 12 + 12 + 1  # the last records what was written


def test_map_beside_its_surface_in_ply(desk):
    assert run("map", "lh.white.ply", "-o", "both.ply", "--beside", "--until", "conformal", "-q") == 0
    assert run("resample", "both.ply", "--to", "ico3", "-o", "same.ply", "-q") == 0
    assert run("map", "lh.white.ply", "-o", "map.npz", "--until", "conformal", "-q") == 0
    assert run("resample", "map.npz", "--to", "ico3", "-o", "other.ply", "-q") == 0
    np.testing.assert_array_equal(read_mesh("same.ply").vertices, read_mesh("other.ply").vertices)


def test_a_map_has_the_axes_asked_for_at_its_pole_and_front(desk, capsys):
    shape = shapes.ellipsoid((0.6, 1.0, 0.8), 320)
    write_mesh("egg.ply", shape.vertices, shape.faces)
    for words, (front, up) in ((["--up", "y", "--front", "x"], (0, 1)), (["--up", "x", "--front", "z"], (2, 0))):
        assert run("map", "egg.ply", "-o", "egg.npz", "--until", "conformal", "-q", *words) == 0
        found = MapResult.load("egg.npz")
        for points in (found.sphere, found.conformal):
            assert (shape.vertices[:, up] * points[:, 2]).min() > -1e-3
            assert (shape.vertices[:, front] * points[:, 0]).min() > -1e-3
    assert run("map", "egg.ply", "-o", "egg.npz", "--until", "conformal", "--up", "x", "--front", "-x") == 1
    assert "omtwarp: error: " in capsys.readouterr().err


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


def test_structure_of_the_brain_survives_every_command(desk, short_warps):
    """What a GIFTI file says of its surface goes with its map, and into every GIFTI file that is made of this."""
    nibabel = pytest.importorskip("nibabel")
    write_mesh("in.surf.gii", BLOB.vertices, BLOB.faces)
    image = nibabel.load("in.surf.gii")
    image.get_arrays_from_intent("pointset")[0].meta["AnatomicalStructurePrimary"] = "Cerebellum"
    nibabel.save(image, "in.surf.gii")
    for words in (
        ["map", "in.surf.gii", "-o", "a.npz", "--until", "conformal"],
        ["align", "a.npz", "--to", "axes", "-o", "b.npz"],
        ["register", "b.npz", "--to", "template.npz", "-o", "c.npz"],
        ["map", "in.surf.gii", "-o", "0.surf.gii", "--until", "conformal"],
        ["align", "a.npz", "--to", "axes", "-o", "1.surf.gii"],
        ["register", "b.npz", "--to", "template.npz", "-o", "2.surf.gii", "--strain", "3.shape.gii"],
        ["resample", "c.npz", "--to", "ico2", "-o", "4.surf.gii", "--sphere", "5.surf.gii"],
        ["resample", "c.npz", "--to", "ico2", "--data", "thickness.npy", "-o", "6.shape.gii"],
        ["resample", "template.npz", "--to", "c.npz", "-o", "7.ply", "--sphere", "8.surf.gii"],
        ["resample", "1.surf.gii", "--surface", "in.surf.gii", "--to", "template.npz", "-o", "9.surf.gii"],
    ):
        assert run(*words, "-q") == 0, words
    made = sorted(path.name for path in desk.glob("[0-9].*.gii"))
    assert len(made) == 9
    assert {name: structure_of(Path(name)) for name in made} == dict.fromkeys(made, "Cerebellum")
    assert run("resample", "c.npz", "--to", "lh.npz", "-o", "no.ply") == 1  # the name of which says CortexLeft


def test_a_distance_of_scaled_shapes_has_no_unit(desk, capsys):
    """The line names the unit; scaled to size 1, shapes ten times as large are as far apart."""
    large = MapResult.load("lh.npz")
    large.with_arrays({"vertices": 10.0 * large.vertices}).save("large.npz")
    lines = []
    for words in ([], ["--scale"]):
        assert run("distance", "large.npz", "template.npz", "--degree", "4", *words) == 0
        lines.append(capsys.readouterr().out)
    assert "(unit of the surfaces)" in lines[0] and "(at size 1)" in lines[1]
    far, near = (float(line.split()[1]) for line in lines)
    assert far > 1.0 and near < 1e-6


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["resample", "lh.npz", "--to", "ico3", "--data", "short.npy", "-o", "x.npy"], "the data have 7 where"),
        (["resample", "lh.npz", "--to", "ico3", "--data", "holes.npy", "-o", "x.npy"], "infinite at 1 of"),
        (["resample", "lh.white.ply", "--to", "ico3", "-o", "x.ply"], "not a sphere about the origin"),
        (["resample", "lh.npz", "--to", "ico99", "-o", "x.ply"], "there is no sphere 'ico99'"),
        (["resample", "lh.npz", "--to", "rh.template.ply", "-o", "x.ply"], "same hemisphere"),
        (["resample", "lh.npz", "--to", "ico3", "--data", "thickness.npy", "-o", "x.label.gii"], "without a table"),
        (["resample", "lh.npz", "--to", "ico3", "--hemisphere", "right", "-o", "x.ply"], "--hemisphere names"),
        (["resample", "lh.npz", "--to", "ico3", "-o", "rh.surf.gii"], "'rh.surf.gii' names the other hemisphere"),
        (["resample", "lh.npz", "--to", "healpix:4", "-o", "x.ply"], "no triangles"),
        (["resample", "lh.npz", "--to", "ico3", "-o", "-", "--data", "holes.npy"], "infinite at 1 of"),
        (
            ["resample", "lh.npz", "--to", "ico3", "--data", "regions.npy", "--labels", "-o", "x.annot"],
            "table of names",
        ),
        (["resample", "lh.npz", "--to", "lh.white.ply", "-o", "x.ply"], "not a sphere about the origin"),
        (["align", "lh.npz", "--to", "lh.white.ply", "-o", "x.npz"], "not a sphere about the origin"),
        (
            [
                "align",
                "lh.npz",
                "--to",
                "template.npz",
                "--feature",
                "short.npy",
                "--to-feature",
                "short.npy",
                "-o",
                "x.npz",
            ],
            "feature 'short.npy (1)' of the map: shape [7]",
        ),
        (
            [
                "align",
                "lh.npz",
                "--to",
                "template.npz",
                "--feature",
                "holes.npy",
                "--to-feature",
                "holes.npy",
                "-o",
                "x.npz",
            ],
            "feature 'holes.npy (1)' of the map",
        ),
        (["align", "lh.sphere.ply", "-o", "x.ply"], "has no axes"),
        (["register", "lh.npz", "--to", "ico3", "-o", "x.npz"], "give the surface, or features"),
        (["register", "lh.npz", "--to", "rh.template.ply", "-o", "x.npz"], "same hemisphere"),
        (["register", "lh.npz", "--to", "template.npz", "-o", "x.npz", "--stiffness", "0"], "the stiffness"),
        (["register", "lh.npz", "--to", "template.npz", "--feature", "thickness.npy", "-o", "x.npz"], "as many"),
        (["align", "lh.sphere.ply", "--to", "lh.npz", "-o", "x.npz"], "needs a map"),
        (["align", "lh.npz", "--to", "rh.template.ply", "-o", "x.npz"], "same hemisphere"),
        (["align", "lh.npz", "--to", "ico3", "-o", "x.npz"], "no features of its own"),
        (["align", "lh.npz", "--to", "template.npz", "--feature", "thickness.npy", "-o", "x.npz"], "as many"),
    ],
)
def test_bad_input_is_one_line(desk, capsys, words, message):
    np.save("short.npy", np.ones(7))
    np.save("regions.npy", np.zeros(COUNT, int))
    np.save("holes.npy", np.where(np.arange(COUNT) == 3, np.inf, 1.0))
    write_mesh("rh.template.ply", SPHERE.vertices, SPHERE.faces)
    assert run(*words) == 1
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1
    assert not list(desk.glob("x.*"))


@pytest.mark.parametrize(
    "words",
    [
        "resample lh.npz --to ico2 -o x.npy --data OTHER",
        "resample left.npz --to ico2 -o x.npy --data OTHER",
        "resample lh.sphere.ply --surface rh.white.ply --to ico2 -o x.npy --data thickness.npy",
        "register lh.npz --to template.npz -o x.npz --feature OTHER --to-feature thickness.npy",
        "register lh.npz --to template.npz -o x.npz --feature thickness.npy --to-feature OTHER",
        "align lh.npz --to template.npz -o x.npz --feature OTHER --to-feature thickness.npy",
        "register lh.npz left.npz -o x --group --feature OTHER --feature thickness.npy",
        "register template.npz lh.npz -o x --sequence --feature thickness.npy --feature OTHER",
    ],
)
@pytest.mark.parametrize("other", ["rh.thickness.npy", "rh.y.shape.gii", "x.shape.gii"])
def test_data_of_the_other_hemisphere_are_refused(desk, capsys, words, other):
    pytest.importorskip("nibabel")
    inside = "CortexRight" if other.startswith("x") else None
    write_data(desk / other, VertexData(np.linspace(1.0, 2.0, COUNT)[:, None], ("y",), structure=inside))
    write_mesh("rh.white.ply", BLOB.vertices, BLOB.faces)
    replace(a_map(random_rotation(1)), report={"structure": "CortexLeft"}).save("left.npz")
    before = sorted(desk.iterdir())
    assert run(*words.replace("OTHER", other).split()) == 1
    said = capsys.readouterr().err
    assert "same hemisphere" in said and said.count("\n") == 1
    assert sorted(desk.iterdir()) == before


@pytest.mark.parametrize("mode", ["--group", "--sequence"])
def test_a_folder_of_results_is_not_called_as_a_map_is(desk, capsys, mode):
    for output, words in (("x.npz", "a map such as 'x.npz'"), ("x.NPZ", "a map such as"), ("-", "standard output")):
        assert run("register", "lh.npz", "template.npz", mode, "-o", output) == 1
        said = capsys.readouterr().err
        assert f"{mode} writes a folder, not {words}" in said and said.count("\n") == 1
    assert not list(desk.glob("x.*"))


@pytest.mark.parametrize(
    "words",
    [
        "map lh.white.ply -o rh.npz --until conformal",
        "align lh.npz --to axes -o rh.npz",
        "register lh.npz --to template.npz -o rh.npz",
    ],
)
def test_an_output_called_as_the_other_hemisphere_is_refused(desk, capsys, words):
    assert run(*words.split()) == 1
    assert capsys.readouterr().err.endswith("'rh.npz' names the other hemisphere than what is written, CortexLeft\n")
    assert not Path("rh.npz").exists()


@pytest.mark.parametrize(
    "words",
    [
        "register lh.npz --to template.npz -o x.ply --before x.ply",
        "register lh.npz --to template.npz -o x.npz --strain x.ply --before ./x.ply",
        "register lh.npz --to template.npz -o x.npz --before x.gii --strain x.gii",
        "resample lh.npz --to ico1 -o x.ply --sphere x.ply",
    ],
)
def test_one_name_for_two_outputs_is_refused(desk, capsys, words):
    before = sorted(desk.iterdir())
    assert run(*words.split()) == 1
    said = capsys.readouterr().err
    assert "twice" in said and said.count("\n") == 1
    assert sorted(desk.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("align lh.npz -o x.npz --degree 5", "'degree' is of alignments to another map"),
        ("align lh.npz -o x.npz --mirror", "'mirror' is of alignments to another map: leave it out with --to axes"),
        ("align lh.npz -o x.npz --by features", "'by' is of alignments to another map"),
        (
            "align lh.npz -o x.npz --to template.npz --by vertices --feature thickness.npy --to-feature thickness.npy",
            "'features' is of alignments by features: leave it out with --by vertices",
        ),
        ("align lh.npz -o x.npz --to template.npz --by vertices --degree 5", "'degree' is of alignments by features"),
        ("register lh.npz -o x.npz --to template.npz --rounds 2", "--rounds is of --group"),
        ("register lh.npz template.npz -o x --sequence --rounds 2", "--rounds is of --group"),
        ("register lh.npz -o x.npz --to template.npz --hemisphere left", "--hemisphere is of targets that have two"),
        ("register lh.npz -o x.npz --to fsaverage5-left --hemisphere right", "--hemisphere is of targets that have"),
        ("register lh.npz template.npz -o x --group --hemisphere left", "--hemisphere is of one map"),
        ("register lh.npz template.npz -o x --sequence --hemisphere left", "--hemisphere is of one map"),
        ("resample lh.npz --to ico2 -o x.ply --labels", "--labels is of --data"),
        ("map lh.white.ply -o x.npz --weights-at vertices", "--weights-at is of --weights"),
        ("map lh.white.ply -o x.npz --target-floor 0.1", "--target-floor is of --target"),
        ("map lh.white.ply -o x.npz --until moser --refine area", "refine is of the stage refine"),
        ("map lh.white.ply -o x.npz --method moser --scheme paper", "scheme is of the method omt"),
    ],
)
def test_options_without_effect_are_refused(desk, capsys, words, message):
    before = sorted(desk.iterdir())
    assert run(*words.split()) == 1
    said = capsys.readouterr().err
    assert message in said and "leave it out" in said and said.count("\n") == 1
    assert sorted(desk.iterdir()) == before


def test_a_folder_that_no_cohort_wrote_is_no_group(desk, capsys):
    (desk / "registered").mkdir()
    for name in ("table.csv", "template.npz", "lh.npz"):
        (desk / "registered" / name).write_text("id\n", "utf-8")
    assert run("group", "registered", "-o", "x") == 1
    assert "'registered' is no cohort's folder: give the maps in it" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ["align", "bad.npz", "-o", "x.npz"],
        ["resample", "bad.npz", "--to", "ico2", "-o", "x.ply"],
        ["spharm", "bad.npz", "-o", "x.coef"],
        ["distance", "lh.npz", "bad.npz"],
        ["group", "lh.npz", "bad.npz", "-o", "x.study"],
    ],
    ids=lambda words: words[0],
)
def test_maps_that_are_none_are_refused_by_every_command(desk, capsys, words):
    with np.load("lh.npz") as file:
        whole = dict(file)
    holes = whole["sphere"].copy()
    holes[3, 0] = np.nan
    for sphere, message in (
        (holes, "1 number that is not finite, first in row 3"),
        (3.0 * whole["sphere"], "not on the unit sphere"),
        (whole["sphere"][1:], f"shape [{COUNT - 1}, 3], not [{COUNT}, 3]"),
    ):
        np.savez("bad.npz", **whole | {"sphere": sphere})
        assert run(*words) == 1
        said = capsys.readouterr().err
        assert message in said and "'bad.npz' is not a map" in said and said.count("\n") == 1
    assert not list(desk.glob("x.*"))
