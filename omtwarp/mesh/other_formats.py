"""Small formats of brain surfaces and asteroids, finite elements, and formats that are not read, with the way round.

Finite elements are read by meshio, an optional package (``pip install 'omtwarp[meshio]'``).
"""

import contextlib
import io
import re
import struct

import numpy as np

from omtwarp.errors import OmtwarpError, installed
from omtwarp.files.output import scratch
from omtwarp.mesh.arrays import Floats, whole_numbers
from omtwarp.mesh.polygons import Triangles, fans

MESHIO_FORMATS = {"msh": "gmsh", "mesh": "medit", "inp": "abaqus"}
"""Suffixes of formats that are read by meshio, and its names of them; a .msh without gmsh's header is of Ansys."""

_EXPORT = "export a .glb, .obj or .ply from the program that made it, or from Blender"
_MESH_IT = "a solid of curved faces: mesh it first, in FreeCAD or gmsh, and export an .stl"
_VOLUME = "a volume: save its labels as .nii.gz, whose surfaces are taken"

WAYS_ROUND = {
    **dict.fromkeys(
        ("fbx", "usd", "usda", "usdc", "usdz", "blend", "max", "ma", "mb", "c4d", "lwo", "3ds", "x3d"), _EXPORT
    ),
    **dict.fromkeys(("step", "stp", "iges", "igs", "sat", "sldprt", "f3d", "3dm"), _MESH_IT),
    **dict.fromkeys(("nrrd", "mha", "mhd", "dcm", "tif", "tiff"), _VOLUME),
    "drc": "meshes compressed by Draco: decode it first, by 'gltf-transform copy' or draco_decoder",
}
"""Formats that are known and not read, and what to do about each."""

# Corners of meshio's kinds of flat cells, None for any number; others follow on edges and inside.
_CORNERS = {"triangle": 3, "triangle6": 3, "triangle7": 3, "quad": 4, "quad8": 4, "quad9": 4, "polygon": None}
_NO_AREA = ("vertex", "line")


def read_by_meshio(data: bytes, name: str) -> Triangles:
    """Read the triangles and polygons of a file by meshio; points and lines are left out.

    Args:
        data: the file.
        name: meshio's name of its format; of gmsh's also for a file of Ansys, which has the same suffix.

    Raises:
        OmtwarpError: meshio is not installed, the file names others, or it has cells with a volume.
        Exception: what meshio raises on a damaged file.
    """
    if name == "abaqus" and re.search(rb"^[ \t]*\*[ \t]*INCLUDE", data, re.M | re.I):
        raise OmtwarpError("names other files by *INCLUDE, which are not read: export it as one file")
    with installed("needs meshio", "meshio"):
        import meshio
    if name == "gmsh" and b"$MeshFormat" not in data:
        name = "ansys"
    with scratch() as folder, contextlib.redirect_stderr(io.StringIO()):  # to which meshio prints its warnings
        (folder / "mesh").write_bytes(data)
        mesh = getattr(meshio, name).read(folder / "mesh")
    corners, sizes = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
    for block in mesh.cells:
        if block.type.startswith(_NO_AREA):
            continue
        kind = "polygon" if block.type.startswith("polygon") else block.type
        if kind not in _CORNERS:
            raise OmtwarpError(f"not a surface: cells of the kind {block.type}; extract its surface first, in ParaView")
        cells = np.asarray(block.data)[:, : _CORNERS[kind]]
        corners.append(cells.reshape(-1))
        sizes.append(np.full(len(cells), cells.shape[1]))
    points = np.zeros((len(mesh.points), 3))
    points[:, : mesh.points.shape[1]] = mesh.points  # of two coordinates, in a plane
    return points, *fans(np.concatenate(corners), np.concatenate(sizes))


_MZ3_HEADER = "<HHIII"  # the magic number, what is in the file, and the numbers of faces, vertices and bytes to skip


