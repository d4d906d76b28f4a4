"""A finished map survives its file, and files that are none are refused in one line."""

import json
import os
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.maps.result import MapResult
from omtwarp.mesh.shapes import blob
from omtwarp.metrics import measure_triangles

REQUIRED = ("vertices", "faces", "sphere", "conformal", "density")
OPTIONAL = ("face_density", "source", "moser", "transported")  # where their stage was run


@pytest.fixture(scope="module")
def result():
    surface = blob(seed=3, amplitude=0.2, degree=3, sphere=320)
    mapped = map_to_sphere((surface.vertices, surface.faces), until="omt", device="cpu")
    even = map_to_sphere((surface.vertices, surface.faces), until="moser", device="cpu").moser
    with_all_stages = replace(mapped, moser=even)
    assert with_all_stages.certificate.bijective  # known from here on, as of a map that was made
    return with_all_stages


def test_round_trip(tmp_path, result):
    path = tmp_path / "map.npz"
    result.save(path)
    again = MapResult.load(path)
    for name in REQUIRED + OPTIONAL:
        one, other = getattr(result, name), getattr(again, name)
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    assert again.report == json.loads(json.dumps(result.report))
    assert again.history == json.loads(json.dumps(result.history))
    assert again.bijective is result.bijective is True
    assert os.listdir(tmp_path) == ["map.npz"]


