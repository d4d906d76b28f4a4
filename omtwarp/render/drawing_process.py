"""The drawing process: reads jobs from standard input, draws them with pyrender, writes pictures to standard output.

An OpenGL driver may crash, hang, or conflict with other users of OpenGL in a process, and it reads environment
variables that must be set before it is loaded. It therefore runs in a process of its own, which the caller can time and
end. Messages are pickles after their length; both ends are the same program.
"""

from __future__ import annotations

import gc
import os
import pickle
import select
import signal
import struct
import sys
from typing import TYPE_CHECKING, BinaryIO, cast

GARBAGE_THRESHOLD = 200_000  # objects made between searches for garbage, as in omtwarp.cli

if TYPE_CHECKING:
    from omtwarp.render.scene import RenderJob

_LENGTH = struct.Struct(">Q")


def send(stream: BinaryIO, message: object) -> None:
    """Write one message."""
    data = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    stream.write(_LENGTH.pack(len(data)))
    stream.write(data)
    stream.flush()


def receive(stream: BinaryIO) -> object:
    """Read one message.

    Raises:
        EOFError: the other end is gone.
    """
    return pickle.loads(_exactly(stream, _LENGTH.unpack(_exactly(stream, _LENGTH.size))[0]))


def _exactly(stream: BinaryIO, count: int) -> bytes:
    data = stream.read(count)
    if data is None or len(data) < count:
        raise EOFError
    return data


def _waiting(stream: BinaryIO) -> bool:
    """Return whether input is available, where that can be tested, which Windows cannot for pipes."""
    return os.name == "nt" or bool(select.select([stream], [], [], 0.0)[0])


def main() -> None:
    """Serve until standard input ends."""
    gc.set_threshold(GARBAGE_THRESHOLD)  # the imports leave little garbage, and collection takes time
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C and closes the pipe
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a driver prints must not mix with the replies
    jobs = sys.stdin.buffer
    try:
        from omtwarp.render.pyrender_compat import GLUnavailable

        try:
            from omtwarp.render.pyrender_backend import GLRenderer

            renderer = GLRenderer()
        except GLUnavailable as error:
            send(replies, ("unavailable", str(error)))
            return
    except Exception as error:
        send(replies, ("unavailable", f"OpenGL could not be started: {type(error).__name__}: {error}"))
        return
    send(replies, ("ready", renderer.device))
    if not _waiting(jobs):
        renderer.warm_up()
    while True:
        try:
            job = receive(jobs)
        except EOFError:
            break
        try:
            answer: tuple[str, object] = ("pictures", renderer.draw(cast("RenderJob", job)))
        except Exception as error:
            answer = ("failed", f"{type(error).__name__}: {error}".splitlines()[0])
        send(replies, answer)
    renderer.close()
