"""The optimal mass-preserving map (section 4.3) by a flow in which the vertices carry the map.

Along a vertex the paper's transport equation g_t + v · ∇g = 0 with v = -(1/μ) J∇H reads dy/dt = J∇H(y): with g area
preserving, the image moves with a divergence-free field of the *uniform* sphere, and nothing is interpolated back and
forth. The stream function H lives on a subdivided icosahedron and is the derivative of the cost with respect to such a
motion (the weak curl of log_y(x) times area, at the centres of the image's triangles), preconditioned in the paper's
own wavelet basis.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import resolve_device, wp
from omtwarp.embedding.guard import StepGuard
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import Surface
from omtwarp.threads import blas_threads, launch_parts
from omtwarp.transport.area import AreaMonitor
from omtwarp.transport.kernels import advect, centre_distance, combine, cost_and_force, divide_by_area
from omtwarp.wavelets import SphereHierarchy, SphereSampler, WaveletPreconditioner, level_for, sphere_hierarchy
from omtwarp.wavelets.filter import WaveletFilter

COSTS = ("squared", "geodesic")
SCHEMES = ("default", "plain")
MAXIMUM_ITERATIONS = {"default": 60, "plain": 1000}

# A wavelet is used in full where it spans several mesh edges, and faded out where it does not: vertices cannot follow
# a motion finer than they are, and a cost that falls by aliasing is no progress.
RESOLVED_EDGES = 3.0
FADING = 3

# The flow stops when the part of the displacement that a mass-preserving motion could still remove is this small
# relative to the displacement, or when steps no longer lower the cost by a noticeable part.
CURL_TOLERANCE = 2e-3
COST_TOLERANCE = {"default": 3e-5, "plain": 1e-7}  # plain steps are short: a small one is not the last
SUFFICIENT_DECREASE = 0.1
# A step that promises less than this part of the cost is not worth looking for.
NEGLIGIBLE = {"default": 1e-7, "plain": 1e-10}
# The flow ends when the area error has grown by more than AREA_LOSS of what it was and AREA_PRICE times the part of the
# cost that this bought: from there on the cost would fall at the expense of area.
AREA_LOSS = 0.1
AREA_PRICE = 0.02
AREA_HALVINGS = 3
LONGEST_STEP = 4.0


@dataclass(frozen=True)
class TransportMap:
    """An optimal (or stopped) mass-preserving map.

    Attributes:
        sphere: image of every vertex, unit vectors, float64, shape [V, 3].
        history: one record per iteration, the start first: ``iteration``, ``cost`` (the paper's M, total mass 4π),
            ``curl`` (relative size of the removable part), ``step``, ``held`` (vertices held back from a flip) and
            ``area_error``.
        converged: whether a tolerance was met before the iterations ran out or area began to suffer.
    """

    sphere: NDArray[np.float64]
    history: list[dict[str, Any]] = field(default_factory=list)
    converged: bool = False

    @property
    def iterations(self) -> int:
        return len(self.history) - 1


def transport_cost(
    surface: Surface, start: NDArray[np.float64], sphere: NDArray[np.float64], cost: str = "squared"
) -> float:
    """M(g), equation 6: the sum of triangle area times Φ(x, g(x)) at its centre; total area 4π, distances in radians.

    Centres of triangles stand for the paper's dual vertices; a mesh has twice as many of them as vertices, and large
    triangles count where they are.

    Args:
        surface: the surface whose areas are the masses.
        start: the points x, unit vectors, shape [V, 3] (the conformal or substitute start).
        sphere: their images g(x), unit vectors, shape [V, 3].
        cost: ``squared`` or ``geodesic`` distance.
    """
    maps = (np.ascontiguousarray(x, dtype=np.float64) for x in (start, sphere))
    points = [wp.array(x, dtype=wp.vec3d, device="cpu", copy=False) for x in maps]
    faces = wp.array(surface.faces, dtype=wp.vec3i, device="cpu", copy=False)
    distance = wp.empty(surface.face_count, dtype=wp.float64, device="cpu")
    wp.launch(centre_distance, dim=surface.face_count, inputs=[*points, faces], outputs=[distance], device="cpu")
    moved = distance.numpy()
    return float((surface.face_areas * (moved * moved if cost == "squared" else moved)).sum())


def triangle_centres(surface: Surface, sphere: NDArray[np.float64]) -> NDArray[np.float64]:
    """Centres of a map's triangles on the sphere, unit vectors, shape [F, 3]."""
    sums = np.asarray(sphere)[surface.faces].sum(axis=1)
    return np.asarray(sums / np.linalg.norm(sums, axis=1)[:, None])


@blas_threads(1)
def optimal_transport(
    surface: Surface,
    start: NDArray[np.float64],
    initial: NDArray[np.float64],
    *,
    cost: str = "squared",
    scheme: str = "default",
    iterations: int | None = None,
    tolerance: float = CURL_TOLERANCE,
    device: str | None = "cpu",
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> TransportMap:
    """Lower the transport cost of a mass-preserving map by a mass-preserving flow until it is optimal (section 4.3).

    Args:
        surface: the surface; the areas of its triangles, total 4π, are the masses.
        start: the points x that are transported, unit vectors, shape [V, 3].
        initial: a mass-preserving map g^0 of them, unit vectors, shape [V, 3]; if it has no flip, no step makes one.
        cost: ``squared`` geodesic distance (its optimum is unique), or the paper's ``geodesic`` distance.
        scheme: ``default``, wavelet-preconditioned conjugate gradients; ``plain``, steepest descent with H the curl
            itself (equation 12), as far as the mesh resolves it.
        iterations: the most iterations; 60 for ``default``, 1000 for ``plain``.
        tolerance: relative curl at which the map counts as optimal.
        device: where the kernels run.
        progress: called after each iteration with its number, the most there can be, and the record of ``history``.

    Returns:
        The map and its history.

    Raises:
        OmtwarpError: an unknown cost or scheme.
    """
    if cost not in COSTS:
        raise OmtwarpError(f"unknown cost '{cost}': use {' or '.join(COSTS)}")
    if scheme not in SCHEMES:
        raise OmtwarpError(f"unknown scheme '{scheme}': use {' or '.join(SCHEMES)}")
    flow = _Flow(surface, start, initial, cost, scheme, resolve_device(device))
    most = MAXIMUM_ITERATIONS[scheme] if iterations is None else iterations
    converged = flow.run(most, tolerance, progress)
    return TransportMap(flow.points.numpy().copy(), flow.history, converged)


class _Flow:
    """The state of the flow on the device."""

    def __init__(
        self,
        surface: Surface,
        start: NDArray[np.float64],
        initial: NDArray[np.float64],
        cost: str,
        scheme: str,
        device: Any,
    ):
        self.device = device
        self.count = surface.vertex_count
        self.geodesic = cost == "geodesic"
        self.scheme = scheme
        self.plain = scheme == "plain"
        self.history: list[dict[str, Any]] = []
        self.start = wp.array(np.ascontiguousarray(start), dtype=wp.vec3d, device=device)
        self.points = wp.array(np.array(initial, dtype=np.float64), dtype=wp.vec3d, device=device)
        self.trial = wp.empty_like(self.points)
        self.faces = wp.array(surface.faces, dtype=wp.vec3i, device=device)
        self.face_count = surface.face_count
        self.centres = wp.empty(surface.face_count, dtype=wp.vec3d, device=device)
        self.masses = wp.array(surface.face_areas, dtype=wp.float64, device=device)
        self.hierarchy = sphere_hierarchy(level_for(1.2 * surface.vertex_count, lowest=2))
        centres = triangle_centres(surface, initial)
        self.sampler = SphereSampler(self.hierarchy, centres, device=str(device))
        # Within a grid cell the direction to x is not resolved anyway.
        self.softening = self.hierarchy.node_spacing(self.hierarchy.level)
        damping = resolution_damping(surface, np.asarray(initial), self.sampler, self.hierarchy)
        self.preconditioner = WaveletPreconditioner(
            self.hierarchy, butterfly=True, damping=damping, device=str(device)
        )
        self.filter = WaveletFilter(self.hierarchy, damping, butterfly=True, device=str(device)) if self.plain else None
        self.node_areas = wp.array(self.hierarchy.node_areas, dtype=wp.float64, device=device)
        levels = self.hierarchy.level_faces
        starts = np.concatenate([[0], np.cumsum([len(faces) for faces in levels])]).astype(np.int32)
        self.grid = [
            wp.array(self.hierarchy.vertices, dtype=wp.vec3d, device=device),
            wp.array(np.concatenate(levels), dtype=wp.int32, device=device),
            wp.array(starts, dtype=wp.int32, device=device),
        ]
        self.monitor = AreaMonitor(surface, device)
        self.guard = StepGuard(surface, device)
        self.guarded = self.guard.count(self.points) == 0
        self.costs = wp.empty(self.face_count, dtype=wp.float64, device=device)
        self.turned = wp.empty(self.face_count, dtype=wp.vec3d, device=device)

    def cost_at(self, points: Any) -> float:
        options = [int(self.geodesic), wp.float64(self.softening)]

        def arguments(part: slice) -> tuple[list[Any], list[Any]]:
            own = [self.faces[part], self.masses[part]]
            return [self.start, points, *own, *options], [self.costs[part], self.turned[part], self.centres[part]]

        launch_parts(cost_and_force, self.face_count, arguments, self.device)
        return float(wp.utils.array_sum(self.costs))

    def gradient(self) -> Any:
        """The derivative of the cost with respect to H at the nodes, weak form; needs :meth:`cost_at` before."""
        self.sampler.locate(self.centres)
        return self.sampler.gradient_adjoint(self.turned, smooth=True)

    def curl(self, gradient: Any) -> Any:
        """H of equation 12, the curl itself, in the space that the mesh resolves: F A^-1 F^T of the weak one.

        F fades out the wavelets that are too fine for the mesh (Algorithm 1 clears those of the finest levels), A holds
        the nodes' areas. Unfiltered, steepest descent follows the finest wavelets first, which is what vertices cannot
        do: the cost then falls because areas are lost.
        """
        assert self.filter is not None
        weak, out = wp.clone(gradient), wp.empty_like(gradient)
        self.filter.apply_adjoint(weak)
        wp.launch(divide_by_area, dim=len(out), inputs=[weak, self.node_areas], outputs=[out], device=self.device)
        self.filter.apply(out)
        return out

    def move(self, velocity: Any, step: float) -> None:
        def arguments(part: slice) -> tuple[list[Any], list[Any]]:
            return [self.points[part], wp.float64(step), *self.grid, velocity], [self.trial[part]]

        launch_parts(advect, self.count, arguments, self.device)

    def run(self, most: int, tolerance: float, progress: Callable[[int, int, dict[str, Any]], None] | None) -> bool:
        cost = self.cost_at(self.points)
        # In the squared cost a unit of the preconditioned gradient, halved, is a Newton step on a flat density.
        scale = 2.0 if not self.geodesic else 4.0 * np.pi / max(cost, 1e-12)
        step = 0.4 / scale if not self.plain else 0.1 * self.softening**2
        longest = LONGEST_STEP / scale if not self.plain else np.inf
        direction: Any = None
        previous: Any = None
        previous_square = 0.0
        held = 0
        small = 0
        area_error = self.monitor.error(self.points)
        first_cost, largest_error = cost, (1.0 + AREA_LOSS) * area_error
        for iteration in range(most + 1):
            gradient = self.gradient()
            image = self.preconditioner.apply(gradient)
            square = float(wp.utils.array_inner(gradient, image))
            curl = float(np.sqrt(max(square / scale, 0.0) / max(scale * cost, 1e-300)))
            record = {"iteration": iteration, "cost": cost, "curl": curl, "step": step, "held": held}
            record["area_error"] = area_error
            self.history.append(record)
            if progress is not None:
                progress(iteration, most, record)
            if curl <= tolerance or cost <= 1e-14 or square <= 0.0 or small >= 3:
                return True
            if iteration == most:
                return False
            if self.plain:
                image = self.curl(gradient)
                square = float(wp.utils.array_inner(gradient, image))
            # Polak and Ribiere's conjugate directions, restarted when they stop pointing downhill.
            factor = 0.0
            if direction is not None and not self.plain:
                factor = max(0.0, (square - float(wp.utils.array_inner(previous, image))) / previous_square)
            if direction is None:
                direction = wp.zeros_like(image)
            wp.launch(
                combine, dim=len(image), inputs=[image, wp.float64(factor), direction], device=self.device
            )
            slope = float(wp.utils.array_inner(gradient, direction))
            if slope > -0.1 * square:
                wp.launch(combine, dim=len(image), inputs=[image, wp.float64(0.0), direction], device=self.device)
                slope = -square
            previous, previous_square = gradient, square
            velocity = self.sampler.node_gradient(direction)
            accepted, shortened = False, 0
            for _ in range(30):
                self.move(velocity, step)
                held = self.guard.limit(self.points, self.trial) if self.guarded else 0
                new_cost = self.cost_at(self.trial)
                # The parabola through the cost, its slope and the trial says where along this direction to stop.
                bend = (new_cost - cost - slope * step) / step**2
                best = -slope / (2.0 * bend) if bend > 0.0 else 2.0 * step
                if new_cost <= cost + SUFFICIENT_DECREASE * slope * step:
                    area_error = self.monitor.error(self.trial)
                    accepted = area_error <= largest_error + AREA_PRICE * (1.0 - new_cost / first_cost)
                    if accepted or shortened == AREA_HALVINGS:
                        break
                    # What a step costs in area grows with its square, what it gains with its length.
                    shortened += 1
                    step *= 0.5
                    continue
                step = max(min(best, 0.5 * step), 0.1 * step)
                if -slope * step < NEGLIGIBLE[self.scheme] * cost:
                    break
            if not accepted:
                # Either area will not have it, or no step along the best direction lowers the cost: at round-off.
                return shortened == 0
            small = small + 1 if cost - new_cost <= COST_TOLERANCE[self.scheme] * cost else 0
            self.points, self.trial = self.trial, self.points
            cost = new_cost
            step = min(max(best, 0.5 * step), 2.0 * step, longest)
        return False


def resolution_damping(
    surface: Surface, image: NDArray[np.float64], sampler: SphereSampler, hierarchy: SphereHierarchy
) -> NDArray[np.float64]:
    """How much of every wavelet the vertices of an image can follow, between 0 and 1, shape [N].

    A wavelet of node spacing h over a mesh whose edges are e long there counts (1 + (3 e / h)^2)^-3: all of it where it
    spans many edges, next to nothing where it spans one. Nodes far from every vertex (inside a large triangle) get 0.
    """
    faces = surface.faces
    corners = image[faces]
    squares = np.max([((corners[:, k] - corners[:, k - 1]) ** 2).sum(axis=1) for k in range(3)], axis=0)
    longest = np.full(hierarchy.node_count, -np.inf)
    nodes = hierarchy.faces[sampler.point_faces.numpy()]
    np.maximum.at(longest, nodes.ravel(), np.repeat(squares, 3))
    damping = np.ones(hierarchy.node_count)
    for level in reversed(range(hierarchy.level)):
        first, last = hierarchy.node_counts[level], hierarchy.node_counts[level + 1]
        parents = hierarchy.level_parents[level]
        np.maximum.at(longest, parents.ravel(), np.repeat(longest[first:last], 2))
        around = np.maximum(longest[first:last], longest[parents].max(axis=1))
        spacing = 4.0 * np.pi / last
        with np.errstate(over="ignore"):
            ratio = np.where(np.isfinite(around), RESOLVED_EDGES**2 * around / spacing, np.inf)
        damping[first:last] = (1.0 + ratio) ** -FADING
    return damping
