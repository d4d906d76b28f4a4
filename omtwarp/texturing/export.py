"""Writing textured meshes: GLB, OBJ with MTL and PNG, and PLY with colours at the vertices.

The files appear once all of them are complete, so that a failure, a full disk or Ctrl-C leaves the old ones or none.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import as_path, companion, staged
from omtwarp.options import TextureFormat, choose
from omtwarp.texturing.gltf import GltfFile, flipped_rows, single_precision
from omtwarp.texturing.image import png_bytes
from omtwarp.texturing.mesh import ROUGHNESS

SUFFIXES = (".glb", ".obj", ".ply")


class Exportable(Protocol):
    """A mesh cut along the seams of its texture: :class:`omtwarp.texturing.mesh.TexturedMesh` has the attributes."""

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
    """Check that a textured mesh can be written to a path, and return the path's suffix in lower case.

    Raises:
        OmtwarpError: another suffix.
    """
    suffix = as_path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise OmtwarpError(
            f"cannot write '{path}': a textured mesh is written as .glb, .obj (with .mtl and .png) or .ply"
        )
    return suffix


def export(
    textured: Exportable,
    path: str | os.PathLike[str],
    *,
    keep: Iterable[Path | None] = (),
    texture_format: str = TextureFormat.PNG,
) -> list[Path]:
    """Write a textured surface in the format of the path's suffix.

    Args:
        textured: the surface and its texture.
        path: the file to write. The material and the picture of an OBJ get free names in the same folder, or those of
            files that the package wrote there before.
        keep: files that must not be replaced, such as inputs.
        texture_format: ``png`` or, in a .glb, ``webp``.

    Returns:
        The files written, the named one last.

    Raises:
        OmtwarpError: another suffix or format, a place that cannot be written to, a full disk.
    """
    suffix = check_suffix(path)
    encoding = format_for(suffix, texture_format)
    kept = (*keep, textured.source_image)
    with staged(path, keep=kept) as file:
        if suffix == ".glb":
            files = [(file, glb_bytes(textured, encoding))]
        elif suffix == ".ply":
            files = [(file, ply_bytes(textured))]
        else:
            files = obj_files(textured, file, keep=kept)
        for name, content in files:
            name.write_bytes(content)
    return [as_path(path).with_name(name.name) for name, _ in files[:-1]] + [as_path(path)]


def format_for(suffix: str, texture_format: str) -> TextureFormat:
    """Check the encoding of pictures in files of a suffix, and return it.

    Raises:
        OmtwarpError: an unknown encoding, or WebP in another file than .glb.
    """
    chosen = choose(TextureFormat, texture_format)
    if chosen is TextureFormat.WEBP and suffix != ".glb":
        raise OmtwarpError(f"WebP textures are for .glb: '{suffix}' has PNG, or colours at vertices")
    return chosen


def glb_bytes(textured: Exportable, texture_format: TextureFormat = TextureFormat.PNG) -> bytes:
    """Encode a textured mesh as a binary glTF 2.0 file.

    One mesh, one PBR material with the texture embedded, lit from any side the same way.
    """
    file = GltfFile(textured.wraps, textured.wraps_rows, texture_format)
    attributes = {
        "POSITION": file.accessor(single_precision(textured.vertices, "positions"), bounds=True),
        "NORMAL": file.accessor(single_precision(textured.normals, "normals")),
        "TEXCOORD_0": file.accessor(flipped_rows(textured.uv)),
    }
    primitive = {"attributes": attributes, "indices": file.accessor(textured.faces.ravel().astype(np.uint32))}
    material = {
        "name": "texture",
        "pbrMetallicRoughness": {
            "baseColorTexture": file.texture(textured.image, "texture"),
            "baseColorFactor": [1.0, 1.0, 1.0, 1.0],
            "metallicFactor": 0.0,
            "roughnessFactor": ROUGHNESS,
        },
        "alphaMode": "OPAQUE" if textured.image.shape[2] == 3 else "BLEND",
        "doubleSided": False,
    }
    return file.content([primitive], [material])


def _lines(prefix: str, rows: NDArray, form: str) -> str:
    """Write an array's rows as lines of text, with one format for all, which is much faster than a call per line."""
    pattern = prefix + " " + " ".join([form] * rows.shape[1]) + "\n"
    return (pattern * len(rows)) % tuple(rows.ravel().tolist())


def obj_files(textured: Exportable, place: Path, *, keep: Iterable[Path | None] = ()) -> list[tuple[Path, bytes]]:
    """Return the files of an OBJ: its picture and material first, the OBJ last.

    Positions and normals are written once per vertex of the uncut mesh (the input's vertices first, in their order);
    only texture coordinates are doubled along the seams, as the format allows.
    """
    # Names without spaces, at which readers of these files end a name.
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
        "# omtwarp",
        "newmtl texture",
        "Ka 1.000 1.000 1.000",
        "Kd 1.000 1.000 1.000",
        "Ks 0.000 0.000 0.000",
        "d 1.0",
        "illum 1",
        f"Pr {ROUGHNESS}",
        "Pm 0.0",
        f"map_Kd {picture.name}",  # no options: several readers take them as a part of the name
        "",
    ]
    return [(picture, png_bytes(textured.image)), (material, "\n".join(lines).encode()), (place, text.encode())]


def ply_bytes(textured: Exportable) -> bytes:
    """Return a binary PLY of the **input's** vertices and faces, unchanged and in order, with a colour per vertex."""
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
