"""Steps that several commands share: a checked mesh, a device, a map that is made or read, and the facts about it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import omtwarp
from omtwarp.commands._options import Printing, Source
from omtwarp.commands._streams import is_standard_output, progress_bar, say, warnings_as_lines
from omtwarp.errors import OmtwarpError, naming
from omtwarp.files.output import check_output, guard_results, make_folder
from omtwarp.options import Domain, MapOptions, Method, parse_device

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from omtwarp.maps.result import MapReport, MapResult
    from omtwarp.mesh.read import JoinedMesh
    from omtwarp.mesh.repair import Repaired


Output = TypeVar("Output", Path, Path | None)
Target = TypeVar("Target")


def facts_of(result: MapResult, output: Path, report: Path | None = None) -> dict:
    """Sum up a finished map, its files and its figures, ready for JSON.

    ``degree`` is of the whole map: the total signed solid angle over 4π, so that parts with a sphere each are added up.
    ``degree_of_parts`` has one for each of these parts, in their order, and is None for all other maps. Of a disk, a
    degree is the signed area over the unsigned one.
    """
    stages, certificate = result.report["stages"], result.certificate
    last = stages[-1]
    # Of parts mapped each by itself, the figure of the part that has the largest is told.
    parts = result.report.get("parts", [])
    reports: list[MapReport] = [result.report, *parts]
    errors = [stage.get("largest_area_error") for each in reports for stage in each["stages"]]
    apart = result.cap_centres is None  # not side by side on one sphere
    gaps = [each.get("optimality", {}).get("gap") for each in reports]  # the bound is on squared distances only
    facts: dict = {"output": str(output), "report": None if report is None else str(report), **counts_of(result)}
    facts |= {"bijective": certificate.bijective, "flips": certificate.flips, "degree": last["degree"]}
    return facts | {
        "degree_of_parts": [part["stages"][-1]["degree"] for part in parts] if parts and apart else None,
        "domain": str(result.domain),
        "area": last["area"]["surface"],
        "angle": last["angle"]["surface"],
        "largest_area_error": max((error for error in errors if error is not None), default=None),
        "gap": max((gap for gap in gaps if gap is not None), default=None),
        "seconds": result.report["seconds"],
    }


def counts_of(result: MapResult) -> dict[str, int]:
    """Count vertices, faces, copies of vertices along cuts, new ones, and the faces that triangles are parts of."""
    import numpy as np

    of_vertices, of_faces = result.vertex_origin, result.face_origin
    copied = new = 0
    if of_vertices is not None:
        known = of_vertices[of_vertices >= 0]
        copied, new = len(known) - len(np.unique(known)), len(of_vertices) - len(known)
    vertices, faces = len(result.vertices), len(result.faces)
    given = faces if of_faces is None else len(np.unique(of_faces[of_faces >= 0])) + int((of_faces < 0).sum())
    counts = {"vertices": vertices, "faces": faces, "copied_vertices": copied, "new_vertices": new}
    return counts | {"input_faces": given}


def sizes(counts: Mapping[str, int]) -> str:
    """Return :func:`counts_of` a map's mesh in words: those of the input, and what cuts and new vertices added."""
    copied, new, faces, given = (counts[k] for k in ("copied_vertices", "new_vertices", "faces", "input_faces"))
    more = [f"{copied} copies along cuts"] * bool(copied) + [f"{new} new ones"] * bool(new)
    line = " and ".join([f"{counts['vertices'] - copied - new} vertices", *more])
    return f"{line}, {given} faces" + (f" in {faces} parts" if faces > given else "")


def summary(facts: dict) -> str:
    """Return a line for readers about a finished map and its files."""
    line = f"{facts['output']}: {sizes(facts)}; {quality(facts)}"
    return line if facts["report"] is None else f"{line}; report {facts['report']}"


def quality(facts: dict) -> str:
    """Return the figures of a map's quality: flips, degree, area, angle, and the gap where it was computed.

    Of a map to a part of the sphere, the degree is the share that is covered; of parts with a sphere each, it is told
    for each of them.
    """
    line = f"flips {facts['flips']}, {_covered(facts)}"
    of_parts = "" if facts["largest_area_error"] is None else " (of the quarters)"
    line += f", area {facts['area']:.4f}{of_parts}, angle {facts['angle']:.4f}"
    if facts["largest_area_error"] is not None:
        line += f", areas of all triangles right to {facts['largest_area_error']:.1e}"
    if facts["gap"] is not None:
        within = f"within {facts['gap']:.3%} of the least"
        # Above this gap the bound says little of the least cost: on a bracket, two fifths of whose conformal map are
        # flipped, it is less than a ten-thousandth of the cost of the map.
        line += f", cost {within if facts['gap'] <= 1.0 else 'more than twice its lower bound'}"
    return line


