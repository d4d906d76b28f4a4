"""Standard input and output in place of files: ``-`` reads or writes a stream.

Standard input is stored in a temporary file named after the format recognised by its first bytes. Standard output is
written when the command has succeeded; messages of the command and its progress go to standard error.
"""

import contextlib
import gzip
import io
import logging
import os
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import TextIO, cast

from omtwarp.errors import OmtwarpError, OmtwarpWarning, one_line, with_options
from omtwarp.files.limits import LARGEST_MESH_FILE, amount
from omtwarp.files.output import scratch
from omtwarp.options import Progress, Record, tell

STREAM = Path("-")
_HEADS = (
    (b"PK", ".npz"), (b"glTF", ".glb"), (b"ply", ".ply"), (b"OFF", ".off"), (b"COFF", ".off"), (b"solid", ".stl"),
    (b"<?xml", ".gii"), (b"\x1f\x8b", ".gii.gz"), (b"\x89PNG", ".png"), (b"\xff\xd8\xff", ".jpg"),
    (b"\xff\xff\xfe", ""), (b"{", ".gltf"), (b"# vtk", ".vtk"), (b"\x93NUMPY", ".npy"), (b"\xff\xff\xff", ".curv"),
)  # fmt: skip


class _Streams:
    """The temporary files of one run of the command line, and the names that replace theirs in messages."""

    def __init__(self, folder: Callable[[], Path]):
        self.folder = folder
        self.names: dict[str, str] = {}
        self.output: Path | None = None
        self.taken = False

    def shown(self, text: str) -> str:
        """Replace the names of temporary files in a text by those of the streams."""
        for name, words in self.names.items():
            text = text.replace(name, words)
        return text


