"""What registrations of many maps share: names of results, and steps that are kept where a run is interrupted."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.alignment.align import checked_features
from omtwarp.errors import OmtwarpError
from omtwarp.files.inputs import read_arrays, write_arrays
from omtwarp.files.output import RECORD, digest_of, make_folder, staged
from omtwarp.maps.result import MapResult
from omtwarp.mesh.data import read_data
from omtwarp.mesh.neuro import structure_of
from omtwarp.registration.folding import FOLDING_WEIGHTS
from omtwarp.registration.group_template import Template
from omtwarp.registration.sides import Side, folds
from omtwarp.resampling import as_points
from omtwarp.version import package_version

STEPS = ".steps"  # folder of what is kept until all is done


Files = Sequence[str | os.PathLike[str]]


@dataclass(frozen=True)
class Member:
    """A map of several and the data that it is registered by.

    Attributes:
        path: of the map.
        features: names and files of data at its vertices; without any its folds are the features.
    """

    path: Path
    features: tuple[tuple[str, Path], ...] = ()

    @property
    def digest(self) -> list[object]:
        """What tells the files from others, as plain values."""
        return [digest_of(self.path), *([name, digest_of(file)] for name, file in self.features)]

    @property
    def weights(self) -> Mapping[str, float]:
        """What the features count, where that is not 1."""
        return {} if self.features else FOLDING_WEIGHTS

    def side(self) -> Side:
        """Read the map with its features.

        Raises:
            OmtwarpError: a file cannot be read, or its data are not one number for each vertex.
        """
        points, given = as_points(MapResult.load(self.path), str(self.path)), {}
        for name, file in self.features:
            columns = read_data(file, structure_of(self.path)).values
            if columns.shape[1] != 1:
                raise OmtwarpError(f"'{file}' has {columns.shape[1]} columns: give a file of one for each feature")
            given[name] = columns[:, 0]
        return Side(points, checked_features(given, points, str(self.path)) or folds(points, str(self.path)))


def members(
    maps: Files, features: Mapping[str, Files] | None, folder: str | os.PathLike[str], *taken: str
) -> dict[str, Member]:
    """Return maps and their data by the names of the maps without suffix, under which results go to a folder.

    Args:
        maps: the files.
        features: by name, a file of data for every map, in their order.
        folder: of the results.
        taken: names of other results.

    Raises:
        OmtwarpError: fewer than two maps, two of one name, one that is called as a result is, or that one would
            replace, or another number of files of a feature.
    """
    wanted = features or {}
    for name, given in wanted.items():
        if len(given) != len(maps):
            raise OmtwarpError(f"feature '{name}' has {len(given)} files for {len(maps)} maps: give one a map")
    paths = _by_name(maps, folder, *taken)
    return {
        stem: Member(path, tuple((name, Path(given[k])) for name, given in wanted.items()))
        for k, (stem, path) in enumerate(paths.items())
    }


def _by_name(maps: Files, folder: str | os.PathLike[str], *taken: str) -> dict[str, Path]:
    """Return maps by their names without suffix; arguments and errors as of :func:`members`."""
    files = {Path(path).stem: Path(path) for path in maps}
    if len(maps) < 2:
        raise OmtwarpError(f"{len(maps)} map in all: give at least two")
    if len(files) < len(maps):
        raise OmtwarpError(f"{len(maps)} maps have {len(files)} names: results are called as they are, so rename some")
    for word in taken:
        if word in files:
            raise OmtwarpError(f"'{files[word]}' has the name of a result: rename it")
    replaced = next((one for name, one in files.items() if _same(one, Path(folder) / f"{name}.npz")), None)
    if replaced is not None:
        raise OmtwarpError(f"'{replaced}' is a map and would be replaced as a result: choose another folder")
    missing = next((path for path in files.values() if not path.is_file()), None)
    if missing is not None:
        raise OmtwarpError(f"'{missing}' is no file: give maps (.npz)")
    return files


def _same(one: Path, other: Path) -> bool:
    return os.path.realpath(one) == os.path.realpath(other)


class Kept:
    """Results of steps, a file each, until all are done.

    Args:
        folder: made if there is none.

    Raises:
        OmtwarpError: the folder cannot be made.
    """

    def __init__(self, folder: Path):
        make_folder(folder)
        self._folder = folder
        self._files: list[Path] = []

    def result(
        self, name: str, key: str, make: Callable[[], Mapping[str, ArrayLike]], made: Path | None = None
    ) -> dict[str, NDArray]:
        """Return what a step makes, or made before with the same key, and the file it wrote, if any, unchanged."""
        file = self._folder / f"{name}.npz"
        self._files.append(file)
        with contextlib.suppress(OSError, OmtwarpError), open(file, "rb") as stream:
            names = [str(one) for one in read_arrays(stream, ["names"])["names"]]
            known = read_arrays(stream, ["key", "made", *names])
            if str(known.pop("key")) == key and str(known.pop("made")) == (digest_of(made) if made else ""):
                return known
        found = {what: np.asarray(values) for what, values in make().items()}
        words = {"key": np.array(key), "names": np.array([*found]), "made": np.array(digest_of(made) if made else "")}
        write_arrays(file, {**found, **words})
        return found

    def remove(self) -> None:
        """Remove the files of all steps, and their folder where nothing else is in it."""
        for file in (*self._files, self._folder / RECORD):
            file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._folder.rmdir()


def key_of(*parts: object) -> str:
    """Return a digest of what a step depends on: the version, plain values, and templates."""
    digest = hashlib.sha256(package_version().encode())
    for part in parts:
        content = part.content() if isinstance(part, Template) else json.dumps(part, sort_keys=True).encode()
        digest.update(content)
    return digest.hexdigest()


def write_facts(path: Path, table: Mapping[str, Mapping[str, float]]) -> None:
    """Write facts about maps as ``.csv``, a line for each, with its name as ``id``."""
    columns = list(dict.fromkeys(column for row in table.values() for column in row))
    with staged(path) as file, open(file, "w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["id", *columns])
        writer.writerows([[name, *(row.get(column, "") for column in columns)] for name, row in table.items()])
