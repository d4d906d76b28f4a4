"""What all tests share: the device fixture, strict launches, repeatable properties and no network."""

from __future__ import annotations

import gc
import os
import socket
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

if TYPE_CHECKING:
    from fake_device import FakeDevice

# Kernels compiled by the tests stay in the checkout. Before anything imports Warp.
os.environ.setdefault("WARP_CACHE_PATH", str(Path(__file__).parent.parent / ".warp"))

# The same examples on every run, and no clock: a busy machine must not turn a green test red.
settings.register_profile(
    "omtwarp", derandomize=True, deadline=None, max_examples=25, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("omtwarp")


def pytest_configure(config: pytest.Config) -> None:
    """Make a launch with an array of another device an error in every test."""
    import warp

    warp.config.launch_array_access_mode = warp.config.LaunchArrayAccessMode.STRICT
    gc.disable()  # until all tests are collected


def pytest_collection_finish() -> None:
    """Keep the half a million objects that tests are collected as out of collections of garbage: 5 % of the time."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeDevice:
    """Make ``cuda:0`` a device that is a CPU to Warp and CUDA to the package, where there is none."""
    from fake_device import install

    from omtwarp.device.start import wp

    if wp.is_cuda_available():
        pytest.skip("this machine has a CUDA device")  # of the same name, under which surfaces keep their arrays
    return install(monkeypatch)


@pytest.fixture
def library(fake, monkeypatch):
    """cuDSS by SciPy, on the fake device."""
    from fake_cudss import FakeCudss

    made = FakeCudss()
    monkeypatch.setattr("omtwarp.solvers.cudss.load_library", lambda: made)
    return made


@pytest.fixture(params=["cpu", "fake", pytest.param("cuda", marks=pytest.mark.cuda)])
def device(request: pytest.FixtureRequest) -> str:
    """Run a test on the CPU, on a fake device, and on the first CUDA device where there is one."""
    if request.param == "cpu":
        return "cpu"
    if request.param == "fake":
        request.getfixturevalue("fake")
        return "cuda:0"
    from omtwarp.device.start import wp

    if not wp.is_cuda_available():
        pytest.skip("no CUDA device on this machine")
    return "cuda:0"


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make pictures of few pixels where a command chooses their size."""
    from small_pictures import shrink

    shrink(monkeypatch.setattr)


@pytest.fixture
def smallest_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make pictures of few pixels whatever size is asked for, where a test is about what runs."""
    from small_pictures import shrink_all

    shrink_all(monkeypatch.setattr)


@pytest.fixture
def short_warps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take few steps in registrations, where a test is not about how well these do."""
    from small_pictures import shorten

    shorten(monkeypatch.setattr)


@pytest.fixture
def items_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute items of cohorts in this process, where a test is not about processes, which take a second to begin."""
    from omtwarp.cohort.executors import Host
    from omtwarp.cohort.host import run_item

    monkeypatch.setattr(Host, "run", lambda host, job: run_item(replace(job, memory_limit=0)))


@pytest.fixture(autouse=True)
def _no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail every connection to the network that the package or a test attempts."""
    connect = socket.socket.connect

    def local_only(self: socket.socket, address):
        if self.family in (socket.AF_INET, socket.AF_INET6):
            raise AssertionError(f"a test tried to connect to {address}")
        return connect(self, address)

    monkeypatch.setattr(socket.socket, "connect", local_only)
