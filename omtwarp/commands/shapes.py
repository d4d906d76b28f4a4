"""``omtwarp spharm``, ``distance`` and ``group``: shapes in spherical harmonics, how far two are apart, and groups."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import omtwarp
from omtwarp.commands._options import Argument, Only, Printing, Source, Typed, output_option
from omtwarp.commands._streams import STREAM, input_file, input_table, progress_bar, say, step_times
from omtwarp.commands._work import load_whole_map, map_from, require_whole, show_facts, start_device
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files.output import check_folder, check_outputs, folder_of_results, write_text
from omtwarp.options import Device, MapOptions

if TYPE_CHECKING:
    from omtwarp.shape_analysis.expansion import Expansion
    from omtwarp.shape_analysis.group import GroupStudy


EXPANSIONS = (".coef", ".csv", ".npz")


class Fit(StrEnum):
    """How coefficients are found; the values are those of :func:`omtwarp.shape_analysis.expansion.expand`."""

    LEAST_SQUARES, QUADRATURE = "least-squares", "quadrature"


def run_spharm(
    *,
    output: Annotated[Path, output_option(".csv")],
    mesh: Annotated[Path | None, Argument(file=input_file)] = None,
    source: Annotated[Source, Only(("finished", "repair"))],
    degree: Annotated[int, Typed(bounds=(0, 500))] = 15,
    fit: Fit = Fit.LEAST_SQUARES,
    reconstruction: Path | None = None,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Expand a surface in spherical harmonics over its map to the sphere (SPHARM).

    Holes are expanded as they were filled, but count for nothing in the error.

    Harmonics are real and orthonormal, without the Condon-Shortley phase; a .coef file has SPHARM-PDM's own order and
    signs.

    Examples:
        omtwarp spharm left.npz -o left.coef --degree 15 --reconstruction smooth.ply
        omtwarp spharm left.npz -o left.csv --fit quadrature --json

    Options:
        output: .coef as SPHARM-PDM has it, .csv, or .npz with everything; - is standard output, as .csv.
        degree (L): Highest degree of the harmonics.
        fit: How to fit: least squares at the vertices, or integrals over the triangles.
        reconstruction (MESH): Also write the surface that the coefficients describe.
        mesh (MESH): A closed triangle mesh, or -; not needed with --map.
    """
    import numpy as np

    from omtwarp.mesh.write import SUFFIXES as MESH_SUFFIXES, write_mesh
    from omtwarp.shape_analysis.expansion import expand
    from omtwarp.spheres import mesh_grid

    check_outputs([(output, EXPANSIONS), (reconstruction, MESH_SUFFIXES)], mesh, source.finished)
    start_device(device)
    result = require_whole(map_from(mesh, source, MapOptions(device=device), printing), source.finished or mesh)
    whole = result.closed()
    mesh_grid(whole.sphere, whole.faces, str(source.finished or mesh))  # harmonics need a map that covers it once
    with step_times(printing.verbose) as done:
        expansion = expand(whole.sphere, whole.vertices, degree, faces=whole.faces, method=fit.value)
        done("expand")
        again = expansion.at(result.sphere)
        done("reconstruct")
    areas = omtwarp.Surface(result.vertices, result.faces).vertex_areas
    error = float(np.sqrt(areas @ ((again - result.vertices) ** 2).sum(axis=1) / areas.sum()))
    _save_expansion(output, expansion)
    if reconstruction is not None:
        write_mesh(reconstruction, again, result.faces)
    size = float(np.sqrt(expansion.power()[1:].sum() / (4.0 * np.pi)))
    line = f"{output}: degree {degree}, root mean square error {error:.6g} of a size of {size:.6g}"
    show_facts({"degree": degree, "rms_error": error, "power": expansion.power()}, line, printing)