def _covered(facts: dict) -> str:
    """Return the degree of a map or of its parts in words, or the share of the sphere that is covered."""
    degrees = facts["degree_of_parts"] or [facts["degree"]]
    where = f" each of {len(degrees)} {'disks' if facts['domain'] == Domain.DISK else 'spheres'}"
    several, low, high = len(degrees) > 1, min(degrees), max(degrees)
    # Degrees are whole numbers but for the round-off of a million solid angles, as in omtwarp.spheres.
    if all(abs(degree - round(low)) < 1e-6 for degree in degrees):
        return f"degree {low:.6f}" + (f" on{where}" if several else "")
    share = f"{low:.2%}" if f"{low:.2%}" == f"{high:.2%}" else f"{low:.2%} to {high:.2%}"
    return f"{share} of{where if several else ' the sphere'} covered"


@dataclass
class Input:
    """A mesh that was read, repaired if asked for, and found free of defects.

    Attributes:
        surface: the mesh, examined; its origins are those in the file, after repair or after copies were joined.
        mesh: what was read; the origins of the surface where copies were joined and nothing was repaired.
        notes: what reading and repair did, in words.
    """

    surface: omtwarp.Surface
    mesh: JoinedMesh
    notes: list[str]


def show_facts(facts: Mapping[str, object], line: str, printing: Printing) -> None:
    """Print the outcome of a command on standard output: its facts as JSON, or a line for readers."""
    if printing.as_json:
        print(report_text(facts), end="")
    elif not printing.quiet:
        print(line)


def with_files(files: Sequence[Path]) -> str:
    """Return a line about the companions of a file that was asked for, which is the last; none if it is alone."""
    return f"\nwith {' and '.join(str(file) for file in files[:-1])}" if len(files) > 1 else ""


def say_notes(path: Path, notes: Iterable[str]) -> None:
    """Print what reading and repair of a file did, a line for each."""
    for note in notes:
        say(f"{path}: {note}")


def sound_surface(
    path: Path, vertices: NDArray, faces: NDArray, notes: list[str], repair: bool, *, any_surface: bool = False
) -> tuple[omtwarp.Surface, Repaired | None]:
    """Return a surface that can be mapped, and the repairs if there were any; say what was noted and repaired.

    Args:
        path: the file.
        vertices, faces: what is in it.
        notes: what reading did, in words; repairs are added.
        repair: whether to repair the mesh first.
        any_surface: whether holes, handles and several parts are left to :func:`omtwarp.map_surface`.

    Raises:
        OmtwarpError: the mesh cannot be mapped.
    """
    from omtwarp.mesh.validate import as_arrays, require_valid

    repaired = omtwarp.repair(vertices, faces, whole=not any_surface) if repair else None
    if repaired is not None and repaired.actions:
        vertices, faces = repaired.vertices, repaired.faces
        notes += repaired.actions
    say_notes(path, notes)
    checked = as_arrays(vertices, faces) if any_surface else require_valid(vertices, faces, str(path))
    surface = omtwarp.Surface(*checked)
    surface.checked = not any_surface
    return surface, repaired if repaired is not None and repaired.actions else None


def read_sound_mesh(
    path: Path, repair: bool = False, *, any_surface: bool = False, smoothing: int | None = None
) -> Input:
    """Read a mesh and make sure that it can be mapped.

    Args:
        path: the file.
        repair: whether to repair the mesh first.
        any_surface: whether holes, handles and several parts are left to :func:`omtwarp.map_surface`.
        smoothing: of the surfaces of a volume's labels, as for :func:`omtwarp.read_mesh`.

    Raises:
        OmtwarpError: the file cannot be read, or its mesh cannot be mapped.
    """
    from omtwarp.mesh.read import read_joined_mesh

    mesh = read_joined_mesh(path, together=repair or any_surface, smoothing=smoothing)
    notes = [*of_a_map(path), *mesh.notes]
    surface, repaired = sound_surface(path, mesh.vertices, mesh.faces, notes, repair, any_surface=any_surface)
    surface.origins = mesh.after(repaired)
    return Input(surface, mesh, notes)


def of_a_map(path: Path) -> list[str]:
    """Return a note where a file that is read as a mesh is that of a map, whole or not; otherwise none."""
    from omtwarp.maps.result import is_map_file

    return ["a map's file, of which only the mesh is read"] if is_map_file(path) else []


def outputs_of(meshes: Sequence[Path], output: Output, suffix: str) -> list[Output]:
    """Return the output path of every mesh: the named file for one mesh, files in the named directory for several.

    Raises:
        OmtwarpError: the directory cannot be made, two meshes of one name would write one file, or several files
            would go to standard output.
    """
    if len(meshes) == 1 or output is None:
        return [output] * len(meshes)
    if is_standard_output(output):
        raise OmtwarpError(f"{len(meshes)} files cannot go to standard output: name a directory with -o")
    targets: list[Output] = [output / f"{mesh.stem}{suffix}" for mesh in meshes]
    if twice := [target for k, target in enumerate(targets) if target in targets[:k]]:
        raise OmtwarpError(f"two meshes would both be written as '{twice[0]}': rename one, or map them by themselves")
    if not output.exists():
        _made.append(output)
    make_folder(output)
    guard_results(output, *(target.name for target in targets if target))
    return targets


