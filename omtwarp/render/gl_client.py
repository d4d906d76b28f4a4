"""The drawing process, in which pyrender draws: its early start, requests for pictures, recovery from crashes.

An OpenGL driver may crash, hang, or conflict with other users of OpenGL in a process, and it reads environment
variables that must be set before it is loaded. It therefore runs in a process of its own, which the caller can time and
end. Messages are pickles; both ends are the same program.
"""

from __future__ import annotations

import atexit
import importlib.util
import math
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from typing import IO, TYPE_CHECKING, cast

from omtwarp.errors import DrawingFailed
from omtwarp.files.interruptions import interpreter
from omtwarp.mesh.arrays import Bytes

if TYPE_CHECKING:  # commands start the drawing process before they import NumPy
    from omtwarp.render.scene import RenderJob

# Long enough for a software driver on a busy machine: one that has not answered by then hangs.
START_SECONDS = 120.0
IDLE_SECONDS = 60.0  # after which the drawing process gets no more jobs

_COMMAND = "from omtwarp.render.gl_client import serve; serve()"


def _send(stream: IO[bytes], message: object) -> None:
    pickle.dump(message, stream, protocol=pickle.HIGHEST_PROTOCOL)
    stream.flush()


def serve() -> None:
    """Write the device, and pictures for each job on standard input, to standard output, until a job or it fails."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and closes the pipe
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a driver prints must not mix with the replies
    failing = "OpenGL could not be started: "
    try:
        from omtwarp.render.pyrender_renderer import GLRenderer

        renderer = GLRenderer()
        _send(replies, renderer.device)
        failing = ""
        while True:
            _send(replies, renderer.draw(pickle.load(sys.stdin.buffer)))
    except DrawingFailed as failure:
        _send(replies, failure)
    except EOFError:  # the caller has ended, or wants no more
        pass
    except Exception as error:
        text = f"{failing}{type(error).__name__}: {error}".splitlines()[0]
        _send(replies, DrawingFailed(text, lasting=bool(failing)))


class _DrawingProcess:
    """A child process with an OpenGL context.

    It starts in the background (importing pyrender, opening a context) while the caller reads its mesh, and is kept for
    the next picture until it has been idle for a minute. It is not usable in a process that was forked from this one.
    """

    def __init__(self) -> None:
        self._log: IO[bytes] = tempfile.TemporaryFile()
        self._lock = threading.Lock()
        self._until = math.inf
        self._idle = threading.Timer(0.0, self.close)
        self.device = ""
        self._process = subprocess.Popen(
            interpreter(_COMMAND), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log
        )

    @property
    def usable(self) -> bool:
        """Whether the process runs, and is not about to end."""
        return time.monotonic() < self._until and self._process.poll() is None

    def draw(self, job: RenderJob) -> list[Bytes]:
        """Draw a job.

        Raises:
            DrawingFailed: no OpenGL, or the process crashed, hung or reported an error.
        """
        picture_seconds = 180.0
        with self._lock:
            self._idle.cancel()
            try:
                self.device = self.device or cast(str, self._answer(None, START_SECONDS))
                pictures = self._answer(job, picture_seconds * max(1, len(job.shots)))
            except BaseException:
                self.close()  # after a failure or Ctrl-C the pipe may hold half a message
                raise
            self._until = time.monotonic() + IDLE_SECONDS
            self._idle = threading.Timer(IDLE_SECONDS + 5.0, self.close)  # never while a job arrives
            self._idle.daemon = True
            self._idle.start()
        return cast("list[Bytes]", pictures)

    def _answer(self, job: RenderJob | None, seconds: float) -> object:
        """Send a job, if any, and wait for one message; pipes have no timeout, so that a late process is ended."""
        end, late = time.monotonic() + seconds, threading.Timer(seconds, self._process.kill)
        late.start()
        try:
            if job is not None:
                _send(cast("IO[bytes]", self._process.stdin), job)
            answer = pickle.load(cast("IO[bytes]", self._process.stdout))
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            reason = f"gave no picture within {seconds:.0f} s" if time.monotonic() >= end else self._last_words()
            raise DrawingFailed(f"the OpenGL driver {reason}", lasting=True) from error
        finally:
            late.cancel()
        if isinstance(answer, DrawingFailed):
            raise answer
        return answer

    def _last_words(self) -> str:
        code = self._process.wait(5)
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return f"ended its process (exit status {code}{''.join(f': {line.strip()}' for line in lines[-1:])})"

    def close(self) -> None:
        """End the child process; in a process forked from this one, only let go of it."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._log):
            with suppress(OSError):
                cast("IO[bytes]", stream).close()


_current: _DrawingProcess | None = None
_no_use: str | None = None


def prepare() -> None:
    """Start the drawing process if there is none, without waiting for it, unless nothing can be drawn with OpenGL."""
    global _current, _no_use
    if _no_use is None and importlib.util.find_spec("pyrender") is None:
        from omtwarp.render.pyrender_compat import INSTALL_GL, INSTALL_PYRENDER

        _no_use = f"pyrender is not installed ({INSTALL_PYRENDER}; on Debian and Ubuntu also {INSTALL_GL})"
    if _no_use is None and not sys.executable:
        _no_use = "there is no Python executable to start the drawing process with"
    if _no_use is None and (_current is None or not _current.usable):
        shut_down()
        _current = _DrawingProcess()


def draw(job: RenderJob) -> tuple[list[Bytes], str]:
    """Draw a job with OpenGL.

    Returns:
        The pictures, and the name of the device that drew them.

    Raises:
        DrawingFailed: pyrender or OpenGL is missing, or the process crashed, hung or reported an error.
    """
    global _no_use
    prepare()
    if _no_use is not None or _current is None:
        raise DrawingFailed(str(_no_use), lasting=True)
    try:
        return _current.draw(job), _current.device
    except DrawingFailed as failure:
        if failure.lasting:
            _no_use = str(failure)
        raise


@atexit.register
def shut_down() -> None:
    """End the drawing process, if there is one."""
    global _current
    if _current is not None:
        _current.close()
        _current = None
