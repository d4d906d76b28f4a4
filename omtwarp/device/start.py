"""Warp, started once and quietly; every module that defines or launches kernels imports ``wp`` from here.

``import omtwarp`` alone does not import it, and so does not take its time.
"""

import contextlib
import ctypes
import os
import sys
import tempfile
from collections.abc import Iterator

import warp as wp

from omtwarp.errors import OmtwarpError

_NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"


def _has_cuda_driver() -> bool:
    """Return whether the driver's library can be loaded; the names are those that Warp tries."""
    for name in ("nvcuda.dll",) if os.name == "nt" else ("libcuda.so", "libcuda.so.1"):
        with contextlib.suppress(OSError):
            ctypes.CDLL(name)
            return True
    return False


@contextlib.contextmanager
def _without_driver_message() -> Iterator[None]:
    """Suppress one line on standard error, that there is no CUDA driver, which is normal on a machine without a GPU.

    Warp's native code writes it past Python and ``log_level``, so that the file descriptor has to be redirected. Any
    other output in the meantime, from this thread or another, is passed on afterwards.
    """
    try:
        # First of all, since a file opened while standard error is closed would take its number.
        kept = os.dup(2)
    except OSError:  # closed
        yield
        return
    try:
        aside = tempfile.TemporaryFile()
    except OSError:  # no temporary file: the line is not suppressed
        os.close(kept)
        yield
        return
    with aside:
        _flush_stderr()
        os.dup2(aside.fileno(), 2)
        try:
            yield
        finally:
            _flush_stderr()
            os.dup2(kept, 2)
            os.close(kept)
            aside.seek(0)
            rest = b"".join(line for line in aside if _NO_DRIVER not in line)
            while rest:
                try:
                    rest = rest[os.write(2, rest) :]
                except OSError:  # standard error has no reader any more
                    break


def _flush_stderr() -> None:
    with contextlib.suppress(AttributeError, OSError, ValueError):  # there may be none, or a closed one
        sys.stderr.flush()


if wp.config.log_level < wp.LOG_WARNING:
    wp.config.log_level = wp.LOG_WARNING  # no banner in a library; a stricter level set by the caller is kept
try:
    with contextlib.nullcontext() if _has_cuda_driver() else _without_driver_message():
        wp.init()
except OSError as error:
    if error.filename is None:
        raise
    raise OmtwarpError(
        f"compiled kernels cannot be kept in '{error.filename}': {error.strerror}; "
        "name another folder in the environment variable WARP_CACHE_PATH"
    ) from None

# Options of every file of kernels. None is differentiated; the compiler unrolls loops, not the text it is
# given. One header precedes all files and is compiled by every process that compiles kernels, once for every set of
# flags: hence the same flags everywhere. Without the code for bfloat16 it takes two fifths less time, and templates
# instantiated in it are not instantiated again in each file. The limit of inlining is the compiler's own, which Warp
# raises forty times; functions that need inlining request it. None of this changes the results.
#
# Kernels of one index over arrays of one dimension are compiled twice, with and without the assumption that arrays are
# contiguous. That makes short kernels faster. A long one takes two indices, `i, _compiled_once = wp.tid()`, of which
# the second is always 0, and is compiled once. (wp.tid() cannot be called in a function, which could hide this.)
KERNEL_OPTIONS = {
    "enable_backward": False,
    "max_unroll": 0,
    "cpu_compiler_flags": (
        "-march=native -fpch-instantiate-templates -DWP_NO_BFLOAT16="
        " -disable-llvm-verifier -discard-value-names -disable-lifetime-markers"
    ),
}

# Kernels are float64 throughout: a literal 0.5 does not compile against a float64, so the constants live here.
ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))
THREE = wp.constant(wp.float64(3.0))
PI = wp.constant(wp.float64(3.141592653589793))
# In place of infinity: minima begin with it, and what is larger has overflowed.
LARGE = wp.constant(wp.float64(1.0e300))
