"""Small formats that people bring, each written here as its document describes it."""

from __future__ import annotations

import gzip
import struct

import numpy as np
import pytest

from omtwarp.commands._cli import main
from omtwarp.errors import OmtwarpError
from omtwarp.maps.result import MapResult
from omtwarp.mesh import shapes
from omtwarp.mesh.other_formats import WAYS_ROUND
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.validate import check
from omtwarp.mesh.write import write_mesh
from omtwarp.texturing import read_painted_mesh

BALL = shapes.icosphere(2)
V, F = BALL.vertex_count, BALL.face_count
POINTS, FACES = BALL.vertices, BALL.faces


def lines(*tables) -> bytes:
    return "".join(" ".join(map(str, row)) + "\n" for table in tables for row in np.asarray(table).tolist()).encode()


def mz3(content: int = 3, skip: bytes = b"") -> bytes:
    head = struct.pack("<HHIII", 0x5A4D, content, F, V, len(skip)) + skip
    return head + FACES.astype("<i4").tobytes() + POINTS.astype("<f4").tobytes()


def freesurfer() -> bytes:
    marks = np.zeros((V, 1)), np.zeros((F, 1), int)
    head = f"#!ascii version of lh.pial\n{V} {F}\n".encode()
    return head + lines(np.hstack([POINTS, marks[0]]), np.hstack([FACES, marks[1]]))


def mni(colored: int = 0) -> bytes:
    colours = np.ones(((1, F, V)[colored], 4))
    head = f"P 0.3 0.3 0.4 10 1 {V}\n".encode() + lines(POINTS) + b"\n" + lines(POINTS) + f"\n{F}\n{colored} ".encode()
    ends, corners = 3 * np.arange(1, F + 1), FACES.reshape(-1, 10)
    return head + lines(colours) + b"\n" + lines(ends.reshape(-1, 8)) + b"\n" + lines(corners)


def plates(together: bool = True) -> bytes:
    rows = [f"{k} {x!r} {y!r} {z!r}" for k, (x, y, z) in enumerate(POINTS.tolist(), 1)]
    sides = [f"{k} {a} {b} {c}" for k, (a, b, c) in enumerate((FACES + 1).tolist(), 1)]
    head, middle = ([f"{V} {F}"], []) if together else ([f"{V}"], [f"{F}"])
    return "\n".join([*head, *rows, *middle, *sides]).encode()


def off(keyword: str) -> bytes:
    return f"{keyword}{V} {F} 0\n".encode() + lines(POINTS, np.hstack([np.full((F, 1), 3, dtype=object), FACES]))


FILES = {
    "a.mz3": mz3(),
    "b.mz3": mz3(7, b"12345"),
    "lh.pial.asc": freesurfer(),
    "mni.obj": mni(),
    "faces.obj": mni(1),
    "vertices.obj": mni(2),
    "a.tab": plates(),
    "apart.tab": plates(together=False),
    "glued.off": off("OFF"),
    "normal.off": off("OFF\n"),
    "colours.off": off("COFF "),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("packed", [False, True])
def test_the_same_mesh_is_read_from_every_format(tmp_path, name, packed):
    path = tmp_path / (name + ".gz" * packed)
    path.write_bytes(gzip.compress(FILES[name]) if packed else FILES[name])
    mesh = read_mesh(path)
    precision = np.float32 if name.endswith(".mz3") else np.float64
    np.testing.assert_array_equal(mesh.vertices, POINTS.astype(precision))
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_array_equal(read_painted_mesh(path).faces, FACES)


@pytest.mark.parametrize("name", [name for name in FILES if not name.endswith(".off")])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_files_that_are_cut_short_say_so(tmp_path, name, share):
    (tmp_path / name).write_bytes(FILES[name][: int(share * len(FILES[name]))])
    with pytest.raises(OmtwarpError, match="cut short") as caught:
        read_mesh(tmp_path / name)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.mz3", b"no header", "no header of an mz3 file"),
        ("a.mz3", mz3(8), "data alone"),
        ("a.tab", b"2 1\n1 0 0 0\n3 0 0 0\n1 1 1 1\n", "not numbered from 1"),
        ("a.tab", b"name value\n1 2\n", "cannot be read as tab"),
        ("a.obj", b"P 0 0 0 0 1 1000000000000\n0 0 0\n", "cut short: 3000000000000 numbers announced"),
        ("a.obj.gz", gzip.compress(b"v 0 0 0\n" * 99, mtime=0)[:-9], "cut short: its compressed data have no end"),
        ("a.obj.gz", gzip.compress(b"v 0 0 0\n" * 99, mtime=0) + b"ends", "longer than its compressed data"),
        ("a.gz", gzip.compress(b"v 0 0 0\n" * 99, mtime=0), "unknown format, as its name has no suffix: known are"),
        ("a.obj.gz", b"v 0 0 0\n", "no faces in it"),
        ("a.vtp", b"<html></html>", "no VTK file: XML that begins with <html>"),
        ("a.vtu", b"<html></html>", "no VTK file: XML that begins with <html>"),
        ("a.gii", b"<html></html>", "a.gii: damaged, or no GIFTI file: XML of another kind$"),
        ("a.xyz.gz", gzip.compress(b"0 0 0", mtime=0), "unknown format '.xyz'"),
    ],
)
def test_damaged_files_are_one_line(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(OmtwarpError, match=words) as caught:
        read_mesh(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_what_inflates_too_far_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("omtwarp.mesh.read.LARGEST_MESH_FILE", 10_000)
    (tmp_path / "a.obj.gz").write_bytes(gzip.compress(bytes(10_001)))
    with pytest.raises(OmtwarpError, match=r"inflates to more than 10.0 kB"):
        read_mesh(tmp_path / "a.obj.gz")


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".off", ".stl", ".vtk", ".surf.gii", ".white"])
def test_any_format_may_be_compressed(tmp_path, suffix):
    if suffix in (".surf.gii", ".white"):
        pytest.importorskip("nibabel")
    write_mesh(tmp_path / f"a{suffix}", POINTS, FACES)
    content = (tmp_path / f"a{suffix}").read_bytes()
    (tmp_path / f"b{suffix}.gz").write_bytes(gzip.compress(content))
    one, other = read_mesh(tmp_path / f"a{suffix}"), read_mesh(tmp_path / f"b{suffix}.gz")
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)


