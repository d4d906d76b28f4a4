"""Reading a triangle mesh from a file without changing it: vertices and faces in the order in which the file has them.

Formats are read by trimesh, brain surfaces by nibabel. Where a general reader would silently reorder, split or merge,
the readers here keep the file's own mesh or raise an error; what they decide is in notes.

GLB, and other formats with one row of attributes for every vertex, hold a vertex twice where two charts of a texture or
two materials meet. The surface is closed nevertheless; only its numbering is not: :func:`read_joined_mesh` joins them.
"""

from __future__ import annotations

import codecs
import gzip
import io
import os
import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import read_arrays, read_bytes, read_up_to, reading
from omtwarp.files.limits import LARGEST_MESH_FILE, MOST_FACES, amount
from omtwarp.files.output import as_path
from omtwarp.mesh import other_formats
from omtwarp.mesh.arrays import Indices, InOneLine, whole_number, whole_numbers
from omtwarp.mesh.neuro import copied, load_gifti, nibabel_module
from omtwarp.mesh.origins import Derived, Origins
from omtwarp.mesh.other_formats import MESHIO_FORMATS, WAYS_ROUND
from omtwarp.mesh.ply import read_ply
from omtwarp.mesh.polygons import Triangles, fans, taken_together
from omtwarp.mesh.scenes import load_scene, placed_meshes, scene_formats
from omtwarp.mesh.validate import Topology, components_of
from omtwarp.mesh.volumes import MOST_ROUNDS, ROUNDS, VOLUMES, label_surfaces
from omtwarp.mesh.vtk import read_vtk, read_vtk_xml

if TYPE_CHECKING:
    from omtwarp.mesh.repair import Repaired


@dataclass(frozen=True, repr=False)
class MeshFile(InOneLine):
    """A mesh as a file holds it; not yet checked.

    Attributes:
        vertices: float64, shape [V, 3].
        faces: int64, shape [F, 3].
        notes: decisions made while reading, in words; empty for most files.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    notes: tuple[str, ...] = ()


def read_mesh(path: str | os.PathLike[str], *, together: bool = False, smoothing: int | None = None) -> MeshFile:
    """Read a mesh.

    Args:
        path: a file of any format that trimesh reads (ply, obj, off, stl, glb, gltf, ...), a map or mesh in ``.npz``
            (``vertices``, ``faces``), VTK, GIFTI or a FreeSurfer surface of any name (both need nibabel), a volume of
            labels (:mod:`omtwarp.mesh.volumes`), whose surfaces are taken together, and those of
            :data:`omtwarp.mesh.other_formats.MESHIO_FORMATS` (which need meshio); compressed by gzip or not.
        together: take several geometries of a scene together instead of refusing them.
        smoothing: rounds of Taubin's filter that the surfaces of a volume's labels are smoothed by, 0 to 1000; by
            default 20.

    Returns:
        Vertices and faces in the file's order. STL has no vertices of its own: equal corners become one vertex there,
        in the order in which they first appear. Faces with more than three corners are cut into fans of triangles, and
        the notes say how many.

    Raises:
        OmtwarpError: a missing or unreadable file, no triangles in it, or several geometries.

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
    data, suffix = mesh_content(file)
    with reading(file, suffix or "a mesh", len(data)):
        if suffix in VOLUMES:
            rounds = ROUNDS if smoothing is None else whole_number(smoothing, "smoothing", most=MOST_ROUNDS)
            read: Triangles = label_surfaces(data, suffix, rounds)
        elif smoothing is not None:
            raise OmtwarpError("smoothing is for the surfaces of a volume's labels: leave it out for a mesh")
        elif suffix in _OWN:
            read = _OWN[suffix](data)
        elif suffix == "gii":
            read = _read_gifti(file)
        else:
            read = _read_scene(data, file, suffix, together)
        vertices, faces, notes = read
        if np.ndim(vertices) != 2 or np.shape(vertices)[1] != 3 or np.ndim(faces) != 2 or np.shape(faces)[1] != 3:
            raise OmtwarpError("not a triangle mesh: no list of triangles in it")
        corners = whole_numbers(faces, "faces", (None, 3))
        mesh = MeshFile(np.ascontiguousarray(vertices, np.float64), corners, tuple(notes))
    if len(mesh.faces) > MOST_FACES:
        raise OmtwarpError(f"{file}: {len(mesh.faces):,} triangles, and {MOST_FACES:,} is the most")
    return mesh


