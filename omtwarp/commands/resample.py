"""``omtwarp resample``: a surface or data at its vertices, carried to another sphere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import omtwarp
from omtwarp.commands._options import Argument, Printing, Typed, output_option
from omtwarp.commands._streams import STREAM, input_file, output_file, step_times
from omtwarp.commands._work import refuse, require_own_hemisphere, show_facts, start_device
from omtwarp.errors import OmtwarpError
from omtwarp.files.output import check_outputs
from omtwarp.options import Device, Interpolation, MapOptions, Side

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from omtwarp.mesh.data import VertexData
    from omtwarp.resampling import Resampling


@dataclass(frozen=True)
class Extras:
    """What is written beside the data.

    Options:
        sphere (MESH): Write the target sphere as well.
        matrix (NPZ): Write the sparse matrix, for scipy.sparse.load_npz.
    """

    sphere: Path | None = None
    matrix: Path | None = None

    def write(self, resampling: Resampling, like: Path | None) -> None:
        """Write the target's sphere and the matrix where they are asked for."""
        from omtwarp.mesh.write import write_mesh

        if self.sphere is not None:
            grid = resampling.target.grid
            write_mesh(self.sphere, grid.points[: grid.own_points], grid.own_triangles, spherical=True, like=like)
        if self.matrix is not None:
            resampling.save(self.matrix)


@dataclass(frozen=True)
class Given:
    """The data that are carried, none where the surface itself is.

    Options:
        data: Data at SOURCE's points: .npy, GIFTI, .annot, curv, .ply; - is standard input.
        labels: Treat the data as labels; GIFTI and .annot files are recognised.
    """

    data: Annotated[Path | None, Typed(file=input_file)] = None
    labels: bool = False

    def read(self, structure: str | None) -> VertexData | None:
        """Read the data, of a part of the brain that their file may say itself.

        Raises:
            OmtwarpError: they cannot be read.
        """
        from omtwarp.mesh.data import read_data

        if self.data is None:
            return None
        given = read_data(self.data, structure)
        return replace(given, structure=given.structure or structure)


def run_resample(
    *,
    source: Annotated[str, Argument(file=input_file)],
    to: Annotated[str, Typed(file=input_file)],
    output: Annotated[Path, output_option()],
    given: Given,
    method: Interpolation | None = None,
    surface: Path | None = None,
    extras: Extras,
    hemisphere: Side | None = None,
    device: Device = MapOptions.device,
    printing: Printing,
) -> None:
    """Carry data, or the surface itself, from one sphere to another.

    Both spheres are taken in the position they are in: see 'omtwarp align'. Conservative resampling keeps integrals,
    bounds and signs. Without --data the surface is written with the target's triangles: the same mesh for all subjects.

    Examples:
        omtwarp resample left.npz --to right.npz -o resampled.ply
        omtwarp resample lh.npz --to fsaverage5 --data lh.thickness -o lh.shape.gii
        omtwarp align lh.npz -o - | omtwarp resample - --to ico5 -o lh_ico5.ply

    Options:
        source (SOURCE): A map (.npz), a sphere as a mesh, or a grid such as fsaverage5; - is standard input.
        to (TARGET): A map, a sphere, ico0..ico8, fsaverage3..7, fsLR32k, healpix:NSIDE, equiangular:HxW, octahedral:N.
        output: The data at the target; without --data the surface; - is standard output, .npy or .ply.
        method: How; barycentric by default, and conservative (largest overlap) for labels.
        surface (MESH): The surface of SOURCE, where SOURCE is a sphere without one.
        hemisphere: Of fsLR32k, and of what is written where neither SOURCE nor the data say it.
    """
    from omtwarp.mesh.data import DATA_SUFFIXES
    from omtwarp.mesh.neuro import structure_of
    from omtwarp.mesh.write import SUFFIXES
    from omtwarp.resampling import file_points
    from omtwarp.resampling.averages import is_average, with_side
    from omtwarp.spheres import is_named

    files = [file for file in (given.data, surface, *map(Path, (source, to))) if file is not None]
    refuse({"--labels is of --data": given.labels and given.data is None})
    structure = _structure(files, hemisphere, output)
    source, to = (text if is_named(text) else with_side(text, structure) for text in (source, to))
    here, there = (None if is_named(text) or is_average(text) else Path(text) for text in (source, to))
    if output == STREAM:
        output = cast(Path, output_file(".ply" if given.data is None else ".npy")(output))
    inputs = [here, there, surface, given.data]
    suffixes = SUFFIXES if given.data is None else DATA_SUFFIXES
    check_outputs([(output, suffixes), (extras.sphere, SUFFIXES), (extras.matrix, (".npz",))], *inputs)
    like = here if surface is None else surface
    data = given.read(structure)
    as_labels = given.labels or (data is not None and data.is_labels)  # of which the one of largest overlap is taken
    chosen = method or (Interpolation.CONSERVATIVE if as_labels else Interpolation.BARYCENTRIC)
    start_device(device)
    with step_times(printing.verbose) as done:
        ends = [file_points(source, surface), file_points(to, None)]
        done("read")
        resampling = omtwarp.resample(*ends, method=chosen, device=device)
        done("resample")
        if data is not None:
            _write(output, resampling, data, as_labels)
        else:
            _write_surface(output, resampling, like, to, structure)
        extras.write(resampling, there if structure_of(there) else like)
        done("write")
    show_facts(_record(resampling, output, data), _line(resampling, output, data, as_labels), printing)


