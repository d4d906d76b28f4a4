"""Surfaces in the formats of neuroimaging: GIFTI, FreeSurfer and VTK PolyData, written with their metadata.

nibabel (``pip install 'omtwarp[neuro]'``) reads and writes GIFTI and FreeSurfer's files.
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError

if TYPE_CHECKING:
    from nibabel.gifti import GiftiImage

# Names that FreeSurfer gives to its surfaces, behind lh. or rh.
FREESURFER_SUFFIXES = (".sphere", ".reg", ".white", ".pial", ".inflated", ".orig", ".smoothwm")
STRUCTURES = {"L": "CortexLeft", "R": "CortexRight"}


def nibabel_module() -> ModuleType:
    """Import and return the package nibabel.

    Raises:
        OmtwarpError: nibabel is not installed.
    """
    try:
        import nibabel
    except ImportError:
        raise OmtwarpError("needs nibabel: pip install 'omtwarp[neuro]'") from None
    return nibabel


def structure_of(path: Path | None) -> str | None:
    """Return the part of the brain that a file names as its content: ``CortexLeft``, ``CortexRight`` and so on.

    The result is None if the file does not say.

    GIFTI says it inside (AnatomicalStructurePrimary); other files by their names, ``lh.``, ``hemi-L`` or ``.L.``.
    """
    if path is None:
        return None
    name = path.name
    if name.lower().endswith((".gii", ".gii.gz")) and path.is_file():
        image = gifti_image(path)
        for meta in [image.meta, *(array.meta for array in image.darrays)]:
            if meta.get("AnatomicalStructurePrimary"):
                return str(meta["AnatomicalStructurePrimary"])
    found = re.search(r"(?:^|[._-])(?:(l|r)h(?=[._])|hemi-([LR])(?=[._])|([LR])(?=[.]))", name)
    return STRUCTURES[next(word for word in found.groups() if word).upper()] if found else None


def gifti_image(path: Path) -> GiftiImage:
    """Read a GIFTI file, as nibabel's image.

    Raises:
        OmtwarpError: the file cannot be read, or is no GIFTI file.
    """
    nibabel = nibabel_module()
    try:
        with warnings.catch_warnings(action="ignore"):
            image = nibabel.load(path)
        if isinstance(image, nibabel.gifti.GiftiImage):
            return image
        detail = f"it is {type(image).__name__}"
    except MemoryError:
        raise
    except Exception as error:  # nibabel, expat and zlib raise many kinds on a damaged file
        detail = " ".join(str(error).split())[:160] or type(error).__name__
    raise OmtwarpError(f"{path}: cannot be read as GIFTI: {detail}")


def require_same_structure(one: Path | None, other: Path | None) -> None:
    """Refuse two files that name different parts of the brain as their content.

    Raises:
        OmtwarpError: the two files name different parts.
    """
    ours, theirs = structure_of(one), structure_of(other)
    if ours is not None and theirs is not None and ours != theirs:
        raise OmtwarpError(f"'{one}' is {ours} and '{other}' is {theirs}: take the template of the same hemisphere")


def write_gifti_surface(
    file: Path, points: NDArray[np.float64], faces: NDArray[np.int32], spherical: bool, like: Path | None
) -> None:
    """Write a GIFTI surface (single precision, as its readers expect).

    Metadata and coordinate system are those of the file that it is like; otherwise the structure follows from the
    names.
    """
    nibabel = nibabel_module()
    gifti = nibabel.gifti
    whole, own, corners, system = {}, {}, {}, None
    if like is not None and like.name.lower().endswith((".gii", ".gii.gz")):
        given = gifti_image(like)
        whole = dict(given.meta)
        for array in given.darrays:
            if array.intent == nibabel.nifti1.intent_codes["NIFTI_INTENT_POINTSET"]:
                own, system = dict(array.meta), array.coordsys
            elif array.intent == nibabel.nifti1.intent_codes["NIFTI_INTENT_TRIANGLE"]:
                corners = dict(array.meta)
    structure = own.get("AnatomicalStructurePrimary") or structure_of(like) or structure_of(file)
    if structure:
        own["AnatomicalStructurePrimary"] = structure
    if spherical:
        own["GeometricType"] = "Spherical"
        own.pop("AnatomicalStructureSecondary", None)  # such as MidThickness, which a sphere is not
    else:
        own.setdefault("GeometricType", "Anatomical")
    corners.setdefault("TopologicalType", "Closed")
    float32, int32 = "NIFTI_TYPE_FLOAT32", "NIFTI_TYPE_INT32"
    arrays = [
        gifti.GiftiDataArray(points.astype(np.float32), "NIFTI_INTENT_POINTSET", float32, coordsys=system),
        gifti.GiftiDataArray(faces.astype(np.int32), "NIFTI_INTENT_TRIANGLE", int32),
    ]
    arrays[0].meta, arrays[1].meta = gifti.GiftiMetaData(own), gifti.GiftiMetaData(corners)
    nibabel.save(gifti.GiftiImage(darrays=arrays, meta=gifti.GiftiMetaData(whole)), file)


def write_freesurfer_surface(
    file: Path, points: NDArray[np.float64], faces: NDArray[np.int32], like: Path | None
) -> None:
    """Write a surface in FreeSurfer's binary format, with the volume geometry of the file that it is like."""
    io = nibabel_module().freesurfer.io
    volume = None
    if like is not None and not like.name.lower().endswith((".gii", ".gii.gz", ".npz")):
        try:
            volume = io.read_geometry(like, read_metadata=True)[2] or None
        except (ValueError, OSError):
            volume = None  # of another format, which has none
    io.write_geometry(file, points, faces, create_stamp="created by omtwarp", volume_info=volume)


