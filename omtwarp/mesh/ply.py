"""Reading PLY files (Turk 1994, "The PLY Polygon File Format"): vertices and polygons, from text or binary numbers.

All lengths are checked against the header before memory is allocated.
"""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats, whole_numbers
from omtwarp.mesh.polygons import parts_of_strips, triangles_of_strips

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_NUMBERS = b"0123456789+-.eEnaifNAIF \t\r\n\f\v"  # the characters of numbers, NaN and infinity as text
_CORNERS = ("vertex_indices", "vertex_index")


Column = NDArray | tuple[NDArray, NDArray]
"""The values of a property: numbers, or the lengths of lists and their values."""


@dataclass(frozen=True)
class _Property:
    """A property in a PLY header: its name, the type of its numbers and, for a list, the type of its length."""

    name: str
    type: str
    length: str | None = None


@dataclass(frozen=True)
class _Element:
    """An element in a PLY header: its name, its number of rows, and the properties of each row."""

    name: str
    count: int
    properties: list[_Property]


def read_ply(data: bytes) -> tuple[Floats, NDArray[np.generic], NDArray[np.int64], list[str]]:
    """Read the vertices and polygons of a PLY file, in the file's order.

    Returns:
        Vertices, float64 [V, 3]; the corners of all polygons one after another, of the file's type; how many each has,
        int64 [F]; notes about what was decided.

    Raises:
        OmtwarpError: the file is not as long as its header says, or has no vertices or no faces.
        ValueError: it is no PLY file.
    """
    columns, notes = ply_columns(data)
    return *polygons_of(columns), notes


def ply_columns(data: bytes) -> tuple[dict[str, dict[str, Column]], list[str]]:
    """Read every property of every element of a PLY file; a list as its lengths and its values one after another.

    Returns:
        Columns by element and property, and notes about what was decided.

    Raises:
        OmtwarpError: the file is not as long as its header says.
        ValueError: it is no PLY file.
    """
    elements, order, body = _header(data)
    if order is not None:
        return _columns(body, elements, order), []
    try:
        return _text_columns(body, elements), []
    except OmtwarpError:
        announced, longer = _announced_words(body, elements)
        if not longer:
            raise
        note = f"left out the numbers at the ends of {longer} lines that the header does not announce"
        return _text_columns(announced, elements), [note]


def polygons_of(columns: dict[str, dict[str, Column]]) -> tuple[Floats, NDArray, NDArray]:
    """Take vertices, the corners of all polygons and their numbers from columns, as :func:`read_ply` returns them.

    Raises:
        OmtwarpError: no vertices or no faces among the elements.
    """
    if not {"x", "y", "z"} <= set(columns.get("vertex", {})):
        raise OmtwarpError("not a triangle mesh: no vertices with x, y and z in it")
    points = np.stack([np.asarray(columns["vertex"][axis], dtype=np.float64) for axis in "xyz"], axis=1)
    faces, strips = (columns.get(element, {}) for element in ("face", "tristrips"))
    corners = next((faces[name] for name in _CORNERS if name in faces), None)
    strip = next((strips[name] for name in _CORNERS if name in strips), None)
    if corners is None and strip is not None:
        lengths = whole_numbers(strip[0], "lengths of strips", (None,))
        triangles = triangles_of_strips(*parts_of_strips(strip[1], lengths))
        return points, triangles.reshape(-1), np.full(len(triangles), 3)
    if corners is None:
        raise OmtwarpError("not a triangle mesh: it holds points and no faces")
    sizes, flat = corners
    return points, flat, whole_numbers(sizes, "corners of faces", (None,))


def _header(data: bytes) -> tuple[list[_Element], str | None, bytes]:
    """Read a PLY header: the elements, the byte order (``<`` or ``>``, None for text), and the bytes after it.

    Raises:
        ValueError: no header, or one that cannot be understood.
    """
    # Longest header: bytes
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data[:1_000_000])
    if not data.startswith(b"ply") or end is None:
        raise ValueError("no header of a PLY file, or one cut short")
    elements: list[_Element] = []
    order: str | None = ""
    for line in data[: end.start()].decode("utf-8", "replace").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) > 1:
            order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal():
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[0] == "property" and elements and len(words) in (3, 5):
            elements[-1].properties.append(_property(words[1:]))
        else:
            raise ValueError(f"its header says '{line[:60]}'")
    if order == "":
        raise ValueError("its header names no format")
    # An element without properties takes no memory, however many the header announces.
    return [element for element in elements if element.properties], order, data[end.end() :]


def _property(words: list[str]) -> _Property:
    """Read what a header says of a property: its type or ``list`` and the types of lengths and entries, and its name.

    Raises:
        KeyError: an unknown type.
        ValueError: lists whose length is not of a type of whole numbers.
    """
    listed = words[0] == "list"
    kinds = [_TYPES[word] for word in (words[1:3] if listed else words[:1])]
    if listed and kinds[0].startswith("f"):
        raise ValueError(f"the lengths of '{words[-1]}' are no whole numbers")
    return _Property(words[-1], kinds[-1], kinds[0] if listed else None)


def _cut(elements: list[_Element]) -> OmtwarpError:
    return OmtwarpError(
        f"the file is not as long as its header says, cut short or damaged: {_counts(elements)} announced"
    )


def _counts(elements: list[_Element]) -> str:
    return " and ".join(f"{element.count} of '{element.name}'" for element in elements)


