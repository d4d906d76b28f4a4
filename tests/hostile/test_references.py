"""Files that a mesh file names: regular ones in its folder, pictures of six formats, one line for all others."""

from __future__ import annotations

import base64
import json
import os
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import omtwarp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import shapes
from omtwarp.mesh.read import read_mesh
from omtwarp.render import preview
from omtwarp.texturing.image import FORMATS, png_bytes
from omtwarp.texturing.read import read_painted_mesh

BALL = shapes.icosphere(2)
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\nshowpage\n%%EOF\n"
PNG = png_bytes(np.full((8, 8, 3), (200, 30, 30), np.uint8))


def gltf(picture: dict, buffer: str | None = None) -> dict:
    """Return the JSON of a ball with a picture; its arrays in the file, or in a file of their own."""
    places = BALL.vertices.astype("<f4").tobytes()
    corners = BALL.faces.astype("<u4").tobytes()
    coordinates = (BALL.vertices[:, :2] / 2 + 0.5).astype("<f4").tobytes()
    parts, views, start = (places, corners, coordinates), [], 0
    for part in parts:
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(part)})
        start += len(part)
    count = len(BALL.vertices)
    inside = "data:application/octet-stream;base64," + base64.b64encode(b"".join(parts)).decode()
    return {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "buffers": [{"byteLength": start, "uri": buffer or inside}],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3 * len(BALL.faces), "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": count, "type": "VEC2"},
        ],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]},
        ],
        "images": [picture], "textures": [{"source": 0}],
        "materials": [{"name": "skin", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    }  # fmt: skip


def write_gltf(folder: Path, picture: dict, buffer: str | None = None) -> Path:
    file = folder / "ball.gltf"
    file.write_text(json.dumps(gltf(picture, buffer)), "utf-8")
    return file


def write_obj(folder: Path, name: str) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in BALL.vertices] + ["vt 0 0", "usemtl skin"]
    lines += ["f " + " ".join(f"{k}/1" for k in face + 1) for face in BALL.faces]
    (folder / "ball.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n", "utf-8")
    (folder / "ball.obj").write_text("\n".join(["mtllib ball.mtl", *lines]), "utf-8")
    return folder / "ball.obj"


