"""Limits on the size of inputs and outputs, above those of real work and checked before any work is done.

Memory that a parser may allocate is bounded too, on Linux alone. The limits keep a damaged or hostile file, or a typing
error, from filling memory or running for ever.
"""

import contextlib
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from omtwarp.errors import OmtwarpError

LARGEST_MESH_FILE = 4 * 2**30  # bytes: 80 million triangles as binary PLY, 30 million as OBJ
LARGEST_ARRAYS = 4 * 2**30  # bytes that an .npz may inflate to: a map of 20 million triangles with every stage has 2e9
LARGEST_DIRECTORY = 2**20  # bytes of an .npz's list of arrays, which takes ten times as many: maps have 2e3
MOST_KEPT = 2**29  # bytes of inputs that a command keeps for all who read them: maps of 300,000 triangles have 2e8
LARGEST_REPORT = 256 * 2**20  # bytes of a report's text in an .npz: those of long flows have 1e6
MOST_FACES = 2**25  # triangles: maps of 2 million were measured, and each takes about 1.3 kB of memory
LARGEST_PICTURE_FILE = 2 * 2**30  # bytes: the largest pictures below, uncompressed
LONGEST_SIDE = 32768  # texels of a picture or texture along one side
MOST_TEXELS = 16384 * 16384  # of a picture: what GPUs hold in one texture; NASA's largest Blue Marble is 21600 x 10800
LARGEST_VIEW = 8192  # pixels of a drawn picture along one side
MOST_FRAMES = 3600  # of a film: a minute at 60 per second
MOST_FILM_PIXELS = 2**31  # of all its frames together, which are in memory at a time, 3 bytes each
FRAMES_PER_SECOND = (0.1, 240.0)  # of a film: chosen, from a slide show to the fastest screens


def amount(bytes_: int) -> str:
    """Write a number of bytes for readers, such as ``4.3 GB``."""
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if bytes_ >= size:
            return f"{bytes_ / size:.1f} {unit}"
    return f"{bytes_} bytes"


# The limit belongs to the process: two threads that parse at once would each restore what the other one had set.
_parsing = threading.RLock()
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

    with _parsing:
        before, hard = resource.getrlimit(resource.RLIMIT_AS)
        most = ROOM + TIMES * size
        limits = [limit for limit in (before, hard, address_space() + most) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(limits), hard))
        try:
            yield
        except MemoryError:
            if min(limits) == before:  # of the caller's
                raise
            asked = f"damaged: asks for more than {amount(most)} of memory, with {amount(size)} there"
            raise OmtwarpError(asked) from None
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (before, hard))
