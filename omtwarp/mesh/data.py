"""Reading and writing of numbers and labels at the vertices of a mesh.

=================================================  ==================================================================
``.npy``                                           an array [V] or [V, K]
``.csv``, ``.txt``                                 a line for every vertex, below a line of names if there is one
``.shape.gii``, ``.func.gii``, ``.label.gii``      GIFTI; labels with their table of names and colours
``.annot``                                         FreeSurfer's labels with their table
``.curv``, ``.sulc``, ``.thickness``, ``.area``,   FreeSurfer's curv format
``.volume``
``.ply``                                           properties of the vertices besides their position
``.mgh``, ``.mgz``                                 FreeSurfer's, read only
``.dscalar.nii``, ``.dtseries.nii``,               CIFTI, read only, of the surface's part of the brain: NaN, or the
``.dlabel.nii``                                    key 0, at vertices without data, such as the medial wall
=================================================  ==================================================================

A number may be NaN, where there is none.
"""

import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError, brief
from omtwarp.files.inputs import array_of, read_bytes, reading
from omtwarp.files.limits import LARGEST_MESH_FILE
from omtwarp.files.output import staged
from omtwarp.mesh.arrays import Floats, Ints, single_precision, whole_numbers
from omtwarp.mesh.neuro import copied, load_gifti, nibabel_module, structure_of
from omtwarp.mesh.ply import ply_columns
from omtwarp.mesh.write import ply_bytes

CURV_SUFFIXES = (".curv", ".sulc", ".thickness", ".area", ".volume")
TEXT_SUFFIXES = (".csv", ".txt")
DATA_SUFFIXES = (".npy", *TEXT_SUFFIXES, ".gii", ".annot", *CURV_SUFFIXES, ".ply")
"""Formats that are written."""
MGH_SUFFIXES = (".mgh", ".mgz")
CIFTI_SUFFIXES = (".dscalar.nii", ".dtseries.nii", ".dlabel.nii")

_TOO_EXACT = "single precision does not hold these whole numbers"

TITLES = re.compile(r'"((?:[^"]|"")*)"|([^\s,;"]+)')  # in a line of names: in quotes, or none

LabelTable = dict[int, tuple[str, tuple[float, float, float, float]]]


@dataclass(frozen=True, eq=False)
class VertexData:
    """Numbers or labels at vertices.

    Attributes:
        values: float64, or int64 for labels, shape [V, K].
        names: of the K columns.
        table: of labels, for every key its name and its colour (red, green, blue, opacity from 0 to 1); None for
            numbers.
        structure: the part of the brain, as GIFTI names it, where the file says it.
        meta: further metadata of a GIFTI file.
    """

    values: NDArray[np.generic]
    names: tuple[str, ...]
    table: LabelTable | None = None
    structure: str | None = None
    meta: dict[str, str] = field(default_factory=dict)

    @property
    def is_labels(self) -> bool:
        """Whether these are labels with a table."""
        return self.table is not None


def read_data(path: Path, structure: str | None = None) -> VertexData:
    """Read per-vertex data of any format of the module's table.

    Args:
        path: the file.
        structure: the part of the brain that the vertices are of, as GIFTI names it, such as ``CortexLeft``; CIFTI
            files hold several. None where it is not known: the file's name may say it.

    Raises:
        OmtwarpError: a missing or unreadable file, an unknown format, no data in it, or data of several surfaces where
            it is not known which is meant.
    """
    data = read_bytes(path, LARGEST_MESH_FILE, "data file")
    name = path.name.lower()
    by_nibabel = name.endswith((".annot", ".nii", *MGH_SUFFIXES, *CURV_SUFFIXES)) or data[:3] == b"\xff\xff\xff"
    with reading(path, "data", len(data)), copied(data, path.name) if by_nibabel else nullcontext(path) as file:
        readers: dict[str | tuple[str, ...], Callable[[], VertexData]] = {
            ".npy": lambda: from_npy(data, path.stem),
            TEXT_SUFFIXES: lambda: from_text(data.decode("utf-8-sig"), path.stem),
            (".gii", ".gii.gz"): lambda: _read_gifti(path),
            ".annot": lambda: _read_annot(file, data),
            ".ply": lambda: _read_ply(data),
            MGH_SUFFIXES: lambda: _read_mgh(file),
            ".nii": lambda: _read_cifti(file, structure or structure_of(path)),
            name if by_nibabel else CURV_SUFFIXES: lambda: _read_curv(file),
        }
        read = next((read for endings, read in readers.items() if name.endswith(endings)), None)
        if read is None:
            known = ", ".join((*DATA_SUFFIXES, *MGH_SUFFIXES, *CIFTI_SUFFIXES))
            raise OmtwarpError(f"unknown format of data: use {known}")
        content = read()
    return content if content.structure else replace(content, structure=structure_of(path))


