"""The items of a cohort: from a table, a pattern of file names, or BIDS names."""

from __future__ import annotations

import csv
import glob
import io
import re
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TextIO

from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files.inputs import read_bytes

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
        items = _from_table(path)
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
    others = [path.name for path in files if path not in meshes and not path.is_dir()]
    if others:
        names = ", ".join(others[:most_named]) + (", ..." if len(others) > most_named else "")
        text = f"'{folder}': left out {len(others)} files, which are no meshes by their names: {names}"
        warnings.warn(f"{text}; a table or a pattern takes any", OmtwarpWarning, stacklevel=3)
    return meshes


def _checked(items: list[Item], source: str) -> list[Item]:
    """Refuse an empty list of items, and two items of one name; return the others unchanged."""
    if not items:
        raise OmtwarpError(f"{source} names no surface")
    twice = [name for name, count in Counter(item.id.casefold() for item in items).items() if count > 1]
    if twice:
        raise OmtwarpError(f"{len(twice)} items of {source} have the name of another, the first is '{twice[0]}'")
    return items


def _from_table(path: Path) -> list[Item]:
    try:
        # Largest manifest: bytes; a million rows of 256
        text = read_bytes(path, 2**28, "table").decode("utf-8-sig")
    except UnicodeDecodeError:
        raise OmtwarpError(f"'{path}' is no text: give a table (.csv, .tsv), a folder or a pattern in quotes") from None
    return _from_text(text, f"'{path}'", path.parent, "\t" if path.suffix.lower() == ".tsv" else ",")


def _from_text(text: str, name: str, folder: Path, delimiter: str = "") -> list[Item]:
    """Read items from a table's text, whose columns are separated by tabs where its first line has one."""
    first = text.partition("\n")[0]
    rows = csv.DictReader(io.StringIO(text), delimiter=delimiter or ("\t" if "\t" in first else ","))
    try:
        names = rows.fieldnames or []
    except csv.Error as error:
        raise OmtwarpError(f"{name}, line 1: {error}") from None
    if "path" not in names:
        raise OmtwarpError(f"{name} has no column 'path': its first line is '{first[:80]}'")
    found: list[tuple[Path, dict[str, str]]] = []
    try:
        listed = [(rows.line_num, row) for row in rows]
    except csv.Error as error:
        raise OmtwarpError(f"{name}, line {rows.line_num}: {error}") from None
    for number, row in listed:
        if None in row or any(value is None for value in row.values()):
            raise OmtwarpError(f"{name}, line {number}: not {len(names)} columns as the first line has")
        if not row["path"].strip():
            raise OmtwarpError(f"{name}, line {number}: the path is empty")
        fields = {column: value for column, value in row.items() if column != "path"}
        found.append((folder / row["path"].strip(), fields))
    if "id" not in names:
        return _named(found)
    return [Item(_safe(fields.pop("id")), mesh, fields) for mesh, fields in found]


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
    stem = path.name
    while Path(stem).suffix.lower() in (*MESH_SUFFIXES, ".surf", ".gz") and Path(stem).stem:
        suffix = Path(stem).suffix.lower()
        if suffix in (".white", ".pial", ".orig"):
            break
        stem = Path(stem).stem
    return stem


def _safe(name: str) -> str:
    cleaned = re.sub(r"[^\w.-]+", "_", name.strip(), flags=re.ASCII).strip("._")
    if not cleaned:
        raise OmtwarpError(f"the item name '{name}' has no letter or digit")
    return cleaned[:120]
