"""Compile every kernel of the package ahead of time: ``python -m omtwarp.device.prewarm [DEVICE ...]``.

Warp compiles a file's kernels when the first of them is launched and keeps them in a cache. Processes that start
together on an empty cache would each compile everything; run this once before them.
"""

import importlib
import re
import sys
import time
from pathlib import Path

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import core_count

PACKAGE = Path(__file__).parent.parent


def kernel_modules() -> list[str]:
    """List the package's modules that define kernels, by reading the files rather than importing them."""
    defines = re.compile(r"^@wp\.kernel\b", re.MULTILINE)
    files = [file for file in sorted(PACKAGE.rglob("*.py")) if defines.search(file.read_text("utf-8"))]
    return [".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts) for file in files]


def prewarm(device: str = "cpu") -> int:
    """Compile and load every kernel of the package on a device; returns the number of modules.

    Args:
        device: ``cpu``, ``cuda`` or ``cuda:N``.
    """
    target = resolve_device(device)
    names = kernel_modules()
    for name in names:
        importlib.import_module(name)
    # Every thread compiles a header of its own, a tenth of the work: a single core is fastest without threads.
    cores = core_count()
    wp.force_load(target, [wp.get_module(name) for name in names], max_workers=cores if cores > 1 else 0)
    return len(names)


def main() -> None:
    for device in sys.argv[1:] or ["cpu"]:
        start = time.perf_counter()
        count = prewarm(device)
        seconds = time.perf_counter() - start
        print(f"kernels of {count} modules ready on {device} after {seconds:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
