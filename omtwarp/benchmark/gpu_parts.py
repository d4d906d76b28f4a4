"""Parts of a pass over a GPU, each a process of its own: ``python -m omtwarp.benchmark.gpu_parts PART DEVICE [FACES]``.

A part prints what it has found so far as a line of JSON, again whenever it has found more: what was printed last counts
when it is ended. :mod:`omtwarp.benchmark.gpu` runs all of them.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator

import numpy as np

from omtwarp.benchmark.roofline import LaunchRecorder, copy_bandwidth
from omtwarp.benchmark.runner import made
from omtwarp.device import core_count
from omtwarp.device.policy import is_cuda, resolve_device
from omtwarp.device.prewarm import prewarm
from omtwarp.device.start import wp
from omtwarp.device.threads import step_by_step
from omtwarp.errors import OmtwarpError
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.maps.result import MapResult
from omtwarp.options import MapKeywords, Scheme, Solver

Record = dict[str, object]

# The kinds of maps that are compared on small meshes: the default, the device's solver, and the paper's flow.
VARIANTS: dict[str, MapKeywords] = {
    "default": {},
    "refined": {"refine": "balanced"},
    "flow": {"scheme": Scheme.PLAIN},
}
SMALL_FACES = 10_000  # up to here all variants are compared, above the default alone
STAGES = ("conformal", "transported", "sphere")
READS = 200  # of one number, whose mean time is that of a synchronising read
LAUNCHES = 500  # of one thread each
MOST_KERNELS = 25  # in the table of kernels, slowest first


def describe(device: str, _faces: int) -> Iterator[Record]:
    """Describe the device and its driver."""
    where = resolve_device(device)
    record: Record = {"name": where.name, "cores": core_count()}
    if is_cuda(where):
        record |= {
            "architecture": int(where.arch),
            "memory, GiB": round(where.total_memory / 2**30, 1),
            "driver": str(wp.get_cuda_driver_version()),
            "toolkit": str(wp.get_cuda_toolkit_version()),
            "conditions in graphs": bool(wp.is_conditional_graph_supported()),
            "memory pool": bool(where.is_mempool_enabled),
        }
    yield record


def compile_kernels(device: str, _faces: int) -> Iterator[Record]:
    """Compile every kernel for the CPU and the device."""
    record: Record = {}
    for name in dict.fromkeys((device, "cpu")):
        start = time.perf_counter()
        record[name] = {"modules": prewarm(name), "seconds": time.perf_counter() - start}
        yield record


def compare(device: str, faces: int) -> Iterator[Record]:
    """Compare maps with those of the CPU, and of a second run."""
    surface = made("blob", faces)
    record: Record = {}
    for name, options in VARIANTS.items() if faces <= SMALL_FACES else (("default", VARIANTS["default"]),):
        maps, seconds = [], []
        for where in ("cpu", device, device):
            start = time.perf_counter()
            keywords: MapKeywords = {**options, "device": where}
            maps.append(map_to_sphere(surface, **keywords))
            seconds.append(time.perf_counter() - start)
        cpu, one, two = maps
        differences = {stage: largest_difference(cpu, one, stage) for stage in STAGES}
        record[name] = {
            "same bits twice": all(largest_difference(one, two, stage) == 0.0 for stage in STAGES),
            "bijective": one.bijective,
            **{f"from the CPU, {stage}": value for stage, value in differences.items()},
            "CPU, s": seconds[0],
            "first, s": seconds[1],
            "second, s": seconds[2],
        }
        yield record


def largest_difference(one: MapResult, other: MapResult, stage: str) -> float:
    """Return the largest difference of a coordinate of two maps after a stage, 0 where neither has it."""
    here, there = getattr(one, stage), getattr(other, stage)
    return 0.0 if here is None and there is None else float(np.abs(here - there).max())


def time_stages(device: str, faces: int) -> Iterator[Record]:
    """Time the stages of a map on the device and on the CPU; the device comes first, after a small map."""
    surface = made("blob", faces)
    record: Record = {}
    for where in dict.fromkeys((device, "cpu")):
        map_to_sphere(made("blob", 320), device=where)  # loads the kernels
        stages: dict[str, float] = {}
        begun = before = time.perf_counter()

        def over(stage: str, _done: int, _total: int, details: dict[str, float]) -> None:
            nonlocal before
            if "flips" in details:
                now = time.perf_counter()
                stages[stage] = stages.get(stage, 0.0) + now - before  # noqa: B023 (called before the next turn)
                before = now
                print_record(record | {where: stages})  # noqa: B023

        mapped = map_to_sphere((surface.vertices, surface.faces), device=where, progress=over)
        whole = time.perf_counter() - begun
        record[where] = {stage["name"]: stage["seconds"] for stage in mapped.report["stages"]} | {"whole map": whole}
        yield record


def time_copies(device: str, _faces: int) -> Iterator[Record]:
    """Time copies, reads of one number and empty launches."""
    where = resolve_device(device)
    one, host = wp.zeros(1, dtype=wp.float64, device=where), np.zeros(2**22)
    array = wp.array(host, dtype=wp.float64, device=where)
    record: Record = {"on the device, GB/s read and written": copy_bandwidth(device) / 1e9}
    record["to the host, GB/s"] = host.nbytes / best_of(array.numpy, where) / 1e9
    record["from the host, GB/s"] = (
        host.nbytes / best_of(lambda: wp.array(host, dtype=wp.float64, device=where), where) / 1e9
    )
    record["read of a number, microseconds"] = best_of(lambda: [one.numpy() for _ in range(READS)], where) / READS * 1e6
    record["launch, microseconds"] = best_of(lambda: [one.fill_(1.0) for _ in range(LAUNCHES)], where) / LAUNCHES * 1e6
    yield record


def best_of(work: Callable[[], object], device: wp.Device, repeats: int = 4) -> float:
    """Return the least seconds of some runs of work, the device's part of it included."""
    best = np.inf
    for _ in range(repeats):
        wp.synchronize_device(device)
        start = time.perf_counter()
        work()
        wp.synchronize_device(device)
        best = min(best, time.perf_counter() - start)
    return best


