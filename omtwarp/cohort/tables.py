"""The tables of a cohort: its items, from a table, a pattern of names or BIDS names, and its results."""

import csv
import glob
import os
import re
import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from omtwarp.cohort.item import NUMBERS, OF_REGISTRATION, OK, REAL, WHOLE, Row
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files import output
from omtwarp.files.inputs import table_rows, table_text

MESH_SUFFIXES = (
    *(".ply", ".obj", ".off", ".stl", ".glb", ".gltf", ".gii", ".vtk", ".vtp", ".vtu", ".mz3", ".msh", ".mesh"),
    *(".inp", ".white", ".pial", ".orig"),
)
"""Files of a folder that are items, also compressed (``.gz``)."""


@dataclass(frozen=True)
class Item:
    """One surface of a cohort.

    Attributes:
        id: its name among the others, which names its files; letters, digits, and any of ``._-``.
        path: of the mesh.
        fields: what else is known about it, such as a group or BIDS entities; columns of the table.
    """

    id: str
    path: Path
    fields: dict[str, str] = field(default_factory=dict)


def read_manifest(source: str | Path | TextIO) -> list[Item]:
    """List the items of a cohort.

    Args:
        source: a table (.csv or .tsv) with a column ``path`` (relative to the table), and perhaps ``id`` and others; a
            folder; a pattern such as ``sub-*/surf/lh.white``, quoted; or an open table, whose paths are relative to
            the current folder. Without a column ``id`` items are named after their files, and parts such as ``sub-01``
            and ``hemi-L`` of BIDS names become columns. Of a folder the files that end in :data:`MESH_SUFFIXES` are
            items.

    Raises:
        OmtwarpError: no such file, no item, no column ``path``, or two items of one name.

    Warns:
        OmtwarpWarning: files of a folder are left out, with their names.
    """
    if not isinstance(source, str | Path):
        return _checked(_from_text(source.read(), "the table", Path()), "the table")
    text = str(source)
    path = Path(text)
    if any(sign in text for sign in "*?[") and not path.exists():
        paths = sorted(Path(name) for name in glob.glob(text, recursive=True))
        items = _named([(p, {}) for p in paths if p.is_file()])
    elif path.is_dir():
        items = _named([(p, {}) for p in _meshes_of(path)])
    else:
        # Largest manifest: bytes; a million rows of 256
        text = table_text(path, 2**28, "a table (.csv, .tsv), a folder or a pattern in quotes")
        items = _from_text(text, f"'{path}'", path.parent, "\t" if path.suffix.lower() == ".tsv" else ",")
    return _checked(items, f"'{source}'")


def _meshes_of(folder: Path) -> list[Path]:
    """List the files of a folder that are meshes by their names, and warn of the others.

    Raises:
        OmtwarpError: the folder cannot be read.
    """
    most_named = 8  # files left out that a warning names
    try:
        files = sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise OmtwarpError(f"{folder}: cannot be read: {error.strerror or error}") from None
    meshes = [path for path in files if Path(path.name.lower().removesuffix(".gz")).suffix in MESH_SUFFIXES]
    if others := [path.name for path in files if path not in meshes and not path.is_dir()]:
        names = ", ".join(others[:most_named]) + (", ..." if len(others) > most_named else "")
        text = f"'{folder}': left out {len(others)} files, which are no meshes by their names: {names}"
        warnings.warn(f"{text}; a table or a pattern takes any", OmtwarpWarning, stacklevel=3)
    return meshes


def _checked(items: list[Item], source: str) -> list[Item]:
    """Refuse an empty list of items, and two items of one name; return the others unchanged."""
    if not items:
        raise OmtwarpError(f"{source} names no surface")
    if twice := [name for name, count in Counter(item.id.casefold() for item in items).items() if count > 1]:
        raise OmtwarpError(f"{len(twice)} items of {source} have the name of another, the first is '{twice[0]}'")
    return items


def _from_text(text: str, name: str, folder: Path, delimiter: str = "") -> list[Item]:
    """Read items from a table's text, whose columns are separated by tabs where its first line has one."""
    first = text.partition("\n")[0]
    names, listed = table_rows(text, name, delimiter or ("\t" if "\t" in first else ","), "path")
    entries: list[tuple[Path, dict[str, str]]] = []
    if twice := [column for column, times in Counter(names).items() if times > 1]:
        raise OmtwarpError(f"{name} has several columns called '{twice[0]}': its first line is '{first[:80]}'")
    for number, row in listed:
        if None in row or any(value is None for value in row.values()):
            raise OmtwarpError(f"{name}, line {number}: not {len(names)} columns as the first line has")
        if not row["path"].strip() or "\0" in row["path"]:
            raise OmtwarpError(f"{name}, line {number}: the path is empty, or has a null byte")
        fields = {column: value for column, value in row.items() if column != "path"}
        entries.append((folder / row["path"].strip(), fields))
    if "id" not in names:
        return _named(entries)
    return [Item(_safe(fields.pop("id")), mesh, fields) for mesh, fields in entries]


