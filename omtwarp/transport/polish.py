"""Removal of the remaining curl on the image mesh itself.

The flow on the subdivided icosahedron leaves the curl that its wavelets cannot represent. Here the stream function
lives on the vertices of the image: one Poisson problem takes the curl out of log_y(x) (section 2.3, with Angenent,
Haker and Tannenbaum's (2003) projection in place of steepest descent), and another, with the same factorised matrix,
restores the areas, as one step of Moser's flow would (section 4.2). A few rounds leave a map that is closer to optimal
and to area preserving at once.

A vertex takes the mean velocity of the triangles around it, weighted by one over their areas. At the rim of a fan of
triangles hundreds of times larger than the others (the flat base of a scanned bust) vertices then move with the fine
mesh, and the fan hardly changes. Weighted by angle or by area, the fan pulls its rim through the small triangles next
to it: on Max Planck the gap then stayed at 0.6 % of the cost, or fell at the expense of area.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, THREE, ZERO, wp
from omtwarp.device.sums import RowSums, sums_for
from omtwarp.device.threads import Arguments, blas_threads, launch_parts
from omtwarp.flips.guard import StepGuard
from omtwarp.geometry.spherical import TINY, logarithm, solid_angle
from omtwarp.mesh.checks import MeshLike, as_sphere, as_surface
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.options import Progress, Record
from omtwarp.solvers.poisson import cotangent_solver, solve_arrays
from omtwarp.transport.cost import LARGEST_ERROR
from omtwarp.transport.flow import AREA_PRICE, OPTIMAL_CURL, TransportMap
from omtwarp.transport.kernels import area_error, centre

wp.set_module_options(KERNEL_OPTIONS)

MAX_ROUNDS = 18  # at most; it ends sooner where a round gains too little
# Share of the full step that a round takes: where the map contracts strongly a full step overshoots. A round that does
# not lower the curl, or loses area, is undone and tried again at half the share; areas are restored with twice the
# step.
STEP = 0.7
# The area error must not grow, neither with triangles counting at most 0.1 each, which measures most of the map, nor
# with up to 10 each, which measures the worst triangles, except by a negligible amount and by the share of the gain in
# cost that the flow allows too.
AREA_SLACK = 1e-4


@wp.kernel
def cost_and_area_errors(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    areas: wp.array[wp.float64],
    usual: wp.float64,
    worst: wp.float64,
    # Data out:
    measured: wp.array2d[wp.float64],
):
    """Compute the squared cost of every triangle, and its area error, at most ``usual`` and at most ``worst``."""
    f = wp.tid()
    face = faces[f]
    _pull, distance = logarithm(centre(points, face), centre(start, face))
    measured[f, 0] = areas[f] * distance * distance
    measured[f, 1] = area_error(points, face, areas[f], usual)
    measured[f, 2] = area_error(points, face, areas[f], worst)


@wp.kernel
def displacements_to_start(
    start: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    # Data out:
    pull: wp.array[wp.vec3d],
):
    v = wp.tid()
    towards, _distance = logarithm(points[v], start[v])
    pull[v] = towards


@wp.kernel
def weak_curl_and_area(
    points: wp.array[wp.vec3d],
    pull: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    first: int,
    # Data out:
    curl: wp.array[wp.float64],
    energy: wp.array[wp.float64],
    area: wp.array[wp.float64],
):
    """Compute ∫ u · J∇φ over the triangles around a vertex, a third of ∫ |u|², and a third of their area on the sphere.

    The area is that of the spherical triangles, which tile the sphere: in a fan of long thin triangles the flat ones
    fall short of it by several per cent, and equal flat areas would push the map out of the fan at the expense of cost.
    u is the mean of the displacements at a triangle's corners. With n the normal of length 2A and e the edge opposite
    the vertex, A J∇φ = n × (n × e) / (4A) = -A e / (2A) ... = -e / 2: the area drops out, and slivers do no harm.
    """
    thread, _compiled_once = wp.tid()
    v = first + thread
    total_curl = wp.float64(0.0)
    total_energy = wp.float64(0.0)
    total_area = wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        corner = corners[k]
        face = faces[corner // 3]
        i, j = face[(corner + 1) % 3], face[(corner + 2) % 3]
        mean = ONE / THREE * (pull[v] + pull[i] + pull[j])
        double_area = wp.length(wp.cross(points[i] - points[v], points[j] - points[v]))
        total_curl -= HALF * wp.dot(mean, points[j] - points[i])
        total_energy += ONE / THREE * HALF * double_area * wp.dot(mean, mean)
        total_area += ONE / THREE * solid_angle(points[v], points[i], points[j])
    curl[v] = total_curl
    energy[v] = total_energy
    area[v] = total_area


@wp.kernel
def missing_areas(
    wanted: wp.array[wp.float64],
    area: wp.array[wp.float64],
    total: wp.array[wp.float64],
    sphere_area: wp.float64,
    # Data out:
    missing: wp.array[wp.float64],
):
    """Compute the area missing at vertices, whose present areas are scaled to the sum 4π."""
    v = wp.tid()
    missing[v] = wanted[v] - area[v] * (sphere_area / total[0])


@wp.kernel
def move_by_potentials(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    stream: wp.array[wp.float64],
    potential: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    curl_step: wp.float64,
    area_step: wp.float64,
    first: int,
    # Data out:
    moved: wp.array[wp.vec3d],
):
    """Move along J∇H and -∇Θ, means over the triangles around a vertex weighted by one over their areas.

    With n the normal of length 2A and e_k the edge opposite corner k, ∇H = Σ H_k n × e_k / (2A)² and
    J∇H = -Σ H_k e_k / 2A.
    """
    v = first + wp.tid()
    total = wp.vec3d()
    weight = ZERO
    for k in range(offsets[v], offsets[v + 1]):
        face = faces[corners[k] // 3]
        i, j, l = face[0], face[1], face[2]
        normal = wp.cross(points[j] - points[i], points[l] - points[i])
        double_area = wp.length(normal)
        if double_area > ZERO:
            a, b, c = points[l] - points[j], points[i] - points[l], points[j] - points[i]
            around = -(stream[i] * a + stream[j] * b + stream[l] * c) / double_area
            uphill = potential[i] * a + potential[j] * b + potential[l] * c
            uphill = wp.cross(normal / double_area, uphill) / double_area
            total += (curl_step * around - area_step * uphill) / double_area
            weight += ONE / double_area
    y = points[v]
    step = total / wp.max(weight, TINY)
    moved[v] = wp.normalize(y + step - wp.dot(step, y) * y)


@blas_threads(1)
def polish_transport(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    start: ArrayLike | wp.array,
    rounds: int = MAX_ROUNDS,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> TransportMap:
    """Remove the curl left in a nearly optimal map, and its area error with it.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes; its vertex areas, total 4π, are
            the masses.
        sphere: a mass-preserving map of ``start`` without flips, unit vectors, shape [V, 3]; or a Warp array of vec3d.
        start: the points x that are transported, in the same way.
        rounds: the most rounds.
        device: where the kernels run, and where the systems of a large mesh are solved.
        progress: called after each round as ``progress("omt", round, most, record)``.

    Returns:
        The map of the last round that lowered the curl without harm to the areas, and a record of all rounds:
        ``iteration``, ``step`` and ``held`` of the round, ``cost``, ``curl`` and ``area_error`` of the map it left,
        which is the one before where the round was taken back.

    Raises:
        OmtwarpError: the mesh or a map cannot be used.
    """
    # A round has to lower the curl by at least this share for another to follow.
    min_curl_reduction = 0.03
    surface = as_surface(surface)
    where = resolve_device(device)
    origin, points = (vectors(as_sphere(array, surface), where) for array in (start, sphere))
    points = wp.clone(points)
    moved = wp.empty_like(points)
    curl = _Curl(surface, origin, points)
    guard = StepGuard(surface, where)
    guarded = guard.count(points) == 0
    history: list[Record] = []
    best = wp.clone(points)
    first_cost, *largest = curl.cost_and_errors(points)
    potentials: list[wp.array] = []
    kept: dict[str, float] = {}
    least, held, step, last = np.inf, 0, STEP, False
    for number in range(rounds + 1):
        removable, size, solved = curl.removable(points)
        # Least size, of the displacements: its square is a normal number; a map that is its own start has none
        relative = removable / max(size, 1e-150)
        cost, *errors = curl.cost_and_errors(points)
        slack = AREA_SLACK + AREA_PRICE * max(0.0, 1.0 - cost / max(first_cost, float(TINY)))
        tried = step
        if removable < least and errors[0] <= largest[0] + slack and errors[1] <= largest[1] + slack:
            last = removable > (1.0 - min_curl_reduction) * least
            wp.copy(best, points)
            least = removable
            potentials = solved
            kept = {"cost": cost, "curl": relative, "area_error": errors[0]}
        else:
            step *= 0.5
        record = {"iteration": number, **kept, "step": tried, "held": held}
        history.append(record)
        if progress is not None:
            progress("omt", number, rounds, record)
        ended = _end(relative, last, step, number == rounds)
        if ended:
            break
        curl.move(best, potentials, step, moved)
        held = guard.limit(best, moved) if guarded else 0
        points, moved = moved, points
    return TransportMap(best.numpy().copy(), history, kept["curl"] <= OPTIMAL_CURL, ended)


def _end(curl: float, exhausted: bool, step: float, most: bool) -> str:
    """Return why no further round is made, in words; empty where one is.

    Args:
        curl: of the map, relative to the displacements.
        exhausted: whether the round took too little off the curl.
        step: of the next round.
        most: whether the most rounds were made.
    """
    shortest_step = 0.1
    negligible_curl = 1e-3
    if curl <= negligible_curl:
        return "the curl is negligible"
    if exhausted:
        return "a round took next to nothing off the curl"
    if step < shortest_step:
        return "no step lowers the curl without harm to areas"
    return "most rounds made" if most else ""


class _Curl:
    """The curl of maps of one surface, and the steps that take it out; with the arrays that all rounds share.

    Args:
        surface: V vertices; its vertex areas, total 4π, are the masses.
        origin: the points that are transported, vec3d, shape [V].
        points: the map whose triangles the Laplacian is made of, vec3d, shape [V].
    """

    def __init__(self, surface: Surface, origin: wp.array, points: wp.array):
        where, count = points.device, surface.vertex_count
        self.where, self.count, self.origin, self.mesh = where, count, origin, surface.on(where)
        self.solver = cotangent_solver(surface, points)
        self.pull = wp.empty_like(points)
        self.curl, self.energy, self.area, self.missing = (
            wp.empty(count, dtype=wp.float64, device=where) for _ in range(4)
        )
        self.total, self.squares = (wp.empty(size, dtype=wp.float64, device=where) for size in (1, 2))
        self.measured = wp.empty((surface.face_count, 3), dtype=wp.float64, device=where)
        self.face_sums, self.vertex_sums = RowSums(surface.face_count, 3, where), sums_for(where)

    def cost_and_errors(self, points: wp.array) -> tuple[float, float, float]:
        """Return cost and area errors of a map: with triangles counting little each, and with up to ten each."""
        # The area error must not grow, neither with triangles counting at most 0.1 each, which measures most of the
        # map, nor with up to 10 each, which measures the worst triangles, except by a negligible amount and by the
        # share of the gain in cost that the flow allows too.
        max_counted_error = 10.0
        limits = [wp.float64(LARGEST_ERROR), wp.float64(max_counted_error)]

        def of_triangles(part: slice) -> Arguments:
            inputs = [self.origin, points, self.mesh.faces[part], self.mesh.face_areas[part], *limits]
            return inputs, [self.measured[part]]

        launch_parts(cost_and_area_errors, len(self.measured), of_triangles, self.where)
        cost, usual, worst = (float(x) for x in self.face_sums(self.measured).numpy().sum(axis=0))
        return cost, usual / SPHERE_AREA, worst / SPHERE_AREA

    def removable(self, points: wp.array) -> tuple[float, float, list[wp.array]]:
        """Return the norms of the curl and of the displacements, and the potentials that take out curl and area error.

        Args:
            points: the map, vec3d, shape [V].
        """
        inputs = [self.origin, points]
        wp.launch(displacements_to_start, dim=self.count, inputs=inputs, outputs=[self.pull], device=self.where)

        def around_vertices(part: slice) -> Arguments:
            inputs = [points, self.pull, self.mesh.faces, *self.mesh.vertex_corners, part.start]
            return inputs, [self.curl, self.energy, self.area]

        launch_parts(weak_curl_and_area, self.count, around_vertices, self.where)
        self.vertex_sums.total(self.area, self.total)
        inputs = [self.mesh.vertex_areas, self.area, self.total, wp.float64(SPHERE_AREA)]
        wp.launch(missing_areas, dim=self.count, inputs=inputs, outputs=[self.missing], device=self.where)
        solved = solve_arrays(self.solver, [self.curl, self.missing])
        self.vertex_sums.dot(self.curl, solved[0], self.squares[:1])
        self.vertex_sums.total(self.energy, self.squares[1:])
        removable, size = np.sqrt(np.maximum(self.squares.numpy(), 0.0)).tolist()
        return removable, size, solved

    def move(self, points: wp.array, potentials: list[wp.array], step: float, moved: wp.array) -> None:
        """Move a map along its potentials: that of the curl by a share of the full step, that of areas by twice it."""

        def along_potentials(part: slice) -> Arguments:
            lengths = [wp.float64(step), wp.float64(min(1.0, 2.0 * step))]
            inputs = [points, self.mesh.faces, *potentials, *self.mesh.vertex_corners, *lengths, part.start]
            return inputs, [moved]

        launch_parts(move_by_potentials, self.count, along_potentials, self.where)
