"""Writing meshes with materials: GLB, and OBJ with MTL and PNG."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import companion, staged
from omtwarp.materials.base import Bytes, PaintedArrays
from omtwarp.materials.gltf import glb_bytes
from omtwarp.options import TextureFormat
from omtwarp.texturing.export import format_for
from omtwarp.texturing.image import png_bytes
from omtwarp.texturing.textured import vertex_normals

SUFFIXES = (".glb", ".obj")
# Statements of a material library that name a picture; `norm` and `map_ao` are read by Blender's and other importers.
_SLOTS = (
    ("map_Kd", "picture", "color"),
    ("norm", "normal_picture", "normal"),
    ("map_ao", "occlusion_picture", "occlusion"),
    ("map_Ke", "emission_picture", "emission"),
)


def export(
    mesh: PaintedArrays,
    path: str | os.PathLike[str],
    *,
    keep: Iterable[Path | None] = (),
    texture_format: str = TextureFormat.PNG,
) -> list[Path]:
    """Write a mesh with materials in the format of the path's suffix.

    Args:
        mesh: what to write.
        path: ``.glb`` or ``.obj``.
        keep: files that must not be replaced, such as inputs.
        texture_format: ``png`` or, in a .glb, ``webp``.

    Returns:
        The files written, the named one last.

    Raises:
        OmtwarpError: another suffix or format, a place that cannot be written to, a full disk.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise OmtwarpError(f"cannot write '{path}': a mesh with materials is written as .glb or .obj")
    encoding = format_for(suffix, texture_format)
    kept = tuple(keep)
    with staged(path, keep=kept) as file:
        files = [(file, glb_bytes(mesh, encoding))] if suffix == ".glb" else obj_files(mesh, file, keep=kept)
        for name, content in files:
            name.write_bytes(content)
    return [Path(path).with_name(name.name) for name, _ in files[:-1]] + [Path(path)]


def obj_files(mesh: PaintedArrays, place: Path, *, keep: Iterable[Path | None] = ()) -> list[tuple[Path, bytes]]:
    """Return the files of an OBJ: pictures and material library first, the OBJ last.

    Vertices are written once and in their order, faces material by material.
    """
    kept = tuple(keep)
    materials = np.unique(mesh.material_of)
    names = _names([mesh.materials[number].name for number in materials])
    library = ["# omtwarp"]
    pictures: dict[int, tuple[Path, bytes]] = {}
    for number, name in zip(materials, names, strict=True):
        material = mesh.materials[number]
        red, green, blue, opacity = material.color
        library += [
            f"newmtl {name}",
            f"Kd {red:.6f} {green:.6f} {blue:.6f}",
            "Ks 0.000 0.000 0.000",
            f"d {opacity:.6f}",
            "illum 1",
            f"Pr {material.roughness:.4f}",
            f"Pm {material.metallic:.4f}",
        ]
        for statement, slot, ending in _SLOTS:
            picture: Bytes | None = getattr(material, slot)
            if picture is None or mesh.uv is None:
                continue
            if id(picture) not in pictures:
                there = companion(place, f"-{name}-{ending}.png", kept)
                pictures[id(picture)] = (there, png_bytes(picture))
            library.append(f"{statement} {pictures[id(picture)][0].name}")
        library.append("")
    written = companion(place, ".mtl", kept)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    text = ["# omtwarp\n", f"mtllib {written.name}\no surface\n"]
    text += [_lines("v", mesh.vertices, "%.17g"), _lines("vn", normals, "%.5f")]
    index: NDArray | None = None
    if mesh.uv is not None:
        flat = mesh.uv.reshape(-1, 2)
        known = np.isfinite(flat).all(axis=1)
        table, inverse = np.unique(flat[known], axis=0, return_inverse=True)
        numbers = np.zeros(len(flat), dtype=np.int64)
        numbers[known] = inverse.reshape(-1) + 1
        index = numbers.reshape(-1, 3)
        text.append(_lines("vt", table, "%.9g"))
    for number, name in zip(materials, names, strict=True):
        text.append(f"usemtl {name}\ns 1\n")
        of_it = mesh.material_of == number
        v = mesh.faces[of_it] + 1
        if index is None or (index[of_it] == 0).any():
            text.append(_corners(np.stack([v, v], axis=2), "%d//%d"))
        else:
            text.append(_corners(np.stack([v, index[of_it], v], axis=2), "%d/%d/%d"))
    return [*pictures.values(), (written, "\n".join(library).encode()), (place, "".join(text).encode())]


def _names(given: list[str]) -> list[str]:
    """Return distinct names of materials without spaces, which can also be names of files."""
    names: list[str] = []
    for name in given:
        word = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "material"
        taken = word
        number = 2
        while taken in names:
            taken, number = f"{word}-{number}", number + 1
        names.append(taken)
    return names


def _corners(rows: NDArray, form: str) -> str:
    line = f"f {form} {form} {form}\n"
    return (line * len(rows)) % tuple(rows.reshape(-1).tolist())


def _lines(prefix: str, rows: NDArray, form: str) -> str:
    line = prefix + " " + " ".join([form] * rows.shape[1]) + "\n"
    return (line * len(rows)) % tuple(rows.ravel().tolist())


__all__ = ["SUFFIXES", "export", "obj_files"]
