"""``python -m omtwarp``, and the command ``omtwarp``.

What answers an interruption is in place before anything else is read: reading the commands takes a tenth of a second.
"""

import contextlib
import os
import signal
import sys
from types import FrameType


def _end(number: int, frame: FrameType | None) -> None:
    """End as the signal ends a program, after a line; for the short time until the package's own handler is read."""
    os.write(2, b"omtwarp: interrupted\n")
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)


def _open_streams() -> None:
    """Lead standard streams that are closed to the null device, since files that are opened would get their numbers.

    A terminal that cannot show a character is shown its code.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # of the lowest number that is free, which is its own
            with contextlib.suppress(OSError):
                os.dup2(stream.fileno(), number)  # children inherit it
            setattr(sys, name, stream)
    with contextlib.suppress(AttributeError):  # a stream that is no text of the system's
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]


def main() -> None:
    """Run the command line, see :func:`omtwarp.commands._cli.main`."""
    _open_streams()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    from omtwarp.files.interruptions import ending_the_process

    with ending_the_process(restore=False, instead_of=_end):
        from omtwarp.commands._cli import main as run

        run()


if __name__ == "__main__":
    main()
