"""``omtwarp register``: a map's sphere, warped until its surface's features lie where another map has them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import Printing, named
from omtwarp.commands._streams import input_file, is_standard_output, progress_bar, warnings_as_lines
from omtwarp.commands._work import Pair, show_facts
from omtwarp.commands.film import FILMS
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_folder, check_output
from omtwarp.options import Side

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from omtwarp.registration import GroupRegistration, Registration, SequenceRegistration
    from omtwarp.resampling import SpherePoints


@dataclass(frozen=True)
class Several:
    """What is done with more maps than one.

    Options:
        more: Further maps, for --group and --sequence.
        group: Make a template from all maps and register them to it; -o is a folder. --feature: once for each map.
        sequence: Register one subject's maps in the order of time to the first; -o is a folder.
        rounds: How many times the template of --group is made anew.
    """

    more: Annotated[list[Path] | None, typer.Argument(metavar="MORE", callback=input_file)] = None
    group: bool = False
    sequence: bool = False
    rounds: Annotated[int, typer.Option(metavar="N", min=1)] = 3

    @property
    def mode(self) -> str:
        """The option that asks for several maps, empty where none does.

        Raises:
            OmtwarpError: both options are given.
        """
        if self.group and self.sequence:
            raise OmtwarpError("--group and --sequence exclude each other")
        return "--group" if self.group else "--sequence" if self.sequence else ""


@dataclass(frozen=True)
class Extras:
    """What is written beside the registered map.

    Options:
        strain (FILE): Write log2 of ratios of areas and of stretches at MOVING's vertices too.
        before (MESH): Write MOVING's sphere as it was too: with the sphere of -o a deformation.
        report (HTML): Write a page: features before and after, strain, pictures.
        film (FILE): Write a film of the warp of a map (.npz): .mp4, .gif or .webp.
    """

    strain: Path | None = None
    before: Path | None = None
    report: Path | None = None
    film: Path | None = None

    def check(self, pair: Pair) -> None:
        """Make sure that all can be written.

        Raises:
            OmtwarpError: a file cannot be written, or a film is asked for of a sphere alone.
        """
        from omtwarp.mesh.data import DATA_SUFFIXES
        from omtwarp.mesh.write import SUFFIXES

        if self.film is not None and pair.source.suffix.lower() != ".npz":
            raise OmtwarpError("--film needs a map (.npz): a sphere alone has no surface to film")
        suffixes = {self.strain: DATA_SUFFIXES, self.before: SUFFIXES, self.report: (".html", ".htm")}
        for extra, allowed in (suffixes | {self.film: FILMS}).items():
            if extra is not None:
                check_output(extra, allowed, pair.source, pair.surface)

    def write(self, found: Registration, pair: Pair, moving: SpherePoints, fixed: SpherePoints | str) -> None:
        """Write all that is asked for about a registration of one sphere to another."""
        points, faces = moving.grid.points[: moving.grid.own_points], moving.grid.own_triangles
        if self.strain is not None:
            _write_strain(self.strain, found, faces, pair.surface or pair.source)
        if self.before is not None:
            from omtwarp.mesh.write import write_mesh

            write_mesh(self.before, pair.radius * points, faces, spherical=True, like=pair.source)
        if self.report is not None:
            from omtwarp.registration.sides import target_points
            from omtwarp.shape_analysis.registration_report import write_registration_page

            write_registration_page(self.report, found, moving, target_points(fixed)[0])
        if self.film is not None:
            from omtwarp.maps.result import MapResult
            from omtwarp.shape_analysis.registration_report import film_warp

            film_warp(self.film, found, MapResult.load(pair.source))


@dataclass(frozen=True)
class Strength:
    """How much the warp may distort.

    Options:
        keep_areas (NUMBER|exact): Weight of squared changes of the areas around vertices.
        stiffness (NUMBER): Weight of distortion against differences of features.
        max_strain (NUMBER): Bound of |log2| of ratios of areas, and of stretches, of every triangle.
    """

    keep_areas: str = "0"
    stiffness: float = 0.44
    max_strain: float = 1.1

    def keywords(self) -> dict[str, float | str]:
        """Return the options as functions take them, which refuse a text for areas unless it is ``exact``."""
        with contextlib.suppress(ValueError):
            return vars(self) | {"keep_areas": float(self.keep_areas)}
        return dict(vars(self))


def run(
    *,
    pair: Pair,
    several: Several,
    to: Annotated[str | None, typer.Option(metavar="TARGET", callback=input_file)] = None,
    hemisphere: Annotated[Side | None, named(Side)] = None,
    feature_weight: list[float] | None = None,
    landmarks: Path | None = None,
    extras: Extras,
    strength: Strength,
    printing: Printing,
) -> None:
    """Warp a map's sphere until features of its surface lie where another map has them.

    Features are sulcal depth and curvature of both surfaces, or those given. The warp begins at the rotation under
    which they agree best or at a match of places that look alike, flips no triangle, and strains none more than is
    allowed. Where the next best rotation agrees nearly as well the start is doubtful: several are tried, and the output
    says so.

    Examples:
        omtwarp register left.npz --to right.npz -o registered.npz
        omtwarp register lh.npz --to mean.npz -o lh.reg.surf.gii --max-strain 1

    Options:
        to: A map, a template, fsaverage5, fsaverage, fsLR32k, or a sphere with its surface or features; -.
        hemisphere: Of fsaverage5, fsaverage or fsLR32k; by default the one that MOVING says.
        feature_weight (NUMBER): What a feature counts, in their order (sulcal depth, curvature if none are given):
            repeat for all.
        landmarks (FILE): A table of points and curves on both sides: columns label, side, vertex or x, y, z, and
            weight.
    """
    from omtwarp.mesh.neuro import structure_of
    from omtwarp.registration import register
    from omtwarp.registration.group_template import is_template
    from omtwarp.resampling import file_points
    from omtwarp.resampling.averages import is_average, with_side
    from omtwarp.spheres import is_named

    if several.mode:
        alone = {"--to": to, "--landmarks": landmarks, "--feature-weight": feature_weight}
        _require_many(several.mode, pair, alone | {f"--{name}": file for name, file in vars(extras).items()})
        _register_many(pair, several, strength, printing)
        return
    if to is None or several.more:
        raise OmtwarpError("give one map and --to TARGET, or several maps and --group or --sequence")
    extras.check(pair)
    if not (pair.feature and is_named(to)):
        to = with_side(to, hemisphere or structure_of(pair.source) or structure_of(pair.surface))
    other = None if is_named(to) or is_average(to) else Path(to)
    pair.check(other)
    with progress_bar(printing.quiet, printing.verbose) as progress:
        moving = file_points(pair.source, pair.surface)
        fixed = to if is_average(to) or is_template(to) else file_points(to, pair.to_surface)
        mine, others = pair.features(other)
        weights = None if feature_weight is None else _named_weights(list(mine or ["sulc", "curv"]), feature_weight)
        warp: Callable[..., Registration] = register  # whose options are read from groups
        of_both = {"features": mine, "to_features": others, "feature_weights": weights, "landmarks": landmarks}
        found = warp(moving, fixed, progress=progress, **of_both, **strength.keywords())
    pair.write(found.registered, found.sphere, moving.grid.own_triangles)
    extras.write(found, pair, moving, fixed)
    show_facts({"output": str(pair.output), **found.to_dict()}, f"{pair.output}: {_line(found)}", printing)


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


def _register_many(pair: Pair, several: Several, strength: Strength, printing: Printing) -> None:
    """Register maps to a template made from them, or to the first of them, and say how well."""
    from omtwarp.registration import register_group, register_sequence

    maps = [pair.source, *(several.more or [])]
    features = _by_feature(pair.feature or [], len(maps))
    with progress_bar(printing.quiet, printing.verbose) as progress, warnings_as_lines():
        warp: Callable[..., GroupRegistration | SequenceRegistration] = register_sequence
        if several.group:
            warp = partial(register_group, rounds=several.rounds)
        table = warp(maps, pair.output, features=features, progress=progress, **strength.keywords()).table
    made = pair.output / ("template.npz" if several.group else "strain.npz")
    drift = max(one.get("drift", 0.0) for one in table.values())
    told = "" if several.group else f"; drift at most {drift:.2f} degrees"
    line = f"{made}: {_many_line(list(table.values()))}{told}"
    show_facts({"output": str(pair.output), "maps": table}, line, printing)


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
        line += f"; the start is doubtful ({scores}): the best of {len(found.starts)} starts was taken"
    return line
