"""Measurement of time and memory, a description of the machine, the bandwidth of kernels, and tables of all of it.

While :class:`LaunchRecorder` is active every launch is timed by itself (with events of the device on CUDA), and the
bytes it cannot do without are counted from its arguments: each array once as a whole, but no more than sixteen elements
for every thread where there are many, since some arrays hold more than a launch touches. A kernel that moves those
bytes at the rate of a plain copy is bound by memory, and cannot be faster; a slower one is bound by computation or
scattered reads, or too small to fill the device.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import platform
import subprocess
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy import sparse

from omtwarp.device.start import wp
from omtwarp.device.threads import core_count, step_by_step
from omtwarp.files.interruptions import interpreter
from omtwarp.mapping.pipeline import map_to_sphere, versions
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import Surface


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
        self.base: int | None = None
        with contextlib.suppress(OSError):  # where the system cannot reset the peak, it is not known
            Path("/proc/self/clear_refs").write_text("5")
            self.base = _resident("VmRSS")

    def read(self) -> int | None:
        """Return the peak in bytes, or None where the system does not report it."""
        peak = _resident("VmHWM")
        return None if peak is None or self.base is None else max(peak - self.base, 0)


def _resident(field: str) -> int | None:
    kilobytes = _from_system("/proc/self/status", field).removesuffix("kB")
    return 1024 * int(kilobytes) if kilobytes else None


def _from_system(file: str, field: str) -> str:
    """Return what stands behind a name and a colon in a file of Linux; nothing where it is not there."""
    with contextlib.suppress(OSError):
        for line in Path(file).read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == field:
                return value.strip()
    return ""


def splu_reference(laplacian: sparse.csc_matrix, right: Floats) -> tuple[float, float]:
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
    processor = _from_system("/proc/cpuinfo", "model name") or platform.processor() or platform.machine()
    system, threads = f"{platform.system()} {platform.release()}", os.environ.get("OPENBLAS_NUM_THREADS", "all")
    about: Facts = {"processor": processor, "cores": core_count(), "memory": _total_memory(), "system": system}
    return about | {"gpus": gpus, "load_before": load, "blas_threads": threads, "versions": versions()}


def _total_memory() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return None


FIRST_USE = {
    "compile_seconds": "all kernels compiled", "compile_cpu_seconds": "the same, CPU", "load_seconds": "loaded again",
    "import_seconds": "`import omtwarp`", "help_seconds": "`omtwarp --help`",
}  # fmt: skip
"""What a new machine does once, with the heads of a table."""


def first_use(device: str = "cpu") -> dict[str, float]:
    """Time what a new machine does once, each in its own process: compilation into an empty cache, and starts.

    Args:
        device: what kernels are compiled for.

    Returns:
        Seconds under the names of :data:`FIRST_USE`.
    """
    with tempfile.TemporaryDirectory(prefix="omtwarp-benchmark-") as folder:
        empty = os.environ | {"WARP_CACHE_PATH": folder}
        prewarm = interpreter("from omtwarp.device.prewarm import main; main()", device)
        compiled, compiled_cpu = _run(prewarm, empty)
        loaded, _ = _run(prewarm, empty)
    plain = dict(os.environ)
    imported = min(_run(interpreter("import omtwarp"), plain)[0] for _ in range(3))
    helped = min(_run(interpreter("from omtwarp.__main__ import main; main()", "--help"), plain)[0] for _ in range(3))
    return dict(zip(FIRST_USE, (compiled, compiled_cpu, loaded, imported, helped), strict=True))


def _run(command: list[str], environment: dict[str, str]) -> tuple[float, float]:
    before = os.times()
    start = time.perf_counter()
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall = time.perf_counter() - start
    after = os.times()
    return wall, after.children_user + after.children_system - before.children_user - before.children_system


Facts: TypeAlias = dict
"""Figures by name, ready for JSON, times in seconds and memory in bytes.

