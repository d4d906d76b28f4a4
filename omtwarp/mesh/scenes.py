"""Reading formats of whole scenes (glTF, OBJ with materials, 3MF, ...) through trimesh, within the package's limits."""

from __future__ import annotations

import io
import json
import logging
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import file_beside, read_bytes
from omtwarp.files.limits import LARGEST_MESH_FILE, amount
from omtwarp.files.memory import memory_for_file
from omtwarp.mesh.accessors import Document, pictures_of, with_document, with_plain_accessors

if TYPE_CHECKING:
    import trimesh

# Of what trimesh reads, those that open no other file themselves, as readers of archives and of simulations do.
_SCENES = {"glb", "gltf", "dae", "3mf", "xaml", "ctm", "json"}
ROLES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")
# Parts of glTF that are read, or that change nothing about triangles and little about their look.
_READ = ("KHR_mesh_quantization", "EXT_texture_webp", "KHR_materials_", "KHR_lights_")
# Parts that change where a picture lies or how it is stored, and nothing about triangles.
_OF_PICTURES = ("KHR_texture_", "EXT_texture_", "MSFT_texture_")


class MissingFile(OmtwarpError):
    """A file that a mesh file names is not there."""


def scene_formats() -> set[str]:
    """Return the suffixes, without the dot, of the formats that :func:`load_scene` reads."""
    import trimesh

    return set(trimesh.available_formats()) & _SCENES


def load_scene(data: bytes, file: Path, suffix: str, *, pictures: bool = True) -> trimesh.Scene:
    """Read a scene, with the files that it names in its directory or below.

    Args:
        data: the file's content.
        file: where it came from; files that it names are looked for in its directory.
        suffix: its format.
        pictures: whether its pictures matter, so that a part that they need and that is not read is refused.

    Returns:
        A ``trimesh.Scene`` with vertices as the file has them, and without any picture: trimesh would have them opened
        in every format there is, some of them by programs of the system. glTF materials are called by their numbers.

    Raises:
        OmtwarpError: a part of glTF that the file requires and that is not read, such as compressed geometry; an
            archive that inflates too far; or a file that it names and that cannot be read.
        Exception: what trimesh raises on a damaged file.
    """
    import trimesh
    from trimesh.resolvers import Resolver

    class Buffers(Resolver):
        """The files that a glTF file names as its arrays; no other format may ask for a file."""

        def __init__(self) -> None:
            """Begin with no file, as trimesh asks for them by name."""

        def get(self, name: str) -> bytes:
            if suffix != "gltf":
                raise OmtwarpError(f"names '{name}', which is not read with a .{suffix}")
            return named(name)

        def namespaced(self, _namespace: str) -> Buffers:
            return self

        def keys(self) -> list[str]:
            return []

        def write(self, name: str, data: object) -> None:
            raise OmtwarpError(f"{name}: not written, as the scene is only read")

    named = reader_beside(file)
    if suffix in ("glb", "gltf"):
        header = gltf_header(data, suffix)
        _require_read(header, (*_READ, *(() if pictures else _OF_PICTURES)))
        data = with_plain_accessors(data, header, suffix == "glb", named)
        if header.pop("images", None) or header.get("materials"):
            for number, material in enumerate(header.get("materials", [])):
                material["name"] = str(number)
            data = with_document(data, header, suffix == "glb")
    if data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
        if total > LARGEST_MESH_FILE:
            raise OmtwarpError(f"inflates to {amount(total)}, and {amount(LARGEST_MESH_FILE)} is the most")
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # its errors contain the same information
    with memory_for_file(len(data)):
        return trimesh.load_scene(io.BytesIO(data), file_type=suffix, resolver=Buffers(), process=False)


def reader_beside(file: Path) -> Callable[[str], bytes]:
    """Return a function that reads a file that a mesh file names, in its directory or below.

    The function raises an OmtwarpError where the file is elsewhere, is no regular file, or is not there.
    """

    def read(name: str) -> bytes:
        there = file_beside(file, unquote(name))
        if there is None:
            raise MissingFile(f"names '{name}', which is not there")
        return read_bytes(there, LARGEST_MESH_FILE)

    return read


