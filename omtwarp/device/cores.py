"""The number of usable cores, in a module that does not load Warp."""

from __future__ import annotations

import os
import re


def core_count() -> int:
    """Return the number of cores that this process may use, which ``OMTWARP_THREADS`` lowers."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = os.environ.get("OMTWARP_THREADS", "")
    return min(cores, max(int(wanted), 1)) if re.fullmatch("[0-9]{1,9}", wanted) else cores
