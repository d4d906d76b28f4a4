"""Kantorovich's dual problem of a map to a sphere or a torus: potentials, bounds on its cost, steps that raise them.

:mod:`omtwarp.metrics.optimality` explains the bound. It is a concave function of the potential, smooth but for kinks
where best images change triangles, and the matrix that a potential is fitted with approximates its second derivative.
With that matrix as the initial one, steps are those of limited-memory BFGS: pairs of steps and changes of the slope
correct it (Nocedal and Wright 2006, algorithm 7.4). On a cortex of 2,500 vertices seven bounds come as near as 28 with
steps along smoothed slopes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import sent, vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import Each, core_count, each, launch_parts
from omtwarp.mesh.arrays import TINY, Floats, cross, dots, norms, squared_norms
from omtwarp.mesh.surface import Surface
from omtwarp.metrics import optimality_kernels as kernels, tree_kernels as trees
from omtwarp.solvers.poisson import EdgeLaplacianSolver


def ascend(
    dual: MapDual, best: Bound, most: int, enough: float, notify: Callable[[int, Bound], None] | None = None
) -> tuple[Bound, int]:
    """Raise a bound by steps, each of which is shortened until it raises the bound.

    Args:
        dual: the problem.
        best: the bound to begin with.
        most: steps.
        enough: the excess at which steps end.
        notify: called before every step with the number of steps taken and the bound.

    Returns:
        The best bound, and the steps taken.
    """
    # Steps end where so many times what the last two gained would not reach what is wanted, or where that was less than
    # this share of the excess.
    pace, stalled = 8.0, 2e-3
    pairs = _Pairs(dual)
    slope = dual.slope(best)
    excesses, done = [best.excess], 0
    while best.excess > enough and done < most:
        if notify is not None:
            notify(done, best)
        step = _step(dual, pairs, best, slope)
        if step is None:
            if pairs.empty:
                break
            pairs = _Pairs(dual)  # the slope itself may still raise the bound, as next to a kink
            continue
        after = dual.slope(step)
        pairs.add(step.potential - best.potential, slope - after)
        best, slope, done = step, after, done + 1
        excesses.append(best.excess)
        if len(excesses) > 3 and excesses[-3] - best.excess < max((best.excess - enough) / pace, stalled * best.excess):
            break
    return best, done


def _step(dual: MapDual, pairs: _Pairs, best: Bound, slope: Floats) -> Bound | None:
    """Return the bound after one step, or None where no length raises it."""
    trials, shorter = 6, 0.4  # lengths of a step that are tried, each so many times the one before
    first = 0.4  # length of the first step, in units of what would bring a straight line to zero
    direction = pairs.direction(slope)
    along = float(direction @ slope)
    if not along > 0.0:
        return None
    length = first * best.excess / along if pairs.empty else 1.0
    for _ in range(trials):
        raised = dual.bound(best.potential + length * direction)
        if raised.excess < best.excess:
            return raised
        length *= shorter
    return None


class _Pairs:
    """The pairs of limited-memory BFGS, with the matrix of a dual problem as the initial one.

    Args:
        dual: the problem.
    """

    def __init__(self, dual: MapDual):
        self._smoothed = dual.smoothed
        # Most pairs, of steps and changes of the slope; 3 to 20 are usual (Nocedal and Wright 2006, chapter 7)
        self._pairs: deque[tuple[Floats, Floats, float]] = deque(maxlen=10)
        self._scale = 1.0

    @property
    def empty(self) -> bool:
        """Whether there is no pair."""
        return not self._pairs

    def add(self, step: Floats, change: Floats) -> None:
        """Add a step of the potential and how far the slope fell, unless its curvature is round-off."""
        product = float(step @ change)
        # Least curvature, s · y over |s| |y|: pairs with less are not kept, their curvature is round-off
        if product > 1e-12 * float(np.linalg.norm(step) * np.linalg.norm(change)):
            self._pairs.append((step, change, product))
            self._scale = product / float(change @ self._smoothed(change))

    def direction(self, slope: Floats) -> Floats:
        """Return the change of the potential that a slope asks for, by the corrected matrix."""
        right, factors = slope.copy(), []
        for step, change, product in reversed(self._pairs):
            factors.append(float(step @ right) / product)
            right -= factors[-1] * change
        out = self._smoothed(right) * (self._scale if self._pairs else 1.0)
        for (step, change, product), factor in zip(self._pairs, reversed(factors), strict=True):
            out += step * (factor - float(change @ out) / product)
        return out


TOLERANCE = 1e-5
"""How far below the true minimum, in units of the mean cost, the search for it may stay: what it adds to the gap."""


@dataclass(frozen=True)
class Bound:
    """A potential and its c-transform.

    Attributes:
        potential: ψ at the y_i, float64, shape [V].
        vertex_gap: c(x_i, y_i) - ψ(y_i) - φ(x_i), never negative, float64, shape [V].
        excess: Σ m_i vertex_gap_i.
        face: the triangle in which the minimum is attained, shape [V]; -1 where that is y_i itself.
        weights: its barycentric coordinates there, shape [V, 3].
    """

    potential: Floats
    vertex_gap: Floats
    excess: float
    face: NDArray[np.int64]
    weights: Floats


class MapDual(ABC):
    """The dual problem of a map x_i -> y_i with masses m_i, on a sphere or a torus.

    Attributes:
        surface: the faces and edges, V vertices; positions are not used.
        mass: the m_i, shape [V].
        cost: c(x_i, y_i), shape [V].
        tolerance: how far below the true minimum the search for it may stay.
    """

    surface: Surface
    mass: Floats
    cost: Floats
    _solver: EdgeLaplacianSolver | None = None

    @abstractmethod
    def admissible_differences(self) -> tuple[Floats, Floats]:
        """Return the least and the largest difference of ψ along every edge with which its ends swap no partners."""

    @abstractmethod
    def bound(self, potential: Floats) -> Bound:
        """Return the lower bound on the cost that a potential ψ gives, with its c-transform φ."""

    def bound_by(self, kernel: wp.Kernel, potential: Floats, sources: wp.array, inputs: list[object]) -> Bound:
        """Return the bound of a potential whose c-transform a kernel computes at every x_i.

        Args:
            kernel: takes the x_i, c(x_i, y_i) - ψ(y_i), which are the values to beat, and the inputs.
            potential: ψ at the y_i.
            sources: the x_i on the device where the kernel runs, shape [V].
            inputs: further arguments.
        """
        device, own = sources.device, self.cost - potential
        minimum = (wp.float64, wp.int32, wp.vec3d)
        lowest = [wp.empty(len(own), dtype=kind, device=device) for kind in minimum]
        inputs = [*each(sources, sent(own, wp.float64, device)), *inputs]
        # Points whose transforms are worth a launch of their own on another core: each takes 10 microseconds.
        launch_parts(kernel, len(own), inputs, each(*lowest), device, 128)
        proven, face, weights = (array.numpy() for array in lowest)
        gap = own - proven
        return Bound(potential, gap, float(self.mass @ gap), face.astype(np.int64), weights)

    @property
    def tolerance(self) -> float:
        """How far below the true minimum the search for it may stay."""
        return TOLERANCE * float(self.mass @ self.cost) / float(self.mass.sum())

    def initial_potential(self) -> tuple[Floats, int]:
        """Fit ψ to the middles of the admissible differences along all edges.

        Returns:
            The potential, shape [V], and the number of edges that admit no difference.
        """
        lowest, highest = self.admissible_differences()
        width = highest - lowest
        # Narrowest, of the median interval: flipped triangles make empty ones, whose weight must stay finite
        floor = max(1e-3 * float(np.median(np.abs(width))), np.finfo(float).tiny)
        weights = 1.0 / np.maximum(width, floor)
        weights /= weights.mean()
        self._solver = EdgeLaplacianSolver(self.surface, weights)
        return self._solver.fit(0.5 * (lowest + highest)), int((highest < lowest).sum())

    def slope(self, current: Bound) -> Floats:
        """Return the derivative of Σ m_i (φ(x_i) + ψ(y_i)) by ψ: the map's own mass less the mass at the minimisers."""
        moved = current.face >= 0
        arrived = (self.mass[moved][:, None] * current.weights[moved]).ravel()
        corners = self.surface.faces[current.face[moved]].ravel()
        return np.where(moved, self.mass, 0.0) - np.bincount(corners, weights=arrived, minlength=len(self.mass))

    def smoothed(self, slope: Floats) -> Floats:
        """Return the change of ψ that a slope asks for: the initial fit's matrix approximates the second derivative.

        Where the minima attract more mass than the map sends, ψ has to decrease, smoothly.
        """
        assert self._solver is not None
        return self._solver.solve(slope)