def test_file_is_plain_numpy_of_the_documented_names_and_types(tmp_path, result):
    result.save(tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz", allow_pickle=False) as data:
        assert set(data.files) == {*REQUIRED, *OPTIONAL, "report"}
        assert data["faces"].dtype == np.int32
        for name in set(data.files) - {"faces", "report"}:
            assert data[name].dtype == np.float64
        assert json.loads(str(data["report"]))["stages"]


def test_stages_that_were_not_run_are_not_in_the_file(tmp_path, result):
    bare = MapResult(result.vertices, result.faces, result.sphere, result.conformal, result.density)
    bare.save(tmp_path / "bare.npz")
    again = MapResult.load(tmp_path / "bare.npz")
    assert (again.face_density, again.moser, again.transported, again.history) == (None, None, None, [])
    assert again.bijective  # measured, though no stage said so


def test_a_map_made_elsewhere_needs_only_the_five_arrays(tmp_path, result):
    arrays = {name: getattr(result, name) for name in REQUIRED}
    arrays["faces"] = arrays["faces"].astype(np.int64)
    arrays["vertices"] = arrays["vertices"].astype(np.float32)
    np.savez_compressed(tmp_path / "made.npz", **arrays)
    again = MapResult.load(tmp_path / "made.npz")
    assert again.faces.dtype == np.int32
    assert again.vertices.dtype == np.float64
    assert again.distortion().flips == 0


def test_distortion_of_every_stage(result):
    for stage in ("sphere", "conformal", "moser", "transported"):
        got = result.distortion(stage)
        truth = measure_triangles(result.vertices, result.faces, getattr(result, stage))
        assert got.to_dict() == truth.to_dict()
    assert result.distortion("conformal").area["surface"] > result.distortion("moser").area["surface"]
    with pytest.raises(OmtwarpError, match="no stage 'refined'"):
        result.distortion("refined")
    with pytest.raises(OmtwarpError, match="no stage '") as caught:
        result.distortion(np.ones((40, 3)))
    assert "\n" not in str(caught.value)
    with pytest.raises(OmtwarpError, match="no stage 'report'"):
        result.distortion("report")


def damaged(path, result, how):
    """Write a file that is not a map."""
    result.save(path)
    whole = path.read_bytes()
    with np.load(path) as data:
        arrays = {name: data[name] for name in data.files}
    if how == "cut short":
        path.write_bytes(whole[: len(whole) // 2])
    elif how == "bits turned over":
        middle = len(whole) // 2
        path.write_bytes(whole[:middle] + bytes(255 - b for b in whole[middle : middle + 400]) + whole[middle + 400 :])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "text":
        path.write_text("v 0 0 0\nf 1 2 3\n")
    elif how == "a single array":
        with open(path, "wb") as stream:
            np.save(stream, arrays["sphere"])
    elif how == "another zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("readme.txt", "nothing here")
    else:
        change = {
            "no sphere": lambda: arrays.pop("sphere"),
            "other mesh": lambda: arrays.update(vertices=arrays["vertices"][:-3]),
            "flat vertices": lambda: arrays.update(vertices=arrays["vertices"].ravel()),
            "no array": lambda: arrays.update(vertices=np.float64(1.0)),
            "square faces": lambda: arrays.update(faces=arrays["faces"][:, [0, 1, 2, 2]]),
            "faces out of range": lambda: arrays.update(faces=arrays["faces"] + 5),
            "negative faces": lambda: arrays.update(faces=arrays["faces"] - 1),
            "fractional faces": lambda: arrays.update(faces=arrays["faces"] + 0.5),
            "words": lambda: arrays.update(density=np.array(["a"] * len(arrays["density"]))),
            "short moser": lambda: arrays.update(moser=arrays["moser"][:5]),
            "pickled": lambda: arrays.update(density=np.array([{}] * len(arrays["density"]), dtype=object)),
        }
        change[how]()
        np.savez(path, **arrays)


@pytest.mark.parametrize(
    "how",
    [
        "cut short",
        "bits turned over",
        "empty",
        "text",
        "a single array",
        "another zip",
        "no sphere",
        "other mesh",
        "flat vertices",
        "no array",
        "square faces",
        "faces out of range",
        "negative faces",
        "fractional faces",
        "words",
        "short moser",
        "pickled",
    ],
)
def test_files_that_are_no_maps(tmp_path, result, how):
    path = tmp_path / "broken.npz"
    damaged(path, result, how)
    with pytest.raises(OmtwarpError, match=r"broken\.npz.*not a map") as caught:
        MapResult.load(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["no json {", "[1, 2]", '"words"'])
def test_a_report_that_cannot_be_read_costs_only_the_report(tmp_path, result, text):
    arrays = {name: getattr(result, name) for name in REQUIRED}
    np.savez(tmp_path / "odd.npz", **arrays, report=np.array(text))
    again = MapResult.load(tmp_path / "odd.npz")
    assert (set(again.report), again.history) == ({"certificate"}, [])
    np.testing.assert_array_equal(again.sphere, result.sphere)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(OmtwarpError, match="no such file"):
        MapResult.load(tmp_path / "none.npz")
    with pytest.raises(OmtwarpError, match="not a map"):
        MapResult.load(tmp_path)


def test_places_that_cannot_be_written(tmp_path, result):
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "folder.npz").mkdir()
    for path in (tmp_path / "none" / "map.npz", tmp_path / "file" / "map.npz", tmp_path / "folder.npz"):
        with pytest.raises(OmtwarpError, match="cannot write"):
            result.save(path)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.npz"]


def test_a_failed_save_leaves_the_old_file(tmp_path, result, monkeypatch):
    path = tmp_path / "map.npz"
    path.write_bytes(b"an older map")

    def full(*arguments, **named):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OmtwarpError, match="No space left"):
        result.save(path)
    assert path.read_bytes() == b"an older map"
    assert os.listdir(tmp_path) == ["map.npz"]


def test_a_result_owns_its_arrays(result):
    """Neither the arrays it was made of nor its own can be changed under it."""
    surface = blob(seed=4, sphere=320)
    given = np.array(surface.vertices)
    sphere = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
    made = MapResult(given, surface.faces, sphere, sphere, np.ones(surface.vertex_count))
    before = made.distortion().area
    given[:], sphere[:] = 7.0, np.nan
    assert made.distortion().area == before
    np.testing.assert_array_equal(made.vertices, surface.vertices)
    for name in REQUIRED + OPTIONAL:
        with pytest.raises(ValueError, match="read-only"):
            getattr(result, name)[0] = 0


def test_origins_of_a_repaired_mesh_are_in_the_file(tmp_path, result):
    origin = np.arange(len(result.vertices))[::-1]
    replace(result, vertex_origin=origin).save(tmp_path / "map.npz")
    again = MapResult.load(tmp_path / "map.npz")
    np.testing.assert_array_equal(again.vertex_origin, origin)
    assert again.face_origin is None


def test_repr_measures_nothing(result, monkeypatch):
    monkeypatch.setattr(MapResult, "distortion", lambda *_: pytest.fail("it measured the distortion"))
    assert repr(result) == f"MapResult({len(result.vertices)} vertices, {len(result.faces)} faces, omt, bijective)"