def read_mz3(data: bytes) -> Triangles:
    """Read a surface of Surf Ice (``.mz3``).

    Returns:
        Points [V, 3] and faces [F, 3].

    Raises:
        OmtwarpError: no such file, one without a surface, or one cut short.
    """
    size = struct.calcsize(_MZ3_HEADER)
    magic, content, faces, vertices, skipped = struct.unpack(_MZ3_HEADER, data[:size].ljust(size, b"\0"))
    # Mz3 magic: "MZ" as a little-endian number
    if magic != 23117:
        raise OmtwarpError("no header of an mz3 file")
    if content & 3 != 3:  # the bits of faces and of vertices
        raise OmtwarpError("not a triangle mesh: an mz3 file of data alone")
    start = size + skipped
    need = start + 12 * (faces + vertices)
    if len(data) < need:
        raise OmtwarpError(f"cut short: {need} bytes announced, {len(data)} there")
    corners = np.frombuffer(data, "<i4", 3 * faces, start)
    points = np.frombuffer(data, "<f4", 3 * vertices, start + 12 * faces)
    return points.reshape(-1, 3), corners.reshape(-1, 3), []


def read_freesurfer_text(data: bytes) -> Triangles:
    """Read a surface that FreeSurfer wrote as text (``.asc``): two counts, and points and faces with a mark each.

    Returns:
        Points [V, 3] and faces [F, 3].

    Raises:
        OmtwarpError: the file is cut short.
    """
    numbers = _Numbers(data.partition(b"\n")[2])
    vertices, faces = (int(count) for count in numbers.take(2))
    points = numbers.take(4 * vertices).reshape(-1, 4)[:, :3]
    return points, numbers.take(4 * faces).reshape(-1, 4)[:, :3], []


def read_mni(data: bytes) -> Triangles:
    """Read polygons of the Montreal Neurological Institute (``.obj`` that begins with P).

    Raises:
        OmtwarpError: the file is cut short, or its polygons do not fit their corners.
    """
    numbers = _Numbers(data.lstrip()[1:])
    numbers.take(5)  # how it shines, and its opacity
    vertices = int(numbers.take(1)[0])
    points = numbers.take(3 * vertices).reshape(-1, 3)
    numbers.take(3 * vertices)  # normals
    count, colored = (int(number) for number in numbers.take(2))
    if colored not in (0, 1, 2):
        raise OmtwarpError(f"damaged: colours of the kind {colored}")
    numbers.take(4 * (1, count, vertices)[colored])
    sizes = np.diff(whole_numbers(numbers.take(count), "ends of polygons", (None,)), prepend=0)
    if (sizes < 0).any():
        raise OmtwarpError("damaged: ends of polygons that do not grow")
    return points, *fans(numbers.take(int(sizes.sum())), sizes)


def read_plates(data: bytes) -> Triangles:
    """Read a plate model of the Planetary Data System (``.tab``): numbered vertices, and plates that count from 1.

    Counts stand together before the vertices, or each before its own list.

    Returns:
        Points [V, 3] and faces [F, 3], which count from 0.

    Raises:
        OmtwarpError: no plate model, or one cut short.
    """
    together = len(data.split(b"\n", 1)[0].split()) == 2
    numbers = _Numbers(data)
    vertices = int(numbers.take(1)[0])
    plates = int(numbers.take(1)[0]) if together else None
    points = numbers.take(4 * vertices).reshape(-1, 4)
    faces = numbers.take(4 * (int(numbers.take(1)[0]) if plates is None else plates)).reshape(-1, 4)
    for rows in (points, faces):
        if not np.array_equal(rows[:, 0], np.arange(1, len(rows) + 1)):
            raise OmtwarpError("no plate model: its rows are not numbered from 1")
    return points[:, 1:], faces[:, 1:] - 1, []


class _Numbers:
    """The numbers of a text, taken from its beginning to its end."""

    def __init__(self, text: bytes):
        self.words, self.place = text.split(), 0

    def take(self, count: int) -> Floats:
        """Return the next numbers.

        Raises:
            OmtwarpError: there are fewer.
        """
        taken = self.words[self.place : self.place + max(count, 0)]
        if len(taken) != count:
            raise OmtwarpError(f"cut short: {count} numbers announced, {len(taken)} there")
        self.place += count
        return np.array(taken, dtype=np.float64)
