"""Surfaces in the file formats of VTK: legacy (``.vtk``) and XML (``.vtp``, ``.vtu``)."""

import base64
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.limits import LARGEST_MESH_FILE, amount
from omtwarp.mesh.arrays import Floats, Ints, Numbers, whole_numbers
from omtwarp.mesh.polygons import Triangles, counted_lists, fans, triangles_of_strips

_LEGACY_TYPES = {
    "float": "f4", "double": "f8", "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2",
    "int": "i4", "unsigned_int": "u4", "vtkidtype": "i4", "vtktypeint32": "i4", "vtktypeint64": "i8", "long": "i8",
}  # fmt: skip
_XML_NAMES = "Int8 UInt8 Int16 UInt16 Int32 UInt32 Int64 UInt64 Float32 Float64".split()
_XML_TYPES = {name: np.dtype(name.lower()).str[1:] for name in _XML_NAMES}

_SURFACE = "extract its surface first, in ParaView by 'Extract Surface'"


def write_vtk(file: Path, points: Floats, faces: Ints, beside: Mapping[str, NDArray[np.generic]] | None = None) -> None:
    """Write legacy VTK PolyData, binary, in double precision, with numbers at the points by name."""
    cells = np.insert(faces, 0, 3, axis=1).astype(">i4")
    head = f"# vtk DataFile Version 3.0\nomtwarp\nBINARY\nDATASET POLYDATA\nPOINTS {len(points)} double\n"
    polygons = f"\nPOLYGONS {len(faces)} {4 * len(faces)}\n"
    body = [head.encode("ascii"), points.astype(">f8").tobytes(), polygons.encode("ascii"), cells.tobytes(), b"\n"]
    if beside:
        body.append(f"POINT_DATA {len(points)}\nFIELD FieldData {len(beside)}\n".encode("ascii"))
        for word, values in zip(distinct_words(beside), beside.values(), strict=True):
            body.append(f"{word} 1 {len(points)} double\n".encode())
            body += [np.asarray(values).astype(">f8").tobytes(), b"\n"]
    file.write_bytes(b"".join(body))


def distinct_words(names: Iterable[str], *taken: str) -> list[str]:
    """Return names without spaces, at which formats end them, each other than those before it and those taken."""
    words = [*taken]
    for name in names:
        word = "_".join(name.split()) or "value"
        while word in words:
            word += "_"
        words.append(word)
    return words[len(taken) :]


def read_vtk(data: bytes) -> Triangles:
    """Read polygons and strips of legacy VTK PolyData or an UNSTRUCTURED_GRID, text or binary, versions 1 to 5.

    Raises:
        OmtwarpError: another kind of dataset, cells with a volume, or fewer numbers than announced.
    """
    form = re.search(rb"^\s*(ASCII|BINARY)\s*$", data[:1000], re.M | re.I)
    kind = re.search(rb"^\s*DATASET\s+(\w+)", data[:2000], re.M | re.I)
    if not data.startswith(b"# vtk") or form is None or kind is None:
        raise OmtwarpError("no header of a legacy VTK file")
    name = kind[1].upper().decode("ascii")
    if name not in ("POLYDATA", "UNSTRUCTURED_GRID"):
        raise OmtwarpError(f"a VTK dataset of the kind {name}, which is no surface; {_SURFACE}")
    file = _Legacy(data, form[1].upper() == b"BINARY")
    at = file.find(rb"POINTS[ \t]+(\d+)[ \t]+(\w+)", kind.end())
    if at is None:
        raise OmtwarpError("no points in it")
    flat, end = file.numbers(at.end(), 3 * int(at[1]), at[2])
    points = flat.reshape(-1, 3)
    if name == "UNSTRUCTURED_GRID":
        corners, sizes = file.lists("CELLS", end)
        at = file.find(rb"CELL_TYPES[ \t]+(\d+)", end)
        if at is None:
            raise OmtwarpError("no CELL_TYPES in it")
        return points, *fans(*_of_kinds(corners, sizes, file.numbers(at.end(), int(at[1]), b"int")[0]))
    polygons, strips = file.lists("POLYGONS", end), file.lists("TRIANGLE_STRIPS", end)
    return points, *fans(*_with_strips(polygons, strips))


