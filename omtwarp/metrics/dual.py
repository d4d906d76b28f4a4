"""Kantorovich's dual problem of a map to a sphere or a torus: potentials, bounds on its cost, steps that raise them.

:mod:`omtwarp.metrics.optimality` explains the bound. It is a concave function of the potential, smooth but for kinks
where best images change triangles, and the matrix that a potential is fitted with approximates its second derivative.
With that matrix as the initial one, steps are those of limited-memory BFGS: pairs of steps and changes of the slope
correct it (Nocedal and Wright 2006, algorithm 7.4). On a cortex of 2,500 vertices seven bounds come as near as 28 with
steps along smoothed slopes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import sent, vectors
from omtwarp.device.policy import HEAVY_LAUNCH, SLOW_LAUNCH, resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import FIRST_THREAD, each, launch_parts, parts_of, run_all
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
    pace, stalled = 16.0, 2e-3
    pairs = _Pairs(dual)
    slope = dual.slope(best)
    excesses, done = [best.excess], 0
    while best.excess > enough and done < most:
        if notify is not None:
            notify(done, best)
        step = _step(dual, pairs, best, slope)
        if step is None:
            if not pairs.kept:
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
    length = first * best.excess / along if not pairs.kept else 1.0
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

    Attributes:
        kept: steps, changes of the slope and their products.
    """

    def __init__(self, dual: MapDual):
        self._smoothed = dual.smoothed
        # Most pairs, of steps and changes of the slope; 3 to 20 are usual (Nocedal and Wright 2006, chapter 7)
        self.kept: deque[tuple[Floats, Floats, float]] = deque(maxlen=10)
        self._scale = 1.0

    def add(self, step: Floats, change: Floats) -> None:
        """Add a step of the potential and how far the slope fell, unless its curvature is round-off."""
        product = float(step @ change)
        # Least curvature, s · y over |s| |y|: pairs with less are not kept, their curvature is round-off
        if product > 1e-12 * float(np.linalg.norm(step) * np.linalg.norm(change)):
            self.kept.append((step, change, product))
            self._scale = product / float(change @ self._smoothed(change))

    def direction(self, slope: Floats) -> Floats:
        """Return the change of the potential that a slope asks for, by the corrected matrix."""
        right, factors = slope.copy(), []
        for step, change, product in reversed(self.kept):
            factors.append(float(step @ right) / product)
            right -= factors[-1] * change
        out = self._smoothed(right) * self._scale
        for (step, change, product), factor in zip(self.kept, reversed(factors), strict=True):
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