def from_npy(data: bytes, name: str = "data") -> VertexData:
    """Read an array [V] or [V, K] in NumPy's format.

    Raises:
        OmtwarpError: the file holds no such array.
    """
    array = array_of(data, name)
    if array.dtype.kind not in "iufb" or array.ndim not in (1, 2):
        raise OmtwarpError("not an array of numbers of shape [V] or [V, K]")
    columns = (array.astype(np.int64) if array.dtype.kind == "b" else array).reshape(len(array), -1)
    values = columns.astype(np.float64) if array.dtype.kind == "f" else whole_numbers(columns, "data", (None, None))
    return VertexData(values, _numbered(name, columns))


def _numbered(name: str, columns: NDArray[np.generic]) -> tuple[str, ...]:
    """Name columns after the file, with a number each if they are several."""
    count = columns.shape[1]
    return (name,) if count == 1 else tuple(f"{name} {k + 1}" for k in range(count))


def from_text(text: str, name: str = "data") -> VertexData:
    """Read a line of numbers for every vertex, divided by commas, semicolons, tabs or spaces.

    Empty lines and lines that begin with ``#`` are skipped; a first line that is no numbers names the columns, in
    quotes where a name is a number or has one of these signs in it.

    Args:
        text: what the file holds.
        name: of the data, where no line names the columns.

    Raises:
        OmtwarpError: a line without numbers, or of another length than the first.
    """
    rows = [line.strip().rstrip(",;") for line in text.splitlines()]
    rows = [row for row in rows if row and not row.startswith("#")]
    words = [re.split(r"\s*[,;\t]\s*|\s+", row) for row in rows]
    names = words.pop(0) if words and not any(map(_is_number, words[0])) else []
    if names and '"' in rows[0]:
        names = [" ".join(title).strip().replace('""', '"') for title in TITLES.findall(rows[0])]
    try:
        columns = np.array([[float(word) for word in row] for row in words])
    except ValueError as error:
        raise OmtwarpError(f"no list of numbers: {brief(error)}") from None
    if columns.ndim != 2:
        raise OmtwarpError("no list of numbers: it is empty")
    return VertexData(columns, tuple(names) if len(names) == columns.shape[1] else _numbered(name, columns))


def _as_title(name: str) -> str:
    """Return a name of a column as a line of names has it: in quotes where it could be taken for more, or a number."""
    if re.fullmatch(r"[\w.-]+", name) and not _is_number(name):
        return name
    return '"' + " ".join(name.split()).replace('"', '""') + '"'


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_gifti(path: Path) -> VertexData:
    nibabel = nibabel_module()
    image = load_gifti(path)
    codes = nibabel.nifti1.intent_codes
    geometry = (codes["NIFTI_INTENT_POINTSET"], codes["NIFTI_INTENT_TRIANGLE"])
    arrays = [array for array in image.darrays if array.intent not in geometry]
    if not arrays:
        raise OmtwarpError("a surface without data")
    if any(array.data.ndim != 1 or len(array.data) != len(arrays[0].data) for array in arrays):
        raise OmtwarpError("its arrays have different lengths, or more than one number per vertex")
    labels = all(array.intent == codes["NIFTI_INTENT_LABEL"] for array in arrays)
    names = tuple(array.meta.get("Name") or f"{path.name.split('.')[0]} {k + 1}" for k, array in enumerate(arrays))
    table = None
    if labels:
        table = {}
        for label in image.labeltable.labels:
            red, green, blue, alpha = (1.0 if part is None else float(part) for part in label.rgba)
            table[int(label.key)] = (label.label or str(label.key), (red, green, blue, alpha))
    meta = dict(image.meta)
    structure = meta.get("AnatomicalStructurePrimary")
    kind = np.int64 if labels else np.float64
    return VertexData(np.stack([array.data.astype(kind) for array in arrays], axis=1), names, table, structure, meta)


def _read_curv(path: Path) -> VertexData:
    values = nibabel_module().freesurfer.read_morph_data(path)
    return VertexData(np.asarray(values, np.float64)[:, None], (path.suffix.lstrip("."),))


def _read_mgh(path: Path) -> VertexData:
    values = np.asanyarray(nibabel_module().load(path).dataobj)
    shape = values.shape[:3]
    if values.ndim not in (3, 4) or sorted(shape)[1] != 1:
        raise OmtwarpError(f"a volume of {' x '.join(map(str, shape))}, not data of vertices")
    columns = values.reshape(max(shape), -1, order="F")
    return VertexData(columns.astype(np.float64), _numbered(path.name.partition(".mg")[0], columns))


