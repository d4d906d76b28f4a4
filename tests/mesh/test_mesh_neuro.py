"""Files of neuroimaging and data at vertices, written and read by the package and by other libraries."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from trimesh.exchange.ply import load_ply

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.data import VertexData, read_data, write_data
from omtwarp.mesh.neuro import require_same_structure, structure_of
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.write import write_mesh

BALL = shapes.shuffled(shapes.blob(seed=2, sphere=shapes.icosphere(5)), seed=1)
COUNT = BALL.vertex_count
SPHERE = shapes.icosphere(5)
TABLE = {0: ("???", (0.0, 0.0, 0.0, 0.0)), 3: ("gyrus", (1.0, 0.0, 0.2, 1.0)), 7: ("sulcus", (0.0, 0.4, 1.0, 1.0))}


def labels() -> VertexData:
    keys = np.random.default_rng(0).choice([0, 3, 7], size=(COUNT, 1))
    return VertexData(keys, ("regions",), TABLE, "CortexLeft")


@pytest.mark.parametrize("name", ["a.surf.gii", "lh.sphere", "lh.white", "a.vtk"])
def test_surfaces_come_back(tmp_path, name):
    if name != "a.vtk":
        pytest.importorskip("nibabel")
    write_mesh(tmp_path / name, BALL.vertices, BALL.faces)
    mesh = read_mesh(tmp_path / name)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)
    np.testing.assert_allclose(mesh.vertices, BALL.vertices, atol=0 if name == "a.vtk" else 2e-7)


def test_gifti_says_what_it_is_and_keeps_what_it_was(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    gifti = nibabel.gifti
    system = gifti.GiftiCoordSystem(1, 3, np.diag([1.0, 2.0, 3.0, 1.0]))
    arrays = [
        gifti.GiftiDataArray(
            BALL.vertices.astype(np.float32), "NIFTI_INTENT_POINTSET", "NIFTI_TYPE_FLOAT32", coordsys=system
        ),
        gifti.GiftiDataArray(BALL.faces.astype(np.int32), "NIFTI_INTENT_TRIANGLE", "NIFTI_TYPE_INT32"),
    ]
    arrays[0].meta = gifti.GiftiMetaData(
        AnatomicalStructurePrimary="CortexRight", AnatomicalStructureSecondary="MidThickness", Subject="7"
    )
    nibabel.save(gifti.GiftiImage(darrays=arrays, meta=gifti.GiftiMetaData(Study="made")), tmp_path / "in.surf.gii")
    write_mesh(
        tmp_path / "out.surf.gii", 100 * SPHERE.vertices, SPHERE.faces, spherical=True, like=tmp_path / "in.surf.gii"
    )
    image = nibabel.load(tmp_path / "out.surf.gii")
    points = image.get_arrays_from_intent("pointset")[0]
    assert dict(image.meta)["Study"] == "made" and points.meta["Subject"] == "7"
    assert points.meta["AnatomicalStructurePrimary"] == "CortexRight"
    assert points.meta["GeometricType"] == "Spherical" and "AnatomicalStructureSecondary" not in points.meta
    np.testing.assert_array_equal(points.coordsys.xform, system.xform)
    assert (points.coordsys.dataspace, points.coordsys.xformspace) == (1, 3)
    np.testing.assert_allclose(np.linalg.norm(points.data, axis=1), 100.0, rtol=1e-6)
    write_mesh(tmp_path / "lh.sphere.surf.gii", SPHERE.vertices, SPHERE.faces, spherical=True)
    assert structure_of(tmp_path / "lh.sphere.surf.gii") == "CortexLeft"


def test_freesurfer_volume_geometry_is_kept(tmp_path, monkeypatch):
    io = pytest.importorskip("nibabel").freesurfer.io
    volume = {
        "head": np.array([2, 0, 20], np.int32),
        "valid": "1  # volume info valid",
        "filename": "../mri/filled.mgz",
        "volume": np.array([256, 256, 256]),
        "voxelsize": np.array([1.0, 1.0, 1.0]),
        "xras": np.array([-1.0, 0.0, 0.0]),
        "yras": np.array([0.0, 0.0, -1.0]),
        "zras": np.array([0.0, 1.0, 0.0]),
        "cras": np.array([5.4, 18.0, 0.0]),
    }
    io.write_geometry(tmp_path / "lh.white", BALL.vertices, BALL.faces, volume_info=volume)
    write_mesh(tmp_path / "lh.sphere", 100 * SPHERE.vertices, SPHERE.faces, spherical=True, like=tmp_path / "lh.white")
    points, faces, found = io.read_geometry(tmp_path / "lh.sphere", read_metadata=True)
    np.testing.assert_array_equal(faces, SPHERE.faces)
    np.testing.assert_allclose(points, 100 * SPHERE.vertices, atol=2e-5)
    lines = ["map lh.white -o lh.npz --until conformal --device cpu", "align lh.npz -o moved.npz"]
    monkeypatch.chdir(tmp_path)
    for line in [*lines, "resample moved.npz --to ico2 -o lh.pial --device cpu"]:  # through the map too
        with pytest.raises(SystemExit) as ended:
            main([*line.split(), "-q"])
        assert not ended.value.code
    for kept in (found, io.read_geometry("lh.pial", read_metadata=True)[2]):
        for key, value in volume.items():
            np.testing.assert_array_equal(kept[key], value)
    assert MapResult.load("lh.npz").report["volume_geometry"]["cras"] == [5.4, 18.0, 0.0]
    damaged = replace(MapResult.load("lh.npz"), report={"volume_geometry": {"cras": "far"}})
    damaged.save("damaged.npz")
    write_mesh("lh.orig", BALL.vertices, BALL.faces, like=Path("damaged.npz"))
    assert not io.read_geometry("lh.orig", read_metadata=True)[2]


@pytest.mark.parametrize(
    "name", ["a.npy", "a.csv", "a.txt", "a.shape.gii", "a.func.gii", "lh.thickness", "lh.curv", "a.ply"]
)
def test_numbers_come_back(tmp_path, name):
    exact = name.endswith(("npy", "csv", "txt", "ply"))
    if not exact:
        pytest.importorskip("nibabel")
    columns = 1 if name.startswith("lh") else 2
    values = np.random.default_rng(1).normal(size=(COUNT, columns))
    names = ("thickness", "sulc")[:columns]
    write_data(tmp_path / name, VertexData(values, names), (BALL.vertices, BALL.faces))
    found = read_data(tmp_path / name)
    np.testing.assert_allclose(found.values, values, rtol=0 if exact else 1e-6, atol=0 if exact else 1e-7)
    assert name.startswith(("a.npy", "lh")) or found.names == names


def test_whole_numbers_that_int64_does_not_hold_are_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.array([2**63 - 1, 3], np.uint64))
    assert read_data(tmp_path / "a.npy").values.tolist() == [[2**63 - 1], [3]]
    np.save(tmp_path / "a.npy", np.array([2**63 + 5, 3], np.uint64))
    with pytest.raises(OmtwarpError, match="numbers up to 9223372036854775813 are out of range"):
        read_data(tmp_path / "a.npy")
    np.save(tmp_path / "a.npy", np.array([True, False]))
    assert read_data(tmp_path / "a.npy").values.tolist() == [[1], [0]]


def test_text_is_read_with_any_separator_and_names(tmp_path):
    (tmp_path / "a.txt").write_text("\ufeff# heights\nx; y\n1; 2.5\n\n-3e2;nan;\n", "utf-8")
    found = read_data(tmp_path / "a.txt")
    assert found.names == ("x", "y")
    np.testing.assert_array_equal(found.values, [[1.0, 2.5], [-300.0, np.nan]])
    (tmp_path / "b.csv").write_text("1\t2\n3 4\n")
    found = read_data(tmp_path / "b.csv")
    assert found.names == ("b 1", "b 2")
    np.testing.assert_array_equal(found.values, [[1.0, 2.0], [3.0, 4.0]])


@pytest.mark.parametrize("name", ["a.label.gii", "lh.a.annot"])
def test_labels_come_back_with_their_table(tmp_path, name):
    pytest.importorskip("nibabel")
    write_data(tmp_path / name, labels())
    found = read_data(tmp_path / name)
    assert found.is_labels and found.structure == "CortexLeft"
    words = [found.table[key][0] for key in found.values[:, 0]]
    assert words == [TABLE[key][0] for key in labels().values[:, 0]]
    colors = dict(found.table.values())
    np.testing.assert_allclose(colors["sulcus"], TABLE[7][1], atol=1e-6 if name.endswith("gii") else 2e-3)


def test_ply_holds_the_sphere_beside_the_surface(tmp_path):
    beside = dict(zip(("px", "py", "pz"), SPHERE.vertices.T, strict=True))
    write_mesh(tmp_path / "a.ply", BALL.vertices, BALL.faces, beside=beside)
    with open(tmp_path / "a.ply", "rb") as stream:
        rows = load_ply(stream)["metadata"]["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.column_stack([rows[name] for name in ("px", "py", "pz")]), SPHERE.vertices)
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.ply").vertices, BALL.vertices)
    np.testing.assert_array_equal(read_data(tmp_path / "a.ply").values, SPHERE.vertices)


def test_text_vtk_and_the_newer_layout_are_read(tmp_path):
    points = "0 0 0 1 0 0 0 1 0 0 0 1"
    old = f"# vtk DataFile Version 2.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n{points}\n"
    old += "POLYGONS 4 16\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    new = f"# vtk DataFile Version 5.1\nx\nASCII\nDATASET POLYDATA\nPOINTS 4 float\n{points}\n"
    new += "POLYGONS 5 12\nOFFSETS vtktypeint64\n0 3 6 9 12\nCONNECTIVITY vtktypeint64\n0 2 1 0 1 3 0 3 2 1 2 3\n"
    for k, text in enumerate((old, new)):
        (tmp_path / f"{k}.vtk").write_text(text)
        mesh = read_mesh(tmp_path / f"{k}.vtk")
        np.testing.assert_array_equal(mesh.faces, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        np.testing.assert_array_equal(mesh.vertices, np.array(points.split(), float).reshape(4, 3))


def test_workbench_reads_our_files(tmp_path):
    pytest.importorskip("nibabel")
    if shutil.which("wb_command") is None:
        pytest.skip("Connectome Workbench is not installed: apt-get install connectome-workbench")
    write_mesh(tmp_path / "lh.a.surf.gii", 100 * SPHERE.vertices, SPHERE.faces, spherical=True)
    write_data(tmp_path / "lh.a.shape.gii", VertexData(np.ones((COUNT, 1)), ("one",)))
    write_data(tmp_path / "lh.a.label.gii", labels())
    for name, words in (
        ("lh.a.surf.gii", ("Surface", "CortexLeft", str(COUNT))),
        ("lh.a.shape.gii", ("Metric", "CortexLeft", str(COUNT))),
        ("lh.a.label.gii", ("Label", "CortexLeft", "sulcus")),
    ):
        command = ["wb_command", "-file-information", str(tmp_path / name)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        for word in words:
            assert word.upper() in done.stdout.upper(), (word, done.stdout)


def test_what_a_format_cannot_hold_is_one_line(tmp_path):
    numbers = VertexData(np.ones((COUNT, 2)), ("a", "b"))
    with pytest.raises(OmtwarpError, match="without a table"):
        write_data(tmp_path / "a.label.gii", numbers)
    with pytest.raises(OmtwarpError, match="one number per vertex"):
        write_data(tmp_path / "lh.curv", numbers)
    with pytest.raises(OmtwarpError, match="unknown format"):
        write_data(tmp_path / "a.mat", numbers)
    (tmp_path / "bad.npy").write_bytes(b"no array")
    with pytest.raises(OmtwarpError, match=r"bad\.npy: not an array"):
        read_data(tmp_path / "bad.npy")
    with pytest.raises(OmtwarpError, match="no such file"):
        read_data(tmp_path / "none.npy")
    for name, text, words in (
        ("a.mat", "1", "unknown format"),
        ("a.csv", "1,2\n3\n", r"a\.csv: no list of numbers"),
        ("a.txt", "one\n1\ntwo\n", r"a\.txt: no list of numbers.*two"),
        ("b.csv", "# nothing\n", "it is empty"),
        ("other.gii", "<html></html>", r"^[^:]*: damaged, or no GIFTI file: XML of another kind$"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(OmtwarpError, match=words):
            read_data(tmp_path / name)
    assert not (tmp_path / "a.label.gii").exists()


@pytest.mark.parametrize("suffix", [".mgh", ".mgz"])
@pytest.mark.parametrize("columns", [1, 3])
def test_data_of_freesurfers_volumes_are_read(tmp_path, suffix, columns):
    nibabel = pytest.importorskip("nibabel")
    values = np.random.default_rng(3).normal(size=(COUNT, columns)).astype(np.float32)
    values[5] = np.nan
    shape = (COUNT, 1, 1) if columns == 1 else (COUNT, 1, 1, columns)
    nibabel.save(nibabel.freesurfer.MGHImage(values.reshape(shape), np.eye(4)), tmp_path / f"lh.thickness{suffix}")
    data = read_data(tmp_path / f"lh.thickness{suffix}")
    np.testing.assert_array_equal(data.values, values)
    assert data.structure == "CortexLeft" and len(data.names) == columns and data.names[0].startswith("lh.thickness")
    volume = np.zeros((4, 5, 6), dtype=np.float32)
    nibabel.save(nibabel.freesurfer.MGHImage(volume, np.eye(4)), tmp_path / f"orig{suffix}")
    with pytest.raises(OmtwarpError, match="a volume of 4 x 5 x 6, not data of vertices"):
        read_data(tmp_path / f"orig{suffix}")


LEFT = np.delete(np.arange(COUNT), [3, 40, 41])  # without a medial wall
RIGHT = np.arange(10, COUNT)


def cifti(rows, parts=("left", "right", "volume")):
    """Make a CIFTI file of a row's kind with data 1, 2, ... in the order of its columns; return the values too."""
    nibabel = pytest.importorskip("nibabel")
    axes = nibabel.cifti2.cifti2_axes
    cortex = axes.BrainModelAxis.from_surface
    models = {
        "left": cortex(LEFT, COUNT, "CIFTI_STRUCTURE_CORTEX_LEFT"),
        "right": cortex(RIGHT, COUNT, "CIFTI_STRUCTURE_CORTEX_RIGHT"),
        "volume": axes.BrainModelAxis.from_mask(np.ones((2, 2, 2)), "CIFTI_STRUCTURE_THALAMUS_LEFT", np.eye(4)),
    }
    columns = models[parts[0]]
    for part in parts[1:]:
        columns = columns + models[part]
    values = np.arange(1.0, 1.0 + len(rows) * len(columns)).reshape(len(rows), -1)
    return nibabel.Cifti2Image(values, (rows, columns)), values


