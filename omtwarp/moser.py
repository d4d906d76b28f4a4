"""Section 4.2: Moser's flow, the initial mass-preserving map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import SLOW_LAUNCH, resolve_device, solving_with
from omtwarp.device.start import HALF, KERNEL_OPTIONS, LARGE, ONE, THREE, TWO, ZERO, wp
from omtwarp.device.threads import FIRST_THREAD, blas_threads, each, launch_parts
from omtwarp.errors import choose
from omtwarp.geometry.spherical import TINY
from omtwarp.location import walk
from omtwarp.measures import TargetDensity
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, as_sphere, as_surface, triangle_areas
from omtwarp.options import Progress, Record, Solver, SolverLike, tell
from omtwarp.solvers.poisson import EdgeLaplacianSolver, LaplacianSolver, cotangent_solver

wp.set_module_options(KERNEL_OPTIONS)

SHORTEST_STEP = wp.constant(wp.float64(1e-3))  # where slivers would need shorter ones: a path has 14 units of time
MAX_STEPS = wp.constant(20000)  # of a path: more than FINAL_TIME / SHORTEST_STEP, so that every path ends


@wp.func(inline=True)
def velocity_at(
    p: wp.vec3d,
    growth: wp.float64,
    start: int,
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    neighbours: wp.array[wp.vec3i],
    field: wp.array[wp.vec3d],
    numbers: wp.array[wp.vec3d],
):
    """Return dx/ds = -∇Θ / (μ + (e^s - 1) ρ), section 4.2 with s = -log(1 - t); growth is e^s - 1.

    Also return the size of triangles there, linear between the vertices, and the face.
    """
    f, w = walk(p, start, points, faces, neighbours)
    face = faces[f]
    v = w[0] * field[face[0]] + w[1] * field[face[1]] + w[2] * field[face[2]]
    here = w[0] * numbers[face[0]] + w[1] * numbers[face[1]] + w[2] * numbers[face[2]]  # μ, ρ - 1 and size
    v = (ONE / (here[0] + growth + growth * here[1])) * v
    return v - wp.dot(v, p) * p, here[2], f


@wp.kernel
def vertex_field(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    first: int,
    # Data out:
    field: wp.array[wp.vec3d],
    sizes: wp.array[wp.float64],
):
    """Compute -∇Θ at vertices: the angle-weighted mean of the gradients of the triangles around, tangent to the sphere.

    With angle weights a large triangle does not dominate a small one: the area error after the flow is a third of that
    with area weights on scanned shapes.
    """
    thread, _compiled_once = wp.tid()
    v = first + thread
    total = wp.vec3d()
    weight = wp.float64(0.0)
    size = wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        face = faces[corner // 3]
        p0, p1, p2 = points[face[0]], points[face[1]], points[face[2]]
        normal = wp.cross(p1 - p0, p2 - p0)  # its length is twice the area
        double_area = wp.length(normal)
        if double_area > ZERO:
            slope = potential[face[0]] * (p2 - p1) + potential[face[1]] * (p0 - p2) + potential[face[2]] * (p1 - p0)
            side = points[face[(corner + 1) % 3]] - points[v]
            other = points[face[(corner + 2) % 3]] - points[v]
            angle = wp.atan2(double_area, wp.dot(side, other))
            total += angle / double_area * wp.cross(normal / double_area, slope)
            weight += angle
            size += angle * wp.sqrt(double_area)
    sizes[v] = size / wp.max(weight, TINY)
    mean = total / wp.max(weight, TINY)
    field[v] = -(mean - wp.dot(mean, points[v]) * points[v])


@wp.kernel
def integrate_particles(
    particles: wp.array[wp.vec3d],
    first_corners: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    neighbours: wp.array[wp.vec3i],
    field: wp.array[wp.vec3d],
    numbers: wp.array[wp.vec3d],
    corners: wp.array[wp.int32],
    largest_step: wp.float64,
    courant: wp.float64,
    final: wp.float64,
    # Data out:
    moved: wp.array[wp.vec3d],
    steps: wp.array[wp.int32],
):
    """Integrate each particle's path by third-order Runge-Kutta steps (Ralston 1962), each within a part of a triangle.

    The velocity is linear on every triangle, so steps shorter than a triangle resolve it, and particles in calm regions
    take long steps: no particle waits for another.
    """
    v, _compiled_once = wp.tid()
    p = particles[v]
    f = corners[first_corners[v]] // 3
    s = wp.float64(0.0)
    grown = wp.float64(1.0)  # e^s
    count = int(0)
    while s < final and count < MAX_STEPS:
        k1, size, f = velocity_at(p, grown - ONE, f, points, faces, neighbours, field, numbers)
        # The remaining motion falls as e^-s, and the error of a step as its fourth power.
        # Longest step, of the 14 units of time of a path
        longest = wp.min(largest_step * wp.sqrt(wp.sqrt(grown)), wp.float64(2.0))
        step = wp.min(longest, courant * size / wp.max(wp.length(k1), TINY))
        step = wp.min(wp.max(step, SHORTEST_STEP), final - s)
        quarter = wp.exp(wp.float64(0.25) * step)
        later = grown * quarter * quarter
        # One call for both other stages, not two: it is inlined, and half of the kernel.
        k = k1
        # Stages at 0, 1/2 and 3/4 with weights 2/9, 1/3 and 4/9: Ralston's method of third order (1962).
        total = TWO / wp.float64(9.0) * k1
        near = int(f)
        for stage in range(1, 3):
            ahead = HALF * step
            weight = ONE / THREE
            if stage == 2:
                ahead = wp.float64(0.75) * step
                weight = wp.float64(4.0) / wp.float64(9.0)
                later = later * quarter
            ahead_point = wp.normalize(p + ahead * k)
            k, _, near = velocity_at(ahead_point, later - ONE, near, points, faces, neighbours, field, numbers)
            total += weight * k
        grown = later * quarter
        p = wp.normalize(p + step * total)
        s += step
        count += 1
    moved[v] = p
    steps[v] = count


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

    sphere: Floats
    potential: Floats
    steps: int
    history: tuple[Record, ...] = ()
    converged: bool = True


@blas_threads(1)
def moser_map(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    target: TargetDensity | None = None,
    solver: EdgeLaplacianSolver | LaplacianSolver | SolverLike | None = None,
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
        target: the density ρ that the image is to have; uniform where not given; a function is taken for one.
            It is taken at the vertices of ``sphere`` and as linear between them.
        solver: the factorised cotangent Laplacian of the image, made here when left out. For a conformal image the
            surface's own can serve and saves a factorisation, but around the pole a discrete conformal map is not
            conformal: the area error it leaves is three to four times as large, and does not vanish on fine meshes. The
            name of a solver of :func:`omtwarp.map_to_sphere` is taken for one that is made here.
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
    target = target if isinstance(target, TargetDensity | None) else TargetDensity(target)  # of a function
    surface = as_surface(surface)
    where = resolve_device(device)
    tell(progress, "moser", 0, parts, {})
    vertices = surface.vertex_count
    points = vectors(as_sphere(sphere, surface), where)
    mesh = surface.on(where)
    faces, rows = mesh.faces, mesh.vertex_corners
    if not isinstance(solver, EdgeLaplacianSolver | LaplacianSolver):
        with solving_with(Solver.AUTO if solver is None else choose(Solver, solver)):
            solver = cotangent_solver(surface, points)
    tell(progress, "moser", 2, parts, {})
    here = points.numpy()
    areas = triangle_areas(here, surface.faces)
    around = surface.sum_to_vertices(areas * (SPHERE_AREA / areas.sum())) / 3.0
    wanted = around
    if target is not None:
        masses = areas * target.at(here)[surface.faces].mean(axis=1)
        wanted = surface.sum_to_vertices(masses * (SPHERE_AREA / masses.sum())) / 3.0
    with np.errstate(divide="ignore"):
        densities = np.minimum([surface.vertex_areas / around, wanted / around - 1.0], float(LARGE))
    potential = wp.array(solver.solve(surface.vertex_areas - wanted), dtype=wp.float64, device=where)
    tell(progress, "moser", 3, parts, {})

    field = wp.empty(vertices, dtype=wp.vec3d, device=where)
    sizes = wp.empty(vertices, dtype=wp.float64, device=where)
    launch_parts(vertex_field, vertices, [points, faces, potential, *rows, FIRST_THREAD], [field, sizes], where)
    numbers = vectors(np.stack([*densities, sizes.numpy()], axis=1), where)
    moved = wp.empty_like(points)
    steps = wp.empty(vertices, dtype=wp.int32, device=where)
    # In s = -log(1 - t) the remaining motion falls as e^-s: at s = 14 it is 1e-6 of ∇Θ.
    # Largest step, at the start; it grows with s
    limits = [wp.float64(0.25), wp.float64(courant), wp.float64(14.0)]
    inputs = [*each(points, rows[0]), points, faces, mesh.face_neighbours, field, numbers, rows[1], *limits]
    launch_parts(integrate_particles, vertices, inputs, each(moved, steps), where, SLOW_LAUNCH)
    longest = int(steps.numpy().max())
    tell(progress, "moser", parts, parts, {"steps": longest})
    return MoserMap(moved.numpy(), potential.numpy(), longest)