def _read_cifti(path: Path, structure: str | None) -> VertexData:
    """Read the data of one surface, with NaN, or the key 0, at vertices without any.

    Raises:
        OmtwarpError: the file is no such CIFTI, or it holds several surfaces and none of them is the structure.
    """
    nibabel = nibabel_module()
    image = nibabel.load(path)
    axes = nibabel.cifti2.cifti2_axes
    if not isinstance(image, nibabel.Cifti2Image):
        raise OmtwarpError("a volume, not data of vertices")
    rows, models = image.header.get_axis(0), image.header.get_axis(1)
    if not isinstance(models, axes.BrainModelAxis) or isinstance(rows, axes.BrainModelAxis):
        raise OmtwarpError(f"no CIFTI file of data at vertices: use {', '.join(CIFTI_SUFFIXES)}")
    parts = {_gifti_name(name): (columns, model) for name, columns, model in models.iter_structures()}
    surfaces = [name for name in parts if name in map(_gifti_name, models.nvertices)]
    if structure is None and len(surfaces) == 1:
        (structure,) = surfaces
    if structure not in surfaces:
        which = "the surface does not say which" if structure is None else f"not of {structure}"
        raise OmtwarpError(
            f"data of {', '.join(surfaces) or 'no surface'}, and {which}: GIFTI says it inside, other files by names "
            "with lh. or rh., hemi-L or hemi-R, .L. or .R."
        )
    columns, model = parts[structure]
    values = np.asanyarray(image.dataobj)[:, columns].T
    (count,) = model.nvertices.values()
    if not isinstance(rows, axes.LabelAxis):
        names = rows.name if isinstance(rows, axes.ScalarAxis) else _numbered(path.name.split(".")[0], values)
        whole: NDArray[np.generic] = np.full((count, values.shape[1]), np.nan)
        whole[model.vertex] = values
        return VertexData(whole, tuple(map(str, names)), structure=structure)
    tables = [{int(key): (str(name), tuple(color)) for key, (name, color) in table.items()} for table in rows.label]
    if any(table != tables[0] for table in tables):
        raise OmtwarpError("its maps have different tables of labels: save them in files of their own")
    whole = np.zeros((count, values.shape[1]), dtype=np.int64)
    whole[model.vertex] = values
    return VertexData(whole, tuple(map(str, rows.name)), {0: ("???", (0.0,) * 4)} | tables[0], structure)


def _gifti_name(structure: str) -> str:
    """Return GIFTI's name of a CIFTI structure: CortexLeft for CIFTI_STRUCTURE_CORTEX_LEFT."""
    return structure.removeprefix("CIFTI_STRUCTURE_").title().replace("_", "")


def _read_annot(path: Path, data: bytes) -> VertexData:
    codes, colors, names = nibabel_module().freesurfer.read_annot(path, orig_ids=True)
    table: LabelTable = {}
    named = 8 * len(codes) + 16  # where the length of the name of the table's own file stands, before the entries
    at = named + 8 + int.from_bytes(data[named : named + 4])
    for place, name in enumerate(names):
        # Where numbers are left out, each entry's own stands before its name
        key, length = np.frombuffer(data, ">i4", 2, at).tolist() if len(names) < len(colors) else (place, 0)
        at += 24 + length
        red, green, blue, transparency = (colors[key, :4] / 255.0).tolist()
        table[key] = (name.decode(), (red, green, blue, 1.0 - transparency))
    known = {int(colors[key, 4]): key for key in reversed(table)}  # the first of a colour counts, as in FreeSurfer
    labels = np.array([known.get(code, -1) for code in codes.tolist()], dtype=np.int64)
    if (labels < 0).any():
        table[-1] = ("???", (0.0, 0.0, 0.0, 0.0))
    return VertexData(labels[:, None], (path.stem,), table)


def _read_ply(data: bytes) -> VertexData:
    vertex = ply_columns(data)[0].get("vertex", {})
    names = [name for name in vertex if name not in ("x", "y", "z")]
    if not names:
        raise OmtwarpError("its vertices have no properties but their position")
    return VertexData(np.stack([np.asarray(vertex[name], dtype=np.float64) for name in names], axis=1), tuple(names))


