"""Surfaces in VTK's formats, written here as its documents describe them."""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.validate import check

BALL = shapes.icosphere(2)
# A tetrahedron, as one strip of six corners: (0 1 2), (2 1 3) turned, (2 3 0), (0 3 1) turned.
CORNERS = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]])
STRIP = [0, 1, 2, 3, 0, 1]
TRIANGLES = [[0, 1, 2], [2, 1, 3], [2, 3, 0], [0, 3, 1]]


def rows(numbers) -> str:
    return " ".join(str(number) for number in np.ravel(numbers).tolist())


def legacy(kind: str, points, sections: list[tuple[str, str, list]], binary: bool) -> bytes:
    head = f"# vtk DataFile Version 3.0\nsurface\n{'BINARY' if binary else 'ASCII'}\nDATASET {kind}\n"
    content = head.encode()
    sections = [(f"POINTS {len(points)} double", ">f8", points), *sections]
    for line, dtype, numbers in sections:
        body = np.ravel(numbers).astype(dtype).tobytes() if binary else rows(numbers).encode()
        content += line.encode() + b"\n" + body + b"\n"
    return content


@pytest.mark.parametrize("binary", [False, True])
def test_strips_are_cut_into_triangles(tmp_path, binary):
    cells = [*[len(STRIP), *STRIP], *[3, 5, 6, 4], *[3, 6, 5, 7]]
    points = np.concatenate([CORNERS, CORNERS + 2])
    content = legacy("POLYDATA", points, [("TRIANGLE_STRIPS 3 15", ">i4", cells)], binary)
    (tmp_path / "a.vtk").write_bytes(content)
    mesh = read_mesh(tmp_path / "a.vtk")
    np.testing.assert_array_equal(mesh.faces, [*TRIANGLES, [5, 6, 4], [6, 5, 7]])
    np.testing.assert_array_equal(mesh.vertices, points)
    assert check(mesh.vertices[:4], mesh.faces[:4]) in ([], check(CORNERS, TRIANGLES))


def test_a_strip_that_repeats_a_corner_has_no_triangle_there(tmp_path):
    cells = [7, 0, 1, 2, 3, 3, 0, 1]
    (tmp_path / "a.vtk").write_bytes(legacy("POLYDATA", CORNERS, [("TRIANGLE_STRIPS 1 8", ">i4", cells)], False))
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.vtk").faces, [[0, 1, 2], [2, 1, 3], [3, 0, 1]])


@pytest.mark.parametrize("binary", [False, True])
def test_flat_cells_of_an_unstructured_grid_are_read(tmp_path, binary):
    """Triangles, a polygon, a square, a pixel (row by row) and a strip; a point and a line are left out."""
    points = np.concatenate([CORNERS] * 2)
    cells = [[1, 0], [2, 0, 1], [3, 0, 1, 2], [5, 0, 1, 2, 3, 4], [4, 0, 1, 2, 3], [4, 4, 5, 6, 7], [4, 0, 1, 2, 3]]
    sections = [
        ("CELLS 7 30", ">i4", [number for cell in cells for number in cell]),
        ("CELL_TYPES 7", ">i4", [1, 3, 5, 7, 9, 8, 6]),
    ]
    (tmp_path / "a.vtk").write_bytes(legacy("UNSTRUCTURED_GRID", points, sections, binary))
    expected = [[0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 2], [0, 2, 3], [4, 5, 7], [4, 7, 6]]
    expected += [[0, 1, 2], [2, 1, 3]]
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.vtk").faces, expected)


@pytest.mark.parametrize(
    ("kind", "sections", "words"),
    [
        (
            "UNSTRUCTURED_GRID",
            [("CELLS 1 5", ">i4", [4, 0, 1, 2, 3]), ("CELL_TYPES 1", ">i4", [10])],
            "of type 10; ext",
        ),
        ("STRUCTURED_GRID", [], "of the kind STRUCTURED_GRID, which is no surface"),
        ("POLYDATA", [("POLYGONS 2 8", ">i4", [3, 0, 1, 2])], "cut short"),
        ("POLYDATA", [("POLYGONS 1000000000000 8", ">i4", [3, 0, 1, 2, 3, 0, 2, 1])], "cut short"),
        ("POLYDATA", [("POLYGONS 2 7", ">i4", [3, 0, 1, 2, 3, 0, 1])], "cut short"),
        ("POLYDATA", [("LINES 1 3", ">i4", [2, 0, 1])], "no faces in it"),
    ],
)
def test_what_is_no_surface_is_one_line(tmp_path, kind, sections, words):
    for binary in (False, True):
        (tmp_path / "a.vtk").write_bytes(legacy(kind, CORNERS, sections, binary))
        with pytest.raises(OmtwarpError, match=words) as caught:
            read_mesh(tmp_path / "a.vtk")
        assert "\n" not in str(caught.value)


