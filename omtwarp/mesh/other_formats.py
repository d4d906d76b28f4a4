"""Formats of finite elements, which meshio reads, and formats that are not read, with the way round each.

meshio is an optional package (``pip install 'omtwarp[meshio]'``).
"""

from __future__ import annotations

import contextlib
import io
import re

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import scratch

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


def read_by_meshio(data: bytes, name: str) -> tuple[NDArray[np.generic], NDArray[np.generic], NDArray[np.int64]]:
    """Read the triangles and polygons of a file by meshio; points and lines are left out.

    Args:
        data: the file.
        name: meshio's name of its format.

    Returns:
        Points [V, 3], the corners of all polygons one after another, and how many each has.

    Raises:
        OmtwarpError: meshio is not installed, the file names others, or it has cells with a volume.
        Exception: what meshio raises on a damaged file.
    """
    if name == "abaqus" and re.search(rb"^[ \t]*\*[ \t]*INCLUDE", data, re.M | re.I):
        raise OmtwarpError("names other files by *INCLUDE, which are not read: export it as one file")
    try:
        import meshio
    except ImportError:
        raise OmtwarpError("needs meshio: pip install 'omtwarp[meshio]'") from None
    readers = {
        "gmsh": meshio.gmsh.read,
        "ansys": meshio.ansys.read,
        "medit": meshio.medit.read,
        "abaqus": meshio.abaqus.read,
    }
    with scratch() as folder, contextlib.redirect_stderr(io.StringIO()):  # to which meshio prints its warnings
        (folder / "mesh").write_bytes(data)
        mesh = readers[name](folder / "mesh")
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
    return points, np.concatenate(corners), np.concatenate(sizes)