_made: list[Path] = []  # folders of outputs that were not there before


def targets_of(source: Source, output: Path, suffix: str, allowed: tuple[str, ...], *inputs: Path | None) -> list[Path]:
    """Return the output path of every mesh, as :func:`outputs_of`, or that of a finished map in their place.

    Args:
        source: the meshes or the map, none of which may be written to.
        output: what the user named.
        suffix: of the files in a directory.
        allowed: the suffixes that can be written.
        inputs: further files that are read.

    Raises:
        OmtwarpError: as of :func:`outputs_of`, one map is given for several meshes, or a file cannot be written.
    """
    meshes, one_map = source.meshes or [], source.finished
    if len(meshes) > 1 and one_map is not None:
        raise OmtwarpError(f"one map '{one_map}' cannot be that of {len(meshes)} meshes: give one mesh, or no map")
    targets = outputs_of(meshes, output, suffix) if len(meshes) > 1 else [output]
    for target in targets:
        check_output(target, allowed, *source.files, *inputs)
    return targets


def show_each(
    meshes: Sequence[Path] | None,
    targets: Iterable[Target],
    action: Callable[[Path | None, Target], tuple[Mapping[str, object], str]],
    printing: Printing,
    failure: Callable[[Mapping[str, object]], str] = lambda facts: "",
) -> None:
    """Process every mesh and print the outcomes; with several, one that fails does not stop the others.

    Args:
        meshes: the inputs; none where a finished map takes their place.
        targets: what is written for each.
        action: processes one mesh, or None for the map, and returns the facts about it and a line for readers.
        printing: whether facts are printed as JSON or lines. JSON is a list for several meshes, an object for one, and
            an empty list where that one fails.
        failure: says, from the facts about a mesh, what is wrong with it; empty where nothing is.

    Raises:
        OmtwarpError: the only mesh fails, with its own message; or some of several fail, each with a message before.
    """
    given: Sequence[Path | None] = meshes or [None]
    known: list[Mapping[str, object]] = []
    failed: list[str] = []
    try:
        for mesh, target in zip(given, targets, strict=True):
            try:
                facts, line = action(mesh, target)
                known.append(facts)
                if not printing.as_json and not printing.quiet:
                    print(line)
                if wrong := failure(facts):
                    raise OmtwarpError(wrong)
            except OmtwarpError as error:
                if len(given) == 1:
                    raise
                words = str(error)
                say(words if str(mesh) in words else f"{mesh}: {words}")
                failed.append(str(mesh))
    finally:
        if printing.as_json:
            print(report_text(known[0] if len(given) == 1 and known else known), end="")
    if failed:
        for folder in _made:
            with suppress(OSError):  # something was written in it
                folder.rmdir()
        raise OmtwarpError(f"{len(failed)} of {len(given)} meshes failed: {', '.join(failed)}")


def start_device(device: str) -> None:
    """Start Warp and make sure that the device exists, before anything long is done.

    Raises:
        OmtwarpError: an unknown device, or CUDA asked for where there is none.
    """
    parse_device(device)  # checked before Warp starts
    from omtwarp.device.policy import resolve_device

    resolve_device(device)


def require_own_hemisphere(structure: str | None, output: Path, asked: str | None = None) -> None:
    """Refuse an output whose name, or an option, names the other hemisphere than what is written.

    Args:
        structure: the part of the brain that is written, None where it is not known.
        output: the file.
        asked: the part that the option ``--hemisphere`` names.

    Raises:
        OmtwarpError: one names the other hemisphere.
    """
    from omtwarp.mesh.neuro import STRUCTURES, structure_in_name

    for what, named in {"--hemisphere": asked, f"'{output}'": structure_in_name(output.name)}.items():
        if {structure, named} == set(STRUCTURES.values()):
            raise OmtwarpError(f"{what} names the other hemisphere than what is written, {structure}")


def refuse(options: Mapping[str, object]) -> None:
    """Refuse options that would have no effect.

    Args:
        options: by what they are for, in words; one that is given counts as true.

    Raises:
        OmtwarpError: some option is given.
    """
    for words, given in options.items():
        if given:
            raise OmtwarpError(f"{words}: leave it out")


def route_of(mapping: MapOptions) -> dict[str, object]:
    """Return the options of a map that are given, but for the device, with their values."""
    usual = vars(MapOptions(device=mapping.device))
    return {f"--{name.replace('_', '-')}": value for name, value in vars(mapping).items() if value != usual[name]}


