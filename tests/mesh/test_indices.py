"""Corners of faces keep their numbers in every format: numbers that wrap and halves are refused in one line."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.validate import check
from omtwarp.texturing import PaintedMesh, read_painted_mesh

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
WRAPPED, HALF = 2**32 + 1, 1.5


def text_of(rows) -> str:
    return "\n".join(" ".join(str(number) for number in row) for row in rows) + "\n"


def ply(faces, kind: str = "double") -> bytes:
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face 4\nproperty list uchar {kind} vertex_indices\nend_header\n"
    return (head + text_of(POINTS.tolist()) + text_of([3, *face] for face in faces)).encode()


def binary_ply(faces) -> bytes:
    """Write corners as doubles, or as int64 where they are whole."""
    kind, code = ("double", "<d") if any(isinstance(i, float) for face in faces for i in face) else ("int64", "<q")
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    head += "property double x\nproperty double y\nproperty double z\n"
    head += f"element face 4\nproperty list uchar {kind} vertex_indices\nend_header\n"
    rows = b"".join(b"\3" + b"".join(struct.pack(code, i) for i in face) for face in faces)
    return head.encode() + POINTS.astype("<f8").tobytes() + rows


def obj(faces) -> bytes:
    return (text_of(["v", *p] for p in POINTS.tolist()) + text_of(["f", *(i + 1 for i in f)] for f in faces)).encode()


def off(faces) -> bytes:
    return ("OFF\n4 4 0\n" + text_of(POINTS.tolist()) + text_of([3, *face] for face in faces)).encode()


def vtk(faces) -> bytes:
    head = "# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 4 double\n" + text_of(POINTS.tolist())
    return (head + "POLYGONS 4 16\n" + text_of([3, *face] for face in faces)).encode()


def vtp(faces) -> bytes:
    kind = "Float64" if any(isinstance(i, float) for face in faces for i in face) else "Int64"
    array = '<DataArray type="{}" Name="{}" format="ascii">{}</DataArray>'
    polys = array.format(kind, "connectivity", text_of(faces)) + array.format("Int64", "offsets", "3 6 9 12")
    points = array.format("Float64", "points", text_of(POINTS.tolist()))
    piece = f"<PolyData><Piece><Points>{points}</Points><Polys>{polys}</Polys></Piece></PolyData>"
    return f'<VTKFile type="PolyData">{piece}</VTKFile>'.encode()


FORMATS = {"text.ply": ply, "binary.ply": binary_ply, "a.obj": obj, "a.off": off, "a.vtk": vtk, "a.vtp": vtp}


def error_of(call) -> str:
    with pytest.raises(OmtwarpError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("name", FORMATS)
def test_whole_numbers_within_range_are_read(tmp_path, name):
    (tmp_path / name).write_bytes(FORMATS[name](FACES))
    np.testing.assert_array_equal(read_mesh(tmp_path / name).faces, FACES)
    np.testing.assert_array_equal(read_painted_mesh(tmp_path / name).faces, FACES)
    np.testing.assert_array_equal(read_mesh(tmp_path / name).vertices, POINTS)


@pytest.mark.parametrize("name", FORMATS)
def test_a_number_that_wraps_is_out_of_range(tmp_path, name):
    """In 32 bits 2^32 + 1 is 1, which would complete the surface."""
    faces = [[WRAPPED if number == 1 else number for number in face] for face in FACES]
    (tmp_path / name).write_bytes(FORMATS[name](faces))
    mesh = read_mesh(tmp_path / name)
    assert [defect.kind for defect in check(mesh.vertices, mesh.faces)] == ["index-out-of-range"]
    words = error_of(lambda: read_painted_mesh(tmp_path / name))
    assert str(WRAPPED) in words and name in words


@pytest.mark.parametrize("name", FORMATS)
def test_halves_are_refused(tmp_path, name):
    faces = [[HALF if number == 1 else number for number in face] for face in FACES]
    (tmp_path / name).write_bytes(FORMATS[name](faces))
    for read in (read_mesh, read_painted_mesh):
        words = error_of(lambda read=read: read(tmp_path / name))
        assert name in words and ("whole numbers, not 1.5" in words or "not whole numbers alone" in words)


def test_gifti_and_arrays_follow(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    for kind, value in (("float32", HALF), ("float32", 1.0)):
        faces = np.array([[value if number == 1 else number for number in face] for face in FACES], kind)
        arrays = [
            nibabel.gifti.GiftiDataArray(POINTS.astype("f4"), "NIFTI_INTENT_POINTSET", "NIFTI_TYPE_FLOAT32"),
            nibabel.gifti.GiftiDataArray(faces, "NIFTI_INTENT_TRIANGLE", "NIFTI_TYPE_FLOAT32"),
        ]
        nibabel.save(nibabel.gifti.GiftiImage(darrays=arrays), tmp_path / "a.gii")
        if value == HALF:
            assert "whole numbers, not 1.5" in error_of(lambda: read_mesh(tmp_path / "a.gii"))
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.gii").faces, FACES)
    huge = np.array(FACES, np.uint64)
    huge[0, 0] = 2**64 - 1  # -1 as int64
    np.savez(tmp_path / "a.npz", vertices=POINTS, faces=huge)
    assert "out of range" in error_of(lambda: read_mesh(tmp_path / "a.npz"))
    for wrong in (WRAPPED, HALF):
        faces = [[wrong if number == 1 else number for number in face] for face in FACES]
        assert str(wrong) in error_of(lambda faces=faces: PaintedMesh(POINTS, np.array(faces)))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_lengths_of_lists_that_are_no_whole_numbers_are_refused(tmp_path, form):
    content = ply(FACES, "int").replace(b"uchar", b"float").replace(b"ascii", form.encode())
    (tmp_path / "a.ply").write_bytes(content)
    assert "lengths of 'vertex_indices'" in error_of(lambda: read_mesh(tmp_path / "a.ply"))
    (tmp_path / "b.ply").write_bytes(ply(FACES, "int").replace(b"\n3 ", b"\n3.5 "))
    assert "whole numbers, not 3.5" in error_of(lambda: read_mesh(tmp_path / "b.ply"))


def test_numbers_of_a_glb_are_unsigned_and_in_range(tmp_path):
    """A corner of a primitive beyond its vertices is no vertex of the next primitive."""
    binary = POINTS.astype("<f4").tobytes() + np.array([0, 2, 1, 0, 1, 7], "<u4").tobytes()
    header = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 24}],
        "buffers": [{"byteLength": len(binary)}],
    }
    words = json.dumps(header).encode()
    words += b" " * (-len(words) % 4)
    content = struct.pack("<II", len(words), 0x4E4F534A) + words + struct.pack("<II", len(binary), 0x004E4942) + binary
    path = Path(tmp_path / "a.glb")
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(content)) + content)
    assert "7" in error_of(lambda: read_painted_mesh(path))
