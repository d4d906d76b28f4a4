"""Reading formats of whole scenes (glTF, OBJ with materials, 3MF, ...) through trimesh, within the package's limits.

Sparse and quantised arrays of glTF files are written out as plain ones first (glTF 2.0, sections 3.6.2 and 3.11). The
extension KHR_mesh_quantization stores positions and coordinates as whole numbers, divided by their largest value where
they are normalised. KHR_texture_transform moves texture coordinates, which are moved when they are read.
"""

from __future__ import annotations

import base64
import io
import json
import logging
import struct
import zipfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import file_beside, read_bytes
from omtwarp.files.limits import LARGEST_MESH_FILE, amount, memory_for_file
from omtwarp.mesh.arrays import Floats, Numbers, whole_numbers

if TYPE_CHECKING:
    import trimesh


_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # by componentType
_FLOAT = 5126  # single precision
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


Document: TypeAlias = dict
"""A glTF file's JSON, or an entry of it; names are those of the specification (glTF 2.0, section 5)."""


class GltfInput:
    """A glTF file (glTF 2.0): its JSON, and its buffers, each read when it is asked for first.

    Args:
        data: the file.
        suffix: ``glb`` or ``gltf``.
        file: where it came from; files that it names lie in its directory or below.

    Attributes:
        document: its JSON, which may be changed before it is :meth:`encoded` again.

    Raises:
        OmtwarpError: the file is shorter than its header says.
        ValueError: it is no such file.
    """

    def __init__(self, data: bytes, suffix: str, file: Path):
        self.file, self.chunks = file, b""
        if suffix == "glb":  # section 4.4
            magic, _, length, size, _ = struct.unpack("<4sIIII", data[:20].ljust(20, b"\0"))
            if magic != b"glTF":
                raise ValueError("no header of a binary glTF file")
            if len(data) < length or len(data) < 20 + size:
                raise OmtwarpError(f"cut short: {max(length, 20 + size)} bytes announced, {len(data)} there")
            data, self.chunks = data[20 : 20 + size], data[20 + size :]
        self.document: Document = json.loads(data)
        if not isinstance(self.document, dict):
            raise ValueError("its JSON is no object")
        self.buffers: list[Document] = self.document.get("buffers", [])
        self.known: dict[int, bytes] = {}
        self.left = LARGEST_MESH_FILE  # bytes that arrays may still take

    def encoded(self) -> bytes:
        """Return its JSON as it is now, with its buffers called by their numbers."""
        buffers = [entry | {"uri": str(number)} for number, entry in enumerate(self.buffers)]
        return json.dumps(self.document | {"buffers": buffers}).encode()

    def write_out_arrays(self) -> None:
        """Write out sparse arrays, and as floats normalised whole numbers: positions, normals and texture coordinates.

        They go to one more buffer.

        Raises:
            OmtwarpError: a sparse array replaces rows that it does not have, or arrays are too large.
            LookupError: the document refers to what is not there.
            ValueError: an array is not as long as announced.
        """
        accessors = self.document.get("accessors", [])
        primitives = [one for mesh in self.document.get("meshes", []) for one in mesh.get("primitives", [])]
        pairs = (pair for one in primitives for pair in one.get("attributes", {}).items())
        scaled = {number for name, number in pairs if name.startswith(("POSITION", "NORMAL", "TEXCOORD_"))}
        wanted = [k for k, one in enumerate(accessors) if "sparse" in one or (k in scaled and one.get("normalized"))]
        if not wanted:
            return
        arrays = []
        for k in wanted:
            arrays.append(self._array(accessors[k]))
            if k in scaled and accessors[k].get("normalized"):
                # Whole numbers become -1 to 1, or 0 to 1 where they have no sign (glTF 2.0, section 3.11).
                kind = arrays[-1].dtype
                most = 1 if kind.kind == "f" else 2 ** (8 * kind.itemsize - (kind.kind == "i")) - 1
                arrays[-1] = np.maximum(arrays[-1].astype(np.float64) / most, -1.0).astype(np.float32)
                accessors[k] |= {"componentType": _FLOAT, "normalized": False}
            for key in ("sparse", "byteOffset"):
                accessors[k].pop(key, None)
        for k, view in zip(wanted, self._stored(arrays), strict=True):
            accessors[k]["bufferView"] = view

    def lay_out_pictures(self) -> None:
        """Give triangles as their first coordinates those that their material's first picture is laid out by.

        These are another set of the file's, or moved ones: offset + rotation · scale · uv with KHR_texture_transform.

        Raises:
            LookupError: the document refers to what is not there.
        """
        accessors, materials = self.document.get("accessors", []), self.document.get("materials", [])
        known: dict[tuple[int, Layout], int] = {}
        for primitive in (one for mesh in self.document.get("meshes", []) for one in mesh.get("primitives", [])):
            uses = picture_uses(materials[primitive["material"]]) if "material" in primitive else {}
            layout = next(map(layout_of, uses.values()), PLAIN_LAYOUT)
            given = primitive.get("attributes", {}).get(f"TEXCOORD_{layout[0]}")
            if layout == PLAIN_LAYOUT or given is None:
                continue
            if (given, layout) not in known:
                _, offset, turn, (along, down) = layout
                cosine, sine = np.cos(turn), np.sin(turn)
                u, v = self._array(accessors[given]).astype(np.float64).T * [[along], [down]]
                moved = np.stack([cosine * u + sine * v, cosine * v - sine * u], axis=1) + offset
                (view,) = self._stored([moved.astype(np.float32)])
                known[given, layout] = len(accessors)
                accessors.append({"bufferView": view, "componentType": _FLOAT, "type": "VEC2", "count": len(moved)})
            primitive["attributes"]["TEXCOORD_0"] = known[given, layout]

    def _stored(self, arrays: list[Numbers]) -> list[int]:
        """Add arrays to the file, in one more buffer; return the numbers of their views."""
        content, views = b"", self.document.setdefault("bufferViews", [])
        number, first = len(self.buffers), len(views)
        for array in arrays:
            views.append({"buffer": number, "byteOffset": len(content), "byteLength": array.nbytes})
            content += array.tobytes() + bytes(-array.nbytes % 4)
        self.buffers.append({"byteLength": len(content)})
        self.known[number] = content
        return list(range(first, len(views)))

    def picture(self, number: int) -> bytes | None:
        """Return the bytes of a picture; None for a format that is not read, and for a file that is not there."""
        entry = self.document["images"][number]
        uri = entry.get("uri", "")
        if entry.get("mimeType") == "image/ktx2" or not ("bufferView" in entry or uri):
            return None
        return self._view(entry["bufferView"])[0] if "bufferView" in entry else self._named(uri)

    def _named(self, uri: str) -> bytes | None:
        """Return what a URI holds, or the content of the file that it names; None where nothing is there."""
        if "base64," in uri:
            return base64.b64decode(uri.partition("base64,")[2])
        there = file_beside(self.file, unquote(uri))
        return None if there is None else read_bytes(there, LARGEST_MESH_FILE)

    def _view(self, number: int) -> tuple[bytes, int]:
        """Return a view's bytes, and how many lie between the beginnings of its rows, 0 for none but their own."""
        view = self.document["bufferViews"][number]
        start = view.get("byteOffset", 0)
        return self.buffer(view["buffer"])[start : start + view["byteLength"]], view.get("byteStride", 0)

    def buffer(self, number: int) -> bytes:
        """Read a buffer.

        Raises:
            OmtwarpError: its file is elsewhere than in the directory or below, is no regular file, or is not there.
        """
        if number not in self.known:
            uri = self.buffers[number].get("uri")
            content = self._chunk() if uri is None else self._named(uri)
            if content is None:
                raise OmtwarpError(f"names '{uri}', which is not there")
            self.known[number] = content
        return self.known[number]

    def _chunk(self) -> bytes:
        """Return the bytes of a ``.glb`` behind its JSON; none where it has none."""
        place = 0
        while place + 8 <= len(self.chunks):
            length, kind = struct.unpack("<I4s", self.chunks[place : place + 8])
            place += 8
            if kind == b"BIN\0":
                return self.chunks[place : place + length]
            place += length
        return b""

    def _array(self, accessor: Document) -> Numbers:
        """Read the array of an accessor, shape [count, width].

        Raises:
            OmtwarpError: it replaces rows that it does not have, or is too large.
        """
        kind, width, count = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
        self._take(count * width * kind.itemsize)
        array = np.zeros((count, width), dtype=kind)
        if "bufferView" in accessor:
            content, stride = self._view(accessor["bufferView"])
            start = accessor.get("byteOffset", 0)
            size = stride or width * kind.itemsize
            row = np.dtype({"names": ["row"], "formats": [(kind, (width,))], "itemsize": size})
            content = content[start:].ljust(count * size * bool(stride), b"\0")  # the last row may end early
            array[:] = np.frombuffer(content, dtype=row, count=count)["row"]
        sparse = accessor.get("sparse")
        if sparse is not None:
            numbers = np.dtype(_TYPES[sparse["indices"]["componentType"]])
            rows = self._packed(sparse["indices"], numbers, sparse["count"], 1)
            values = self._packed(sparse["values"], kind, sparse["count"], width)
            array[whole_numbers(rows[:, 0], "rows of a sparse array", (None,), below=count)] = values
        return array

    def _packed(self, part: Document, kind: np.dtype, count: int, width: int) -> Numbers:
        """Read rows that lie side by side, shape [count, width].

        Raises:
            OmtwarpError: they are too many.
        """
        self._take(count * width * kind.itemsize)
        content, _ = self._view(part["bufferView"])
        return np.frombuffer(content, kind, count * width, part.get("byteOffset", 0)).reshape(count, width)

    def _take(self, size: int) -> None:
        """Count bytes of an array.

        Raises:
            OmtwarpError: they are too many, or fewer than none.
        """
        self.left -= size
        if size < 0:
            raise OmtwarpError("damaged: a negative number of rows in a sparse array")
        if self.left < 0:
            raise OmtwarpError(f"its sparse arrays take more than {amount(LARGEST_MESH_FILE)}, which is the most")


