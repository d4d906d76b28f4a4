"""A process with all modules loaded that forks for every item.

Loading Warp and the kernels takes seconds, a fork milliseconds. Jobs are lines on standard input, and the answer to
each is a line of JSON: its exit status, and whether it exceeded its time. When standard input ends, because the driver
is done or dead, the item at work is ended too. Where there is no fork, and on CUDA, whose state a fork does not
survive, the process works on one item itself and ends.
"""

import contextlib
import ctypes
import gc
import json
import os
import select
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from omtwarp.cohort.item import ERROR, MEMORY, OK, Job, Row, append_to_journal, locked, read_record, write_record
from omtwarp.device.policy import asks_for_cuda
from omtwarp.errors import OmtwarpError, OmtwarpWarning, choose, out_of_memory, unexpected, with_options
from omtwarp.files.limits import address_space
from omtwarp.files.output import digest_of, staged
from omtwarp.mapping.any_surface import in_file, map_surface
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.maps.result import MapResult
from omtwarp.mesh.neuro import structure_of, volume_geometry_of
from omtwarp.mesh.read import read_joined_mesh, read_mesh
from omtwarp.mesh.repair import NOTED_LOSS, repair
from omtwarp.mesh.shapes import blob
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, triangle_areas
from omtwarp.mesh.write import write_mesh
from omtwarp.options import Domain, FillArea, MapKeywords

APART = ("repair", "fill_area", "register")  # options of a job that are not those of a map


def run_item(job: Job) -> Row:
    """Map an item and write its record, unless there is one already; the process is expected to end afterwards."""
    with locked(job):
        finished = read_record(job)
        if finished is not None:
            return finished
        if job.memory_limit and sys.platform == "linux":  # elsewhere no such limit is enforced
            import resource

            resource.setrlimit(resource.RLIMIT_AS, (address_space() + job.memory_limit,) * 2)
        begun, used = time.perf_counter(), time.process_time()

        def recorded(status: str, message: str = "", numbers: Row | None = None) -> Row:
            spent = {"seconds": time.perf_counter() - begun, "cpu_seconds": time.process_time() - used}
            return write_record(job, status, message, **(numbers or {}), **spent, memory=_peak_memory())

        try:
            result = _map(job)
            numbers = numbers_of(result)
            if "register" in job.options:
                from omtwarp.registration import register  # what cohorts without it need not load

                target = str(job.options["register"])
                registration = register(result, target)
                result = registration.registered(result)
                numbers |= {"registered_to": target, **registration.facts()}
            with staged(job.map_file) as file:
                result.save(file)
                made: Row = {"map_size": file.stat().st_size, "map_digest": digest_of(file)}
                record = recorded(OK, numbers=numbers | made)
        except OmtwarpError as error:
            record = recorded(ERROR, with_options(str(error)))  # a file, for the tables and pages of the command
        except Exception as error:
            more = f"needs more than {job.memory_limit / 2**30:.3g} GiB of memory"
            record = recorded(MEMORY, more) if out_of_memory(error) else recorded(ERROR, unexpected(error))
        append_to_journal(job, str(record["status"]))
        return record


def _map(job: Job) -> MapResult:
    """Read an item, repair it where asked, and map it."""
    repair_first = bool(job.options.get("repair"))
    mesh = read_joined_mesh(Path(job.path), together=repair_first)
    repaired = repair(mesh, whole="fill_area" not in job.options) if repair_first else None
    if repaired is not None and repaired.loss > NOTED_LOSS:
        warnings.warn(f"{job.path}: {repaired.actions[-1]}", OmtwarpWarning, stacklevel=2)
    given = mesh if repaired is None else repaired
    result = in_file(mapped((given.vertices, given.faces), job.options), mesh.after(repaired), len(given.vertices))
    structure = structure_of(Path(job.path))
    if structure is not None:
        result.report["structure"] = structure
    if (volume := volume_geometry_of(Path(job.path))) is not None:
        result.report["volume_geometry"] = volume
    return result


