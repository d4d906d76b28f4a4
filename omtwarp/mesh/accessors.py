"""Sparse and quantised arrays of glTF files, written out as plain ones (glTF 2.0, sections 3.6.2 and 3.11).

The extension KHR_mesh_quantization stores positions and coordinates as whole numbers, divided by their largest value
where they are normalised.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.limits import LARGEST_MESH_FILE, amount
from omtwarp.mesh.arrays import whole_numbers

Numbers = NDArray[np.generic]

_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}  # by componentType
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_GLB_HEADER, _CHUNK_HEADER = 12, 8  # bytes of a .glb before its first chunk, and of each chunk before its content
_JSON, _BIN = 0x4E4F534A, 0x004E4942  # the types of its chunks, "JSON" and "BIN" in ASCII


Document: TypeAlias = dict
"""A glTF file's JSON, or an entry of it; names are those of the specification (glTF 2.0, section 5)."""


def with_plain_accessors(data: bytes, document: Document, binary: bool, named: Callable[[str], bytes]) -> bytes:
    """Write out sparse arrays, and normalised whole numbers of positions, normals and texture coordinates as floats.

    Args:
        data: the file.
        document: its JSON, which is changed.
        binary: whether the file is a ``.glb``.
        named: reads a file that the document names.

    Returns:
        The file with these arrays in one more buffer; the data themselves where there is none of them.

    Raises:
        OmtwarpError: a sparse array replaces rows that it does not have, or arrays are too large.
        LookupError: the document refers to what is not there.
        ValueError: an array is not as long as announced.
    """
    accessors = document.get("accessors", [])
    scaled = {
        number
        for mesh in document.get("meshes", [])
        for primitive in mesh.get("primitives", [])
        for name, number in primitive.get("attributes", {}).items()
        if name.startswith(("POSITION", "NORMAL", "TEXCOORD_"))
    }
    wanted = [k for k, one in enumerate(accessors) if "sparse" in one or (k in scaled and one.get("normalized"))]
    if not wanted:
        return data
    buffers = _Buffers(document, _binary_chunk(data) if binary else b"", named)
    content = b""
    views = document.setdefault("bufferViews", [])
    number = len(document.setdefault("buffers", []))
    for k in wanted:
        array = _array(accessors[k], buffers)
        if k in scaled and accessors[k].get("normalized"):
            array = _unit_range(array)
            # Float: the componentType of single precision
            accessors[k] |= {"componentType": 5126, "normalized": False}
        for key in ("sparse", "byteOffset"):
            accessors[k].pop(key, None)
        accessors[k]["bufferView"] = len(views)
        views.append({"buffer": number, "byteOffset": len(content), "byteLength": array.nbytes})
        content += array.tobytes() + bytes(-array.nbytes % 4)
    uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode("ascii")
    document["buffers"].append({"byteLength": len(content), "uri": uri})
    return with_document(data, document, binary)


def with_document(data: bytes, document: Document, binary: bool) -> bytes:
    """Return a glTF file with other JSON; arguments are those of :func:`with_plain_accessors`."""
    text = json.dumps(document).encode("utf-8")
    if not binary:
        return text
    text += b" " * (-len(text) % 4)
    length = struct.unpack("<I", data[_GLB_HEADER : _GLB_HEADER + 4])[0]
    chunks = data[_GLB_HEADER + _CHUNK_HEADER + length :]
    whole = _GLB_HEADER + _CHUNK_HEADER + len(text) + len(chunks)
    return struct.pack("<4sIIII", b"glTF", 2, whole, len(text), _JSON) + text + chunks


def _binary_chunk(data: bytes) -> bytes:
    """Return the bytes of a ``.glb`` behind its JSON; none where it has none."""
    place = _GLB_HEADER
    while place + _CHUNK_HEADER <= len(data):
        length, kind = struct.unpack("<II", data[place : place + _CHUNK_HEADER])
        place += _CHUNK_HEADER
        if kind == _BIN:
            return data[place : place + length]
        place += length
    return b""


