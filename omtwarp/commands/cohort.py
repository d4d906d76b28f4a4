"""``omtwarp cohort``: many meshes in, their maps, one table and one page out."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from omtwarp.commands._options import ROUTE, Argument, Only, Printing, Typed, output_option
from omtwarp.commands._streams import input_table, say, warnings_as_lines
from omtwarp.commands._work import show_facts
from omtwarp.errors import INTERRUPTED, OmtwarpError
from omtwarp.files.interruptions import LINE, raised
from omtwarp.options import FillArea, MapOptions

if TYPE_CHECKING:
    from omtwarp.options import Progress, Record


def parse_shard(text: str) -> tuple[int, int]:
    """Read the value of --shard, i/n.

    Raises:
        OmtwarpError: the text has another form.
    """
    match = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    part, parts = match.groups() if match else ("0", "0")
    if not 1 <= int(part) <= int(parts):
        raise OmtwarpError(f"unknown shard '{text}': give i/n with i from 1 to n, such as 2/8")
    return int(part), int(parts)


@dataclass(frozen=True)
class Running:
    """How items are computed: options of :func:`omtwarp.cohort.run_cohort`, by their names there.

    Options:
        executor (local|dask|dask:ADDRESS|slurm|submitit-local): Engine that runs the work: processes of this machine,
            or a cluster.
        workers (N): Number of items at the same time; one for each core by default.
        time_limit (SECONDS): Seconds after which an item counts as failed.
        memory_limit (GIB): GiB of memory that an item may allocate, on Linux; 0 for no limit.
        retry: Compute failed items again.
        collect: Compute nothing; write the table and the page, with the options of the last run.
        fill_area: Fill holes, on the sphere as large as they are or small; the filling is in the .npz only.
        register (TARGET|group): Register every map, to a map, template or fsaverage5-left or -right, or all to one of
            the group.
        repair: Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.
    """

    executor: str = "local"
    workers: Annotated[int | None, Typed(bounds=(1, None))] = None
    time_limit: float = 3600.0
    memory_limit: float = 0.0
    retry: bool = False
    collect: bool = False
    fill_area: FillArea | None = None
    register: str | None = None
    repair: bool = False


def run_cohort(
    *,
    manifest: Annotated[str, Argument()],
    output: Annotated[Path, output_option()],
    shard: str = "1/1",
    running: Running,
    mapping: Annotated[MapOptions, Only((*ROUTE, "optimality"))],
    printing: Printing,
) -> None:
    """Map many surfaces: one process each, with limits; failures are rows of the table; a rerun continues.

    DIR gets maps/ID.npz, records/ID.json, table.parquet (table.csv without pyarrow) and report.html, and with
    --register group the template and registered maps in registered/.

    Examples:
        omtwarp cohort 'sub-*/surf/lh.white' -o out --time-limit 600 --memory-limit 4
        omtwarp cohort meshes.csv -o out --shard 2/8

    Options:
        manifest (MANIFEST): A table with a column 'path' (- is standard input), a folder, or a pattern in quotes.
        output (DIR): Folder of the results.
        shard (I/N): Compute every N-th item only, beginning with the I-th.
    """
    from omtwarp.cohort import read_manifest, run_cohort

    part = parse_shard(shard)
    with warnings_as_lines():
        items = read_manifest(input_table(manifest))
    with _ended_when_interrupted(), _reporting(printing.quiet, printing.verbose) as progress:
        result = run_cohort(items, output, shard=part, progress=progress, **vars(running), **vars(mapping))
    counts = ", ".join(f"{count} {status}" for status, count in sorted(result.counts.items()))
    line = f"{result.table}: {counts}; {result.computed} computed in this run; {result.page}"
    show_facts(vars(result) | {"table": str(result.table), "page": str(result.page)}, line, printing)


@contextmanager
def _ended_when_interrupted() -> Iterator[None]:
    """Let an interruption end the items at work, and say what is done.

    Other commands end at once, see :mod:`omtwarp.files.interruptions`: they are in native code, which this one
    waits for in other processes.
    """
    try:
        with raised():
            yield
    except KeyboardInterrupt as stopped:
        print(f"{LINE}: {stopped or 'run again to continue'}", file=sys.stderr)
        sys.exit(INTERRUPTED)


@contextmanager
def _reporting(quiet: bool, verbose: bool = False) -> Iterator[Progress | None]:
    """Show the progress of a cohort and the time left: a bar on a terminal, otherwise a line at intervals."""
    if quiet:
        yield None
        return
    if sys.stderr.isatty() and not verbose:
        from rich import progress as shown
        from rich.console import Console

        columns = [shown.BarColumn(30), shown.MofNCompleteColumn(), shown.TextColumn("{task.fields[failed]} failed")]
        columns += [shown.TimeElapsedColumn(), shown.TextColumn("left"), shown.TimeRemainingColumn()]
        with shown.Progress(*columns, console=Console(stderr=True)) as bars:
            task = bars.add_task("cohort", total=None, failed=0)

            def draw(stage: str, done: int, total: int, info: Record) -> None:
                bars.update(task, completed=done, total=total, failed=info["failed"])

            yield draw
        return
    begun = last = time.monotonic()
    first: dict[str, tuple[int, float]] = {}  # of each stage, what was done before, and when it began

    def report(stage: str, done: int, total: int, info: Record) -> None:
        nonlocal last
        now = time.monotonic()
        before, begun_at = first.setdefault(stage, (done - 1, begun if not first else last))
        # Lines every: seconds between lines on how far a cohort is, where there is no terminal
        if verbose or now - last >= 30.0 or done == total:
            last = now
            left = (now - begun_at) / (done - before) * (total - done)
            what = "steps of registration" if stage == "register" else "done"
            say(f"{done} of {total} {what}, {info['failed']} failed, about {left:.0f} s left")

    yield report
