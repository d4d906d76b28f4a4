"""One pass over a GPU: tests, agreement with the CPU, and times: ``python3 run.py gpu [OPTIONS]``.

Each part runs in a process of its own, ``python .ci/gpu.py PART DEVICE [FACES]``, and has a limit, so that none can
take the others with it. A part prints what it has found so far as a line of JSON, again whenever it has found more:
what was printed last counts when it is ended. What is known is written after every part, as ``gpu.json`` and as a page
``gpu.html``. The parts that tell most come first.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

from benchmark import made
from benchmark_measure import best_of, copy_bandwidth, kernel_table

from omtwarp.device import core_count
from omtwarp.device.policy import is_cuda, resolve_device
from omtwarp.device.prewarm import prewarm
from omtwarp.device.start import wp
from omtwarp.device.threads import step_by_step
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import staged
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.maps.result import MapResult
from omtwarp.options import MapKeywords, Scheme, Solver, parse_device
from omtwarp.reporting.markup import Markup, element, table, write_plain_page

Record = dict[str, object]

# The kinds of maps that are compared on small meshes: the default, the device's solver, and the paper's flow.
VARIANTS: dict[str, MapKeywords] = {"default": {}, "refined": {"refine": "balanced"}, "flow": {"scheme": Scheme.PLAIN}}
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
    yield {
        row["name"]: {
            "launches": row["launches"],
            "milliseconds": 1e3 * row["seconds"],
            "GB/s": row["bytes_per_second"] / 1e9,
        }
        for row in kernel_table(surface, device, None)["kernels"][:MOST_KERNELS]
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


def run_one(name: str, device: str, faces: str = "0") -> int:
    """Run one part, and return the exit status; a device that is not there is one line on standard error."""
    warnings.simplefilter("ignore")  # maps of coarse blobs may warn: the record has the figures
    try:
        for record in PARTS[name](device, int(faces)):
            print_record(record)
    except OmtwarpError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


SECONDS = 480.0  # of a whole pass: leases of graphics cards are short
LEAST_SECONDS = 5.0  # a part is not begun with less left
SIZES = (2_000, 70_000, 300_000, 1_000_000)  # faces: to compare all kinds of maps, to compare the default, to time
TESTS_LIMIT = 120.0  # seconds of the tests that need CUDA
# Seconds that a part may take; the last ones may take all that is left.
LIMITS = {
    "device": 60.0,
    "kernels compiled": 150.0,
    "agreement": 90.0,
    "copies": 30.0,
    "graphs": 60.0,
    "kernels": 60.0,
    "solvers": 60.0,
}


@dataclass(frozen=True)
class Planned:
    """A part of the pass.

    Attributes:
        name: its heading.
        command: what to run; the last line of its output is its record, as JSON or as text.
        limit: seconds that it may take.
    """

    name: str
    command: list[str]
    limit: float


def plan(device: str, sizes: Sequence[int], tests: Path | None) -> list[Planned]:
    """List the parts of a pass, in order.

    Args:
        device: a device's name.
        sizes: faces of four meshes, ascending: to compare all kinds of maps, to compare the default, and two to time.
        tests: the folder of the tests, where they are to run.
    """
    small, middle, *large = sizes

    def part(name: str, faces: int | None = None) -> Planned:
        words = [name, device] if faces is None else [name, device, str(faces)]
        heading = name if faces is None else f"{name}, {faces} faces"
        command = [sys.executable, "-P", __file__, *words]
        return Planned(heading, command, LIMITS.get(name, SECONDS))

    parts = [part("device"), part("kernels compiled"), part("agreement", small)]
    if tests is not None:
        command = [sys.executable, "-P", "-m", "pytest", "-m", "cuda", "--continue-on-collection-errors", "--tb=line"]
        parts.append(Planned("tests", [*command, "-p", "no:cacheprovider", str(tests)], TESTS_LIMIT))
    parts += [part("agreement", middle), part("copies"), part("stages", middle)]
    if parse_device(device).startswith("cuda"):
        parts.append(part("solvers", middle))
    parts += [part("graphs", small), part("kernels", middle)]
    return parts + [part("stages", faces) for faces in large]


def run_part(part: Planned, seconds: float) -> dict[str, object]:
    """Run a part for as many seconds at most, and return what it found: ``result``, ``error`` and ``seconds``."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        start, error = time.perf_counter(), ""
        try:
            subprocess.run(
                part.command, stdin=subprocess.DEVNULL, stdout=out, stderr=errors, timeout=seconds, check=True
            )
        except subprocess.CalledProcessError as ended:
            error = f"exit status {ended.returncode}"
        except subprocess.TimeoutExpired:
            error = f"ended after {seconds:.0f} s"
        taken = time.perf_counter() - start
        said = []
        for stream in (out, errors):
            stream.seek(0)
            said.append([line for line in stream.read().decode(errors="replace").splitlines() if line.strip()])
    record: dict[str, object] = {"seconds": round(taken, 1), "result": last_record(said[0])}
    if error:
        record["error"] = f"{error}: {said[1][-1][:400]}" if said[1] else error
    return record


