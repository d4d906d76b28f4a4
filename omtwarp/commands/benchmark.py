"""``omtwarp benchmark``: how fast the package is on this machine."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import Only, output_option
from omtwarp.commands._streams import input_file, output_file, say
from omtwarp.commands._work import report_text, start_device
from omtwarp.errors import OmtwarpError
from omtwarp.files.limits import MOST_FACES
from omtwarp.files.output import check_output, write_text
from omtwarp.options import MapOptions, Refinement


def face_counts(text: str) -> str:
    """Check the value of --sizes: numbers of faces, such as 5000,20k,1M; return it unchanged."""
    parse_sizes(text)
    return text


def parse_sizes(text: str) -> tuple[int, ...]:
    """Read numbers of faces from text such as 5000,20k,1M; ``none`` gives an empty list."""
    if text == "none":
        return ()
    sizes = []
    for word in text.split(","):
        number, factor = word.strip().lower(), 1.0
        if number and number[-1] in "km":
            number, factor = number[:-1], 1e3 if number[-1] == "k" else 1e6
        try:
            faces = float(number) * factor
        except ValueError:
            faces = math.nan
        if not 1.0 <= faces <= MOST_FACES:
            raise typer.BadParameter(f"'{word}' is not a number of faces up to {MOST_FACES:,}: use 5000, 20k or 1M")
        sizes.append(round(faces))
    return tuple(sizes)


@dataclass(frozen=True)
class Workload:
    """What is measured, and how often.

    Options:
        meshes: Mesh files to measure in addition to generated shapes; - is standard input.
        sizes: Numbers of faces of generated shapes, 5k to 2M; none for no shapes.
        shapes: Generated shapes: blob, creature, sphere.
        subdivisions: How often to subdivide the given meshes too.
        devices: Devices to map on; auto is every device there is.
        repeats: Number of maps, of which the median is taken.
        kernels: Also measure every kernel, and the memory it moves.
        cold: Also measure compilation into an empty cache, and starts.
    """

    meshes: Annotated[list[Path] | None, typer.Argument(metavar="MESH", callback=input_file)] = None
    sizes: Annotated[str, typer.Option(metavar="N,N,...", callback=face_counts)] = "5k,20k,80k"
    shapes: Annotated[str, typer.Option("--shape", metavar="NAME,...")] = "blob"
    subdivisions: Annotated[int, typer.Option("--subdivide", metavar="TIMES", min=0, max=6)] = 0
    devices: Annotated[str, typer.Option("--device", metavar="cpu,cuda:0")] = "auto"
    repeats: Annotated[int, typer.Option(min=1, max=1000)] = 3
    kernels: bool = False
    cold: bool = False


def run_benchmark(
    *,
    workload: Workload,
    mapping: Annotated[MapOptions, Only(("refine",))],
    json_output: Annotated[Path | None, typer.Option("--json", metavar="FILE", callback=output_file(".json"))] = None,
    output: Annotated[Path | None, output_option()] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q")] = False,
) -> None:
    """Time every stage and its memory on meshes of several sizes, and compare with a sparse factorisation by SciPy.

    Takes a minute or two with the sizes it has by default, and no network.

    Examples:
        omtwarp benchmark --sizes 5k,20k --repeats 1
        omtwarp benchmark scan.ply --sizes none --json -

    Options:
        json_output: Write all figures as JSON, or to -.
        output: Write the tables (.md) instead of printing.
        quiet: Print no progress.
        verbose: Print what every stage did.
    """

    given = tuple(workload.meshes or ())
    check_output(json_output, (".json",), *given)
    check_output(output, (".md", ".markdown", ".txt"), *given)
    if json_output is not None and output is not None and json_output.resolve() == output.resolve():
        raise OmtwarpError("--json and --output name the same file")
    wanted = [word.strip() for word in workload.devices.split(",")]
    for name in wanted:
        start_device(name)
    from omtwarp.benchmark import markdown, run as measure
    from omtwarp.device.start import wp

    if wanted == ["auto"]:
        wanted = ["cpu", "cuda:0"] if wp.is_cuda_available() else ["cpu"]
    asked = {"meshes": given, "sizes": parse_sizes(workload.sizes), "devices": wanted}
    asked["shapes"] = tuple(word.strip() for word in workload.shapes.split(","))
    refine = str(mapping.refine or Refinement.NONE)
    result = measure(**vars(workload) | asked, refine=refine, progress=None if quiet else say)
    if verbose:
        for mesh in result["meshes"]:
            for times in mesh["runs"]:
                for stage in times["stages"]:
                    say(f"{mesh['name']}, {times['device']}: {stage['name']}: {stage['seconds']:.2f} s")
    if json_output is not None:
        write_text(json_output, report_text(result))
    if output is not None:
        write_text(output, markdown(result))
    else:
        print(markdown(result), end="")
