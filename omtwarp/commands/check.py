"""``omtwarp check``: what is wrong with a mesh, and what would mend it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from omtwarp.commands._options import MeshArgument
from omtwarp.errors import OmtwarpError
from omtwarp.files import check_output

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from omtwarp.mesh.validate import Defect


def check_mesh(
    mesh: MeshArgument,
    repair: Annotated[
        bool, typer.Option("--repair", help="Repair the mesh; list what that does and what is left.")
    ] = False,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="Write the mended mesh (with --repair).")
    ] = None,
) -> None:
    """Tell what keeps a mesh from being mapped to the sphere; the exit status is 0 if nothing does."""
    from omtwarp.mesh.read import read_mesh
    from omtwarp.mesh.validate import check
    from omtwarp.mesh.write import SUFFIXES, write_mesh

    if output is not None and not repair:
        raise OmtwarpError("--output is for the mended mesh: it needs --repair")
    if output is not None:
        check_output(output, SUFFIXES, mesh)
    given = read_mesh(mesh, triangulate=repair)
    vertices, faces = given.vertices, given.faces
    print(f"{mesh}: {len(vertices)} vertices, {len(faces)} faces")
    for note in given.notes:
        print(f"  note: {note}")
    defects = check(vertices, faces)
    for defect in defects:
        print(f"  {defect.kind}: {defect}")
    if repair and defects:
        from omtwarp.mesh.repair import repair as mend

        mended = mend(vertices, faces)
        for action in mended.actions:
            print(f"  repair: {action}")
        vertices, faces = mended.vertices, mended.faces
        defects = check(vertices, faces)
        for defect in defects:
            print(f"  left: {defect}")
    for line in options_text(vertices, faces, defects):
        print(f"  option {line}")
    if output is not None:
        write_mesh(output, vertices, faces)
        print(f"{output}: {len(vertices)} vertices, {len(faces)} faces")
    if defects:
        count = len(defects)
        saved = f"; what could be mended was saved as '{output}'" if output is not None else ""
        left = " left" if repair else ""
        raise OmtwarpError(f"{mesh}: {count} kind{'s' * (count > 1)} of defect{left}, see above{saved}")
    print("  closed, manifold, oriented outward, one component, genus 0: it can be mapped")


def options_text(vertices: NDArray, faces: NDArray, defects: list[Defect]) -> list[str]:
    """List the options of ``omtwarp map`` for a mesh that is no sphere; none for other defects."""
    from omtwarp.topology.kind import MAPPABLE, options_for, parts_of

    if not defects or any(defect.kind not in MAPPABLE for defect in defects):
        return []
    try:
        return options_for(parts_of(vertices, faces))
    except OmtwarpError:  # a boundary that touches itself, which no option takes
        return []
