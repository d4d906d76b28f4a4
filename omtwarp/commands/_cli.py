"""The command line: ``omtwarp COMMAND ...``, one module of :mod:`omtwarp.commands` for every command."""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Iterable

import typer

import omtwarp
from omtwarp.commands import function_of
from omtwarp.commands._command import Command, Group
from omtwarp.commands._options import as_command, sections
from omtwarp.commands._streams import say, standard_streams, warnings_as_lines
from omtwarp.errors import INTERRUPTED, OmtwarpError, unexpected
from omtwarp.files.interruptions import LINE, ending_the_process

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
    "benchmark": "Time every stage and its memory on meshes of several sizes.",
}
"""One line about every command, short enough for a terminal of 80 columns; each is ``run`` in a module of its name."""


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
        cls=Group,
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


if __name__ == "__main__":
    main()
