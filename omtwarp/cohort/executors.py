"""Executors of items: processes of this machine, a Dask cluster, or Slurm through submitit, with one interface."""

import contextlib
import json
import os
import subprocess
import threading
from collections.abc import Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from omtwarp.cohort.item import CRASHED, MEMORY, TIMEOUT, Job, Row, read_record, settle
from omtwarp.errors import OmtwarpError, installed
from omtwarp.files.interruptions import interpreter, safe_paths
from omtwarp.files.output import make_folder

ATTEMPTS = 2  # an item whose process was killed from outside is tried once more


class Stopped(Exception):
    """The run that an item belongs to was given up."""


class Host:
    """A process that forks for every item, see :mod:`omtwarp.cohort.host`; started when it is first needed."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._stopped = threading.Event()

    def run(self, job: Job) -> Row:
        """Compute an item in a process of its own, and return its record, also of a failure.

        Raises:
            Stopped: the run was given up; the item has no record, so that the next run computes it.
        """
        died = 0
        for _ in range(ATTEMPTS):
            exit_status, late = self._attempt(job)
            record = read_record(job)
            if record is not None:
                return record
            if self._stopped.is_set():
                raise Stopped
            if late:
                return settle(job, TIMEOUT, f"took longer than {job.time_limit:g} s", seconds=job.time_limit)
            died = -exit_status
        if died == 9 and job.memory_limit:
            return settle(job, MEMORY, "was killed twice, most likely for want of memory")
        return settle(job, CRASHED, f"its process ended by signal {died}, {ATTEMPTS} times")

    def _attempt(self, job: Job) -> tuple[int, bool]:
        process = self._started()
        assert process.stdin is not None and process.stdout is not None
        overdue = threading.Event()

        def end() -> None:
            overdue.set()
            process.kill()

        # Grace: seconds that a host may take to load, and to end an item that exceeds its time
        timer = threading.Timer(job.time_limit + 30.0, end)
        timer.daemon = True
        timer.start()
        try:
            process.stdin.write(job.to_json() + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except OSError:  # it has died before
            line = ""
        finally:
            timer.cancel()
        if line:
            answer = json.loads(line)
            return int(answer["exit"]), bool(answer["timeout"])
        self.close()
        return -9, overdue.is_set()

    def _started(self) -> subprocess.Popen[str]:
        if self._process is not None and self._process.poll() is not None:
            self.close()
        if self._process is None:
            self._process = subprocess.Popen(
                interpreter("from omtwarp.cohort.host import main; main()"),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                start_new_session=True,  # the driver handles interruptions
                env=os.environ | {"OMTWARP_THREADS": "1"},
            )
            if self._stopped.is_set():  # by another thread, which may not have seen the process
                self.close()
                raise Stopped
        return self._process

    def stop(self) -> None:
        """End the item at work and the process, called by another thread than that of :meth:`run`."""
        self._stopped.set()
        # Seconds that a host has to end its item where the run is interrupted: it does so at once, but while it loads.
        self._end(self._process, 1.0)

    def close(self) -> None:
        """End the child process."""
        process, self._process = self._process, None
        self._end(process, 2.0)
        if process is not None and process.stdout is not None:
            process.wait()
            process.stdout.close()

    @staticmethod
    def _end(process: subprocess.Popen[str] | None, seconds: float) -> None:
        if process is None or process.stdin is None:
            return
        with contextlib.suppress(OSError):
            process.stdin.close()  # by which the process knows, and ends its item
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(seconds)
        process.kill()


_own = threading.local()  # the host of each thread


class LocalPool:
    """Processes on this machine.

    Args:
        workers: how many items are worked on at once, by a thread each.
    """

    def __init__(self, workers: int):
        self._workers = workers

    def records(self, jobs: Sequence[Job]) -> Generator[Row, None, None]:
        """Yield the records of all jobs, in the order in which these finish; closing it ends what is at work."""
        hosts: list[Host] = []

        def begin() -> None:
            _own.host = Host()
            hosts.append(_own.host)

        pool = ThreadPoolExecutor(self._workers, initializer=begin)
        try:
            for record in as_completed([pool.submit(run_job, job.to_json()) for job in jobs]):
                yield record.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for host in hosts:
                host.stop()
            pool.shutdown()
            for host in hosts:
                host.close()


def run_job(line: str) -> Row:
    """Compute one job, in a process of its own; the thread keeps its host for the next."""
    if not hasattr(_own, "host"):
        _own.host = Host()
    job = Job.from_json(line)
    make_folders(Path(job.folder))
    return _own.host.run(job)


def run_jobs(lines: list[str]) -> list[Row]:
    """Compute several jobs one after the other, and end all processes."""
    try:
        return [run_job(line) for line in lines]
    finally:
        _own.host.close()


def make_folders(folder: Path) -> None:
    """Make the folders of a cohort's results.

    Raises:
        OmtwarpError: the folders cannot be made.
    """
    for name in ("records", "maps", "locks"):
        make_folder(folder / name)


class DaskCluster:
    """A Dask cluster, which gives the items of a worker that dies to another one.

    Args:
        address: of its scheduler; empty for a cluster of processes here.
        workers: of the cluster here.

    Raises:
        OmtwarpError: Dask is not installed, or there is no scheduler.
    """

    def __init__(self, address: str, workers: int):
        with installed("Dask is not installed", "dask"):
            from distributed import Client, LocalCluster
        self._safe = contextlib.ExitStack()  # as long as the cluster may start a worker again
        self._safe.enter_context(safe_paths())
        try:
            if address:
                self._client = Client(address, timeout=20)
            else:
                self._client = Client(LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None))
        except (OSError, ValueError) as error:
            self._safe.close()
            raise OmtwarpError(f"no Dask scheduler answers at '{address}': {str(error).splitlines()[0]}") from None

    def records(self, jobs: Sequence[Job]) -> Generator[Row, None, None]:
        from distributed import as_completed

        futures = self._client.map(run_job, [job.to_json() for job in jobs], pure=False, retries=ATTEMPTS)
        by_key = {future.key: job for future, job in zip(futures, jobs, strict=True)}
        try:
            for future in as_completed(futures):
                job = by_key[future.key]
                if future.status == "finished":
                    yield future.result()
                else:
                    yield settle(job, CRASHED, f"Dask gave it up: {future.exception()}")
                future.release()
        finally:
            self._client.close()
            self._safe.close()


class SubmititArray:
    """Jobs of Slurm through submitit, or its local executor.

    Args:
        cluster: ``slurm`` or ``local``.
        folder: where submitit keeps its files.
        workers: the most jobs at once; each works on its share of the items, one after the other.

    Raises:
        OmtwarpError: submitit is not installed, or there is no Slurm here.
    """

    def __init__(self, cluster: str, folder: Path, workers: int):
        with installed("submitit is not installed", "slurm"):
            import submitit
        try:
            self._executor = submitit.AutoExecutor(folder=folder / "submitit", cluster=cluster)
        except Exception as error:
            raise OmtwarpError(f"submitit cannot use '{cluster}': {error}") from None
        self._workers = workers

    def records(self, jobs: Sequence[Job]) -> Generator[Row, None, None]:
        import submitit

        shares = [share for k in range(self._workers) if (share := list(jobs[k :: self._workers]))]
        longest = max(sum(job.time_limit for job in share) for share in shares)
        memory = max(job.memory_limit for job in jobs)
        limits: dict[str, float] = {"timeout_min": max(1, round(longest / 60) + 2), "cpus_per_task": 1}
        if memory:
            limits["mem_gb"] = memory / 2**30 + 2.0
        self._executor.update_parameters(name="omtwarp-cohort", **limits)
        with safe_paths():
            running = self._executor.map_array(run_jobs, [[job.to_json() for job in share] for share in shares])
        by_id = {task.job_id: share for task, share in zip(running, shares, strict=True)}
        for task in submitit.helpers.as_completed(running, poll_frequency=1):
            failed = task.exception()
            for job in by_id[task.job_id]:
                yield settle(job, CRASHED, f"its job {task.job_id} ended: {failed}")


def executor_for(name: str, folder: Path, workers: int) -> LocalPool | DaskCluster | SubmititArray:
    """Return the executor of a name: ``local``, ``dask``, ``dask:ADDRESS``, ``slurm`` or ``submitit-local``.

    Raises:
        OmtwarpError: another name, or what it needs is not installed.
    """
    if name == "local":
        return LocalPool(workers)
    if name == "dask" or name.startswith("dask:"):
        return DaskCluster(name.partition(":")[2], workers)
    if name in ("slurm", "submitit-local"):
        return SubmititArray("local" if name == "submitit-local" else "slurm", folder, workers)
    raise OmtwarpError(f"unknown executor '{name}': use local, dask, dask:ADDRESS, slurm or submitit-local")
