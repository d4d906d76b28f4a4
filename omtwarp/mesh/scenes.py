"""Reading formats of whole scenes (glTF, OBJ with materials, 3MF, ...) through trimesh, within the package's limits."""

from __future__ import annotations

import io
import json
import logging
import struct
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

from omtwarp.errors import OmtwarpError
from omtwarp.inputs import read_bytes
from omtwarp.limits import LARGEST_MESH_FILE, amount

if TYPE_CHECKING:
    import trimesh

# Drawings without surfaces, points without triangles, and archives of unknown content.
_NOT_MESHES = {"dxf", "xyz", "zip", "bz2", "tar.gz", "tar.bz2"}
# Parts of glTF that a file may call required and that change nothing about its triangles.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_", "KHR_mesh_quantization")


def scene_formats() -> set[str]:
    """Return the suffixes, without the dot, of the formats that :func:`load_scene` reads."""
    import trimesh

    return set(trimesh.available_formats()) - _NOT_MESHES


def load_scene(data: bytes, file: Path, suffix: str) -> trimesh.Scene:
    """Read a scene, with the files that it names in its directory or below.

    Args:
        data: the file's content.
        file: where it came from; files that it names are looked for in its directory.
        suffix: its format.

    Returns:
        A ``trimesh.Scene`` with vertices as the file has them.

    Raises:
        OmtwarpError: compressed geometry, an archive that inflates too far, or a file that it names and that cannot be
            read.
        Exception: what trimesh raises on a damaged file.
    """
    import trimesh
    from trimesh.resolvers import Resolver

    class Beside(Resolver):
        """Regular files of bounded size in the scene's directory, and nowhere else."""

        def __init__(self, folder: Path):
            self.folder = folder.resolve()

        def get(self, name: str) -> bytes:
            path = (self.folder / name.strip()).resolve()
            if not path.is_relative_to(self.folder):
                path = self.folder / path.name
            return read_bytes(path, LARGEST_MESH_FILE)

        def namespaced(self, namespace: str) -> Beside:
            return Beside(self.folder / namespace)

        def keys(self) -> list[str]:
            return []

        def write(self, name: str, data: object) -> None:
            raise OmtwarpError(f"{name}: not written, as the scene is only read")

    if suffix in ("glb", "gltf"):
        _require_plain(gltf_header(data, suffix))
    if data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
        if total > LARGEST_MESH_FILE:
            raise OmtwarpError(f"inflates to {amount(total)}, and {amount(LARGEST_MESH_FILE)} is the most")
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # its errors contain the same information
    return trimesh.load_scene(io.BytesIO(data), file_type=suffix, resolver=Beside(file.parent), process=False)


def gltf_header(data: bytes, suffix: str) -> object:
    """Return the JSON of a glTF file (glTF 2.0 specification, section 4.4).

    Raises:
        OmtwarpError: the file is shorter than its header says.
        ValueError: it is no such file.
    """
    if suffix == "gltf":
        return json.loads(data)
    magic, _, length, size, _ = struct.unpack("<4sIIII", data[:20].ljust(20, b"\0"))
    if magic != b"glTF":
        raise ValueError("no header of a binary glTF file")
    if len(data) < length or len(data) < 20 + size:
        raise OmtwarpError(f"cut short: {max(length, 20 + size)} bytes announced, {len(data)} there")
    return json.loads(data[20 : 20 + size])


def _require_plain(header: object) -> None:
    """Refuse parts of a scene that trimesh would drop silently.

    Raises:
        OmtwarpError: an extension that changes the triangles.
    """
    required = header.get("extensionsRequired", []) if isinstance(header, dict) else []
    unknown = [str(name) for name in required if not str(name).startswith(_HARMLESS)]
    if unknown:
        raise OmtwarpError(f"needs {unknown[0]}, which is not read: save it without compression and extensions")


__all__ = ["gltf_header", "load_scene", "scene_formats"]
