"""Bandwidth of every kernel of a map: the bytes that it has to move, by a formula, over the measured time.

While :class:`LaunchRecorder` is active every launch is timed by itself (with events of the device on CUDA), and the
bytes it cannot do without are counted from its arguments: each array once as a whole, but no more than sixteen elements
for every thread where there are many, since some arrays hold more than a launch touches. A kernel that moves those
bytes at the rate of a plain copy is bound by memory, and cannot be faster; a slower one is bound by computation or
scattered reads, or too small to fill the device.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from omtwarp.benchmark.measure import Facts
from omtwarp.device.start import wp
from omtwarp.device.threads import step_by_step
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh.surface import Surface

# Kernels that work through a list whose length only the device knows: next to nothing, and counted as nothing.
LISTED = ("omtwarp.flips.guard.find_bad_around", "omtwarp.flips.guard.shorten_steps")


@dataclass
class KernelRecord:
    """Launches of a kernel, summed.

    Attributes:
        module: where it is defined.
        launches: how many.
        threads: of all launches.
        seconds: time spent in it.
        moved: bytes it had to read and write.
    """

    module: str
    launches: int = 0
    threads: int = 0
    seconds: float = 0.0
    moved: int = 0


class LaunchRecorder:
    """Times all launches on one device between entering and leaving; the launches themselves are unchanged.

    Recorded graphs are launched step by step meanwhile.
    """

    def __init__(self, device: str):
        self.device = wp.get_device(device)
        self.kernels: dict[str, KernelRecord] = {}
        self._lock = threading.Lock()
        self._events: list[tuple[KernelRecord, wp.Event, wp.Event]] = []
        self._steps = step_by_step()

    def __enter__(self) -> LaunchRecorder:
        self._steps.__enter__()
        self._launch = wp.launch
        wp.launch = self._timed
        return self

    def __exit__(self, *_: object) -> None:
        wp.launch = self._launch
        self._steps.__exit__(None, None, None)
        if self._events:
            wp.synchronize_device(self.device)
            for record, begin, end in self._events:
                record.seconds += wp.get_event_elapsed_time(begin, end, synchronize=False) / 1e3
            self._events.clear()

    def _timed(
        self,
        kernel: wp.Kernel,
        dim: int | tuple[int, ...],
        inputs: Sequence[object] = (),
        outputs: Sequence[object] = (),
        *rest: object,
        **options: object,
    ) -> object:
        if options.get("record_cmd") or wp.get_device(options.get("device")) != self.device:
            return self._launch(kernel, dim, inputs, outputs, *rest, **options)
        threads = int(np.prod(dim))
        with self._lock:
            name = f"{kernel.module.name.removeprefix('omtwarp.')}.{kernel.key}"
            record = self.kernels.setdefault(name, KernelRecord(kernel.module.name))
            record.launches += 1
            record.threads += threads
            if f"{kernel.module.name}.{kernel.key}" not in LISTED:
                record.moved += moved_bytes(threads, [*inputs, *outputs])
        if self.device.is_cuda:
            begin, end = (wp.Event(self.device, enable_timing=True) for _ in range(2))
            stream = self.device.stream  # that of the launch; Warp's default device may be another
            stream.record_event(begin)
            result = self._launch(kernel, dim, inputs, outputs, *rest, **options)
            stream.record_event(end)
            self._events.append((record, begin, end))
            return result
        start = time.perf_counter()
        result = self._launch(kernel, dim, inputs, outputs, *rest, **options)
        seconds = time.perf_counter() - start
        with self._lock:
            record.seconds += seconds
        return result


def moved_bytes(threads: int, arguments: Sequence[object]) -> int:
    """Return the bytes that a launch over so many threads has to move.

    It counts every array once, and at most sixteen elements per thread.
    """
    total, seen = 0, set()
    for argument in arguments:
        if not isinstance(argument, wp.array) or argument.ptr in seen:
            continue
        seen.add(argument.ptr)
        # Per thread, elements of an array that a thread is taken to touch at most: a vertex has six neighbours on
        # average
        # Many threads, launches of fewer threads may go through whole arrays in a loop: these are counted whole
        elements = min(argument.size, 16 * threads) if threads >= 1024 else argument.size
        total += elements * wp.types.type_size_in_bytes(argument.dtype)
    return total


def copy_bandwidth(device: str, megabytes: int = 256, repeats: int = 5) -> float:
    """Return the bytes per second, read and written, of the fastest of some plain copies on a device."""
    where = wp.get_device(device)
    count = megabytes * 2**20 // 8
    source, target = (wp.full(count, 1.0, dtype=wp.float64, device=where) for _ in range(2))
    wp.copy(target, source)
    best = np.inf
    for _ in range(repeats):
        wp.synchronize_device(where)
        start = time.perf_counter()
        wp.copy(target, source)
        wp.synchronize_device(where)
        best = min(best, time.perf_counter() - start)
    return 16.0 * count / best


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
    with LaunchRecorder(device) as recorder:
        map_to_sphere((surface.vertices, surface.faces), device=device, refine=refine)
    rows: list[Facts] = []
    for name, record in sorted(recorder.kernels.items(), key=lambda item: -item[1].seconds):
        rate = record.moved / record.seconds if record.seconds > 0.0 else 0.0
        rows.append(
            {
                "name": name,
                "launches": record.launches,
                "threads": record.threads,
                "seconds": record.seconds,
                "bytes": record.moved,
                "bytes_per_second": rate,
                "part_of_copy": rate / bandwidth,
            }
        )
    return {"device": device, "faces": surface.face_count, "bandwidth": bandwidth, "kernels": rows}
