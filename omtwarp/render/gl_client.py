"""The drawing process, in which pyrender draws: its early start, requests for pictures, recovery from crashes.

An OpenGL driver may crash, hang, or conflict with other users of OpenGL in a process, and it reads environment
variables that must be set before it is loaded. It therefore runs in a process of its own, which the caller can time and
end. Messages are pickles; both ends are the same program.
"""

from __future__ import annotations

import atexit
import importlib.util
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

# For the start and for each picture, on a busy machine without a GPU: a process that takes longer hangs.
START_SECONDS = 120.0
IDLE_SECONDS = 60.0  # after which the drawing process ends

_COMMAND = "from omtwarp.render.gl_client import serve; serve()"


def serve() -> None:
    """Write pictures and the device's name for each job on standard input, or at last what failed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and closes the pipe
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a driver prints must not mix with the replies
    from omtwarp.render.pyrender_renderer import GLRenderer

    renderer = GLRenderer()
    try:
        while True:
            _send(replies, (renderer.draw(pickle.load(sys.stdin.buffer)), renderer.device))
    except EOFError:  # the caller has ended, or wants no more
        pass
    except Exception as error:
        _send(replies, f"{type(error).__name__}: {error}".splitlines()[0])


def _send(stream: IO[bytes] | None, message: object) -> None:
    pickle.dump(message, cast("IO[bytes]", stream), protocol=pickle.HIGHEST_PROTOCOL)
    cast("IO[bytes]", stream).flush()


class _DrawingProcess(subprocess.Popen[bytes]):
    """A child process with an OpenGL context.

    It starts in the background (importing pyrender, opening a context) while the caller reads its mesh, and is kept for
    the next picture until it has been idle for a minute. It is not usable in a process that was forked from this one.
    """

    def __init__(self) -> None:
        self.log = tempfile.TemporaryFile()
        self._clock = threading.Timer(0.0, self.kill)
        super().__init__(interpreter(_COMMAND), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.log)

    def end_in(self, seconds: float) -> None:
        """End the process after a time, in place of the one that was set before; pipes have no timeout."""
        self._clock.cancel()
        if self._clock.is_alive():
            self._clock.join()  # it may be ending the process at this moment
        self._clock = threading.Timer(seconds, self.kill)
        self._clock.daemon = True
        self._clock.start()

    def draw(self, job: RenderJob) -> tuple[list[Bytes], str]:
        """Return the pictures of a job, and the device's name.

        Raises:
            DrawingFailed: the process crashed, hung or reported an error.
        """
        global _no_use
        seconds = START_SECONDS * (1 + len(job.shots))
        begin = time.monotonic()
        self.end_in(seconds)
        try:
            _send(self.stdin, job)
            answer = pickle.load(cast("IO[bytes]", self.stdout))
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            late = time.monotonic() >= begin + seconds
            code = self.wait()
            self.log.seek(0)
            words = self.log.read().decode(errors="replace").strip().rpartition("\n")[2]
            ended = f"gave no picture within {seconds:.0f} s" if late else f"ended its process (exit status {code})"
            _no_use = f"the OpenGL driver {ended}{words and f': {words}'}"
            raise DrawingFailed(_no_use) from error
        if isinstance(answer, str):
            raise DrawingFailed(answer)
        self.end_in(IDLE_SECONDS)
        return cast("tuple[list[Bytes], str]", answer)


_lock = threading.Lock()
_current: _DrawingProcess | None = None
_no_use = ""  # why nothing can be drawn with OpenGL


def prepare() -> None:
    """Start the drawing process if there is none, without waiting for it, unless nothing can be drawn with OpenGL."""
    global _current, _no_use
    if importlib.util.find_spec("pyrender") is None or not sys.executable:
        from omtwarp.render.pyrender_compat import INSTALL

        _no_use = f"there is no pyrender, or no Python to run it in ({INSTALL})"
    if _current is not None:
        _current.end_in(IDLE_SECONDS)
    if not _no_use and (_current is None or _current.poll() is not None):
        shut_down()
        _current = _DrawingProcess()


def draw(job: RenderJob) -> tuple[list[Bytes], str]:
    """Draw a job with OpenGL.

    Returns:
        The pictures, and the name of the device that drew them.

    Raises:
        DrawingFailed: pyrender or OpenGL is missing, or the process crashed, hung or reported an error.
    """
    with _lock:
        prepare()
        if _current is None:
            raise DrawingFailed(_no_use)
        try:
            return _current.draw(job)
        except BaseException:
            shut_down()  # after a failure or Ctrl-C the pipe may hold half a message
            raise


@atexit.register
def shut_down() -> None:
    """End the drawing process, if there is one; in a process forked from this one, only let go of it."""
    global _current
    if _current is not None:
        with suppress(OSError), _current.log, _current:
            _current.kill()
        _current = None
