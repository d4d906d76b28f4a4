"""Writing of meshes with vertices and faces unchanged, in double precision where the format has it."""

import os
from collections.abc import Mapping
from enum import IntEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import as_path, staged
from omtwarp.mesh.arrays import Floats, Ints, single_precision
from omtwarp.mesh.neuro import FREESURFER_SUFFIXES, write_freesurfer_surface, write_gifti_surface
from omtwarp.mesh.vtk import write_vtk


class Target(IntEnum):
    """What a view of a buffer is for in glTF 2.0, by OpenGL's numbers."""

    ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963


SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb", ".gii", ".vtk", *FREESURFER_SUFFIXES)


def write_mesh(
    path: str | os.PathLike[str],
    vertices: NDArray,
    faces: NDArray,
    *,
    beside: Mapping[str, NDArray] | None = None,
    spherical: bool = False,
    like: Path | None = None,
) -> None:
    """Write a triangle mesh; vertex order and faces are kept, except that STL has only triangles.

    Args:
        path: .ply and .vtk (binary, double), .obj and .off (all digits of a double), .stl, .glb, GIFTI (.surf.gii) or a
            FreeSurfer surface (lh.sphere, ...), which have single precision.
        vertices: float64, shape [V, 3].
        faces: shape [F, 3].
        beside: further numbers per vertex by name, each shape [V]; for .ply and .vtk alone.
        spherical: it is a sphere, which GIFTI records.
        like: the file that the mesh comes from; GIFTI keeps its metadata, FreeSurfer's format its volume geometry.

    Raises:
        OmtwarpError: another suffix, or the file cannot be written; then an older file is as it was.
    """
    file = as_path(path)
    suffix = file.suffix.lower()
    points, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int32)
    if suffix not in SUFFIXES:
        raise OmtwarpError(f"cannot write '{file}': unknown suffix '{file.suffix}', use {', '.join(SUFFIXES)}")
    if beside and suffix not in (".ply", ".vtk"):
        raise OmtwarpError(f"cannot write '{file}': only .ply and .vtk hold numbers at the vertices")
    with staged(file) as place:
        if suffix == ".gii":
            write_gifti_surface(place, points, triangles, spherical, like)
        elif suffix in FREESURFER_SUFFIXES:
            write_freesurfer_surface(place, points, triangles, like)
        elif suffix == ".vtk":
            write_vtk(place, points, triangles, beside)
        else:
            _write(place, suffix, points, triangles, beside)


def _write(file: Path, suffix: str, points: Floats, triangles: Ints, beside: Mapping[str, NDArray] | None) -> None:
    """Write a mesh in a general format, not one of neuroimaging."""
    if suffix == ".ply":
        file.write_bytes(ply_bytes(points, triangles, beside))
    elif suffix == ".obj":
        rows = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()]
        rows += [f"f {a} {b} {c}\n" for a, b, c in (triangles + 1).tolist()]
        file.write_text("".join(rows), "ascii")
    elif suffix == ".off":
        rows = [f"OFF\n{len(points)} {len(triangles)} 0\n"]
        rows += [f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist()]
        rows += [f"3 {a} {b} {c}\n" for a, b, c in triangles.tolist()]
        file.write_text("".join(rows), "ascii")
    else:
        import trimesh

        single_precision(points, "vertices")  # which both formats have
        mesh = trimesh.Trimesh(points, triangles, process=False)
        if suffix == ".glb":
            file.write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), tree_postprocessor=_name_targets))
        else:
            mesh.export(file)


def _name_targets(document: dict) -> None:
    """Add to a glTF file of trimesh's what its views of the buffer are for, which readers would otherwise infer."""
    for mesh in document["meshes"]:
        for primitive in mesh["primitives"]:
            uses = [(number, Target.ARRAY_BUFFER) for number in primitive["attributes"].values()]
            for number, target in [*uses, (primitive["indices"], Target.ELEMENT_ARRAY_BUFFER)]:
                document["bufferViews"][document["accessors"][number]["bufferView"]]["target"] = target


def ply_bytes(points: Floats, faces: Ints, properties: Mapping[str, NDArray[np.generic]] | None = None) -> bytes:
    """Encode a mesh as binary PLY with further properties of its vertices: bytes, else all in double precision."""
    given = properties or {}
    names = ["x", "y", "z", *("_".join(name.split()) or "value" for name in given)]
    head = f"ply\nformat binary_little_endian 1.0\ncomment omtwarp\nelement vertex {len(points)}\n"
    columns = [*points.T, *map(np.asarray, given.values())]
    kinds = ["u1" if column.dtype == np.uint8 else "<f8" for column in columns]
    words = {"u1": "uchar", "<f8": "double"}
    head += "".join(f"property {words[kind]} {name}\n" for kind, name in zip(kinds, names, strict=True))
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    table = np.empty(len(points), dtype=[(str(k), kind) for k, kind in enumerate(kinds)])
    for k, column in enumerate(columns):
        table[str(k)] = column
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return head.encode("ascii") + table.tobytes() + rows.tobytes()
