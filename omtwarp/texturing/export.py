"""Writing textured meshes: GLB, OBJ with MTL and PNG, and PLY with colours at the vertices.

The files appear when all of them are whole, so that a failure, a full disk or Ctrl-C leaves the old ones or none.
"""

from __future__ import annotations

import io
import json
import os
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import MARK, as_path, companion, staged

SUFFIXES = (".glb", ".obj", ".ply")
REPEAT, CLAMP = 10497, 33071  # glTF 2.0, sampler.wrapS and wrapT
LINEAR, LINEAR_MIPMAP_LINEAR = 9729, 9987
FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


class Exportable(Protocol):
    """A mesh cut along the seams of its texture: :class:`omtwarp.texturing.mesh.TexturedMesh` says what is what."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    uv: NDArray[np.float64]
    normals: NDArray[np.float64]
    image: NDArray[np.uint8]
    welded: NDArray[np.int32]
    original_vertices: NDArray[np.float64]
    original_faces: NDArray[np.int32]
    source_image: Path | None

    @property
    def wraps(self) -> bool:
        """Whether the image repeats to the right."""

    @property
    def wraps_rows(self) -> bool:
        """Whether it repeats upwards."""

    @property
    def original_vertex_count(self) -> int:
        """How many vertices the input has."""

    @property
    def vertex_colours(self) -> NDArray[np.uint8]:
        """Colours of the texture at the input's vertices, uint8, shape [V, 4]."""


def check_suffix(path: str | os.PathLike[str]) -> str:
    """The suffix of a textured mesh that can be written, lower case.

    Raises:
        OmtwarpError: another suffix.
    """
    suffix = as_path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise OmtwarpError(
            f"cannot write '{path}': a textured mesh is written as .glb, .obj (with .mtl and .png) or .ply"
        )
    return suffix


def export(textured: Exportable, path: str | os.PathLike[str], *, keep: Iterable[Path | None] = ()) -> list[Path]:
    """Write a textured surface in the format of the path's suffix.

    Args:
        textured: the surface and its texture.
        path: the file to write. The material and the picture of an OBJ get names beside it that are free, or those of
            files that the package wrote there before.
        keep: files that must not be replaced, such as inputs.

    Returns:
        The files written, the named one last.

    Raises:
        OmtwarpError: another suffix, a place that cannot be written to, a full disk.
    """
    suffix = check_suffix(path)
    kept = (*keep, textured.source_image)
    with staged(path, keep=kept) as file:
        if suffix == ".glb":
            files = [(file, glb_bytes(textured))]
        elif suffix == ".ply":
            files = [(file, ply_bytes(textured))]
        else:
            files = obj_files(textured, file, keep=kept)
        for name, content in files:
            name.write_bytes(content)
    return [as_path(path).with_name(name.name) for name, _ in files[:-1]] + [as_path(path)]