def write_vtk(file: Path, points: NDArray[np.float64], faces: NDArray[np.int32]) -> None:
    """Write legacy VTK PolyData, binary, in double precision."""
    cells = np.empty((len(faces), 4), dtype=">i4")
    cells[:, 0], cells[:, 1:] = 3, faces
    head = f"# vtk DataFile Version 3.0\nomtwarp\nBINARY\nDATASET POLYDATA\nPOINTS {len(points)} double\n"
    polygons = f"\nPOLYGONS {len(faces)} {4 * len(faces)}\n"
    body = [head.encode("ascii"), points.astype(">f8").tobytes(), polygons.encode("ascii"), cells.tobytes(), b"\n"]
    file.write_bytes(b"".join(body))


_VTK_TYPES = {"float": ">f4", "double": ">f8", "int": ">i4", "vtktypeint64": ">i8", "long": ">i8"}


def read_vtk(data: bytes) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """Read the points and polygons of legacy VTK PolyData, text or binary, versions 1 to 5.

    Returns:
        Points [V, 3] and a list of the corners of every polygon.

    Raises:
        OmtwarpError: another kind of dataset.
    """
    text = re.search(rb"^\s*(ASCII|BINARY)\s*$", data[:1000], re.M | re.I)
    if not data.startswith(b"# vtk") or text is None or not re.search(rb"DATASET\s+POLYDATA", data[:2000], re.I):
        raise OmtwarpError("not legacy VTK PolyData")
    binary = text[1].upper() == b"BINARY"
    at = re.search(rb"^POINTS\s+(\d+)\s+(\w+)[ \t]*\r?\n", data, re.M | re.I)
    if at is None:
        raise OmtwarpError("no points in it")

    def numbers(start: int, count: int, kind: str) -> tuple[NDArray[np.generic], int]:
        if binary:
            end = start + count * np.dtype(kind).itemsize
            return np.frombuffer(data[start:end], dtype=kind), end
        words = data[start:].split(None, count)[:count]
        return np.array(words, dtype=np.float64), start

    kind = _VTK_TYPES.get(at[2].decode().lower())
    if kind is None:
        raise OmtwarpError(f"points of type '{at[2].decode()}'")
    flat, end = numbers(at.end(), 3 * int(at[1]), kind)
    cells = re.compile(rb"^POLYGONS\s+(\d+)\s+(\d+)[ \t]*\r?\n", re.M | re.I).search(data, end)
    if cells is None or len(flat) != 3 * int(at[1]):
        raise OmtwarpError("no polygons in it, or cut short")
    first, second = int(cells[1]), int(cells[2])
    offsets = re.compile(rb"OFFSETS\s+(\w+)[ \t]*\r?\n", re.I).match(data, cells.end())
    if offsets is None:
        entries = numbers(cells.end(), second, ">i4")[0].astype(np.int64)
        polygons, place = [], 0
        for _ in range(first):
            polygons.append(entries[place + 1 : place + 1 + entries[place]])
            place += 1 + int(entries[place])
    else:
        ends, after = numbers(offsets.end(), first, _VTK_TYPES[offsets[1].decode().lower()])
        lists = re.compile(rb"CONNECTIVITY\s+(\w+)[ \t]*\r?\n", re.I).search(data, after)
        if lists is None:
            raise OmtwarpError("no corners in it")
        corners = numbers(lists.end(), second, _VTK_TYPES[lists[1].decode().lower()])[0].astype(np.int64)
        polygons = np.split(corners, ends.astype(np.int64)[1:-1])
    return flat.reshape(-1, 3).astype(np.float64), polygons


__all__ = [
    "FREESURFER_SUFFIXES",
    "gifti_image",
    "nibabel_module",
    "read_vtk",
    "require_same_structure",
    "structure_of",
    "write_freesurfer_surface",
    "write_gifti_surface",
    "write_vtk",
]
