"""Options that several commands share."""

import dataclasses
import functools
import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar, cast, get_args, get_origin, get_type_hints

import typer
from typer.models import OptionInfo, ParameterInfo

from omtwarp.commands._streams import input_file, output_file
from omtwarp.errors import Kind, OmtwarpError, choose
from omtwarp.options import MapOptions, Option, PatternName

Value = TypeVar("Value")

OUTPUTS = ("output", "report", "sphere", "matrix", "reconstruction", "strain", "json_output", "title")
"""Options that name no input; a title may be the name of a file."""


def usage(parse: Callable[[str], Value]) -> Callable[[str], Value]:
    """Turn the OmtwarpError of a parser into wrong usage, which exits with status 2."""

    def parsed(text: str) -> Value:
        try:
            return parse(text)
        except OmtwarpError as error:
            raise typer.BadParameter(str(error)) from None

    return parsed


def named(kind: type[Kind]) -> OptionInfo:
    """Make a command-line option whose values are the members of an enumeration of :mod:`omtwarp.options`."""
    return typer.Option(metavar="|".join(kind), parser=usage(lambda text: choose(kind, text)))


def sections(documented: object) -> tuple[str, str, str]:
    """Return a docstring's text, the lines below ``Examples:``, and those below ``Options:`` after them."""
    text, _, options = (inspect.getdoc(documented) or "").partition("\n\nOptions:\n")
    text, _, examples = text.partition("\n\nExamples:\n")
    return text, textwrap.dedent(examples), options


def described(documented: object) -> dict[str, Option]:
    """Return what the docstring of a command, or of a group of options, says of each: ``name (METAVAR): a sentence``.

    Such lines stand below ``Options:`` at the end; longer sentences go on in lines that are indented further.
    """
    found = re.findall(r"^    (\w+)(?: \((.*?)\))?: (.*(?:\n {5,}.*)*)", sections(documented)[2], re.M)
    return {name: Option(" ".join(help.split()), metavar) for name, metavar, help in found}


def readable(name: str, default: object, annotation: object, known: Option) -> object:
    """Return an annotation as Typer reads it, with what is said about the option.

    Args:
        name: of the option.
        default: its value where it is not given.
        annotation: a type, with an option of Typer's where more than a value is read, or with one that
            :mod:`omtwarp.options` declares.
        known: what a docstring says.
    """
    kind, *said = _annotated(annotation)
    if said and isinstance(said[0], ParameterInfo):
        said[0].help = said[0].help or known.help
        return annotation
    option = said[0] if said and isinstance(said[0], Option) else known
    read = option.reader(kind) if option is not known else None
    if read is not None:
        info = typer.Option(metavar=option.metavar or "|".join(kind), parser=usage(read), help=option.help)
        return Annotated[str, info]
    # Without the opposite of what is off
    flags = [f"--{name.replace('_', '-')}"] if kind is bool and not default else []
    return Annotated[kind, typer.Option(*flags, metavar=option.metavar or None, help=option.help)]


def output_option(suffix: str | None = None, *, metavar: str = "FILE") -> OptionInfo:
    """Return the option for what a command writes.

    Args:
        suffix: the format in which ``-`` writes it to standard output; None where the command sees to that.
        metavar: what stands for the value in help.
    """
    callback = None if suffix is None else output_file(suffix)
    return typer.Option("--output", "-o", metavar=metavar, callback=callback)


def _annotated(annotation: object) -> tuple:
    """Return the type that an annotation names, and what is said about it."""
    return get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)


class Only(tuple[str, ...]):
    """The options of a group that a command takes, in the place of all."""


