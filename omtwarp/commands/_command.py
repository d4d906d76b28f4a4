"""Functions as commands: options from a signature and docstrings, their help in groups, files that are kept."""

import contextlib
import dataclasses
import inspect
import re
import textwrap
from collections.abc import Callable, Iterator
from enum import EnumType, StrEnum
from pathlib import Path
from types import UnionType
from typing import Annotated, cast, get_args, get_origin, get_type_hints

import click
from click.shell_completion import CompletionItem

from omtwarp.commands._options import Argument, Typed
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import keeping
from omtwarp.options import Option

OUTPUTS = ("output", "report", "sphere", "matrix", "reconstruction", "strain", "json_output", "title")
"""Options that name no input; a title may be the name of a file."""

GROUPS = {
    "Input": (
        "finished map_of_source map_of_target surface to_surface data labels feature to_feature landmarks faces "
        "smoothing covariate"
    ),
    "Output": (
        "output report json_output as_json quiet verbose title beside radius sphere matrix reconstruction strain "
        "force before film"
    ),
    "Map": "method until cost scheme refine exact weights weights_at target_picture target_floor optimality",
    "Holes, handles, parts": "hemisphere disk cap fill_area components together cut cut_along torus",
    "Method": (
        "to by aligned mirror grid degree scale fit permutations seed transport resample.method group.components "
        "stiffness max_strain feature_weight keep_areas group sequence rounds register"
    ),
    "Texture": (
        "image pattern projection atlas rotate seam uv keep_materials opacity bake detail aspect margin "
        "texture_format texture.size transfer.size"
    ),
    "View": (
        "size view zoom field_of_view up front light background transparent wireframe frames fps seconds captions "
        "backend preview.projection"
    ),
    "Computation": ("device devices solver repair strict executor workers shard time_limit memory_limit retry collect"),
}
"""Options, or those of one command, by the heading that help shows them under; others are shown last."""


