"""Reading a triangle mesh from a file without changing it: vertices and faces in the order in which the file has them.

Formats are read by trimesh, brain surfaces by nibabel. Where a general reader would silently reorder, split, merge or
triangulate, the readers here keep the file's own mesh or raise an error.
"""

from __future__ import annotations

import codecs
import io
import os
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import as_path
from omtwarp.inputs import read_arrays, read_bytes
from omtwarp.limits import LARGEST_MESH_FILE, MOST_FACES
from omtwarp.mesh.arrays import whole_numbers
from omtwarp.mesh.neuro import nibabel_module, require_files_beside
from omtwarp.mesh.ply import read_ply
from omtwarp.mesh.polygons import fans
from omtwarp.mesh.scenes import load_scene, placed_meshes, scene_formats
from omtwarp.mesh.vtk import read_vtk, read_vtk_xml

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class MeshFile:
    """A mesh as a file holds it; not yet checked.

    Attributes:
        vertices: float64, shape [V, 3].
        faces: int64, shape [F, 3].
        notes: decisions made while reading, in words; empty for most files.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    notes: tuple[str, ...] = ()


def read_mesh(path: str | os.PathLike[str], *, triangulate: bool = False, together: bool | None = None) -> MeshFile:
    """Read a mesh.

    Args:
        path: a file of any format that trimesh reads (ply, obj, off, stl, glb, gltf, ...), a map or mesh in ``.npz``
            (``vertices``, ``faces``), GIFTI (``.gii``, ``.gii.gz``) or a FreeSurfer surface of any name; the last two
            need nibabel.
        triangulate: cut faces with more than three corners into triangles instead of refusing them.
        together: take several geometries of a scene together instead of refusing them; None does as ``triangulate``.

    Returns:
        Vertices and faces in the file's order. STL has no vertices of its own: equal corners become one vertex there,
        in the order in which they first appear.

    Raises:
        OmtwarpError: a missing or unreadable file, no triangles in it, faces with more than three corners, or several
            geometries.

    Example:
        >>> import omtwarp
        >>> from omtwarp.mesh.write import write_mesh
        >>> surface = omtwarp.shapes.icosphere(2)
        >>> _ = write_mesh("ball.ply", surface.vertices, surface.faces)
        >>> mesh = omtwarp.read_mesh("ball.ply")
        >>> mesh.vertices.dtype.name, mesh.faces.shape == surface.faces.shape
        ('float64', True)
    """
    file = as_path(path)
    data = read_bytes(file, LARGEST_MESH_FILE, "mesh file")
    suffix = _suffix(file)
    try:
        with warnings.catch_warnings(action="ignore"):  # about guesses of parsers; results are checked below
            reader = _reader(suffix, data)
            split = triangulate if together is None or reader is not _read_scene else together
            vertices, faces, notes = reader(data, file, split)
        if np.ndim(vertices) != 2 or np.shape(vertices)[1] != 3 or np.ndim(faces) != 2 or np.shape(faces)[1] != 3:
            raise OmtwarpError("not a triangle mesh: no list of triangles in it")
        corners = whole_numbers(faces, "faces", (None, 3))
        mesh = MeshFile(np.ascontiguousarray(vertices, np.float64), corners, tuple(notes))
    except OmtwarpError as error:
        raise OmtwarpError(f"{file}: {error}") from None
    except MemoryError:
        raise
    except Exception as error:  # any failure of a parser means that the file is not what its suffix says
        detail = " ".join(str(error).split())[:160] or type(error).__name__
        raise OmtwarpError(f"{file}: cannot be read as {suffix or 'a mesh'}: {detail}") from None
    if len(mesh.faces) > MOST_FACES:
        raise OmtwarpError(f"{file}: {len(mesh.faces):,} triangles, and {MOST_FACES:,} is the most")
    return mesh


_Read = tuple[NDArray[np.generic], NDArray[np.generic], list[str]]


def _suffix(file: Path) -> str:
    """Return the suffix that determines the format, in lower case, without the dot."""
    name = file.name.lower()
    return "gii" if name.endswith(".gii.gz") else name.rpartition(".")[2] if "." in name else ""


def _reader(suffix: str, data: bytes) -> Callable[[bytes, Path, bool], _Read]:
    """Return the function that reads a format, known by its suffix or, for FreeSurfer, by its first bytes."""
    own = {
        "npz": _read_npz,
        "ply": _read_ply,
        "obj": _read_obj,
        "off": _read_off,
        "stl": _read_stl,
        "gii": _read_gifti,
        "vtk": _read_vtk,
        "vtp": _read_vtk_xml,
        "vtu": _read_vtk_xml,
    }
    if suffix in own:
        return own[suffix]
    if data[:3] in (b"\xff\xff\xfe", b"\xff\xff\xff", b"\xff\xff\xfd"):  # triangles, and the two old kinds of quads
        return _read_freesurfer
    return _read_scene


def _read_npz(data: bytes, file: Path, triangulate: bool) -> _Read:
    arrays = read_arrays(io.BytesIO(data), ("vertices", "faces"))
    if len(arrays) < 2:
        raise OmtwarpError("no arrays 'vertices' and 'faces' in it")
    if arrays["vertices"].dtype.kind not in "iuf" or arrays["faces"].dtype.kind not in "iu":
        raise OmtwarpError("'vertices' are not real numbers, or 'faces' not whole ones")
    return arrays["vertices"], arrays["faces"], []


def _read_ply(data: bytes, file: Path, triangulate: bool) -> _Read:
    vertices, corners, sizes = read_ply(utf8(data))
    return vertices, *fans(corners, sizes, triangulate)


def utf8(data: bytes) -> bytes:
    """Remove a byte order mark from a text, and convert to UTF-8 what the mark says is in another encoding."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16").encode("utf-8")
    return data.removeprefix(codecs.BOM_UTF8)


