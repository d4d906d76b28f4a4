"""Formats of single precision hold the numbers that are written, or refuse them in one line."""

import re

import numpy as np
import pytest

import omtwarp
from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.data import VertexData, read_data, write_data
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh
from omtwarp.render import preview
from omtwarp.render.scene import Arrows

BALL = shapes.icosphere(2)
COUNT = BALL.vertex_count


def data_of(values, table=None) -> VertexData:
    return VertexData(np.asarray(values)[:, None], ("number",), table)


@pytest.mark.parametrize("largest", [2**24, 2**24 + 1, 2**31 - 1, -(2**31)])
@pytest.mark.parametrize("kind", [np.int64, np.float64])
def test_whole_numbers_come_back_from_gifti(tmp_path, largest, kind):
    pytest.importorskip("nibabel")
    values = np.arange(COUNT).astype(kind)
    values[3] = largest
    write_data(tmp_path / "a.shape.gii", data_of(values))
    np.testing.assert_array_equal(read_data(tmp_path / "a.shape.gii").values[:, 0], values)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("a.shape.gii", np.full(COUNT, 2**31)),
        ("a.shape.gii", np.r_[np.nan, np.full(COUNT - 1, 2.0**24 + 1)]),
        ("lh.thickness", np.full(COUNT, 2**24 + 1)),
        ("lh.thickness", np.full(COUNT, 1.5e39)),
        ("a.shape.gii", np.full(COUNT, 1.5e39) + 0.5),
        ("a.label.gii", np.full(COUNT, 2**31)),
    ],
)
def test_numbers_that_a_format_does_not_hold_are_refused(tmp_path, name, values):
    pytest.importorskip("nibabel")
    table = {2**31: ("far", (1.0, 0.0, 0.0, 1.0))} if name.endswith(".label.gii") else None
    with pytest.raises(OmtwarpError, match="single precision"):
        write_data(tmp_path / name, data_of(values, table))
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    "names", [("2020",), ("mean, left", "sulc 1"), ('a "b"', "-1e3", "#c"), ("plain", "lh.curv-2")]
)
def test_names_of_columns_come_back_from_text(tmp_path, names):
    values = np.random.default_rng(2).normal(size=(COUNT, len(names)))
    write_data(tmp_path / "a.csv", VertexData(values, names))
    again = read_data(tmp_path / "a.csv")
    assert again.names == names
    np.testing.assert_array_equal(again.values, values)


@pytest.mark.parametrize("names", [("x", "y"), ("a", "a", "b"), ("a b", "a_b"), ("Größe", "z"), ("", "value")])
def test_columns_of_any_name_come_back_from_ply_beside_the_mesh(tmp_path, names):
    values = np.random.default_rng(3).normal(size=(COUNT, len(names)))
    write_data(tmp_path / "a.ply", VertexData(values, names), (BALL.vertices, BALL.faces))
    again = read_data(tmp_path / "a.ply")
    assert len(set(again.names)) == len(names)
    np.testing.assert_array_equal(again.values, values)
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply").vertices, BALL.vertices)
    write_mesh(tmp_path / "a.vtk", BALL.vertices, BALL.faces, beside=dict(zip(names, values.T, strict=True)))
    listed = (tmp_path / "a.vtk").read_bytes().decode("utf-8", "replace")
    assert len(set(re.findall(r"(\S+) 1 42 double", listed))) == len(set(names))


@pytest.mark.parametrize("label", [3, -3])
def test_labels_that_annot_would_lose_are_refused(tmp_path, label):
    pytest.importorskip("nibabel")
    data = data_of(np.where(np.arange(COUNT) < 5, label, 1), {1: ("one", (1.0, 0.0, 0.0, 1.0))})
    with pytest.raises(OmtwarpError, match=f"cannot hold the label {label}"):
        write_data(tmp_path / "lh.a.annot", data)
    assert not (tmp_path / "lh.a.annot").exists()


def test_black_is_a_label_of_annot_where_the_table_has_it(tmp_path):
    pytest.importorskip("nibabel")
    table = {0: ("unknown", (0.0, 0.0, 0.0, 1.0)), 2: ("one", (1.0, 0.0, 0.0, 1.0))}
    write_data(tmp_path / "lh.a.annot", data_of(2 * (np.arange(COUNT) % 2), table))
    again = read_data(tmp_path / "lh.a.annot")
    np.testing.assert_array_equal(again.values[:, 0], np.arange(COUNT) % 2)
    assert list(again.table.values()) == list(table.values())
    with pytest.raises(OmtwarpError, match="cannot hold the label -1"):  # which would become black, and so 'unknown'
        write_data(tmp_path / "lh.b.annot", data_of(np.full(COUNT, -1), table))