class TransportDual(MapDual):
    """The dual problem of a map to the sphere.

    Args:
        surface: the faces, V vertices.
        x: the x_i, unit vectors, shape [V, 3].
        y: the y_i, unit vectors, shape [V, 3].
        mass: the m_i, shape [V].
        device: where kernels run.

    Attributes:
        x, y: the points on the device.
        log: log_y(x) at every vertex, shape [V, 3].
        edge_terms: the quadratic terms of ψ on the edges of every triangle, vec3d, shape [F].
    """

    def __init__(self, surface: Surface, x: Floats, y: Floats, mass: Floats, device: str | None):
        self.device = resolve_device(device)
        self.surface, self.mass = surface, mass
        self.x, self.y = vectors(x, self.device), vectors(y, self.device)
        self.log = log_maps(y, x)
        self.cost = half_squares(x, y)
        self.edge_terms = vectors(edge_bulges(y[surface.faces], self.log[surface.faces]), self.device)
        # Triangles near each other in space next to each other in the tree.
        triangles, corners = trees.narrow_parts(y, surface.faces)
        order = trees.order_by_halves((corners @ y[surface.faces[triangles]]).mean(axis=1))
        leaves, samples = trees.leaf_count(len(order)), kernels.SAMPLES * len(order)
        tree = self._tree = kernels.Tree()
        tree.points, tree.faces, tree.edge = self.y, surface.on(self.device).faces, self.edge_terms
        tree.leaf_count, tree.triangles = leaves, sent(triangles[order].astype(np.int32), wp.int32, self.device)
        tree.corners = sent(corners[order], wp.mat33d, self.device)
        tree.places, tree.values = (wp.empty(samples, kind, device=self.device) for kind in (wp.vec3d, wp.float64))
        node = (wp.vec3d, wp.vec3d, kernels.vec11d)
        tree.centres, tree.axes, tree.models = (wp.empty(2 * leaves, kind, device=self.device) for kind in node)
        offsets, segments = trees.tree_segments(leaves)
        # The work of a node is in proportion to its leaves: every part of a launch gets nodes of all sizes.
        nodes, spread = (trees.interleaved(count, core_count()) for count in (2 * leaves, len(segments)))
        self._nodes, self._offsets = (sent(numbers, wp.int32, self.device) for numbers in (nodes, offsets))
        self._segments = sent(segments[spread], wp.vec2i, self.device)
        # Whether there are paraboloids: fitted to the first potential, and raised above a later one, they bound it too.
        self._fitted = False

    def admissible_differences(self) -> tuple[Floats, Floats]:
        """Return the least and the largest difference of ψ along every edge with which its ends swap no partners."""
        a, b = self.surface.edges.T
        x, y = self.x.numpy(), self.y.numpy()
        return self.cost[b] - half_squares(x[b], y[a]), half_squares(x[a], y[b]) - self.cost[a]

    def bound(self, potential: Floats) -> Bound:
        """Compute φ, the c-transform of ψ, at every x_i."""
        tree = self._tree
        tree.nodal = sent(potential, wp.float64, self.device)
        wp.launch(kernels.sample_triangles, dim=len(tree.triangles), outputs=[tree], device=self.device)
        if not self._fitted:
            launch_parts(kernels.fit_nodes, len(self._nodes), [Each(self._nodes)], [tree], self.device)
            self._fitted = True
        extremes = wp.empty(self._segments.size, dtype=kernels.vec6d, device=self.device)
        inputs = [self._offsets, Each(self._segments), tree]
        launch_parts(kernels.measure_segments, extremes.size, inputs, [extremes], self.device)
        inputs = [self._offsets, extremes]
        wp.launch(kernels.bound_nodes, dim=len(self._nodes), inputs=inputs, outputs=[tree], device=self.device)
        return self.bound_by(kernels.c_transform, potential, self.x, [self.tolerance, tree])


