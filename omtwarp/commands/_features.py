"""Two spheres, their surfaces and data at their vertices as features, as the commands that compare them take them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import RadiusOption, output_option
from omtwarp.commands._streams import input_file
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_output

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from omtwarp.maps.result import MapResult


@dataclass(frozen=True)
class Pair:
    """A sphere that is moved, another one, their surfaces, data at their vertices, and where the moved one goes."""

    source: Annotated[
        Path,
        typer.Argument(
            metavar="MOVING", callback=input_file, help="A map (.npz), or a sphere as a mesh; - is standard input."
        ),
    ]
    output: Annotated[
        Path, output_option(".npz for the whole map, or a mesh suffix for the sphere; - is standard output.", ".npz")
    ]
    surface: Annotated[
        Path | None, typer.Option(metavar="MESH", help="The surface of MOVING, where MOVING is a sphere without one.")
    ] = None
    to_surface: Annotated[
        Path | None, typer.Option(metavar="MESH", help="The surface of the other sphere, where that is no .npz.")
    ] = None
    feature: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Compare by these data at MOVING's vertices; repeat for more features."),
    ] = None
    to_feature: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="The same data at the other sphere's vertices, in this order."),
    ] = None
    radius: RadiusOption = 1.0

    @property
    def as_map(self) -> bool:
        """Whether a whole map is written."""
        return self.output.suffix.lower() == ".npz"

    def check(self, other: Path | None) -> None:
        """Make sure that the output can be written, and that no part of a brain meets another one.

        Args:
            other: the file of the other sphere, None where it is made.

        Raises:
            OmtwarpError: the output cannot be written, or is a map where there is none, or the parts differ.
        """
        from omtwarp.mesh.neuro import require_same_structure
        from omtwarp.mesh.write import SUFFIXES

        check_output(self.output, (".npz", *SUFFIXES), self.source, self.surface)
        if self.as_map and self.source.suffix.lower() != ".npz":
            raise OmtwarpError(f"cannot write '{self.output}': a whole map needs a map (.npz) as input")
        for ours in (self.source, self.surface):
            for theirs in (other, self.to_surface):
                require_same_structure(ours, theirs)

    def features(self, other: Path | None) -> tuple[dict[str, NDArray] | None, dict[str, NDArray] | None]:
        """Read the data of both sides by name, None where there are none; arguments and errors as of :meth:`check`."""
        files = (self.source, self.surface), (other, self.to_surface)
        ours, theirs = read_features(self.feature or [], self.to_feature or [], *files)
        return ours or None, theirs or None

    def write(self, moved: Callable[[MapResult], MapResult], sphere: NDArray, faces: NDArray) -> None:
        """Write the moved map, or its sphere as a mesh.

        Args:
            moved: moves the map.
            sphere, faces: what a mesh holds, shapes [V, 3] and [F, 3].
        """
        from omtwarp.maps.result import MapResult
        from omtwarp.mesh.write import write_mesh

        if self.as_map:
            moved(MapResult.load(self.source)).save(self.output)
        else:
            write_mesh(self.output, self.radius * sphere, faces, spherical=True, like=self.source)


def read_features(
    ours: list[Path], theirs: list[Path], here: Iterable[Path | None], there: Iterable[Path | None]
) -> tuple[dict[str, NDArray], dict[str, NDArray]]:
    """Read the data of both sides; return their columns by name, with the same names in the same order.

    Args:
        ours, theirs: files of data.
        here, there: the spheres and surfaces that they belong to, which may say what part of the brain that is.

    Raises:
        OmtwarpError: a file cannot be read, or the two sides have different numbers of files or columns.
    """
    from omtwarp.mesh.data import read_data
    from omtwarp.mesh.neuro import structure_of

    if len(ours) != len(theirs):
        raise OmtwarpError(f"{len(ours)} features here and {len(theirs)} there: give as many --to-feature as --feature")
    mine: dict[str, NDArray] = {}
    others: dict[str, NDArray] = {}
    parts = [next(filter(None, map(structure_of, files)), None) if ours else None for files in (here, there)]
    for file, their_file in zip(ours, theirs, strict=True):
        one, other = read_data(file, parts[0]).values, read_data(their_file, parts[1]).values
        if one.shape[1] != other.shape[1]:
            raise OmtwarpError(f"'{file}' and '{their_file}' hold different numbers of features")
        for column, its_own in zip(one.T, other.T, strict=True):
            name = f"{file} ({len(mine) + 1})"
            mine[name], others[name] = column, its_own
    return mine, others
