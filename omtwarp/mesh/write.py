"""Writing a mesh with its vertices and faces as they are, in double precision where the format has it."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files import staged

SUFFIXES = (".ply", ".obj", ".off", ".stl", ".glb")


def write_mesh(path: str | os.PathLike[str], vertices: NDArray, faces: NDArray) -> None:
    """Write a triangle mesh; vertex order and faces are kept, except that STL has only triangles.

    Args:
        path: .ply (binary, double), .obj and .off (all digits of a double), .stl or .glb (single precision).
        vertices: float64, shape [V, 3].
        faces: shape [F, 3].

    Raises:
        OmtwarpError: another suffix, or the file cannot be written; then an older file is as it was.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    points, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int32)
    if suffix not in SUFFIXES:
        raise OmtwarpError(f"cannot write '{file}': unknown suffix '{file.suffix}', use {', '.join(SUFFIXES)}")
    with staged(file) as place:
        _write(place, suffix, points, triangles)


def _write(file: Path, suffix: str, points: NDArray[np.float64], triangles: NDArray[np.int32]) -> None:
    """Write a mesh in the format of one of ``SUFFIXES``."""
    if suffix == ".ply":
        file.write_bytes(_ply(points, triangles))
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

        trimesh.Trimesh(points, triangles, process=False).export(file)


def _ply(points: NDArray[np.float64], faces: NDArray[np.int32]) -> bytes:
    head = "ply\nformat binary_little_endian 1.0\ncomment omtwarp\n"
    head += f"element vertex {len(points)}\nproperty double x\nproperty double y\nproperty double z\n"
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    return head.encode("ascii") + points.astype("<f8").tobytes() + rows.tobytes()


__all__ = ["SUFFIXES", "write_mesh"]