@dataclass
class _Legacy:
    """The bytes of a legacy VTK file, and whether its numbers are binary."""

    data: bytes
    binary: bool

    def find(self, words: bytes, start: int) -> re.Match[bytes] | None:
        """Find a line, behind a place."""
        return re.compile(rb"^" + words + rb"[ \t]*\r?\n", re.M | re.I).search(self.data, start)

    def numbers(self, start: int, count: int, name: bytes) -> tuple[Numbers, int]:
        """Read numbers of a type; return them and a place behind them.

        Raises:
            OmtwarpError: an unknown type, or the file ends before.
        """
        kind = _LEGACY_TYPES.get(name.decode("ascii", "replace").lower())
        if kind is None:
            raise OmtwarpError(f"numbers of the type '{name.decode('ascii', 'replace')[:40]}'")
        if self.binary:
            size = np.dtype(kind).itemsize
            end, there = start + count * size, (len(self.data) - start) // size
            values: Numbers = np.frombuffer(self.data, f">{kind}", min(count, there), start)
        else:
            values, end = np.array(self.data[start:].split(None, count)[:count], dtype=np.float64), start
        if len(values) < count:
            raise OmtwarpError(f"cut short: {count} numbers announced, {len(values)} there")
        return values, end

    def lists(self, name: str, start: int) -> tuple[Numbers, NDArray[np.int64]]:
        """Read the corners of all cells of a section, and how many each has; none where there is no such section.

        Raises:
            OmtwarpError: the file ends before the section does.
        """
        head = self.find(name.encode("ascii") + rb"[ \t]+(\d+)[ \t]+(\d+)", start)
        if head is None:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
        first, second = int(head[1]), int(head[2])
        offsets = re.compile(rb"OFFSETS[ \t]+(\w+)[ \t]*\r?\n", re.I).match(self.data, head.end())
        if offsets is None:
            return counted_lists(self.numbers(head.end(), second, b"int")[0], first)
        ends, after = self.numbers(offsets.end(), first, offsets[1])
        corners = self.find(rb"CONNECTIVITY[ \t]+(\w+)", after)
        if corners is None:
            raise OmtwarpError(f"no corners of its {name}")
        return self.numbers(corners.end(), second, corners[1])[0], _lengths(ends[1:], second)


def _lengths(ends: Numbers, total: int) -> NDArray[np.int64]:
    """Return the lengths of lists from where each ends.

    Raises:
        OmtwarpError: the ends do not grow, or lie beyond the total.
    """
    lengths = np.diff(whole_numbers(ends, "offsets of cells", (None,)), prepend=0)
    if (lengths < 0).any() or int(lengths.sum()) != total:
        raise OmtwarpError("damaged: offsets of its cells do not fit their corners")
    return lengths


def _with_strips(
    polygons: tuple[Numbers, NDArray[np.int64]], strips: tuple[Numbers, NDArray[np.int64]]
) -> tuple[Numbers, NDArray[np.int64]]:
    """Append the triangles of strips to polygons."""
    triangles = triangles_of_strips(*strips)
    sizes = np.concatenate([polygons[1], np.full(len(triangles), 3)])
    return np.concatenate([polygons[0], triangles.reshape(-1)]), sizes


def _of_kinds(corners: Numbers, sizes: NDArray[np.int64], kinds: Numbers) -> tuple[Numbers, NDArray[np.int64]]:
    """Take the polygons and strips among cells of all kinds; points and lines are left out.

    Raises:
        OmtwarpError: cells that are no flat polygons.
    """
    # Numbers of VTK's kinds of cells that are points, lines, polygons, strips and pixels (squares numbered row by row).
    no_area, flat_kinds, strip_kind, pixel_kind = (1, 2, 3, 4), (5, 7, 9), 6, 8
    types = whole_numbers(kinds, "CELL_TYPES", (len(sizes),))
    other = ~np.isin(types, (*no_area, *flat_kinds, strip_kind, pixel_kind))
    if other.any():
        first, count = int(np.argmax(other)), int(other.sum())
        what = f"{count} of {len(types)} cells are no flat polygons, first cell {first} of type {types[first]}"
        raise OmtwarpError(f"not a surface: {what}; {_SURFACE}")
    starts = np.cumsum(sizes) - sizes
    pixels = starts[(types == pixel_kind) & (sizes == 4)]
    ordered = np.array(corners)
    ordered[pixels + 2], ordered[pixels + 3] = corners[pixels + 3], corners[pixels + 2]
    flat, strip = np.isin(types, (*flat_kinds, pixel_kind)), types == strip_kind
    polygons = ordered[np.repeat(flat, sizes)], sizes[flat]
    return _with_strips(polygons, (corners[np.repeat(strip, sizes)], sizes[strip]))


def read_vtk_xml(data: bytes) -> Triangles:
    """Read polygons and strips of a VTK XML file: PolyData (``.vtp``) or UnstructuredGrid (``.vtu``).

    Arrays are text or binary, beside the markup or appended, plain or compressed by zlib.

    Raises:
        OmtwarpError: another kind of dataset, cells with a volume, another compression, or a damaged array.
        ElementTree.ParseError: no XML.
    """
    file = _Xml(data)
    kind = file.root.get("type", "")
    if file.root.tag != "VTKFile":
        raise OmtwarpError(f"no VTK file: XML that begins with <{file.root.tag[:40]}>")
    if kind not in ("PolyData", "UnstructuredGrid"):
        raise OmtwarpError(f"a VTK dataset of the kind {kind[:40]}, which is no surface; {_SURFACE}")
    points, corners, sizes, start = [], [], [], 0
    for piece in file.root.iter("Piece"):
        here = file.first(piece, "Points").reshape(-1, 3)
        if kind == "PolyData":
            triangles = _with_strips(file.lists(piece, "Polys"), file.lists(piece, "Strips"))
        else:
            triangles = _of_kinds(*file.lists(piece, "Cells"), file.first(piece, "Cells", "types"))
        points.append(here)
        corners.append(whole_numbers(triangles[0], "corners of cells", (None,)) + start)
        sizes.append(triangles[1])
        start += len(here)
    if not points:
        raise OmtwarpError("no piece of a surface in it")
    return np.concatenate(points), *fans(np.concatenate(corners), np.concatenate(sizes))


