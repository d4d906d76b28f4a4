"""The commands of the command line, in modules by what they are about; :mod:`omtwarp.commands._cli` puts them together.

Nothing heavy is imported at the top of these modules, so that ``omtwarp --help`` answers at once.
"""

from collections.abc import Callable
from importlib import import_module

_HOMES = {
    "map": ("map", "demo"),
    "texture": ("texture", "unwrap", "transfer"),
    "pictures": ("preview", "film", "report"),
    "spheres": ("align", "register"),
    "shapes": ("spharm", "distance", "group"),
}
"""Modules of several commands; others have a module of their name."""


def function_of(command: str) -> Callable[..., None]:
    """Return the function of a command, ``run_COMMAND``, whose module is loaded where it is first needed."""
    home = next((module for module, commands in _HOMES.items() if command in commands), command)
    return getattr(import_module(f"omtwarp.commands.{home}"), f"run_{command}")