def pictures_of(
    data: bytes, document: Document, binary: bool, named: Callable[[str], bytes]
) -> Callable[[int], bytes | None]:
    """Return a function that gives the bytes of a picture of a glTF file by its number, None for unread formats.

    Args:
        data: the file.
        document: its JSON.
        binary: whether the file is a ``.glb``.
        named: reads a file that the document names.
    """
    buffers = _Buffers(document, _binary_chunk(data) if binary else b"", named)

    def picture(number: int) -> bytes | None:
        entry = document["images"][number]
        uri = entry.get("uri", "")
        if entry.get("mimeType") == "image/ktx2" or not ("bufferView" in entry or uri):
            return None
        if "bufferView" in entry:
            return buffers.view(entry["bufferView"])[0]
        return base64.b64decode(uri.partition("base64,")[2]) if uri.startswith("data:") else named(uri)

    return picture


class _Buffers:
    """The buffers of a glTF file, each read when it is asked for first."""

    def __init__(self, document: Document, chunk: bytes, named: Callable[[str], bytes]):
        self.document, self.chunk, self.named = document, chunk, named
        self.known: dict[int, bytes] = {}
        self.left = LARGEST_MESH_FILE  # bytes that arrays may still take

    def view(self, number: int) -> tuple[bytes, int]:
        """Return a view's bytes, and how many lie between the beginnings of its rows, 0 for none but their own."""
        view = self.document["bufferViews"][number]
        start = view.get("byteOffset", 0)
        return self._buffer(view["buffer"])[start : start + view["byteLength"]], view.get("byteStride", 0)

    def _buffer(self, number: int) -> bytes:
        if number not in self.known:
            uri = self.document["buffers"][number].get("uri")
            if uri is None:
                self.known[number] = self.chunk
            elif "base64," in uri:
                self.known[number] = base64.b64decode(uri.partition("base64,")[2])
            else:
                self.known[number] = self.named(uri)
        return self.known[number]

    def take(self, size: int) -> None:
        """Count bytes of an array.

        Raises:
            OmtwarpError: they are too many, or fewer than none.
        """
        self.left -= size
        if size < 0:
            raise OmtwarpError("damaged: a negative number of rows in a sparse array")
        if self.left < 0:
            raise OmtwarpError(f"its sparse arrays take more than {amount(LARGEST_MESH_FILE)}, which is the most")


def _array(accessor: Document, buffers: _Buffers) -> Numbers:
    """Read the array of an accessor, shape [count, width].

    Raises:
        OmtwarpError: it replaces rows that it does not have, or is too large.
    """
    kind, width, count = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
    buffers.take(count * width * kind.itemsize)
    array = np.zeros((count, width), dtype=kind)
    if "bufferView" in accessor:
        content, stride = buffers.view(accessor["bufferView"])
        start = accessor.get("byteOffset", 0)
        size = stride or width * kind.itemsize
        row = np.dtype({"names": ["row"], "formats": [(kind, (width,))], "itemsize": size})
        content = (
            content[start:].ljust(count * size, b"\0") if stride else content[start:]
        )  # the last row may end early
        array[:] = np.frombuffer(content, dtype=row, count=count)["row"]
    sparse = accessor.get("sparse")
    if sparse is None:
        return array
    rows = _packed(sparse["indices"], np.dtype(_TYPES[sparse["indices"]["componentType"]]), sparse["count"], 1, buffers)
    values = _packed(sparse["values"], kind, sparse["count"], width, buffers)
    array[whole_numbers(rows[:, 0], "rows of a sparse array", (None,), below=count)] = values
    return array


def _packed(part: Document, kind: np.dtype, count: int, width: int, buffers: _Buffers) -> Numbers:
    """Read rows that lie side by side, shape [count, width].

    Raises:
        OmtwarpError: they are too many.
    """
    buffers.take(count * width * kind.itemsize)
    content, _ = buffers.view(part["bufferView"])
    return np.frombuffer(content, kind, count * width, part.get("byteOffset", 0)).reshape(count, width)


def _unit_range(array: Numbers) -> NDArray[np.float32]:
    """Convert normalised whole numbers to -1 to 1, or to 0 to 1 where they have no sign (glTF 2.0, section 3.11)."""
    bits = 8 * array.dtype.itemsize - (array.dtype.kind == "i")
    most = 1 if array.dtype.kind == "f" else 2**bits - 1
    return np.maximum(array.astype(np.float64) / most, -1.0).astype(np.float32)