_FREESURFER = (b"\xff\xff\xfe", b"\xff\xff\xff", b"\xff\xff\xfd")  # triangles, and the two old kinds of quads


def mesh_content(file: Path) -> tuple[bytes, str]:
    """Read a file of a mesh, and inflate it where it is compressed by gzip.

    Returns:
        Its bytes, and the suffix that determines the format, in lower case, without the dot: that of the name, or one
        of ours where the first bytes say more: ``freesurfer``, ``freesurfer text``, ``mni``.

    Raises:
        OmtwarpError: the file cannot be read, or inflates too far.
    """
    data = read_bytes(file, LARGEST_MESH_FILE, "mesh file")
    name = file.name.lower().removesuffix(".gz")
    if data.startswith(b"\x1f\x8b"):
        try:
            with gzip.open(io.BytesIO(data)) as stream:
                data = read_up_to(stream.read, LARGEST_MESH_FILE)
        except EOFError:
            raise OmtwarpError(f"{file}: cut short: its compressed data have no end") from None
        except (OSError, zlib.error) as error:  # also where other bytes follow the end
            raise OmtwarpError(f"{file}: damaged, or longer than its compressed data: {error}") from None
        if len(data) > LARGEST_MESH_FILE:
            raise OmtwarpError(f"{file}: inflates to more than {amount(LARGEST_MESH_FILE)}, which is the most")
    suffix = name.rpartition(".")[2] if "." in name else ""
    if data.startswith(b"#!ascii"):
        suffix = "freesurfer text"
    elif data.startswith(_FREESURFER) and suffix not in (*_OWN, "gii"):
        suffix = "freesurfer"
    elif suffix == "obj" and data.lstrip()[:2] in (b"P ", b"P\t"):
        suffix = "mni"
    return data, suffix


CUT = "its handles were cut open for a map"


def _read_npz(data: bytes) -> Triangles:
    arrays = read_arrays(io.BytesIO(data), ("vertices", "faces", "loop_pairs"))
    if not {"vertices", "faces"} <= arrays.keys():
        raise OmtwarpError("no arrays 'vertices' and 'faces' in it")
    if arrays["vertices"].dtype.kind not in "iuf" or arrays["faces"].dtype.kind not in "iu":
        raise OmtwarpError("'vertices' are not real numbers, or 'faces' not whole ones")
    return arrays["vertices"], arrays["faces"], [CUT] if "loop_pairs" in arrays else []


def _read_ply(data: bytes) -> Triangles:
    vertices, corners, sizes, notes = read_ply(utf8(data))
    faces, cut = fans(corners, sizes)
    return vertices, faces, [*notes, *cut]


