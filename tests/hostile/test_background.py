"""A job in the background, which ignores Ctrl-C, leaves nothing behind when it is asked to terminate."""

import os
import signal
import subprocess
import sys

import pytest

WAITING = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
from omtwarp.files.output import scratch
with scratch() as folder:
    print(folder, flush=True)
    time.sleep(60)
"""


@pytest.mark.skipif(os.name != "posix", reason="Windows has no SIGTERM")
def test_a_temporary_folder_goes_with_its_process():
    with subprocess.Popen([sys.executable, "-c", WAITING], stdout=subprocess.PIPE, text=True) as job:
        folder = job.stdout.readline().strip()
        assert os.path.isdir(folder)
        job.terminate()
        assert job.wait(30) == -signal.SIGTERM
    assert not os.path.exists(folder)
