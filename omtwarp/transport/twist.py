"""Turns of a map against the optimal one, and steps that take them out.

The cost hardly depends on how far a limb is turned about its axis where the conformal map shrinks it, and with areas
kept a turned limb is a minimum of its own: the triangles around its foot hold it. But the optimal map turns nothing,
however small: up to a factor across the way, its derivative is symmetric (section 2.3). The angle of the rotation that
is left, triangle by triangle, is the curl of the map relative to its size, and a velocity along a stream function takes
it out. The flow of Angenent, Haker and Tannenbaum (2003), which takes the curl of the displacements, would need many
steps where the conformal map is small.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import empty
from omtwarp.device.start import wp
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.solvers.poisson import SurfaceLaplacianSolver
from omtwarp.transport.polish_kernels import move_by_potentials
from omtwarp.transport.twist_kernels import triangle_turns, turns_at_vertices


@dataclass(frozen=True)
class Turns:
    """Angles that a map turns triangles by against the optimal map.

    Attributes:
        angles: in radians, counter-clockwise seen from outside, float64, shape [F].
        rms: their root mean square, weighted by the areas of triangles on the surface.
    """

    angles: wp.array
    rms: float


def turns(surface: Surface, points: wp.array, start: wp.array) -> Turns:
    """Measure by how much a map turns every triangle of a surface.

    Args:
        surface: V vertices and F faces.
        points: the map, vec3d, shape [V], on a device.
        start: the points that are transported, vec3d, shape [V], on the same device; triangles flipped there count as
            not turned.
    """
    angles = empty(surface.face_count, wp.float64, points.device)
    inputs = [start, points, surface.on(points.device).faces]
    wp.launch(triangle_turns, dim=surface.face_count, inputs=inputs, outputs=[angles], device=points.device)
    squares = surface.face_areas @ angles.numpy() ** 2
    return Turns(angles, float(np.sqrt(squares / SPHERE_AREA)))


def turned_back(surface: Surface, points: wp.array, found: Turns) -> NDArray[np.float64]:
    """Move a map along the stream function that takes its turns out; triangles may flip.

    Args:
        surface, points: as of :func:`turns`.
        found: the turns of this map.

    Returns:
        Unit vectors, shape [V, 3].

    Raises:
        OmtwarpError: the cotangent Laplacian of the map is singular.
    """
    device, count, mesh = points.device, surface.vertex_count, surface.on(points.device)
    source, moved = empty(count, wp.float64, device), empty(count, wp.vec3d, device)
    rows = mesh.vertex_corners
    inputs = [points, mesh.faces, found.angles, *rows]
    wp.launch(turns_at_vertices, dim=count, inputs=inputs, outputs=[source], device=device)
    (stream,) = SurfaceLaplacianSolver(surface, points, device=device).solve_arrays([source])
    # A full step along the stream function, and none along a potential of areas: the second stands in for it.
    inputs = [points, mesh.faces, stream, stream, *rows, wp.float64(1.0), wp.float64(0.0), 0]
    wp.launch(move_by_potentials, dim=count, inputs=inputs, outputs=[moved], device=device)
    return moved.numpy()