def _structure(files: list[Path], hemisphere: Side | None, output: Path) -> str | None:
    """Return the part of the brain that is written: the files' own or, where they do not say it, the hemisphere asked.

    Raises:
        OmtwarpError: the files are of different parts, or the hemisphere, or the one in the output's name, is another
            one than theirs.
    """
    from omtwarp.mesh.neuro import require_same_structure

    asked = hemisphere and f"Cortex{hemisphere.title()}"
    structure = require_same_structure(*files) or asked
    require_own_hemisphere(structure, output, asked)
    return structure


def _line(resampling: Resampling, output: Path, data: VertexData | None, as_labels: bool) -> str:
    what = "the surface" if data is None else f"{('data', 'labels')[as_labels]} with {data.values.shape[1]} column(s)"
    rows, columns = resampling.matrix.shape
    line = f"{output}: {what}, {resampling.method}, from {columns} to {rows} points"
    empty = 0 if data is None else int(resampling.empty.sum())
    return f"{line}, {empty} of them 0 as they lie in filled holes" if empty else line


def _write_surface(output: Path, resampling: Resampling, like: Path | None, target: str, structure: str | None) -> None:
    """Write the surface with the target's triangles.

    Raises:
        OmtwarpError: the target has no triangles.
    """
    from omtwarp.mesh.write import write_mesh

    grid = resampling.target.grid
    if grid.faces is None:
        raise OmtwarpError(f"{target} has no triangles that a surface could have: give --data, or another target")
    write_mesh(output, resampling.surface(), grid.own_triangles, like=like, structure=structure)


def _write(output: Path, resampling: Resampling, given: VertexData, as_labels: bool) -> None:
    """Carry the data over and write them."""
    import numpy as np

    from omtwarp.mesh.data import write_data

    if as_labels:
        values: NDArray[np.generic] = np.stack([resampling.labels(column) for column in given.values.T], axis=1)
    else:
        values = resampling.apply(given.values)
    moved = replace(given, values=np.asarray(values).reshape(len(values), -1))
    grid = resampling.target.grid
    shown = resampling.target.vertices if resampling.target.vertices is not None else grid.points
    write_data(output, moved, None if grid.faces is None else (shown[: grid.own_points], grid.own_triangles))


def _record(resampling: Resampling, output: Path, given: VertexData | None) -> dict[str, object]:
    source, target, (rows, columns) = resampling.source.grid, resampling.target.grid, resampling.matrix.shape
    record: dict[str, object] = {"output": str(output), "method": str(resampling.method)}
    record |= {"source": source.name, "target": target.name, "shape": list(target.shape)}
    record["empty"] = int(resampling.empty.sum())
    record["matrix"] = {"rows": rows, "columns": columns, "entries": int(resampling.matrix.nnz)}
    return record if given is None else record | {"columns": list(given.names), "structure": given.structure}