def utf8(data: bytes) -> bytes:
    """Remove a byte order mark from a text, and convert to UTF-8 what the mark says is in another encoding."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16").encode("utf-8")
    return data.removeprefix(codecs.BOM_UTF8)


def _read_off(data: bytes) -> Triangles:
    """Read the Object File Format by its lines; values after coordinates and corners, such as colours, are ignored."""
    text = re.sub(rb"#[^\n]*", b"", utf8(data)).replace(b"\r", b"\n")
    text = re.sub(rb"^\s*(ST|C|N|4|n)*OFF", b"", text)  # the counts may follow it, even without a space
    lines = [words for line in text.split(b"\n") if (words := line.split())]
    vertex_count, face_count = (int(word) for word in lines[0][:2])
    announced = f"{vertex_count} vertices and {face_count} faces announced"
    if vertex_count < 0 or face_count < 0:
        raise OmtwarpError(f"damaged: {announced}")
    if len(lines) < 1 + vertex_count + face_count:
        raise OmtwarpError(f"cut short: {announced}, {len(lines) - 1} lines there")
    vertices = coordinates(lines[1 : 1 + vertex_count])
    rows = lines[1 + vertex_count : 1 + vertex_count + face_count]
    polygons = [line[1 : 1 + int(line[0])] for line in rows]
    if short := [k for k, polygon in enumerate(polygons) if len(polygon) != int(rows[k][0])]:
        raise OmtwarpError(f"cut short: face {short[0]} has fewer corners than it announces")
    return vertices, *fans(numbers_of(polygons, "face", int), np.array(list(map(len, polygons)), dtype=np.int64))


def _read_obj(data: bytes) -> Triangles:
    """Read a Wavefront OBJ by its ``v`` and ``f`` lines alone.

    Its texture coordinates, normals, materials and groups make a general reader split, drop and reorder vertices.
    """
    lines = re.findall(rb"^[ \t]*([vf])[ \t]+([^\n#]*)", obj_text(data), flags=re.MULTILINE)
    vertices = coordinates([rest.split() for kind, rest in lines if kind == b"v"])
    polygons = [[word.partition(b"/")[0] for word in rest.split()] for kind, rest in lines if kind == b"f"]
    vertices_before = np.cumsum([kind == b"v" for kind, _ in lines])[[kind == b"f" for kind, _ in lines]]
    sizes = np.array(list(map(len, polygons)), dtype=np.int64)
    return vertices, *fans(obj_corners(polygons, np.repeat(vertices_before, sizes)), sizes)


def obj_text(data: bytes) -> bytes:
    """Return the text of a Wavefront OBJ with its lines joined where they go on, and ended as on Unix."""
    return utf8(data).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").replace(b"\r", b"\n")


def obj_corners(polygons: list[list[bytes]], vertices_before: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the vertices, counted from 0, that the corners of a Wavefront OBJ's faces refer to.

    Args:
        polygons: the numbers of each face, which count from 1, or if negative back from the last vertex before it.
        vertices_before: how many vertices there are before the face of each corner, shape [C].

    Raises:
        OmtwarpError: a word is no whole number, or a face refers to vertex 0.
    """
    flat = numbers_of(polygons, "face", int)
    if (flat == 0).any():
        raise OmtwarpError("a face refers to vertex 0, and OBJ counts vertices from 1: the file counts from 0")
    return np.where(flat < 0, flat + vertices_before, flat - 1)


def coordinates(rows: list[list[bytes]]) -> NDArray[np.float64]:
    """Convert the words of a text file's vertices to numbers, the first three of each, shape [V, 3].

    Raises:
        OmtwarpError: a vertex has fewer, or a word that is no number.
    """
    if short := [number for number, row in enumerate(rows) if len(row) < 3]:
        raise OmtwarpError(f"cut short: vertex {short[0]} has {len(rows[short[0]])} of its three coordinates")
    return numbers_of([row[:3] for row in rows], "vertex", float).reshape(-1, 3)


def numbers_of(rows: list[list[bytes]], what: str, kind: type[float] | type[int]) -> NDArray:
    """Convert the words of a text file's rows to numbers, one row after another.

    Args:
        rows: words of each.
        what: a row is, for the error's text.
        kind: of the numbers, which are float64 or int64.

    Raises:
        OmtwarpError: a word is no number of that kind.
    """
    numbers: list[float] = []
    for number, row in enumerate(rows):
        try:
            numbers += map(kind, row)
        except ValueError:
            said = b" ".join(row)[:60].decode("utf-8", "replace")
            wanted = "whole numbers" if kind is int else "numbers"
            raise OmtwarpError(f"damaged: {what} {number} has '{said}', not {wanted} alone") from None
    return np.array(numbers, dtype=np.int64 if kind is int else np.float64)


def _read_stl(data: bytes) -> Triangles:
    count = int.from_bytes(data[80:84], "little")
    whole = 84 + 50 * count  # a head, a count, and for every triangle twelve numbers and an attribute
    binary = len(data) >= 84 and (len(data) == whole or not data.lstrip()[:5].lower() == b"solid")
    if binary and len(data) < whole:
        raise OmtwarpError(f"cut short: {count} triangles announced, {(len(data) - 84) // 50} there")
    if not binary and b"\0" in data:
        raise OmtwarpError("neither a binary STL file nor one of text")
    notes: list[str] = []
    if binary:
        record = np.dtype([("numbers", "<f4", (4, 3)), ("attribute", "<u2")])  # a normal, three corners
        corners = np.frombuffer(data, record, count, 84)["numbers"][:, 1:].reshape(-1, 3).astype(np.float64)
    else:
        corners, solids = _stl_text(data)
        notes += [f"took {solids} solids together"] if solids > 1 else []
    corners = corners + 0.0  # plus zero: makes -0 and 0 the same bits
    _, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # vertices in the order of their first appearance
    note = f"STL stores no shared vertices: {len(corners)} corners became {len(first)} vertices where equal"
    return corners[first[order]], np.argsort(order)[inverse.reshape(-1)].reshape(-1, 3), [*notes, note]


