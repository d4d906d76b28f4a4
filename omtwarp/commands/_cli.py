"""The command line: ``omtwarp COMMAND ...``, the commands of :mod:`omtwarp.commands`."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast

import typer

import omtwarp
from omtwarp.commands import function_of
from omtwarp.commands._options import OUTPUTS, as_command, sections
from omtwarp.commands._streams import say, standard_streams, warnings_as_lines
from omtwarp.errors import INTERRUPTED, OmtwarpError, unexpected
from omtwarp.files.interruptions import LINE, ending_the_process
from omtwarp.files.output import keeping

if TYPE_CHECKING:
    from typer._click.formatting import HelpFormatter  # click's own in versions without a copy of it

SUMMARIES = {
    "map": "Map surfaces to the sphere, with their areas preserved.",
    "texture": "Texture a surface with a picture or pattern through its map.",
    "transfer": "Transfer the texture of one mesh to another.",
    "unwrap": "Give a mesh texture coordinates, without a texture.",
    "preview": "Draw a mesh, a textured surface or a map; pictures and films.",
    "film": "Film the map: from conformal to optimal, and to the sphere.",
    "report": "Write a page about a map, with a 3D view, to open in a browser.",
    "align": "Turn a map so that it matches another, or the shape's own axes.",
    "register": "Warp a map until its folds lie where another map has them.",
    "resample": "Carry data or a surface from one sphere to another.",
    "check": "List the defects of meshes, and repair them.",
    "cohort": "Map many surfaces, each in a process, to a table and a page.",
    "spharm": "Expand a surface in spherical harmonics over its map.",
    "distance": "Measure the distance of two shapes from their maps.",
    "group": "Compute mean, components and differences of a group of maps.",
    "demo": "Make a shape, map it, texture it and draw it.",
}
"""One line about every command, short enough for a terminal of 80 columns; see :func:`function_of`."""

GROUPS = {
    "Input": (
        "finished map_of_source map_of_target surface to_surface data labels feature to_feature landmarks faces "
        "smoothing covariate"
    ),
    "Output": (
        "output report json_output as_json quiet verbose title beside radius sphere matrix reconstruction strain "
        "force before film"
    ),
    "Map": "method until cost scheme refine exact weights weights_at density target_floor optimality",
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


class Command(typer.core.TyperCommand):
    """A command whose help has groups of options, and whose epilog is examples, one a line."""

    def format_options(self, ctx: object, formatter: HelpFormatter) -> None:
        """Write arguments, then the groups of options."""
        context = cast(typer.Context, ctx)
        rows: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(context):
            record = parameter.get_help_record(context)
            if record is not None:
                record = _plain(record[0]), record[1]
                heading = heading_of(str(self.name), str(parameter.name))
                rows.setdefault("Arguments" if parameter.param_type_name == "argument" else heading, []).append(record)
        for heading in ("Arguments", *GROUPS, "Other"):
            if heading in rows:
                with formatter.section(heading):
                    formatter.write_dl(rows[heading])

    def parse_args(self, ctx: object, args: list[str]) -> list[str]:
        """Read the arguments; an error says what is wrong, without the name of a Python exception."""
        try:
            return super().parse_args(cast(typer.Context, ctx), args)
        except typer.BadParameter as error:
            error.message = error.message.removeprefix("Value error, ")
            raise

    def invoke(self, ctx: object) -> object:
        """Run the command, which replaces nothing that it reads."""
        given = cast(typer.Context, ctx).params
        inputs = (path for name, value in given.items() if name not in OUTPUTS for path in _named_files(value))
        with keeping(inputs, force=bool(given.get("force"))):
            return super().invoke(cast(typer.Context, ctx))

    def collect_usage_pieces(self, ctx: object) -> list[str]:
        """Return the words of the usage line; names of arguments that are needed stand without braces."""
        pieces = super().collect_usage_pieces(cast(typer.Context, ctx))
        return [re.sub(r"^\{(.*)\}(\.*)$", r"\1\2", piece) for piece in pieces]

    def format_epilog(self, ctx: object, formatter: HelpFormatter) -> None:
        """Write the examples."""
        if self.epilog:
            with formatter.section("Examples"):
                for line in self.epilog.splitlines():
                    formatter.write(f"{'':{formatter.current_indent}}{line}\n")


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


def _plain(usage: str) -> str:
    """Replace Python's names of types in an option's help: choices by their values, others by NUMBER and TEXT."""
    usage = re.sub(r"(?<=[A-Z.\]]) <[^<>]*>$", "", usage)  # of an argument, which has its name
    usage = re.sub(r"<(?:float|int)(?: range)?>$", "NUMBER", usage)
    usage = re.sub(r"<(?:str|text)>$", "TEXT", usage)
    return re.sub(r"<([^<>]*\|[^<>]*)>$", r"\1", usage)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"omtwarp {omtwarp.__version__}")
        raise typer.Exit


def _common(
    version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True, help="Print the version."),
) -> None:
    pass


def app_of(names: Iterable[str] = SUMMARIES) -> typer.Typer:
    """Return the command line with the commands of these names; to read the options of all takes a while."""
    app = typer.Typer(
        help="Area-preserving maps of surfaces to the sphere, and textures through them.",
        epilog="Begin with: omtwarp demo -o out. Options and examples of a command: omtwarp COMMAND --help.",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["--help", "-h"]},
    )
    app.callback()(_common)
    for name in names:
        run = function_of(name)
        app.command(name, cls=Command, short_help=SUMMARIES[name], epilog=sections(run)[1])(as_command(run))
    return app


def main(arguments: list[str] | None = None) -> None:
    """Run a command and exit: with 0 if done, 1 if it failed (one line says why), 2 on wrong usage.

    An interruption ends the process by its signal after one line, see :mod:`omtwarp.files.interruptions`;
    shells report 130.

    Args:
        arguments: the command line without the program's name; ``sys.argv`` by default, where the process is taken to
            end with the command.
    """
    # A command imports many modules once and ends soon after: garbage collection of these takes a tenth of a second
    # during the import and as much again at the end.
    # Garbage threshold, objects made between searches for garbage: a map imports half as many, and all stay
    gc.set_threshold(1_000_000)
    atexit.register(gc.freeze)
    with ending_the_process(restore=arguments is not None):
        try:
            with standard_streams():
                try:
                    words = sys.argv[1:] if arguments is None else arguments
                    with warnings_as_lines():
                        app_of(SUMMARIES.keys() & words[:1] or SUMMARIES)(args=arguments, prog_name="omtwarp")
                except OmtwarpError as error:
                    _fail(str(error))
        except BrokenPipeError:  # the reader of the output has ended
            sys.exit(1)
        except MemoryError:
            _fail("out of memory: use a coarser mesh, or a machine with more")
        except KeyboardInterrupt:
            print(LINE, file=sys.stderr)
            sys.exit(INTERRUPTED)
        except Exception as error:
            if os.environ.get("OMTWARP_TRACEBACK"):
                raise
            _fail(unexpected(error, " (OMTWARP_TRACEBACK=1 shows where; please report it)"))


def _fail(message: str) -> None:
    say(f"error: {message}")
    sys.exit(1)
