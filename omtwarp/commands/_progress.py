"""Progress on a terminal: the stage, the share of it that is done, its cost and its flips."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator

from omtwarp.commands._streams import say
from omtwarp.options import Progress, Record


@contextlib.contextmanager
def progress_bar(quiet: bool = False, verbose: bool = False) -> Iterator[Progress | None]:
    """Show progress on standard error; the callback is None where nobody would read it.

    Args:
        quiet: whether to draw no bar.
        verbose: whether to say at the end how long every stage took.
    """
    with _bars(quiet) as draw:
        if not verbose:
            yield draw
            return
        last = time.perf_counter()
        taken: dict[str, float] = {}

        def report(stage: str, done: int, total: int, info: Record) -> None:
            nonlocal last
            now = time.perf_counter()
            taken[stage] = taken.get(stage, 0.0) + now - last
            last = now
            if draw is not None:
                draw(stage, done, total, info)

        yield report
    for stage, seconds in taken.items():
        say(f"{stage}: {seconds:.2f} s")


@contextlib.contextmanager
def step_times(verbose: bool) -> Iterator[Callable[[str], None]]:
    """Time the steps of a command too short for a bar, and say at the end how long each took where that is asked for.

    Args:
        verbose: whether to say it.

    Yields:
        A function to be called with the name of a step when it is done.
    """
    with progress_bar(quiet=True, verbose=verbose) as progress:

        def done(step: str) -> None:
            if progress is not None:
                progress(step, 1, 1, {})

        yield done


@contextlib.contextmanager
def _bars(quiet: bool) -> Iterator[Progress | None]:
    """Draw bars on standard error, where that is a terminal."""
    # characters of a bar; on a terminal of 80 columns the narrow one leaves room for the figures
    bar, narrow_bar = 30, 8
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars
    from rich.table import Column

    class CalmConsole(Console):
        def show_cursor(self, show: bool = True) -> bool:
            return False  # a process that is interrupted must not leave the terminal without a cursor

    console = CalmConsole(stderr=True)
    # Wide: columns of a terminal from which on the wide bar fits beside all figures
    width = bar if console.width >= 104 else narrow_bar
    columns = (
        TextColumn("{task.description}", table_column=Column(min_width=10, no_wrap=True)),
        BarColumn(width, table_column=Column(min_width=width)),
        TaskProgressColumn(show_speed=False, table_column=Column(min_width=4)),
        TimeElapsedColumn(table_column=Column(min_width=7)),
        TextColumn("{task.fields[words]}", table_column=Column(no_wrap=True)),
    )
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int, info: Record) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total or None, words="")
            words = " ".join(
                _word(name, info[name]) for name in ("cost", "flips", "area", "angle", "gap") if name in info
            )
            bars.update(tasks[stage], completed=done, total=total or None, words=words)

        yield report


def steps(progress: Progress | None, stage: str, total: int) -> Callable[[int], None]:
    """Make a function that shows how many of a command's steps are done, if progress is shown at all."""

    def notify(done: int) -> None:
        if progress is not None:
            progress(stage, done, total, {})

    return notify


def _word(name: str, value: object) -> str:
    return f"{name} {value:.5g}" if isinstance(value, float) else f"{name} {value}"
