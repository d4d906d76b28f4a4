"""Run an item in a process of its own: read, map, register where asked, save, and record the result."""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np

from omtwarp.cohort.item import (
    ERROR,
    MEMORY,
    OK,
    Job,
    Row,
    append_to_journal,
    locked,
    read_record,
    write_record,
)
from omtwarp.errors import OmtwarpError, OmtwarpWarning, choose, unexpected
from omtwarp.files.memory import address_space
from omtwarp.files.output import digest_of, staged
from omtwarp.mapping.any_surface import map_surface
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.maps.result import MapResult
from omtwarp.mesh.checks import MeshLike
from omtwarp.mesh.neuro import structure_of
from omtwarp.mesh.repair import NOTED_LOSS, repair
from omtwarp.mesh.seams import read_joined_mesh
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.options import Domain, FillArea, MapKeywords

APART = ("repair", "fill_area", "register")  # options of a job that are not those of a map


def run_item(job: Job) -> Row:
    """Map an item and write its record, unless there is one already; the process is expected to end afterwards."""
    with locked(job):
        finished = read_record(job)
        if finished is not None:
            return finished
        _limit_memory(job.memory_limit)
        begun, used = time.perf_counter(), time.process_time()

        def recorded(status: str, message: str = "", numbers: Row | None = None) -> Row:
            numbers = (numbers or {}) | {
                "seconds": time.perf_counter() - begun,
                "cpu_seconds": time.process_time() - used,
            }
            return write_record(job, status, message, **numbers, memory=_peak_memory())

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
        except MemoryError:
            record = recorded(MEMORY, f"needs more than {job.memory_limit / 2**30:.3g} GiB of memory")
        except OmtwarpError as error:
            record = recorded(ERROR, str(error))
        except Exception as error:
            record = recorded(ERROR, unexpected(error))
        append_to_journal(job, str(record["status"]))
        return record


def _map(job: Job) -> MapResult:
    """Read an item, repair it where asked, and map it."""
    repair_first = bool(job.options.get("repair"))
    mesh = read_joined_mesh(Path(job.path), together=repair_first)
    vertices, faces = mesh.vertices, mesh.faces
    if repair_first:
        repaired = repair(vertices, faces, whole="fill_area" not in job.options)
        vertices, faces = repaired.vertices, repaired.faces
        if repaired.loss > NOTED_LOSS:
            warnings.warn(f"{job.path}: {repaired.actions[-1]}", OmtwarpWarning, stacklevel=2)
    result = mapped((vertices, faces), job.options)
    structure = structure_of(Path(job.path))
    if structure is not None:
        result.report["structure"] = structure
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


def _limit_memory(limit: int) -> None:
    """Limit how many more bytes the process may allocate; only Linux enforces such a limit."""
    if limit and sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (address_space() + limit,) * 2)


def _peak_memory() -> int:
    """Return the peak memory of the process in bytes, 0 where the system does not report it."""
    if sys.platform == "win32":
        return 0
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