class Command(click.Command):
    """A command whose help has groups of options, and whose epilog is examples, one a line."""

    def format_arguments(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Leave the arguments to :meth:`format_options`."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write arguments, then the groups of options."""
        headings = {one: heading_of(str(self.name), str(one.name)) for one in self.get_params(ctx)}
        headings |= {one: "Arguments" for one in headings if isinstance(one, click.Argument)}
        for heading in ("Arguments", *GROUPS, "Other"):
            rows = [record for one, its in headings.items() if its == heading and (record := one.get_help_record(ctx))]
            if rows:
                with formatter.section(heading):
                    formatter.write_dl(rows)

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the examples."""
        if self.epilog:
            with formatter.section("Examples"):
                for line in self.epilog.splitlines():
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")

    def invoke(self, ctx: click.Context) -> object:
        """Run the command, which replaces nothing that it reads."""
        inputs = (path for name, value in ctx.params.items() if name not in OUTPUTS for path in _named_files(value))
        with keeping(inputs, force=bool(ctx.params.get("force"))):
            return super().invoke(ctx)


def _named_files(value: object) -> Iterator[Path]:
    """Yield the files that an option or argument names."""
    for one in value if isinstance(value, list | tuple) else [value]:
        with contextlib.suppress(OSError, ValueError):  # a text that is too long for a name, or with a null character
            if isinstance(one, str | Path) and Path(one).is_file():
                yield Path(one)


def heading_of(command: str, option: str) -> str:
    """Return the heading of an option of a command: the command's own, or the one it has everywhere."""
    for name in (f"{command}.{option}", option):
        for heading, members in GROUPS.items():
            if name in members.split():
                return heading
    return "Other"


class _Argument(click.Argument):
    """An argument whose metavar is its name, without the brackets that usage has."""

    def get_usage_pieces(self, ctx: click.Context) -> list[str]:
        name = self.human_readable_name
        return [(name if self.required else f"[{name}]") + ("..." if self.nargs == -1 else "")]

    def get_help_record(self, ctx: click.Context) -> tuple[str, str]:
        return self.human_readable_name, f"{self.help}{'  [required]' if self.required else ''}"


def _offered(ctx: click.Context, option: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return what shells offer for a value: words of its metavar, or files where none fits a text."""
    words = [word for word in str(option.metavar).split("|") if word.islower() and word.startswith(incomplete)]
    files = [CompletionItem(incomplete, type="file")] * (option.type is click.STRING)
    return [CompletionItem(word) for word in words] or files


TYPES: dict[object, click.ParamType] = {bool: click.BOOL, int: click.INT, float: click.FLOAT}
RANGES: dict[object, Callable[..., click.ParamType]] = {int: click.IntRange, float: click.FloatRange}
METAVARS: dict[object, str] = {int: "NUMBER", float: "NUMBER", Path: "FILE"}


def sections(documented: object) -> tuple[str, str, str]:
    """Return a docstring's text, the lines below ``Examples:``, and those below ``Options:`` after them."""
    text, _, options = (inspect.getdoc(documented) or "").partition("\n\nOptions:\n")
    text, _, examples = text.partition("\n\nExamples:\n")
    return text, textwrap.dedent(examples), options


def described(documented: object) -> dict[str, Option]:
    """Return what the docstring of a command, or of a group of options, says of each: ``name (METAVAR): a sentence``.

    Such lines stand below ``Options:`` at the end; longer sentences go on in lines that are indented further.
    """
    lines = re.findall(r"^    (\w+)(?: \((.*?)\))?: (.*(?:\n {5,}.*)*)", sections(documented)[2], re.M)
    return {name: Option(" ".join(help.split()), metavar) for name, metavar, help in lines}


def _annotated(annotation: object) -> tuple:
    """Return the type that an annotation names, and what is said about it."""
    return get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)


def _single(kind: object) -> tuple:
    """Return the type of one value of a type, and whether there may be several; None is left out."""
    kind = get_args(kind)[0] if isinstance(kind, UnionType) else kind
    return (get_args(kind)[0], True) if get_origin(kind) is list else (kind, False)


def _reading(read: Callable[[object], object], typed: Typed) -> Callable[..., object]:
    """Return a callback that makes a value of a text; that of a default stays what it is."""

    def received(ctx: click.Context, parameter: click.Parameter, given: object) -> object:
        if given is None or ctx.resilient_parsing:
            return given
        if isinstance(given, tuple):
            return [received(ctx, parameter, one) for one in given] or None
        try:
            value = read(given)
        except OmtwarpError as error:
            raise click.BadParameter(str(error)) from None
        if typed.bounds is not None and value != value:
            raise click.BadParameter(f"{value} is not a number.")
        return value if typed.file is None else typed.file(value)

    return received


def parameter_of(name: str, default: object, annotation: object, known: dict[str, Option]) -> click.Parameter:
    """Return an option or argument of a command.

    Args:
        name: of the option.
        default: its value where it is not given.
        annotation: its type, with a :class:`Typed` where more is to be said, or with an option that
            :mod:`omtwarp.options` declares.
        known: what a docstring says of options.
    """
    kind, *said = _annotated(annotation)
    typed = next((one for one in said if isinstance(one, Typed)), Typed())
    option = next((one for one in said if isinstance(one, Option)), known.get(name, Option("")))
    read = option.reader(kind) if option in said else typed.read
    kind, several = _single(kind)
    words = list(map(str, kind)) if isinstance(kind, EnumType) else []
    form = click.Choice(words) if words and read is None else TYPES.get(kind, click.STRING)
    if typed.bounds is not None:
        form = RANGES[kind](*typed.bounds)
        form.name = form.name.removesuffix(" range")  # in messages
    facts: dict = {"type": form, "callback": _reading(read or kind, typed), "shell_complete": _offered}
    facts["required"] = needed = default in (inspect.Parameter.empty, dataclasses.MISSING)
    facts["metavar"] = option.metavar or "|".join(words) or METAVARS.get(kind, "TEXT")
    if isinstance(typed, Argument):
        parameter: click.Parameter = _Argument([name], nargs=-1 if several else 1, **facts)
    else:
        word = name.replace("_", "-")
        names = typed.names.split() or [f"--{word}" + f"/--no-{word}" * (default is True)]
        if not needed:
            facts["default"] = str(default) if isinstance(default, StrEnum) else default
        facts["is_flag"] = True if kind is bool else None
        parameter = click.Option([*names, name], show_default=default != "", multiple=several, **facts)
    parameter.help = option.help
    return parameter


def as_command(run: Callable[..., None]) -> Command:
    """Return the command that a function is: the options of every group that it takes are options of its own.

    A group is a dataclass, as :class:`omtwarp.commands._options.Source`. A command that writes files also gets the
    option --force, which :class:`Command` reads.
    """
    groups: dict[str, tuple[Callable[..., object], list[str]]] = {}
    parameters: list[click.Parameter] = []
    own = described(run)
    for name, parameter in inspect.signature(run, eval_str=True).parameters.items():
        group, *only = _annotated(parameter.annotation)
        if dataclasses.is_dataclass(group):
            hints, known = get_type_hints(group, include_extras=True), described(group)
            fields = [each for each in dataclasses.fields(group) if not only or each.name in only[0]]
            groups[name] = cast(Callable[..., object], group), [each.name for each in fields]
            parameters += [parameter_of(each.name, each.default, hints[each.name], known) for each in fields]
        else:
            parameters.append(parameter_of(name, parameter.default, parameter.annotation, own))
    if any(parameter.name in OUTPUTS for parameter in parameters):
        said = "Also replace companions and results that omtwarp did not write; never an input."
        parameters.append(click.Option(["--force"], is_flag=True, help=said))

    def command(force: bool = False, **given: object) -> None:
        for name, (group, names) in groups.items():
            given[name] = group(**{each: given.pop(each) for each in names})
        run(**given)

    text, examples, _ = sections(run)
    name = run.__name__.removeprefix("run_")
    return Command(name, params=parameters, callback=command, help=text, epilog=examples)