def log_maps(base: Floats, target: Floats) -> Floats:
    """Return log_y(x), tangent vectors at unit vectors y that point to others x and are as long as their distances."""
    towards = target - dots(base, target)[..., None] * base
    distance = np.sqrt(2.0 * half_squares(base, target))[..., None]
    return distance / np.maximum(norms(towards)[..., None], TINY) * towards


def half_squares(x: Floats, y: Floats) -> Floats:
    """Return the cost c(x, y), half the squared distances of unit vectors."""
    return 0.5 * np.arctan2(norms(cross(x, y)), dots(x, y)) ** 2


def edge_bulges(corners: Floats, logs: Floats) -> Floats:
    """Return the quadratic terms e of ψ on the edges (k, k+1) of triangles from its slopes -log at the corners, [F, 3].

    They are those that a quadratic of the distance along the edge has with these slopes, its two ends averaged.
    """
    others, theirs = np.roll(corners, -1, axis=1), np.roll(logs, -1, axis=1)
    ahead, back = log_maps(corners, others), log_maps(others, corners)
    return -0.5 * (dots(theirs, back) + dots(logs, ahead))


def edge_steps(surface: Surface, shift: NDArray) -> NDArray:
    """Return what is added to the second end of every edge in the cover of the first, shape [E, 2].

    Args:
        surface: E edges and F faces.
        shift: what is added at the corners of triangles, shape [F, 3, 2].
    """
    corner = surface.edge_corners[:, 0].astype(np.int64)
    face, place = corner // 3, corner % 3
    one, two = (place + 1) % 3, (place + 2) % 3
    steps = shift[face, two] - shift[face, one]
    return np.where((surface.faces[face, one] == surface.edges[:, 0])[:, None], steps, -steps)


