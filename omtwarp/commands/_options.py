"""Options that several commands share."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer
from typer.models import OptionInfo

from omtwarp.commands._command import OUTPUTS
from omtwarp.commands._streams import input_file, output_file
from omtwarp.errors import Kind, OmtwarpError, choose
from omtwarp.options import (
    Backend,
    Cost,
    CutAlong,
    FillArea,
    Method,
    Scheme,
    Solver,
    Stage,
    WeightsAt,
    parse_refinement,
)

Value = TypeVar("Value")


def usage(parse: Callable[[str], Value]) -> Callable[[str], Value]:
    """Turn the OmtwarpError of a parser into wrong usage, which exits with status 2."""

    def parsed(text: str) -> Value:
        try:
            return parse(text)
        except OmtwarpError as error:
            raise typer.BadParameter(str(error)) from None

    return parsed


def named(kind: type[Kind], help: str) -> OptionInfo:
    """Make a command-line option whose values are the members of an enumeration of :mod:`omtwarp.options`."""
    return typer.Option(metavar="|".join(kind), parser=usage(lambda text: choose(kind, text)), help=help)


def output_option(help: str, suffix: str | None = None, *, metavar: str = "FILE") -> OptionInfo:
    """Return the option for what a command writes.

    Args:
        help: what is written.
        suffix: the format in which ``-`` writes it to standard output; None where the command sees to that.
        metavar: what stands for the value in help.
    """
    callback = None if suffix is None else output_file(suffix)
    return typer.Option("--output", "-o", metavar=metavar, callback=callback, help=help)


def with_force(run: Callable[..., None]) -> Callable[..., None]:
    """Give a command that writes files the option --force, which :class:`Command` reads; leave another as it is."""
    signature = inspect.signature(run, eval_str=True)
    if not any(name in signature.parameters for name in OUTPUTS):
        return run

    @functools.wraps(run)
    def command(*, force: bool, **given: object) -> None:
        run(**given)

    option = inspect.Parameter("force", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=ForceOption)
    vars(command)["__signature__"] = signature.replace(parameters=[*signature.parameters.values(), option])
    command.__annotations__ = run.__annotations__ | {"force": ForceOption}
    return command


def refine_weight(text: str) -> str:
    """Check the value of --refine: a name, a positive number, or an area to match; return it unchanged."""
    usage(parse_refinement)(text)
    return text


def picture_size(text: str) -> str:
    """Check the value of --size: WIDTHxHEIGHT, or one number for both; return it unchanged."""
    if not re.fullmatch(r"0*[1-9][0-9]{0,5}(x0*[1-9][0-9]{0,5})?", text.lower(), flags=re.ASCII):
        raise typer.BadParameter(f"'{text}' is not a size: use WIDTHxHEIGHT, such as 1024x768, or one number")
    return text


def size_text(size: tuple[int, int]) -> str:
    return "x".join(str(length) for length in size)


def as_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    return int(width), int(height or width)


ForceOption = Annotated[
    bool,
    typer.Option("--force", help="Also replace companions and results that omtwarp did not write; never an input."),
]
MeshArguments = Annotated[
    list[Path],
    typer.Argument(
        metavar="MESH", callback=input_file, help="Closed triangle meshes of any format; - is standard input."
    ),
]
OptionalMeshes = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="MESH", callback=input_file, help="Closed triangle meshes of any format, or -; none with --map."
    ),
]
OptionalMesh = Annotated[
    Path | None,
    typer.Argument(metavar="MESH", callback=input_file, help="A closed triangle mesh, or -; not needed with --map."),
]
MapOption = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="NPZ",
        callback=input_file,
        help="A finished map (from 'omtwarp map') instead of a new one; - is standard input.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the facts as JSON on standard output.")]
VerboseOption = Annotated[bool, typer.Option("--verbose", "-v", help="Print what every stage did.")]
MethodOption = Annotated[Method, named(Method, "How to map; all but omt are there for comparison.")]
UntilOption = Annotated[Stage, named(Stage, "Stop after this stage.")]
CostOption = Annotated[Cost, named(Cost, "What the transport minimises: squared geodesic distance, or distance.")]
SchemeOption = Annotated[Scheme, named(Scheme, "How the transport descends; paper is the published one.")]
RefineOption = Annotated[
    str,
    typer.Option(
        metavar="none|area|balanced|angle|NUMBER|match:AREA",
        callback=refine_weight,
        help="Refine the optimal map towards less distortion: a weight of area against angle.",
    ),
]
WeightsAtOption = Annotated[WeightsAt, named(WeightsAt, "What the weights belong to; auto goes by their number.")]
SolverOption = Annotated[Solver, named(Solver, "How sparse systems are solved; scipy is the plain way.")]
DeviceOption = Annotated[str, typer.Option(metavar="auto|cpu|cuda:N", help="Device to compute on.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress and no summary.")]
RepairOption = Annotated[
    bool,
    typer.Option(
        "--repair",
        help="Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.",
    ),
]
StrictOption = Annotated[
    bool, typer.Option("--strict", help="Refuse a map that would come with a warning: exit status 1, no output.")
]
ExactOption = Annotated[
    bool,
    typer.Option(
        "--exact", help="Cut every triangle into four and keep the area of each to 1e-6; the map is that of the parts."
    ),
]
HemisphereOption = Annotated[
    bool, typer.Option("--hemisphere", help="Map a surface with a hole to the hemisphere, the boundary on the equator.")
]
DiskOption = Annotated[
    bool, typer.Option("--disk", help="Map a surface with a hole to the unit disk, by Lambert's equal-area projection.")
]
CapOption = Annotated[
    bool,
    typer.Option("--cap", help="Map a surface with a hole to a spherical cap of the area that the filled hole leaves."),
]
FillAreaOption = Annotated[
    FillArea | None,
    named(FillArea, "Fill holes, on the sphere as large as they are or small; the filling is in the .npz only."),
]
ComponentsOption = Annotated[
    bool, typer.Option("--components", help="Map every part of the surface by itself, each to a sphere of its own.")
]
TogetherOption = Annotated[
    bool,
    typer.Option("--together", help="Map all parts to disjoint caps of one sphere, in proportion to their areas."),
]
CutOption = Annotated[
    bool,
    typer.Option("--cut", help="Cut handles open along short loops and map to the sphere; textures have seams there."),
]
CutAlongOption = Annotated[
    CutAlong | None,
    named(
        CutAlong,
        "Cut along the shortest loops, around handles, or through the holes that these make, which leaves fewer limbs.",
    ),
]
TorusOption = Annotated[bool, typer.Option("--torus", help="Map a closed surface of genus 1 to a flat torus.")]
ImageOption = Annotated[
    Path | None, typer.Option(metavar="PICTURE", help="An equirectangular picture to put on the surface.")
]
UpOption = Annotated[
    str | None, typer.Option(metavar="AXIS", help="The axis that points upwards: y, z, -x, ...; guessed by default.")
]
FrontOption = Annotated[
    str | None, typer.Option(metavar="AXIS", help="The axis that points at the viewer in the front view.")
]
BackgroundOption = Annotated[str, typer.Option(metavar="COLOUR|studio", help="Colour behind the surface.")]
BackendOption = Annotated[Backend, typer.Option(help="What draws: OpenGL or the ray caster.")]
RadiusOption = Annotated[
    float, typer.Option(min=1e-6, max=1e9, help="Radius of a sphere that is written as a mesh; FreeSurfer's is 100.")
]
SizeOption = Annotated[
    str, typer.Option(metavar="WIDTHxHEIGHT", callback=picture_size, help="Size of the picture in pixels.")
]
