"""The package's exception, the category of its warnings, their form in a terminal, and the choice of a known value."""

import contextlib
import re
from collections.abc import Iterable, Iterator
from enum import StrEnum
from typing import TypeVar

Kind = TypeVar("Kind", bound=StrEnum)

# What messages say in Python, and what the command line says for it; other arguments become the option of their name.
OPTIONS = {
    "omtwarp.repair": "--repair",
    "map_surface with ": "'omtwarp map' with ",
    "domain='sphere', fill_area='natural' or 'small'": "--fill-area natural or small",
    "domain='sphere' makes": "--cut makes",  # of a surface with handles
    "domain='sphere'": "--fill-area natural",
    "map_to_sphere and save": "'omtwarp map MESH -o MAP.npz'",
    "by align with mirror=True": "with 'omtwarp align MAP --to FIRST --mirror'",
    "or choose another directory": "choose another directory, or use --force",
    "shard=(i, n)": "--shard i/n",
} | {f"domain='{name}'": f"--{name}" for name in ("hemisphere", "disk", "cap", "torus")}
ARGUMENT = re.compile(r"\b([a-z_]+)=(?:True|\[?'([^']+)'\]?)")
INTERRUPTED = 130  # exit status of a command that is interrupted: 128 and the number of the signal, as shells report it


class OmtwarpError(ValueError):
    """Raised for input that cannot be used, or a request that cannot be met; its message is one line.

    The text names the defect, how many there are, where the first one is and how to repair it; the command line prints
    this text, with its options in place of arguments, and exits with a status other than 0.

    Example:
        >>> import omtwarp
        >>> try:
        ...     omtwarp.map_to_sphere(omtwarp.shapes.icosphere(2), device="gpu")
        ... except omtwarp.OmtwarpError as error:
        ...     print(error)
        unknown device 'gpu': use auto, cpu, cuda or cuda:N
    """

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text) if "\n" in text else text)  # it may show an array


class LacksArray(OmtwarpError, AttributeError):
    """Raised where an array of a map is read that maps to its domain do not have; ``hasattr`` says so too."""


def one_line(text: str) -> str:
    """Return a text on one line with control characters escaped, since it may quote a file.

    >>> one_line("no such\\nfile '\\x1b[31m'")
    "no such file '\\\\x1b[31m'"
    """
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape", "backslashreplace").decode()
        for character in " ".join(text.split())
    )


def brief(error: Exception) -> str:
    """Return what an error of another library says, short and on one line, or its type where it says nothing."""
    return " ".join(str(error).split())[:160] or type(error).__name__


def with_options(text: str) -> str:
    """Return a message for a terminal: arguments of Python in it become options of the command line.

    >>> with_options("remesh it, or use refine='area', bake=['normal'] or cut_along='holes' with cut=True")
    'remesh it, or use --refine area, --bake normal or --cut-along holes with --cut'
    >>> with_options("keep the largest with omtwarp.repair, or use map_surface with domain='disk'")
    "keep the largest with --repair, or use 'omtwarp map' with --disk"
    """
    for words, option in OPTIONS.items():
        text = text.replace(words, option)
    return ARGUMENT.sub(lambda match: f"--{match[1].replace('_', '-')}{' ' if match[2] else ''}{match[2] or ''}", text)


@contextlib.contextmanager
def installed(lacks: str, extra: str) -> Iterator[None]:
    """Import a package in this context that is not always installed.

    Args:
        lacks: what the message says where it is missing.
        extra: of this package, with which it is installed.

    Raises:
        OmtwarpError: it is missing.
    """
    try:
        yield
    except ImportError:
        raise OmtwarpError(f"{lacks}: pip install 'omtwarp[{extra}]'") from None


@contextlib.contextmanager
def naming(what: str) -> Iterator[None]:
    """Say first what an error of this context is about.

    Args:
        what: a file, a map or another object, as messages call it.

    Raises:
        OmtwarpError: the same error, with these words and a colon before it.
    """
    try:
        yield
    except OmtwarpError as error:
        raise OmtwarpError(f"{what}: {error}") from None


def out_of_memory(error: Exception) -> bool:
    """Return whether an error says that memory is used up: Python's own, or Warp's, which is a RuntimeError."""
    return isinstance(error, MemoryError) or str(error).startswith("Failed to allocate")


def unexpected(error: Exception, hint: str = "") -> str:
    """Return a line about an error that is not the package's own: the system's about a file, or one in the package.

    >>> unexpected(PermissionError(13, "Permission denied", "kernels"), " (please report it)")
    "'kernels': Permission denied"
    >>> unexpected(KeyError("gap"), " (please report it)")
    "internal error, KeyError: 'gap' (please report it)"
    """
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"'{error.filename}': {error.strerror}"
    return f"internal error, {type(error).__name__}: {error}{hint}"


class DrawingFailed(Exception):
    """The drawing process gave no picture; the text says why."""


class OmtwarpWarning(UserWarning):
    """Warns of a map that is one to one but worse than it should be: the measure, the worst place and what would help.

    Example:
        >>> import warnings, omtwarp
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always", omtwarp.OmtwarpWarning)
        ...     result = omtwarp.map_to_sphere(omtwarp.shapes.icosphere(4), device="cpu")
        >>> len(caught), result.report["warnings"]
        (0, [])
    """


def choose(kind: type[Kind], value: object, *, without: tuple[Kind, ...] = ()) -> Kind:
    """Return the member of an option's values that a text names.

    Args:
        kind: the option, such as :class:`omtwarp.options.Cost`.
        value: a member, or its text.
        without: members that are not offered here.

    Raises:
        OmtwarpError: the option has no such value; the message lists those it has.
    """
    name = re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower()
    check_word(name, value, [member for member in kind if member not in without])
    return kind(str(value))


def check_word(name: str, value: object, offered: Iterable[str]) -> None:
    """Check that a text is among those that are offered.

    Args:
        name: what it is the name of, such as ``light``.
        value: the text.
        offered: all texts that it may be.

    Raises:
        OmtwarpError: it is none of them; the message lists them.
    """
    offered = list(offered)
    if not isinstance(value, str) or value not in offered:
        raise OmtwarpError(f"unknown {name} {shown(value)}: use {', '.join(offered)}")


def truth(value: object, name: str) -> bool:
    """Return whether an option is asked for.

    Raises:
        OmtwarpError: the value is text, or has many values: it is not said which of them counts.
    """
    if isinstance(value, Iterable):
        raise OmtwarpError(f"{name} {shown(value)}: must be True or False")
    return bool(value)


def shown(value: object) -> str:
    """Return a value as text for a message: itself where it is text or a number, its type otherwise."""
    return f"'{value}'" if isinstance(value, str | int | float) else f"of type {type(value).__name__}"
