"""The commands of the command line, one module each; :mod:`omtwarp.commands._cli` puts them together.

Nothing heavy is imported at the top of these modules, so that ``omtwarp --help`` answers at once.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module


def function_of(command: str) -> Callable[..., None]:
    """Return the function of a command, ``run`` in the module of its name, which is loaded where it is first needed."""
    function: Callable[..., None] = import_module(f"omtwarp.commands.{command}").run
    return function
