"""Arrays and nodes of glTF, as the standard says: sparse, quantised, mirrored; parts that are not read are refused."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np
import pytest

from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_joined_mesh, read_mesh
from omtwarp.mesh.validate import check
from omtwarp.render.subject import as_surface_view as drawn_mesh
from omtwarp.texturing import read_painted_mesh

BALL = shapes.icosphere(3)
TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


class File:
    """A glTF file of one mesh, put together accessor by accessor."""

    def __init__(self):
        self.binary = b""
        self.document = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {}}]}],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{}],
        }

    def view(self, content: bytes, **more) -> int:
        self.document["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content), **more}
        )
        self.binary += content + bytes(-len(content) % 4)
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values, kind: str, **more) -> int:
        values = np.asarray(values)
        shape = {1: "SCALAR", 2: "VEC2", 3: "VEC3"}[1 if values.ndim == 1 else values.shape[1]]
        self.document["accessors"].append(
            {"componentType": TYPES[kind], "count": len(values), "type": shape, **more}
            | ({} if "sparse" in more else {"bufferView": self.view(values.astype(f"<{kind}").tobytes())})
        )
        return len(self.document["accessors"]) - 1

    def mesh(self, position: int, **more) -> None:
        faces = self.accessor(BALL.faces.ravel(), "u2")
        self.document["meshes"] = [{"primitives": [{"attributes": {"POSITION": position, **more}, "indices": faces}]}]

    def write(self, path):
        if path.suffix == ".glb":
            self.document["buffers"] = [{"byteLength": len(self.binary)}]
            text = json.dumps(self.document).encode()
            text += b" " * (-len(text) % 4)
            body = struct.pack("<II", len(text), 0x4E4F534A) + text
            body += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
            path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
            return path
        if path.stem == "named":
            path.with_suffix(".bin").write_bytes(self.binary)
            uri = path.with_suffix(".bin").name
        else:
            uri = "data:application/octet-stream;base64," + base64.b64encode(self.binary).decode()
        self.document["buffers"] = [{"byteLength": len(self.binary), "uri": uri}]
        path.write_text(json.dumps(self.document))
        return path


def read_everywhere(path) -> tuple[np.ndarray, np.ndarray]:
    """Read a file by the three readers, which agree."""
    mesh, painted, drawn = read_mesh(path), read_painted_mesh(path), drawn_mesh(path)
    for other in (painted, drawn):
        np.testing.assert_array_equal(np.sort(other.vertices[other.faces], axis=1), np.sort(corners(mesh), axis=1))
        assert signed_volume(other.vertices, other.faces) * signed_volume(mesh.vertices, mesh.faces) > 0
    return mesh.vertices, mesh.faces


def corners(mesh) -> np.ndarray:
    return mesh.vertices[mesh.faces]


def signed_volume(vertices, faces) -> float:
    return float(np.linalg.det(np.asarray(vertices)[np.asarray(faces)]).sum() / 6)


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "named.gltf"])
@pytest.mark.parametrize("base", [True, False])
def test_sparse_arrays_replace_rows(tmp_path, name, base):
    """Rows of an array, or of zeros where there is none, are replaced by those of the sparse part."""
    file = File()
    moved = np.array([3, 7, 40])
    values = (BALL.vertices[moved] * 1.25).astype("<f4")
    if not base:
        moved, values = np.arange(BALL.vertex_count), BALL.vertices.astype("<f4")
    sparse = {
        "count": len(moved),
        "indices": {"bufferView": file.view(moved.astype("<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": file.view(bytes(8) + values.tobytes()), "byteOffset": 8},
    }
    accessor = file.accessor(BALL.vertices, "f4", sparse=sparse)
    expected = np.zeros((BALL.vertex_count, 3), "f4")
    if base:
        content = np.zeros((BALL.vertex_count, 5), "<f4")  # rows two numbers apart
        content[:, :3] = expected = BALL.vertices.astype("f4")
        view = file.view(content.tobytes()[:-8], byteStride=20)
        file.document["accessors"][accessor]["bufferView"] = view
    expected = expected.copy()
    expected[moved] = values
    file.mesh(accessor)
    vertices, faces = read_everywhere(file.write(tmp_path / name))
    np.testing.assert_array_equal(vertices, expected)
    np.testing.assert_array_equal(faces, BALL.faces)


def test_sparse_faces_and_damaged_sparse_arrays(tmp_path):
    def written(rows, count: int):
        file = File()
        position = file.accessor(BALL.vertices, "f4")
        file.mesh(position)
        corner = np.array([int(BALL.faces[0, 0])] * len(rows), "<u2")
        indices = {"bufferView": file.view(np.asarray(rows, "<u4").tobytes()), "componentType": 5125}
        values = {"bufferView": file.view(corner.tobytes())}
        file.document["accessors"][1]["sparse"] = {"count": count, "indices": indices, "values": values}
        return file.write(tmp_path / "a.glb")

    np.testing.assert_array_equal(read_mesh(written([5], 1)).faces.ravel()[5], BALL.faces[0, 0])
    for rows, count in (([10**6], 1), ([5], 3), ([5], -1)):
        with pytest.raises(OmtwarpError) as caught:
            read_mesh(written(rows, count))
        assert "\n" not in str(caught.value)
    file = File()
    file.mesh(file.accessor(BALL.vertices, "f4", sparse={}))
    file.document["accessors"][0]["count"] = 10**12
    with pytest.raises(OmtwarpError, match="which is the most"):
        read_mesh(file.write(tmp_path / "a.glb"))


@pytest.mark.parametrize(("kind", "most"), [("i2", 32767), ("i1", 127), ("u2", 65535), ("u1", 255)])
def test_normalised_whole_numbers_are_divided_by_the_largest(tmp_path, kind, most):
    """Positions of a quarter of the ball's size come back so, and coordinates of a texture lie in [0, 1]."""
    low, scale = (0, most) if kind.startswith("u") else (-most - 1, most)
    points = np.clip(np.rint((0.5 * BALL.vertices + 0.5 * kind.startswith("u")) * scale), low, most)
    uv = np.clip(np.rint((0.5 + 0.5 * BALL.vertices[:, :2]) * most), 0, most)
    file = File()
    position = file.accessor(points, kind, normalized=True)
    file.mesh(position, TEXCOORD_0=file.accessor(uv, kind, normalized=True))
    file.document["materials"] = [{"name": "plain"}]
    file.document["meshes"][0]["primitives"][0]["material"] = 0
    file.document["extensionsRequired"] = file.document["extensionsUsed"] = ["KHR_mesh_quantization"]
    path = file.write(tmp_path / "a.glb")
    mesh, painted = read_mesh(path), read_painted_mesh(path)
    np.testing.assert_allclose(mesh.vertices, np.maximum(points / most, -1), rtol=1e-7, atol=0)
    np.testing.assert_array_equal(mesh.faces, BALL.faces)
    at_corner = uv[BALL.faces] / most
    at_corner[..., 1] = 1 - at_corner[..., 1]
    np.testing.assert_allclose(painted.uv, at_corner, rtol=0, atol=1e-7)


