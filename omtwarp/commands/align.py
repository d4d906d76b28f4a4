"""``omtwarp align``: rotation of a map's sphere to that of another, or to its shape's own axes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from omtwarp.commands._options import Printing
from omtwarp.commands._streams import input_file, progress_bar, steps, warnings_as_lines
from omtwarp.commands._work import Pair, show_facts
from omtwarp.options import AlignBy


def run(
    *,
    pair: Pair,
    to: Annotated[str, typer.Option(metavar="axes|FILE|GRID", callback=input_file)] = "axes",
    by: AlignBy = AlignBy.AUTO,
    mirror: bool = False,
    degree: Annotated[int, typer.Option(min=1, max=64)] = 16,
    printing: Printing,
) -> None:
    """Rotate a map's sphere by its shape's own axes, or to another map.

    By axes, the longest axis of the first-order ellipsoid points to longitude 0, the shortest to the north pole. To
    another map, features are correlated over all rotations: distance from the centre of the surface, area over area on
    the sphere, or those given.

    Examples:
        omtwarp align left.npz --to right.npz -o aligned.npz
        omtwarp align lh.npz --to axes -o lh.sphere.surf.gii --radius 100

    Options:
        to: The shape's own axes, another map or sphere (- is standard input), or a grid such as fsaverage5.
        by: What to compare; vertices needs equal faces; auto takes it for two maps of one surface.
        mirror: Also try the mirror image, and take it if it fits better.
        degree: Highest degree of the spherical harmonics.
    """
    import numpy as np
    from scipy.spatial.transform import Rotation

    from omtwarp.alignment import align
    from omtwarp.resampling import as_points, file_points
    from omtwarp.spheres import is_named

    other = None if to == "axes" or is_named(to) else Path(to)
    pair.check(other)
    with progress_bar(printing.quiet, printing.verbose) as progress:
        notify = steps(progress, "align", 3)
        moving = file_points(pair.source, pair.surface)
        fixed = "axes" if to == "axes" else as_points(to) if other is None else file_points(other, pair.to_surface)
        notify(1)
        mine, others = pair.features(other)
        with warnings_as_lines():
            alignment = align(moving, fixed, features=mine, to_features=others, by=by, mirror=mirror, degree=degree)
        notify(2)
        faces = moving.grid.own_triangles[:, ::-1] if alignment.mirrored else moving.grid.own_triangles
        pair.write(alignment.turned, alignment.sphere, faces)
        notify(3)
    turn = alignment.rotation if not alignment.mirrored else alignment.rotation @ np.diag([-1.0, 1.0, 1.0])
    degrees = np.degrees(Rotation.from_matrix(turn).magnitude())
    margin = f", {alignment.margin:.3f} above the next best" if np.isfinite(alignment.margin) else ""
    line = f"{pair.output}: turned by {degrees:.3f} degrees{', mirrored' * alignment.mirrored}; by {alignment.method} "
    line += f"({alignment.basis}), score {alignment.score:.6f}{margin}"
    show_facts({"output": str(pair.output), **alignment.to_dict()}, line, printing)
