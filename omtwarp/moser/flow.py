"""Moser's flow (section 4.2): a mass-preserving map from the density μ to the uniform sphere, or to another density."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import sums_for
from omtwarp.device.threads import Arguments, blas_threads, launch_parts
from omtwarp.measures import TargetDensity
from omtwarp.mesh.checks import MeshLike, as_sphere, as_surface
from omtwarp.mesh.surface import SPHERE_AREA
from omtwarp.moser.kernels import face_areas, integrate_particles, sources_and_density, target_masses, vertex_field
from omtwarp.options import Progress, Record
from omtwarp.solvers.poisson import PoissonSolver, cotangent_solver, solve_arrays


@dataclass(frozen=True)
class MoserMap:
    """The map g of section 4.2.

    Attributes:
        sphere: the image of every vertex, unit vectors, float64, shape [V, 3].
        potential: Θ at the vertices, shape [V].
        steps: the largest number of Runge-Kutta steps of a particle.
        history: empty: every particle takes steps of its own.
        converged: True: every particle ends at t = 1.
    """

    sphere: NDArray[np.float64]
    potential: NDArray[np.float64]
    steps: int
    history: tuple[Record, ...] = ()
    converged: bool = True


@blas_threads(1)
def moser_map(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    target: TargetDensity | None = None,
    solver: PoissonSolver | None = None,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> MoserMap:
    """Carry a map to the sphere to a mass-preserving one along Moser's flow.

    Solves ΔΘ = ρ - μ on the image ``sphere`` and moves every vertex along u_t = -∇Θ / ((1 - t) μ + t ρ), t from 0 to 1.
    The paper's ρ is 1: with the surface's own areas as masses the map then preserves area.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes; its
            :attr:`~omtwarp.Surface.face_areas`, of total 4π, are the masses.
        sphere: a map to the sphere without flips, unit vectors, float64, shape [V, 3]; or a Warp array of vec3d.
        target: the density ρ that the image is to have; uniform where not given. It is taken at the vertices of
            ``sphere`` and as linear between them.
        solver: the factorised cotangent Laplacian of the image, made here when left out. For a conformal image the
            surface's own can serve and saves a factorisation, but around the pole a discrete conformal map is not
            conformal: the area error it leaves is three to four times as large, and does not vanish on fine meshes.
        device: where the particles move.
        progress: called as ``progress("moser", done, 4, details)`` before, with the linear system factorised, with it
            solved, and after.

    Returns:
        The map at t = 1, which preserves area up to the discretisation of Θ and can flip triangles where μ is steep.

    Raises:
        OmtwarpError: the surface cannot be mapped, or the start is no map of it to the sphere.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> start = omtwarp.conformal_map(surface, device="cpu").sphere
        >>> initial = omtwarp.moser_map(surface, start, device="cpu").sphere
        >>> before, after = (omtwarp.distortion(surface, m, device="cpu").area["mean"] for m in (start, initial))
        >>> after - 2 < 0.2 * (before - 2)
        True
    """
    courant = 0.5  # of a triangle's size: a particle moves by at most this in a step
    parts = 4  # of the work in progress reports: half is the factorisation
    surface = as_surface(surface)
    where = resolve_device(device)
    if progress is not None:
        progress("moser", 0, parts, {})
    vertices, triangles = surface.vertex_count, surface.face_count
    points = vectors(as_sphere(sphere, surface), where)
    mesh = surface.on(where)
    faces, rows = mesh.faces, mesh.vertex_corners
    if solver is None:
        solver = cotangent_solver(surface, points)
    if progress is not None:
        progress("moser", 2, parts, {})
    areas = wp.empty(triangles, dtype=wp.float64, device=where)
    total = wp.empty(1, dtype=wp.float64, device=where)
    sources, mu, excess = (wp.empty(vertices, dtype=wp.float64, device=where) for _ in range(3))
    wp.launch(face_areas, dim=triangles, inputs=[points, faces], outputs=[areas], device=where)
    sums_for(where).total(areas, total)
    wanted, wanted_total = areas, total
    if target is not None:
        wanted, wanted_total = wp.empty_like(areas), wp.empty_like(total)
        at_vertices = wp.array(target.at(points.numpy()), dtype=wp.float64, device=where)
        wp.launch(target_masses, dim=triangles, inputs=[areas, faces, at_vertices], outputs=[wanted], device=where)
        sums_for(where).total(wanted, wanted_total)
    inputs = [areas, total, wanted, wanted_total, wp.float64(SPHERE_AREA), mesh.vertex_areas, *rows]
    wp.launch(sources_and_density, dim=vertices, inputs=inputs, outputs=[sources, mu, excess], device=where)
    (potential,) = solve_arrays(solver, [sources])
    if progress is not None:
        progress("moser", 3, parts, {})

    field = wp.empty(vertices, dtype=wp.vec3d, device=where)
    sizes = wp.empty(vertices, dtype=wp.float64, device=where)

    def field_arguments(part: slice) -> Arguments:
        return [points, faces, potential, *rows, part.start], [field, sizes]

    launch_parts(vertex_field, vertices, field_arguments, where)
    moved = wp.empty_like(points)
    steps = wp.empty(vertices, dtype=wp.int32, device=where)
    # In s = -log(1 - t) the remaining motion falls as e^-s: at s = 14 it is 1e-6 of ∇Θ.
    # Largest step, at the start; it grows with s
    limits = [wp.float64(0.25), wp.float64(courant), wp.float64(14.0)]

    def arguments(part: slice) -> Arguments:
        own = [points[part], rows[0][part]]
        shared = [points, faces, mesh.face_neighbours, field, mu, excess, sizes, rows[1]]
        return [*own, *shared, *limits], [moved[part], steps[part]]

    launch_parts(integrate_particles, vertices, arguments, where)
    longest = int(steps.numpy().max())
    if progress is not None:
        progress("moser", parts, parts, {"steps": longest})
    return MoserMap(moved.numpy(), potential.numpy(), longest)