def test_annot_with_numbers_left_out_of_its_table_or_labels_out_of_it_is_read(tmp_path):
    pytest.importorskip("nibabel")

    def word(text):
        return np.array(len(text) + 1, ">i4").tobytes() + text.encode() + b"\0"

    named = [(3, "one", 200), (7, "two", 100)]
    codes = np.r_[np.full(COUNT - 3, 200), 100, 0, 150]  # the last one is in no table
    data = np.array(COUNT, ">i4").tobytes() + np.column_stack([np.arange(COUNT), codes]).astype(">i4").tobytes()
    data += np.array([1, -2, 8], ">i4").tobytes() + word("table.txt") + np.array(2, ">i4").tobytes()
    for key, name, red in named:
        data += np.array(key, ">i4").tobytes() + word(name) + np.array([red, 0, 0, 0], ">i4").tobytes()
    (tmp_path / "lh.a.annot").write_bytes(data)
    found = read_data(tmp_path / "lh.a.annot")
    np.testing.assert_array_equal(found.values[:, 0], np.r_[np.full(COUNT - 3, 3), 7, -1, -1])
    assert {key: name for key, (name, _) in found.table.items()} == {3: "one", 7: "two", -1: "???"}


def test_other_numbers_are_single_precision(tmp_path):
    pytest.importorskip("nibabel")
    values = np.random.default_rng(1).normal(size=COUNT) * 1e20
    values[5], values[6] = np.nan, np.inf
    for name in ("a.shape.gii", "lh.curv"):
        write_data(tmp_path / name, data_of(values))
        np.testing.assert_array_equal(read_data(tmp_path / name).values[:, 0], values.astype(np.float32))


@pytest.mark.parametrize("suffix", [".surf.gii", ".white", ".stl", ".glb"])
def test_coordinates_out_of_the_range_of_single_precision_are_refused(tmp_path, suffix):
    pytest.importorskip("nibabel")
    for scale in (1e39, 1e-39):
        with pytest.raises(OmtwarpError, match="out of range for single precision"):
            write_mesh(tmp_path / f"a{suffix}", scale * BALL.vertices, BALL.faces)
    write_mesh(tmp_path / f"a{suffix}", 1e30 * BALL.vertices, BALL.faces)
    assert np.isfinite(read_mesh(tmp_path / f"a{suffix}").vertices).all()


@pytest.mark.parametrize("radius", ["inf", "nan", "-1", "1e39"])
def test_a_radius_is_a_finite_length(tmp_path, capsys, radius):
    words = ["map", str(tmp_path / "a.ply"), "-o", str(tmp_path / "b.ply"), "--radius", radius]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code and "--radius" in capsys.readouterr().err


COMPLEX = np.ones(COUNT) + 1j


@pytest.mark.parametrize(
    "target",
    [
        (BALL.vertices, BALL.faces, COMPLEX),
        (BALL.vertices + 1j, BALL.faces, COMPLEX.real),
        lambda points: points[:, 0] + 1j,
    ],
    ids=["values", "sphere", "function"],
)
def test_complex_targets_are_refused(target):
    with pytest.raises(OmtwarpError, match="complex numbers"):
        omtwarp.map_to_sphere(BALL, target=target, device="cpu")


@pytest.mark.parametrize(
    ("subject", "options"),
    [
        ((BALL.vertices + 1j, BALL.faces), {}),
        ((BALL.vertices, BALL.faces), {"scalar": COMPLEX}),
        ((BALL.vertices, BALL.faces), {"arrows": Arrows(BALL.vertices + 1j)}),
    ],
    ids=["vertices", "scalar", "arrows"],
)
def test_complex_previews_are_refused(tmp_path, subject, options):
    with pytest.raises(OmtwarpError, match="complex numbers"):
        preview(subject, tmp_path / "a.png", size=(16, 16), backend="warp", **options)


@pytest.mark.parametrize("suffix", [".glb", ".stl"])
def test_digits_that_are_lost_far_from_the_origin_are_warned_of(tmp_path, suffix, recwarn):
    path = tmp_path / f"ball{suffix}"
    write_mesh(path, BALL.vertices + 100.0, BALL.faces)
    assert not [one for one in recwarn if one.category is omtwarp.OmtwarpWarning]
    with pytest.warns(omtwarp.OmtwarpWarning, match="single precision changes edges of .* write .ply or .obj"):
        write_mesh(path, BALL.vertices + 1e7, BALL.faces)


WRONG_ARRAYS = {
    "vertices": ("abc", None, BALL.vertices.T, BALL.vertices + 1j, BALL.vertices.astype(str)),
    "faces": ("abc", None, BALL.faces[:, :2], BALL.faces + 0.5, BALL.faces * np.nan, BALL.faces + 1j),
    "beside": (3, "abc", BALL.vertices, {"a": np.ones(3)}, {"a": "abc"}, {"a": None}),
}


@pytest.mark.parametrize("suffix", [".ply", ".vtk"])
@pytest.mark.parametrize("name", WRONG_ARRAYS)
def test_arrays_that_are_no_mesh_are_not_written(tmp_path, name, suffix):
    for wrong in WRONG_ARRAYS[name]:
        with pytest.raises(OmtwarpError, match=r"vertices|faces|beside"):
            write_mesh(tmp_path / f"a{suffix}", **{"vertices": BALL.vertices, "faces": BALL.faces} | {name: wrong})
    assert not list(tmp_path.iterdir())


def test_digits_that_a_textured_glb_loses_are_warned_of(tmp_path):
    far = omtwarp.PaintedMesh(BALL.vertices + 1e7, BALL.faces)
    with pytest.warns(omtwarp.OmtwarpWarning, match="single precision changes edges of .* of 80 faces"):
        far.export(tmp_path / "far.glb")
