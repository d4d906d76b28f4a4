"""The optimal mass-preserving map (section 4.3) by a flow in which the vertices carry the map.

Along a vertex the paper's transport equation g_t + v · ∇g = 0 with v = -(1/μ) J∇H reads dy/dt = J∇H(y): with g area
preserving, the image moves with a divergence-free field of the *uniform* sphere, and nothing is interpolated back and
forth. The stream function H lives on a subdivided icosahedron and is the derivative of the cost with respect to such a
motion (the weak curl of log_y(x) times area, at the centres of the image's triangles), preconditioned in the paper's
own wavelet basis.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import empty, vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.sums import DeviceSum, RowSums
from omtwarp.device.threads import Each, Graph, blas_threads, each, launch_parts
from omtwarp.errors import choose
from omtwarp.flips.exact import flipped_faces
from omtwarp.flips.guard import StepGuard
from omtwarp.measures import TargetDensity
from omtwarp.mesh.arrays import Floats, Ints, normalised, real_number, squared_norms, whole_number
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_sphere, as_surface
from omtwarp.metrics.optimality import relative_curl
from omtwarp.options import Cost, CostLike, Progress, Record, Scheme, SchemeLike, tell
from omtwarp.transport import kernels
from omtwarp.transport.cost import LARGEST_ERROR
from omtwarp.transport.kernels import Ending
from omtwarp.wavelets import SphereHierarchy, SphereSampler, WaveletPreconditioner, level_for, sphere_hierarchy
from omtwarp.wavelets.kernels import scale_values
from omtwarp.wavelets.transform import WaveletFilter

MAXIMUM_ITERATIONS = {"default": 60, "plain": 1000}


# The flow stops when the part of the displacement that a mass-preserving motion could still remove is this small
# relative to the displacement, or when three steps together no longer lower the cost by a noticeable part.
CURL_TOLERANCE = 2e-3
COST_TOLERANCE = {"default": 1e-4, "plain": 3e-7}  # plain steps are short: small ones are not the last
# No step is searched for whose expected gain is below this share of the cost.
NEGLIGIBLE = {"default": 1e-7, "plain": 1e-10}
# Where iterations are a graph on the device, the host reads the records of this many at a time.
ITERATIONS_AT_ONCE = 10
ENDINGS = {
    Ending.SMALL_CURL: "the curl that the grid resolves is below the tolerance",
    Ending.SETTLED: "three steps together gained next to nothing",
    Ending.NO_STEP: "no step lowers the cost",
    Ending.AREAS: "areas would suffer",
    Ending.ITERATIONS: "most iterations made",
}
# After these the map may be optimal.
SETTLED_ENDINGS = [ENDINGS[ending] for ending in (Ending.SMALL_CURL, Ending.SETTLED, Ending.NO_STEP)]
# Relative curl of the whole displacement up to which a map counts as optimal: the excess of its cost grows with the
# square. The curl that the flow itself uses omits what is too fine for a badly stretched mesh, and is zero where no
# wavelet is resolved.
OPTIMAL_CURL = 0.025
# The numbers that an iteration records, in the order of the kernels.
RECORD = ("cost", "curl", "step", "held", "area_error")


@dataclass(frozen=True)
class TransportMap:
    """An optimal (or stopped) mass-preserving map.

    Attributes:
        sphere: image of every vertex, unit vectors, float64, shape [V, 3].
        history: one record per iteration, the start first: ``iteration``, ``cost`` (the paper's M, total mass 4π),
            ``curl`` (relative size of the removable part), ``step``, ``held`` (vertices held back from a flip) and
            ``area_error``.
        converged: whether the map is optimal as far as its curl shows: steps no longer gain, and no more than
            ``OPTIMAL_CURL`` of the displacement is curl, of which no scale is left out.
        ended: why there were no more steps, in words.
    """

    sphere: Floats
    history: list[Record] = field(default_factory=list)
    converged: bool = False
    ended: str = ""

    @property
    def iterations(self) -> int:
        return len(self.history) - 1


@blas_threads(1)
def optimal_transport(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    start: ArrayLike | wp.array,
    cost: CostLike = Cost.SQUARED,
    scheme: SchemeLike = Scheme.DEFAULT,
    target: TargetDensity | None = None,
    iterations: int | None = None,
    tolerance: float = CURL_TOLERANCE,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> TransportMap:
    """Lower the transport cost of a mass-preserving map by a mass-preserving flow until it is optimal (section 4.3).

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes; its
            :attr:`~omtwarp.Surface.face_areas`, total 4π, are the masses.
        sphere: a mass-preserving map g^0 of ``start``, unit vectors, shape [V, 3], or a Warp array of vec3d; if it has
            no flip, no step makes one.
        start: the points x that are transported, in the same way.
        cost: ``squared`` geodesic distance (its optimum is unique), or the paper's ``geodesic`` distance.
        scheme: ``default``, wavelet-preconditioned conjugate gradients; ``plain``, steepest descent with H the curl
            itself (equation 12), as far as the mesh resolves it.
        target: the density ρ that ``initial`` has reached and that the flow keeps, as the velocity is divided by it;
            uniform where not given; a function is taken for one. It is taken as linear between the nodes of the
            flow's grid.
        iterations: the most iterations; 60 for ``default``, 1000 for ``plain``.
        tolerance: relative curl at which the map counts as optimal.
        device: where the kernels run.
        progress: called after each iteration as ``progress("omt", iteration, most, record)``, the record being that of
            ``history``.

    Returns:
        The map and its history.

    Raises:
        OmtwarpError: the mesh or a map cannot be used, or an unknown cost or scheme.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> start = omtwarp.conformal_map(surface, device="cpu").sphere
        >>> initial = omtwarp.moser_map(surface, start, device="cpu").sphere
        >>> optimal = omtwarp.optimal_transport(surface, initial, start=start, device="cpu").sphere
        >>> cost = [omtwarp.transport_cost(surface, sphere, start=start, device="cpu") for sphere in (initial, optimal)]
        >>> cost[1] < cost[0]
        True
    """
    surface = as_surface(surface)
    cost, scheme = choose(Cost, cost), choose(Scheme, scheme, without=(Scheme.PAPER,))
    where = resolve_device(device)
    x, initial = (vectors(as_sphere(points, surface), where) for points in (start, sphere))
    target = target if isinstance(target, TargetDensity | None) else TargetDensity(target)  # of a function
    flow = _Flow(surface, x, initial, cost, scheme, target)
    most = MAXIMUM_ITERATIONS[scheme] if iterations is None else whole_number(iterations, "iterations")
    tolerance = real_number(tolerance, "tolerance", least=0.0)
    ended = flow.run(flow.iterations(), most, tolerance, progress)
    converged = ended in SETTLED_ENDINGS
    if converged:
        left = relative_curl(surface, flow.points, start=x, cost=cost, device=str(flow.device))
        converged = left <= OPTIMAL_CURL
        if not converged:
            ended += f", and {left:.3f} of the displacement is curl that it cannot remove"
    return TransportMap(flow.points.numpy().copy(), flow.history, converged, ended)


class _StreamGrid:
    """The subdivided icosahedron that the stream function lives on, and what carries it to an image and back.

    Args:
        surface: the surface that is mapped.
        centres: of the image's triangles, vec3d [F] on the device.
        squares: squared length of the longest edge of each of the image's triangles, shape [F].
        plain: whether steepest descent wants a filter, see :meth:`_Flow.set_steepest`.
        target: the density that the flow keeps.

    Attributes:
        sampler: from the nodes to the centres, and the adjoint.
        spacing: of the finest nodes, in radians: below it the direction to a point is not resolved.
        preconditioner: the wavelets, each damped where vertices cannot follow it.
        filter: fades the same wavelets out; None but for plain steepest descent.
        inverse_areas: one over the nodes' areas, float64 [N].
        node_shares: 1/ρ at the nodes, float64 [N]; empty for the uniform density.
    """

    def __init__(
        self, surface: Surface, centres: wp.array[wp.vec3d], squares: Floats, plain: bool, target: TargetDensity | None
    ):
        device = centres.device
        hierarchy = sphere_hierarchy(level_for(surface.vertex_count, lowest=2))
        density = None if target is None else target.at(hierarchy.vertices)
        self.sampler = SphereSampler(hierarchy, centres, device=str(device), density=density)
        self.node_shares = wp.array(1.0 / density if density is not None else [], dtype=wp.float64, device=device)
        self.spacing = hierarchy.node_spacing(hierarchy.level)
        damping = resolution_damping(squares, self.sampler.point_faces.numpy(), hierarchy)
        self.preconditioner = WaveletPreconditioner(hierarchy, butterfly=True, damping=damping, device=str(device))
        self.filter = WaveletFilter(hierarchy, damping, butterfly=True, device=str(device)) if plain else None
        self.inverse_areas = wp.array(1.0 / hierarchy.node_areas, dtype=wp.float64, device=device)


class _Flow:
    """The state of the flow, all of it on the device: an iteration reads nothing back."""

    def __init__(
        self, surface: Surface, start: wp.array, initial: wp.array, cost: str, scheme: str, target: TargetDensity | None
    ):
        self.device = device = initial.device
        self.count, self.face_count = surface.vertex_count, surface.face_count
        self.geodesic, self.scheme, self.plain = cost == "geodesic", scheme, scheme == "plain"
        self.history: list[Record] = []
        self.points = wp.clone(initial)
        self.trial = wp.empty_like(self.points)
        mesh = surface.on(device)
        self.faces, self.masses = mesh.faces, mesh.face_areas
        before, corners = (points.numpy()[surface.faces] for points in (start, initial))
        self.start_centres, self.centres = (
            wp.array(normalised(places.sum(axis=1)), dtype=wp.vec3d, device=device) for places in (before, corners)
        )
        squares = squared_norms(corners - np.roll(corners, -1, axis=1)).max(axis=1)
        self.grid = _StreamGrid(surface, self.centres, squares, self.plain, target)
        self.shares = empty(0 if target is None else self.count, wp.float64, device)
        self.hints = wp.full(self.count, -1, dtype=wp.int32, device=device)
        self.guard = StepGuard(surface, device)
        self.guarded = not flipped_faces(self.points, self.faces, device=device).any()
        self.measured = wp.empty((self.face_count, 2), dtype=wp.float64, device=device)
        self.turned = wp.empty(self.face_count, dtype=wp.vec3d, device=device)
        self.face_sums = RowSums(self.face_count, 2, device)
        self.gradient, self.image, self.steepest, self.direction, self.previous = (
            wp.zeros(len(self.grid.inverse_areas), dtype=wp.float64, device=device) for _ in range(5)
        )
        self.products: wp.array = wp.empty(4, dtype=wp.float64, device=device)
        self.product = [self.products[k : k + 1] for k in range(4)]
        self.sums = DeviceSum(device)
        self.sums.dot(self.gradient, self.image, self.product[0])  # makes room, for which iterations must not ask
        self.state = wp.empty(1, dtype=kernels.FlowState, device=device)
        self.running, self.searching = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))

    def launch(self, kernel: wp.Kernel, dim: int, inputs: list[object], outputs: list[object]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def measure(self, points: wp.array) -> wp.array:
        """Compute partial sums of the cost and the area error, and what :meth:`set_gradient` needs."""
        if self.shares.size:
            inputs = [points, self.hints, *self.grid.sampler.triangles, self.grid.node_shares]
            self.launch(kernels.values_at_points, self.count, inputs, [self.shares])
        options = [self.shares, int(self.geodesic), wp.float64(self.grid.spacing), wp.float64(LARGEST_ERROR)]
        inputs = [Each(self.start_centres), points, *each(self.faces, self.masses), *options]
        outputs = each(self.measured, self.turned, self.centres)
        launch_parts(kernels.cost_and_force, self.face_count, inputs, outputs, self.device)
        return self.face_sums(self.measured)

    def set_gradient(self) -> None:
        """Compute the derivative of the cost with respect to H at the nodes, in weak form."""
        self.grid.sampler.locate(self.centres)
        self.grid.sampler.gradient_adjoint(self.turned, out=self.gradient)

    def set_steepest(self) -> None:
        """Compute H of equation 12, the curl, in the space that the mesh resolves: F A^-1 F^T of the weak one.

        F fades out the wavelets that are too fine for the mesh (Algorithm 1 clears those of the finest levels), A holds
        the nodes' areas. Unfiltered, steepest descent follows the finest wavelets first, which is what vertices cannot
        do: the cost then falls because areas are lost.
        """
        assert self.grid.filter is not None
        wp.copy(self.steepest, self.gradient)
        self.grid.filter.apply_adjoint(self.steepest)
        self.launch(scale_values, len(self.steepest), [self.grid.inverse_areas], [self.steepest])
        self.grid.filter.apply(self.steepest)

    def iterate(self) -> None:
        """Run one iteration: choose a direction, and try steps along it until one is accepted."""
        self.set_gradient()
        self.grid.preconditioner.apply(self.gradient, out=self.image)
        ascent = self.image
        if self.plain:
            self.set_steepest()
            ascent = self.steepest
        pairs = [(self.gradient, other) for other in (self.image, ascent, self.direction)]
        for (one, other), out in zip([*pairs, (self.previous, ascent)], self.product, strict=True):
            self.sums.dot(one, other, out)
        inputs = [self.products, self.guard.held, self.state]
        self.launch(kernels.begin_iteration, 1, inputs, [self.records, self.running, self.searching])
        inputs = [self.gradient, ascent, self.state, self.direction]
        self.launch(kernels.turn_direction, len(ascent), inputs, [self.previous])
        wp.capture_while(self.searching, self.search, velocity=self.grid.sampler.node_gradient(self.direction))
        self.launch(kernels.keep_accepted, self.count, [self.trial, self.state], [self.points])

    def search(self, velocity: wp.array) -> None:
        """Try a step along the direction."""
        inputs = [Each(self.points), self.state, *self.grid.sampler.triangles, velocity]
        launch_parts(kernels.advect_points, self.count, inputs, each(self.hints, self.trial), self.device)
        if self.guarded:
            # A step that flips triangles whose repair takes more rounds than this, each a ring further, is too long.
            # Scanned shapes took 48 at most.
            self.guard.hold(self.points, self.trial, 100)
        inputs = [self.measure(self.trial), wp.float64(SPHERE_AREA), self.state]
        self.launch(kernels.judge_step, 1, inputs, [self.running, self.searching])

    def prepare(self, most: int, tolerance: float) -> None:
        """Measure the start, and set the state."""
        # The flow ends when the area error has grown by more than this share of its first value and the price of what
        # was gained (omtwarp.transport.kernels.judge_step): beyond that the cost falls at the expense of area.
        area_loss = 0.1
        longest_step = 4.0
        # First steps, in units of a Newton step on a flat density, and of the plain scheme in squared spacings of
        # nodes. Measured with the geodesic cost on a scan of 6,000 triangles: 0.05 ends after as many iterations as
        # 0.4, and 2 after two, at a cost that is 0.3 % higher; plain, 0.01 takes 429 iterations and 0.5 takes 155, for
        # a cost that is 0.07 % lower than 0.1's in 16.
        first_step, first_plain_step = 0.4, 0.1
        self.guard.held.zero_()
        cost, error = (float(x) for x in self.measure(self.points).numpy().sum(axis=0))
        # In the squared cost a unit of the preconditioned gradient, halved, is a Newton step on a flat density.
        # Radians: distances of a map that is its own start are rounding, and steps are in proportion to 1 / cost.
        scale = 2.0 if not self.geodesic else 4.0 * np.pi / max(cost, 1e-12)
        self.state.zero_()
        state = self.state.numpy().copy()
        area_error = error / SPHERE_AREA
        values = {
            "most": most,
            "conjugate": int(not self.plain),
            "tolerance": tolerance,
            "cost_tolerance": COST_TOLERANCE[self.scheme],
            "negligible": NEGLIGIBLE[self.scheme],
            "scale": scale,
            "longest": longest_step / scale if not self.plain else np.inf,
            "first_cost": cost,
            "largest_error": (1.0 + area_loss) * area_error,
            "cost": cost,
            "area_error": area_error,
            **dict.fromkeys(("last_gain", "last_gains", "gains"), np.inf),
            "step": first_step / scale if not self.plain else first_plain_step * self.grid.spacing**2,
        }
        for name, value in values.items():
            state[name] = value
        self.state.assign(state)

    def iterations(self, record: bool | None = None) -> Graph:
        """Return a graph of ITERATIONS_AT_ONCE iterations; the graph keeps the flow alive, not the reverse."""
        graph = Graph(lambda: wp.capture_while(self.running, self.iterate), self.device, record)
        at_once = ITERATIONS_AT_ONCE if graph.recorded else 1
        self.records = wp.empty((at_once, len(RECORD)), dtype=wp.float64, device=self.device)
        return graph

    def run(self, iterations: Graph, most: int, tolerance: float, progress: Progress | None = None) -> str:
        """Iterate until the flow ends, and return the reason in words."""
        self.prepare(most, tolerance)
        while True:
            self.running.fill_(1)
            iterations()
            state, rows = self.state.numpy()[0], self.records.numpy()
            for iteration in range(len(self.history), int(state["iteration"])):
                numbers = dict(zip(RECORD, rows[iteration % len(rows)].tolist(), strict=True))
                record = {"iteration": iteration} | numbers | {"held": int(numbers["held"])}
                self.history.append(record)
                tell(progress, "omt", iteration, most, record)
            if state["ended"]:
                return ENDINGS[Ending(int(state["ended"]))]


def resolution_damping(squares: Floats, places: Ints, hierarchy: SphereHierarchy) -> Floats:
    """Return the share of every wavelet, from 0 to 1, that the vertices of an image can follow, shape [N].

    ``squares`` holds the square of the longest edge of each of the image's triangles, shape [F], and ``places`` the
    triangle of the hierarchy's finest level that its centre is in.

    A wavelet of node spacing h over a mesh whose edges are e long there counts (1 + (3 e / h)^2)^-3: close to 1 where
    it spans many edges, close to 0 where it spans one. Nodes far from every vertex (inside a large triangle) get 0.
    """
    # A wavelet is used in full where it spans several mesh edges, and faded out where it does not: vertices cannot
    # follow a motion finer than the mesh, and a cost that falls by aliasing is no progress.
    resolved_edges = 3.0
    fading = 3
    longest = np.full(hierarchy.node_count, -np.inf)
    np.maximum.at(longest, hierarchy.faces[places].ravel(), np.repeat(squares, 3))
    damping = np.ones(hierarchy.node_count)
    for level in reversed(range(hierarchy.level)):
        first, last = hierarchy.node_counts[level], hierarchy.node_counts[level + 1]
        parents = hierarchy.level_parents[level]
        np.maximum.at(longest, parents.ravel(), np.repeat(longest[first:last], 2))
        around = np.maximum(longest[first:last], longest[parents].max(axis=1))
        spacing = 4.0 * np.pi / last
        with np.errstate(over="ignore"):
            ratio = np.where(np.isfinite(around), resolved_edges**2 * around / spacing, np.inf)
        damping[first:last] = (1.0 + ratio) ** -fading
    return damping