class _Shown:
    """A stream of text that names no temporary file, and fails in a line, or not at all where it need not be read."""

    def __init__(self, stream: TextIO, streams: _Streams, *, needed: bool):
        self._stream, self._streams, self._needed = stream, streams, needed
        self._failed = False

    def write(self, text: str) -> int:
        return self.tried(lambda: self._stream.write(self._streams.shown(text))) or 0

    def flush(self) -> None:
        self.tried(self._stream.flush)

    def send(self, data: bytes) -> None:
        """Write bytes after the text."""
        self.flush()
        if data:  # a stream of text alone has no buffer
            self.tried(lambda: self._stream.buffer.write(data))
            self.tried(self._stream.buffer.flush)

    def tried(self, write: Callable[[], int | None]) -> int | None:
        """Write, and note where that fails.

        Raises:
            OmtwarpError: it cannot be written, and is needed.
            BrokenPipeError: it is needed, and its reader has ended.
        """
        try:
            return write()
        except OSError as error:
            self._failed = True
            if not self._needed:
                return None
            if isinstance(error, BrokenPipeError):
                raise
            raise OmtwarpError(f"cannot write to standard output: {error.strerror or error}") from None

    def end(self) -> None:
        """Lead a stream that could not be written nowhere, so that the end of the process does not try it again."""
        if self._failed:
            with contextlib.suppress(OSError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


_current: _Streams | None = None


@contextlib.contextmanager
def standard_streams() -> Iterator[None]:
    """Make ``-`` mean standard input and output while a command runs; send the output at its end."""
    global _current
    with contextlib.ExitStack() as stack:
        before, _current = _current, _Streams(cache(lambda: stack.enter_context(scratch())))
        streams = _current
        shown, messages = _Shown(sys.stdout, streams, needed=True), _Shown(sys.stderr, streams, needed=False)
        stack.enter_context(contextlib.redirect_stdout(cast(TextIO, shown)))
        stack.enter_context(contextlib.redirect_stderr(cast(TextIO, messages)))
        try:
            yield
        except SystemExit as end:
            if end.code not in (None, 0):
                with contextlib.suppress(OmtwarpError):  # what failed first has been said
                    shown.flush()
                raise
            file = streams.output
            try:
                shown.send(file.read_bytes() if file is not None and file.exists() else b"")
            except OmtwarpError as error:
                say(f"error: {error}")
                sys.exit(1)
            raise
        finally:
            _current = before
            shown.end()
            messages.end()


def input_file(given: object) -> object:
    """Replace ``-`` by a file that holds standard input, and leave other paths; a list is replaced path by path.

    A text stays a text: an argument that may also be a name of something.

    Raises:
        OmtwarpError: standard input is empty, too large, or asked for twice.
    """
    from omtwarp.files.inputs import read_up_to

    if isinstance(given, list | tuple):
        return [input_file(path) for path in given]
    if isinstance(given, str):
        return str(input_file(STREAM)) if given == str(STREAM) else given
    if given != STREAM or _current is None:
        return given
    if _current.taken:
        raise OmtwarpError("'-' is given for two inputs: standard input can be only one")
    if sys.stdin is None or sys.stdin.isatty():
        raise OmtwarpError("standard input is a terminal: pipe a file into it, or name one")
    data = read_up_to(sys.stdin.buffer.read, LARGEST_MESH_FILE)
    _current.taken = True
    if not data:
        raise OmtwarpError("standard input is empty")
    if len(data) > LARGEST_MESH_FILE:
        raise OmtwarpError(f"standard input has more than the {amount(LARGEST_MESH_FILE)} that a file may have")
    file = _current.folder() / f"standard-input{_suffix_of(data)}"
    file.write_bytes(data)
    _current.names[str(file)] = "standard input"
    return file


def _suffix_of(data: bytes) -> str:
    """Return the suffix of the format that the first bytes of a file tell, also inside of gzip."""
    if data.startswith(b"\x1f\x8b"):
        with contextlib.suppress(OSError, EOFError, zlib.error), gzip.open(io.BytesIO(data)) as stream:
            return f"{_suffix_of(stream.read(1024))}.gz"
    if b"<VTKFile" in data[:1024]:
        return ".vtu" if b"UnstructuredGrid" in data[:1024] else ".vtp"
    suffix = next((suffix for head, suffix in _HEADS if data.startswith(head)), None)
    if suffix is None:
        binary_stl = len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
        suffix = ".stl" if binary_stl else ".obj"
    return suffix


def input_table(given: str) -> str | io.StringIO:
    """Replace ``-`` by the text of standard input, and leave the names of tables' files.

    Raises:
        OmtwarpError: standard input is empty, or is no text.
    """
    if given != str(STREAM):
        return given
    try:
        return io.StringIO(cast(Path, input_file(STREAM)).read_text("utf-8-sig"))
    except UnicodeDecodeError:
        raise OmtwarpError("standard input is no text: a table is expected (.csv, .tsv)") from None


def output_file(suffix: str) -> Callable[[object], object]:
    """Make a callback for output paths that replaces ``-`` by a file whose content is sent to standard output."""

    def chosen(given: object) -> object:
        if given != STREAM or _current is None:
            return given
        if getattr(sys.stdout, "name", "") == os.devnull:  # opened in place of one that is closed
            raise OmtwarpError("standard output is closed: name a file with -o")
        if sys.stdout.isatty():
            raise OmtwarpError("standard output is a terminal: pipe it into a program or file, or name a file with -o")
        _current.output = _current.folder() / f"standard-output{suffix}"
        _current.names[str(_current.output)] = "standard output"
        sys.stdout = sys.stderr
        return _current.output

    return chosen


def is_standard_output(path: Path) -> bool:
    """Return whether a path is the file that is sent to standard output."""
    return _current is not None and path == _current.output


def say(text: str) -> None:
    """Print one line about the work on standard error, apart from the output of a command."""
    print(f"omtwarp: {one_line(with_options(text))}", file=sys.stderr, flush=True)


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Print the package's warnings as a line each at the end of a block, and nothing that other libraries warn of."""
    level = logging.root.manager.disable
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", OmtwarpWarning)
        logging.disable()
        try:
            yield
        finally:
            logging.disable(level)
            for text in dict.fromkeys(str(each.message) for each in caught):
                say(f"warning: {text}")


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
            tell(progress, step, 1, 1, {})

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
    from rich.progress import BarColumn, Progress as Bars, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
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
            shown = {name: info[name] for name in ("cost", "flips", "area", "angle", "gap") if name in info}
            words = " ".join(f"{k} {v:.5g}" if isinstance(v, float) else f"{k} {v}" for k, v in shown.items())
            bars.update(tasks[stage], completed=done, total=total or None, words=words)

        yield report