Layout: TypeAlias = tuple[int, tuple[float, float], float, tuple[float, float]]
"""How a picture lies on triangles: the set of their coordinates, offset, angle in radians, and scale."""

PLAIN_LAYOUT: Layout = (0, (0.0, 0.0), 0.0, (1.0, 1.0))


def picture_uses(material: Document) -> dict[str, Document]:
    """Return how a material uses pictures, by the names of their roles, in the order of :data:`ROLES`."""
    uses = {**material.get("pbrMetallicRoughness", {}), **material}
    return {role: uses[role] for role in ROLES if isinstance(uses.get(role), dict) and "index" in uses[role]}


def layout_of(used: Document) -> Layout:
    """Return how a picture lies by what a material says of its use."""
    moved = used.get("extensions", {}).get("KHR_texture_transform", {})
    (left, top), (along, down) = (map(float, moved.get(*pair)) for pair in (("offset", (0, 0)), ("scale", (1, 1))))
    chosen = int(moved.get("texCoord", used.get("texCoord", 0)))
    return chosen, (left, top), float(moved.get("rotation", 0.0)), (along, down)


# Of what trimesh reads, those that open no other file themselves, as readers of archives and of simulations do.
_SCENES = {"glb", "gltf", "dae", "3mf", "xaml", "ctm", "json"}
ROLES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture", "occlusionTexture", "emissiveTexture")
BRIGHTER = "KHR_materials_emissive_strength"  # the part of glTF for light brighter than 1
# Parts of glTF that are read, or that change nothing about triangles and little about their look.
_READ = ("KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_materials_", "KHR_lights_")
# Parts that change where a picture lies or how it is stored, and nothing about triangles.
_OF_PICTURES = ("KHR_texture_", "EXT_texture_", "MSFT_texture_")


