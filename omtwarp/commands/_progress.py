"""Progress on a terminal: the stage, how far it is, the cost and the flips."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from omtwarp.options import Progress, Record


@contextlib.contextmanager
def progress_bar(quiet: bool = False) -> Iterator[Progress | None]:
    """Show progress on standard error; the callback is None where that is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    class CalmConsole(Console):
        def show_cursor(self, show: bool = True) -> bool:
            return False  # a process that is interrupted must not leave the terminal without a cursor

    name, words = TextColumn("{task.description:<12}"), TextColumn("{task.fields[words]}")
    columns = (name, BarColumn(30), TaskProgressColumn(show_speed=False), words, TimeElapsedColumn())
    with Bars(*columns, console=CalmConsole(stderr=True)) as bars:
        tasks: dict[str, TaskID] = {}

        def report(stage: str, done: int, total: int, info: Record) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total or None, words="")
            words = "  ".join(
                _word(name, info[name]) for name in ("cost", "flips", "area", "angle", "gap") if name in info
            )
            bars.update(tasks[stage], completed=done, total=total or None, words=words)

        yield report


def steps(progress: Progress | None, stage: str, total: int) -> Callable[[int], None]:
    """Return a function that shows how many of a command's steps are done, if progress is shown at all."""

    def notify(done: int) -> None:
        if progress is not None:
            progress(stage, done, total, {})

    return notify


def _word(name: str, value: object) -> str:
    return f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}"
