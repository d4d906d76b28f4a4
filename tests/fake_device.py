"""A device ``cuda:0`` for machines without one: a CPU to Warp, and CUDA to the package.

To Warp it is a second CPU, so that kernels run on it, arrays of one device are refused by launches on the other, and
NumPy's arrays are copied on the way there and back. To :mod:`omtwarp.device.policy` it is CUDA, so that the package
goes the ways that it would go there. What it cannot show are races, round-off of another compiler, and graphs.

Of Warp's own insides it needs the table of devices alone; the rest are functions and classes that Warp documents.
"""

from __future__ import annotations

import inspect
from collections import Counter
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

import pytest

from omtwarp.device import policy
from omtwarp.device.start import wp


class FakeDevice(wp.Device):
    """A CPU that is equal to no other device.

    Attributes:
        downloads: how often the host has read from the device, by place in the package: file and line.
        uploads: how often it has written to it.
    """

    def __init__(self) -> None:
        super().__init__(wp.get_device("cpu").runtime, "cuda:0")
        self.downloads: Counter[str] = Counter()
        self.uploads: Counter[str] = Counter()

    def __eq__(self, other: object) -> bool:
        return other == self.alias if isinstance(other, str) else self is other

    def __hash__(self) -> int:
        return id(self)

    @property
    def stream(self) -> SimpleNamespace:
        """What a library that works on the device's stream is given."""
        return SimpleNamespace(cuda_stream=0)


@cache
def _the_device() -> FakeDevice:
    """Return the one fake device of a process: surfaces that several tests share keep arrays on it."""
    return FakeDevice()


def install(monkeypatch: pytest.MonkeyPatch) -> FakeDevice:
    """Make ``cuda:0`` a fake device, with nothing counted yet, until the end of a test."""
    fake = _the_device()
    fake.downloads.clear()
    fake.uploads.clear()
    for name in ("cuda", "cuda:0", fake):
        monkeypatch.setitem(fake.runtime.device_map, name, fake)
    monkeypatch.setattr(wp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(wp, "get_cuda_device_count", lambda: 1)
    monkeypatch.setattr(policy, "is_cuda", lambda device: device is fake or bool(device.is_cuda))
    initialise, copy, repeat = wp.array.__init__, wp.copy, wp.capture_while

    def initialise_apart(self: wp.array, data: Any = None, *rest: Any, **options: Any) -> None:
        """Copy data of NumPy's also where the caller allows the array to share its memory: CUDA cannot."""
        if data is not None and options.get("device") is not None and wp.get_device(options["device"]) is fake:
            options["copy"] = True
        initialise(self, data, *rest, **options)

    def copy_counted(dest: wp.array, src: wp.array, *rest: Any, **options: Any) -> None:
        """Count what crosses between host and device; all of Warp's conversions end here."""
        if dest.device != src.device:
            (fake.uploads if dest.device is fake else fake.downloads)[place()] += 1
            if not src.is_contiguous:
                src = src.contiguous()
        copy(dest, src, *rest, **options)

    def repeat_counted(condition: wp.array, body: Callable[..., None], **options: Any) -> None:
        """Count a read of the condition before every turn of a loop that is not recorded."""
        if condition.device is fake:
            if condition.size != 1:  # Warp copies it into an array of one element
                raise RuntimeError(f"a condition of {condition.size} elements")
            at = place()

            def turn(**options: Any) -> None:
                fake.downloads[at] += 1
                body(**options)

            repeat(condition, turn, **options)
        else:
            repeat(condition, body, **options)

    monkeypatch.setattr(wp.array, "__init__", initialise_apart)
    monkeypatch.setattr(wp, "copy", copy_counted)
    monkeypatch.setattr(wp, "capture_while", repeat_counted)
    return fake


def place() -> str:
    """Return the innermost file and line of the package that is being run."""
    frame = inspect.currentframe()
    while frame is not None:
        module = str(frame.f_globals.get("__name__", ""))
        if module.startswith("omtwarp"):
            return f"{module}:{frame.f_lineno}"
        frame = frame.f_back
    return "outside of the package"