# What is said of the use of a picture and is not read, with the value at which it changes nothing.
_LEFT_OUT: Document = {"scale": 1, "strength": 1}


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
            if suffix not in ("glb", "gltf"):
                raise OmtwarpError(f"names '{name}', which is not read with a .{suffix}")
            return gltf.buffer(int(name))

        def namespaced(self, _namespace: str) -> Buffers:
            return self

        def keys(self) -> list[str]:
            return []

        def write(self, name: str, data: object) -> None:
            raise OmtwarpError(f"{name}: not written, as the scene is only read")

    size, kind = len(data), suffix
    if suffix in ("glb", "gltf"):
        gltf = GltfInput(data, suffix, file)
        read = (*_READ, *(() if pictures else _OF_PICTURES))
        required = gltf.document.get("extensionsRequired", [])
        if unknown := [str(name) for name in required if not str(name).startswith(read)]:
            raise OmtwarpError(f"needs {unknown[0]}, which is not read: save it without compression and extensions")
        gltf.write_out_arrays()
        if pictures:
            gltf.lay_out_pictures()
        gltf.document.pop("images", None)
        for number, material in enumerate(gltf.document.get("materials", [])):
            material["name"] = str(number)
        data, kind = gltf.encoded(), "gltf"
    if data.startswith(b"PK"):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
        if total > LARGEST_MESH_FILE:
            raise OmtwarpError(f"inflates to {amount(total)}, and {amount(LARGEST_MESH_FILE)} is the most")
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # its errors contain the same information
    with memory_for_file(size):
        return trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=Buffers(), process=False)