def test_whole_numbers_that_are_not_normalised_are_as_they_are(tmp_path):
    file = File()
    file.mesh(file.accessor(np.rint(100 * BALL.vertices), "i1"))
    vertices, _ = read_everywhere(file.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(vertices, np.rint(100 * BALL.vertices))


def test_primitives_that_share_their_vertices_are_one_surface(tmp_path):
    """As writers of several materials on one geometry have it: every primitive names all vertices, and uses some."""
    file, half = File(), BALL.face_count // 2
    shared = {"POSITION": file.accessor(BALL.vertices, "f4"), "TEXCOORD_0": file.accessor(BALL.vertices[:, :2], "f4")}
    parts = [file.accessor(part.ravel(), "u2") for part in (BALL.faces[:half], BALL.faces[half:])]
    file.document["materials"] = [{"name": "one"}, {"name": "other"}]
    file.document["meshes"][0]["primitives"] = [
        {"attributes": shared, "indices": part, "material": number} for number, part in enumerate(parts)
    ]
    path = file.write(tmp_path / "a.glb")
    joined, painted = read_joined_mesh(path), read_painted_mesh(path)
    for mesh in (joined, painted):
        assert len(mesh.vertices) == BALL.vertex_count and check(mesh.vertices, mesh.faces) == []
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], BALL.vertices.astype("f4")[BALL.faces])
    np.testing.assert_allclose(painted.uv, [0, 1] + [1, -1] * painted.vertices[painted.faces][..., :2], atol=1e-6)
    assert np.bincount(painted.face_material).tolist() == [half, BALL.face_count - half]


@pytest.mark.parametrize("node", [{"scale": [-1, 2, 1]}, {"scale": [-1, -1, -1]}, {"scale": [-1, -1, 1]}])
def test_a_mirror_image_turns_its_faces(tmp_path, node):
    file = File()
    file.mesh(file.accessor(BALL.vertices, "f4"))
    file.document["nodes"] = [{"mesh": 0, **node}]
    vertices, faces = read_everywhere(file.write(tmp_path / "a.glb"))
    assert check(vertices, faces) == []
    np.testing.assert_allclose(vertices, BALL.vertices.astype("f4") * node["scale"], rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "of_pictures"),
    [("KHR_draco_mesh_compression", False), ("VENDOR_new", False), ("KHR_texture_basisu", True)],
)
def test_a_required_part_that_is_not_read_is_refused(tmp_path, name, of_pictures):
    file = File()
    file.mesh(file.accessor(BALL.vertices, "f4"))
    file.document["extensionsUsed"] = file.document["extensionsRequired"] = [name]
    path = file.write(tmp_path / "a.glb")
    readers = [read_painted_mesh, drawn_mesh]
    if of_pictures:
        np.testing.assert_array_equal(read_mesh(path).faces, BALL.faces)
    else:
        readers.append(read_mesh)
    for read in readers:
        with pytest.raises(OmtwarpError, match=f"needs {name}, which is not read"):
            read(path)