class _Xml:
    """A VTK XML file: its markup, and the bytes behind it that arrays refer to."""

    def __init__(self, data: bytes):
        at = re.search(rb"<AppendedData\b([^>]*)>\s*_", data)
        self.appended = b"" if at is None else data[at.end() :]
        self.encoded = at is None or b"base64" in at[1]
        markup = data if at is None else data[: at.start()] + b"</VTKFile>"
        if b"<!DOCTYPE" in markup or b"<!ENTITY" in markup:
            raise OmtwarpError("definitions of its own in the markup, which VTK does not write")
        self.root = ElementTree.fromstring(markup)
        self.order = ">" if self.root.get("byte_order") == "BigEndian" else "<"
        self.head = np.dtype(self.order + _XML_TYPES.get(self.root.get("header_type", "UInt32"), "u4"))
        self.compressor = self.root.get("compressor", "")
        self.left = LARGEST_MESH_FILE  # bytes that its arrays may still take

    def first(self, piece: ElementTree.Element, section: str, name: str = "") -> Numbers:
        """Read the array of a name in a section of a piece, or its only one; an empty one where there is none."""
        for array in piece.findall(f"{section}/DataArray"):
            if not name or array.get("Name") == name:
                return self._array(array)
        return np.empty(0)

    def lists(self, piece: ElementTree.Element, section: str) -> tuple[Numbers, NDArray[np.int64]]:
        """Read the corners of all cells in a section, and how many each has."""
        corners = self.first(piece, section, "connectivity")
        return corners, _lengths(self.first(piece, section, "offsets"), len(corners))

    def _array(self, array: ElementTree.Element) -> Numbers:
        """Read an array.

        Raises:
            OmtwarpError: an unknown type or compression, or the array is damaged or too large.
        """
        kind = _XML_TYPES.get(array.get("type", ""))
        if kind is None:
            raise OmtwarpError(f"an array of the type '{array.get('type', '')[:40]}'")
        form = array.get("format", "ascii")
        if form == "ascii":
            return np.array((array.text or "").split(), dtype=np.float64)
        if form == "binary":
            source = "".join((array.text or "").split()).encode("ascii")
        else:
            source = self.appended[int(array.get("offset", "0")) :]
        return np.frombuffer(b"".join(self._blocks(source, form == "binary" or self.encoded)), dtype=self.order + kind)

    def _blocks(self, source: bytes, encoded: bool) -> Iterator[bytes]:
        """Yield the content of an array block by block; lengths stand before it."""
        if not self.compressor:
            size = int(self._header(source, 1, encoded)[0])
            yield self._taken(source, self.head.itemsize + size, encoded)[self.head.itemsize :]
            return
        if self.compressor != "vtkZLibDataCompressor":
            raise OmtwarpError(f"compressed by {self.compressor[:40]}, which is not read: save it without, or by zlib")
        count = int(self._header(source, 1, encoded)[0])
        numbers = self._header(source, 3 + count, encoded)
        used = numbers.nbytes
        body = source[-(-used // 3) * 4 if encoded else used :]
        content = self._taken(body, int(numbers[3:].sum()), encoded)
        place = 0
        for size in numbers[3:].tolist():
            most = int(numbers[1])
            self._take(most)
            yield zlib.decompressobj().decompress(content[place : place + size], most)
            place += size

    def _header(self, source: bytes, count: int, encoded: bool) -> NDArray[np.unsignedinteger]:
        return np.frombuffer(self._taken(source, count * self.head.itemsize, encoded), dtype=self.head)

    def _taken(self, source: bytes, size: int, encoded: bool) -> bytes:
        """Return the first bytes of a source, which may be in base64.

        Raises:
            OmtwarpError: there are fewer.
        """
        self._take(size)
        content = base64.b64decode(source[: -(-size // 3) * 4]) if encoded else source[:size]
        if len(content) < size:
            raise OmtwarpError(f"cut short: an array of {amount(size)} announced, {amount(len(content))} there")
        return content[:size]

    def _take(self, size: int) -> None:
        self.left -= size
        if self.left < 0:
            raise OmtwarpError(f"its arrays take more than {amount(LARGEST_MESH_FILE)}, which is the most")
