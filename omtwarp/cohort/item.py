"""One item of a cohort: its job, record, lock and journal, without modules that load Warp."""

import contextlib
import hashlib
import json
import os
import stat
import time
import zipfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

from omtwarp.files import output
from omtwarp.version import package_version

Row: TypeAlias = dict[str, str | float | None]
"""What is known of an item, by the names of a table's columns."""

# Statuses of a record; all but the first are failures.
OK, ERROR, TIMEOUT, MEMORY, CRASHED = "ok", "error", "timeout", "memory", "crashed"


# Numbers in a record, and in a table's columns.
WHOLE = ("vertices", "faces", "flips", "memory", "map_size")
NUMBERS = ("degree", "area", "area_p95", "angle", "ring", "gap", "seconds", "cpu_seconds")
# Numbers of a registration, as :meth:`omtwarp.registration.Registration.facts` has them.
OF_REGISTRATION = tuple(
    f"registration_{name}"
    for name in ("score", "margin", "doubtful", "flips", "degree", "area_p95", "stretch_p95", "strain", "sulc", "curv")
)
REAL = (*NUMBERS, *OF_REGISTRATION)  # columns of real numbers


@dataclass(frozen=True)
class Job:
    """Everything that a process needs to compute an item.

    Attributes:
        id: the item's name.
        path: of its mesh.
        folder: of the cohort's results.
        key: hash of input, options and version; a record with the same key is final.
        options: of :func:`omtwarp.map_to_sphere`, ``repair``, ``fill_area`` where holes are filled, and the target of
            ``register`` where maps are registered.
        time_limit: seconds.
        memory_limit: bytes that the item may allocate beyond what the process starts with; 0 for no limit.
    """

    id: str
    path: str
    folder: str
    key: str
    options: dict[str, object]
    time_limit: float
    memory_limit: int = 0

    @property
    def record_file(self) -> Path:
        """The path of the item's record."""
        return Path(self.folder) / "records" / f"{self.id}.json"

    @property
    def map_file(self) -> Path:
        """The path of the map."""
        return Path(self.folder) / "maps" / f"{self.id}.npz"

    def to_json(self) -> str:
        """Return the job as one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> "Job":
        """Read a job from its line: the inverse of :meth:`to_json`."""
        return cls(**json.loads(line))


def key_of(path: str | os.PathLike[str], options: dict[str, object]) -> str:
    """Hash what a result depends on: the input's bytes (or that there are none), the options and the version."""
    digest = hashlib.sha256(json.dumps([package_version(), options], sort_keys=True).encode())
    try:
        # Without waiting for a pipe's writer, and without the content of a device, which may have no end.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        with open(descriptor, "rb") as stream:
            regular = stat.S_ISREG(os.fstat(descriptor).st_mode)
            for block in iter(lambda: stream.read(1 << 20) if regular else b"", b""):
                digest.update(block)
    except OSError as error:
        digest.update(f"missing {error.errno}".encode())
    return digest.hexdigest()


def read_record(job: Job) -> Row | None:
    """Return the finished record of a job; None where there is none, or it is of other input, options, version or map.

    A map that is gone, cut short or changed since it was recorded is none, and its item is not done.
    """
    record = _any_record(job)
    if record is None or record.get("key") != job.key:
        return None
    return record if record["status"] != OK or _is_recorded(job.map_file, record) else None