Of a stage ``name``, ``seconds``, ``cpu_seconds``, ``iterations``, ``flips``, ``area`` and ``ratio`` to the reference;
of a map, or the medians of several, ``seconds``, ``cpu_seconds``, both ratios, ``peak_bytes`` above what the process
held before, ``device_bytes`` (None where an earlier map needed as much), ``flips``, ``bijective`` and ``stages``; of a
mesh ``family``, ``name``, ``vertices``, ``faces``, ``splu`` and ``runs``, one on each device.
"""

MAPS = (
    "Seconds on the wall, stage by stage, and of all threads; both of a whole map as multiples of one SciPy `splu` "
    "factorisation and solve of the same mesh's Laplacian, on one thread; the peak of memory above that before:"
)
STAGES = ("conformal", "moser", "omt", "refine", "optimality", "other")


def markdown(result: Facts) -> str:
    """Return the tables of a result of :func:`benchmark.run` as Markdown."""
    parts = [_machine(result["machine"], result["settings"]), MAPS, maps_table(result)]
    parts += [_kernels(table) for table in result.get("kernels", [])]
    if "first_use" in result:
        rows = [[device, *(_number(one[key]) for key in FIRST_USE)] for device, one in result["first_use"].items()]
        parts += ["First use:", table(["device", *(f"{words}, s" for words in FIRST_USE.values())], rows)]
    return "\n\n".join(part for part in parts if part) + "\n"


def table(heads: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table with its first column aligned left and the others right."""
    lines = ["| " + " | ".join(heads) + " |", "|" + "|".join([":--"] + ["--:"] * (len(heads) - 1)) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def _machine(machine: Facts, settings: Facts) -> str:
    memory = f", {machine['memory'] / 2**30:.0f} GiB" if machine["memory"] else ""
    gpus = "; " + ", ".join(gpu["name"] for gpu in machine["gpus"]) if machine["gpus"] else "; no CUDA device"
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    return (
        f"{machine['processor']}, {machine['cores']} cores{memory}{gpus}; {machine['system']}. {versions}. "
        f"Median of {settings['repeats']} maps each, kernels compiled before."
    )


def _number(value: float | None, digits: int = 3) -> str:
    if value is None or value != value:
        return ""
    return f"{value:.{digits}g}" if abs(value) < 1000 else f"{value:.0f}"


def maps_table(result: Facts) -> str:
    """Return the table of all maps, one in a row: seconds on the wall by stage, processor seconds and memory."""
    present = {stage["name"] for mesh in result["meshes"] for run in mesh["runs"] for stage in run["stages"]}
    names = [name for name in STAGES if name in present] + sorted(present - set(STAGES))
    rows = []
    for mesh in result["meshes"]:
        for run in mesh["runs"]:
            stages = {stage["name"]: stage["seconds"] for stage in run["stages"]}
            memory = [None if size is None else size / 2**20 for size in (run["peak_bytes"], run["device_bytes"])]
            seconds = [*(stages.get(name) for name in names), run["seconds"], run["cpu_seconds"]]
            ratios = [run.get("ratio"), run.get("cpu_ratio")]
            figures = [_number(value) for value in (*seconds, *ratios, *memory)]
            rows.append([mesh["name"], f"{mesh['faces']}", run["device"], *figures, str(run["flips"])])
    heads = ["mesh", "faces", "device", *names, "whole map", "CPU", "map / splu", "CPU / splu", "MiB", "device MiB"]
    return table([*heads, "flips"], rows)


def _kernels(kernels: Facts) -> str:
    rows = []
    for row in kernels["kernels"]:
        figures = 1e3 * row["seconds"], row["bytes"] / 1e6, row["bytes_per_second"] / 1e9
        share = f"{100 * row['part_of_copy']:.0f} %"
        rows.append([f"`{row['name']}`", str(row["launches"]), *map(_number, figures), share])
    head = (
        f"Kernels on {kernels['device']}, {kernels['faces']} faces; a plain copy moves "
        f"{kernels['bandwidth'] / 1e9:.0f} GB/s there:"
    )
    return head + "\n\n" + table(["kernel", "launches", "ms", "MB moved", "GB/s", "of a copy"], rows)


# Kernels that work through a list whose length only the device knows: next to nothing, and counted as nothing.
LISTED = ("omtwarp.flips.guard.find_bad_around", "omtwarp.flips.guard.shorten_steps")


@dataclass
class KernelRecord:
    """Launches of a kernel, summed.

    Attributes:
        launches: how many.
        threads: of all launches.
        seconds: time spent in it.
        bytes: that it had to read and write.
    """

    launches: int = 0
    threads: int = 0
    seconds: float = 0.0
    bytes: int = 0


@contextlib.contextmanager
def recorded_launches(device: str) -> Iterator[dict[str, KernelRecord]]:
    """Time all launches on one device meanwhile, by the names of their kernels; the launches themselves are unchanged.

    Recorded graphs are launched step by step.
    """
    where, launch, lock = wp.get_device(device), wp.launch, threading.Lock()
    kernels: dict[str, KernelRecord] = defaultdict(KernelRecord)
    events: list[tuple[KernelRecord, wp.Event, wp.Event]] = []

    def timed(
        kernel: wp.Kernel,
        dim: int | tuple[int, ...],
        inputs: Sequence[object] = (),
        outputs: Sequence[object] = (),
        **options: object,
    ) -> object:
        if options.get("record_cmd") or wp.get_device(options.get("device")) != where:
            return launch(kernel, dim, inputs, outputs, **options)
        threads = int(np.prod(dim))
        with lock:
            record = kernels[f"{kernel.module.name.removeprefix('omtwarp.')}.{kernel.key}"]
            record.launches += 1
            record.threads += threads
            if f"{kernel.module.name}.{kernel.key}" not in LISTED:
                record.bytes += moved_bytes(threads, [*inputs, *outputs])
        if where.is_cuda:
            begin, end = (wp.Event(where, enable_timing=True) for _ in range(2))
            where.stream.record_event(begin)  # of the launch; Warp's default device may have another
            result = launch(kernel, dim, inputs, outputs, **options)
            where.stream.record_event(end)
            events.append((record, begin, end))
            return result
        start = time.perf_counter()
        result = launch(kernel, dim, inputs, outputs, **options)
        seconds = time.perf_counter() - start
        with lock:
            record.seconds += seconds
        return result

    with step_by_step():
        wp.launch = timed
        try:
            yield kernels
        finally:
            wp.launch = launch
    if events:
        wp.synchronize_device(where)
    for record, begin, end in events:
        record.seconds += wp.get_event_elapsed_time(begin, end, synchronize=False) / 1e3


def moved_bytes(threads: int, arguments: Sequence[object]) -> int:
    """Return the bytes that a launch over so many threads has to move.

    It counts every array once, those of structs too, and at most sixteen elements per thread.
    """
    total, seen = 0, set()
    held = ([a] if isinstance(a, wp.array) else getattr(a, "__dict__", {}).values() for a in arguments)
    for argument in (one for several in held for one in several):
        if not isinstance(argument, wp.array) or argument.ptr in seen:
            continue
        seen.add(argument.ptr)
        # Per thread, elements of an array that a thread is taken to touch at most: a vertex has six neighbours on
        # average
        # Many threads, launches of fewer threads may go through whole arrays in a loop: these are counted whole
        elements = min(argument.size, 16 * threads) if threads >= 1024 else argument.size
        total += elements * wp.types.type_size_in_bytes(argument.dtype)
    return total


def best_of(work: Callable[[], object], device: wp.Device, repeats: int = 4) -> float:
    """Return the least seconds of some runs of work, the device's part of it included."""
    best = np.inf
    for _ in range(repeats):
        wp.synchronize_device(device)
        start = time.perf_counter()
        work()
        wp.synchronize_device(device)
        best = min(best, time.perf_counter() - start)
    return best


def copy_bandwidth(device: str, megabytes: int = 256) -> float:
    """Return the bytes per second, read and written, of the fastest of some plain copies on a device."""
    where = wp.get_device(device)
    count = megabytes * 2**20 // 8
    source, target = (wp.full(count, 1.0, dtype=wp.float64, device=where) for _ in range(2))
    return 16.0 * count / best_of(lambda: wp.copy(target, source), where)


def kernel_table(surface: Surface, device: str, refine: str | float | None) -> Facts:
    """Map a surface with every launch recorded.

    Args:
        surface: what to map.
        device: a device's name.
        refine: as in :func:`omtwarp.map_to_sphere`.

    Returns:
        ``bandwidth`` (bytes per second of a copy), ``kernels``, slowest in all first: ``name``, ``launches``,
        ``seconds``, ``bytes``, ``bytes_per_second`` and ``part_of_copy``.
    """
    bandwidth = copy_bandwidth(device)
    with recorded_launches(device) as kernels:
        map_to_sphere((surface.vertices, surface.faces), device=device, refine=refine)
    rows: list[Facts] = []
    for name, record in sorted(kernels.items(), key=lambda item: -item[1].seconds):
        rate = record.bytes / record.seconds if record.seconds > 0.0 else 0.0
        speed = {"bytes_per_second": rate, "part_of_copy": rate / bandwidth}
        rows.append({"name": name, **vars(record), **speed})
    return {"device": device, "faces": surface.face_count, "bandwidth": bandwidth, "kernels": rows}