def write_ply(folder: Path, name: str) -> Path:
    head = [
        "ply", "format ascii 1.0", f"comment TextureFile {name}", f"element vertex {len(BALL.vertices)}",
        *(f"property float {axis}" for axis in "xyzst"), f"element face {len(BALL.faces)}",
        "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    rows = [f"{x} {y} {z} 0.5 0.5" for x, y, z in BALL.vertices] + [f"3 {a} {b} {c}" for a, b, c in BALL.faces]
    (folder / "ball.ply").write_text("\n".join([*head, *rows]) + "\n", "utf-8")
    return folder / "ball.ply"


def write_gifti(folder: Path, name: str) -> Path:
    arrays = []
    for intent, kind, values in (
        ("POINTSET", "FLOAT32", BALL.vertices.astype("<f4")), ("TRIANGLE", "INT32", BALL.faces.astype("<i4"))
    ):  # fmt: skip
        (folder / f"{intent}.bin").write_bytes(values.tobytes())
        place = name if intent == "POINTSET" else "TRIANGLE.bin"
        arrays.append(
            f'<DataArray Intent="NIFTI_INTENT_{intent}" DataType="NIFTI_TYPE_{kind}" '
            f'ArrayIndexingOrder="RowMajorOrder" Dimensionality="2" Dim0="{len(values)}" Dim1="3" '
            f'Encoding="ExternalFileBinary" Endian="LittleEndian" ExternalFileName="{place}" ExternalFileOffset="0">'
            "<MetaData/><Data/></DataArray>"
        )
    text = f'<?xml version="1.0"?><GIFTI Version="1.0" NumberOfDataArrays="2">{"".join(arrays)}</GIFTI>'
    (folder / "ball.surf.gii").write_text(text, "utf-8")
    return folder / "ball.surf.gii"


@pytest.fixture
def place(tmp_path):
    """A folder of a mesh, with a picture, a pipe and a link that leads out of it to a file of the user's."""
    folder = tmp_path / "mesh"
    folder.mkdir()
    (folder / "own.png").write_bytes(PNG)
    (tmp_path / "private.png").write_bytes(PNG)
    (tmp_path / "private.bin").write_bytes(BALL.vertices.astype("<f4").tobytes())
    if hasattr(os, "mkfifo"):
        os.mkfifo(folder / "pipe")
    (folder / "link").symlink_to(tmp_path / "private.png")
    return folder


WRITERS = {"obj": write_obj, "ply": write_ply, "gltf picture": lambda folder, name: write_gltf(folder, {"uri": name})}


@pytest.mark.parametrize("kind", WRITERS)
def test_a_picture_in_the_folder_is_read(place, kind):
    mesh = read_painted_mesh(WRITERS[kind](place, "own.png"))
    assert np.array_equal(mesh.materials[0].picture, np.full((8, 8, 3), (200, 30, 30), np.uint8))


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("name", ["link", "pipe"])
def test_other_references_are_one_line(place, kind, name):
    """A pipe is not waited for, and no link leads out of the folder."""
    if not os.path.lexists(place / name):
        pytest.skip("no pipes here")
    with pytest.raises(OmtwarpError, match=r"names .*(outside of its folder|not a regular file)"):
        read_painted_mesh(WRITERS[kind](place, name))


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("name", ["../private.png", "{}/private.png"])
def test_a_picture_elsewhere_is_not_read(place, kind, name):
    mesh = read_painted_mesh(WRITERS[kind](place, name.format(place.parent)))
    assert mesh.materials[0].picture is None


def test_buffers_elsewhere_are_one_line(place):
    content = b"".join(
        [BALL.vertices.astype("<f4").tobytes(), BALL.faces.astype("<u4").tobytes(), bytes(8 * len(BALL.vertices))]
    )
    for folder in (place, place.parent):
        (folder / ("own.bin" if folder == place else "secret.bin")).write_bytes(content)
    assert np.allclose(read_mesh(write_gltf(place, {"uri": "own.png"}, "own.bin")).vertices, BALL.vertices, atol=1e-6)
    for name in ("../secret.bin", str(place.parent / "secret.bin"), "link", "pipe", "gone.bin"):
        with pytest.raises(OmtwarpError, match="names "):
            read_mesh(write_gltf(place, {"uri": "own.png"}, name))


def test_gifti_reads_arrays_of_its_folder_alone(place):
    pytest.importorskip("nibabel")
    assert np.allclose(read_mesh(write_gifti(place, "POINTSET.bin")).vertices, BALL.vertices, atol=1e-6)
    for name in ("../private.bin", str(place.parent / "private.bin"), "link", "pipe", "gone.bin", "/dev/zero"):
        with pytest.raises(OmtwarpError, match="names "):
            read_mesh(write_gifti(place, name))


def test_no_program_is_started_for_a_picture(place, monkeypatch):
    """Encapsulated PostScript, which Pillow gives to Ghostscript, is refused in every format of meshes."""
    (place / "own.png").write_bytes(EPS)
    started = []
    monkeypatch.setattr("subprocess.Popen.__init__", lambda *words, **more: started.append(words))
    embedded = {"uri": "data:image/png;base64," + base64.b64encode(EPS).decode()}
    files = [write_obj(place, "own.png"), write_ply(place, "own.png"), write_gltf(place, embedded)]
    for file in files:
        for read in (read_painted_mesh, lambda name: preview(name, size=(16, 16), backend="warp")):
            with pytest.raises(OmtwarpError, match=r"not a picture in a format that can be read \(PNG, "):
                read(file)
    read_mesh(files[2])  # the triangles alone, for which no picture is opened
    assert started == []


def test_pictures_are_opened_in_one_place():
    """No other module calls Pillow's ``open``, and trimesh is given none to open."""
    package = Path(omtwarp.__file__).parent
    calls = [
        file.name for file in package.rglob("*.py") if re.search(r"\b(Image|pil)\.open\(", file.read_text("utf-8"))
    ]
    assert calls == ["inputs.py"]
    assert len(FORMATS) == 6


def test_trimesh_opens_no_picture(place, monkeypatch):
    """Of a .glb with a picture, every call of Pillow's ``open`` has the list of formats."""
    document = gltf({"uri": "own.png"})
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    glb = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text
    (place / "ball.glb").write_bytes(glb)
    (place / "own.png").write_bytes(PNG)
    calls, real = [], Image.open
    monkeypatch.setattr(Image, "open", lambda *words, **more: calls.append(more) or real(*words, **more))
    read_mesh(place / "ball.glb")
    assert calls == []
    preview(place / "ball.glb", size=(16, 16), backend="warp")
    assert calls == [{"formats": FORMATS}]