def _any_record(job: Job) -> Row | None:
    """Return the record of an item, of whatever input, options and version; None where there is none."""
    try:
        record = json.loads(job.record_file.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and _well_typed(record) else None


def _is_recorded(map_file: Path, record: Row) -> bool:
    """Return whether a map is there with the size and digest that a record has of it."""
    try:
        there = map_file.stat()
        return (
            stat.S_ISREG(there.st_mode)
            and there.st_size == record.get("map_size")
            and output.digest_of(map_file) == record.get("map_digest")
        )
    except OSError:
        return False


def may_write_map(job: Job) -> bool:
    """Return whether the place of an item's map is free, or holds a map that a record has, or what is left of one.

    What is left is shorter than recorded and no longer an archive. Any other file is somebody's own.
    """
    if not os.path.lexists(job.map_file):
        return True
    record = _any_record(job)
    if record is None or job.map_file.is_symlink() or not job.map_file.is_file():
        return False
    size = record.get("map_size")
    cut = isinstance(size, int) and job.map_file.stat().st_size < size and not zipfile.is_zipfile(job.map_file)
    return cut or _is_recorded(job.map_file, record)


def _well_typed(record: dict[str, object]) -> bool:
    """Return whether a record has a status, and numbers and texts where they belong."""
    return record.get("status") in (OK, ERROR, TIMEOUT, MEMORY, CRASHED) and all(
        value is None or isinstance(value, int | float if name in (*WHOLE, *REAL) else str)
        for name, value in record.items()
    )


def write_record(job: Job, status: str, message: str = "", **numbers: str | float | None) -> Row:
    """Write the record of an item atomically; the caller holds the item's lock, and enters it in the journal.

    A map of before goes with its record, so that no map is without one. That of the new record is moved to its place
    afterwards: where the process dies in between, there is no map, and the item is not done.
    """
    record: Row = {"id": job.id, "path": job.path, "key": job.key, "status": status, "version": package_version()}
    record |= {"message": " ".join(message.split()), **numbers}
    before = _any_record(job)
    if before is not None and _is_recorded(job.map_file, before):
        job.map_file.unlink(missing_ok=True)
    output.write_text(job.record_file, json.dumps(record, indent=1))
    return record


def settle(job: Job, status: str, message: str, **numbers: str | float | None) -> Row:
    """Record a failure that was seen from outside, unless a process that worked on the item has written a record."""
    with locked(job):
        record = read_record(job)
        if record is None:
            record = write_record(job, status, message, **numbers)
            append_to_journal(job, status)
        return record


def forget_failure(job: Job) -> None:
    """Remove the record of an item that failed, so that it is worked on again; never that of one which succeeded."""
    with locked(job):
        record = read_record(job)
        if record is not None and record["status"] != OK:
            job.record_file.unlink(missing_ok=True)


def read_journal(folder: str | os.PathLike[str]) -> list[Row]:
    """Return the lines of a cohort's journal, without those that are not whole."""
    try:
        lines = (Path(folder) / "journal.jsonl").read_text("utf-8", "replace").splitlines()
    except OSError:
        return []
    entries = []
    for line in lines:
        with contextlib.suppress(ValueError):
            entry = json.loads(line)
            if isinstance(entry, dict) and all(isinstance(entry.get(name), str) for name in ("id", "key", "status")):
                entries.append(entry)
    return entries


def complete_journal(jobs: Iterable[Job], folder: str | os.PathLike[str]) -> None:
    """Add the journal's lines of processes that were killed after they had written their record."""
    known = {(entry.get("id"), entry.get("key"), entry.get("status")) for entry in read_journal(folder)}
    for job in jobs:
        record = read_record(job)
        if record is None or (job.id, job.key, record["status"]) in known:
            continue
        with locked(job):  # whoever held the lock has written the line, or is dead
            lines = {(entry.get("id"), entry.get("key"), entry.get("status")) for entry in read_journal(folder)}
            if (job.id, job.key, record["status"]) not in lines:
                append_to_journal(job, str(record["status"]))


def append_to_journal(job: Job, status: str) -> None:
    """Append a line in one write, which processes that append at the same time do not mix.

    Where a process dies between a record and its line, :func:`complete_journal` adds it.
    """
    line = json.dumps({"id": job.id, "key": job.key, "status": status, "time": time.time(), "process": os.getpid()})
    with open(Path(job.folder) / "journal.jsonl", "ab+", buffering=0) as journal:
        torn = False  # the disk was full, or the machine stopped, in the middle of the last line
        if journal.seek(0, os.SEEK_END):
            journal.seek(-1, os.SEEK_END)
            torn = journal.read(1) != b"\n"
        journal.write((b"\n" if torn else b"") + line.encode() + b"\n")


def locked(job: Job) -> contextlib.AbstractContextManager[None]:
    """Lock the item while it is computed; another process waits, then finds the record."""
    return output.locked(Path(job.folder) / "locks" / job.id)