def _read_off(data: bytes, file: Path, triangulate: bool) -> _Read:
    """Read the Object File Format by its lines; values after coordinates and corners, such as colours, are ignored."""
    lines = [line.split() for line in re.sub(rb"#[^\n]*", b"", utf8(data)).replace(b"\r", b"\n").split(b"\n")]
    lines = [line for line in lines if line]
    if lines and lines[0][0].endswith(b"OFF"):
        lines[0].pop(0)  # the counts may be on the line of the keyword
        lines = lines if lines[0] else lines[1:]
    vertex_count, face_count = (int(word) for word in lines[0][:2])
    if vertex_count < 0 or face_count < 0:
        raise OmtwarpError(f"damaged: {vertex_count} vertices and {face_count} faces announced")
    if len(lines) < 1 + vertex_count + face_count:
        announced = f"{vertex_count} vertices and {face_count} faces announced"
        raise OmtwarpError(f"cut short: {announced}, {len(lines) - 1} lines there")
    vertices = np.array([line[:3] for line in lines[1 : 1 + vertex_count]], dtype=np.float64)
    rows = lines[1 + vertex_count : 1 + vertex_count + face_count]
    polygons = [line[1 : 1 + int(line[0])] for line in rows]
    short = [k for k, polygon in enumerate(polygons) if len(polygon) != int(rows[k][0])]
    if short:
        raise OmtwarpError(f"cut short: face {short[0]} has fewer corners than it announces")
    return vertices, *_from_polygons(polygons, triangulate)


def _read_obj(data: bytes, file: Path, triangulate: bool) -> _Read:
    """Read a Wavefront OBJ by its ``v`` and ``f`` lines alone.

    Its texture coordinates, normals, materials and groups make a general reader split, drop and reorder vertices.
    """
    text = utf8(data).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").replace(b"\r", b"\n")
    lines = re.findall(rb"^[ \t]*([vf])[ \t]+([^\n#]*)", text, flags=re.MULTILINE)
    vertices = np.array([rest.split()[:3] for kind, rest in lines if kind == b"v"], dtype=np.float64)
    polygons = [[word.partition(b"/")[0] for word in rest.split()] for kind, rest in lines if kind == b"f"]
    vertices_before = np.cumsum([kind == b"v" for kind, _ in lines])[[kind == b"f" for kind, _ in lines]]
    return vertices, *_from_polygons(polygons, triangulate, vertices_before)


def _from_polygons(
    polygons: list[list[bytes]], triangulate: bool, vertices_before: NDArray | None = None
) -> tuple[NDArray[np.generic], list[str]]:
    """Convert the polygons of a text file, lists of corners, to triangles.

    ``vertices_before`` says that corners count from 1, or if negative back from the last vertex before their face.
    """
    if not polygons:
        raise OmtwarpError("not a triangle mesh: no faces in it")
    corners = np.array([len(polygon) for polygon in polygons])
    flat = np.array([int(word) for polygon in polygons for word in polygon], dtype=np.int64)
    if vertices_before is not None:
        require_counted_from_one(flat)
        flat = np.where(flat < 0, flat + np.repeat(vertices_before, corners), flat - 1)
    return fans(flat, corners, triangulate)