def encoded(content: bytes, head: str, compressed: bool, as_text: bool) -> bytes:
    """Write an array as VTK does: its length before it; compressed, the lengths of its blocks."""
    if not compressed:
        whole = struct.pack(head, len(content)) + content
        return base64.b64encode(whole) if as_text else whole
    size = 200
    blocks = [zlib.compress(content[k : k + size]) for k in range(0, len(content), size)]
    last = len(content) % size
    lengths = b"".join(struct.pack(head, n) for n in (len(blocks), size, last, *map(len, blocks)))
    parts = [lengths, b"".join(blocks)]
    return b"".join(base64.b64encode(part) if as_text else part for part in parts)


def xml(kind: str, form: str, head: str = "<I", compressed: bool = False) -> bytes:
    """Write a ball as a VTK XML file."""
    attributes = f'type="{kind}" byte_order="LittleEndian" header_type="{"UInt64" if head == "<Q" else "UInt32"}"'
    if compressed:
        attributes += ' compressor="vtkZLibDataCompressor"'
    appended = b""

    def array(name: str, values, type_: str, dtype: str) -> bytes:
        nonlocal appended
        start = f'<DataArray type="{type_}" Name="{name}" NumberOfComponents="3" '.encode()
        if form == "ascii":
            return start + b'format="ascii">' + rows(values).encode() + b"</DataArray>\n"
        content = encoded(np.ravel(values).astype(dtype).tobytes(), head, compressed, form != "raw")
        if form == "binary":
            return start + b'format="binary">\n  ' + content + b"\n</DataArray>\n"
        place = len(appended)
        appended += content
        return start + f'format="appended" offset="{place}"/>'.encode()

    points = b"<Points>" + array("Points", BALL.vertices, "Float64", "<f8") + b"</Points>"
    cells = array("connectivity", BALL.faces, "Int32", "<i4")
    cells += array("offsets", 3 * np.arange(1, len(BALL.faces) + 1), "Int64", "<i8")
    if kind == "PolyData":
        cells = b"<Polys>" + cells + b"</Polys>"
    else:
        cells = b"<Cells>" + cells + array("types", np.full(len(BALL.faces), 5), "UInt8", "u1") + b"</Cells>"
    content = f'<?xml version="1.0"?>\n<VTKFile {attributes}><{kind}><Piece>'.encode() + points + cells
    content += f"</Piece></{kind}>".encode()
    if appended:
        encoding = b"raw" if form == "raw" else b"base64"
        content += b'<AppendedData encoding="' + encoding + b'">\n _' + appended + b"\n</AppendedData>"
    return content + b"</VTKFile>\n"


@pytest.mark.parametrize("kind", ["PolyData", "UnstructuredGrid"])
@pytest.mark.parametrize("form", ["ascii", "binary", "base64", "raw"])
@pytest.mark.parametrize(("head", "compressed"), [("<I", False), ("<Q", True)])
def test_every_form_of_vtk_xml_holds_the_same_mesh(tmp_path, kind, form, head, compressed):
    path = tmp_path / ("a.vtp" if kind == "PolyData" else "a.vtu")
    path.write_bytes(xml(kind, form, head, compressed))
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, BALL.vertices)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)


def test_damaged_vtk_xml_is_one_line(tmp_path):
    whole = xml("PolyData", "raw", "<I", True)
    bomb = b'<!DOCTYPE a [<!ENTITY b "cccccccccccccccc">]>'
    huge = xml("PolyData", "raw").replace(struct.pack("<I", BALL.vertices.nbytes), struct.pack("<I", 2**32 - 1))
    cases = {
        "cut short": xml("PolyData", "raw")[:2000],
        "definitions of its own": whole.replace(b"<VTKFile", bomb + b"<VTKFile"),
        "compressed by vtkLZ4": whole.replace(b"vtkZLib", b"vtkLZ4"),
        "of the kind ImageData": whole.replace(b'type="PolyData"', b'type="ImageData"'),
        "which is the most": huge,
        "cannot be read as vtp": b"<VTKFile",
        "do not fit": xml("PolyData", "ascii").replace(b">3 6 9", b">3 6 5"),
    }
    for words, content in cases.items():
        (tmp_path / "a.vtp").write_bytes(content)
        with pytest.raises(OmtwarpError, match=words) as caught:
            read_mesh(tmp_path / "a.vtp")
        assert "\n" not in str(caught.value)
