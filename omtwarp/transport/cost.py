"""The transport cost of a map, equation 6, and the area error of a moving one, which shows whether a fall is real."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.start import wp
from omtwarp.errors import choose
from omtwarp.mesh.arrays import Floats, cross, norms
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_sphere, as_surface, triangle_areas
from omtwarp.options import Cost, CostLike


def transport_cost(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    start: ArrayLike | wp.array,
    cost: CostLike = Cost.SQUARED,
    device: str | None = "auto",
) -> float:
    """Measure the transport cost M(g), equation 6: the sum of mass times Φ(x, g(x)) over the vertices.

    A vertex's mass is a third of the area of the triangles around it, 4π in all; distances are in radians. Reports,
    the optimal map and the bound on the cost sum in the same way.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes; its areas are the masses.
        sphere: the images g(x), unit vectors, shape [V, 3]; or a Warp array of vec3d.
        start: the points x, in the same way.
        cost: ``squared`` or ``geodesic`` distance.
        device: not used, as every measure of a map takes it.

    Returns:
        The cost, in area times radians (``geodesic``) or squared radians (``squared``).

    Raises:
        OmtwarpError: the mesh, a map or the cost cannot be used.

    Example:
        >>> import numpy as np, omtwarp
        >>> surface = omtwarp.shapes.icosphere(8)
        >>> start = surface.vertices
        >>> omtwarp.transport_cost(surface, start, start=start, device="cpu")  # nothing moves
        0.0
        >>> turned = start @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> omtwarp.transport_cost(surface, turned, start=start, device="cpu") > 0.0
        True
    """
    surface, cost = as_surface(surface), choose(Cost, cost)
    x, y = (as_sphere(array.numpy() if isinstance(array, wp.array) else array, surface) for array in (start, sphere))
    moved = np.arctan2(norms(cross(x, y)), np.einsum("vi,vi->v", x, y))
    return float(surface.vertex_areas @ (moved * moved if cost == "squared" else moved))


# A triangle's area error D + 1/D - 2 counts at most this much, so that a few degenerate triangles do not decide.
LARGEST_ERROR = 0.1


def area_loss(surface: Surface, sphere: Floats) -> float:
    """Measure the mean of D + 1/D - 2 weighted by original area, each triangle counting at most LARGEST_ERROR.

    Where a mesh is too coarse for a motion, its vertices can shorten their paths by losing area, and the cost falls
    below that of any mass-preserving map. A falling cost is meaningful only if this does not grow.

    Args:
        surface: F faces, whose areas are those wanted.
        sphere: a map, shape [V, 3]; D is the area of a flat image over its own.
    """
    # Least ratio, of areas: its reciprocal, and that times an area, stay finite
    ratio = np.maximum(triangle_areas(sphere, surface.faces) / surface.face_areas, 1e-150)
    return float(surface.face_areas @ np.minimum(ratio + 1.0 / ratio - 2.0, LARGEST_ERROR)) / SPHERE_AREA