def _announced_words(body: bytes, elements: list[_Element]) -> tuple[bytes, int]:
    """Take from every line of a text what its row announces, and count the lines that have more.

    Returns:
        The text without the rest of its lines, and their number: 0 where a line has fewer numbers than its row.

    Raises:
        OmtwarpError: there are fewer lines than rows.
    """
    lines = [line.split() for line in body.replace(b"\r", b"\n").split(b"\n")]
    lines = [line for line in lines if line]
    if sum(element.count for element in elements) > len(lines):
        raise _cut(elements)
    longer, row = 0, 0
    for element in elements:
        for number in range(row, row + element.count):
            line, end = lines[number], 0
            for part in element.properties:
                if part.length is not None:
                    end += int(line[end]) if end < len(line) and line[end].isdigit() else len(line)
                end += 1
            if end > len(line):
                return body, 0
            longer += end < len(line)
            lines[number] = line[:end]
        row += element.count
    return b"\n".join(b" ".join(line) for line in lines), longer


def _text_columns(body: bytes, elements: list[_Element]) -> dict[str, dict[str, Column]]:
    """Read a text as the binary file that has all its numbers as float64.

    Raises:
        OmtwarpError: the file has fewer or more numbers than its header says, or words among them.
    """
    if body.translate(None, _NUMBERS):
        raise OmtwarpError("damaged: letters or signs among its numbers")
    numbers = np.array(body.split(), dtype=np.float64)
    doubles = []
    for element in elements:
        properties = [_Property(part.name, "f8", part.length and "f8") for part in element.properties]
        doubles.append(_Element(element.name, element.count, properties))
    return _columns(numbers.tobytes(), doubles, "=", ("numbers", numbers.itemsize))


def _columns(
    body: bytes, elements: list[_Element], order: str, unit: tuple[str, int] = ("bytes", 1)
) -> dict[str, dict[str, Column]]:
    """Read every property of every element of a binary file; a list as its lengths and its values.

    Args:
        body: what follows the header.
        elements: what that announces.
        order: of the bytes.
        unit: what a message counts when something is left, and the bytes of one.

    Raises:
        OmtwarpError: the body is shorter or longer than the header says.
    """
    columns: dict[str, dict[str, Column]] = {}
    place = 0
    for element in elements:
        record, lengths = _first_row(body, place, element, order)
        if element.count > 0 and element.count * record.itemsize <= len(body) - place:
            rows = np.frombuffer(body, record, element.count, place)
            if all((rows[f"n{k}"] == lengths[k]).all() for k in lengths):
                place += element.count * record.itemsize
                of_lists = {k: np.full(element.count, length) for k, length in lengths.items()}
                columns[element.name] = {
                    part.name: rows[f"v{k}"] if k not in lengths else (of_lists[k], rows[f"v{k}"].reshape(-1))
                    for k, part in enumerate(element.properties)
                }
                continue
        place, columns[element.name] = _uneven_rows(body, place, element, order, elements)
    if place != len(body):
        what, size = unit
        rest = f"{(len(body) - place) // size} {what} after {_counts(elements)}"
        raise OmtwarpError(f"the file is longer than its header says: {rest}")
    return columns


def _first_row(body: bytes, place: int, element: _Element, order: str) -> tuple[np.dtype, dict[int, int]]:
    """Return the type of an element's first row, and the lengths of the lists in it, by the property's number."""
    fields: list[tuple] = []
    lengths: dict[int, int] = {}
    for k, part in enumerate(element.properties):
        if part.length is not None:
            length = _length(body, place + np.dtype(fields).itemsize, np.dtype(order + part.length))
            lengths[k] = length if 0 <= length * np.dtype(part.type).itemsize <= len(body) else 0
            fields.append((f"n{k}", order + part.length))
        fields.append((f"v{k}", order + part.type, (lengths[k],) if k in lengths else ()))
    return np.dtype(fields), lengths


def _length(body: bytes, place: int, kind: np.dtype) -> int:
    """Return the length of a list; -1 where the body ends before it, or before its values.

    Raises:
        OmtwarpError: it is no whole number.
    """
    if place + kind.itemsize > len(body):
        return -1
    value = float(np.frombuffer(body, kind, 1, place)[0])
    if not value.is_integer():
        raise OmtwarpError(f"lengths of lists must be whole numbers, not {value:g}")
    return int(value) if 0.0 <= value <= len(body) else -1


def _uneven_rows(
    body: bytes, place: int, element: _Element, order: str, elements: list[_Element]
) -> tuple[int, dict[str, Column]]:
    """Read the rows of an element whose lists differ in length, one by one; return them and their end.

    Raises:
        OmtwarpError: the file ends before the rows do.
    """
    values: list[list] = [[] for _ in element.properties]
    sizes: list[list[int]] = [[] for _ in element.properties]
    types = [(part.type, part.length) for part in element.properties]
    kinds = [(np.dtype(order + kind), length and np.dtype(order + length)) for kind, length in types]
    for _ in range(element.count):
        for k, (kind, length) in enumerate(kinds):
            count = 1
            if length:
                count = _length(body, place, length)
                place += length.itemsize
                sizes[k].append(count)
            if count < 0 or place + count * kind.itemsize > len(body):
                raise _cut(elements)
            values[k].append(np.frombuffer(body, kind, count, place))
            place += count * kind.itemsize
    columns: dict[str, Column] = {}
    for k, part in enumerate(element.properties):
        flat = np.concatenate([*values[k], np.empty(0, kinds[k][0])])
        columns[part.name] = flat if part.length is None else (np.array(sizes[k], dtype=np.int64), flat)
    return place, columns
