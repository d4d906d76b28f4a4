"""Surfaces in the formats of neuroimaging: GIFTI and FreeSurfer, written with their metadata.

nibabel (``pip install 'omtwarp[neuro]'``) reads and writes GIFTI and FreeSurfer's files.
"""

import contextlib
import json
import re
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING
from xml.parsers.expat import ParserCreate

import numpy as np

from omtwarp.errors import OmtwarpError, installed
from omtwarp.files.inputs import file_beside, open_input, read_arrays, read_bytes, reading
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.files.output import scratch
from omtwarp.mesh.arrays import Floats, Ints, real_numbers, single_precision, whole_numbers

if TYPE_CHECKING:
    from nibabel.gifti import GiftiImage

# Names that FreeSurfer gives to its surfaces, behind lh. or rh.
FREESURFER_SUFFIXES = (".sphere", ".reg", ".white", ".pial", ".inflated", ".orig", ".smoothwm")
VECTORS, TEXTS = ("voxelsize", "xras", "yras", "zras", "cras"), ("valid", "filename")  # of a volume's geometry
STRUCTURES = {"L": "CortexLeft", "R": "CortexRight"}


def nibabel_module() -> ModuleType:
    """Import and return the package nibabel.

    Raises:
        OmtwarpError: nibabel is not installed.
    """
    with installed("needs nibabel", "neuro"):
        import nibabel
    return nibabel


@contextlib.contextmanager
def copied(data: bytes, name: str) -> Iterator[Path]:
    """Yield a copy of a file that was read, for readers of nibabel's that take a file alone."""
    with scratch() as folder:
        (folder / name).write_bytes(data)
        yield folder / name


def structure_of(path: Path | None) -> str | None:
    """Return the part of the brain that a file names as its content: ``CortexLeft``, ``CortexRight`` and so on.

    The result is None if the file does not say.

    GIFTI says it inside (AnatomicalStructurePrimary), a map in its report, as the file that was mapped had it; other
    files by their names, ``lh.``, ``hemi-L`` or ``.L.``.
    """
    if path is None:
        return None
    name = path.name
    if path.suffix.lower() == ".npz" and path.is_file() and (known := _structure_of_map(path)):
        return known
    if name.lower().endswith((".gii", ".gii.gz")) and path.is_file():
        with reading(path, "GIFTI", path.stat().st_size):
            named = re.search(rb"StructurePrimary\W*Name>\s*<Value>(?:<!\[CDATA\[)?\s*(\w+)", _gifti_text(path))
        if named:
            return named[1].decode()
    return structure_in_name(name)


def structure_in_name(name: str) -> str | None:
    """Return the hemisphere in a file's name, ``CortexLeft`` or ``CortexRight``; None where there is none."""
    match = re.search(r"(?:^|[._-])(?:(l|r)h(?=[._])|hemi-([LR])(?=[._])|([LR])(?=[.]))", name)
    return STRUCTURES[next(word for word in match.groups() if word).upper()] if match else None


def _report_of_map(path: Path) -> dict:
    """Return the report of a map; an empty one where there is none."""
    try:
        with open_input(path, LARGEST_MESH_FILE, "map") as stream:
            return dict(json.loads(str(read_arrays(stream, ("report",))["report"])))
    except (OmtwarpError, ValueError, RecursionError, KeyError, TypeError):  # no map, or one without
        return {}


def _structure_of_map(path: Path) -> str | None:
    """Return the part of the brain that a map's report names; None where it names none."""
    known = _report_of_map(path).get("structure")
    return known if isinstance(known, str) and re.fullmatch(r"[\w .-]{1,80}", known) else None


def volume_geometry_of(path: Path) -> dict[str, object] | None:
    """Return the volume geometry of a FreeSurfer surface, or of the map of one, as JSON holds it; None without any.

    It says where the surface lies in the volume that it was made from; the names are those that FreeSurfer writes.
    """
    with contextlib.suppress(OmtwarpError, ValueError, OSError, KeyError, TypeError):
        if path.suffix.lower() == ".npz":
            known = _report_of_map(path)["volume_geometry"]
        else:
            with open_input(path, LARGEST_MESH_FILE) as stream:
                if stream.read(3) != b"\xff\xff\xfe":  # of another format: no more of it is read
                    return None
            with copied(read_bytes(path, LARGEST_MESH_FILE), path.name) as copy:
                known = nibabel_module().freesurfer.io.read_geometry(copy, read_metadata=True)[2]
        whole = {name: whole_numbers(known[name], name, (None,), below=2**31).tolist() for name in ("head", "volume")}
        numbers = {name: real_numbers(known[name], name, (3,)).tolist() for name in VECTORS}
        return whole | numbers | {name: " ".join(str(known[name]).splitlines()) for name in TEXTS}
    return None


