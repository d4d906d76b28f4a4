"""Where kernels run: Warp's start, arrays, sums, threads, recorded graphs, memory, and what decides between devices.

Here are names of devices and of solvers, as users write them, and the number of cores; nothing heavy is imported.
"""

import os
import re
from enum import StrEnum

from omtwarp.errors import OmtwarpError, shown


class Solver(StrEnum):
    """How sparse systems are solved: by SciPy, a built-in solver or, on a GPU, cuDSS; ``auto`` takes a built-in one."""

    AUTO, SCIPY, CHOLESKY, CUDSS = "auto", "scipy", "cholesky", "cudss"


def parse_device(value: object) -> str:
    """Check a device's name: ``auto`` (also for None), ``cpu``, ``cuda`` or ``cuda:N``; it need not exist.

    Raises:
        OmtwarpError: the name has another form.
    """
    name = "auto" if value is None else str(value)
    if name not in ("auto", "cpu", "cuda") and not (re.fullmatch(r"cuda:[0-9]{1,4}", name)):
        raise OmtwarpError(f"unknown device {shown(value)}: use auto, cpu, cuda or cuda:N")
    return name


def core_count() -> int:
    """Return the number of cores that this process may use, which ``OMTWARP_THREADS`` lowers."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get("OMTWARP_THREADS", "")
    return min(cores, max(int(wanted), 1)) if re.fullmatch("[0-9]{1,9}", wanted) else cores
