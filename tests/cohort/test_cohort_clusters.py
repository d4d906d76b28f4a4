"""Cohorts on other engines: Dask with real processes, one of them killed, and submitit's local one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import pytest
from test_cohort import journal, linux, wait_for, write_shapes

from omtwarp.cohort import read_manifest, run_cohort


@linux
def test_dask_goes_on_when_a_worker_is_killed(tmp_path):
    pytest.importorskip("distributed")
    write_shapes(tmp_path / "in", 14)
    file, out = tmp_path / "scheduler.json", tmp_path / "out"
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "start_new_session": True}
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", "--scheduler-file", str(file), "--no-nanny"]
    worker += ["--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path)]
    started = [subprocess.Popen([*dask, "--host", "127.0.0.1", "--scheduler-file", str(file)], **quiet)]
    try:
        address = wait_for(lambda: file.exists() and json.loads(file.read_text() or "{}").get("address"), "a scheduler")
        started += [subprocess.Popen(worker, **quiet) for _ in range(2)]
        command = [sys.executable, "-m", "omtwarp", "cohort", str(tmp_path / "in"), "-o", str(out), "--json"]
        command += ["--executor", f"dask:{address}", "--device", "cpu", "--until", "conformal"]
        driver = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        wait_for(lambda: len(journal(out)) >= 2 or driver.poll() is not None, "progress")
        os.killpg(started[-1].pid, signal.SIGKILL)
        said, error = driver.communicate(timeout=300)
        assert driver.returncode == 0, error
        assert json.loads(said)["counts"] == {"ok": 14}
        done = journal(out)
        assert len(done) == len(set(done)) == 14
    finally:
        for process in reversed(started):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_submitit_works_on_shares_of_the_items(tmp_path):
    pytest.importorskip("submitit")
    write_shapes(tmp_path / "in", 5)
    (tmp_path / "in" / "bad.ply").write_text("nonsense")
    items = read_manifest(tmp_path / "in")
    result = run_cohort(items, tmp_path / "out", executor="submitit-local", workers=2, until="conformal", device="cpu")
    assert result.counts == {"ok": 5, "error": 1}
    assert len(journal(tmp_path / "out")) == 6
