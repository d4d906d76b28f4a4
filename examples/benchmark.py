"""Time every stage of a map and its memory on meshes of several sizes, beside a sparse factorisation of each by SciPy.

    python examples/benchmark.py                                 # 5k to 80k faces, every device there is
    python examples/benchmark.py --sizes 5k,1M --repeats 1       # as large as memory allows
    python examples/benchmark.py scan.ply --sizes none --subdivide 2
    python examples/benchmark.py --kernels --cold --json all.json -o all.md

Takes a minute or two with the sizes it has by default, and no network. ``run`` returns plain numbers, and ``markdown``
makes tables of them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from benchmark_measure import Clock, Facts, PeakMemory, first_use, kernel_table, machine, markdown, splu_reference
from scipy import sparse

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError, check_word
from omtwarp.files.limits import MOST_FACES
from omtwarp.geometry import cotangent_laplacian
from omtwarp.mapping.pipeline import map_to_sphere
from omtwarp.mesh import shapes
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.read import read_mesh
from omtwarp.mesh.surface import MeshLike, Surface, as_surface
from omtwarp.options import Record

SHAPES = ("blob", "creature", "sphere")


def made(shape: str, face_count: int) -> Surface:
    """Return a generated shape with about so many faces: ``blob`` (a potato), ``creature`` (the demo's) or ``sphere``.

    Raises:
        OmtwarpError: an unknown shape.
    """
    check_word("shape", shape, SHAPES)
    if shape == "blob":
        # Amplitude, of the blob's bumps, in radii: a plain convention, which all published times were taken with
        return shapes.blob(seed=1, amplitude=0.3, sphere=face_count)
    if shape == "creature":
        return shapes.demo_shape(face_count)
    return shapes.icosphere_near(face_count)


MeshSource: TypeAlias = str | os.PathLike[str] | MeshLike
"""A mesh to measure: its file, or a surface in any form."""


def all_meshes(
    shapes: tuple[str, ...], sizes: tuple[int, ...], meshes: tuple[MeshSource, ...], subdivisions: int
) -> Iterator[tuple[str, str, Surface]]:
    """Yield the family, name and surface of every mesh to measure, one in memory at a time.

    Args:
        shapes: generated shapes.
        sizes: their numbers of faces.
        meshes: mesh files, or pairs of vertices and faces.
        subdivisions: how many times every given mesh is subdivided as well.

    Raises:
        OmtwarpError: a mesh cannot be read or mapped.
    """
    for shape in shapes:
        for size in sorted(sizes):
            surface = made(shape, size)
            yield shape, f"{shape}_{label(surface.face_count)}", surface
    for number, mesh in enumerate(meshes):
        if isinstance(mesh, str | os.PathLike):
            name = Path(mesh).stem
            read = read_mesh(Path(mesh))
            surface = as_surface((read.vertices, read.faces))
        else:
            name, surface = f"mesh {number + 1}", as_surface(mesh)
        for level in range(subdivisions + 1):
            yield name, name if level == 0 else f"{name} / {4**level}", surface
            if level < subdivisions:
                surface = quarter(surface).surface


def label(count: int) -> str:
    """Shorten a number of faces to a few characters: 5k, 1.3M."""
    if count >= 1_000_000:
        return f"{count / 1e6:.1f}M".replace(".0M", "M")
    return f"{count / 1e3:.0f}k" if count >= 1000 else str(count)


def run(
    *,
    sizes: Sequence[int] = (5_000, 20_000, 80_000),
    shapes: Sequence[str] = ("blob",),
    meshes: Sequence[MeshSource] = (),
    subdivisions: int = 0,
    devices: Sequence[str] = ("cpu",),
    repeats: int = 3,
    refine: str | float | None = "none",
    kernels: bool = False,
    cold: bool = False,
    largest_reference: int = 500_000,
    progress: Callable[[str], None] | None = None,
) -> Facts:
    """Measure whole maps, from the arrays to the final map, with kernels compiled beforehand.

    Each mesh is mapped ``repeats`` times on each device after a small map has warmed the device up, and factorised
    with SciPy's ``splu`` (its defaults) and solved once before every map on the CPU: medians of all are given. A ratio
    is the median of a map's time over that of the factorisation and solve before it, so that a machine that is busy for
    a while slows both.

    Args:
        sizes: numbers of faces of the generated shapes, from 5,000 to 2,000,000 and beyond.
        shapes: generated shapes: ``blob``, ``creature``, ``sphere``.
        meshes: mesh files, or pairs of vertices and faces, besides.
        subdivisions: how many times each given mesh is also subdivided, each time into four times as many faces.
        devices: ``cpu``, ``cuda:0``, ...
        repeats: maps of which the median counts.
        refine: how maps are refined, see :func:`omtwarp.map_to_sphere`.
        kernels: also time every kernel by itself, and count the memory it has to move, on the largest mesh.
        cold: also measure compilation into an empty cache, and the start of the program.
        largest_reference: meshes with more faces are not factorised for comparison, as SuperLU needs about 10 kB per
            vertex, and minutes.
        progress: called with one line of text before each measurement.

    Returns:
        Everything as plain numbers: ``machine``, ``settings``, ``meshes`` (each with its reference and its ``runs``),
        ``kernels`` and ``first_use`` where asked for.

    Raises:
        OmtwarpError: an unknown shape or device, a mesh that cannot be read or mapped, or nothing to measure.
    """
    if repeats < 1 or any(size < 100 for size in sizes):
        raise OmtwarpError("a benchmark needs at least one repeat, and sizes of at least 100 faces")
    if not meshes and not (sizes and shapes):
        raise OmtwarpError("nothing to measure: give sizes and shapes, or meshes")
    names = tuple(str(resolve_device(device)) for device in devices)
    notify = progress or (lambda text: None)
    settings: Facts = {"repeats": repeats, "refine": refine, "largest_reference": largest_reference}
    # Format, of the file of results; to be raised when a field changes its meaning
    result: Facts = {"format": 1, "machine": machine(names), "settings": settings, "meshes": []}
    for name in names:
        notify(f"warming up {name}")
        # Warm up faces, of the map that is made first, so that every kernel is loaded before times are taken
        measure_map(made("blob", 2000), name, refine)
    largest: Surface | None = None
    for family, label, surface in all_meshes(tuple(shapes), tuple(sizes), tuple(meshes), subdivisions):
        result["meshes"].append(measure_mesh(family, label, surface, names, settings, notify))
        if kernels and (largest is None or surface.face_count > largest.face_count):
            largest = surface
    if kernels and largest is not None:
        notify("timing kernels one by one")
        result["kernels"] = [kernel_table(largest, name, refine) for name in names]
    if cold:
        notify("compiling into an empty cache")
        result["first_use"] = {name: first_use(name) for name in names}
    return result


def measure_mesh(
    family: str, label: str, surface: Surface, devices: Sequence[str], settings: Facts, notify: Callable[[str], None]
) -> Facts:
    """Measure the reference factorisation and the maps of one mesh, with settings as of :func:`run`."""
    repeats, refine = settings["repeats"], settings["refine"]
    system = reference_system(surface) if surface.face_count <= settings["largest_reference"] else None
    references: list[tuple[float, float]] = []
    runs: list[Facts] = []
    for device in devices:
        measured: list[Facts] = []
        for repeat in range(repeats):
            notify(f"{label}: {device}, map {repeat + 1} of {repeats}")
            before = None
            if system is not None and device == "cpu":
                before = splu_reference(*system)
                references.append(before)
            one = measure_map(surface, device, refine)
            one["ratio"] = one["seconds"] / before[0] if before else None
            # Of a small system the processor's clock may have counted nothing.
            one["cpu_ratio"] = one["cpu_seconds"] / before[1] if before and before[1] else None
            for stage in one["stages"]:
                stage["ratio"] = stage["seconds"] / before[0] if before else None
            measured.append(one)
        stages = [_median([one["stages"][k] for one in measured]) for k in range(len(measured[0]["stages"]))]
        runs.append({"device": device, **_median(measured), "stages": stages})
    if system is not None and not references:
        references.append(splu_reference(*system))
    reference = None
    if references:
        wall, cpu = (float(np.median([pair[k] for pair in references])) for k in range(2))
        reference = {"seconds": wall, "cpu_seconds": cpu}
    mesh: Facts = {"family": family, "name": label, "vertices": surface.vertex_count, "faces": surface.face_count}
    return mesh | {"splu": reference, "runs": runs}


def measure_map(surface: Surface, device: str, refine: str | float | None) -> Facts:
    """Measure one map from vertices and faces alone, with nothing kept of an earlier one but kernels."""
    vertices, faces = surface.vertices.copy(), surface.faces.copy()
    marks: dict[str, float] = {}
    where = wp.get_device(device)
    wp.synchronize_device(where)
    used_before = most_used(where)
    memory, clock = PeakMemory(), Clock()

    def mark(stage: str, done: int, total: int, details: Record) -> None:
        if "flips" in details:  # the stage is over
            marks[stage] = clock.read()[1]

    mapped = map_to_sphere((vertices, faces), device=device, refine=refine, progress=mark)
    wp.synchronize_device(where)
    wall, cpu = clock.read()
    used = most_used(where)
    stages: list[Facts] = []
    before = 0.0
    for stage in mapped.report["stages"]:
        now = marks.get(stage["name"], math.nan)
        known: Facts = {name: stage.get(name) for name in ("name", "seconds", "iterations", "flips")}
        stages.append(known | {"cpu_seconds": now - before, "area": stage["area"]["surface"]})
        before = now
    other = {"name": "other", "seconds": wall - sum(stage["seconds"] for stage in stages)}
    stages.append(stages[-1] | other | {"cpu_seconds": cpu - before, "iterations": 1})
    times: Facts = {"seconds": wall, "cpu_seconds": cpu, "peak_bytes": memory.read()}
    times["device_bytes"] = used if used > used_before else None
    return times | {"flips": mapped.certificate.flips, "bijective": mapped.bijective, "stages": stages}


def most_used(device: wp.Device) -> int:
    """Return the most bytes of a device's memory pool that this process has used at a time; 0 on the CPU.

    Warp cannot set this mark back: it is the peak of a map only where the map raises it.
    """
    return int(wp.get_mempool_used_mem_high(device)) if device.is_cuda and device.is_mempool_enabled else 0


def reference_system(surface: Surface) -> tuple[sparse.csc_matrix, Floats]:
    """Return the cotangent Laplacian without its first vertex, and a right-hand side."""
    matrix = cotangent_laplacian(surface.scaled_vertices, surface.faces).tocsc()[1:, 1:]
    return matrix, np.random.default_rng(0).normal(size=matrix.shape[0])


def _median(records: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """Return the median of every number of records of the same fields; other fields are those of the first."""
    out: dict[str, object] = {}
    for key, first in records[0].items():
        values = [record[key] for record in records]
        if isinstance(first, bool):
            out[key] = all(values)
        elif isinstance(first, int | float) and None not in values:
            middle = float(np.median(np.asarray(values, dtype=np.float64)))
            out[key] = int(middle) if isinstance(first, int) else middle
        else:
            out[key] = first
    return out


def parse_sizes(text: str) -> tuple[int, ...]:
    """Read numbers of faces from text such as 5000,20k,1M; ``none`` gives an empty list."""
    if text == "none":
        return ()
    sizes = []
    for word in text.split(","):
        number, factor = word.strip().lower(), 1.0
        if number and number[-1] in "km":
            number, factor = number[:-1], 1e3 if number[-1] == "k" else 1e6
        try:
            faces = float(number) * factor
        except ValueError:
            faces = math.nan
        if not 1.0 <= faces <= MOST_FACES:
            raise argparse.ArgumentTypeError(f"'{word}' is not a number of faces: use 5000, 20k or 1M")
        sizes.append(round(faces))
    return tuple(sizes)


def words(text: str) -> tuple[str, ...]:
    """Take a list of words apart at its commas."""
    return tuple(word.strip() for word in text.split(","))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure what the arguments say, and write or print the tables."""
    parser = argparse.ArgumentParser(description="Time every stage of a map and its memory on meshes of several sizes.")
    parser.add_argument("meshes", nargs="*", metavar="MESH", help="mesh files, besides generated shapes")
    parser.add_argument("--sizes", type=parse_sizes, default=(5_000, 20_000, 80_000), metavar="N,N,...")
    parser.add_argument("--shape", type=words, default=("blob",), metavar="NAME,...", help=", ".join(SHAPES))
    parser.add_argument("--subdivide", type=int, default=0, metavar="TIMES", help="the given meshes, so often")
    parser.add_argument("--device", type=words, default=("auto",), metavar="cpu,cuda:0")
    parser.add_argument("--repeats", type=int, default=3, help="maps of which the median is taken")
    parser.add_argument("--refine", default="none", help="as of omtwarp map")
    parser.add_argument("--kernels", action="store_true", help="also every kernel, and the memory that it moves")
    parser.add_argument("--cold", action="store_true", help="also compilation into an empty cache, and starts")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write the tables in place of printing them")
    given = parser.parse_args(arguments)
    everything = ("cpu", "cuda:0") if wp.is_cuda_available() else ("cpu",)
    try:
        result = run(
            sizes=given.sizes,
            shapes=given.shape,
            meshes=given.meshes,
            subdivisions=given.subdivide,
            devices=everything if given.device == ("auto",) else given.device,
            repeats=given.repeats,
            refine=given.refine,
            kernels=given.kernels,
            cold=given.cold,
            progress=lambda text: print(text, file=sys.stderr),
        )
    except OmtwarpError as error:
        parser.error(str(error))
    if given.json is not None:
        given.json.write_text(json.dumps(result, indent=2) + "\n", "utf-8")
    if given.output is not None:
        given.output.write_text(markdown(result), "utf-8")
    else:
        print(markdown(result), end="")


if __name__ == "__main__":
    main()
