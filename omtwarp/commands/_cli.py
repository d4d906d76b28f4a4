"""The command line: ``omtwarp COMMAND ...``, the commands of :mod:`omtwarp.commands`."""

import atexit
import gc
import os
import sys
from pathlib import Path
from typing import NoReturn

import click
from click.shell_completion import get_completion_class

import omtwarp
from omtwarp.commands import function_of
from omtwarp.commands._command import as_command
from omtwarp.commands._streams import say, standard_streams, warnings_as_lines
from omtwarp.errors import INTERRUPTED, OmtwarpError, out_of_memory, unexpected
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
}
"""One line about every command, short enough for a terminal of 80 columns; see :func:`function_of`."""

STARTS = {
    "bash": (".bashrc", 'eval "$({})"'),
    "zsh": (".zshrc", 'autoload -Uz compinit && compinit && eval "$({})"'),
    "fish": (".config/fish/config.fish", "{} | source"),
}
"""What shells read when they start, in the user's folder, and how they read there what a program prints."""


class _Program(click.Group):
    """All commands by their summaries; one is read where it is asked for."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.commands)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        name, _, rest = super().resolve_command(ctx, args)
        return name, None if name is None else as_command(function_of(name)), rest

    def invoke(self, ctx: click.Context) -> object:
        """Run a command; an interruption does not get to click, which has other words and another status for it."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            _interrupted()


def _interrupted() -> NoReturn:
    """Say that the command was interrupted, and exit."""
    print(LINE, file=sys.stderr)
    sys.exit(INTERRUPTED)


def _answer(ctx: click.Context, option: click.Parameter, wanted: bool) -> None:
    """Print the version, or what has the shell complete commands; or have it do so from now on."""
    if not wanted or ctx.resilient_parsing:
        return
    shell = Path(os.environ.get("SHELL", "powershell")).stem
    known = get_completion_class(shell)
    if option.name == "version":
        print(f"omtwarp {omtwarp.__version__}")
    elif known is None or (option.name == "install_completion" and shell not in STARTS):
        raise OmtwarpError(f"no completion for the shell '{shell}', which SHELL names: use {', '.join(STARTS)}")
    elif option.name == "show_completion":
        print(known(ctx.command, {}, "omtwarp", "_OMTWARP_COMPLETE").source())
    else:
        file, reading = Path.home() / STARTS[shell][0], STARTS[shell][1]
        line = f"\n{reading.format(f'_OMTWARP_COMPLETE={shell}_source omtwarp')}\n"
        file.parent.mkdir(parents=True, exist_ok=True)
        with open(file, "a+", encoding="utf-8", errors="replace") as start:
            start.seek(0)
            start.write("" if line in start.read() else line)
        print(f"{file}: completes commands of omtwarp in shells that start from now on")
    ctx.exit()


program = _Program(
    "omtwarp",
    commands={name: click.Command(name, short_help=summary) for name, summary in SUMMARIES.items()},
    params=[
        click.Option([name], is_flag=True, is_eager=True, expose_value=False, callback=_answer, help=said)
        for name, said in {
            "--version": "Print the version.",
            "--install-completion": "Install completion for the current shell.",
            "--show-completion": "Show completion for the current shell, to copy it or customize the installation.",
        }.items()
    ],
    help="Area-preserving maps of surfaces to the sphere, and textures through them.",
    epilog="Begin with: omtwarp demo -o out. Options and examples of a command: omtwarp COMMAND --help.",
    context_settings={"help_option_names": ["--help", "-h"]},
)


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
                    with warnings_as_lines():
                        program(args=arguments, prog_name="omtwarp")
                except OmtwarpError as error:
                    _fail(str(error))
        except BrokenPipeError:  # the reader of the output has ended
            sys.exit(1)
        except KeyboardInterrupt:
            _interrupted()
        except Exception as error:
            if out_of_memory(error):
                _fail("out of memory: use a coarser mesh, or a machine with more")
            if os.environ.get("OMTWARP_TRACEBACK"):
                raise
            _fail(unexpected(error, " (OMTWARP_TRACEBACK=1 shows where; please report it)"))


def _fail(message: str) -> None:
    say(f"error: {message}")
    sys.exit(1)