def require_whole(result: MapResult, name: object) -> MapResult:
    """Make sure that a map covers the sphere, with what fills its holes, as integrals over it and harmonics need.

    Args:
        result: a map.
        name: of its file, for the message.

    Raises:
        OmtwarpError: the map covers a torus, a hemisphere, a disk or a cap, or is of several parts.
    """
    with naming(f"'{name}'"):
        result.closed()
    return result


def load_whole_map(path: Path) -> MapResult:
    """Read a finished map that covers the sphere.

    Args:
        path: the file.

    Raises:
        OmtwarpError: the file is missing or is no map to the sphere, or the map covers a part of it.
    """
    return require_whole(omtwarp.MapResult.load(path), path)


def report_text(report: object) -> str:
    """Convert a report, or several, to JSON; numbers that are not finite become null."""

    def plain(value: object) -> object:
        if isinstance(value, dict):
            return {str(name): plain(entry) for name, entry in value.items()}
        if isinstance(value, list | tuple):
            return [plain(entry) for entry in value]
        if hasattr(value, "tolist"):  # an array or number of NumPy
            return plain(value.tolist())
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return json.dumps(plain(report), indent=1, allow_nan=False) + "\n"


def make_map(
    surface: omtwarp.Surface,
    mapping: MapOptions,
    quiet: bool,
    any_surface: dict[str, object] | None = None,
    **mass: object,
) -> MapResult:
    """Map a mesh with a progress bar; its warnings are lines on standard error.

    Args:
        surface: what to map.
        mapping: the options of the map.
        quiet: whether to draw no progress.
        any_surface: options of :func:`omtwarp.map_surface` for a mesh that is no sphere.
        mass: weights of vertices or triangles, which of them, and the density on the sphere.
    """
    if mapping.method in (Method.TUTTE, Method.MEAN_VALUE):
        refuse({f"--until is for methods of several stages, not for {mapping.method}": "--until" in route_of(mapping)})
    with warnings_as_lines(), progress_bar(quiet) as bar:
        mapped: Callable[..., MapResult] = omtwarp.map_to_sphere if any_surface is None else omtwarp.map_surface
        return mapped(surface, progress=bar, **mass, **vars(mapping) | (any_surface or {}))


def require_bijective(result: MapResult, path: Path | None = None) -> None:
    """Make sure that a map is one to one.

    Raises:
        OmtwarpError: the map is not one to one; the message counts the flipped triangles and names the first.
    """
    if not result.bijective:
        raise OmtwarpError(f"{path or 'the map'}: not one to one: {result.certificate}")


def map_from(mesh: Path | None, source: Source, mapping: MapOptions, printing: Printing) -> MapResult:
    """Return the map that a command works on: read if it is finished, otherwise computed from the mesh.

    Args:
        mesh: a mesh, or a finished map in its place; None for the finished map that is given.
        source: all that is given.
        mapping: the options of a new map.
        printing: what is said about it.

    Raises:
        OmtwarpError: neither or both of mesh and map are given, or the one given cannot be used.
    """
    from omtwarp.maps.result import is_map_file

    finished = source.finished
    if mesh is not None and finished is None and is_map_file(mesh):
        mesh, finished = None, mesh  # a map in place of a mesh
    if finished is not None:
        if mesh is not None:
            raise OmtwarpError(f"both a mesh '{mesh}' and a finished map '{finished}': the map has its mesh, give one")
        of_new = [*route_of(mapping), *["--repair"] * source.repair]
        refuse({f"{name} is for new maps, and '{finished}' is finished": True for name in of_new})
        return omtwarp.MapResult.load(finished)
    if mesh is None:
        raise OmtwarpError("nothing to work on: give a mesh, or a finished map with --map")
    return map_on_the_way(read_sound_mesh(mesh, source.repair).surface, mesh, mapping, printing)


def map_on_the_way(surface: omtwarp.Surface, mesh: Path, mapping: MapOptions, printing: Printing) -> MapResult:
    """Map the surface of a file for a command that needs its map, and print its quality and what every stage did."""
    start_device(mapping.device)
    result = make_map(surface, mapping, quiet=printing.quiet)
    if printing.verbose:
        say_stages(result)
    if not printing.quiet:
        say(f"{mesh}: {quality(facts_of(result, mesh))}")
    return result


def say_stages(result: MapResult) -> None:
    """Print a line about every stage of a map."""
    for stage in result.report["stages"]:
        words = [f"{stage['seconds']:.2f} s"] if "seconds" in stage else []
        words += [f"{kind} {stage[kind]['surface']:.4f}" for kind in ("area", "angle")]
        words += [f"flips {stage['flips']}"] if "flips" in stage else []
        say(f"{stage['name']}: {', '.join(words)}")
