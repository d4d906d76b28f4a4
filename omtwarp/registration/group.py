"""Registration of a group: a template made from it, every map registered to that, and steps kept for a run to go on."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import json
import os
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.alignment.align import checked_features, feature_coefficients, filled_by_means
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files import output
from omtwarp.files.inputs import read_arrays, write_arrays
from omtwarp.files.output import as_path, digest_of
from omtwarp.geometry.harmonics import power_per_degree
from omtwarp.location import Locator
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, by_name, normalised, whole_number
from omtwarp.mesh.data import read_data
from omtwarp.mesh.neuro import require_same_structure, structure_of
from omtwarp.options import MAX_STRAIN, STIFFNESS, Progress, tell
from omtwarp.registration.folding import FOLDING_WEIGHTS
from omtwarp.registration.group_template import Template
from omtwarp.registration.register import Registration, register
from omtwarp.registration.sides import Side, continued, folds
from omtwarp.registration.strain import kept_within
from omtwarp.registration.warp import feature_grid
from omtwarp.resampling import as_points
from omtwarp.version import package_version

Options = Mapping[str, object]
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
            replace, or another number of files of a feature, or one of another part of the brain than its map.
    """
    wanted = by_name(features, "features")
    for name, given in wanted.items():
        if len(given) != len(maps):
            raise OmtwarpError(f"feature '{name}' has {len(given)} files for {len(maps)} maps: give one a map")
    files = {path.stem: path for path in map(as_path, maps)}
    if len(maps) < 2:
        raise OmtwarpError(f"{len(maps)} map in all: give at least two")
    if len(files) < len(maps):
        raise OmtwarpError(f"{len(maps)} maps have {len(files)} names: results are called as they are, so rename some")
    if named := [path for word, path in files.items() if word in taken]:
        raise OmtwarpError(f"'{named[0]}' has the name of a result: rename it")
    real = os.path.realpath
    if replaced := [one for name, one in files.items() if real(one) == real(Path(folder) / f"{name}.npz")]:
        raise OmtwarpError(f"'{replaced[0]}' is a map and would be replaced as a result: choose another folder")
    if missing := [path for path in files.values() if not path.is_file()]:
        raise OmtwarpError(f"'{missing[0]}' is no file: give maps (.npz)")
    found = {
        stem: Member(path, tuple((name, as_path(given[k])) for name, given in wanted.items()))
        for k, (stem, path) in enumerate(files.items())
    }
    for one in found.values():
        require_same_structure(one.path, *(file for _, file in one.features))
    return found


class Kept:
    """Results of steps, a file each, until all are done.

    Args:
        folder: made if there is none.

    Raises:
        OmtwarpError: the folder cannot be made.
    """

    def __init__(self, folder: Path):
        output.make_folder(folder)
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
        arrays = {what: np.asarray(values) for what, values in make().items()}
        words = {"key": np.array(key), "names": np.array([*arrays]), "made": np.array(digest_of(made) if made else "")}
        write_arrays(file, {**arrays, **words})
        return arrays

    def remove(self) -> None:
        """Remove the files of all steps, and their folder where nothing else is in it."""
        for file in (*self._files, self._folder / output.RECORD):
            file.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            self._folder.rmdir()


def key_of(*parts: object) -> str:
    """Return a digest of what a step depends on: the version, plain values, and templates."""
    digest = hashlib.sha256(package_version().encode())
    for part in parts:
        digest.update(part.content() if isinstance(part, Template) else json.dumps(part, sort_keys=True).encode())
    return digest.hexdigest()


def write_facts(path: Path, table: Mapping[str, Mapping[str, float]]) -> None:
    """Write facts about maps as ``.csv``, a line for each, with its name as ``id``."""
    columns = list(dict.fromkeys(column for row in table.values() for column in row))
    output.write_table(path, ["id", *columns], [[name, *map(row.get, columns)] for name, row in table.items()])


ROUNDS = 3  # that a template is made anew


@dataclass(frozen=True, eq=False)
class GroupRegistration:
    """A group's template, and how its maps were registered.

    Attributes:
        template: made from all of them.
        table: for every map by its name what its registration's :meth:`Registration.facts`.
    """

    template: Template
    table: dict[str, dict[str, float]]


