"""Every decision between the CPU and CUDA, and between the host and a device."""

import contextlib
import os
from collections.abc import Iterator
from contextvars import ContextVar

from omtwarp.device import Solver, parse_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError, choose

# Launches of fewer threads are not divided on the CPU: waking another core takes as long as it saves. Maps of scans and
# registrations take a tenth less of all cores' time than with 4,096.
SMALLEST_SHARED_LAUNCH = 16_384
HEAVY_LAUNCH = 2_048  # the same of kernels whose threads take a tenth of a microsecond or more
SLOW_LAUNCH = 128  # and where they take several microseconds


def resolve_device(device: str | None = "auto") -> wp.Device:
    """Turn ``auto``, ``cpu``, ``cuda`` or ``cuda:N`` into a Warp device.

    ``auto`` (or ``None``) is the CPU: most steps of a map run on the host, and each of them copies from a CUDA device
    and waits for it.

    Raises:
        OmtwarpError: an unknown device, or CUDA asked for where there is none.
    """
    if isinstance(device, wp.Device):
        return device
    name = parse_device(device)
    if name == "auto":
        return wp.get_device("cpu")
    if asks_for_cuda(name) and not wp.is_cuda_available():
        raise OmtwarpError(f"device '{name}' asked for, but this machine has no usable CUDA device: use device='cpu'")
    try:
        return wp.get_device(name)
    except Exception as error:
        count = wp.get_cuda_device_count()
        raise OmtwarpError(
            f"device '{name}' does not exist: this machine has {count} CUDA device(s), 0 to {count - 1}"
        ) from error


def is_cuda(device: wp.Device) -> bool:
    """Return whether a device has memory of its own; every other question about devices here asks this one."""
    return bool(device.is_cuda)


def asks_for_cuda(device: object) -> bool:
    """Return whether a device's name stands for a CUDA device, without a look at what the machine has."""
    return parse_device(device).startswith("cuda")


_wanted: ContextVar[Solver] = ContextVar("solver", default=Solver.AUTO)
_device: ContextVar[str] = ContextVar("device", default="cuda:0")  # where cuDSS solves


@contextlib.contextmanager
def solving_with(solver: Solver, device: str | None = None) -> Iterator[None]:
    """Select the solver of sparse systems for a computation; ``auto`` does not change the selection.

    Args:
        solver: the solver.
        device: that of the computation, where cuDSS then solves.

    Raises:
        OmtwarpError: cuDSS is asked for on the CPU.
    """
    token = _wanted.set(wanted_solver() if solver is Solver.AUTO else solver)
    place = _device.set(device if asks_for_cuda(device) and device is not None else _device.get())
    try:
        if solves_with_cudss() and device is not None and not asks_for_cuda(device):
            raise OmtwarpError("the solver cudss runs on a GPU: use device='cuda', or another solver")
        yield
    finally:
        _device.reset(place)
        _wanted.reset(token)


def wanted_solver() -> Solver:
    """Return the selected solver: that of :func:`solving_with`, of the variable ``OMTWARP_SOLVER``, or ``auto``.

    Raises:
        OmtwarpError: the variable holds something else than a solver's name.
    """
    asked = _wanted.get()
    return asked if asked is not Solver.AUTO else choose(Solver, os.environ.get("OMTWARP_SOLVER") or "auto")


def solves_with_scipy() -> bool:
    """Return whether the host factorises by SciPy rather than by the built-in, several times faster solver."""
    return wanted_solver() is Solver.SCIPY


def solves_with_cudss() -> bool:
    """Return whether systems on whole surfaces are factorised on a GPU by cuDSS; the host keeps small patches."""
    return wanted_solver() is Solver.CUDSS


def solver_device() -> wp.Device:
    """Return the device on which cuDSS solves: that of the computation.

    Raises:
        OmtwarpError: it does not exist.
    """
    return resolve_device(_device.get())


def shares_host_memory(device: wp.Device) -> bool:
    """Return whether kernels read NumPy's arrays without a copy.

    NumPy then takes sums, faster than a kernel on one core without vector instructions, and workspace is shared.
    """
    return not is_cuda(device)


def records_graphs(device: wp.Device) -> bool:
    """Return whether loops are recorded as graphs: on CUDA where its driver knows conditions in them (12.4).

    Never on the CPU, where other threads' launches would end up in the recording.
    """
    return is_cuda(device) and bool(wp.is_conditional_graph_supported())


def launch_parts_of(device: wp.Device, count: int, cores: int, least: int = SMALLEST_SHARED_LAUNCH) -> int:
    """Return the number of parts of a launch of independent threads: one for every core of a CPU, one on CUDA."""
    return 1 if is_cuda(device) or count < least else cores
