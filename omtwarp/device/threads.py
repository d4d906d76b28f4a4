"""Launches on all cores of a CPU, and loops that stay on a GPU as recorded graphs.

Warp runs a launch on one core, and releases Python's lock meanwhile.

A loop is recorded once as a CUDA graph and replayed, or run directly on the CPU. Recorded work launches kernels, copies
and clears arrays, and branches with ``wp.capture_while`` and ``wp.capture_if``, whose conditions are arrays on the
device. It must not read anything back, nor allocate inside of a loop. Not recorded, the same work runs step by step:
the conditions are then read by the host, which on the CPU is free, and large launches can be cut into parts for its
cores.
"""

import contextlib
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise
from typing import TYPE_CHECKING, TypeVar

from omtwarp.device import core_count
from omtwarp.device.policy import SMALLEST_SHARED_LAUNCH, launch_parts_of, records_graphs
from omtwarp.device.start import wp

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Result = TypeVar("Result")
Job = TypeVar("Job")

_pool: tuple[int, ThreadPoolExecutor] | None = None
_loaded: set[tuple[wp.Kernel, str]] = set()


def pool() -> ThreadPoolExecutor:
    """Return the thread pool of this process; a forked process gets its own."""
    global _pool
    if _pool is None or _pool[0] != os.getpid():
        _pool = (os.getpid(), ThreadPoolExecutor(core_count(), thread_name_prefix="omtwarp"))
    return _pool[1]


def run_all(work: Callable[[Job], Result], jobs: Sequence[Job]) -> list[Result]:
    """Run ``work`` for every job in parallel, and return the results; not to be called from within such work.

    The first job runs on the calling thread, which would only wait: many launches take less time than waking a thread.
    Maps of scans take 3 to 10 % less time than with all jobs on other threads.
    """
    if len(jobs) < 2 or core_count() < 2:
        return [work(job) for job in jobs]
    others = [pool().submit(work, job) for job in jobs[1:]]
    try:
        return [work(jobs[0]), *(other.result() for other in others)]
    except BaseException:
        wait(others)  # what they write to may be used again
        raise


def load(kernel: wp.Kernel, device: wp.Device) -> None:
    """Load a kernel, compiled if necessary, before several threads launch it.

    Otherwise each of them would compile it, with its header.
    """
    if (kernel, str(device)) not in _loaded:
        # Not by the module's own method, which uses CUDA's block sizes and compiles kernels that are not launched here.
        wp.load_module(kernel.module, device=device, max_workers=0)
        _loaded.add((kernel, str(device)))


FIRST_THREAD = object()
"""Stands among the arguments of :func:`launch_parts` for the number of a part's first thread."""


@dataclass(frozen=True)
class Each:
    """An array with elements for every thread of a launch, of which each part of the launch gets its own.

    Attributes:
        array: ``width`` elements for a thread, and ``more`` behind the last.
    """

    array: wp.array
    width: int = 1
    more: int = 0

    def of(self, part: slice) -> wp.array:
        """Return the elements of some threads; without a slice where these are all."""
        first, last = self.width * part.start, self.width * part.stop + self.more
        return self.array if first == 0 and last == len(self.array) else self.array[first:last]


def each(*arrays: wp.array) -> list[Each]:
    """Return arrays with one element for every thread as arguments of :func:`launch_parts`."""
    return [Each(array) for array in arrays]


def launch_parts(
    kernel: wp.Kernel,
    count: int,
    inputs: Sequence[object],
    outputs: Sequence[object],
    device: wp.Device,
    least: int = SMALLEST_SHARED_LAUNCH,
) -> None:
    """Launch a kernel whose threads are independent, in one part for every core of a CPU.

    The result is the same, to the bit, as that of one launch.

    Args:
        kernel: writes to the elements of its thread alone.
        count: number of threads.
        inputs, outputs: of the kernel: arrays of which a part gets its own elements as :class:`Each`, and
            :data:`FIRST_THREAD` where a part begins.
        device: a Warp device; on CUDA there is one launch.
        least: launches with fewer threads are not divided.
    """

    def launch(part: slice) -> None:
        def own(given: object) -> object:
            return given.of(part) if isinstance(given, Each) else part.start if given is FIRST_THREAD else given

        arguments = list(map(own, inputs)), list(map(own, outputs))
        wp.launch(kernel, part.stop - part.start, *arguments, device=device)

    parts = parts_of(count, device, least)
    if len(parts) > 1:
        load(kernel, device)
    run_all(launch, parts)


def computed(
    kernel: wp.Kernel, inputs: Sequence[object], out: wp.array, least: int = SMALLEST_SHARED_LAUNCH
) -> wp.array:
    """Launch a kernel in parts whose every thread writes one element, or row, of an array, and return the array.

    Args:
        kernel, inputs, least: as of :func:`launch_parts`.
        out: as many elements or rows as threads; a part gets its own, or with :data:`FIRST_THREAD` all.
    """
    whole = any(given is FIRST_THREAD for given in inputs)
    launch_parts(kernel, len(out), inputs, [out] if whole else each(out), out.device, least)
    return out


def parts_of(count: int, device: wp.Device, least: int = SMALLEST_SHARED_LAUNCH) -> list[slice]:
    """Return the parts of a launch with so many threads, one for every core of a CPU; see :func:`launch_parts`."""
    parts = launch_parts_of(wp.get_device(device), count, core_count(), least)
    return [slice(a, b) for a, b in pairwise([count * k // parts for k in range(parts + 1)])]


_limit, _limit_lock, _limited = contextlib.ExitStack(), threading.Lock(), 0


@contextlib.contextmanager
def blas_threads(count: int) -> Iterator[None]:
    """Limit the linear algebra of NumPy and SciPy to a number of threads, as a context or a decorator.

    OpenBLAS's threads wait for one another by spinning: with other threads or programs running, a product of two
    vectors can take a hundred times as long. Sums on one thread also have the same bits on every machine. The limit is
    the process's: of those that overlap in several threads the first sets it, and the last to end lifts it.
    """
    global _limited
    with _limit_lock:
        if not _limited:
            _limit.enter_context(_controller().limit(limits=count, user_api="blas"))
        _limited += 1
    try:
        yield
    finally:
        with _limit_lock:
            _limited -= 1
            if not _limited:
                _limit.close()


@lru_cache(maxsize=1)
def _controller() -> "ThreadpoolController":
    from scipy.linalg import cython_blas  # noqa: F401 (its library has to be loaded to be found)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


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
    """

    def __init__(self, device: wp.Device):
        self._device = wp.get_device(device)
        self._record = records_graphs(self._device)
        self._graphs: dict[tuple[Callable[[wp.array], None], int], Graph] = {}

    def __call__(self, work: Callable[[wp.array], None], array: wp.array) -> None:
        """Run work(array), recorded at the first call with an array; the recording keeps the array alive."""
        if not (self._record and _recording) or self._device.is_capturing:
            work(array)
            return
        key = (work, array.ptr)
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