def ply_of_strips(strips: list[list[int]]) -> bytes:
    head = f"ply\nformat ascii 1.0\nelement vertex {V}\nproperty double x\nproperty double y\nproperty double z\n"
    head += f"element tristrips {len(strips)}\nproperty list int int vertex_indices\nend_header\n"
    return head.encode() + lines(POINTS) + "".join(f"{len(s)} {' '.join(map(str, s))}\n" for s in strips).encode()


def test_strips_of_a_ply_end_at_minus_one(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply_of_strips([[0, 1, 2, 3, 0, -1, 5, 6, 7, -1, -1, 8, 9], [4, 5, 6, -1]]))
    expected = [[0, 1, 2], [2, 1, 3], [2, 3, 0], [5, 6, 7], [4, 5, 6]]
    for read in (read_mesh, read_painted_mesh):
        np.testing.assert_array_equal(read(tmp_path / "a.ply").faces, expected)
    whole = [[*face, -1] for face in FACES.tolist()]
    (tmp_path / "b.ply").write_bytes(ply_of_strips([[corner for strip in whole for corner in strip]]))
    mesh = read_mesh(tmp_path / "b.ply")
    np.testing.assert_array_equal(mesh.faces, FACES)
    assert check(mesh.vertices, mesh.faces) == []


