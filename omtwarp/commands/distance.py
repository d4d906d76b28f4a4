"""``omtwarp distance``: how far two shapes are apart."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import Printing
from omtwarp.commands._streams import input_file, progress_bar
from omtwarp.commands._work import load_whole_map, show_facts, start_device
from omtwarp.options import Device, MapOptions


def run(
    *,
    first: Annotated[Path, typer.Argument(metavar="A", callback=input_file)],
    second: Annotated[Path, typer.Argument(metavar="B", callback=input_file)],
    degree: Annotated[int, typer.Option(metavar="L", min=1, max=64)] = 12,
    scale: bool = False,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Measure the distance of two shapes, whatever their positions and rotations.

    There are two measures: the root mean square distance of corresponding points, from coefficients of spherical
    harmonics; and the root of the least transport cost between the densities of their conformal maps, in radians.

    Examples:
        omtwarp distance left.npz right.npz --json

    Options:
        first: A map (.npz); - is standard input.
        second: Another map (.npz).
        degree: Highest degree of the harmonics.
        scale: Scale both shapes to the same size before coefficients are compared.
    """
    from omtwarp.shape_analysis.distance import shape_distance

    start_device(device)
    ends = load_whole_map(first), load_whole_map(second)
    with progress_bar(printing.quiet, printing.verbose) as progress:
        distances = shape_distance(*ends, degree=degree, scale=scale, device=device, progress=progress)
    coefficients, transport = f"{distances.coefficients:.6g}", f"{distances.transport:.6g}"
    if printing.quiet and not printing.as_json:
        print(coefficients, transport)
    line = f"coefficients {coefficients} (the surfaces' unit), transport {transport} radians"
    show_facts({"first": str(first), "second": str(second), **distances.to_dict()}, line, printing)
