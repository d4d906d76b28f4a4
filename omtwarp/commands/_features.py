"""Two spheres, their surfaces and data at their vertices as features, as the commands that compare them take them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import output_option
from omtwarp.commands._streams import input_file
from omtwarp.errors import OmtwarpError

if TYPE_CHECKING:
    from numpy.typing import NDArray

MovingArgument = Annotated[
    Path,
    typer.Argument(
        metavar="MOVING", callback=input_file, help="A map (.npz), or a sphere as a mesh; - is standard input."
    ),
]
MovedOption = Annotated[
    Path, output_option(".npz for the whole map, or a mesh suffix for the sphere; - is standard output.", ".npz")
]
SurfaceOption = Annotated[
    Path | None, typer.Option(metavar="MESH", help="The surface of MOVING, where MOVING is a sphere without one.")
]
ToSurfaceOption = Annotated[
    Path | None, typer.Option(metavar="MESH", help="The surface of the other sphere, where that is no .npz.")
]
FeatureOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILE", help="Compare by these data at MOVING's vertices; repeat for more features."),
]
ToFeatureOption = Annotated[
    list[Path] | None, typer.Option(metavar="FILE", help="The same data at the other sphere's vertices, in this order.")
]


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
