"""Moser's flow (section 4.2): a mass-preserving map from the density μ to the uniform sphere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import resolve_device, wp
from omtwarp.conformal import density
from omtwarp.linear import PoissonSolver, SurfaceLaplacianSolver
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.moser.kernels import integrate_particles, vertex_field
from omtwarp.threads import blas_threads, launch_parts

# In s = -log(1 - t) the remaining motion falls as e^-s: at s = 14 it is 1e-6 of ∇Θ.
FINAL_TIME = 14.0
LARGEST_STEP = 0.25  # at the start; it grows with s
COURANT = 1.0  # halving it changes the area distortion that the flow leaves on scans in the fifth digit


@dataclass(frozen=True)
class MoserMap:
    """The map g of section 4.2.

    Attributes:
        sphere: the image of every vertex, unit vectors, float64, shape [V, 3].
        potential: Θ at the vertices, shape [V].
        steps: Runge-Kutta steps of the particle that took most.
    """

    sphere: NDArray[np.float64]
    potential: NDArray[np.float64]
    steps: int


@blas_threads(1)
def moser_map(
    surface: Surface,
    start: NDArray[np.float64],
    *,
    solver: PoissonSolver | None = None,
    device: str | None = "auto",
) -> MoserMap:
    """Carry a map to the sphere to an area-preserving one along Moser's flow.

    Solves ΔΘ = 1 - μ on the image of ``start`` and moves every vertex along u_t = -∇Θ / ((1 - t) μ + t), t from 0 to 1.

    Args:
        surface: the surface; its areas, scaled to 4π, are the masses.
        start: a map to the sphere without flips, unit vectors, float64, shape [V, 3].
        solver: the factorised cotangent Laplacian of the image, made here when left out. For a conformal image the
            surface's own can serve and saves a factorisation, but around the pole a discrete conformal map is not
            conformal: the area error it leaves is three to four times as large, and does not vanish on fine meshes.
        device: where the particles move.

    Returns:
        The map at t = 1, which preserves area up to the discretisation of Θ and can flip triangles where μ is steep.
    """
    where = resolve_device(device)
    image = np.ascontiguousarray(start, dtype=np.float64)
    if solver is None:
        solver = SurfaceLaplacianSolver(surface, image, device=where)
    areas = triangle_areas(image, surface.faces)
    image_masses = surface.sum_to_vertices(areas * (SPHERE_AREA / areas.sum())) / 3.0
    potential = solver.solve(surface.vertex_areas - image_masses)
    _, mu = density(surface, image)

    offsets, corners = surface.vertex_corners
    points = wp.array(image, dtype=wp.vec3d, device=where)
    faces = wp.array(surface.faces, dtype=wp.vec3i, device=where)
    neighbours = wp.array(surface.face_neighbours, dtype=wp.vec3i, device=where)
    rows = [wp.array(offsets, dtype=wp.int32, device=where), wp.array(corners, dtype=wp.int32, device=where)]
    field = wp.empty(surface.vertex_count, dtype=wp.vec3d, device=where)
    wp.launch(
        vertex_field,
        dim=surface.vertex_count,
        inputs=[points, faces, wp.array(potential, dtype=wp.float64, device=where), *rows, field],
        device=where,
    )
    moved = wp.empty_like(points)
    steps = wp.empty(surface.vertex_count, dtype=wp.int32, device=where)
    finite_mu = wp.array(np.minimum(mu, 1e300), dtype=wp.float64, device=where)
    limits = [wp.float64(LARGEST_STEP), wp.float64(COURANT), wp.float64(FINAL_TIME)]

    def arguments(part: slice) -> tuple[list[Any], list[Any]]:
        own = [points[part], rows[0][part]]
        mesh = [points, faces, neighbours, field, finite_mu, rows[1]]
        return [*own, *mesh, *limits], [moved[part], steps[part]]

    launch_parts(integrate_particles, surface.vertex_count, arguments, where)
    return MoserMap(moved.numpy(), potential, int(steps.numpy().max()))
