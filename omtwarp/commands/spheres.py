"""``omtwarp align`` and ``register``: a map's sphere turned or warped until it matches another."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import omtwarp
from omtwarp.commands._options import Argument, Printing, Typed, output_option
from omtwarp.commands._streams import input_file, is_standard_output, progress_bar, step_times, warnings_as_lines
from omtwarp.commands._work import refuse, require_own_hemisphere, show_facts
from omtwarp.commands.pictures import FILMS
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_folder, check_output, check_outputs
from omtwarp.options import MAX_STRAIN, STIFFNESS, AlignBy, Side

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from omtwarp.registration import GroupRegistration, Registration, SequenceRegistration
    from omtwarp.resampling import SpherePoints


@dataclass(frozen=True)
class Pair:
    """A sphere that is moved, another one, their surfaces, data at their vertices, and where the moved one goes.

    Options:
        source (MOVING): A map (.npz), or a sphere as a mesh; - is standard input.
        output: .npz for the whole map, or a mesh suffix for the sphere; - is standard output.
        surface (MESH): The surface of MOVING, where MOVING is a sphere without one.
        to_surface (MESH): The surface of the other sphere, where that is no .npz.
        feature (FILE): Compare by these data at MOVING's vertices; repeat for more features.
        to_feature (FILE): The same data at the other sphere's vertices, in this order.
        radius: Radius of a sphere that is written as a mesh; FreeSurfer's is 100.
    """

    source: Annotated[Path, Argument(file=input_file)]
    output: Annotated[Path, output_option(".npz")]
    surface: Path | None = None
    to_surface: Path | None = None
    feature: list[Path] | None = None
    to_feature: list[Path] | None = None
    radius: Annotated[float, Typed(bounds=(1e-06, 1000000000.0))] = 1.0

    @property
    def as_map(self) -> bool:
        """Whether a whole map is written."""
        return self.output.suffix.lower() == ".npz"

    def check(self, other: Path | None) -> None:
        """Make sure that the output can be written, and that no part of a brain meets another one.

        Args:
            other: the file of the other sphere, None where it is made.

        Raises:
            OmtwarpError: the output cannot be written, or is a map where there is none, or the parts differ, or the
                output names another one.
        """
        from omtwarp.mesh.neuro import require_same_structure
        from omtwarp.mesh.write import SUFFIXES

        check_output(self.output, (".npz", *SUFFIXES), self.source, self.surface)
        if self.as_map and self.source.suffix.lower() != ".npz":
            raise OmtwarpError(f"cannot write '{self.output}': a whole map needs a map (.npz) as input")
        refuse({"--radius is for spheres as meshes, not for .npz": self.as_map and self.radius != Pair.radius})
        files = self.surface, other, self.to_surface, *(self.feature or []), *(self.to_feature or [])
        require_own_hemisphere(require_same_structure(self.source, *files), self.output)

    def features(self, other: Path | None) -> tuple[dict[str, NDArray] | None, dict[str, NDArray] | None]:
        """Read the data of both sides: their columns by name, with the same names in the same order; None for none.

        Args:
            other: as of :meth:`check`.

        Raises:
            OmtwarpError: a file cannot be read, or the two sides have different numbers of files or columns.
        """
        from omtwarp.mesh.data import read_data
        from omtwarp.mesh.neuro import structure_of

        ours, theirs = self.feature or [], self.to_feature or []
        if len(ours) != len(theirs):
            raise OmtwarpError(
                f"{len(ours)} features here and {len(theirs)} there: give as many --to-feature as --feature"
            )
        mine: dict[str, NDArray] = {}
        others: dict[str, NDArray] = {}
        sides = (self.source, self.surface), (other, self.to_surface)
        parts = [next(filter(None, map(structure_of, files)), None) if ours else None for files in sides]
        for file, their_file in zip(ours, theirs, strict=True):
            one, its_own = read_data(file, parts[0]).values, read_data(their_file, parts[1]).values
            if one.shape[1] != its_own.shape[1]:
                raise OmtwarpError(f"'{file}' and '{their_file}' hold different numbers of features")
            for here, there in zip(one.T, its_own.T, strict=True):
                name = f"{file} ({len(mine) + 1})"
                mine[name], others[name] = here, there
        return mine or None, others or None

    def write(self, moved: Callable[[omtwarp.MapResult], omtwarp.MapResult], sphere: NDArray, faces: NDArray) -> None:
        """Write the moved map, or its sphere as a mesh.

        Args:
            moved: moves the map.
            sphere, faces: what a mesh holds, shapes [V, 3] and [F, 3].
        """
        from omtwarp.mesh.write import write_mesh

        if self.as_map:
            moved(omtwarp.MapResult.load(self.source)).save(self.output)
        else:
            write_mesh(self.output, self.radius * sphere, faces, spherical=True, like=self.source)


def run_align(
    *,
    pair: Pair,
    to: Annotated[str, Typed(file=input_file)] = "axes",
    by: AlignBy = AlignBy.AUTO,
    mirror: bool = False,
    degree: Annotated[int, Typed(bounds=(1, 64))] = 16,
    printing: Printing,
) -> None:
    """Rotate a map's sphere by its shape's own axes, or to another map.

    By axes, the longest axis of the first-order ellipsoid points to longitude 0, the shortest to the north pole. To
    another map, features are correlated over all rotations: distance from the centre of the surface, area over area on
    the sphere, or those given.

    Examples:
        omtwarp align left.npz --to right.npz -o aligned.npz
        omtwarp align lh.npz --to axes -o lh.sphere.surf.gii --radius 100

    Options:
        to (axes|FILE|GRID): The shape's own axes, another map or sphere (- is standard input), or a grid such as
            fsaverage5.
        by: What to compare; vertices needs equal faces; auto takes it for two maps of one surface.
        mirror: Also try the mirror image, and take it if it fits better.
        degree: Highest degree of the spherical harmonics.
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from omtwarp.resampling import file_points
    from omtwarp.spheres import is_named

    other = None if to == "axes" or is_named(to) else Path(to)
    pair.check(other)
    refuse({"--to-surface is of a sphere without a surface": to == "axes" and pair.to_surface})
    with step_times(printing.verbose) as done:
        moving = file_points(pair.source, pair.surface)
        fixed = "axes" if to == "axes" else file_points(other or to, pair.to_surface)
        mine, others = pair.features(other)
        done("read")
        with warnings_as_lines():
            alignment = omtwarp.align(
                moving, fixed, features=mine, to_features=others, by=by, mirror=mirror, degree=degree
            )
        done("align")
        faces = moving.grid.own_triangles[:, ::-1] if alignment.mirrored else moving.grid.own_triangles
        pair.write(alignment.turned, alignment.sphere, faces)
        done("write")
    turn = alignment.rotation if not alignment.mirrored else alignment.rotation @ np.diag([-1.0, 1.0, 1.0])
    degrees = np.degrees(Rotation.from_matrix(turn).magnitude())
    margin = f", {alignment.margin:.3f} above the next best" if np.isfinite(alignment.margin) else ""
    line = f"{pair.output}: turned by {degrees:.3f} degrees{', mirrored' * alignment.mirrored}; by {alignment.method} "
    line += f"({alignment.basis}), score {alignment.score:.6f}{margin}"
    show_facts({"output": str(pair.output), **alignment.to_dict()}, line, printing)


