"""Files of neuroimaging and data at vertices, written and read by the package and by other libraries."""

from __future__ import annotations

import shutil
import subprocess

import numpy as np
import pytest
from trimesh.exchange.ply import load_ply

from omtwarp.errors import OmtwarpError
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


def test_freesurfer_volume_geometry_is_kept(tmp_path):
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
    for key, value in volume.items():
        np.testing.assert_array_equal(found[key], value)


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


def test_other_hemisphere_is_told(tmp_path):
    with pytest.raises(OmtwarpError, match="same hemisphere"):
        require_same_structure(tmp_path / "lh.sphere", tmp_path / "tpl_hemi-R_sphere.npz")
    require_same_structure(tmp_path / "lh.sphere", tmp_path / "S1.L.sphere.npz")
    require_same_structure(tmp_path / "lh.sphere", tmp_path / "bunny.ply")
    assert structure_of(tmp_path / "bunny.rh.npz") == "CortexRight"
