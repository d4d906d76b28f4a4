"""What a public function takes as a surface and as a map of it: every accepted form, checked in one place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import require_valid

# Points whose length differs from 1 by no more are taken as they are: a normalised float64 vector is within 4e-16.
UNIT_LENGTH = 1e-12


def as_surface(mesh: Any) -> Surface:
    """Take a mesh in any of the accepted forms, and make sure that it can be mapped.

    A :class:`Surface` is returned itself, and is examined the first time only.

    Args:
        mesh: a ``trimesh.Trimesh``, ``(vertices, faces)``, a :class:`Surface`, or anything else that has ``vertices``
            and ``faces``.

    Raises:
        OmtwarpError: it cannot be mapped, or it is no mesh.
    """
    if isinstance(mesh, Surface):
        if not mesh.checked:
            require_valid(mesh.vertices, mesh.faces)
            mesh.checked = True
        return mesh
    if isinstance(mesh, tuple | list) and len(mesh) == 2:
        vertices, faces = mesh
    elif hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        vertices, faces = mesh.vertices, mesh.faces
    else:
        raise OmtwarpError(f"expected a trimesh.Trimesh or (vertices, faces), got {type(mesh).__name__}")
    surface = Surface(*require_valid(vertices, faces))
    surface.checked = True
    return surface


def as_sphere(sphere: ArrayLike | wp.array, surface: Surface, name: str = "map") -> NDArray[np.float64] | wp.array:
    """Take the images of a surface's vertices on the sphere, and make sure that they are points of it.

    Args:
        sphere: shape [V, 3]; a Warp array of vec3d, which only stages of the package make, is taken as it is.
        surface: the surface, V vertices.
        name: what to call the map in a message.

    Returns:
        float64, shape [V, 3]: the array given where it holds unit vectors to round-off, normalised otherwise.

    Raises:
        OmtwarpError: another shape, coordinates that are not finite, or a point at the centre of the sphere.
    """
    if isinstance(sphere, wp.array):
        return sphere
    wanted = (surface.vertex_count, 3)
    try:
        points = np.ascontiguousarray(sphere, dtype=np.float64)
    except (TypeError, ValueError):
        raise OmtwarpError(f"the {name} is no array of numbers of shape {wanted}") from None
    if points.shape != wanted:
        raise OmtwarpError(f"the {name} has shape {points.shape}: the surface's is {wanted}, a point for every vertex")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise OmtwarpError(f"the {name} has {int((~finite).sum())} points that are not finite, first vertex {bad}")
    lengths = np.linalg.norm(points, axis=1)
    if not lengths.all():
        raise OmtwarpError(
            f"the {name} has a point at the centre of the sphere, first vertex {int(np.argmin(lengths))}"
        )
    if np.abs(lengths - 1.0).max(initial=0.0) > UNIT_LENGTH:
        points = points / lengths[:, None]
    return points


__all__ = ["as_sphere", "as_surface"]
