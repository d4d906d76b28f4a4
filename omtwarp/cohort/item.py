"""One item of a cohort: what is asked for, what became of it, and the work itself."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from omtwarp.errors import OmtwarpError
from omtwarp.files import staged
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.repair import repair
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.pipeline import map_to_sphere
from omtwarp.result import MapResult
from omtwarp.version import package_version

# Statuses of a record; all but the first are failures.
OK, ERROR, TIMEOUT, MEMORY, CRASHED = "ok", "error", "timeout", "memory", "crashed"


@dataclass(frozen=True)
class Job:
    """Everything that a process needs to know to work on an item.

    Attributes:
        id: the item's name.
        path: of its mesh.
        folder: of the cohort's results.
        key: hash of input, options and version; a record with the same key is final.
        options: of :func:`omtwarp.map_to_sphere`, and ``repair``.
        time_limit: seconds.
        memory_limit: bytes that the item may allocate beyond what the process starts with; 0 for no limit.
    """

    id: str
    path: str
    folder: str
    key: str
    options: dict[str, Any]
    time_limit: float
    memory_limit: int = 0

    @property
    def record_file(self) -> Path:
        """Where the record of the item stands."""
        return Path(self.folder) / "records" / f"{self.id}.json"

    @property
    def map_file(self) -> Path:
        """Where the map stands."""
        return Path(self.folder) / "maps" / f"{self.id}.npz"

    def to_json(self) -> str:
        """The job as one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> Job:
        """The inverse of :meth:`to_json`."""
        return cls(**json.loads(line))


def key_of(path: str | os.PathLike[str], options: dict[str, Any]) -> str:
    """Hash what a result depends on: the input's bytes (or that there are none), the options and the version."""
    digest = hashlib.sha256(json.dumps([package_version(), options], sort_keys=True).encode())
    try:
        with open(path, "rb") as stream:
            for block in iter(lambda: stream.read(1 << 20), b""):
                digest.update(block)
    except OSError as error:
        digest.update(f"missing {error.errno}".encode())
    return digest.hexdigest()


