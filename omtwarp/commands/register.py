"""``omtwarp register``: a map's sphere, warped until its surface's features lie where another map has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._features import Pair
from omtwarp.commands._options import Printing, named
from omtwarp.commands._progress import progress_bar
from omtwarp.commands._streams import input_file, is_standard_output, warnings_as_lines
from omtwarp.commands._work import report_text
from omtwarp.commands.film import FILMS
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_folder, check_output
from omtwarp.options import Side

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from omtwarp.registration import GroupRegistration, Registration, SequenceRegistration
    from omtwarp.resampling import SpherePoints


def register_map(
    *,
    pair: Pair,
    more: Annotated[
        list[Path] | None,
        typer.Argument(metavar="MORE", callback=input_file, help="Further maps, for --group and --sequence."),
    ] = None,
    to: Annotated[
        str | None,
        typer.Option(
            metavar="TARGET",
            callback=input_file,
            help="A map, a template, fsaverage5, fsaverage, fsLR32k, or a sphere with its surface or features; -.",
        ),
    ] = None,
    hemisphere: Annotated[
        Side | None, named(Side, "Of fsaverage5, fsaverage or fsLR32k; by default the one that MOVING says.")
    ] = None,
    group: Annotated[
        bool,
        typer.Option(
            "--group",
            help="Make a template from all maps and register them to it; -o is a folder. --feature: once for each map.",
        ),
    ] = False,
    sequence: Annotated[
        bool,
        typer.Option(
            "--sequence", help="Register one subject's maps in the order of time to the first; -o is a folder."
        ),
    ] = False,
    rounds: Annotated[
        int, typer.Option(metavar="N", min=1, help="How many times the template of --group is made anew.")
    ] = 3,
    feature_weight: Annotated[
        list[float] | None,
        typer.Option(
            metavar="NUMBER",
            help="What a feature counts, in their order (sulcal depth, curvature if none are given): repeat for all.",
        ),
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A table of points and curves on both sides: columns label, side, vertex or x, y, z, and weight.",
        ),
    ] = None,
    keep_areas: Annotated[
        str,
        typer.Option(metavar="NUMBER|exact", help="Weight of squared changes of the areas around vertices."),
    ] = "0",
    strain: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write log2 of ratios of areas and of stretches at MOVING's vertices too."),
    ] = None,
    before: Annotated[
        Path | None,
        typer.Option(metavar="MESH", help="Write MOVING's sphere as it was too: with the sphere of -o a deformation."),
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="HTML", help="Write a page: features before and after, strain, pictures.")
    ] = None,
    film: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write a film of the warp of a map (.npz): .mp4, .gif or .webp."),
    ] = None,
    stiffness: Annotated[
        float, typer.Option(metavar="NUMBER", help="Weight of distortion against differences of features.")
    ] = 0.44,
    max_strain: Annotated[
        float,
        typer.Option(metavar="NUMBER", help="Bound of |log2| of ratios of areas, and of stretches, of every triangle."),
    ] = 1.1,
    printing: Printing,
) -> None:
    """Warp a map's sphere until features of its surface lie where another map has them.

    Features are sulcal depth and curvature of both surfaces, or those given. The warp begins at the rotation under
    which they agree best, flips no triangle, and strains none more than --max-strain. Where the next best rotation
    agrees nearly as well the start is doubtful: several are tried, and the output says so.
    """
    from omtwarp.mesh.data import DATA_SUFFIXES
    from omtwarp.mesh.neuro import structure_of
    from omtwarp.mesh.write import SUFFIXES, write_mesh
    from omtwarp.registration import register
    from omtwarp.registration.group_template import is_template
    from omtwarp.resampling import file_points
    from omtwarp.resampling.averages import is_average, with_side
    from omtwarp.spheres import is_named

    if group and sequence:
        raise OmtwarpError("--group and --sequence exclude each other")
    if group or sequence:
        alone = {"--to": to, "--landmarks": landmarks, "--strain": strain, "--feature-weight": feature_weight}
        alone |= {"--before": before, "--report": report, "--film": film}
        _require_many("--group" if group else "--sequence", pair, alone)
        maps, kept = [pair.source, *(more or [])], _weight_or_exact(keep_areas)
        data = _by_feature(pair.feature or [], len(maps))
        _register_many(maps, data, pair.output, rounds if group else 0, stiffness, max_strain, kept, printing)
        return
    if to is None or more:
        raise OmtwarpError("give one map and --to TARGET, or several maps and --group or --sequence")
    if film is not None and pair.source.suffix.lower() != ".npz":
        raise OmtwarpError("--film needs a map (.npz): a sphere alone has no surface to film")
    suffixes = {strain: DATA_SUFFIXES, before: SUFFIXES, report: (".html", ".htm"), film: FILMS}
    for extra, allowed in suffixes.items():
        if extra is not None:
            check_output(extra, allowed, pair.source, pair.surface)
    if not (pair.feature and is_named(to)):
        to = with_side(to, hemisphere or structure_of(pair.source) or structure_of(pair.surface))
    other = None if is_named(to) or is_average(to) else Path(to)
    pair.check(other)
    with progress_bar(printing.quiet, printing.verbose) as progress:
        moving = file_points(pair.source, pair.surface)
        fixed = to if is_average(to) or is_template(to) else file_points(to, pair.to_surface)
        mine, others = pair.features(other)
        weights = None if feature_weight is None else _named_weights(list(mine or ["sulc", "curv"]), feature_weight)
        found = register(
            moving,
            fixed,
            features=mine,
            to_features=others,
            feature_weights=weights,
            stiffness=stiffness,
            max_strain=max_strain,
            landmarks=landmarks,
            keep_areas=_weight_or_exact(keep_areas),
            progress=progress,
        )
    pair.write(found.registered, found.sphere, moving.grid.own_triangles)
    if strain is not None:
        _write_strain(strain, found, moving.grid.own_triangles, pair.surface or pair.source)
    if before is not None:
        points, faces = moving.grid.points[: moving.grid.own_points], moving.grid.own_triangles
        write_mesh(before, pair.radius * points, faces, spherical=True, like=pair.source)
    if report is not None or film is not None:
        _show(report, film, found, pair.source, moving, fixed)
    if printing.as_json:
        print(report_text({"output": str(pair.output), **found.to_dict()}), end="")
    elif not printing.quiet:
        print(f"{pair.output}: {_line(found)}")


def _require_many(mode: str, pair: Pair, others: Mapping[str, object]) -> None:
    """Refuse options of one map where there are several, and an output that is no folder.

    Raises:
        OmtwarpError: there is such an option, or the folder cannot be made.
    """
    of_pair: dict[str, object] = {"--surface": pair.surface, "--to-surface": pair.to_surface}
    of_pair |= {"--to-feature": pair.to_feature, "--radius": pair.radius != Pair.radius}
    given = next((name for name, value in {**of_pair, **others}.items() if value), None)
    if given is not None:
        raise OmtwarpError(f"{given} is of one map: leave it out with {mode}")
    if is_standard_output(pair.output):
        raise OmtwarpError(f"{mode} writes a folder, not standard output: name one with -o")
    check_folder(pair.output)


def _by_feature(files: Sequence[Path], count: int) -> dict[str, Sequence[Path]]:
    """Return files of data by feature: those of the first for all maps, then those of the next.

    Raises:
        OmtwarpError: some map has none.
    """
    if len(files) % count:
        raise OmtwarpError(f"{len(files)} times --feature for {count} maps: give it once for each, in their order")
    return {f"feature {k // count + 1}": files[k : k + count] for k in range(0, len(files), count)}


def _register_many(
    maps: Sequence[Path],
    data: Mapping[str, Sequence[Path]],
    output: Path,
    rounds: int,
    stiffness: float,
    max_strain: float,
    keep_areas: float | str,
    printing: Printing,
) -> None:
    """Register maps to a template made from them in so many rounds, with 0 to the first of them, and say how well."""
    from omtwarp.registration import register_group, register_sequence

    with progress_bar(printing.quiet, printing.verbose) as progress, warnings_as_lines():
        run = partial(register_group, rounds=rounds) if rounds else register_sequence
        found: GroupRegistration | SequenceRegistration = run(
            maps,
            output,
            features=data,
            stiffness=stiffness,
            max_strain=max_strain,
            keep_areas=keep_areas,
            progress=progress,
        )
        table = found.table
    if printing.as_json:
        print(report_text({"output": str(output), "maps": table}), end="")
    elif not printing.quiet:
        made = output / ("template.npz" if rounds else "strain.npz")
        drift = max(one.get("drift", 0.0) for one in table.values())
        told = "" if rounds else f"; drift at most {drift:.2f} degrees"
        print(f"{made}: {_many_line(list(table.values()))}{told}")


def _many_line(facts: Sequence[Mapping[str, float]]) -> str:
    """Return how well many maps are registered, of their facts."""
    from omtwarp.registration.register import FACTS

    names = [name for name in facts[0] if name.startswith("registration_") and name.partition("_")[2] not in FACTS]
    agreement = ", ".join(f"{one.partition('_')[2]} {sum(row[one] for row in facts) / len(facts):.3f}" for one in names)
    flips, doubtful = (int(sum(row[f"registration_{name}"] for row in facts)) for name in ("flips", "doubtful"))
    largest = max(one["registration_strain"] for one in facts)
    return (
        f"{len(facts)} maps; {agreement} on average; largest strain {largest:.2f}; {flips} flips; {doubtful} doubtful"
    )


def _named_weights(names: list[str], weights: list[float]) -> dict[str, float]:
    """Return the weights of features by name.

    Raises:
        OmtwarpError: there are more or fewer weights than features.
    """
    if len(weights) != len(names):
        raise OmtwarpError(f"{len(weights)} times --feature-weight for {len(names)} features: give one for each")
    return dict(zip(names, weights, strict=True))


def _weight_or_exact(text: str) -> float | str:
    """Return the number of --keep-areas, or its text, which the function refuses unless it is ``exact``."""
    try:
        return float(text)
    except ValueError:
        return text


def _write_strain(file: Path, found: Registration, faces: NDArray, like: Path) -> None:
    """Write both strains at the vertices, with the structure of the surface."""
    import numpy as np

    from omtwarp.mesh.data import VertexData, write_data
    from omtwarp.mesh.neuro import structure_of
    from omtwarp.registration.strain import strain_at_vertices

    columns = [
        strain_at_vertices(found.start.sphere, faces, values) for values in (found.area_strain, found.stretch_strain)
    ]
    data = VertexData(np.column_stack(columns), ("area_log2", "stretch_log2"), structure=structure_of(like))
    write_data(file, data, (found.sphere, faces))


def _show(
    report: Path | None,
    film: Path | None,
    found: Registration,
    source: Path,
    moving: SpherePoints,
    fixed: SpherePoints | str,
) -> None:
    """Write the page and the film that are asked for."""
    from omtwarp.maps.result import MapResult
    from omtwarp.registration.sides import target_points
    from omtwarp.shape_analysis.registration_report import film_warp, write_registration_page

    if report is not None:
        write_registration_page(report, found, moving, target_points(fixed)[0])
    if film is not None:
        film_warp(film, found, MapResult.load(source))


def _line(found: Registration) -> str:
    """Return how well the features agree, how much the warp strains, and what is to be known about its start."""
    agreement = ", ".join(
        f"{name} {values['before']:.3f} to {values['after']:.3f}" for name, values in found.correlations.items()
    )
    certificate = found.certificate
    line = (
        f"{agreement}; largest strain {found.largest_strain:.2f} of {found.most_strain:g}; {certificate.flips} flips, "
        f"degree {certificate.degree}"
    )
    if found.landmarks:
        farthest = max(distance["after"] for distance in found.landmarks.values())
        line += f"; landmarks within {farthest:.2f} degrees"
    if found.doubtful:
        scores = f"{found.start.score:.3f} against {found.start.runner_up:.3f}"
        line += f"; the start is doubtful ({scores}): the best of {len(found.starts)} rotations was taken"
    return line