def register_group(
    maps: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    *,
    features: Mapping[str, Files] | None = None,
    rounds: int = ROUNDS,
    stiffness: float = STIFFNESS,
    max_strain: float = MAX_STRAIN,
    keep_areas: float | str = 0.0,
    progress: Progress | None = None,
) -> GroupRegistration:
    """Make a template from maps of a group, and register them to it.

    The first template is the map with the most usual features, by their power at every wave length, in its position. In
    every round all maps are registered to the template; the next one has their mean features, moved so that the mean
    of the ways from it to the maps, point by point, leads nowhere. Maps are read one at a time. What is done is kept:
    an interrupted run goes on where it was, and a finished one is not repeated. The order of the maps does not count.

    Args:
        maps: files of maps with their surfaces, of different names.
        folder: gets ``template.npz``, which :func:`omtwarp.register` takes as a target, every map registered to it
            under its own name, and ``table.csv``.
        features: by name, a file of data at the vertices for every map, in their order; they take the place of the
            folds.
        rounds: how many times the template is made anew.
        stiffness, max_strain, keep_areas: as of :func:`omtwarp.register`.
        progress: called as ``progress("group", step, steps, {})`` after every map in every round.

    Returns:
        The template, and how well every map was registered.

    Raises:
        OmtwarpError: fewer than two maps, two of one name, a file that is no map, data that do not belong to it, or a
            folder that cannot be written.
    """
    files = dict(sorted(members(maps, features, folder, "template").items()))
    rounds = whole_number(rounds, "rounds", least=1)
    options: dict[str, object] = {"stiffness": stiffness, "max_strain": max_strain, "keep_areas": keep_areas}
    digests = {name: one.digest for name, one in files.items()}
    target, origin = as_path(folder), key_of(rounds, digests, options)
    finished = _finished(target, origin, files)
    if finished is not None:
        return finished
    template = _most_usual(files)
    steps, done = (rounds + 1) * len(files), 0
    results = ("template.npz", "table.csv", *(f"{name}.npz" for name in files))
    with output.folder_of_results(target, *results), output.folder_of_results(target / STEPS):
        kept = Kept(target / STEPS)
        for number in range(rounds):
            total: dict[str, Floats] = {}
            for name, one in files.items():
                key = key_of(number, digests[name], options, template)
                step = kept.result(f"{number}_{name}", key, partial(_step, one, template, options))
                for what, values in step.items():
                    total[what] = total.get(what, 0.0) + values
                done += 1
                tell(progress, "group", done, steps, {})
            template = _mean_template(total, template.names, max_strain)
        template = replace(template, origin=origin)
        table = {}
        for name, one in files.items():
            key, file = key_of(rounds, digests[name], options, template), target / f"{name}.npz"
            facts = kept.result(f"{rounds}_{name}", key, partial(_finish, one, template, options, file), file)
            table[name] = {what: float(value) for what, value in facts.items()}
            done += 1
            tell(progress, "group", done, steps, {})
        write_facts(target / "table.csv", table)
        template.save(target / "template.npz")
        kept.remove()
    return GroupRegistration(template, table)


def finished_group(maps: Files, folder: str | os.PathLike[str]) -> GroupRegistration | None:
    """Return what :func:`register_group` without options left in a folder; None where it has not ended on these maps.

    Raises:
        OmtwarpError: what :func:`members` raises.
    """
    files = dict(sorted(members(maps, None, folder, "template").items()))
    usual = {"stiffness": STIFFNESS, "max_strain": MAX_STRAIN, "keep_areas": 0.0}
    return _finished(as_path(folder), key_of(ROUNDS, {name: one.digest for name, one in files.items()}, usual), files)


def _finished(folder: Path, origin: str, names: Collection[str]) -> GroupRegistration | None:
    """Return what a folder holds where a run on the same maps ended in it, and its files were not changed since."""
    files = [folder / name for name in ("template.npz", "table.csv", *(f"{name}.npz" for name in names))]
    with contextlib.suppress(OSError, OmtwarpError, ValueError):
        if all(output.written_by_omtwarp(file) for file in files):
            with open(files[0], "rb") as stream:
                known = str(read_arrays(stream, ["origin"]).get("origin", ""))
            if known == origin:
                with open(files[1], encoding="utf-8", newline="") as text:
                    rows = list(csv.DictReader(text))
                table = {row.pop("id"): {name: float(value) for name, value in row.items()} for row in rows}
                return GroupRegistration(Template.load(files[0]), table)
    return None


def _most_usual(files: Mapping[str, Member]) -> Template:
    """Return the features of the map whose power at every degree is nearest to the mean, in its own position."""
    degree = 16
    powers = []
    for one in files.values():
        here = one.side()
        coefficients = feature_coefficients(filled_by_means(here.features, here.points), here.points, degree)
        powers.append(np.concatenate([power_per_degree(column)[1:] for column in coefficients.T]))
    apart = np.linalg.norm(np.array(powers) - np.mean(powers, axis=0), axis=1)
    here, grid = list(files.values())[int(np.argmin(apart))].side(), feature_grid()
    return Template(grid.vertices, grid.faces, here.on_grid[0], tuple(here.features))


def _registered(one: Member, template: Template, options: Options) -> tuple[Side, Registration]:
    """Return a map with its features, and its registration to a template."""
    here = one.side()
    return here, register(here.points, template, features=here.own, feature_weights=one.weights, **options)  # type: ignore[arg-type]


def _step(one: Member, template: Template, options: Options) -> dict[str, Floats]:
    """Register a map to a template; return its features there, and where that one's points are on its own sphere."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OmtwarpWarning)  # those of the last round are said
        here, registration = _registered(one, template, options)
    values, known = here.moved(registration.closed_sphere).on_grid
    # Where the points of the feature grid, on the template, are on the sphere of the map turned to it
    turned, faces = here.points.grid.points @ registration.start.rotation.T, here.points.grid.triangles
    places = Locator(registration.closed_sphere, faces, device="cpu").find(feature_grid().vertices)
    return {"values": known[:, None] * values, "known": known, "back": places.on_sphere(faces, turned)}


def _mean_template(total: Mapping[str, Floats], names: tuple[str, ...], max_strain: float) -> Template:
    """Return the mean features of registered maps, where the mean of the ways to the maps leads nowhere."""
    grid = feature_grid()
    mean = continued(total["values"] / np.maximum(total["known"], 1.0)[:, None], total["known"] > 0.0)
    # Where the ways lead on average, there the points go that they lead from.
    moved = kept_within(grid, normalised(total["back"]), max_strain)
    place = Locator(moved, grid.faces, device="cpu").find(grid.vertices)
    values = np.einsum("pk,pkc->pc", place.coordinates, mean[grid.faces[place.faces]])
    return Template(grid.vertices, grid.faces, values, names)


def _finish(one: Member, template: Template, options: Options, output: Path) -> dict[str, float]:
    """Register a map to the template and write it; return the facts."""
    registration = _registered(one, template, options)[1]
    registration.registered(MapResult.load(one.path)).save(output)
    return registration.facts()