def _stl_text(data: bytes) -> tuple[NDArray[np.float64], int]:
    """Read the corners of all facets in an STL file of text, shape [3 F, 3], and how many solids it has.

    Raises:
        OmtwarpError: the file does not end where a solid does, or a facet has not three corners.
    """
    text = data.replace(b"\r", b"\n").lower()
    solids = re.findall(rb"^[ \t]*(end)?solid\b", text, re.M)
    facets = re.findall(rb"^[ \t]*(end)?facet\b", text, re.M)
    ends = [sum(kind == b"end" for kind in kinds) for kinds in (solids, facets)]
    if not solids or 2 * ends[0] != len(solids):
        raise OmtwarpError("cut short, or not an STL file: it does not end with 'endsolid'")
    words = [line.split() for line in re.findall(rb"^[ \t]*vertex[ \t]+([^\n]*)", text, re.M)]
    if 2 * ends[1] != len(facets) or len(words) != 3 * ends[1]:
        raise OmtwarpError(f"damaged: {len(words)} corners of {ends[1]} facets")
    if not words:
        raise OmtwarpError("not a triangle mesh: no triangles in it")
    return coordinates(words), ends[0]


def _read_gifti(file: Path) -> Triangles:
    image = load_gifti(file)
    points, triangles = image.get_arrays_from_intent("pointset"), image.get_arrays_from_intent("triangle")
    if len(points) != 1 or len(triangles) != 1:
        raise OmtwarpError(f"{len(points)} point sets and {len(triangles)} lists of triangles in it, not one of each")
    return points[0].data, triangles[0].data, []


def _read_freesurfer(data: bytes) -> Triangles:
    with copied(data, "surface") as file:
        return *nibabel_module().freesurfer.read_geometry(file)[:2], []


_OWN: dict[str, Callable[[bytes], Triangles]] = {
    "npz": _read_npz,
    "ply": _read_ply,
    "obj": _read_obj,
    "off": _read_off,
    "stl": _read_stl,
    "vtk": read_vtk,
    "vtp": read_vtk_xml,
    "vtu": read_vtk_xml,
    "mz3": other_formats.read_mz3,
    "tab": other_formats.read_plates,
    "freesurfer": _read_freesurfer,
    "freesurfer text": other_formats.read_freesurfer_text,
    "mni": other_formats.read_mni,
    **{suffix: partial(other_formats.read_by_meshio, name=name) for suffix, name in MESHIO_FORMATS.items()},
}
"""The formats that are read neither through trimesh nor, as GIFTI, with other files that they name; by suffix."""


def _read_scene(data: bytes, file: Path, suffix: str, together: bool) -> Triangles:
    """Read the only mesh of a scene, moved to the place that the scene gives it, or all of them together."""
    known = {*scene_formats(), *VOLUMES, "gii", *(name for name in _OWN if " " not in name)} - {"freesurfer", "mni"}
    if suffix not in known and suffix in WAYS_ROUND:
        raise OmtwarpError(f"'.{suffix}' is not read: {WAYS_ROUND[suffix]}")
    if suffix not in known:
        what = f"unknown format '.{suffix}'" if suffix else "unknown format, as its name has no suffix"
        raise OmtwarpError(f"{what}: known are {', '.join(sorted(known))}")
    meshes = placed_meshes(load_scene(data, file, suffix, pictures=False))
    if not meshes:
        raise OmtwarpError("not a triangle mesh: no triangles in it")
    if len(meshes) > 1 and not together:
        names = ", ".join(name for name, *_ in meshes[:4]) + (", ..." if len(meshes) > 4 else "")
        raise OmtwarpError(
            f"{len(meshes)} geometries in one scene ({names}), first '{meshes[0][0]}'; save the one to be mapped by "
            "itself, take the largest with omtwarp.repair, or map all with components=True or together=True"
        )
    notes = [f"took {len(meshes)} geometries together"] if len(meshes) > 1 else []
    return *taken_together([one[2:] for one in meshes]), notes


