"""The transport cost of a map, equation 6."""

from __future__ import annotations

from numpy.typing import ArrayLike

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import choose
from omtwarp.mesh.checks import MeshLike, as_sphere, as_surface
from omtwarp.options import Cost
from omtwarp.transport.cost_kernels import centre_distance


def transport_cost(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    start: ArrayLike | wp.array,
    cost: str = Cost.SQUARED,
    device: str | None = "auto",
) -> float:
    """Measure the transport cost M(g), equation 6: the sum of area times Φ(x, g(x)) over the triangles.

    The total area is 4π; distances are in radians, from centre to centre.

    Centres of triangles replace the paper's dual vertices; a mesh has twice as many of them as vertices, and large
    triangles count where they are.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes; its areas are the masses.
        sphere: the images g(x), unit vectors, shape [V, 3]; or a Warp array of vec3d.
        start: the points x, in the same way (the conformal or substitute start).
        cost: ``squared`` or ``geodesic`` distance.
        device: where distances are taken.

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
    where = resolve_device(device)
    distance = wp.empty(surface.face_count, dtype=wp.float64, device=where)
    points = [vectors(as_sphere(array, surface), where) for array in (start, sphere)]
    inputs = [*points, surface.on(where).faces]
    wp.launch(centre_distance, dim=surface.face_count, inputs=inputs, outputs=[distance], device=where)
    moved = distance.numpy()
    return float((surface.face_areas * (moved * moved if cost == "squared" else moved)).sum())
