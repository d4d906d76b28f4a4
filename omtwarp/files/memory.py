"""Bounds on what a process may allocate, which Linux alone enforces."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

from omtwarp.errors import OmtwarpError
from omtwarp.files.limits import amount

ROOM, TIMES = 2**32, 64  # bytes that any file may take to parse, and those for each of its bytes: OBJ takes about 30


def address_space() -> int:
    """Return the bytes of a process' address space, on Linux."""
    import resource

    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


@contextlib.contextmanager
def memory_for_file(size: int) -> Iterator[None]:
    """Bound what is allocated while a file is parsed, so that a number in it that is too large gives an error line.

    Args:
        size: bytes of the file.

    Raises:
        OmtwarpError: the parser asked for more.
    """
    if sys.platform != "linux":
        yield
        return
    import resource

    before, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = ROOM + TIMES * size
    limits = [limit for limit in (before, hard, address_space() + most) if limit != resource.RLIM_INFINITY]
    resource.setrlimit(resource.RLIMIT_AS, (min(limits), hard))
    try:
        yield
    except MemoryError:
        if min(limits) == before:  # of the caller's
            raise
        raise OmtwarpError(f"damaged: asks for more than {amount(most)} of memory, with {amount(size)} there") from None
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (before, hard))