# Formats that double vertices along seams of a texture. In others equal positions that remain open when they are joined
# may be intended.
_DOUBLED = (".glb", ".gltf", ".dae", ".3mf", ".json")


@dataclass(frozen=True, eq=False)
class JoinedMesh(Derived):
    """A mesh file whose copies of vertices along seams are joined; each is the first of its copies.

    Attributes:
        vertices: without copies, in the file's order, float64, shape [V, 3].
        faces: the file's, with the vertices' new numbers, int64, shape [F, 3].
        file: the mesh as the file has it.
        vertex_of_file: the vertex that each of the file's is, shape [N]; None where nothing was joined.
        notes: decisions that were made, in words.
    """

    file: MeshFile
    vertex_of_file: Indices | None
    notes: tuple[str, ...]

    def places(self) -> Indices:
        """Return the vertex that each of the file's is, copies too, and -1 at the end, shape [N + 1]."""
        return super().places() if self.vertex_of_file is None else np.append(self.vertex_of_file, -1)

    def after(self, repaired: Repaired | None) -> Origins | None:
        """Return what the mesh, or a repaired one made from it, has from the file; None where all is the file's own."""
        if repaired is not None and repaired.actions:
            return self.compose(repaired)
        return None if self.vertex_of_file is None else self


def seam_copies(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> Indices | None:
    """Find vertices of boundaries that lie at the same place.

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].

    Returns:
        For every vertex the first one at its place, shape [V]; None where no two are joined.
    """
    at = np.flatnonzero(Topology(faces.astype(np.int64), len(vertices)).on_boundary)
    if not len(at):
        return None
    _, first, inverse = np.unique(vertices[at] + 0.0, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(at):
        return None
    number = np.arange(len(vertices))
    number[at] = at[first[inverse.reshape(-1)]]
    return number


def compressed(number: Indices) -> tuple[NDArray[np.bool_], Indices]:
    """Return a mask of the vertices that stay when copies are joined, and every vertex's new number, shape [V] each."""
    stays = number == np.arange(len(number))
    return stays, (np.cumsum(stays) - 1)[number]


def read_joined_mesh(
    path: str | os.PathLike[str], *, together: bool = False, smoothing: int | None = None
) -> JoinedMesh:
    """Read a mesh, and join the copies of vertices that its format makes along seams.

    Several geometries of a scene, a material each, are one mesh where they close one another's boundaries.

    Args:
        path: a file that :func:`omtwarp.read_mesh` reads.
        together: whether geometries that do not belong together are taken too, each a part of the surface.
        smoothing: of the surfaces of a volume's labels, as for :func:`omtwarp.read_mesh`.

    Raises:
        OmtwarpError: the file cannot be read, as for :func:`omtwarp.read_mesh`.
    """
    shared = not Path(path).name.lower().removesuffix(".gz").endswith(_DOUBLED)
    try:
        file, one_mesh = read_mesh(path, together=together, smoothing=smoothing), True
    except OmtwarpError as error:
        if shared:
            raise
        refused = error
        file, one_mesh = read_mesh(path, together=True), False
    number = None
    if file.faces.size and 0 <= file.faces.min() and file.faces.max() < len(file.vertices):
        number = seam_copies(file.vertices, file.faces)
    count, notes = len(file.vertices), file.notes
    first, joined, of_file = np.arange(count), file.faces, None
    if number is not None:
        stays, places = compressed(number)
        if not shared or CUT in notes or not Topology(places[file.faces], count).on_boundary.any():
            first, joined, of_file = np.flatnonzero(stays), places[file.faces], places
            copies = count - len(first)
            notes = (*notes, f"joined {copies} {'copy' if copies == 1 else 'copies'} of vertices along seams")
    if not one_mesh and not _in_one_piece(joined):
        raise refused  # the user has to choose among geometries that do not belong together
    return JoinedMesh(first, np.arange(len(joined)), file.vertices[first], joined, file, of_file, notes, given=count)


def _in_one_piece(faces: Indices) -> bool:
    """Return whether all triangles are connected through their vertices."""
    count = int(faces.max()) + 1 if faces.size else 0
    labels = components_of(count, np.stack([faces.ravel(), np.roll(faces, -1, axis=1).ravel()], axis=1))[1]
    return len(np.unique(labels[faces])) <= 1
