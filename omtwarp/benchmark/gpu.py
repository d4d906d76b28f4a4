"""One pass over a GPU: tests, agreement with the CPU, and times: ``python -m omtwarp.benchmark.gpu [OPTIONS]``.

Each part runs in a process of its own and has a limit, so that none can take the others with it. What is known is
written after every part, as ``gpu.json`` and as a page ``gpu.html``. The parts that tell most come first.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import staged
from omtwarp.options import parse_device
from omtwarp.reporting.markup import Markup, element, table, write_plain_page

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
class Part:
    """A part of the pass.

    Attributes:
        name: its heading.
        command: what to run; the last line of its output is its record, as JSON or as text.
        limit: seconds that it may take.
    """

    name: str
    command: list[str]
    limit: float


def plan(device: str, sizes: Sequence[int], tests: Path | None) -> list[Part]:
    """List the parts of a pass, in order.

    Args:
        device: a device's name.
        sizes: faces of four meshes, ascending: to compare all kinds of maps, to compare the default, and two to time.
        tests: the folder of the tests, where they are to run.
    """
    small, middle, *large = sizes

    def part(name: str, faces: int | None = None) -> Part:
        words = [name, device] if faces is None else [name, device, str(faces)]
        heading = name if faces is None else f"{name}, {faces} faces"
        command = [sys.executable, "-P", "-m", "omtwarp.benchmark.gpu_parts", *words]
        return Part(heading, command, LIMITS.get(name, SECONDS))

    parts = [part("device"), part("kernels compiled"), part("agreement", small)]
    if tests is not None:
        command = [sys.executable, "-P", "-m", "pytest", "-m", "cuda", "--continue-on-collection-errors", "--tb=line"]
        parts.append(Part("tests", [*command, "-p", "no:cacheprovider", str(tests)], TESTS_LIMIT))
    parts += [part("agreement", middle), part("copies"), part("stages", middle)]
    if parse_device(device).startswith("cuda"):
        parts.append(part("solvers", middle))
    parts += [part("graphs", small), part("kernels", middle)]
    return parts + [part("stages", faces) for faces in large]


def run_part(part: Part, seconds: float) -> dict[str, object]:
    """Run a part for as many seconds at most, and return what it found: ``result``, ``error`` and ``seconds``."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as errors:
        start = time.perf_counter()
        process = subprocess.Popen(part.command, stdin=subprocess.DEVNULL, stdout=out, stderr=errors)
        error = None
        try:
            status = process.wait(seconds)
            if status != 0:
                error = f"exit status {status}"
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            error = f"ended after {seconds:.0f} s"
        taken = time.perf_counter() - start
        said = []
        for stream in (out, errors):
            stream.seek(0)
            said.append([line for line in stream.read().decode(errors="replace").splitlines() if line.strip()])
    record: dict[str, object] = {"seconds": round(taken, 1), "result": last_record(said[0])}
    if error is not None:
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
    """Run a pass, and return the exit status: 0, or 1 where a part failed."""
    parser = argparse.ArgumentParser(prog="run.py gpu", description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda:0", help="the device; cpu tries the pass itself")
    parser.add_argument("--out", type=Path, default=Path("out/gpu"), help="folder for gpu.json and gpu.html")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="of the whole pass")
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)), help="faces of two meshes or more")
    parser.add_argument("--tests", type=Path, help="the folder of the tests, to run those that need CUDA")
    given = parser.parse_args(arguments)
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
