"""Interruptions of the command line, and interpreters beside this one.

An interruption gives one line on standard error, leaves nothing that was staged, and ends the process.

Python's own handler waits until native code returns, which in a factorisation or a long kernel takes more than a
second. While it waits a thread, woken by the signal, ends the process. Code that never lets go of the interpreter's
lock is not interrupted before it returns; none that the package calls holds it for long.
"""

import contextlib
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

from omtwarp.errors import INTERRUPTED

LINE = "omtwarp: interrupted"

Handler = Callable[[int, FrameType | None], object] | int | signal.Handlers | None

_staged: set[Path] = set()  # directories to remove before the process ends
_ending = threading.Lock()  # held by whoever ends the process
_writable = -1  # where the system writes the number of every signal; -1 unless interruptions end the process


@contextlib.contextmanager
def ending_the_process(*, restore: bool, instead_of: Handler = signal.default_int_handler) -> Iterator[None]:
    """Let an interruption end the process at once in a block, with a line, as it ends programs that do not handle it.

    Nothing is changed outside of the main thread, or where another handler than the one given is installed.

    Args:
        restore: put Python's handler back afterwards. Without it, an interruption after the block ends the process
            without a line: it would be an exception in whatever runs while the process ends.
        instead_of: the handler that is replaced: Python's own.
    """
    global _writable
    if not _answered_by(instead_of):
        yield
        return
    watcher, readable = None, -1
    if os.name == "posix":  # elsewhere the handler alone, after native code has returned
        readable, _writable = os.pipe()
        os.set_blocking(_writable, False)
        watcher = threading.Thread(target=_watch, args=(readable,), daemon=True)
        watcher.start()
    _handle()
    try:
        yield
    finally:
        _let_go(signal.default_int_handler if restore else signal.SIG_DFL)
        if watcher is not None:
            os.write(_writable, b"\0")  # lets the thread end
            watcher.join()
            os.close(readable)
            os.close(_writable)
            _writable = -1


@contextlib.contextmanager
def raised() -> Iterator[None]:
    """Let an interruption raise KeyboardInterrupt in a block, where it would end the process."""
    if not _answered_by(_end):
        yield
        return
    _let_go(signal.default_int_handler)
    try:
        yield
    finally:
        _handle()


@contextlib.contextmanager
def removed_at_the_end(folder: Path) -> Iterator[None]:
    """Let an interruption that ends the process in a block, or a request to terminate, remove a directory before."""
    _staged.add(folder)
    ends = _answered_by(_end) or _answered_by(signal.SIG_IGN)  # ignored in jobs in the background
    previous = signal.signal(signal.SIGTERM, _end) if ends else None
    try:
        yield
    finally:
        if ends:
            signal.signal(signal.SIGTERM, previous)
        _staged.discard(folder)


def _answered_by(handler: Handler) -> bool:
    """Return whether this is the main thread, and an interruption of it calls a handler."""
    return threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is handler


def _handle() -> None:
    signal.signal(signal.SIGINT, _end)
    if _writable >= 0:
        signal.set_wakeup_fd(_writable, warn_on_full_buffer=False)


def _let_go(handler: Handler) -> None:
    if _writable >= 0:
        signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGINT, handler)


def _tidy(number: int) -> bool:
    """Remove what is staged, and say why the process ends; return False if another thread is doing so."""
    standard_error = 2  # its descriptor
    if not _ending.acquire(blocking=False):
        return False
    for folder in list(_staged):
        shutil.rmtree(folder, ignore_errors=True)
    if number == signal.SIGINT:
        with contextlib.suppress(OSError):
            # Not through sys.stderr, which the interrupted code may have locked. A terminal shows ^C, or a bar, before.
            os.write(standard_error, (("\n" if os.isatty(standard_error) else "") + LINE + "\n").encode())
    return True


def _end(number: int, frame: FrameType | None = None) -> None:
    """End as the signal would have ended the process, so that a shell's loop stops too."""
    if not _tidy(number):
        return  # the other thread ends the process
    if os.name == "posix":
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(INTERRUPTED - signal.SIGINT + number)


def _watch(readable: int) -> None:
    # That Python's own handler has to end the process, before a thread does; felt as at once.
    seconds_for_handler = 0.4
    while received := os.read(readable, 1):
        number = received[0]
        if number == 0:
            return
        if signal.getsignal(number) is _end:
            time.sleep(seconds_for_handler)
            if _tidy(number):
                os._exit(INTERRUPTED - signal.SIGINT + number)


_ROOT = str(Path(__file__).resolve().parents[2])
_FIND_PACKAGE = "import sys; sys.path.insert(0, sys.argv.pop(1)); "


def interpreter(code: str, *arguments: str) -> list[str]:
    """Return the command line of an interpreter that runs some code with this very package.

    With ``-P`` the working directory is no place for modules: a ``signal.py`` there is data, as every file of a user's.

    Args:
        code: what it runs, on one line.
        arguments: what it finds in ``sys.argv[1:]``.
    """
    return [sys.executable, "-P", "-c", _FIND_PACKAGE + code, _ROOT, *arguments]


@contextlib.contextmanager
def safe_paths() -> Iterator[None]:
    """Let interpreters that libraries start inside of it import nothing from the working directory either."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("PYTHONSAFEPATH", None)
        else:
            os.environ["PYTHONSAFEPATH"] = before