def _save_expansion(path: Path, expansion: Expansion) -> None:
    """Write coefficients in the format of the file's suffix."""
    from omtwarp.files.inputs import write_arrays
    from omtwarp.geometry.harmonics import degrees, orders
    from omtwarp.shape_analysis.expansion import write_coef

    suffix = path.suffix.lower()
    if suffix == ".coef":
        write_coef(path, expansion)
        return
    degree, order = degrees(expansion.degree), orders(expansion.degree)
    if suffix == ".npz":
        power = expansion.power()
        write_arrays(path, {"coefficients": expansion.coefficients, "degree": degree, "order": order, "power": power})
        return
    rows = zip(degree.tolist(), order.tolist(), expansion.coefficients.tolist(), strict=True)
    lines = [f"{n},{m}," + ",".join(map(repr, row)) for n, m, row in rows]
    write_text(path, "\n".join(["degree,order,x,y,z", *lines, ""]))


def run_distance(
    *,
    first: Annotated[Path, Argument(file=input_file)],
    second: Annotated[Path, Argument(file=input_file)],
    degree: Annotated[int, Typed(bounds=(1, 64))] = 12,
    scale: bool = False,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Measure the distance of two shapes, whatever their positions and rotations.

    There are two measures: the root mean square distance of corresponding points, from coefficients of spherical
    harmonics; and the root of the least transport cost between the densities of their conformal maps, in radians.

    Examples:
        omtwarp distance left.npz right.npz --json

    Options:
        first (A): A map (.npz); - is standard input.
        second (B): Another map (.npz).
        degree (L): Highest degree of the harmonics.
        scale: Scale both shapes to the same size before coefficients are compared.
    """
    from omtwarp.shape_analysis.distance import shape_distance

    start_device(device)
    ends = load_whole_map(first), load_whole_map(second)
    with progress_bar(printing.quiet, printing.verbose) as progress:
        distances = shape_distance(*ends, degree=degree, scale=scale, device=device, progress=progress)
    apart, transport = f"{distances.coefficients:.6g}", f"{distances.transport:.6g}"
    if printing.quiet and not printing.as_json:
        print(apart, transport)
    line = f"coefficients {apart} ({'at size 1' if scale else 'unit of the surfaces'}), transport {transport} radians"
    show_facts({"first": str(first), "second": str(second), **distances.to_dict()}, line, printing)


@dataclass(frozen=True)
class Study:
    """What is computed: options of :func:`omtwarp.shape_analysis.study_group`, by their names there.

    Options:
        grid (GRID): Sphere whose points are compared.
        components (N): Largest number of principal components.
        degree (L): Highest degree of the harmonics in distances.
        scale: Scale all shapes to the same size.
        permutations (N): Number of permutations that test differences.
        seed (N): Seed of the random permutations.
        transport: Also compute transport distances of all pairs.
    """

    grid: str = "ico4"
    components: Annotated[int, Typed(bounds=(1, None))] = 5
    degree: Annotated[int, Typed(bounds=(1, 64))] = 12
    scale: bool = False
    permutations: Annotated[int, Typed(bounds=(1, None))] = 999
    seed: Annotated[int, Typed(bounds=(0, None))] = 0
    transport: bool = False


def run_group(
    *,
    sources: Annotated[list[str], Argument()],
    output: Annotated[Path, output_option()],
    covariate: list[str] | None = None,
    study: Study,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Compare a group of maps: mean shape, principal components, distances, and where two groups differ.

    The folder gets table.csv, distances.csv, transport.csv where asked for, the mean and the components as .ply, .vtk
    and GIFTI, and report.html. Groups, named in the table's column 'group', and covariates are tested point by point
    with a linear model and permutations; each given all others.

    Examples:
        omtwarp group subjects.csv -o study
        omtwarp group left.npz right.npz -o study --grid ico3

    Options:
        sources (MANIFEST|MAPS): A table with the columns 'path' and 'group' (- is standard input), a cohort's folder,
            or maps.
        output (DIR): Folder of the results.
        covariate (COLUMN): A column of the table that may explain differences, such as age or site: repeat.
    """
    from omtwarp.mesh.neuro import structure_of
    from omtwarp.shape_analysis.group import GROUP, check_table, mirrored_words, study_group, table_of
    from omtwarp.shape_analysis.reports import write_group_report

    check_folder(output)
    names, paths, rows = _listed(sources)
    if folders := [path for path in paths if path.is_dir()]:
        raise OmtwarpError(f"'{folders[0]}' is no cohort's folder: give the maps in it, without a template")
    labels, covariates = _columns(rows, covariate or [], sources[0])
    if len(paths) < 2:
        raise OmtwarpError(f"{len(paths)} map in all: a group needs at least two")
    table = table_of(labels, covariates)
    if table:
        check_table(table, len(paths), GROUP)
    start_device(device)
    with folder_of_results(output, "table.csv", "distances.csv", "report.html"):  # refused before the work
        pass
    with progress_bar(printing.quiet, printing.verbose) as progress, warnings.catch_warnings():
        warnings.simplefilter("ignore", OmtwarpWarning)  # said below, with the names
        maps, asked = list(map(load_whole_map, paths)), vars(study)
        result = study_group(maps, labels, covariates=covariates, device=device, progress=progress, **asked)
        with folder_of_results(output):
            like = paths[0] if len(set(map(structure_of, paths))) == 1 else None  # of one part of the brain
            files = write_group_report(result, output, names, labels, covariates, like)
    if mirrored := mirrored_words(result.alignment, names):
        say(f"warning: {mirrored}")
    facts = {"output": str(output), "files": [file.name for file in files], "shapes": len(paths)}
    show_facts(facts | _findings(result, names), _group_line(result, output), printing)


def _findings(study: GroupStudy, names: Sequence[str]) -> dict[str, object]:
    """Return the findings about a group by name, ready for JSON."""
    from omtwarp.shape_analysis.reports import SIGNIFICANT

    effects = study.effects.items()
    return {
        "explained": study.components.explained,
        "mirrored": [name for name, image in zip(names, study.alignment.mirrored, strict=True) if image],
        "smallest_p": {name: float(effect.p_values.min()) for name, effect in effects},
        "significant_points": {name: int((effect.p_values <= SIGNIFICANT).sum()) for name, effect in effects},
        "discovered_points": {name: int((effect.fdr <= SIGNIFICANT).sum()) for name, effect in effects},
    }


def _group_line(study: GroupStudy, output: Path) -> str:
    shares = ", ".join(f"{100 * share:.0f} %" for share in study.components.explained)
    line = f"{output / 'report.html'}: {len(study.from_mean)} shapes, components with {shares} of the variance"
    least = ", ".join(f"{name} {effect.p_values.min():.3g}" for name, effect in study.effects.items())
    return f"{line}; smallest corrected p of {least}" if least else line


def _listed(sources: list[str]) -> tuple[list[str], list[Path], list[Mapping[str, object]]]:
    """Return the name and file of every member, and what a table says about it.

    Members of a cohort are those that it mapped, by the maps in its folder.
    """
    from omtwarp.cohort.tables import map_of, read_manifest, table_of_cohort

    one = sources[0] if len(sources) == 1 else ""
    cohort = table_of_cohort(Path(one)) if one and one != str(STREAM) else None
    if cohort is not None:
        folder, rows = cohort
        return [str(row["id"]) for row in rows], [map_of(folder, row) for row in rows], list(rows)
    if one == str(STREAM) or Path(one).suffix.lower() in (".csv", ".tsv"):
        items = read_manifest(input_table(one))
        return [item.id for item in items], [item.path for item in items], [item.fields for item in items]
    paths = [Path(str(input_file(text))) for text in sources]
    stems = [path.stem for path in paths]
    return stems if len(set(stems)) == len(stems) else list(map(str, paths)), paths, [{}] * len(paths)


def _columns(
    rows: list[Mapping[str, object]], wanted: Sequence[str], table: str
) -> tuple[list[str] | None, dict[str, list[object]]]:
    """Return the groups of all members, None where they have none, and the covariates wanted.

    Raises:
        OmtwarpError: a covariate that is no column, or some members have a group and others none.
    """
    if missing := [name for name in wanted if not any(name in row for row in rows)]:
        raise OmtwarpError(f"there is no column '{missing[0]}': covariates are columns of the table of maps")
    groups = [str(row["group"]) for row in rows if row.get("group") is not None]
    if groups and len(groups) < len(rows):
        raise OmtwarpError(f"{len(rows) - len(groups)} of {len(rows)} maps in '{table}' have no group")
    return groups or None, {name: [row.get(name) for row in rows] for name in wanted}