def ply_with(extra: str, missing: int = 0) -> bytes:
    head = f"ply\nformat ascii 1.0\nelement vertex {V}\nproperty double x\nproperty double y\nproperty double z\n"
    head += (
        f"element face {F}\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    )
    rows = [f"3 {a} {b} {c} 6 0 0 1 0 0 1{extra}" for a, b, c in FACES.tolist()]
    return head.encode() + lines(POINTS) + "\n".join(rows[: F - missing]).encode() + b"\n"


def test_numbers_at_line_ends_that_a_header_does_not_announce_are_left_out(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply_with(" 9 1 1 1 1 1 1 1 1 1"))
    for read in (read_mesh, read_painted_mesh):
        mesh = read(tmp_path / "a.ply")
        np.testing.assert_array_equal(mesh.faces, FACES)
        np.testing.assert_array_equal(mesh.vertices, POINTS)
        assert mesh.notes == (f"left out the numbers at the ends of {F} lines that the header does not announce",)
    (tmp_path / "a.ply").write_bytes(ply_with(" 9 1 1", missing=3))
    with pytest.raises(OmtwarpError, match="cut short"):
        read_mesh(tmp_path / "a.ply")


def test_a_file_that_is_longer_than_its_header_says_is_not_called_cut_short(tmp_path):
    write_mesh(tmp_path / "a.ply", POINTS, FACES)
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes() + bytes(20))
    with pytest.raises(OmtwarpError, match=f"longer than its header says: 20 bytes after {V} of 'vertex'"):
        read_mesh(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes(ply_with("") + b"1 2\n")
    with pytest.raises(OmtwarpError, match="longer than its header says: 2 numbers"):
        read_mesh(tmp_path / "a.ply")


def solids(names: list[str]) -> bytes:
    text = ""
    for k, name in enumerate(names):
        text += f"solid {name}\n"
        for triangle in (POINTS[FACES] + 3 * k).tolist():
            corners = "".join(f"      vertex {x!r} {y!r} {z!r}\n" for x, y, z in triangle)
            text += f"  facet normal 0 0 0\n    outer loop\n{corners}    endloop\n  endfacet\n"
        text += f"endsolid {name}\n"
    return text.encode()


def two_objects() -> bytes:
    rows = []
    for k in range(2):
        rows.append(f"o part{k}")
        rows += [f"v {x!r} {y!r} {z!r}" for x, y, z in (POINTS + 3 * k).tolist()]
        rows += [f"f {a} {b} {c}" for a, b, c in (FACES + 1 + k * V).tolist()]
    return "\n".join(rows).encode()


def two_meshes() -> bytes:
    import trimesh

    parts = {f"part{k}": trimesh.Trimesh(POINTS + 3 * k, FACES, process=False) for k in range(2)}
    content = trimesh.Scene(parts).export(file_type="glb")
    assert isinstance(content, bytes)
    return content


def test_solids_of_an_stl_are_taken_together(tmp_path):
    (tmp_path / "a.stl").write_bytes(solids(["Part 1; vertex 1 2 3", "Part 2"]))
    mesh = read_mesh(tmp_path / "a.stl")
    assert len(mesh.vertices) == 2 * V and len(mesh.faces) == 2 * F and mesh.notes[0] == "took 2 solids together"
    np.testing.assert_array_equal(mesh.vertices[mesh.faces], np.concatenate([POINTS[FACES], POINTS[FACES] + 3]))
    (tmp_path / "a.stl").write_bytes(solids(["one", "two"])[:-12])
    with pytest.raises(OmtwarpError, match="cut short"):
        read_mesh(tmp_path / "a.stl")


@pytest.mark.parametrize("option", ["--components", "--together"])
def test_parts_of_every_format_are_mapped_alike(tmp_path, monkeypatch, option):
    monkeypatch.chdir(tmp_path)
    files = {"a.obj": two_objects(), "a.stl": solids(["one", "two"]), "a.glb": two_meshes()}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SystemExit) as ended:
            main(["map", name, "-o", "a.npz", option, "--until", "conformal", "--device", "cpu", "--quiet"])
        assert not ended.value.code, name
        result = MapResult.load("a.npz")
        assert len(result.faces) >= 2 * F


@pytest.mark.parametrize("suffix", ["fbx", "usdz", "step", "nrrd", "drc"])
def test_formats_that_are_not_read_come_with_a_way_round(tmp_path, suffix):
    (tmp_path / f"a.{suffix}").write_bytes(b"content")
    with pytest.raises(OmtwarpError) as caught:
        read_mesh(tmp_path / f"a.{suffix}")
    assert f"'.{suffix}' is not read: {WAYS_ROUND[suffix]}" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("suffix", "name"), [("msh", "gmsh"), ("msh", "gmsh22"), ("msh", "ansys"), ("mesh", "medit"), ("inp", "abaqus")]
)
def test_formats_of_finite_elements_need_meshio(tmp_path, suffix, name):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"content")
    try:
        import meshio
    except ImportError:
        with pytest.raises(OmtwarpError, match=r"needs meshio: pip install 'omtwarp\[meshio\]'"):
            read_mesh(path)
        return
    with pytest.raises(OmtwarpError) as caught:
        read_mesh(path)
    assert "\n" not in str(caught.value)
    lines_of = np.stack([FACES[:, 0], FACES[:, 1]], axis=1)
    cells = [("line", lines_of), ("triangle", FACES)]
    meshio.write(path, meshio.Mesh(POINTS, cells if name == "medit" else cells[1:]), file_format=name)
    mesh = read_mesh(path)
    np.testing.assert_allclose(mesh.vertices, POINTS, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(mesh.faces, FACES)
    tetrahedra = meshio.Mesh(POINTS, [("tetra", np.array([[0, 1, 2, 3]]))])
    meshio.write(path, tetrahedra, file_format=name)
    with pytest.raises(OmtwarpError, match="cells of the kind tetra"):
        read_mesh(path)