@dataclass(frozen=True)
class Several:
    """What is done with more maps than one.

    Raises:
        OmtwarpError: options exclude each other, or one is given without the one that it belongs to.

    Options:
        more (MORE): Further maps, for --group and --sequence.
        group: Make a template from all maps and register them to it; -o is a folder. --feature: once for each map.
        sequence: Register one subject's maps in the order of time to the first; -o is a folder.
        rounds (N): How many times the template of --group is made anew; 3 by default.
    """

    more: Annotated[list[Path] | None, Argument(file=input_file)] = None
    group: bool = False
    sequence: bool = False
    rounds: Annotated[int | None, Typed(bounds=(1, None))] = None

    def __post_init__(self) -> None:
        if self.group and self.sequence:
            raise OmtwarpError("--group and --sequence exclude each other")
        refuse({"--rounds is of --group": self.rounds is not None and not self.group})

    @property
    def mode(self) -> str:
        """The option that asks for several maps, empty where none does."""
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
        pages = (".html", ".htm")
        extras = [(self.strain, DATA_SUFFIXES), (self.before, SUFFIXES), (self.report, pages), (self.film, FILMS)]
        check_outputs([(pair.output, ()), *extras], pair.source, pair.surface)

    def write(self, registration: Registration, pair: Pair, moving: SpherePoints, fixed: SpherePoints | str) -> None:
        """Write all that is asked for about a registration of one sphere to another."""
        points, faces = moving.grid.points[: moving.grid.own_points], moving.grid.own_triangles
        if self.strain is not None:
            _write_strain(self.strain, registration, faces, pair.surface or pair.source)
        if self.before is not None:
            from omtwarp.mesh.write import write_mesh

            write_mesh(self.before, pair.radius * points, faces, spherical=True, like=pair.source)
        if self.report is not None:
            from omtwarp.registration.sides import target_points
            from omtwarp.shape_analysis.reports import write_registration_page

            write_registration_page(self.report, registration, moving, target_points(fixed)[0])
        if self.film is not None:
            from omtwarp.shape_analysis.reports import film_warp

            film_warp(self.film, registration, omtwarp.MapResult.load(pair.source))


