"""Meshes with texture coordinates and materials on the command line, together with their maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from omtwarp.commands._options import Printing, Source
from omtwarp.commands._streams import say
from omtwarp.commands._work import make_map, require_bijective, require_whole, say_made, start_device
from omtwarp.errors import OmtwarpError
from omtwarp.options import Domain, MapOptions

if TYPE_CHECKING:
    from omtwarp.maps.result import MapResult
    from omtwarp.maps.torus_map import TorusMap
    from omtwarp.mesh.surface import Surface
    from omtwarp.texturing import PaintedMesh


def read_sound_painted(path: Path, repair: bool) -> tuple[PaintedMesh, Surface]:
    """Read a mesh with its coordinates and materials, and make sure that it can be mapped.

    Raises:
        OmtwarpError: the file cannot be read, or its mesh cannot be mapped.
    """
    from omtwarp.mesh.surface import Surface
    from omtwarp.mesh.validate import require_valid
    from omtwarp.texturing import read_painted_mesh

    mesh = read_painted_mesh(path)
    notes, origins = list(mesh.notes), None
    if repair:
        from omtwarp.mesh.repair import repair as repair_mesh

        repaired = repair_mesh(mesh.vertices, mesh.faces)
        if repaired.actions:
            origins = dataclasses.replace(repaired.origins, given=len(mesh.vertices))
            mesh = mesh.on(repaired.vertices, repaired.faces, repaired.face_origin)
            notes += repaired.actions
    for note in notes:
        say(f"{path}: {note}")
    surface = Surface(*require_valid(mesh.vertices, mesh.faces, str(path)))
    surface.checked, surface.origins = True, origins
    return mesh, surface


def with_objects(path: Path | None, result: MapResult | TorusMap) -> PaintedMesh:
    """Return the surface of a map as a plain mesh, with the names of objects in the file that it is from.

    Faces that the file has not get its first name.

    Args:
        path: the file; one that is no OBJ has no names.
        result: the map that was made of it.
    """
    import numpy as np

    from omtwarp.texturing import PaintedMesh
    from omtwarp.texturing.read import read_objects

    mesh = PaintedMesh(result.vertices, result.faces)
    names, numbers = ((), None) if path is None else read_objects(path)
    if numbers is None:
        return mesh
    origin = np.arange(len(result.faces)) if result.origins is None else result.origins.face_origin
    return dataclasses.replace(mesh, objects=names, face_object=np.where(origin < 0, 0, numbers[origin]))


def painted_map(
    path: Path, source: Source, mapping: MapOptions, printing: Printing
) -> tuple[PaintedMesh, MapResult | TorusMap]:
    """Return a mesh with its materials and its map, which is read where it is finished and computed otherwise.

    Raises:
        OmtwarpError: the mesh or the map cannot be used, or the map is of another mesh.
    """

    if source.finished is None:
        mesh, surface = read_sound_painted(path, source.repair)
        return mesh, _mapped(surface, path, mapping, printing)
    from omtwarp.maps.torus_map import read_map
    from omtwarp.texturing import read_painted_mesh

    result = read_map(source.finished)
    require_bijective(result, source.finished)
    mesh = read_painted_mesh(path)
    if source.repair and len(mesh.faces) != len(result.faces):
        mesh, _ = read_sound_painted(path, source.repair)
    try:
        mesh.on(result.vertices, result.faces)
    except OmtwarpError as error:
        raise OmtwarpError(f"{source.finished} and {path}: {error}") from None
    return mesh, result


def painted_maps(
    files: Sequence[tuple[Path, Path | None]], *, repair: bool, device: str, printing: Printing
) -> list[tuple[PaintedMesh, MapResult]]:
    """Return meshes with their materials and maps of the whole sphere; all are read before the first is mapped.

    Args:
        files: of meshes, each with that of its finished map, or None for one that is computed.
        repair: whether to repair meshes first.
        device: where kernels run.
        printing: what is said about new maps.

    Raises:
        OmtwarpError: a mesh or a map cannot be used, a map is of another mesh, or does not cover the sphere.
    """
    known, sound, mapping = {}, {}, MapOptions(device=device)
    for number, (path, of_map) in enumerate(files):
        if of_map is None:
            sound[number] = read_sound_painted(path, repair)
        else:
            mesh, result = painted_map(path, Source(finished=of_map, repair=repair), mapping, printing)
            known[number] = mesh, require_whole(result, of_map)
    for number, (mesh, surface) in sound.items():
        known[number] = mesh, _mapped(surface, files[number][0], mapping, printing)
    return [known[number] for number in range(len(files))]


def standing(
    result: MapResult | TorusMap, source: Path | None, up: str | None, front: str | None
) -> MapResult | TorusMap:
    """Turn a map so that pictures on its sphere stand upright on the surface, with their middle in front.

    The sphere is turned as near as it can be to the directions that points have from the surface's centre, with the
    upward axis at the north pole, where the upper border of a picture is, and the front axis at longitude 0.

    Args:
        result: a map; one that is not to a single whole sphere is returned as it is.
        source: the file of the mesh, or of the map: this keeps its poles, which may be aligned, unless axes are given.
        up: the axis upwards, guessed from the shape by default.
        front: the axis towards the viewer, guessed in the same way.

    Raises:
        OmtwarpError: an axis has another name, the two are parallel, or axes are given for another domain.
    """
    import numpy as np

    from omtwarp.geometry.axes import rotation_onto_axes
    from omtwarp.maps.result import MapResult
    from omtwarp.mesh.surface import Surface
    from omtwarp.render.camera import Camera, camera_axes
    from omtwarp.render.scene import SurfaceView
    from omtwarp.render.upright import posed

    given = up is not None or front is not None
    if source is not None and source.suffix.lower() == ".npz" and not given:
        return result
    if not isinstance(result, MapResult) or result.domain != Domain.SPHERE or result.part is not None:
        if given:
            raise OmtwarpError("--up and --front are for maps of one surface to the whole sphere: leave them out")
        return result
    pose = posed(SurfaceView(result.vertices, result.faces), up, front)
    right, above, ahead = camera_axes(Camera(azimuth=0.0, elevation=0.0), pose.up or "y", pose.front).T
    surface = Surface(result.vertices, result.faces)
    turn, certain = rotation_onto_axes(surface, result.sphere, np.stack([ahead, right, above]))
    return result.turned(turn.T) if certain else result


def _mapped(surface: Surface, path: Path, mapping: MapOptions, printing: Printing) -> MapResult:
    """Map the surface of a file, and say how well."""
    start_device(mapping.device)
    made = cast("MapResult", make_map(surface, mapping, quiet=printing.quiet))
    require_bijective(made)
    say_made(made, path, printing)
    return made
