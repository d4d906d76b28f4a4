"""Interpreters that are started beside this one, which import nothing from the working directory."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_ROOT = str(Path(__file__).resolve().parents[2])
_FIND_PACKAGE = "import sys; sys.path.insert(0, sys.argv.pop(1)); "


def interpreter(code: str, *arguments: str) -> list[str]:
    """Return the command line of an interpreter that runs some code with this very package.

    With ``-P`` the working directory is no place for modules: a ``signal.py`` there is data, as every file of a user's.

    Args:
        code: what it runs, on one line.
        arguments: what it finds in ``sys.argv[1:]``.
    """
    return [sys.executable, "-P", "-c", _FIND_PACKAGE + code, _ROOT, *arguments]


@contextmanager
def safe_paths() -> Iterator[None]:
    """Let interpreters that libraries start inside of it import nothing from the working directory either."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            os.environ.pop("PYTHONSAFEPATH", None)
        else:
            os.environ["PYTHONSAFEPATH"] = before