def last_record(lines: list[str]) -> object:
    """Return the last line that is JSON, or where none is the last lines as text; a line cut short is not JSON."""
    for line in reversed(lines):
        try:
            return json.loads(line)
        except ValueError:
            continue
    return {"output": "\n".join(lines[-10:])} if lines else None


def write_results(folder: Path, results: dict[str, dict[str, object]]) -> None:
    """Write what is known as JSON and as a page."""
    with staged(folder / "gpu.json") as file:
        file.write_text(json.dumps(results, indent=1) + "\n", "utf-8")
    body: list[Markup] = []
    for name, record in results.items():
        body.append(element("h2", f"{name} ({record['seconds']} s)"))
        if "error" in record:
            body.append(element("p", str(record["error"])))
        if isinstance(record.get("result"), dict):
            body.append(as_table(record["result"]))  # type: ignore[arg-type]
    write_plain_page(folder / "gpu.html", "A pass over a GPU", body)


def as_table(result: dict[str, object]) -> Markup:
    """Make a table of a record: a line for each name, and a column for each number where a name has several."""
    lines = {name: value if isinstance(value, dict) else {"": value} for name, value in result.items()}
    columns = list(dict.fromkeys(key for line in lines.values() for key in line))
    return table(["", *columns], [[name, *(shown(line.get(key)) for key in columns)] for name, line in lines.items()])


def shown(value: object) -> str:
    """Return a value as a cell of a table shows it."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: ""}[value]
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a pass, or the part that is named, and return the exit status: 0, or 1 where a part failed."""
    words = sys.argv[1:] if arguments is None else arguments
    if words and words[0] in PARTS:
        return run_one(*words)
    parser = argparse.ArgumentParser(prog="run.py gpu", description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda:0", help="the device; cpu tries the pass itself")
    parser.add_argument("--out", type=Path, default=Path("out/gpu"), help="folder for gpu.json and gpu.html")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of the whole pass")
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)), help="faces of two meshes or more")
    parser.add_argument("--tests", type=Path, help="the folder of the tests, to run those that need CUDA")
    given = parser.parse_args(words)
    sizes = [int(word) for word in given.sizes.split(",") if word.strip().isdigit()]
    if len(sizes) < 2:
        parser.error("--sizes takes two numbers of faces or more, as 2000,70000")
    end = time.perf_counter() + given.seconds
    results: dict[str, dict[str, object]] = {}
    try:
        given.out.mkdir(parents=True, exist_ok=True)
        for part in plan(given.device, sizes, given.tests):
            left = end - time.perf_counter()
            if left < LEAST_SECONDS:
                results[part.name] = {"seconds": 0.0, "result": None, "error": "left out: no time was left"}
            else:
                results[part.name] = run_part(part, min(part.limit, left))
            write_results(given.out, results)
            record = results[part.name]
            print(f"{part.name}: {record['seconds']} s {record.get('error', '')}".rstrip(), flush=True)
            if part.name == "device" and "error" in record:
                return 1
    except (OSError, OmtwarpError) as error:
        print(f"run.py: error: {error}", file=sys.stderr)
        return 1
    print(f"written: {given.out / 'gpu.json'}, {given.out / 'gpu.html'}")
    return 1 if any("error" in record for record in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
