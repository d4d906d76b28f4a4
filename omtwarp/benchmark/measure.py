"""Measurement of time and memory, and a description of the machine."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import platform
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from omtwarp.benchmark.tables import Facts
from omtwarp.device.start import wp
from omtwarp.device.threads import core_count
from omtwarp.files.interruptions import interpreter
from omtwarp.mapping.pipeline import versions


class Clock:
    """Measures wall-clock and processor seconds since it was made; the latter of all threads of the process."""

    def __init__(self) -> None:
        self.wall, self.cpu = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """Return the wall-clock and processor seconds since the clock was made."""
        return time.perf_counter() - self.wall, time.process_time() - self.cpu


class PeakMemory:
    """Measures the peak of this process's resident memory above what the process held at the start."""

    def __init__(self) -> None:
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):  # freed memory that is kept would hide later use
            ctypes.CDLL("libc.so.6").malloc_trim(0)
        self.base = _resident("VmRSS")
        try:  # reset the peak, where the system can
            Path("/proc/self/clear_refs").write_text("5")
            self.resettable = True
        except OSError:
            self.resettable = False

    def read(self) -> int | None:
        """Return the peak in bytes, or None where the system does not report it."""
        peak = _resident("VmHWM")
        if not self.resettable or peak is None or self.base is None:
            return None
        return max(peak - self.base, 0)


def _resident(field: str) -> int | None:
    try:
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith(field + ":"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return None


def splu_reference(laplacian: sparse.csc_matrix, right: NDArray[np.float64]) -> tuple[float, float]:
    """Return the wall and processor seconds of one default ``scipy.sparse.linalg.splu`` and one solve.

    Args:
        laplacian: the cotangent Laplacian with one vertex removed, compressed columns.
        right: a right-hand side.
    """
    from scipy.sparse.linalg import splu

    clock = Clock()
    splu(laplacian).solve(right)
    return clock.read()


def machine(devices: tuple[str, ...]) -> Facts:
    """Describe the machine and the versions of the libraries."""
    gpus: list[Facts] = []
    for name in devices:
        device = wp.get_device(name)
        if device.is_cuda:
            gpus.append({"name": device.name, "memory": int(device.total_memory), "arch": int(device.arch)})
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {
        "processor": _processor(),
        "cores": core_count(),
        "memory": _total_memory(),
        "system": f"{platform.system()} {platform.release()}",
        "gpus": gpus,
        "load_before": load,
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS", "all"),
        "versions": versions(),
    }


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _total_memory() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None


def first_use(device: str = "cpu") -> dict[str, float]:
    """Time what a new machine does once, each in its own process: compilation into an empty cache, and starts.

    Args:
        device: what kernels are compiled for.

    Returns:
        ``compile_seconds`` and ``compile_cpu_seconds`` (all kernels, empty cache), ``load_seconds`` (the same again,
        from the cache), ``import_seconds`` (``import omtwarp``) and ``help_seconds`` (``omtwarp --help``).
    """
    with tempfile.TemporaryDirectory(prefix="omtwarp-benchmark-") as folder:
        empty = os.environ | {"WARP_CACHE_PATH": folder}
        prewarm = interpreter("from omtwarp.device.prewarm import main; main()", device)
        compiled, compiled_cpu = _run(prewarm, empty)
        loaded, _ = _run(prewarm, empty)
    plain = dict(os.environ)
    imported = min(_run(interpreter("import omtwarp"), plain)[0] for _ in range(3))
    helped = min(_run(interpreter("from omtwarp.__main__ import main; main()", "--help"), plain)[0] for _ in range(3))
    return {
        "compile_seconds": compiled,
        "compile_cpu_seconds": compiled_cpu,
        "load_seconds": loaded,
        "import_seconds": imported,
        "help_seconds": helped,
    }


def _run(command: list[str], environment: dict[str, str]) -> tuple[float, float]:
    before = os.times()
    start = time.perf_counter()
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall = time.perf_counter() - start
    after = os.times()
    return wall, after.children_user + after.children_system - before.children_user - before.children_system
