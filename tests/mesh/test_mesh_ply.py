"""PLY in all its forms, compared with the reader of trimesh."""

from __future__ import annotations

import io

import numpy as np
import pytest
import trimesh

from omtwarp.mesh import shapes
from omtwarp.mesh.ply import read_ply

BALL = shapes.icosphere(2)


def ply(form: str, line_end: str = "\n", index: str = "int", count: str = "uchar") -> bytes:
    """Make a PLY file of a sphere with vertex colours, a number per face, and an unknown element."""
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    vertices, faces = BALL.vertices.astype(np.float32), BALL.faces
    head = [
        "ply", f"format {form} 1.0", "comment element vertex 3", "element other 2", "property short a",
        f"element vertex {len(vertices)}", "property uchar red", "property float x", "property float y",
        "property float32 z", f"element face {len(faces)}", "property double quality",
        f"property list {count} {index} vertex_indices", "element nothing 99999999999", "end_header", "",
    ]  # fmt: skip
    content = line_end.join(head).encode()
    if not order:
        rows = ["1", "2"]
        rows += [f"7 {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
        rows += [f"0.5 3 {a} {b} {c}" for a, b, c in faces.tolist()]
        return content + line_end.join([*rows, ""]).encode()
    kinds = {"int": "i4", "ushort": "u2", "uchar": "u1"}
    rows_of_vertices = np.empty(len(vertices), [("red", "u1"), ("at", order + "f4", 3)])
    rows_of_vertices["red"], rows_of_vertices["at"] = 7, vertices
    rows_of_faces = np.empty(
        len(faces), [("quality", order + "f8"), ("n", order + kinds[count]), ("v", order + kinds[index], 3)]
    )
    rows_of_faces["quality"], rows_of_faces["n"], rows_of_faces["v"] = 0.5, 3, faces
    return content + np.array([1, 2], order + "i2").tobytes() + rows_of_vertices.tobytes() + rows_of_faces.tobytes()


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(("index", "count"), [("int", "uchar"), ("ushort", "int")])
def test_every_form_holds_the_same_mesh(form, line_end, index, count):
    points, corners, sizes, _ = read_ply(ply(form, line_end, index, count))
    np.testing.assert_array_equal(points, BALL.vertices.astype(np.float32))
    np.testing.assert_array_equal(corners.reshape(-1, 3), BALL.faces)
    assert (sizes == 3).all()


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian"])
def test_the_mesh_is_that_of_another_reader(form):
    content = ply(form).replace(b"element nothing 99999999999\n", b"")
    other = trimesh.load_mesh(io.BytesIO(content), file_type="ply", process=False)
    points, corners, *_ = read_ply(content)
    np.testing.assert_array_equal(points, other.vertices)
    np.testing.assert_array_equal(corners.reshape(-1, 3), other.faces)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("how", ["short", "long", "header", "format", "type"])
def test_what_does_not_fit_is_an_error(form, how):
    content = ply(form)
    content = {
        "short": content[:-3],
        "long": content + b" 1 2",
        "header": content.replace(b"end_header", b"end-header"),
        "format": content.replace(b"format", b"formal"),
        "type": content.replace(b"property float x", b"property quaternion x"),
    }[how]
    with pytest.raises((ValueError, KeyError)):
        read_ply(content)
