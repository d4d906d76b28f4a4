"""Run a cohort: compute the items without a record, and write one table and one page."""

from __future__ import annotations

import contextlib
import json
import os
from collections import Counter
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Unpack

from omtwarp.cohort.executors import executor_for, make_folders
from omtwarp.cohort.item import OK, Job, Row, complete_journal, forget_failure, key_of, may_write_map, read_record
from omtwarp.cohort.tables import GROUP, ORDER, REGISTERED, REGISTERED_MAPS, Item, write_table
from omtwarp.device import core_count
from omtwarp.errors import OmtwarpError, choose
from omtwarp.files.output import digest_of, folder_of_results, locked, require_own, write_text
from omtwarp.mesh.arrays import listed, real_number, whole_number, whole_numbers
from omtwarp.options import AreaMatch, FillArea, MapKeywords, MapOptions, Progress, Record, takes_map_options, tell

RESULTS = ("table.parquet", "table.csv", "report.html")


@dataclass(frozen=True)
class CohortResult:
    """The outcome of a cohort.

    Attributes:
        counts: items by status: ``ok``, ``error``, ``timeout``, ``memory``, ``crashed``, and ``waiting`` for items of
            other shards that have no record yet.
        computed: how many items were worked on in this run; the others were done before.
        table: the table of all items, ``.parquet`` where pyarrow is installed, else ``.csv``.
        page: the report page.
    """

    counts: dict[str, int]
    computed: int
    table: Path
    page: Path


