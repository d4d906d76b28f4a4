"""Mirror-symmetric maps of the double of a surface, half of which is a map of the surface to the hemisphere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.flips.rings import is_bijective
from omtwarp.mesh.surface import Surface
from omtwarp.topology.doubling import Double
from omtwarp.untangling.untangle import untangle

Floats = NDArray[np.float64]

ROUNDS = 4  # of repair after symmetrising; one was enough on every surface tried


def mirror_frame(double: Double, sphere: Floats, masses: Floats) -> Floats:
    """The rotation that brings a nearly symmetric map's plane of symmetry to the equator, the surface to the north.

    Among all planes it is the one whose reflection brings mirror images nearest to each other: the eigenvector of the
    least eigenvalue of sum m (y y'ᵀ + y' yᵀ) for pairs y, y'.

    Args:
        double: the surface and its copy.
        sphere: a map of it, unit vectors, shape [W, 3].
        masses: of the vertices, shape [W].

    Returns:
        A rotation matrix R, shape [3, 3]; ``sphere @ R`` is the turned map.
    """
    paired = (sphere * masses[:, None]).T @ sphere[double.mirror]
    _, vectors = np.linalg.eigh(paired + paired.T)
    surface = np.arange(len(sphere)) < double.mirror  # inside the surface, not in the copy
    north = vectors[:, 0]
    if (masses[surface] * (sphere[surface] @ north)).sum() < 0.0:
        north = -north
    east = vectors[:, 2]
    return np.stack([east, np.cross(north, east), north], axis=1)


def symmetrised(double: Double, turned: Floats) -> Floats:
    """A map made exactly symmetric about the equator: means of mirror images, the boundary with z = 0.

    Args:
        double: the surface and its copy.
        turned: a map whose plane of symmetry is nearly the equator's, shape [W, 3].
    """
    mirrored = turned[double.mirror] * np.array([1.0, 1.0, -1.0])
    # The sum of two numbers has the same bits in either order, so that mirror images agree exactly.
    means = turned + mirrored
    means[double.on_boundary, 2] = 0.0
    return means / np.linalg.norm(means, axis=1)[:, None]


def symmetric_map(
    double: Double,
    surface: Surface,
    sphere: Floats,
    improve: Callable[[Floats], Floats],
    *,
    device: str | None = "auto",
) -> Floats:
    """An exactly mirror-symmetric map without flips, from a nearly symmetric one.

    Args:
        double: the surface and its copy.
        surface: the same as a surface.
        sphere: a map of it that lies as :func:`mirror_frame` turns it, shape [W, 3].
        improve: what follows a repair: from a map that is one to one to a better one.
        device: where the repair runs.

    Raises:
        OmtwarpError: it is still not one to one after several repairs.
    """
    image = symmetrised(double, sphere)
    for number in range(ROUNDS):
        if is_bijective(image, surface.faces, device=device):
            return image
        mended = untangle(surface, image, device=device).sphere
        if number == 0 and is_bijective(mended, surface.faces, device=device):
            mended = improve(mended)
        image = symmetrised(double, mended @ mirror_frame(double, mended, surface.vertex_areas))
    if not is_bijective(image, surface.faces, device=device):
        raise OmtwarpError(
            "the map of the doubled surface is not one to one once it is symmetric: use a finer mesh, or fill the hole"
        )
    return image


__all__ = ["mirror_frame", "symmetric_map", "symmetrised"]
