"""Independent work on all cores: Warp runs a launch on one core, and releases Python's lock meanwhile."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias, TypeVar

from omtwarp.device.names import core_count
from omtwarp.device.policy import SMALLEST_SHARED_LAUNCH, launch_parts_of
from omtwarp.device.start import wp

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController

Result = TypeVar("Result")
Job = TypeVar("Job")
Arguments: TypeAlias = tuple[Sequence[object], Sequence[object]]
"""Inputs and outputs of a launch: arrays, numbers and vectors, in the order of the kernel's parameters."""

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


def launch_parts(
    kernel: wp.Kernel,
    count: int,
    arguments: Callable[[slice], Arguments],
    device: wp.Device,
    least: int = SMALLEST_SHARED_LAUNCH,
) -> None:
    """Launch a kernel whose threads are independent, in one part for every core of a CPU.

    The result is the same, to the bit, as that of one launch.

    Args:
        kernel: writes to the elements of its thread alone.
        count: number of threads.
        arguments: inputs and outputs of a launch over a slice: arrays with an element per thread cut to that slice.
        device: a Warp device; on CUDA there is one launch.
        least: launches with fewer threads are not divided.
    """

    def launch(part: slice) -> None:
        inputs, outputs = arguments(part)
        wp.launch(kernel, dim=part.stop - part.start, inputs=inputs, outputs=outputs, device=device)

    parts = parts_of(count, device, least)
    if len(parts) > 1:
        load(kernel, device)
    run_all(launch, parts)


def parts_of(count: int, device: wp.Device, least: int = SMALLEST_SHARED_LAUNCH) -> list[slice]:
    """Return the parts of a launch with so many threads, one for every core of a CPU; see :func:`launch_parts`."""
    parts = launch_parts_of(wp.get_device(device), count, core_count(), least)
    bounds = [count * k // parts for k in range(parts + 1)]
    return [slice(a, b) for a, b in pairwise(bounds)]


def cut(array: wp.array, part: slice) -> wp.array:
    """Return the part of an array that a launch over a slice works on; without a slice where that is all of it."""
    return array if part.start == 0 and part.stop == len(array) else array[part]


@contextlib.contextmanager
def blas_threads(count: int) -> Iterator[None]:
    """Limit the linear algebra of NumPy and SciPy to a number of threads, as a context or a decorator.

    OpenBLAS's threads wait for one another by spinning: with other threads or programs running, a product of two
    vectors can take a hundred times as long. Sums on one thread also have the same bits on every machine.
    """
    with _controller().limit(limits=count, user_api="blas"):
        yield


@lru_cache(maxsize=1)
def _controller() -> ThreadpoolController:
    from scipy.linalg import cython_blas  # noqa: F401 (its library has to be loaded to be found)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
