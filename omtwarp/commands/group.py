"""``omtwarp group``: mean, components and differences of a group of maps."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import Printing, output_option
from omtwarp.commands._progress import progress_bar
from omtwarp.commands._streams import STREAM, input_file, input_table, say
from omtwarp.commands._work import load_whole_map, report_text, start_device
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.files.output import check_folder, folder_of_results
from omtwarp.options import Device, MapOptions


def group(
    *,
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="MANIFEST|MAPS",
            help="A table with the columns 'path' and 'group' (- is standard input), a cohort's folder, or maps.",
        ),
    ],
    output: Annotated[Path, output_option("Folder of the results.", metavar="DIR")],
    grid: Annotated[str, typer.Option(metavar="GRID", help="Sphere whose points are compared.")] = "ico4",
    components: Annotated[int, typer.Option(metavar="N", min=1, help="Largest number of principal components.")] = 5,
    degree: Annotated[
        int, typer.Option(metavar="L", min=1, max=64, help="Highest degree of the harmonics in distances.")
    ] = 12,
    scale: Annotated[bool, typer.Option("--scale", help="Scale all shapes to the same size.")] = False,
    permutations: Annotated[
        int, typer.Option(metavar="N", min=1, help="Number of permutations that test differences.")
    ] = 999,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the random permutations.")] = 0,
    transport: Annotated[
        bool, typer.Option("--transport", help="Also compute transport distances of all pairs.")
    ] = False,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Compare a group of maps: mean shape, principal components, distances, and where two groups differ.

    The folder gets table.csv, distances.csv, transport.csv where asked for, the mean and the components as .ply, .vtk
    and GIFTI, and report.html. Two groups, named in the table's column 'group', are compared point by point
    with Student's t and permutations.
    """
    from omtwarp.shape_analysis.group import mirrored_words, study_group, two_groups
    from omtwarp.shape_analysis.group_report import SIGNIFICANT, write_group_report

    check_folder(output)
    names, paths, labels = _members(sources)
    if len(paths) < 2:
        raise OmtwarpError(f"{len(paths)} map in all: a group needs at least two")
    if labels is not None:
        two_groups(labels, len(paths))
    start_device(device)
    with folder_of_results(output, "table.csv", "distances.csv", "report.html"):  # refused before the work
        pass
    with progress_bar(printing.quiet, printing.verbose) as progress, warnings.catch_warnings():
        warnings.simplefilter("ignore", OmtwarpWarning)  # said below, with the names
        study = study_group(
            [load_whole_map(path) for path in paths],
            labels,
            grid=grid,
            components=components,
            scale=scale,
            degree=degree,
            permutations=permutations,
            seed=seed,
            transport=transport,
            device=device,
            progress=progress,
        )
        with folder_of_results(output):
            files = write_group_report(study, output, names, labels, _of_one_structure(paths))
    mirrored = mirrored_words(study.alignment, names)
    if mirrored:
        say(f"warning: {mirrored}")
    smallest = None if study.difference is None else float(study.difference.p_values.min())
    if printing.as_json:
        record = {
            "output": str(output),
            "files": [file.name for file in files],
            "shapes": len(paths),
            "explained": study.components.explained,
            "mirrored": [name for name, image in zip(names, study.alignment.mirrored, strict=True) if image],
            "smallest_p": smallest,
            "significant_points": None
            if study.difference is None
            else int((study.difference.p_values <= SIGNIFICANT).sum()),
        }
        print(report_text(record), end="")
    elif not printing.quiet:
        shares = ", ".join(f"{100 * share:.0f} %" for share in study.components.explained)
        told = "" if smallest is None else f"; smallest corrected p of a difference {smallest:.3g}"
        print(f"{output / 'report.html'}: {len(paths)} shapes, components with {shares} of the variance{told}")


def _of_one_structure(paths: Sequence[Path]) -> Path | None:
    """Return the first of the maps where all name the same part of the brain as their content."""
    from omtwarp.mesh.neuro import structure_of

    return paths[0] if len({structure_of(path) for path in paths}) == 1 else None


def _members(sources: list[str]) -> tuple[list[str], list[Path], list[str] | None]:
    """Return the name, file and group of every member; groups come from a table's column ``group``.

    Members of a cohort are those that it mapped, by the maps in its folder.
    """
    from omtwarp.cohort.manifest import read_manifest
    from omtwarp.cohort.table import table_of_cohort

    rows = table_of_cohort(Path(sources[0])) if len(sources) == 1 and sources[0] != str(STREAM) else None
    if rows is not None:
        return _mapped_members(sources[0], *rows)
    if len(sources) == 1 and (sources[0] == str(STREAM) or Path(sources[0]).suffix.lower() in (".csv", ".tsv")):
        items = read_manifest(input_table(sources[0]))
        labels = [item.fields["group"] for item in items] if "group" in items[0].fields else None
        return [item.id for item in items], [item.path for item in items], labels
    paths = [Path(str(input_file(text))) for text in sources]
    stems = [path.stem for path in paths]
    return (stems if len(set(stems)) == len(stems) else [str(path) for path in paths]), paths, None


def _mapped_members(
    source: str, folder: Path, done: Sequence[Mapping[str, object]]
) -> tuple[list[str], list[Path], list[str] | None]:
    """Return name, file and group of every member that a cohort mapped, from the rows of its table."""
    groups = [str(row["group"]) for row in done if row.get("group") is not None]
    if groups and len(groups) < len(done):
        raise OmtwarpError(f"{len(done) - len(groups)} of {len(done)} maps in '{source}' have no group")
    return [str(row["id"]) for row in done], [folder / "maps" / f"{row['id']}.npz" for row in done], groups or None
