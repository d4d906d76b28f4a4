"""Loops that stay on the device: recorded once as a CUDA graph and replayed, or run directly on the CPU.

Recorded work launches kernels, copies and clears arrays, and branches with ``wp.capture_while`` and
``wp.capture_if``, whose conditions are arrays on the device. It must not read anything back, nor allocate inside of a
loop. Not recorded, the same work runs step by step: the conditions are then read by the host, which on the CPU is free,
and large launches can be cut into parts for its cores.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial

from omtwarp.device.policy import records_graphs
from omtwarp.device.start import wp

# Graphs that are kept for one kind of work; each keeps its array in memory.
MAX_GRAPHS = 8

_recording = True


class Graph:
    """Work that is repeated on the same arrays.

    Args:
        work: the function to run; the arrays that it reads and writes have to live as long as the graph.
        device: a Warp device.
        record: whether to record it. Left out, on CUDA where its driver knows conditions in graphs (12.4); never on the
            CPU, where other threads' launches would end up in the recording.

    Attributes:
        recorded: whether it will be, or is, recorded.
    """

    def __init__(self, work: Callable[[], None], device: wp.Device, record: bool | None = None):
        self._work = work
        self._device = wp.get_device(device)
        self.recorded = records_graphs(self._device) if record is None else record
        self._graph: wp.Graph | None = None

    def __call__(self) -> None:
        """Run the work; if another graph is being recorded, add it to that graph."""
        if not self.recorded or not _recording or self._device.is_capturing:
            self._work()
            return
        with wp.ScopedDevice(self._device):
            if self._graph is None:
                with wp.ScopedCapture(self._device) as capture:
                    self._work()
                self._graph = capture.graph
            wp.capture_launch(self._graph)


class GraphsByArray:
    """Graphs of work that is done in place on arrays of the caller: one for each kind of work and each array.

    Args:
        device: a Warp device.
        record: as in :class:`Graph`.
    """

    def __init__(self, device: wp.Device, record: bool | None = None):
        self._device = wp.get_device(device)
        self._record = records_graphs(self._device) if record is None else record
        self._graphs: dict[tuple[str, int], Graph] = {}

    def __call__(self, work: Callable[[wp.array], None], array: wp.array) -> None:
        """Run work(array), recorded at the first call with an array; the recording keeps the array alive."""
        if not (self._record and _recording) or self._device.is_capturing:
            work(array)
            return
        key = (work.__name__, array.ptr)
        if key not in self._graphs:
            if len(self._graphs) >= MAX_GRAPHS:
                wp.synchronize_device(self._device)  # none of them may still be running
                self._graphs.clear()
            self._graphs[key] = Graph(partial(work, array), self._device, True)
        self._graphs[key]()


@contextlib.contextmanager
def step_by_step() -> Iterator[None]:
    """Record and replay nothing inside this context, so that each launch can be observed and timed."""
    global _recording
    before, _recording = _recording, False
    try:
        yield
    finally:
        _recording = before