def read_record(job: Job) -> dict[str, Any] | None:
    """The finished record of a job, or None where there is none or it is of other input, options or version."""
    try:
        record = json.loads(job.record_file.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    whole = isinstance(record, dict) and record.get("key") == job.key
    return record if whole and (record.get("status") != OK or job.map_file.exists()) else None


def write_record(job: Job, status: str, message: str = "", **numbers: Any) -> dict[str, Any]:
    """Write what became of an item, in one step, and a line in the journal; the caller holds the item's lock.

    Where the process dies between the two, :func:`complete_journal` adds the line.
    """
    record = {"id": job.id, "path": job.path, "key": job.key, "status": status, "version": package_version()}
    record |= {"message": " ".join(message.split()), **numbers}
    with staged(job.record_file) as file:
        file.write_text(json.dumps(record, indent=1), "utf-8")
    _append_to_journal(job, status)
    return record


def settle(job: Job, status: str, message: str, **numbers: Any) -> dict[str, Any]:
    """Record a failure that was seen from outside, unless a process that worked on the item has written a record."""
    with _locked(job):
        return read_record(job) or write_record(job, status, message, **numbers)


def forget_failure(job: Job) -> None:
    """Remove the record of an item that failed, so that it is worked on again; never that of one which succeeded."""
    with _locked(job):
        record = read_record(job)
        if record is not None and record["status"] != OK:
            job.record_file.unlink(missing_ok=True)


def read_journal(folder: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The lines of a cohort's journal, without those that are not whole."""
    try:
        lines = (Path(folder) / "journal.jsonl").read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
    entries = []
    for line in lines:
        with contextlib.suppress(ValueError):
            entry = json.loads(line)
            if isinstance(entry, dict):
                entries.append(entry)
    return entries


def complete_journal(jobs: Iterable[Job], folder: str | os.PathLike[str]) -> None:
    """Add the journal's lines of processes that were killed after they had written their record."""
    known = {(entry.get("id"), entry.get("key"), entry.get("status")) for entry in read_journal(folder)}
    for job in jobs:
        record = read_record(job)
        if record is None or (job.id, job.key, record["status"]) in known:
            continue
        with _locked(job):  # whoever held the lock has written the line, or is dead
            lines = {(entry.get("id"), entry.get("key"), entry.get("status")) for entry in read_journal(folder)}
            if (job.id, job.key, record["status"]) not in lines:
                _append_to_journal(job, record["status"])


def _append_to_journal(job: Job, status: str) -> None:
    """Append a line in one write, which processes that append at the same time do not mix."""
    line = json.dumps({"id": job.id, "key": job.key, "status": status, "time": time.time(), "process": os.getpid()})
    with open(Path(job.folder) / "journal.jsonl", "ab+", buffering=0) as journal:
        torn = False  # the disk was full, or the machine stopped, in the middle of the last line
        if journal.seek(0, os.SEEK_END):
            journal.seek(-1, os.SEEK_END)
            torn = journal.read(1) != b"\n"
        journal.write((b"\n" if torn else b"") + line.encode() + b"\n")


def run_item(job: Job) -> dict[str, Any]:
    """Map an item and write its record, unless there is one already; the process is expected to end afterwards."""
    with _locked(job):
        finished = read_record(job)
        if finished is not None:
            return finished
        _limit_memory(job.memory_limit)
        begun, used = time.perf_counter(), time.process_time()
        try:
            numbers, status, message = _map(job), OK, ""
        except MemoryError:
            numbers, status, message = {}, MEMORY, f"needs more than {job.memory_limit / 2**30:.3g} GiB of memory"
        except OmtwarpError as error:
            numbers, status, message = {}, ERROR, str(error)
        except Exception as error:
            numbers, status, message = {}, ERROR, f"internal error, {type(error).__name__}: {error}"
        numbers |= {"seconds": time.perf_counter() - begun, "cpu_seconds": time.process_time() - used}
        return write_record(job, status, message, **numbers, memory=_peak_memory())


def _map(job: Job) -> dict[str, Any]:
    options = dict(job.options)
    mended = options.pop("repair", False)
    mesh = read_mesh(Path(job.path), triangulate=mended)
    vertices, faces = mesh.vertices, mesh.faces
    if mended:
        repaired = repair(vertices, faces)
        vertices, faces = repaired.vertices, repaired.faces
    result = map_to_sphere((vertices, faces), **options)
    result.save(job.map_file)
    return numbers_of(result)


def numbers_of(result: MapResult) -> dict[str, Any]:
    """Collect a table's numbers of a map: sizes, flips, degree, distortions, and the cost above its lower bound."""
    last = result.report["stages"][-1]
    surface = Surface(result.vertices, result.faces, result.measure)
    image = triangle_areas(result.sphere, surface.faces)
    around = surface.sum_to_vertices(image) / 3.0 * (SPHERE_AREA / image.sum()) / surface.vertex_areas
    return {
        "vertices": surface.vertex_count,
        "faces": surface.face_count,
        "flips": result.report["certificate"]["flips"],
        "degree": last["degree"],
        "area": last["area"]["surface"],
        "area_p95": last["area"]["p95"],
        "angle": last["angle"]["surface"],
        "ring": float(np.sqrt(np.average((around - 1.0) ** 2, weights=surface.vertex_areas))),
        "gap": result.report.get("optimality", {}).get("gap"),
    }


@contextlib.contextmanager
def _locked(job: Job) -> Iterator[None]:
    """Hold the item while it is worked on: another process waits, and then finds the record. Released by any death."""
    try:
        import fcntl
    except ImportError:  # there is none on Windows, where two drivers on one folder are not kept apart
        yield
        return
    place = Path(job.folder) / "locks" / job.id
    with open(place, "w") as file:
        with contextlib.suppress(OSError):  # some network file systems have no locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _limit_memory(limit: int) -> None:
    """Let the process allocate so many more bytes; on Linux, where the kernel keeps account of them."""
    if limit and sys.platform == "linux":
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + limit,) * 2)


def _peak_memory() -> int:
    """The most memory that the process has held, bytes; 0 where that is not known."""
    if sys.platform == "win32":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


__all__ = [
    "Job",
    "complete_journal",
    "forget_failure",
    "key_of",
    "numbers_of",
    "read_journal",
    "read_record",
    "run_item",
    "settle",
    "write_record",
]
