"""``omtwarp spharm``: a surface as spherical harmonics."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import Printing, Source, output_option
from omtwarp.commands._streams import input_file, progress_bar, steps
from omtwarp.commands._work import map_from, require_whole, show_facts, start_device
from omtwarp.files.output import check_output, staged
from omtwarp.options import Device, MapOptions

if TYPE_CHECKING:
    from omtwarp.shape_analysis.expansion import Expansion

SUFFIXES = (".coef", ".csv", ".npz")


class Fit(StrEnum):
    """How coefficients are found; the values are those of :func:`omtwarp.shape_analysis.expansion.expand`."""

    LEAST_SQUARES = "least-squares"
    QUADRATURE = "quadrature"


def run(
    *,
    output: Annotated[Path, output_option(".csv")],
    mesh: Annotated[Path | None, typer.Argument(metavar="MESH", callback=input_file)] = None,
    finished: Annotated[Path | None, typer.Option("--map", metavar="NPZ", callback=input_file)] = None,
    degree: Annotated[int, typer.Option(metavar="L", min=0, max=500)] = 15,
    fit: Fit = Fit.LEAST_SQUARES,
    reconstruction: Path | None = None,
    repair: bool = False,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Expand a surface in spherical harmonics over its map to the sphere (SPHARM).

    Holes are expanded as they were filled, but count for nothing in the error.

    Harmonics are real and orthonormal, without the Condon-Shortley phase; a .coef file has SPHARM-PDM's own order and
    signs.

    Examples:
        omtwarp spharm left.npz -o left.coef --degree 15 --reconstruction smooth.ply
        omtwarp spharm left.npz -o left.csv --fit quadrature --json

    Options:
        output: .coef as SPHARM-PDM has it, .csv, or .npz with everything; - is standard output, as .csv.
        degree: Highest degree of the harmonics.
        fit: How to fit: least squares at the vertices, or integrals over the triangles.
        reconstruction (MESH): Also write the surface that the coefficients describe.
        mesh: A closed triangle mesh, or -; not needed with --map.
        finished: A finished map (from 'omtwarp map') instead of a new one; - is standard input.
        repair: Repair the mesh first: equal vertices, orientation, small holes, largest component; prints what it did.
    """
    import numpy as np

    from omtwarp.mesh.surface import Surface
    from omtwarp.mesh.write import SUFFIXES as MESH_SUFFIXES
    from omtwarp.mesh.write import write_mesh
    from omtwarp.shape_analysis.expansion import expand
    from omtwarp.spheres import mesh_grid

    check_output(output, SUFFIXES, mesh, finished)
    if reconstruction is not None:
        check_output(reconstruction, tuple(MESH_SUFFIXES), mesh, finished, output)
    start_device(device)
    result = map_from(mesh, Source(finished=finished, repair=repair), MapOptions(device=device), printing)
    result = require_whole(result, finished or mesh)
    whole = result.closed()
    mesh_grid(whole.sphere, whole.faces, str(finished or mesh))  # harmonics need a map that covers the sphere once
    with progress_bar(printing.quiet, printing.verbose) as progress:
        notify = steps(progress, "spharm", 2)
        notify(0)
        expansion = expand(whole.sphere, whole.vertices, degree, faces=whole.faces, method=fit.value)
        notify(1)
        again = expansion.at(result.sphere)
        notify(2)
    areas = Surface(result.vertices, result.faces).vertex_areas
    error = float(np.sqrt(areas @ ((again - result.vertices) ** 2).sum(axis=1) / areas.sum()))
    save(output, expansion)
    if reconstruction is not None:
        write_mesh(reconstruction, again, result.faces)
    size = float(np.sqrt(expansion.power()[1:].sum() / (4.0 * np.pi)))
    line = f"{output}: degree {degree}, root mean square error {error:.6g} of a size of {size:.6g}"
    show_facts({"degree": degree, "rms_error": error, "power": expansion.power()}, line, printing)


def save(path: Path, expansion: Expansion) -> None:
    """Write coefficients in the format of the file's suffix."""
    import numpy as np

    from omtwarp.files.inputs import write_arrays
    from omtwarp.geometry.harmonics import degrees
    from omtwarp.shape_analysis.expansion import write_coef

    suffix = path.suffix.lower()
    if suffix == ".coef":
        write_coef(path, expansion)
        return
    degree = degrees(expansion.degree)
    order = np.arange(len(degree)) - degree * (degree + 1)
    if suffix == ".npz":
        power = expansion.power()
        write_arrays(path, {"coefficients": expansion.coefficients, "degree": degree, "order": order, "power": power})
        return
    with staged(path) as file:
        rows = zip(degree.tolist(), order.tolist(), expansion.coefficients.tolist(), strict=True)
        lines = [f"{n},{m}," + ",".join(map(repr, row)) for n, m, row in rows]
        file.write_text("degree,order,x,y,z\n" + "\n".join(lines) + "\n", "utf-8")
