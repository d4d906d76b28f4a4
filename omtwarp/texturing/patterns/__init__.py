"""Built-in patterns: functions of direction on the sphere, exact at every resolution and without a seam or a pole.

Those of section 5 of the paper, one a file. A pattern is called with directions and gives colours::

    pattern("circles", count=162)(directions)  # [N, 3] -> [N, 3], red, green and blue in 0..1

With its colour every direction gets its reach: an angle in radians within which the colour changes gradually, without
an edge. It is never too large; beyond some angle, which is small beside a pattern's cells, edges are not looked for.

A new pattern is a file here with a class, and its name in :class:`omtwarp.options.PatternName`.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from typing import TypeGuard, cast

from omtwarp.errors import OmtwarpError
from omtwarp.options import PatternLike, PatternName
from omtwarp.texturing.patterns.base import Pattern


def _class(name: str) -> type[Pattern]:
    """Return the class of a pattern, which its file is named after."""
    return cast("type[Pattern]", getattr(import_module(f"{__name__}.{name}"), name.capitalize()))


@lru_cache(maxsize=16)
def _default(name: str) -> Pattern:
    return _class(name)()


def is_name(given: object) -> TypeGuard[PatternLike]:
    """Return whether a text is the name of a pattern."""
    return isinstance(given, str) and given in tuple(PatternName)


def pattern(name: str | Pattern, **options: int | str) -> Pattern:
    """Return a built-in pattern by name, with the options of its class.

    Raises:
        OmtwarpError: a name that does not exist, or an option that the pattern does not have.
    """
    if isinstance(name, Pattern):
        return name
    if name not in tuple(PatternName):
        *most, last = tuple(PatternName)
        raise OmtwarpError(f"unknown pattern '{name}': use {', '.join(most)} or {last}")
    if not options:
        return _default(name)
    try:
        return _class(name)(**options)
    except TypeError as error:
        raise OmtwarpError(f"pattern {name}: {error}") from error


__all__ = ["is_name", "pattern"]
