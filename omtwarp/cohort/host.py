"""A process with all modules loaded that forks for every item: ``python -m omtwarp.cohort.host``.

Loading Warp and the kernels takes seconds, a fork milliseconds. Jobs are lines on standard input, and the answer to
each is a line of JSON: its exit status, and whether it exceeded its time. When standard input ends, because the driver
is done or dead, the item at work is ended too. Where there is no fork, and on CUDA, whose state a fork does not
survive, the process works on one item itself and ends.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import select
import signal
import sys
import tempfile
import time
from pathlib import Path

from omtwarp.cohort.item import Job
from omtwarp.cohort.work import mapped, run_item
from omtwarp.device.policy import asks_for_cuda
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.shapes import blob
from omtwarp.mesh.write import write_mesh


def main() -> None:
    """Serve jobs until standard input ends."""
    forks = hasattr(os, "fork")
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # other output must not mix with the answers
    warm = False
    pending = b""
    while True:
        while b"\n" not in pending:
            block = os.read(0, 1 << 16)
            if not block:
                return
            pending += block
        line, pending = pending.split(b"\n", 1)
        job = Job.from_json(line.decode())
        if not forks or asks_for_cuda(job.options.get("device")):
            run_item(job)
            answers.write(json.dumps({"exit": 0, "timeout": False}) + "\n")
            return
        if not warm:
            _load(job)
            warm = True
        answers.write(json.dumps(_supervise(job)) + "\n")


def _load(job: Job) -> None:
    """Load the readers, libraries and kernels that a job needs, and most likely all others of its cohort.

    A map does this that is small enough to start no thread, which a fork would lose.
    """
    surface = blob(0, sphere=320)
    with tempfile.TemporaryDirectory() as folder:
        write_mesh(Path(folder) / "warm.ply", surface.vertices, surface.faces)
        mesh = read_mesh(Path(folder) / "warm.ply")
        mapped((mesh.vertices, mesh.faces), job.options).save(Path(folder) / "warm.npz")
    gc.collect()
    gc.freeze()  # collections in forks leave these pages shared


def _supervise(job: Job) -> dict[str, int | bool]:
    """Fork, and wait for the item, the end of its time, or the end of the driver."""
    host = os.getpid()
    child = os.fork()
    if child == 0:
        _work(job, host)
    with contextlib.suppress(OSError):  # whichever of the two comes first: the group is there before it may be ended
        os.setpgid(child, child)
    deadline = time.monotonic() + job.time_limit
    pidfd = None
    if hasattr(os, "pidfd_open"):
        with contextlib.suppress(OSError):
            pidfd = os.pidfd_open(child)
    late = False
    try:
        while True:
            left = deadline - time.monotonic()
            watched = [0] if pidfd is None else [0, pidfd]
            # Poll: seconds between polls of an item, where the system cannot wait for it
            ready, _, _ = select.select(watched, [], [], max(0.0, left if pidfd is not None else min(left, 0.02)))
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return {"exit": os.waitstatus_to_exitcode(status), "timeout": late}
            gone = 0 in ready  # jobs come one by one: input during a job is the end of the stream
            if gone or time.monotonic() >= deadline:
                late = not gone
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                if gone:
                    os._exit(1)
                return {"exit": -signal.SIGKILL, "timeout": True}
    finally:
        if pidfd is not None:
            os.close(pidfd)


def _work(job: Job, host: int) -> None:
    """Run an item in a process group of its own, and exit; also where the host has died already."""
    status = 70
    try:
        os.setpgid(0, 0)
        if sys.platform == "linux":
            # Pr set pdeathsig, of Linux's prctl
            ctypes.CDLL(None).prctl(1, signal.SIGKILL)
            if os.getppid() != host:
                return
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        run_item(job)
        status = 0
    finally:
        os._exit(status)


if __name__ == "__main__":
    main()
