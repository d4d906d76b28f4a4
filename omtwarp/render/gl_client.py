"""The caller's side of the drawing process: early start, requests for pictures, recovery from crashes."""

from __future__ import annotations

import atexit
import importlib.util
import os
import subprocess
import sys
import tempfile
import threading
from typing import IO, TYPE_CHECKING, cast

from omtwarp.children import interpreter
from omtwarp.render.drawing_process import receive, send
from omtwarp.render.installing import INSTALL_GL, INSTALL_PYRENDER

if TYPE_CHECKING:  # commands start the drawing process before they import NumPy
    import numpy as np
    from numpy.typing import NDArray

    from omtwarp.render.scene import RenderJob

# Long enough for a software driver on a busy machine: one that has not answered by then hangs.
START_SECONDS = 120.0
PICTURE_SECONDS = 180.0
IDLE_SECONDS = 60.0  # after which the drawing process ends, and frees its memory

_COMMAND = "from omtwarp.render.drawing_process import main; main()"

LAST_BYTES = 2000  # of the drawing process's log, in which its last line is looked for


class DrawingFailed(Exception):
    """The drawing process gave no picture; the text says why. ``lasting``: the next attempt would fail too."""

    def __init__(self, reason: str, lasting: bool = False):
        super().__init__(reason)
        self.lasting = lasting


class _Expired(Exception):
    """The process was ended for idleness just before the next request."""


class DrawingProcess:
    """A child process with an OpenGL context.

    It starts in the background (importing pyrender, opening a context) while the caller reads its mesh, and is kept for
    the next picture until it has been idle for a minute.
    """

    def __init__(self) -> None:
        self._owner = os.getpid()
        self._log: IO[bytes] = tempfile.TemporaryFile()
        self._lock = threading.Lock()
        self._idle: threading.Timer | None = None
        self.device: str | None = None
        self._process = subprocess.Popen(
            interpreter(_COMMAND),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
        )

    @property
    def usable(self) -> bool:
        """Whether the process runs and belongs to this one (after a fork it does not)."""
        return self._owner == os.getpid() and self._process.poll() is None

    def draw(self, job: RenderJob) -> list[NDArray[np.uint8]]:
        """Draw a job.

        Raises:
            DrawingFailed: no OpenGL, or the process crashed, hung or reported an error.
        """
        with self._lock:
            self._cancel_idle()
            if not self.usable:
                raise _Expired
            try:
                if self.device is None:
                    kind, payload = self._exchange(None, START_SECONDS)
                    if kind != "ready":
                        self.close()
                        raise DrawingFailed(str(payload), lasting=True)
                    self.device = str(payload)
                kind, payload = self._exchange(job, PICTURE_SECONDS * max(1, len(job.shots)))
            except BaseException:
                self.close()  # after a failure or Ctrl-C the pipe may hold half a message
                raise
            if kind != "pictures":
                raise DrawingFailed(str(payload))
            self._idle = threading.Timer(IDLE_SECONDS, self._expire)
            self._idle.daemon = True
            self._idle.start()
            return cast("list[NDArray[np.uint8]]", payload)

    def _expire(self) -> None:
        with self._lock:
            if self._idle is threading.current_thread():  # else a picture was requested in the meantime
                self.close()

    def _exchange(self, job: RenderJob | None, seconds: float) -> tuple[str, object]:
        """Send a job (or none) and wait for one message; a thread does both, since pipes have no timeout."""
        outcome: list[tuple[str, object]] = []

        def talk() -> None:
            try:
                if job is not None:
                    send(self._process.stdin, job)  # type: ignore[arg-type]
                outcome.append(cast(tuple[str, object], receive(self._process.stdout)))  # type: ignore[arg-type]
            except (EOFError, OSError, ValueError):
                pass

        thread = threading.Thread(target=talk, daemon=True)
        thread.start()
        thread.join(seconds)
        if thread.is_alive():
            raise DrawingFailed(f"the OpenGL driver gave no picture within {seconds:.0f} s", lasting=True)
        if not outcome:
            raise DrawingFailed(f"the OpenGL driver ended its process ({self._last_words()})", lasting=True)
        return outcome[0]

    def _last_words(self) -> str:
        try:
            code = self._process.wait(5)
        except subprocess.TimeoutExpired:
            code = None
        self._log.seek(0, os.SEEK_END)
        self._log.seek(max(0, self._log.tell() - LAST_BYTES))
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return f"exit status {code}" + (f": {lines[-1].strip()}" if lines else "")

    def _cancel_idle(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None

    def close(self) -> None:
        """End the child process."""
        if self._owner != os.getpid():
            return
        self._cancel_idle()
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            try:
                if stream is not None:
                    stream.close()
            except OSError:
                pass
        self._log.close()


_current: DrawingProcess | None = None
_no_use: str | None = None


def reason_against() -> str | None:
    """Say why no picture can be drawn with OpenGL here; None while no reason is known."""
    global _no_use
    if _no_use is None and importlib.util.find_spec("pyrender") is None:
        _no_use = f"pyrender is not installed ({INSTALL_PYRENDER}; on Debian and Ubuntu also {INSTALL_GL})"
    if _no_use is None and not sys.executable:
        _no_use = "there is no Python executable to start the drawing process with"
    return _no_use


def prepare() -> None:
    """Start the drawing process if there is none, without waiting for it."""
    global _current
    if reason_against() is None and (_current is None or not _current.usable):
        _current = DrawingProcess()


def draw(job: RenderJob) -> tuple[list[NDArray[np.uint8]], str]:
    """Draw a job with OpenGL.

    Returns:
        The pictures, and the name of the device that drew them.

    Raises:
        DrawingFailed: see :class:`DrawingProcess`.
    """
    global _no_use
    reason = reason_against()
    if reason is not None:
        raise DrawingFailed(reason, lasting=True)
    while True:
        prepare()
        assert _current is not None
        try:
            return _current.draw(job), _current.device or "unknown"
        except _Expired:
            continue
        except DrawingFailed as failure:
            if failure.lasting:
                _no_use = str(failure)
            raise


def shut_down() -> None:
    """End the drawing process, if there is one."""
    global _current
    if _current is not None:
        _current.close()
        _current = None


atexit.register(shut_down)