def compare_graphs(device: str, faces: int) -> Iterator[Record]:
    """Compare maps whose loops are recorded as graphs with those whose loops are launched step by step."""
    surface = made("blob", faces)
    options: MapKeywords = {"device": device, "scheme": Scheme.PLAIN}
    recorded = map_to_sphere(surface, **options)
    with step_by_step():
        launched = map_to_sphere(surface, **options)
    yield {"same bits": all(largest_difference(recorded, launched, stage) == 0.0 for stage in STAGES)}


def compare_solvers(device: str, faces: int) -> Iterator[Record]:
    """Compare maps whose systems cuDSS solves with those of the built-in solvers; times are those of a second map."""
    surface = made("blob", faces)
    built_in = map_to_sphere(surface, device=device)
    record: Record = {}
    for solver in (Solver.CHOLESKY, Solver.CUDSS):
        one = map_to_sphere(surface, device=device, solver=solver)
        start = time.perf_counter()
        two = map_to_sphere((surface.vertices, surface.faces), device=device, solver=solver)
        whole = time.perf_counter() - start
        record[str(solver)] = {
            "same bits twice": all(largest_difference(one, two, stage) == 0.0 for stage in STAGES),
            "from the default": largest_difference(built_in, two, "sphere"),
            **{stage["name"]: stage["seconds"] for stage in two.report["stages"]},
            "whole map": whole,
        }
        yield record


def time_kernels(device: str, faces: int) -> Iterator[Record]:
    """Time every kernel of a map by itself."""
    surface = made("blob", faces)
    map_to_sphere(surface, device=device)
    with LaunchRecorder(device) as recorder:
        map_to_sphere((surface.vertices, surface.faces), device=device)
    slowest = sorted(recorder.kernels.items(), key=lambda item: -item[1].seconds)[:MOST_KERNELS]
    yield {
        name: {
            "launches": kernel.launches,
            "milliseconds": 1e3 * kernel.seconds,
            "GB/s": kernel.moved / max(kernel.seconds, 1e-9) / 1e9,
        }
        for name, kernel in slowest
    }


PARTS: dict[str, Callable[[str, int], Iterator[Record]]] = {
    "device": describe,
    "kernels compiled": compile_kernels,
    "agreement": compare,
    "copies": time_copies,
    "graphs": compare_graphs,
    "solvers": compare_solvers,
    "kernels": time_kernels,
    "stages": time_stages,
}


def print_record(record: Record) -> None:
    """Print a record as one line."""
    print(json.dumps(record), flush=True)


def main(arguments: list[str]) -> int:
    """Run one part, and return the exit status; a device that is not there is one line on standard error."""
    name, device, *faces = arguments
    warnings.simplefilter("ignore")  # maps of coarse blobs may warn: the record has the figures
    try:
        for record in PARTS[name](device, int(faces[0]) if faces else 0):
            print_record(record)
    except OmtwarpError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