def test_cifti_data_are_those_of_the_surface_that_is_named(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    axes = nibabel.cifti2.cifti2_axes
    image, values = cifti(axes.ScalarAxis(["sulc", "curv"]))
    nibabel.save(image, tmp_path / "S1.dscalar.nii")
    for structure, vertices, first in (("CortexLeft", LEFT, 0), ("CortexRight", RIGHT, len(LEFT))):
        data = read_data(tmp_path / "S1.dscalar.nii", structure)
        np.testing.assert_array_equal(data.values[vertices], values[:, first : first + len(vertices)].T)
        assert np.isnan(np.delete(data.values, vertices, axis=0)).all() and len(data.values) == COUNT
        assert data.names == ("sulc", "curv") and data.structure == structure
    with pytest.raises(OmtwarpError, match="data of CortexLeft, CortexRight, and the surface does not say which"):
        read_data(tmp_path / "S1.dscalar.nii")
    with pytest.raises(OmtwarpError, match="not of Cerebellum"):
        read_data(tmp_path / "S1.dscalar.nii", "Cerebellum")
    image, values = cifti(axes.SeriesAxis(0.0, 0.7, 4), ("right",))
    nibabel.save(image, tmp_path / "rest.dtseries.nii")
    data = read_data(tmp_path / "rest.dtseries.nii")  # one surface: no question
    np.testing.assert_array_equal(data.values[RIGHT], values.T)
    assert data.structure == "CortexRight" and data.names == tuple(f"rest {k}" for k in (1, 2, 3, 4))


def test_cifti_labels_have_their_table(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    axes = nibabel.cifti2.cifti2_axes
    table = {3: ("gyrus", (1.0, 0.0, 0.2, 1.0)), 7: ("sulcus", (0.0, 0.4, 1.0, 1.0))}
    image, _ = cifti(axes.LabelAxis(["regions"], table), ("left",))
    keys = np.random.default_rng(0).choice([3, 7], size=(1, len(LEFT)))
    nibabel.save(nibabel.Cifti2Image(keys.astype(float), image.header), tmp_path / "parcels.dlabel.nii")
    data = read_data(tmp_path / "parcels.dlabel.nii")
    assert data.is_labels and data.values.dtype == np.int64 and data.table[7][0] == "sulcus"
    np.testing.assert_array_equal(data.values[LEFT], keys.T)
    assert (np.delete(data.values, LEFT, axis=0) == 0).all() and data.table[0][0] == "???"
    write_data(tmp_path / "parcels.label.gii", data)
    np.testing.assert_array_equal(read_data(tmp_path / "parcels.label.gii").values, data.values)


def test_other_files_of_nifti_are_one_line(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    axes = nibabel.cifti2.cifti2_axes
    nibabel.save(nibabel.Nifti1Image(np.zeros((3, 4, 5)), np.eye(4)), tmp_path / "T1.nii")
    with pytest.raises(OmtwarpError, match="a volume, not data of vertices"):
        read_data(tmp_path / "T1.nii")
    image, _ = cifti(axes.ScalarAxis(["a"]), ("volume",))
    nibabel.save(image, tmp_path / "v.dscalar.nii")
    with pytest.raises(OmtwarpError, match="data of no surface"):
        read_data(tmp_path / "v.dscalar.nii")
    parcels = axes.ParcelsAxis(["one"], [np.zeros((0, 3), int)], [{"CIFTI_STRUCTURE_CORTEX_LEFT": LEFT}])
    parcels.nvertices = {"CIFTI_STRUCTURE_CORTEX_LEFT": COUNT}
    nibabel.save(nibabel.Cifti2Image(np.ones((1, 1)), (axes.ScalarAxis(["a"]), parcels)), tmp_path / "p.pscalar.nii")
    with pytest.raises(OmtwarpError, match="no CIFTI file of data at vertices"):
        read_data(tmp_path / "p.pscalar.nii")


def test_commands_take_the_hemisphere_of_the_surface(tmp_path, monkeypatch, capsys):
    """With the map of a left surface the left part is resampled; the medial wall stays one."""
    nibabel = pytest.importorskip("nibabel")
    monkeypatch.chdir(tmp_path)
    image, _ = cifti(nibabel.cifti2.cifti2_axes.ScalarAxis(["sulc"]))
    nibabel.save(image, "S1.dscalar.nii")
    write_mesh("lh.sphere", SPHERE.vertices, SPHERE.faces)
    write_mesh("sphere.ply", SPHERE.vertices, SPHERE.faces)
    line = ["--to", "ico3", "--data", "S1.dscalar.nii", "-o"]
    with pytest.raises(SystemExit) as ended:
        main(["resample", "lh.sphere", *line, "lh.shape.gii"])
    assert not ended.value.code
    found = read_data(Path("lh.shape.gii"))
    finite = found.values[np.isfinite(found.values)]
    assert found.structure == "CortexLeft" and 0 < len(finite) and finite.max() <= len(LEFT)
    with pytest.raises(SystemExit) as ended:
        main(["resample", "sphere.ply", *line, "other.shape.gii"])
    said = capsys.readouterr().err
    assert ended.value.code == 1 and said.count("\n") == 1 and "does not say which" in said
    for side, structure in (("left", "CortexLeft"), ("right", "CortexRight")):  # which an option may say
        for words in ([*line, "other.shape.gii"], ["--surface", "sphere.ply", "--to", "ico3", "-o", "other.surf.gii"]):
            with pytest.raises(SystemExit) as ended:
                main(["resample", "sphere.ply", *words, "--hemisphere", side])
            assert not ended.value.code and structure_of(Path(words[-1])) == structure


def test_other_hemisphere_is_told(tmp_path):
    with pytest.raises(OmtwarpError, match="same hemisphere"):
        require_same_structure(tmp_path / "lh.sphere", tmp_path / "tpl_hemi-R_sphere.npz")
    require_same_structure(tmp_path / "lh.sphere", tmp_path / "S1.L.sphere.npz")
    require_same_structure(tmp_path / "lh.sphere", tmp_path / "bunny.ply")
    assert structure_of(tmp_path / "bunny.rh.npz") == "CortexRight"
