"""Wavefront OBJ and its material library MTL: texture coordinates per corner, a material per face."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.polygons import fans
from omtwarp.mesh.read import require_counted_from_one
from omtwarp.texturing.materials import Bytes, Floats, Ints, Material

_STATEMENT = re.compile(rb"^[ \t]*(vt|v|f|usemtl|mtllib)[ \t]+([^\n#]*)|^[ \t]*(usemtl)[ \t]*$", flags=re.MULTILINE)

# How many values the options of a picture in a material library take.
_OPTIONS = {
    "-blendu": 1, "-blendv": 1, "-boost": 1, "-mm": 2, "-o": 3, "-s": 3, "-t": 3, "-texres": 1, "-clamp": 1, "-bm": 1,
    "-imfchan": 1, "-type": 1,
}  # fmt: skip


@dataclass
class Wavefront:
    """The content of an OBJ file.

    Attributes:
        vertices: float64, shape [V, 3].
        faces: int64, shape [F, 3].
        uv: shape [F, 3, 2], NaN where a triangle has none; None where none has any.
        face_material: number in ``names`` for every triangle, shape [F].
        names: of the materials used, in the order of their first use; the empty one for triangles without.
        libraries: names of the material libraries.
        colors: at the vertices, shape [V, 3], where every one has them.
        notes: what had to be decided, in words.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    uv: Floats | None
    face_material: Ints
    names: list[str]
    libraries: list[str]
    colors: NDArray[np.float64] | None = None
    notes: list[str] = field(default_factory=list)


def read_obj(text: bytes) -> Wavefront:
    """Read the geometry, coordinates and names of materials of an OBJ file, in the order of ``read_mesh``.

    Args:
        text: the file, in UTF-8.

    Raises:
        OmtwarpError: no faces, or one with fewer than three corners.
        ValueError: words where numbers belong.
    """
    found = _statements(text)
    if not found.sizes:
        raise OmtwarpError("not a triangle mesh: no faces in it")
    counts = np.array(found.sizes)
    split = [word.split(b"/") for word in found.corners]
    ahead = np.repeat(np.array(found.before), counts, axis=0)
    vertex = np.array([int(parts[0]) for parts in split], dtype=np.int64)
    require_counted_from_one(vertex)
    vertex = np.where(vertex < 0, vertex + ahead[:, 0], vertex - 1)
    which = np.array([int(parts[1]) if len(parts) > 1 and parts[1] else 0 for parts in split], dtype=np.int64)
    given = which != 0
    which = np.where(which < 0, which + ahead[:, 1], which - 1)
    rows, notes = fans(np.arange(len(vertex)), counts)
    face = np.repeat(np.arange(len(counts)), counts)[rows[:, 0]]
    uv = None
    if given.any() and found.coordinates:
        table = np.array([[*row, b"0"][:2] for row in found.coordinates], dtype=np.float64)
        if which[given].max() >= len(table) or which[given].min() < 0:
            raise OmtwarpError(f"a face refers to texture coordinates {which[given].max() + 1} of {len(table)}")
        at_corner = np.full((len(vertex), 2), np.nan)
        at_corner[given] = table[which[given]]
        uv = at_corner[rows]
    points = found.points
    colored = bool(points) and all(len(row) >= 6 for row in points)
    return Wavefront(
        vertices=np.array([row[:3] for row in points], dtype=np.float64),
        faces=vertex[rows],
        uv=uv,
        face_material=np.array(found.used, dtype=np.int32)[face],
        names=list(found.names),
        libraries=found.libraries,
        colors=np.array([row[3:6] for row in points], dtype=np.float64) if colored else None,
        notes=notes,
    )


@dataclass
class _Statements:
    """The statements of an OBJ file, sorted by what they say.

    Attributes:
        points: words behind ``v``.
        coordinates: the first two words behind ``vt``.
        corners: words behind ``f``, of all faces one after another.
        sizes: how many of them each face has.
        before: how many points and coordinates stand before each face, from which negative numbers count.
        used: number of each face's material.
        names: number of every material used, by its name.
        libraries: words behind ``mtllib``.
    """

    points: list[list[bytes]] = field(default_factory=list)
    coordinates: list[list[bytes]] = field(default_factory=list)
    corners: list[bytes] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)
    before: list[tuple[int, int]] = field(default_factory=list)
    used: list[int] = field(default_factory=list)
    names: dict[str, int] = field(default_factory=dict)
    libraries: list[str] = field(default_factory=list)


def _statements(text: bytes) -> _Statements:
    """Sort the statements of an OBJ file."""
    found = _Statements()
    joined = text.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").replace(b"\r", b"\n")
    current = ""
    for match in _STATEMENT.finditer(joined):
        kind, rest = match.group(1) or b"usemtl", match.group(2) or b""
        if kind == b"v":
            found.points.append(rest.split())
        elif kind == b"vt":
            found.coordinates.append(rest.split()[:2])
        elif kind == b"f":
            words = rest.split()
            found.corners += words
            found.sizes.append(len(words))
            found.before.append((len(found.points), len(found.coordinates)))
            found.used.append(found.names.setdefault(current, len(found.names)))
        elif kind == b"usemtl":
            current = rest.decode("utf-8", "replace").strip()
        else:
            found.libraries.append(rest.decode("utf-8", "replace").strip())
    return found


def read_mtl(text: str, picture: Callable[[str], Bytes | None]) -> dict[str, Material]:
    """Read the materials of a library by name.

    Args:
        text: the library.
        picture: reads a picture by its name, None where there is none.
    """
    found: dict[str, Material] = {}
    name = ""
    for line in text.splitlines():
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        key, values = words[0].lower(), words[1:]
        if key == "newmtl":
            name = " ".join(values)
            found[name] = Material(name=name)
            continue
        if name not in found:
            continue
        found[name] = _with(found[name], key, values, picture)
    return found


def _with(material: Material, key: str, values: list[str], picture: Callable[[str], Bytes | None]) -> Material:
    """Apply one statement of a library to a material."""
    if key == "map_kd":
        return replace(material, picture=picture(_picture_name(values)))
    if key == "norm":
        return replace(material, normal_picture=picture(_picture_name(values)))
    if key == "map_ke":
        return replace(material, emission_picture=picture(_picture_name(values)))
    try:
        numbers = [float(word) for word in values]
    except ValueError:
        return material
    if not numbers or not np.isfinite(numbers).all():
        return material
    first = min(max(numbers[0], 0.0), 1.0)
    if key == "kd":
        red, green, blue = np.clip((numbers * 3)[:3], 0.0, 1.0)
        return replace(material, color=(float(red), float(green), float(blue), material.color[3]))
    if key in ("d", "tr"):
        return replace(material, color=(*material.color[:3], first if key == "d" else 1.0 - first))
    if key == "pr":
        return replace(material, roughness=first)
    if key == "pm":
        return replace(material, metallic=first)
    return material


def _picture_name(words: list[str]) -> str:
    """Return the file's name from the words after ``map_Kd``, which may begin with options."""
    rest = list(words)
    while rest and rest[0].lower() in _OPTIONS:
        taken = _OPTIONS[rest.pop(0).lower()]
        while taken and len(rest) > 1 and re.fullmatch(r"[-+.0-9eE]+|on|off|[a-z]", rest[0]):
            rest.pop(0)
            taken -= 1
    return " ".join(rest)


__all__ = ["Wavefront", "read_mtl", "read_obj"]