def write_data(path: Path, data: VertexData, mesh: tuple[Floats, Ints] | None = None) -> None:
    """Write per-vertex data; an older file is as it was if anything is wrong.

    Args:
        path: its suffix determines the format (see the module's table).
        data: numbers or labels.
        mesh: vertices and faces, for ``.ply``.

    Raises:
        OmtwarpError: a format that cannot hold these data, a missing table of names, or a file not to be written.
    """
    name = path.name.lower()
    if name.endswith((".label.gii", ".annot")) and data.table is None:
        raise OmtwarpError(f"cannot write '{path}': the data are without a table of names; use .shape.gii or .npy")
    if name.endswith((".annot", *CURV_SUFFIXES)) and data.values.shape[1] != 1:
        raise OmtwarpError(f"cannot write '{path}': the format holds one number per vertex, not {data.values.shape[1]}")
    with staged(path) as file:
        if name.endswith(".npy"):
            with open(file, "wb") as stream:
                np.save(stream, data.values[:, 0] if data.values.shape[1] == 1 else data.values)
        elif name.endswith(TEXT_SUFFIXES):
            rows = [",".join(map(_as_title, data.names)), *(",".join(map(repr, row)) for row in data.values.tolist())]
            file.write_text("\n".join(rows) + "\n", "utf-8")
        elif name.endswith((".gii", ".gii.gz")):
            _write_gifti(file, data, name)
        elif name.endswith(".annot"):
            _write_annot(file, data)
        elif name.endswith(CURV_SUFFIXES):
            values = _stored(data.values[:, 0], data.names[0])
            if values.dtype != np.float32:
                raise OmtwarpError(f"cannot write '{path}': {_TOO_EXACT}: use .label.gii, .npy or .csv")
            nibabel_module().freesurfer.write_morph_data(file, values)
        elif name.endswith(".ply"):
            if mesh is None:
                raise OmtwarpError(f"cannot write '{path}': .ply needs a mesh with triangles; use .npy")
            file.write_bytes(ply_bytes(mesh[0], mesh[1], zip(data.names, data.values.T, strict=True)))
        else:
            raise OmtwarpError(f"cannot write '{path}': unknown format of data, use {', '.join(DATA_SUFFIXES)}")


def _write_gifti(file: Path, data: VertexData, name: str) -> None:
    nibabel = nibabel_module()
    gifti = nibabel.gifti
    meta = dict(data.meta)
    structure = data.structure or structure_of(file)
    if structure:
        meta["AnatomicalStructurePrimary"] = structure
    intent = "NIFTI_INTENT_NONE" if name.endswith((".func.gii", ".func.gii.gz")) else "NIFTI_INTENT_SHAPE"
    table = gifti.GiftiLabelTable()
    if data.table is not None:
        intent = "NIFTI_INTENT_LABEL"
        for key, (word, color) in sorted(data.table.items()):
            label = gifti.GiftiLabel(key, *color)
            label.label = word
            table.labels.append(label)
    arrays = []
    for column, title in zip(data.values.T, data.names, strict=True):
        arrays.append(gifti.GiftiDataArray(_stored(column, title, labels=data.is_labels), intent, meta={"Name": title}))
    nibabel.save(gifti.GiftiImage(darrays=arrays, meta=gifti.GiftiMetaData(meta), labeltable=table), file)


def _stored(column: NDArray[np.generic], name: str, *, labels: bool = False) -> NDArray[np.generic]:
    """Return numbers in a type of GIFTI's that holds them: float32, or int32 for labels.

    Whole numbers that float32 would round become int32.

    Raises:
        OmtwarpError: no such type holds them.
    """
    finite = column[np.isfinite(column)]
    largest = np.abs(finite).max(initial=0)
    # Numbers of float64 that are larger are whole whatever they count
    counted = column.dtype.kind != "f" or (largest <= 2**53 and bool((finite == np.floor(finite)).all()))
    # Most exact: up to which float32 holds every whole number
    if labels or (counted and largest > 2**24):
        limits = np.iinfo(np.int32)
        fits = finite.min(initial=0) >= limits.min and finite.max(initial=0) <= limits.max
        if len(finite) < len(column) or not fits:
            raise OmtwarpError(f"'{name}': {_TOO_EXACT}, nor does int32: use .npy or .csv")
        return np.ascontiguousarray(column, dtype=np.int32)
    return np.ascontiguousarray(single_precision(column, f"'{name}'"))


def _write_annot(file: Path, data: VertexData) -> None:
    assert data.table is not None
    keys = [key for key in sorted(data.table) if key >= 0]
    number = {key: place for place, key in enumerate(keys)}
    places = np.array([number.get(key, -1) for key in data.values[:, 0].tolist()], dtype=np.int64)
    rgba = np.rint(255.0 * np.array([data.table[key][1] for key in keys]).reshape(-1, 4)).astype(np.int64)
    colors = np.column_stack([rgba[:, :3], 255 - rgba[:, 3]])  # with transparency in place of opacity
    # FreeSurfer identifies labels by their colours: two labels of one colour would become one.
    if len(np.unique(colors[:, :3], axis=0)) < len(keys):
        raise OmtwarpError("two labels have the same colour, by which the .annot format identifies them: change one")
    # Black stands for no label too, unless a label has it
    none = (-1, 0) if colors[:, :3].any(axis=1).all() else ()
    if lost := set(np.unique(data.values).tolist()) - {*none, *keys}:
        raise OmtwarpError(f"the .annot format cannot hold the label {min(lost)}: it is negative, or has no name")
    nibabel_module().freesurfer.write_annot(file, places, colors, [data.table[key][0] for key in keys])
