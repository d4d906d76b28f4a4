"""The transport cost of a map, equation 6, and the area error of a moving one, which shows whether a fall is real."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, TWO, wp
from omtwarp.device.sums import RowSums
from omtwarp.errors import choose
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_sphere, as_surface
from omtwarp.options import Cost

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def centre(points: wp.array[wp.vec3d], face: wp.vec3i):
    return wp.normalize(points[face[0]] + points[face[1]] + points[face[2]])


@wp.func
def area_error(points: wp.array[wp.vec3d], face: wp.vec3i, area: wp.float64, largest: wp.float64):
    """Return area times D + 1/D - 2 of a triangle, D the area of its flat image over its own, at most ``largest``."""
    p0 = points[face[0]]
    image = HALF * wp.length(wp.cross(points[face[1]] - p0, points[face[2]] - p0))
    # Least ratio, of areas: its reciprocal, and that times an area, stay finite
    ratio = wp.max(image / area, wp.float64(1e-150))
    return area * wp.min(ratio + ONE / ratio - TWO, largest)


@wp.kernel
def capped_area_error(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    areas: wp.array[wp.float64],
    largest: wp.float64,
    # Data out:
    error: wp.array2d[wp.float64],
):
    f = wp.tid()
    error[f, 0] = area_error(points, faces[f], areas[f], largest)


def transport_cost(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    start: ArrayLike | wp.array,
    cost: str = Cost.SQUARED,
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
    moved = np.arctan2(np.linalg.norm(np.cross(x, y), axis=1), np.einsum("vi,vi->v", x, y))
    return float(surface.vertex_areas @ (moved * moved if cost == "squared" else moved))


# A triangle's area error D + 1/D - 2 counts at most this much, so that a few degenerate triangles do not decide.
LARGEST_ERROR = 0.1


class AreaMonitor:
    """Measures the area error of a moving map on the device.

    Where a mesh is too coarse for a motion, its vertices can shorten their paths by losing area, and the cost falls
    below that of any mass-preserving map. A falling cost is meaningful only if the area error does not grow.
    """

    def __init__(self, surface: Surface, device: wp.Device):
        self.device = device
        mesh = surface.on(device)
        self._faces, self._areas = mesh.faces, mesh.face_areas
        self._errors = wp.empty((surface.face_count, 1), dtype=wp.float64, device=device)
        self._sums = RowSums(surface.face_count, 1, device)

    def error(self, points: wp.array) -> float:
        """Return the mean of D + 1/D - 2 weighted by original area, each triangle counting at most LARGEST_ERROR."""
        wp.launch(
            capped_area_error,
            dim=len(self._errors),
            inputs=[points, self._faces, self._areas, wp.float64(LARGEST_ERROR)],
            outputs=[self._errors],
            device=self.device,
        )
        return float(self._sums(self._errors).numpy().sum()) / SPHERE_AREA