def mapped(mesh: MeshLike, asked: Mapping[str, object]) -> MapResult:
    """Map a surface to the sphere, its holes filled where the options have ``fill_area``.

    Args:
        mesh: the surface.
        asked: the options of a job.
    """
    options = cast(MapKeywords, {name: value for name, value in asked.items() if name not in APART})
    if "fill_area" not in asked:
        return map_to_sphere(mesh, **options)
    area = choose(FillArea, asked["fill_area"])
    result = map_surface(mesh, domain=Domain.SPHERE, fill_area=area, components=False, cut=False, **options)
    return cast(MapResult, result)  # as the domain is no torus


def numbers_of(result: MapResult) -> Row:
    """Collect a table's numbers of a map: sizes, flips, degree, distortions, and the cost above its lower bound."""
    last = result.report["stages"][-1]
    surface = Surface(result.vertices, result.faces, result.measure)
    image = triangle_areas(result.sphere, surface.faces)
    around = surface.sum_to_vertices(image) / 3.0 * (SPHERE_AREA / image.sum()) / surface.vertex_areas
    numbers: Row = {"vertices": surface.vertex_count, "faces": surface.face_count, "degree": last["degree"]}
    numbers |= {"flips": result.report["certificate"]["flips"]}
    numbers |= {"area": last["area"]["surface"], "area_p95": last["area"]["p95"], "angle": last["angle"]["surface"]}
    numbers["ring"] = float(np.sqrt(np.average((around - 1.0) ** 2, weights=surface.vertex_areas)))
    return numbers | {"gap": result.report.get("optimality", {}).get("gap")}


def _peak_memory() -> int:
    """Return the peak memory of the process in bytes, 0 where the system does not report it."""
    if sys.platform == "win32":
        return 0
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def main() -> None:
    """Serve jobs until standard input ends."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # other output must not mix with the answers
    warm = False
    pending = b""
    while True:
        while b"\n" not in pending:
            block = os.read(0, 1 << 16)
            if not block:
                return
            pending += block
        line, pending = pending.split(b"\n", 1)
        job = Job.from_json(line.decode())
        if not hasattr(os, "fork") or asks_for_cuda(job.options.get("device")):
            run_item(job)
            answers.write(json.dumps({"exit": 0, "timeout": False}) + "\n")
            return
        if not warm:
            _load(job)
            warm = True
        answers.write(json.dumps(_supervise(job)) + "\n")


def _load(job: Job) -> None:
    """Load the readers, libraries and kernels that a job needs, and most likely all others of its cohort.

    A map does this that is small enough to start no thread, which a fork would lose.
    """
    surface = blob(0, sphere=320)
    with tempfile.TemporaryDirectory() as folder:
        write_mesh(Path(folder) / "warm.ply", surface.vertices, surface.faces)
        mesh = read_mesh(Path(folder) / "warm.ply")
        mapped((mesh.vertices, mesh.faces), job.options).save(Path(folder) / "warm.npz")
    gc.collect()
    gc.freeze()  # collections in forks leave these pages shared


def _supervise(job: Job) -> dict[str, int | bool]:
    """Fork, and wait for the item, the end of its time, or the end of the driver."""
    host = os.getpid()
    child = os.fork()
    if child == 0:
        _work(job, host)
    with contextlib.suppress(OSError):  # whichever of the two comes first: the group is there before it may be ended
        os.setpgid(child, child)
    deadline = time.monotonic() + job.time_limit
    while True:
        # Seconds between looks at an item
        ready, _, _ = select.select([0], [], [], max(0.0, min(deadline - time.monotonic(), 0.02)))
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return {"exit": os.waitstatus_to_exitcode(status), "timeout": False}
        gone = bool(ready)  # jobs come one by one: input during a job is the end of the stream
        if gone or time.monotonic() >= deadline:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            if gone:
                os._exit(1)
            return {"exit": -signal.SIGKILL, "timeout": True}


def _work(job: Job, host: int) -> None:
    """Run an item in a process group of its own, and exit; also where the host has died already."""
    status = 70
    try:
        os.setpgid(0, 0)
        if sys.platform == "linux":
            # Pr set pdeathsig, of Linux's prctl
            ctypes.CDLL(None).prctl(1, signal.SIGKILL)
            if os.getppid() != host:
                return
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        run_item(job)
        status = 0
    finally:
        os._exit(status)
