"""The command line: ``omtwarp COMMAND ...``, one module of :mod:`omtwarp.commands` for every command."""

from __future__ import annotations

import atexit
import contextlib
import gc
import os
import signal
import sys
import threading
from collections.abc import Iterator

import typer

from omtwarp.commands.align import align_map
from omtwarp.commands.benchmark import benchmark
from omtwarp.commands.check import check_mesh
from omtwarp.commands.cohort import cohort
from omtwarp.commands.demo import demo
from omtwarp.commands.map import map_mesh
from omtwarp.commands.preview import preview_mesh
from omtwarp.commands.report import report_on_map
from omtwarp.commands.resample import resample_map
from omtwarp.commands.spharm import spharm
from omtwarp.commands.texture import texture_mesh
from omtwarp.errors import OmtwarpError, one_line
from omtwarp.version import package_version

app = typer.Typer(
    help="Area-preserving maps from closed genus-0 surfaces to the sphere, and textures through them.",
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("map")(map_mesh)
app.command("texture")(texture_mesh)
app.command("preview")(preview_mesh)
app.command("report")(report_on_map)
app.command("align")(align_map)
app.command("resample")(resample_map)
app.command("check")(check_mesh)
app.command("cohort")(cohort)
app.command("spharm")(spharm)
app.command("demo")(demo)
app.command("benchmark")(benchmark)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"omtwarp {package_version()}")
        raise typer.Exit


@app.callback()
def _common(
    version: bool = typer.Option(False, "--version", callback=_show_version, is_eager=True, help="Print the version."),
) -> None:
    pass


def main(arguments: list[str] | None = None) -> None:
    """Run a command and exit: 0 done, 1 it could not be done (one line says why), 2 wrong usage, 130 interrupted.

    Args:
        arguments: the command line without the program's name; ``sys.argv`` by default, where the process is taken to
            end with the command.
    """
    # A command imports a great deal once and ends soon after: looking for garbage among that takes a tenth of a second
    # while it is imported and as much again at the end.
    gc.set_threshold(200_000)
    atexit.register(gc.freeze)
    with _interruptible(restore=arguments is not None):
        try:
            app(args=arguments, prog_name="omtwarp")
        except OmtwarpError as error:
            _fail(str(error))
        except BrokenPipeError:  # the reader of our output has gone
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            sys.exit(1)
        except MemoryError:
            _fail("out of memory: use a coarser mesh, or a machine with more")
        except KeyboardInterrupt:
            sys.exit(130)
        except Exception as error:
            if os.environ.get("OMTWARP_TRACEBACK"):
                raise
            kind = type(error).__name__
            _fail(f"internal error, {kind}: {error} (OMTWARP_TRACEBACK=1 shows where; please report it)")


def _fail(message: str) -> None:
    print(f"omtwarp: error: {one_line(message)}", file=sys.stderr)
    sys.exit(1)


@contextlib.contextmanager
def _interruptible(restore: bool) -> Iterator[None]:
    """Let an interruption end the process at once, as it ends programs that do not handle it.

    ``restore`` puts Python's handler back afterwards. A process that ends with the command leaves it: an interruption
    while it ends would be an exception in whatever runs then.

    Python's own handler waits until native code returns, which in a factorisation or a long kernel takes more than a
    second. Nothing is lost: files are staged, and while there is anything to tidy up, the signal is handled by
    :func:`omtwarp.files.staged`.
    """
    own = threading.current_thread() is threading.main_thread()
    handled = own and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if handled:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        if handled and restore:
            signal.signal(signal.SIGINT, signal.default_int_handler)


if __name__ == "__main__":
    main()
