"""Turns of a map against the optimal one, and the motion that takes them out.

Where the points x have shrunk a limb, the cost hardly depends on how far the map turns it about its axis, and with
areas kept a turned limb is nearly a minimum of its own: the triangles around its foot hold it. But the optimal map
turns nothing, however small: up to a factor across the way, its derivative is symmetric (section 2.3). The angle of the
rotation that is left in every triangle is measured in proportion to the triangle. Twice this angle is the curl of the
velocity that turns everything back in unit time, and its stream function follows from a Poisson equation. The flow of
Angenent, Haker and Tannenbaum (2003), which takes the curl of the displacements out, would need many steps where x is
small.
"""

from __future__ import annotations

import numpy as np

from omtwarp.device.arrays import empty, vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.device.threads import FIRST_THREAD, Each, computed, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.spherical import corners_of, first_tangent
from omtwarp.mesh.arrays import Floats, cross, normalised
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.moser import vertex_field
from omtwarp.solvers.poisson import cotangent_solver
from omtwarp.untangling.untangle import RepairBudget, untangled

wp.set_module_options(KERNEL_OPTIONS)

# Radians: triangles that moved by less have no direction of their own, and need none, as d / sin d is 1.
SHORTEST = wp.constant(wp.float64(1e-8))
LEAST_TURNED = 0.1  # share of the turns that a motion has to take out for another to follow


@wp.kernel
def triangle_turns(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    turns: wp.array[wp.float64],
):
    """Compute the angle that every triangle is turned by against the optimal map; 0 where x is flipped.

    In frames along and across the geodesic from x to y, diag(1, d / sin d) times the derivative of the optimal map is
    the second derivative of a potential at x, symmetric and positive. The angle is that of the rotation in the polar
    decomposition of this product, which does not depend on the size of the triangle at x.
    """
    t = wp.tid()
    x0, x1, x2 = corners_of(start, faces[t])
    y0, y1, y2 = corners_of(points, faces[t])
    x, y = wp.normalize(x0 + x1 + x2), wp.normalize(y0 + y1 + y2)
    normal = wp.cross(x, y)
    sine = wp.length(normal)
    across = first_tangent(x)
    stretch = ONE
    if sine > SHORTEST:
        across = normal / sine
        stretch = wp.atan2(sine, wp.dot(x, y)) / sine
    along_x, along_y = wp.cross(across, x), wp.cross(across, y)
    p, q, r, s = wp.dot(along_x, x1 - x0), wp.dot(along_x, x2 - x0), wp.dot(across, x1 - x0), wp.dot(across, x2 - x0)
    a, b, c, d = wp.dot(along_y, y1 - y0), wp.dot(along_y, y2 - y0), wp.dot(across, y1 - y0), wp.dot(across, y2 - y0)
    turns[t] = ZERO
    if p * s - q * r > ZERO:  # which the product is multiplied by
        turns[t] = wp.atan2(stretch * (c * s - d * r) - (b * p - a * q), a * s - b * r + stretch * (d * p - c * q))


def turned_back(surface: Surface, sphere: Floats, start: Floats, *, device: str | None = "auto") -> Floats:
    """Return a map without the turns of limbs that it has against the optimal map, as far as they can be taken out.

    The repairs of all motions may take the work of one.

    Args:
        surface: closed, V vertices.
        sphere: a map without flips, unit vectors, shape [V, 3].
        start: the points x, shape [V, 3]; triangles may be flipped there.
        device: where the kernels run.
    """
    turns, budget = turns_against(surface, sphere, start, device=device), RepairBudget(surface)
    before = size(surface, turns)
    while True:
        try:
            moved = untangled(surface, _moved_back(surface, sphere, turns, device), budget=budget, device=device)
        except OmtwarpError:  # the motion flips more than can be repaired
            return sphere
        turns = turns_against(surface, moved, start, device=device)
        after = size(surface, turns)
        if not after < (1.0 - LEAST_TURNED) * before:
            return sphere
        sphere, before = moved, after


def turns_against(surface: Surface, sphere: Floats, start: Floats, *, device: str | None = "auto") -> Floats:
    """Return the angles that a map turns triangles by against the optimal one, counter-clockwise, radians, shape [F].

    Arguments are as of :func:`turned_back`.
    """
    where = resolve_device(device)
    inputs = [vectors(start, where), vectors(sphere, where), Each(surface.on(where).faces)]
    return np.array(computed(triangle_turns, inputs, empty(surface.face_count, wp.float64, where)).numpy())


def size(surface: Surface, turns: Floats) -> float:
    """Return the root mean square of turns, weighted by the areas of triangles on the surface."""
    return float(np.sqrt(surface.face_areas @ turns**2 / SPHERE_AREA))


def _moved_back(surface: Surface, sphere: Floats, turns: Floats, device: str | None) -> Floats:
    """Move a map along the stream function that takes its turns out; triangles may flip."""
    where, solver = resolve_device(device), cotangent_solver(surface, sphere)
    mesh = surface.on(where)
    source = 2.0 / 3.0 * surface.sum_to_vertices(turns * triangle_areas(sphere, surface.faces))
    stream = wp.array(solver.solve(source), dtype=wp.float64, device=where)
    downhill, sizes = empty(surface.vertex_count, wp.vec3d, where), empty(surface.vertex_count, wp.float64, where)
    inputs = [vectors(sphere, where), mesh.faces, stream, *mesh.vertex_corners, FIRST_THREAD]
    launch_parts(vertex_field, surface.vertex_count, inputs, [downhill, sizes], where)
    return normalised(sphere - cross(sphere, downhill.numpy()))