def png_bytes(image: NDArray[np.uint8]) -> bytes:
    """An image as a PNG file."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    stream = io.BytesIO()
    level = 4 if image.size < 30_000_000 else 3  # a tenth more bytes than at Pillow's 6, in a third of the time
    origin = PngInfo()
    origin.add_text("Software", MARK.decode())  # tells a later run that the file may be replaced
    Image.fromarray(image).save(stream, format="PNG", compress_level=level, pnginfo=origin)
    return stream.getvalue()


def _single(name: str, values: NDArray[np.float64]) -> NDArray[np.float32]:
    largest = float(np.abs(values).max(initial=0.0))
    if largest > np.finfo(np.float32).max:
        raise OmtwarpError(
            f"cannot write {name} up to {largest:.3g} as GLB, which holds 32-bit numbers: scale the mesh down"
        )
    return np.ascontiguousarray(values, dtype=np.float32)


def glb_bytes(textured: Exportable) -> bytes:
    """A binary glTF 2.0 file: one mesh, one PBR material with the texture embedded, lit from any side the same way."""
    position = _single("positions", textured.vertices)
    normal = _single("normals", textured.normals)
    # glTF's texture coordinates have their origin at the top left.
    uv = np.ascontiguousarray(np.stack([textured.uv[:, 0], 1.0 - textured.uv[:, 1]], axis=1), dtype=np.float32)
    index = np.ascontiguousarray(textured.faces, dtype=np.uint32)
    opaque = textured.image.shape[2] == 3
    blob = bytearray()
    views: list[dict[str, Any]] = []

    def view(content: bytes, target: int | None = None) -> int:
        blob.extend(b"\0" * (-len(blob) % 4))
        entry: dict[str, Any] = {"buffer": 0, "byteOffset": len(blob), "byteLength": len(content)}
        if target is not None:
            entry["target"] = target
        views.append(entry)
        blob.extend(content)
        return len(views) - 1

    def accessor(array: NDArray, kind: str, component: int, target: int, bounds: bool = False) -> dict[str, Any]:
        count = array.size if kind == "SCALAR" else len(array)
        entry: dict[str, Any] = {
            "bufferView": view(array.tobytes(), target),
            "componentType": component,
            "count": count,
            "type": kind,
        }
        if bounds:
            entry["min"] = [float(x) for x in array.min(axis=0)]
            entry["max"] = [float(x) for x in array.max(axis=0)]
        return entry

    accessors = [
        accessor(position, "VEC3", FLOAT, ARRAY_BUFFER, bounds=True),
        accessor(normal, "VEC3", FLOAT, ARRAY_BUFFER),
        accessor(uv, "VEC2", FLOAT, ARRAY_BUFFER),
        accessor(index, "SCALAR", UNSIGNED_INT, ELEMENT_ARRAY_BUFFER),
    ]
    picture = view(png_bytes(textured.image))
    document = {
        "asset": {"version": "2.0", "generator": "omtwarp"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface"}],
        "meshes": [
            {
                "name": "surface",
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2},
                        "indices": 3,
                        "material": 0,
                        "mode": 4,
                    }
                ],
            }
        ],
        "materials": [
            {
                "name": "texture",
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0, "texCoord": 0},
                    "baseColorFactor": [1.0, 1.0, 1.0, 1.0],
                    "metallicFactor": 0.0,
                    "roughnessFactor": 0.65,
                },
                "alphaMode": "OPAQUE" if opaque else "BLEND",
                "doubleSided": False,
            }
        ],
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [
            {
                "magFilter": LINEAR,
                "minFilter": LINEAR_MIPMAP_LINEAR,
                "wrapS": REPEAT if textured.wraps else CLAMP,  # u runs around the sphere
                # On a sphere repeating here would let the poles bleed into each other.
                "wrapT": REPEAT if textured.wraps_rows else CLAMP,
            }
        ],
        "images": [{"bufferView": picture, "mimeType": "image/png", "name": "texture"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob) + -len(blob) % 4}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    blob.extend(b"\0" * (-len(blob) % 4))
    total = 12 + 8 + len(text) + 8 + len(blob)
    head = struct.pack("<4sII", b"glTF", 2, total)
    return (
        head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + bytes(blob)
    )


def _lines(prefix: str, rows: NDArray, form: str) -> str:
    """Rows as lines of text; one format for the whole array is much quicker than a call per line."""
    pattern = prefix + " " + " ".join([form] * rows.shape[1]) + "\n"
    return (pattern * len(rows)) % tuple(rows.ravel().tolist())


def obj_files(textured: Exportable, place: Path, *, keep: Iterable[Path | None] = ()) -> list[tuple[Path, bytes]]:
    """An OBJ with its material and picture, the OBJ last.

    Positions and normals are written once per vertex of the uncut mesh (the input's vertices first, in their order);
    only texture coordinates are doubled along the seams, as the format allows.
    """
    # Names without spaces: readers end those in these files at one.
    material, picture = companion(place, ".mtl", keep), companion(place, ".png", keep)
    count = int(textured.welded.max(initial=-1)) + 1
    first = np.zeros(count, dtype=np.int64)
    first[textured.welded[::-1]] = np.arange(len(textured.welded))[::-1]
    v, vt = textured.welded[textured.faces] + 1, textured.faces + 1
    corners = np.stack([v, vt, v], axis=2).reshape(len(v), 9)
    face = "f %d/%d/%d %d/%d/%d %d/%d/%d\n"
    text = "".join(
        [
            "# omtwarp: surface with a texture from its area-preserving map\n",
            f"# the first {textured.original_vertex_count} vertices are those of the input, in its order\n",
            f"mtllib {material.name}\no surface\n",
            _lines("v", textured.vertices[first], "%.9g"),
            _lines("vt", textured.uv, "%.8f"),
            _lines("vn", textured.normals[first], "%.5f"),
            "usemtl texture\ns 1\n",
            (face * len(corners)) % tuple(corners.ravel().tolist()),
        ]
    )
    lines = [
        f"# {MARK.decode()}",
        "newmtl texture",
        "Ka 1.000 1.000 1.000",
        "Kd 1.000 1.000 1.000",
        "Ks 0.000 0.000 0.000",
        "d 1.0",
        "illum 1",
        "Pr 0.65",
        "Pm 0.0",
        f"map_Kd {picture.name}",  # no options: several readers take them for a part of the name
        "",
    ]
    return [(picture, png_bytes(textured.image)), (material, "\n".join(lines).encode()), (place, text.encode())]


def ply_bytes(textured: Exportable) -> bytes:
    """A binary PLY of the **input's** vertices and faces, unchanged and in their order, with a colour per vertex."""
    vertices, faces = textured.original_vertices, textured.original_faces
    record = np.dtype(
        [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), ("alpha", "u1")]
    )
    rows = np.empty(len(vertices), dtype=record)
    for k, name in enumerate("xyz"):
        rows[name] = vertices[:, k]
    colours = textured.vertex_colours
    for k, name in enumerate(("red", "green", "blue", "alpha")):
        rows[name] = colours[:, k]
    triangles = np.empty(len(faces), dtype=np.dtype([("n", "u1"), ("v", "<i4", (3,))]))
    triangles["n"], triangles["v"] = 3, faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment omtwarp: colours of a texture on the area-preserving map",
        f"element vertex {len(vertices)}",
        *(f"property double {name}" for name in "xyz"),
        *(f"property uchar {name}" for name in ("red", "green", "blue", "alpha")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    return "\n".join(header).encode() + rows.tobytes() + triangles.tobytes()
