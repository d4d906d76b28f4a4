"""Checks of surfaces and maps that public functions take, in every accepted form."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import ROUND_OFF, Floats, Ints, real_numbers, require_unit_length, whole_numbers
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import MeshLike, mesh_arrays, require_valid


def as_surface(mesh: MeshLike) -> Surface:
    """Convert a mesh in any of the accepted forms to a surface, and make sure that it can be mapped.

    A :class:`Surface` is returned itself, and is examined the first time only.

    Args:
        mesh: a ``trimesh.Trimesh``, ``(vertices, faces)``, a :class:`Surface`, or anything else that has ``vertices``
            and ``faces``.

    Raises:
        OmtwarpError: the value is no mesh, or the mesh cannot be mapped.
    """
    if isinstance(mesh, Surface):
        if not mesh.checked:
            require_valid(mesh.vertices, mesh.faces)
            mesh.checked = True
        return mesh
    surface = Surface(*require_valid(*mesh_arrays(mesh)))
    surface.checked = True
    return surface


def as_triangles(mesh: MeshLike) -> tuple[Floats, Ints]:
    """Return the vertices and faces of a mesh in any of the accepted forms, whether it can be mapped or not.

    Args:
        mesh: as of :func:`as_surface`.

    Returns:
        Finite vertices, float64, shape [V, 3], and faces among them, int32, shape [F, 3].

    Raises:
        OmtwarpError: the value is no mesh.
    """
    vertices, faces = mesh_arrays(mesh)
    positions = real_numbers(vertices, "vertices", (None, 3))
    return positions, as_faces(faces, len(positions))


def as_sphere(sphere: ArrayLike | wp.array, surface: Surface, name: str = "map") -> Floats | wp.array:
    """Check that the images of a surface's vertices lie on the unit sphere, and normalise them to round-off.

    Args:
        sphere: shape [V, 3]; a Warp array of vec3d, which only stages of the package make, is taken as it is.
        surface: the surface, V vertices.
        name: what to call the map in a message.

    Returns:
        float64, shape [V, 3]: the array given where it holds unit vectors to round-off, normalised otherwise.

    Raises:
        OmtwarpError: another shape, coordinates that are not finite, or points off the unit sphere.
    """
    if isinstance(sphere, wp.array):
        if sphere.shape != (surface.vertex_count,):
            raise OmtwarpError(f"the {name} has {sphere.shape} points: the surface has {surface.vertex_count} vertices")
        return sphere
    return as_unit_vectors(sphere, surface.vertex_count, name)


def as_unit_vectors(points: ArrayLike, count: int | None = None, name: str = "map") -> Floats:
    """Check that points lie on the unit sphere, and normalise them to round-off.

    Args:
        points: shape [N, 3].
        count: how many there must be; any number where left out.
        name: what to call them in a message.

    Returns:
        float64, shape [N, 3]: the array given where it holds unit vectors to round-off, normalised otherwise.

    Raises:
        OmtwarpError: another shape or type, coordinates that are not finite, or points off the unit sphere.
    """
    given = real_numbers(points, f"the {name}", (count, 3))
    require_unit_length(given, f"the {name}")
    lengths = np.linalg.norm(given, axis=1)
    if np.abs(lengths - 1.0).max(initial=0.0) > ROUND_OFF:
        given = given / lengths[:, None]
    return given


def as_faces(faces: ArrayLike, count: int) -> Ints:
    """Check triangles whose corners are among a number of vertices.

    Args:
        faces: shape [F, 3], at least one.
        count: how many vertices there are.

    Raises:
        OmtwarpError: the faces are empty or of another shape or type, or a corner is out of range.
    """
    corners = whole_numbers(faces, "faces", (None, 3), below=count)
    if len(corners) == 0:
        raise OmtwarpError("faces: there are none")
    return corners.astype(np.int32)
