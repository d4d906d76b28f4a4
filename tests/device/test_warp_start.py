"""Warp starts without messages, and other output is not lost."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from omtwarp.device.start import _NO_DRIVER, _has_cuda_driver, _without_driver_message

ROOT = Path(__file__).resolve().parents[2]
START = "from omtwarp.device.start import wp; print(wp.get_device('cpu'))"


def python(code: str, *before: str) -> subprocess.CompletedProcess:
    command = [*before, sys.executable, "-c", code]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)


def test_the_start_is_quiet():
    done = python(START)
    assert (done.returncode, done.stdout, done.stderr) == (0, "cpu\n", "")


@pytest.mark.skipif(os.name != "posix", reason="closes a file descriptor before the start")
def test_the_start_works_without_standard_error():
    """Warp starts with standard error closed, and writes nothing into a file that got its descriptor's number."""
    done = python(START, "sh", "-c", 'exec "$0" "$@" 2>&-')
    assert (done.returncode, done.stdout) == (0, "cpu\n")


def test_the_start_works_without_a_stderr_object():
    done = python(f"import sys; sys.stderr = None\n{START}")
    assert (done.returncode, done.stdout, done.stderr) == (0, "cpu\n", "")


def test_only_the_line_about_the_driver_is_dropped(capfd):
    with _without_driver_message():
        os.write(2, b"Warp CUDA error: something is broken\n")
        os.write(2, b"Warp CUDA warning: " + _NO_DRIVER + b". GPU execution will not be available.\n")
        os.write(2, b"and a last one without an end")
    os.write(2, b", which goes on\n")
    assert capfd.readouterr().err.splitlines() == [
        "Warp CUDA error: something is broken",
        "and a last one without an end, which goes on",
    ]


def test_what_was_said_before_a_failure_is_passed_on(capfd):
    with pytest.raises(RuntimeError), _without_driver_message():
        os.write(2, b"why\n")
        raise RuntimeError
    assert capfd.readouterr().err == "why\n"


def test_descriptors_are_given_back():
    if not Path("/dev/fd").is_dir():
        pytest.skip("no list of open files")
    before = sorted(os.listdir("/dev/fd"))
    with _without_driver_message():
        pass
    assert sorted(os.listdir("/dev/fd")) == before


@pytest.mark.skipif(_has_cuda_driver(), reason="needs a machine without a CUDA driver")
def test_the_line_is_the_one_that_warp_writes():
    """The suppressed line is the one that Warp writes; this fails if Warp changes its words."""
    done = python("import warp; warp.init()")
    assert _NO_DRIVER.decode() in done.stderr