@takes_map_options
def run_cohort(
    items: Sequence[Item],
    folder: str | os.PathLike[str],
    *,
    executor: str = "local",
    workers: int | None = None,
    shard: tuple[int, int] = (1, 1),
    time_limit: float = 3600.0,
    memory_limit: float = 0.0,
    retry: bool = False,
    collect: bool = False,
    progress: Progress | None = None,
    repair: bool = False,
    fill_area: str | None = None,
    register: str | None = None,
    **options: Unpack[MapKeywords],
) -> CohortResult:
    """Map many surfaces, each in a process of its own; a surface that fails becomes a row of the table.

    The run may be ended in any way and started again: items that have a record for the same input, options and version
    are not worked on twice, unless their map is gone, cut short or changed.

    Args:
        items: the surfaces, see :func:`omtwarp.cohort.read_manifest`.
        folder: of the results: ``maps/ID.npz``, ``records/ID.json``, ``journal.jsonl``, the table and ``report.html``.
        executor: ``local``, ``dask``, ``dask:ADDRESS``, ``slurm`` or ``submitit-local``.
        workers: items at once; one for each core by default.
        shard: (i, n) works on every n-th item, the i-th first, counting from 1.
        time_limit: seconds that an item may take; the largest surfaces of the field, 330,000 faces, take 60 to 120.
        memory_limit: GiB that it may allocate (on Linux); 0 for no limit.
        retry: work again on items that failed.
        collect: only write the table and the page of what is there, with the options of the last run in the folder.
        progress: called as ``progress("cohort", done, total, {"failed": ...})``.
        repair: repair meshes first, as ``omtwarp map --repair`` does.
        fill_area: fill holes of surfaces, on the sphere with their own area (``natural``) or a ``small`` one, see
            :func:`omtwarp.map_surface`; without it surfaces with holes are failures.
        register: what every map is registered to after it is made (:func:`omtwarp.register`): the name of a template,
            or a file; or ``group``: when all maps are there they are registered, in this process, to a template made
            from them (:func:`omtwarp.registration.register_group`), in the folder ``registered``. The table has the
            facts of the registrations.
        options: those of :class:`omtwarp.options.MapOptions`.

    Raises:
        OmtwarpError: an unknown option or executor, a folder that cannot be written to, a file at the place of a map,
            the table or the page that no cohort wrote, or options to ``collect`` with that the run did not have.
        KeyboardInterrupt: the run was interrupted; its text says how many items have a record.

    Example:
        >>> import tempfile, omtwarp
        >>> from omtwarp.cohort import read_manifest, run_cohort
        >>> from omtwarp.mesh.write import write_mesh
        >>> folder = tempfile.mkdtemp()
        >>> for k in range(2):
        ...     surface = omtwarp.shapes.blob(k, sphere=320)
        ...     write_mesh(f"{folder}/shape{k}.ply", surface.vertices, surface.faces)
        >>> run_cohort(read_manifest(f"{folder}/*.ply"), folder + "/out", workers=1, until="moser").counts
        {'ok': 2}
    """
    items = listed(items, "items", "omtwarp.cohort.Item", Item)
    workers = core_count() if workers is None else whole_number(workers, "workers", least=1)
    part, parts = whole_numbers(shard, "shard", (2,)).tolist()
    time_limit, memory_limit = real_number(time_limit, "time_limit"), real_number(memory_limit, "memory_limit")
    _require_possible(items, part, parts, time_limit, memory_limit)
    if register == GROUP and any(item.id == "template" for item in items):
        raise OmtwarpError("an item is called 'template', as a result of register='group' is: give it another id")
    asked, on = _options_of_jobs(options, repair, fill_area, register)
    from omtwarp.cohort.page import write_page  # loads Warp, which fails before the work where it cannot start

    target = Path(folder).absolute()
    with _results_in(target):  # refused before the work, not after it
        make_folders(target)
    run, run_file = on | {"group": register == GROUP}, target / "locks" / ".options.json"
    on = _of_last_run(run_file, run) if collect else dict(run)
    in_group = on.pop("group")
    limits = time_limit, int(memory_limit * 2**30)
    jobs = [Job(one.id, str(one.path.absolute()), str(target), key_of(one.path, on), asked, *limits) for one in items]
    _require_other_inputs(jobs, target)
    mine = [] if collect else jobs[part - 1 :: parts]
    todo = [job for job in mine if (record := read_record(job)) is None or (retry and record["status"] != OK)]
    for job in todo:
        require_own(job.map_file, may_write_map(job))
    if todo:
        words = f"another process is working on '{target}': wait for it, or use shard=(i, n)"
        with locked(target / "locks" / f".driver-{part}-{parts}", words):
            write_text(run_file, json.dumps(run))  # not before: the options of a run that is refused are no one's
            for job in todo if retry else ():
                forget_failure(job)
            records = executor_for(str(executor), target, workers).records(todo)
            _follow(records, len(mine) - len(todo), len(mine), progress)
    elif not collect:
        write_text(run_file, json.dumps(run))
    complete_journal(jobs, target)
    rows = [_row(item, read_record(job)) for item, job in zip(items, jobs, strict=True)]
    if in_group:
        _register_all(rows, target, progress, collect)
    with _results_in(target):
        table, page = write_table(rows, target), write_page(rows, target)
    return CohortResult(dict(Counter(str(row["status"]) for row in rows)), len(todo), table, page)


@contextlib.contextmanager
def _results_in(folder: Path) -> Generator[None, None, None]:
    """Replace a cohort's table and page as its results; other shards, which end in the meantime, wait for it.

    What one has moved to its place and not recorded yet would be a stranger's file to another.
    """
    place = folder / "locks" / ".results"
    with locked(place) if place.parent.is_dir() else contextlib.nullcontext(), folder_of_results(folder, *RESULTS):
        yield


def _row(item: Item, record: Row | None) -> Row:
    """Return an item's row of the table, with its path as it was given."""
    own: Row = {"id": item.id, "path": str(item.path)}
    return own | item.fields | (record or {"status": "waiting", "message": ""}) | own


def _options_of_jobs(
    options: MapKeywords, repair: bool, fill_area: str | None, register: str | None
) -> tuple[dict[str, object], dict[str, object]]:
    """Return the options of a job, and what its result depends on: these, and the content of a target's file.

    Raises:
        OmtwarpError: an unknown option, or a target without folds to register to.
    """
    chosen = vars(MapOptions.parse(**options))
    asked = {name: str(value) if isinstance(value, str | AreaMatch) else value for name, value in chosen.items()}
    asked["repair"] = repair
    if fill_area is not None:
        asked["fill_area"] = str(choose(FillArea, fill_area))
    if register is None or register == GROUP:
        return asked, asked
    from omtwarp.registration.sides import target_points

    points, features = target_points(register)
    if points.vertices is None and features is None:
        raise OmtwarpError(f"'{register}' is a sphere without its surface, and so has no folds to register to")
    file = Path(register)
    asked["register"] = str(file.absolute()) if file.is_file() else register
    return asked, asked | ({"target": digest_of(file)} if file.is_file() else {})


