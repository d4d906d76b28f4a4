"""``python -m omtwarp``, and the command ``omtwarp``.

What answers an interruption is in place before anything else is read: reading the commands takes a tenth of a second.
"""

import os
import signal
from types import FrameType


def _end(number: int, frame: FrameType | None) -> None:
    """End as the signal ends a program, after a line; for the short time until the package's own handler is read."""
    os.write(2, b"omtwarp: interrupted\n")
    signal.signal(number, signal.SIG_DFL)
    signal.raise_signal(number)


def main() -> None:
    """Run the command line, see :func:`omtwarp.cli.main`."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    from omtwarp.interruptions import ending_the_process

    with ending_the_process(restore=False, instead_of=_end):
        from omtwarp.cli import main as run

        run()


if __name__ == "__main__":
    main()