@dataclass(frozen=True)
class Strength:
    """How much the warp may distort.

    Options:
        keep_areas (NUMBER|exact): Weight of squared changes of the areas around vertices.
        stiffness (NUMBER): Weight of distortion against differences of features.
        max_strain (NUMBER): Bound of |log2| of ratios of areas, and of stretches, of every triangle.
    """

    keep_areas: str = "0"
    stiffness: float = STIFFNESS
    max_strain: float = MAX_STRAIN

    def keywords(self) -> dict[str, float | str]:
        """Return the options as functions take them, which refuse a text for areas unless it is ``exact``."""
        with contextlib.suppress(ValueError):
            return vars(self) | {"keep_areas": float(self.keep_areas)}
        return dict(vars(self))


def run_register(
    *,
    pair: Pair,
    several: Several,
    to: Annotated[str | None, Typed(file=input_file)] = None,
    hemisphere: Side | None = None,
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
        to (TARGET): A map, a template, fsaverage5, fsaverage, fsLR32k, or a sphere with its surface or features; -.
        hemisphere: Of fsaverage5, fsaverage or fsLR32k; by default the one that MOVING says.
        feature_weight (NUMBER): What a feature counts, in their order (sulcal depth, curvature if none are given):
            repeat for all.
        landmarks (FILE): A table of points and curves on both sides: columns label, side, vertex or x, y, z, and
            weight.
    """
    from omtwarp.mesh.neuro import structure_of
    from omtwarp.registration.group_template import is_template
    from omtwarp.resampling import file_points
    from omtwarp.resampling.averages import is_average, with_side
    from omtwarp.spheres import is_named

    if several.mode:
        alone = {"--to": to, "--hemisphere": hemisphere, "--landmarks": landmarks, "--feature-weight": feature_weight}
        _require_many(several.mode, pair, alone | {f"--{name}": file for name, file in vars(extras).items()})
        _register_many(pair, several, strength, printing)
        return
    if to is None or several.more:
        raise OmtwarpError("give one map and --to TARGET, or several maps and --group or --sequence")
    extras.check(pair)
    has_one = is_average(to) or with_side(to, hemisphere) == to
    refuse({"--hemisphere is of targets that have two": hemisphere and has_one})
    if not (pair.feature and is_named(to)):
        own = structure_of(pair.source) or structure_of(pair.surface)
        to = with_side(with_side(to, hemisphere or own), own)
    other = None if is_named(to) or is_average(to) else Path(to)
    pair.check(other)
    whole = is_average(to) or is_template(to)
    refuse({"--to-surface is of a sphere without a surface": whole and pair.to_surface})
    with progress_bar(printing.quiet, printing.verbose) as progress:
        moving = file_points(pair.source, pair.surface)
        fixed = to if whole else file_points(to, pair.to_surface)
        mine, others = pair.features(other)
        weights = None if feature_weight is None else _named_weights(list(mine or ["sulc", "curv"]), feature_weight)
        warp: Callable[..., Registration] = omtwarp.register  # whose options are read from groups
        of_both = {"features": mine, "to_features": others, "feature_weights": weights, "landmarks": landmarks}
        moved = warp(moving, fixed, progress=progress, **of_both, **strength.keywords())
    pair.write(moved.registered, moved.sphere, moving.grid.own_triangles)
    extras.write(moved, pair, moving, fixed)
    show_facts({"output": str(pair.output), **moved.to_dict()}, f"{pair.output}: {_line(moved)}", printing)


def _require_many(mode: str, pair: Pair, others: Mapping[str, object]) -> None:
    """Refuse options of one map where there are several, and an output that is no folder, or is called as a map is.

    Raises:
        OmtwarpError: there is such an option or output, or the folder cannot be made.
    """
    of_pair: dict[str, object] = {"--surface": pair.surface, "--to-surface": pair.to_surface}
    of_pair |= {"--to-feature": pair.to_feature, "--radius": pair.radius != Pair.radius}
    if given := [name for name, value in {**of_pair, **others}.items() if value]:
        raise OmtwarpError(f"{given[0]} is of one map: leave it out with {mode}")
    if is_standard_output(pair.output):
        raise OmtwarpError(f"{mode} writes a folder, not standard output: name one with -o")
    check_folder(pair.output)
    if pair.as_map:
        raise OmtwarpError(f"{mode} writes a folder, not a map such as '{pair.output}': name one with -o")


def _register_many(pair: Pair, several: Several, strength: Strength, printing: Printing) -> None:
    """Register maps to a template made from them, or to the first of them, and say how well."""
    from omtwarp.registration import register_group, register_sequence
    from omtwarp.registration.group import ROUNDS

    maps = [pair.source, *(several.more or [])]
    files, count = pair.feature or [], len(maps)  # those of the first feature for all maps, then those of the next
    if len(files) % count:
        raise OmtwarpError(f"{len(files)} times --feature for {count} maps: give it once for each, in their order")
    features = {f"feature {k // count + 1}": files[k : k + count] for k in range(0, len(files), count)}
    with progress_bar(printing.quiet, printing.verbose) as progress, warnings_as_lines():
        warp: Callable[..., GroupRegistration | SequenceRegistration] = register_sequence
        if several.group:
            warp = partial(register_group, rounds=several.rounds or ROUNDS)
        table = warp(maps, pair.output, features=features, progress=progress, **strength.keywords()).table
    made = pair.output / ("template.npz" if several.group else "strain.npz")
    drift = max(one.get("drift", 0.0) for one in table.values())
    told = "" if several.group else f"; drift at most {drift:.2f} degrees"
    line = f"{made}: {count} maps; {_many_line(list(table.values()))}{told}"
    show_facts({"output": str(pair.output), "maps": table}, line, printing)


def _many_line(facts: Sequence[Mapping[str, float]]) -> str:
    """Return how well many maps are registered, of their facts."""
    from omtwarp.registration.register import FACTS

    names = [name for name in facts[0] if name.startswith("registration_") and name.partition("_")[2] not in FACTS]
    agreement = ", ".join(f"{one.partition('_')[2]} {sum(row[one] for row in facts) / len(facts):.3f}" for one in names)
    flips, doubtful = (int(sum(row[f"registration_{name}"] for row in facts)) for name in ("flips", "doubtful"))
    largest = max(one["registration_strain"] for one in facts)
    return f"{agreement} on average; largest strain {largest:.2f}; {flips} flips; {doubtful} doubtful"


def _named_weights(names: list[str], weights: list[float]) -> dict[str, float]:
    """Return the weights of features by name.

    Raises:
        OmtwarpError: there are more or fewer weights than features.
    """
    if len(weights) != len(names):
        raise OmtwarpError(f"{len(weights)} times --feature-weight for {len(names)} features: give one for each")
    return dict(zip(names, weights, strict=True))


def _write_strain(file: Path, registration: Registration, faces: NDArray, like: Path) -> None:
    """Write both strains at the vertices, with the structure of the surface."""
    import numpy as np

    from omtwarp.mesh.data import VertexData, write_data
    from omtwarp.mesh.neuro import structure_of
    from omtwarp.registration.strain import strain_at_vertices

    strains, before = (registration.area_strain, registration.stretch_strain), registration.start.sphere
    columns = [strain_at_vertices(before, faces, values) for values in strains]
    data = VertexData(np.column_stack(columns), ("area_log2", "stretch_log2"), structure=structure_of(like))
    write_data(file, data, (registration.sphere, faces))


def _line(registration: Registration) -> str:
    """Return how well the features agree, how much the warp strains, and what is to be known about its start."""
    known, certificate = registration.correlations.items(), registration.certificate
    agreement = ", ".join(f"{name} {values['before']:.3f} to {values['after']:.3f}" for name, values in known)
    line = f"{agreement}; largest strain {registration.largest_strain:.2f} of {registration.most_strain:g}; "
    line += f"{certificate.flips} flips, degree {certificate.degree}"
    if registration.landmarks:
        farthest = max(distance["after"] for distance in registration.landmarks.values())
        line += f"; landmarks within {farthest:.2f} degrees"
    if registration.doubtful:
        scores = f"{registration.start.score:.3f} against {registration.start.runner_up:.3f}"
        line += f"; the start is doubtful ({scores}): the best of {len(registration.starts)} starts was taken"
    return line