def gltf_pictures(data: bytes, file: Path, suffix: str) -> list[dict[str, bytes]]:
    """Return the encoded pictures of every material of a glTF file by the names of their roles.

    Pictures that are not there are left out, and so are those of formats that glTF 2.0 does not know.

    Raises:
        OmtwarpError: the file names one that is elsewhere than in its directory, or is no regular file.
        LookupError: the document refers to what is not there.
    """
    document = gltf_header(data, suffix)
    picture = pictures_of(data, document, suffix == "glb", reader_beside(file))
    known: dict[int, bytes | None] = {}
    pictures: list[dict[str, bytes]] = []
    for material in document.get("materials", []):
        uses: dict[str, object] = {**material.get("pbrMetallicRoughness", {}), **material}
        pictures.append({})
        for role in ROLES:
            used = uses.get(role)
            number = _image_of(document, used["index"]) if isinstance(used, dict) and "index" in used else None
            if number is None:
                continue
            if number not in known:
                try:
                    known[number] = picture(number)
                except MissingFile:
                    known[number] = None
            content = known[number]
            if content:
                pictures[-1][role] = content
    return pictures


def _image_of(document: Document, texture: int) -> int | None:
    """Return the number of a texture's picture, as WebP where it has it so; None where it has none."""
    entry = document["textures"][texture]
    return entry.get("extensions", {}).get("EXT_texture_webp", entry).get("source")


def gltf_header(data: bytes, suffix: str) -> Document:
    """Return the JSON of a glTF file (glTF 2.0 specification, section 4.4).

    Raises:
        OmtwarpError: the file is shorter than its header says.
        ValueError: it is no such file.
    """
    if suffix == "gltf":
        return _document(data)
    magic, _, length, size, _ = struct.unpack("<4sIIII", data[:20].ljust(20, b"\0"))
    if magic != b"glTF":
        raise ValueError("no header of a binary glTF file")
    if len(data) < length or len(data) < 20 + size:
        raise OmtwarpError(f"cut short: {max(length, 20 + size)} bytes announced, {len(data)} there")
    return _document(data[20 : 20 + size])


def _document(text: bytes) -> Document:
    document = json.loads(text)
    if not isinstance(document, dict):
        raise ValueError("its JSON is no object")
    return document


def _require_read(header: Document, read: tuple[str, ...]) -> None:
    """Refuse a file that requires a part of glTF which is not read.

    Raises:
        OmtwarpError: the file requires such a part.
    """
    unknown = [str(name) for name in header.get("extensionsRequired", []) if not str(name).startswith(read)]
    if unknown:
        raise OmtwarpError(f"needs {unknown[0]}, which is not read: save it without compression and extensions")


def placed_meshes(scene: trimesh.Scene) -> list[tuple[str, trimesh.Trimesh, NDArray[np.float64], NDArray[np.int64]]]:
    """Return the meshes of a scene in the file's order, each with its name, and moved to where the scene puts it.

    Returns:
        For every mesh its name, itself, its points there, shape [V, 3], and its faces, shape [F, 3], which a mirror
        image turns.
    """
    order = list(scene.geometry)
    placed = [(*scene.graph[node], str(node)) for node in scene.graph.nodes_geometry]
    placed.sort(key=lambda entry: (order.index(entry[1]), entry[2]))  # the graph gives them in no order
    found = []
    for matrix, name, _ in placed:
        mesh = scene.geometry[name]
        if hasattr(mesh, "faces"):
            points, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
            if not np.array_equal(matrix, np.eye(4)):
                points = points @ matrix[:3, :3].T + matrix[:3, 3]
            if np.linalg.det(matrix[:3, :3]) < 0:
                faces = faces[:, ::-1]
            found.append((str(name), mesh, points, faces))
    return found