def require_counted_from_one(corners: NDArray[np.int64]) -> None:
    """Refuse a Wavefront OBJ whose faces refer to vertex 0.

    Raises:
        OmtwarpError: there is such a face.
    """
    if (corners == 0).any():
        raise OmtwarpError("a face refers to vertex 0, and OBJ counts vertices from 1: the file counts from 0")


def _read_stl(data: bytes, file: Path, triangulate: bool) -> _Read:
    count = int.from_bytes(data[80:84], "little")
    whole = 84 + 50 * count  # a head, a count, and for every triangle twelve numbers and an attribute
    binary = len(data) >= 84 and (len(data) == whole or not data.lstrip()[:5].lower() == b"solid")
    if binary and len(data) < whole:
        raise OmtwarpError(f"cut short: {count} triangles announced, {(len(data) - 84) // 50} there")
    if not binary and b"\0" in data:
        raise OmtwarpError("neither a binary STL file nor one of text")
    if not binary and b"endsolid" not in data.lower():
        raise OmtwarpError("cut short, or not an STL file: it does not end with 'endsolid'")
    if binary:
        record = np.dtype([("numbers", "<f4", (4, 3)), ("attribute", "<u2")])  # a normal, three corners
        corners = np.frombuffer(data, record, count, 84)["numbers"][:, 1:].reshape(-1, 3).astype(np.float64)
    else:
        points, faces, _ = _single_geometry(load_scene(data, file, "stl_ascii"), triangulate)
        corners = points[faces.ravel()]
    corners = corners + 0.0  # plus zero: makes -0 and 0 the same bits
    _, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # vertices in the order of their first appearance
    place = np.argsort(order)
    note = f"STL stores no shared vertices: {len(corners)} corners became {len(first)} vertices where equal"
    return corners[first[order]], place[inverse.reshape(-1)].reshape(-1, 3), [note]


def _read_gifti(data: bytes, file: Path, triangulate: bool) -> _Read:
    nibabel = nibabel_module()
    require_files_beside(file)
    image = nibabel.load(file)
    points, triangles = image.get_arrays_from_intent("pointset"), image.get_arrays_from_intent("triangle")
    if len(points) != 1 or len(triangles) != 1:
        raise OmtwarpError(f"{len(points)} point sets and {len(triangles)} lists of triangles in it, not one of each")
    return points[0].data, triangles[0].data, []


def _read_vtk(data: bytes, file: Path, triangulate: bool) -> _Read:
    points, corners, sizes = read_vtk(data)
    return points, *fans(corners, sizes, triangulate)


def _read_vtk_xml(data: bytes, file: Path, triangulate: bool) -> _Read:
    points, corners, sizes = read_vtk_xml(data)
    return points, *fans(corners, sizes, triangulate)


def _read_freesurfer(data: bytes, file: Path, triangulate: bool) -> _Read:
    vertices, faces = nibabel_module().freesurfer.read_geometry(file)[:2]
    return vertices, faces, []


def _read_scene(data: bytes, file: Path, triangulate: bool) -> _Read:
    suffix = _suffix(file)
    known = {*scene_formats(), "npz", "gii", "vtk", "vtp", "vtu"}
    if suffix not in known:
        raise OmtwarpError(f"unknown format '.{suffix}': known are {', '.join(sorted(known))}")
    return _single_geometry(load_scene(data, file, suffix, pictures=False), triangulate)


def _single_geometry(scene: trimesh.Scene, together: bool) -> tuple[NDArray[np.float64], NDArray[np.int64], list[str]]:
    """Return the only mesh of a scene, moved to the place that the scene gives it."""
    meshes = placed_meshes(scene)
    if not meshes:
        raise OmtwarpError("not a triangle mesh: no triangles in it")
    if len(meshes) > 1 and not together:
        names = ", ".join(name for name, *_ in meshes[:4]) + (", ..." if len(meshes) > 4 else "")
        raise OmtwarpError(
            f"{len(meshes)} geometries in one scene ({names}), first '{meshes[0][0]}'; save the one to be mapped by "
            "itself, or take the largest with --repair"
        )
    vertices, faces, start = [], [], 0
    for _, _, points, triangles in meshes:
        vertices.append(points)
        faces.append(triangles + start)
        start += len(points)
    notes = [f"took {len(meshes)} geometries together"] if len(meshes) > 1 else []
    return np.concatenate(vertices), np.concatenate(faces), notes


__all__ = ["MeshFile", "read_mesh", "require_counted_from_one", "utf8"]