def load_gifti(path: Path) -> "GiftiImage":
    """Read a GIFTI file, as nibabel's image.

    It names no other file than regular ones in its folder, where arrays may be stored.

    Raises:
        OmtwarpError: the file cannot be read, or is no GIFTI file, or names another one.
        Exception: what nibabel, expat or zlib raise on a damaged file.
    """
    nibabel, text = nibabel_module(), _gifti_text(path)

    def begun(name: str, attributes: dict[str, str]) -> None:
        named = attributes.get("ExternalFileName")
        if named and (path.absolute().parent / named).resolve() != file_beside(path, named):
            raise OmtwarpError(f"names '{named}', which is not a file in its folder")

    parser = ParserCreate()
    parser.StartElementHandler = begun
    parser.Parse(text, True)
    stream, whole = BytesIO(text), nibabel.gifti.GiftiImage.parser()
    stream.name = str(path)  # where nibabel looks for the files that it names
    whole.parse(fptr=stream)
    if not isinstance(whole.img, nibabel.gifti.GiftiImage):
        raise OmtwarpError("damaged, or no GIFTI file: XML of another kind")
    return whole.img


def _gifti_text(path: Path) -> bytes:
    """Read a GIFTI file, and inflate it where it is compressed, to no more than a mesh file may have."""
    data = read_bytes(path, LARGEST_MESH_FILE, "mesh file")
    return zlib.decompressobj(31).decompress(data, LARGEST_MESH_FILE) if data.startswith(b"\x1f\x8b") else data


def require_same_structure(*files: Path | None) -> str | None:
    """Return the part of the brain that files name as their content, None where none does; refuse different ones.

    Raises:
        OmtwarpError: two files name different parts.
    """
    named = {part: file for file in reversed(files) if (part := structure_of(file)) is not None}
    if len(named) > 1:
        (ours, one), (theirs, other), *_ = named.items()
        raise OmtwarpError(f"'{one}' is {ours} and '{other}' is {theirs}: take files of the same hemisphere")
    return next(iter(named), None)


def write_gifti_surface(
    file: Path, points: Floats, faces: Ints, spherical: bool, like: Path | None, structure: str | None
) -> None:
    """Write a GIFTI surface (single precision, as its readers expect).

    Metadata and coordinate system are those of the file that it is like; otherwise the structure is the given one, or
    follows from the names.
    """
    nibabel = nibabel_module()
    gifti = nibabel.gifti
    whole, own, corners, system = {}, {}, {}, None
    if like is not None and like.name.lower().endswith((".gii", ".gii.gz")):
        with reading(like, "GIFTI", None):
            given = load_gifti(like)
        whole = dict(given.meta)
        for array in given.darrays:
            if array.intent == nibabel.nifti1.intent_codes["NIFTI_INTENT_POINTSET"]:
                own, system = dict(array.meta), array.coordsys
            elif array.intent == nibabel.nifti1.intent_codes["NIFTI_INTENT_TRIANGLE"]:
                corners = dict(array.meta)
    structure = own.get("AnatomicalStructurePrimary") or structure_of(like) or structure or structure_of(file)
    if structure:
        own["AnatomicalStructurePrimary"] = structure
    if spherical:
        own["GeometricType"] = "Spherical"
        own.pop("AnatomicalStructureSecondary", None)  # such as MidThickness, which a sphere is not
    else:
        own.setdefault("GeometricType", "Anatomical")
    corners.setdefault("TopologicalType", "Closed")
    arrays = [
        gifti.GiftiDataArray(single_precision(points, "vertices"), "NIFTI_INTENT_POINTSET", coordsys=system, meta=own),
        gifti.GiftiDataArray(faces.astype(np.int32), "NIFTI_INTENT_TRIANGLE", meta=corners),
    ]
    nibabel.save(gifti.GiftiImage(darrays=arrays, meta=gifti.GiftiMetaData(whole)), file)


def write_freesurfer_surface(file: Path, points: Floats, faces: Ints, like: Path | None) -> None:
    """Write a surface in FreeSurfer's binary format, with the volume geometry of the file that it is like."""
    io, volume = nibabel_module().freesurfer.io, None if like is None else volume_geometry_of(like)
    rounded = single_precision(points, "vertices")
    io.write_geometry(file, rounded, faces, create_stamp="created by omtwarp", volume_info=volume)