def _of_last_run(file: Path, given: dict[str, object]) -> dict[str, object]:
    """Return the options of the last run in a folder, for what is collected; those given where none are recorded.

    Raises:
        OmtwarpError: one that is given has neither the value that it had there nor the one that it has by default.
    """
    try:
        known: dict[str, object] = {"group": False} | json.loads(file.read_text("utf-8"))
    except (OSError, ValueError, TypeError):
        return given
    usual = _options_of_jobs({}, False, None, None)[1] | {"group": False}
    if other := [name for name, value in given.items() if value not in (usual.get(name), known.get(name))]:
        names = ", ".join("register" if name in ("group", "target") else name for name in other)
        raise OmtwarpError(f"the results in '{file.parents[1]}' are not of this {names}: leave options out to collect")
    return known


def _require_possible(items: list[Item], part: int, parts: int, time_limit: float, memory_limit: float) -> None:
    """Refuse a run that asks for what cannot be.

    Raises:
        OmtwarpError: a shard or a limit out of bounds, or a column that the table has itself.
    """
    longest = 1e8  # seconds of a time limit: three years, and less than timers of the system take
    largest_limit = 1e6  # GiB of a memory limit, in bytes less than 2^63
    if not 1 <= part <= parts:
        raise OmtwarpError(f"shard {part}/{parts}: give i/n with i from 1 to n")
    if not (0.0 < time_limit <= longest and 0.0 <= memory_limit <= largest_limit):
        raise OmtwarpError(
            f"the time limit must be above 0 and at most {longest:.0e} seconds, the memory limit from 0 to "
            f"{largest_limit:.0e} GiB"
        )
    taken = next((name for item in items for name in item.fields if name in (*ORDER, *REGISTERED)), None)
    if taken is not None:
        raise OmtwarpError(f"the table of results has a column '{taken}' of its own: rename that of the list of items")


def _require_other_inputs(jobs: Sequence[Job], folder: Path) -> None:
    """Refuse items whose mesh is a file that the run writes.

    Raises:
        OmtwarpError: an item is a map, a record, the table or the page of this cohort.
    """
    written = {os.path.realpath(folder / name) for name in RESULTS}
    written.update(os.path.realpath(file) for job in jobs for file in (job.map_file, job.record_file))
    for job in jobs:
        if os.path.realpath(job.path) in written:
            raise OmtwarpError(f"'{job.path}' is an item and would be replaced as a result: choose another folder")


def _follow(records: Generator[Row, None, None], done: int, total: int, progress: Progress | None) -> None:
    """Wait for the records of running items, and report progress after each.

    Raises:
        KeyboardInterrupt: with how many items are done.
    """
    failed = 0
    try:
        with contextlib.closing(records):
            for record in records:
                done += 1
                failed += record["status"] != OK
                tell(progress, "cohort", done, total, {"failed": failed})
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{done} of {total} items done; run again to continue") from None


def _register_all(rows: list[Row], folder: Path, progress: Progress | None, collect: bool) -> None:
    """Register all maps to a template made from them, unless some are not made yet, and add the facts to their rows.

    Only what is there is read where the run is to ``collect``.
    """
    from omtwarp.registration.group import finished_group, register_group

    done = [row for row in rows if row["status"] == OK]
    if len(done) < 2 or any(row["status"] == "waiting" for row in rows):
        return

    def notify(stage: str, step: int, steps: int, info: Record) -> None:
        tell(progress, "register", step, steps, {"failed": len(rows) - len(done)})

    maps, place = [folder / "maps" / f"{row['id']}.npz" for row in done], folder / REGISTERED_MAPS
    with contextlib.nullcontext() if collect else locked(folder / "locks" / ".registered"):
        group = finished_group(maps, place) if collect else register_group(maps, place, progress=notify)
    if group is not None:
        for row in done:
            row |= {"registered_to": GROUP, **group.table[str(row["id"])]}