class MapDual:
    """The dual problem of a map x_i -> y_i with masses m_i, on a sphere or, in its universal cover, on a flat torus.

    Args:
        surface: the faces and edges, V vertices; positions are not used.
        x: the x_i, unit vectors, or points of the plane with a third coordinate of zero, shape [V, 3].
        y: the y_i, in the same way.
        mass: the m_i, shape [V].
        device: where kernels run.
        shift: of a torus, what is added at the corners of triangles, shape [F, 3, 3].
        lattice: vectors that the torus repeats along, as rows, shape [2, 3].
        slopes: the gradient of ψ at the y_i, shape [V, 3]; -log_y(x) by default.

    Attributes:
        surface, mass: as given.
        cost: c(x_i, y_i), shape [V].
        edge_terms: what ψ on every triangle depends on besides its values at corners, e_k, s_k and t_k of
            :mod:`omtwarp.metrics.optimality_kernels`, vec3d, shape [F] each.
    """

    def __init__(
        self,
        surface: Surface,
        x: Floats,
        y: Floats,
        mass: Floats,
        device: str | None,
        shift: Floats | None = None,
        lattice: Floats | None = None,
        *,
        slopes: Floats | None = None,
    ):
        self.device = resolve_device(device)
        self.surface, self.mass, self._x, self._y, self._lattice = surface, mass, x, y, lattice
        self._apart = np.zeros(3) if shift is None else edge_steps(surface, shift)
        self.cost = self._costs(x, y)
        corners = y.take(surface.faces, axis=0) + (0.0 if shift is None else shift)
        slopes = (-self._logs(y, x) if slopes is None else slopes).take(surface.faces, axis=0)
        # Slopes of ψ along the edges (k, k+1) at both ends: by the length of the arc, which decide on ψ in the middle,
        # and half of those by the length of the edge, as places move along it.
        others, ends = np.roll(corners, -1, axis=1), np.roll(slopes, -1, axis=1)
        arcs = dots(slopes, self._logs(corners, others)), -dots(ends, self._logs(others, corners))
        first, last = 0.5 * dots(slopes, others - corners), 0.5 * dots(ends, others - corners)
        bulges = 0.5 * (arcs[0] - arcs[1])
        self.edge_terms = [vectors(term, self.device) for term in (bulges, first + last, first - last - bulges)]
        if lattice is None:
            triangles, parts = trees.narrow_parts(y, surface.faces)
        else:
            x = x - self._cells(x)
            corners = corners - self._cells(corners.mean(axis=1))[:, None]
            triangles, parts = np.arange(len(corners)), np.broadcast_to(np.eye(3), corners.shape)
        # Triangles near each other in space next to each other in the tree.
        order = trees.order_by_halves((parts @ corners.take(triangles, axis=0)).mean(axis=1))
        leaves, samples = trees.leaf_count(len(order)), kernels.SAMPLES * len(order)
        tree = self._tree = kernels.Tree()
        psi = tree.potential
        psi.flat, psi.images = lattice is not None, sent(corners, wp.mat33d, self.device)
        psi.edge, psi.mean, psi.bend = self.edge_terms
        psi.faces, tree.leaf_count = surface.on(self.device).faces, leaves
        tree.triangles = sent(triangles[order].astype(np.int32), wp.int32, self.device)
        tree.corners = sent(parts[order], wp.mat33d, self.device)
        tree.places, tree.values = (wp.empty(samples, kind, device=self.device) for kind in (wp.vec3d, wp.float64))
        tree.bulges = wp.empty(len(order), wp.float64, device=self.device)
        tree.centres, tree.axes = (wp.empty(2 * leaves, wp.vec3d, device=self.device) for _ in range(2))
        tree.models = wp.empty(2 * leaves, kernels.vec6d, device=self.device)
        self._fitted = False  # whether there are paraboloids, to the first potential; for others they are raised
        self._sources = vectors(x, self.device)
        self._solver: EdgeLaplacianSolver | None = None

    def _cells(self, points: Floats) -> Floats:
        """Return the vectors of the lattice from its first cell to those that hold points of the plane."""
        assert self._lattice is not None
        return np.floor(points @ np.linalg.pinv(self._lattice)) @ self._lattice

    def _logs(self, base: Floats, target: Floats) -> Floats:
        """Return the vectors that point from places to others and are as long as their distances."""
        return log_maps(base, target) if self._lattice is None else target - base

    def _costs(self, x: Floats, y: Floats) -> Floats:
        """Return the cost c, half the squared distances of places."""
        return half_squares(x, y) if self._lattice is None else 0.5 * squared_norms(x - y)

    def admissible_differences(self) -> tuple[Floats, Floats]:
        """Return the least and the largest difference of ψ along every edge with which its ends swap no partners."""
        a, b = self.surface.edges.T
        apart = self._apart
        (x_a, x_b), (y_a, y_b) = (points.take([a, b], axis=0) for points in (self._x, self._y))
        return self.cost[b] - self._costs(x_b + apart, y_a), self._costs(x_a, y_b + apart) - self.cost[a]

    def bound(self, potential: Floats) -> Bound:
        """Return the lower bound on the cost that a potential ψ gives, with its c-transform φ at every x_i."""
        tree, device, own = self._tree, self.device, self.cost - potential
        tree.potential.nodal = sent(potential, wp.float64, device)
        launch_parts(kernels.sample_triangles, len(tree.triangles), [FIRST_THREAD], [tree], device, HEAVY_LAUNCH)
        if not self._fitted:
            launch_parts(kernels.fit_nodes, len(tree.models) - 1, [FIRST_THREAD], [tree], device)
            self._fitted = True

        def raised(part: slice) -> wp.array:
            extremes = wp.full(len(tree.models), kernels.NOTHING, kernels.vec6d, device=device)
            inputs, count = [part.start, tree], part.stop - part.start
            wp.launch(kernels.raise_paraboloids, count, inputs, [extremes], device=device)
            return extremes

        tree.extremes, *others = run_all(raised, parts_of(len(tree.triangles), device, HEAVY_LAUNCH))
        for other in others:  # on the host alone
            np.maximum(tree.extremes.numpy(), other.numpy(), out=tree.extremes.numpy())
        lowest = [wp.empty(len(own), dtype=kind, device=device) for kind in (wp.float64, wp.int32, wp.vec3d)]
        inputs = [vectors(self._copies(own), device), self.tolerance, tree]
        inputs = [*each(self._sources, sent(own, wp.float64, device)), *inputs]
        launch_parts(kernels.c_transform, len(own), inputs, each(*lowest), device, SLOW_LAUNCH)
        proven, face, weights = (array.numpy() for array in lowest)
        gap = own - proven
        return Bound(potential, gap, float(self.mass @ gap), face.astype(np.int64), weights)

    def _copies(self, own: Floats) -> Floats:
        """Return the vectors of the lattice that a best image may be shifted by, the shortest first, shape [N, 3].

        Args:
            own: c(x_i, y_i) - ψ(y_i), the values to beat.
        """
        if self._lattice is None:
            return np.zeros((1, 3))
        reach = float(np.sqrt(2.0 * (own + (self.cost - own).max()).max()))  # nothing farther is better
        far = np.ceil(np.linalg.norm(np.linalg.pinv(self._lattice), axis=0) * reach).astype(int) + 1
        steps = [(i, j) for i in range(-far[0], far[0] + 1) for j in range(-far[1], far[1] + 1)]
        repeats = np.array(steps) @ self._lattice
        return repeats[np.argsort(squared_norms(repeats), kind="stable")]

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
        weights = current.weights[moved]
        if self._lattice is None:  # the cubic part is one of them, too
            after = np.roll(weights, -1, axis=1)
            cubic = weights * after * (weights - after)
            weights = weights + cubic - np.roll(cubic, 1, axis=1)
        arrived = (self.mass[moved][:, None] * weights).ravel()
        corners = self.surface.faces[current.face[moved]].ravel()
        return np.where(moved, self.mass, 0.0) - np.bincount(corners, weights=arrived, minlength=len(self.mass))

    def smoothed(self, slope: Floats) -> Floats:
        """Return the change of ψ that a slope asks for: the initial fit's matrix approximates the second derivative.

        Where the minima attract more mass than the map sends, ψ has to decrease, smoothly.
        """
        assert self._solver is not None
        return self._solver.solve(slope)


def log_maps(base: Floats, target: Floats) -> Floats:
    """Return log_y(x), tangent vectors at unit vectors y that point to others x and are as long as their distances."""
    towards = target - dots(base, target)[..., None] * base
    distance = np.sqrt(2.0 * half_squares(base, target))[..., None]
    return distance / np.maximum(norms(towards)[..., None], TINY) * towards


def half_squares(x: Floats, y: Floats) -> Floats:
    """Return the cost c(x, y), half the squared distances of unit vectors."""
    return 0.5 * np.arctan2(norms(cross(x, y)), dots(x, y)) ** 2


def edge_steps(surface: Surface, shift: NDArray) -> NDArray:
    """Return what is added to the second end of every edge in the cover of the first, shape [E, 2] or [E, 3].

    Args:
        surface: E edges and F faces.
        shift: what is added at the corners of triangles, shape [F, 3, 2] or [F, 3, 3].
    """
    corner = surface.edge_corners[:, 0].astype(np.int64)
    face, place = corner // 3, corner % 3
    one, two = (place + 1) % 3, (place + 2) % 3
    steps = shift[face, two] - shift[face, one]
    return np.where((surface.faces[face, one] == surface.edges[:, 0])[:, None], steps, -steps)
