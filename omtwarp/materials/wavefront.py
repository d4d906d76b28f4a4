"""Wavefront OBJ and its material library MTL: texture coordinates per corner, a material per face."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.materials.base import Bytes, Floats, Ints, Material
from omtwarp.mesh.read import fans

_STATEMENT = re.compile(rb"^[ \t]*(vt|v|f|usemtl|mtllib)[ \t]+([^\n#]*)|^[ \t]*(usemtl)[ \t]*$", flags=re.MULTILINE)
_SLOTS = {"map_kd": "picture", "norm": "normal_picture", "map_ke": "emission_picture"}
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
        faces: int32, shape [F, 3].
        uv: shape [F, 3, 2], NaN where a triangle has none; None where none has any.
        face_material: number in ``names`` for every triangle, shape [F].
        names: of the materials used, in the order of their first use; the empty one for triangles without.
        libraries: names of the material libraries.
        colors: at the vertices, shape [V, 3], where every one has them.
        notes: what had to be decided, in words.
    """

    vertices: Floats
    faces: Ints
    uv: Floats | None
    face_material: Ints
    names: list[str]
    libraries: list[str]
    colors: NDArray[np.float64] | None = None
    notes: list[str] = field(default_factory=list)


def read_obj(text: bytes, triangulate: bool) -> Wavefront:
    """Read the geometry, coordinates and names of materials of an OBJ file, in the order of ``read_mesh``.

    Args:
        text: the file, in UTF-8.
        triangulate: cut larger faces into fans instead of refusing them.

    Raises:
        OmtwarpError: no triangles, or faces with more corners.
        ValueError: words where numbers belong.
    """
    joined = text.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").replace(b"\r", b"\n")
    points: list[list[bytes]] = []
    coordinates: list[list[bytes]] = []
    corners: list[bytes] = []
    before: list[tuple[int, int]] = []
    sizes: list[int] = []
    used: list[int] = []
    names: dict[str, int] = {}
    libraries: list[str] = []
    current = ""
    for match in _STATEMENT.finditer(joined):
        kind, rest = match.group(1) or b"usemtl", match.group(2) or b""
        if kind == b"v":
            points.append(rest.split())
        elif kind == b"vt":
            coordinates.append(rest.split()[:2])
        elif kind == b"f":
            words = rest.split()
            corners += words
            sizes.append(len(words))
            before.append((len(points), len(coordinates)))
            used.append(names.setdefault(current, len(names)))
        elif kind == b"usemtl":
            current = rest.decode("utf-8", "replace").strip()
        else:
            libraries.append(rest.decode("utf-8", "replace").strip())
    if not sizes:
        raise OmtwarpError("not a triangle mesh: no faces in it")
    counts = np.array(sizes)
    split = [word.split(b"/") for word in corners]
    ahead = np.repeat(np.array(before), counts, axis=0)
    vertex = np.array([int(parts[0]) for parts in split], dtype=np.int64)
    vertex = np.where(vertex < 0, vertex + ahead[:, 0], vertex - 1)
    which = np.array([int(parts[1]) if len(parts) > 1 and parts[1] else 0 for parts in split], dtype=np.int64)
    given = which != 0
    which = np.where(which < 0, which + ahead[:, 1], which - 1)
    rows, notes = fans(np.arange(len(vertex)), counts, triangulate)
    face = np.repeat(np.arange(len(counts)), counts)[rows[:, 0]]
    uv = None
    if given.any() and coordinates:
        table = np.array([[*row, b"0"][:2] for row in coordinates], dtype=np.float64)
        if which[given].max() >= len(table) or which[given].min() < 0:
            raise OmtwarpError(f"a face asks for texture coordinates {which[given].max() + 1} of {len(table)}")
        at_corner = np.full((len(vertex), 2), np.nan)
        at_corner[given] = table[which[given]]
        uv = at_corner[rows]
    colored = bool(points) and all(len(row) >= 6 for row in points)
    return Wavefront(
        vertices=np.array([row[:3] for row in points], dtype=np.float64),
        faces=vertex[rows].astype(np.int32),
        uv=uv,
        face_material=np.array(used, dtype=np.int32)[face],
        names=list(names),
        libraries=libraries,
        colors=np.array([row[3:6] for row in points], dtype=np.float64) if colored else None,
        notes=notes,
    )


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
    if key in _SLOTS:
        found: dict[str, Any] = {_SLOTS[key]: picture(_picture_name(values))}
        return replace(material, **found)
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
    """The name of the file among the words behind ``map_Kd``, after its options."""
    rest = list(words)
    while rest and rest[0].lower() in _OPTIONS:
        taken = _OPTIONS[rest.pop(0).lower()]
        while taken and len(rest) > 1 and re.fullmatch(r"[-+.0-9eE]+|on|off|[a-z]", rest[0]):
            rest.pop(0)
            taken -= 1
    return " ".join(rest)


__all__ = ["Wavefront", "read_mtl", "read_obj"]