def _named(rows: list[tuple[Path, dict[str, str]]]) -> list[Item]:
    """Name items after their files, with as many folders in front as make them distinct."""
    for depth in range(1, 8):
        names = [_safe("_".join(path.absolute().parts[-depth:-1] + (_stem(path),))) for path, _ in rows]
        if len({name.casefold() for name in names}) == len(names):
            break
    # Entities of a BIDS name: sub-01_hemi-L_white.surf.gii has sub 01 and hemi L.
    entity = re.compile(r"(?:^|_)([a-zA-Z]+)-([a-zA-Z0-9]+)")
    return [
        Item(name, path, dict(entity.findall(path.name)) | fields)
        for name, (path, fields) in zip(names if rows else [], rows, strict=True)
    ]


def _stem(path: Path) -> str:
    stem, of_formats = path.name, {*MESH_SUFFIXES, ".surf", ".gz"} - {".white", ".pial", ".orig"}
    while Path(stem).suffix.lower() in of_formats and Path(stem).stem:
        stem = Path(stem).stem
    return stem


def _safe(name: str) -> str:
    cleaned = re.sub(r"[^\w.-]+", "_", name.strip(), flags=re.ASCII).strip("._")
    if not cleaned:
        raise OmtwarpError(f"the item name '{name}' has no letter or digit")
    return cleaned[:120]


TABLES = "table.parquet", "table.csv"
ORDER = ("id", "path", "status", *WHOLE[:3], *NUMBERS, "memory", "version", "message", "map_size", "map_digest", "key")
GROUP, REGISTERED_MAPS = "group", "registered"  # what maps are registered to, and the folder where they go then
REGISTERED = ("registered_to", *OF_REGISTRATION)  # columns where maps are registered


def columns_of(rows: Sequence[Row]) -> list[str]:
    """Return the names of a table's columns: the manifest's own after ``path``, then the others in a fixed order."""
    given = dict.fromkeys(name for row in rows for name in row)
    own = [name for name in given if name not in ORDER and name not in REGISTERED]
    return [*ORDER[:2], *own, *ORDER[2:], *(name for name in REGISTERED if name in given)]


def write_table(rows: Sequence[Row], folder: Path) -> Path:
    """Write ``table.parquet``, or ``table.csv`` where there is no pyarrow; whichever is older is removed.

    Args:
        rows: one per item; missing values are left out.
        folder: where the table goes.
    """
    names = columns_of(rows)
    try:
        import pyarrow as arrow
        import pyarrow.parquet as parquet
    except ImportError:
        target = folder / "table.csv"
        output.write_table(target, names, [[row.get(name) for name in names] for row in rows])
    else:
        kinds = defaultdict(arrow.string, dict.fromkeys(WHOLE, arrow.int64()) | dict.fromkeys(REAL, arrow.float64()))
        columns = [arrow.array([_valid(row.get(name)) for row in rows], kinds[name]) for name in names]
        with output.staged(target := folder / "table.parquet") as file:
            parquet.write_table(arrow.table(columns, names=names), file)
    (folder / ("table.csv" if target.suffix == ".parquet" else "table.parquet")).unlink(missing_ok=True)
    return target


def _valid(value: object) -> object:
    """Return a value as UTF-8 can hold it: bytes of a file's name that are none are backslashed."""
    return value.encode(errors="backslashreplace").decode() if isinstance(value, str) else value


def read_table(path: str | os.PathLike[str]) -> list[Row]:
    """Read a table that :func:`write_table` wrote; a CSV's numbers become numbers, its empty fields None."""
    path = output.as_path(path)
    if path.suffix == ".parquet":
        import pyarrow.parquet as parquet

        return list(parquet.read_table(path).to_pylist())
    with open(path, encoding="utf-8", newline="") as stream:
        return [
            {
                name: (int(value) if name in WHOLE else float(value) if name in REAL else value) if value else None
                for name, value in row.items()
            }
            for row in csv.DictReader(stream)
        ]


def map_of(folder: Path, row: Row) -> Path:
    """Return the file of an item's map in a cohort's folder, registered where the table says so."""
    return folder / (REGISTERED_MAPS if row.get("registered_to") == GROUP else "maps") / f"{row['id']}.npz"


def table_of_cohort(source: Path) -> tuple[Path, list[Row]] | None:
    """Return the folder of a cohort and its mapped rows, or None where the source is neither folder nor table of one.

    Args:
        source: the folder of a cohort's results, or the table in it.

    Raises:
        OmtwarpError: the table cannot be read, or has columns that no cohort writes.
    """
    folder = source if source.is_dir() else source.parent
    tables = [folder / name for name in TABLES if (folder / name).is_file()]
    if not (folder / "maps").is_dir() or not tables or source not in (folder, *tables):
        return None
    table = source if source in tables else tables[0]
    try:
        return folder, [row for row in read_table(table) if row["status"] == OK]
    except ImportError as error:
        raise OmtwarpError(f"'{table}' needs the package pyarrow: pip install 'omtwarp[tables]'") from error
    except (OSError, ValueError, KeyError) as error:
        raise OmtwarpError(f"'{table}' cannot be read as a cohort's table: {error}") from None