def gltf_pictures(data: bytes, file: Path, suffix: str) -> tuple[list[tuple[Document, dict[str, bytes]]], list[str]]:
    """Return every material of a glTF file, and its encoded pictures by the names of their roles; and what is lost.

    Pictures that are not there are left out, and so are those of formats that glTF 2.0 does not know.

    Raises:
        OmtwarpError: the file names one that is elsewhere than in its directory, or is no regular file.
        LookupError: the document refers to what is not there.
    """
    gltf = GltfInput(data, suffix, file)
    picture = cache(gltf.picture)
    pictures: list[tuple[Document, dict[str, bytes]]] = []
    lost: list[str] = []
    for material in gltf.document.get("materials", []):
        pictures.append((material, {}))
        uses = picture_uses(material)
        for role, used in uses.items():
            lost += [f"{name} of {role}" for name, usual in _LEFT_OUT.items() if used.get(name, usual) != usual]
            lost += [f"coordinates of {role} alone"] * (layout_of(used) != layout_of(next(iter(uses.values()))))
            entry = gltf.document["textures"][used["index"]]  # as WebP where it has it so
            number = entry.get("extensions", {}).get("EXT_texture_webp", entry).get("source")
            content = None if number is None else picture(number)
            if content:
                pictures[-1][1][role] = content
    return pictures, [f"left out {', '.join(dict.fromkeys(lost))}, which are not read"] if lost else []


def placed_meshes(scene: trimesh.Scene) -> list[tuple[str, trimesh.Trimesh, Floats, NDArray[np.int64]]]:
    """Return the meshes of a scene in the file's order, each with its name, and moved to where the scene puts it.

    Returns:
        For every mesh its name, itself, its points there, shape [V, 3], and its faces, shape [F, 3], which a mirror
        image turns. Of several meshes, vertices in no face are left out.
    """
    order = list(scene.geometry)
    placed = [(*scene.graph[node], str(node)) for node in scene.graph.nodes_geometry]
    placed.sort(key=lambda entry: (order.index(entry[1]), entry[2]))  # the graph gives them in no order
    meshes = []
    for matrix, name, _ in placed:
        mesh = scene.geometry[name]
        if hasattr(mesh, "faces"):
            if len(placed) > 1:  # primitives of glTF may name the vertices of several, and use some of them
                mesh.remove_unreferenced_vertices()
            points, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
            if not np.array_equal(matrix, np.eye(4)):
                points = points @ matrix[:3, :3].T + matrix[:3, 3]
            faces = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
            meshes.append((str(name), mesh, points, faces))
    return meshes
