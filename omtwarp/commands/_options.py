"""Options that several commands share."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class Until(StrEnum):
    """Stages of the pipeline, in order."""

    CONFORMAL = "conformal"
    MOSER = "moser"
    OMT = "omt"
    REFINE = "refine"


class Cost(StrEnum):
    SQUARED = "squared"
    GEODESIC = "geodesic"


class Method(StrEnum):
    OMT = "omt"
    HAKER = "haker"
    MOSER = "moser"
    TUTTE = "tutte"
    MEAN_VALUE = "mean-value"


class Scheme(StrEnum):
    DEFAULT = "default"
    PLAIN = "plain"
    PAPER = "paper"


def refine_weight(text: str) -> str:
    """Check what --refine is given: a name, or a positive number."""
    if text in ("none", "area", "balanced", "angle"):
        return text
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0.0 < number < float("inf"):
        raise typer.BadParameter(f"'{text}' is neither none, area, balanced or angle nor a positive number")
    return text


def picture_size(text: str) -> str:
    """Check what --size is given: WIDTHxHEIGHT, or one number for both."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and (height or width).isdigit() and int(width) > 0 and int(height or width) > 0):
        raise typer.BadParameter(f"'{text}' is not a size: use WIDTHxHEIGHT, such as 1024x768, or one number")
    return text


def as_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    return int(width), int(height or width)


MeshArgument = Annotated[Path, typer.Argument(metavar="MESH", help="A closed triangle mesh of any format.")]
OptionalMesh = Annotated[
    Path | None, typer.Argument(metavar="MESH", help="A closed triangle mesh; not needed with --map.")
]
MapOption = Annotated[
    Path | None, typer.Option("--map", metavar="NPZ", help="A finished map (from 'omtwarp map') instead of a new one.")
]
MethodOption = Annotated[Method, typer.Option(help="How to map; all but omt are there for comparison.")]
UntilOption = Annotated[Until, typer.Option(help="Stop after this stage.")]
CostOption = Annotated[Cost, typer.Option(help="What the transport minimises: squared geodesic distance, or distance.")]
SchemeOption = Annotated[Scheme, typer.Option(help="How the transport descends; paper is the published one.")]
RefineOption = Annotated[
    str,
    typer.Option(
        metavar="none|area|balanced|angle|NUMBER",
        callback=refine_weight,
        help="Last stage: the weight of area against angle.",
    ),
]
DeviceOption = Annotated[str, typer.Option(metavar="auto|cpu|cuda:N", help="Where to compute.")]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")]
RepairOption = Annotated[
    bool,
    typer.Option(
        "--repair",
        help="Mend the mesh first: equal vertices, orientation, small holes, the largest component; says what it did.",
    ),
]
SizeOption = Annotated[
    str, typer.Option(metavar="WIDTHxHEIGHT", callback=picture_size, help="Size of the picture in pixels.")
]
