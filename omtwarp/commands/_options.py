"""Options that several commands share."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from omtwarp.commands._streams import input_file, output_file
from omtwarp.errors import OmtwarpError
from omtwarp.options import MapOptions, PatternName


@dataclass(frozen=True)
class Typed:
    """How an option is typed, where its name and type do not say it.

    Attributes:
        names: what it is called, as ``--output -o``; ``--NAME`` by default.
        read: reads the text, and refuses it with an OmtwarpError.
        file: replaces ``-`` by a file, as :func:`omtwarp.commands._streams.input_file` does.
        bounds: the least and the largest number that is taken; None for no such bound.
    """

    names: str = ""
    read: Callable[[object], object] | None = None
    file: Callable[[object], object] | None = None
    bounds: tuple[float | None, float | None] | None = None


class Argument(Typed):
    """A value that is typed without a name before it."""


def output_option(suffix: str | None = None) -> Typed:
    """Return the option for what a command writes.

    Args:
        suffix: the format in which ``-`` writes it to standard output; None where the command sees to that.
    """
    return Typed("--output -o", file=None if suffix is None else output_file(suffix))


class Only(tuple[str, ...]):
    """The options of a group that a command takes, in the place of all."""


def picture_size(given: object) -> str:
    """Check the value of --size: WIDTHxHEIGHT, or one number for both; return it unchanged.

    Raises:
        OmtwarpError: it is neither.
    """
    text = str(given)
    if not re.fullmatch(r"0*[1-9][0-9]{0,5}(x0*[1-9][0-9]{0,5})?", text.lower(), flags=re.ASCII):
        raise OmtwarpError(f"'{text}' is not a size: use WIDTHxHEIGHT, such as 1024x768, or one number")
    return text


def as_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    return int(width), int(height or width)


ROUTE = Only(("method", "until", "cost", "scheme", "refine", "device", "solver"))
"""The options of a map for commands that make something from it."""

RouteOptions = Annotated[MapOptions, ROUTE]


@dataclass(frozen=True)
class Source:
    """What a command works on: meshes, of which it makes maps, or a finished map.

    Options:
        meshes (MESH): Closed triangle meshes of any format, or -; none with --map.
        finished (NPZ): A finished map (from 'omtwarp map') instead of a new one; - is standard input.
        repair: Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.
    """

    meshes: Annotated[list[Path] | None, Argument(file=input_file)] = None
    finished: Annotated[Path | None, Typed("--map", file=input_file)] = None
    repair: bool = False

    @property
    def files(self) -> list[Path]:
        """All files that are given."""
        return [*(self.meshes or []), *([] if self.finished is None else [self.finished])]


@dataclass(frozen=True)
class PictureOrPattern:
    """A picture or a pattern on the sphere.

    Options:
        image (PICTURE): An equirectangular picture to put on the surface.
        pattern: A pattern in place of a picture; circles by default.
    """

    image: Path | None = None
    pattern: PatternName | None = None

    def read(self) -> dict:
        """Read the picture; return it and the pattern as functions take them.

        Raises:
            OmtwarpError: both are given, or the picture cannot be read.
        """
        from omtwarp.texturing import read_image

        if self.image is not None and self.pattern is not None:
            raise OmtwarpError("both --image and --pattern: give one")
        picture = None if self.image is None else read_image(self.image)
        return {"image": picture, "pattern": self.pattern or PatternName.CIRCLES}


@dataclass(frozen=True)
class Printing:
    """What a command says about its work.

    Options:
        as_json: Print the facts as JSON on standard output.
        verbose: Print what every stage did.
        quiet: Print no progress and no summary.
    """

    as_json: Annotated[bool, Typed("--json")] = False
    verbose: Annotated[bool, Typed("--verbose -v")] = False
    quiet: Annotated[bool, Typed("--quiet -q")] = False
