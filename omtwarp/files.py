"""Outputs that appear whole or not at all, and are known to be writable before the work starts.

Every file that the package writes for a user goes through :func:`staged`.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omtwarp.errors import OmtwarpError

PREFIX = ".omtwarp-"  # of the directories that files are written in before they are moved


def check_output(path: Path, suffixes: tuple[str, ...], *inputs: Path | None) -> Path:
    """Make sure that an output can be written, by trying, before anything long is computed.

    Args:
        path: the file to be.
        suffixes: what it may end in, with the dot, in small letters; anything if empty.
        inputs: files that it must not be.

    Returns:
        The path with links followed, so that replacing the file keeps the link.

    Raises:
        OmtwarpError: an unknown suffix, no directory, no right to write, or an input as the output.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise OmtwarpError(f"cannot write '{path}': unknown suffix '{path.suffix}', use {', '.join(suffixes)}")
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise OmtwarpError(f"cannot write '{path}': it is a directory")
    if target.exists() and not target.is_file():
        raise OmtwarpError(f"cannot write '{path}': it is not a regular file")
    if any(given is not None and target.exists() and given.exists() and target.samefile(given) for given in inputs):
        raise OmtwarpError(f"cannot write '{path}': it is the input; choose another name")
    if not target.parent.is_dir():
        raise OmtwarpError(f"cannot write '{path}': there is no directory '{path.parent}'")
    try:
        if target.exists() and not os.access(target, os.W_OK):
            raise PermissionError(13, "Permission denied")
        os.rmdir(tempfile.mkdtemp(prefix=PREFIX, dir=target.parent))
    except OSError as error:
        raise OmtwarpError(f"cannot write '{path}': {error.strerror or error}") from None
    return target


@contextlib.contextmanager
def staged(target: Path) -> Iterator[Path]:
    """Give a path of the same name in a new directory beside the target; at the end, move all that was written there.

    Whatever is written beside the file under that path (materials, textures) moves with it. After an error or an
    interruption nothing is left, neither parts nor the directory, and an older file is as it was. May be nested.

    Raises:
        OmtwarpError: there is no such directory, the disk is full, or the files cannot be moved.
    """
    folder: Path | None = None
    try:
        folder = Path(tempfile.mkdtemp(prefix=PREFIX, dir=target.parent))
        with _tidy_when_interrupted(folder):
            yield folder / target.name
            # Companions first, so that the file that refers to them is never there without them.
            for file in sorted(folder.iterdir(), key=lambda file: file.name == target.name):
                os.replace(file, target.parent / file.name)
    except BrokenPipeError:  # of standard output, not of a file
        raise
    except OSError as error:
        raise OmtwarpError(f"cannot write '{target}': {error.strerror or error}") from error
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _die_by(number: int) -> None:
    """End as the signal would have ended the process, so that a shell's loop stops too."""
    if os.name == "posix":
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
    os._exit(128 + number)


@contextlib.contextmanager
def _tidy_when_interrupted(folder: Path) -> Iterator[None]:
    """While there is something to tidy up, an interruption tidies first.

    Outside of this, an interruption ends the process at once, also in the middle of a long computation in native code
    (see :func:`omtwarp.cli.main`). Here Python's own handler has to run, which waits for native code to return; a
    thread that the signal wakes does the tidying if that takes too long.
    """
    ours = threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_DFL
    if not ours:
        yield  # somebody else (a test, a notebook) handles interruptions: they raise, and the caller tidies up
        return

    def tidy(number: int, frame: Any = None) -> None:
        shutil.rmtree(folder, ignore_errors=True)
        _die_by(number)

    def watch() -> None:
        received = os.read(readable, 1)
        if received and received[0]:
            time.sleep(0.4)
            shutil.rmtree(folder, ignore_errors=True)
            os._exit(128 + received[0])

    readable, writable = os.pipe()
    os.set_blocking(writable, False)
    previous = {number: signal.signal(number, tidy) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.set_wakeup_fd(writable, warn_on_full_buffer=False)
    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(-1)
        for number, handler in previous.items():
            signal.signal(number, handler)
        os.write(writable, b"\0")  # lets the thread end
        watcher.join()
        os.close(readable)
        os.close(writable)