def as_command(run: Callable[..., None]) -> Callable[..., None]:
    """Return a command as Typer reads it: the options of every group that it takes are options of its own.

    A group is a dataclass, as :class:`Source`. A command that writes files also gets the option --force, which
    :class:`Command` reads.
    """
    groups: dict[str, tuple[Callable[..., object], list[str]]] = {}
    parameters: list[inspect.Parameter] = []

    def add(name: str, default: object, annotation: object, known: dict[str, Option]) -> None:
        read = readable(name, default, annotation, known.get(name, Option("")))
        parameters.append(inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=read))

    for name, parameter in inspect.signature(run, eval_str=True).parameters.items():
        group, *only = _annotated(parameter.annotation)
        if dataclasses.is_dataclass(group):
            hints = get_type_hints(group, include_extras=True)
            fields = [each for each in dataclasses.fields(group) if not only or each.name in only[0]]
            groups[name] = cast(Callable[..., object], group), [each.name for each in fields]
            known = described(group)
            for each in fields:
                needed = each.default is dataclasses.MISSING
                add(each.name, inspect.Parameter.empty if needed else each.default, hints[each.name], known)
        else:
            add(name, parameter.default, parameter.annotation, described(run))
    writes = any(parameter.name in OUTPUTS for parameter in parameters)
    if writes:
        add("force", False, ForceOption, {})

    @functools.wraps(run)
    def command(**given: object) -> None:
        if writes:
            del given["force"]
        for name, (group, names) in groups.items():
            given[name] = group(**{each: given.pop(each) for each in names})
        run(**given)

    command.__doc__ = sections(run)[0]
    vars(command)["__signature__"] = inspect.Signature(parameters)
    command.__annotations__ = run.__annotations__ | {each.name: each.annotation for each in parameters}
    return command


def picture_size(text: str | None) -> str | None:
    """Check the value of --size: WIDTHxHEIGHT, or one number for both, where it is given; return it unchanged."""
    if text is not None and not re.fullmatch(r"0*[1-9][0-9]{0,5}(x0*[1-9][0-9]{0,5})?", text.lower(), flags=re.ASCII):
        raise typer.BadParameter(f"'{text}' is not a size: use WIDTHxHEIGHT, such as 1024x768, or one number")
    return text


def as_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    return int(width), int(height or width)


ForceOption = Annotated[
    bool,
    typer.Option("--force", help="Also replace companions and results that omtwarp did not write; never an input."),
]

ROUTE = Only(("method", "until", "cost", "scheme", "refine", "device", "solver"))
"""The options of a map for commands that make something from it."""

RouteOptions = Annotated[MapOptions, ROUTE]


@dataclass(frozen=True)
class Source:
    """What a command works on: meshes, of which it makes maps, or a finished map.

    Options:
        meshes: Closed triangle meshes of any format, or -; none with --map.
        finished: A finished map (from 'omtwarp map') instead of a new one; - is standard input.
        repair: Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.
    """

    meshes: Annotated[list[Path] | None, typer.Argument(metavar="MESH", callback=input_file)] = None
    finished: Annotated[Path | None, typer.Option("--map", metavar="NPZ", callback=input_file)] = None
    repair: bool = False

    @property
    def files(self) -> list[Path]:
        """All files that are given."""
        return [*(self.meshes or []), *([] if self.finished is None else [self.finished])]


@dataclass(frozen=True)
class Shown:
    """A picture or a pattern on the sphere.

    Options:
        image (PICTURE): An equirectangular picture to put on the surface.
        pattern: A pattern in place of a picture; circles by default.
    """

    image: Path | None = None
    pattern: PatternName | None = None

    def read(self) -> dict:
        """Read the picture; return it and the pattern as functions take them.

        Raises:
            OmtwarpError: both are given, or the picture cannot be read.
        """
        from omtwarp.texturing import read_image

        if self.image is not None and self.pattern is not None:
            raise OmtwarpError("both --image and --pattern: give one")
        picture = None if self.image is None else read_image(self.image)
        return {"image": picture, "pattern": self.pattern or PatternName.CIRCLES}


@dataclass(frozen=True)
class Printing:
    """What a command says about its work.

    Options:
        as_json: Print the facts as JSON on standard output.
        verbose: Print what every stage did.
        quiet: Print no progress and no summary.
    """

    as_json: Annotated[bool, typer.Option("--json")] = False
    verbose: Annotated[bool, typer.Option("--verbose", "-v")] = False
    quiet: Annotated[bool, typer.Option("--quiet", "-q")] = False