class TorusDual(MapDual):
    """The dual problem of a map to a flat torus, with c = |x - y|²/2 in its universal cover.

    Args:
        surface: V vertices; their areas are the masses.
        x: the points that are transported, in the plane, shape [V, 2].
        y: their images in the universal cover, shape [V, 2].
        shift: what is added at the corners of triangles, shape [F, 3, 2].
        lattice: vectors that the torus repeats along, as rows, shape [2, 2].
    """

    def __init__(self, surface: Surface, x: Floats, y: Floats, shift: Floats, lattice: Floats):
        self.surface, self.mass, self._lattice = surface, surface.vertex_areas, lattice
        self._x, self._y, self._shift = x, y, shift
        moved = y - x
        self.cost = 0.5 * squared_norms(moved)
        back = np.linalg.inv(lattice)
        self._home = sent(x - np.floor(x @ back) @ lattice, wp.vec2d)
        corner = y[surface.faces] + shift
        middle = corner.mean(axis=1)
        corner -= (np.floor(middle @ back) @ lattice)[:, None]
        # Triangles near each other in the plane next to each other in the tree.
        self._order = trees.order_by_halves(np.concatenate([corner.mean(axis=1), np.zeros((len(corner), 1))], axis=1))
        corner = np.ascontiguousarray(corner[self._order])
        self._faces = surface.faces[self._order]
        slope = moved[self._faces]
        along = np.roll(corner, -1, axis=1) - corner
        # |z|²/2 - ψ(z) on an edge: the first is what it is, and ψ has the slopes y - x at the ends of the edge.
        bulges = -0.5 * squared_norms(along) - 0.5 * dots(slope - np.roll(slope, -1, axis=1), along)
        self._corners, self._bulges = sent(corner, wp.vec2d), sent(bulges, wp.vec3d)
        self._slopes = sent((corner - slope).mean(axis=1), wp.vec2d)
        self._half_squares = 0.5 * squared_norms(corner)
        self._leaves = trees.leaf_count(len(corner))

    def admissible_differences(self) -> tuple[Floats, Floats]:
        """Return the least and the largest difference of ψ along every edge with which its ends swap no partners."""
        a, b = self.surface.edges.T
        apart = edge_steps(self.surface, self._shift)
        along, across = self._y[b] - self._y[a] + apart, self._x[b] - self._x[a] + apart
        middle = 0.5 * dots(along, self._y[a] - self._x[a] + self._y[b] - self._x[b])
        half = 0.5 * dots(along, across)
        return middle - half, middle + half

    def bound(self, potential: Floats) -> Bound:
        """Compute φ at every x_i: the least of c(x_i, z) - ψ(z) over all of the torus."""
        mesh = [self._corners, sent(self._half_squares - potential[self._faces], wp.vec3d), self._bulges]
        nodes = wp.empty(2 * self._leaves, dtype=trees.vec7d, device="cpu")
        inputs = [*mesh, self._slopes, len(self._faces), self._leaves]
        wp.launch(trees.build_plane_nodes, dim=len(nodes), inputs=inputs, outputs=[nodes], device="cpu")
        inputs = [sent(self._copies(potential), wp.vec2d), *mesh, nodes, self._leaves, self.tolerance]
        found = self.bound_by(trees.best_images, potential, self._home, inputs)
        return replace(found, face=np.where(found.face >= 0, self._order[found.face], -1))

    def _copies(self, potential: Floats) -> Floats:
        """Return the lattice vectors that a best image may be shifted by, the shortest first, shape [N, 2]."""
        reach = float(np.sqrt(2.0 * (self.cost - potential + potential.max()).max()))  # nothing farther is better
        far = np.ceil(np.linalg.norm(np.linalg.inv(self._lattice), axis=0) * reach).astype(int) + 1
        steps = [(i, j) for i in range(-far[0], far[0] + 1) for j in range(-far[1], far[1] + 1)]
        vectors = np.array(steps) @ self._lattice
        return vectors[np.argsort(squared_norms(vectors), kind="stable")]
