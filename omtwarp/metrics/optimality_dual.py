"""Kantorovich's dual on a device: potentials from a map, their c-transform, and steps that improve them.

:mod:`omtwarp.metrics.optimality` explains the bound. For shrunken limbs the potential is at the points that are
transported: where the conformal map shrinks limbs to points, much of the mass lies on a few points x, each of which is
spread over the whole image of a limb (semi-discrete transport). There every image is as good as every other for such a
point, so that ψ has to be c(x, ·) up to a constant all over the limb's image. A potential that is fitted at the images
is far from that. With φ given at the x_j in place of ψ, and

    ψ(y_i) = min over j of c(x_j, y_i) - φ(x_j),

it is so by itself, and φ has one unknown for a whole limb. The bound Σ m_i (φ(x_i) + ψ(y_i)) is concave in φ, its slope
the mass of x_j less that of the images whose minimum is at x_j (Kitagawa, Mérigot and Thibert 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import Each, core_count, each, launch_parts
from omtwarp.geometry.space_order import in_strips
from omtwarp.mesh.arrays import Floats, Ints
from omtwarp.mesh.surface import Surface
from omtwarp.metrics import optimality_kernels as kernels
from omtwarp.solvers.poisson import EdgeLaplacianSolver

TOLERANCE = 1e-5
"""How far below the true minimum, in units of the mean cost, the search for it may stay: what it adds to the gap."""

LONGEST = 0.25
"""Longest edge of a leaf of the tree, an arc: bounds of nodes err by the third power of their radii."""


@dataclass(frozen=True)
class Bound:
    """A potential and its c-transform.

    Attributes:
        potential: ψ at the y_i, float64, shape [V].
        vertex_gap: c(x_i, y_i) - ψ(y_i) - φ(x_i), never negative, float64, shape [V].
        excess: Σ m_i vertex_gap_i.
        face: the triangle in which the minimum is attained, shape [V]; -1 where that is y_i itself.
        weights: its barycentric coordinates there, shape [V, 3].
        visited: nodes of the tree that were examined, shape [V].
    """

    potential: Floats
    vertex_gap: Floats
    excess: float
    face: NDArray[np.int64]
    weights: Floats
    visited: Ints


@dataclass(frozen=True)
class SharedSources:
    """Points that stand for others so close that their transforms are nearly the same.

    Attributes:
        chosen: the points that stand for others and themselves, shape [N].
        of: which of these stands for each point, shape [V].
        lowered: how much the transform of a point can lie below that of its stand-in, shape [V].
    """

    chosen: NDArray[np.intp]
    of: NDArray[np.intp]
    lowered: Floats

    def spread(
        self, own: Floats, proven: Floats, face: NDArray[np.int64], weights: Floats, visited: Ints, surface: Surface
    ) -> tuple[Floats, NDArray[np.int64], Floats, Ints]:
        """Return bounds, triangles, weights and visits of all points from those of the chosen; ``own`` is of all."""
        everywhere = np.minimum(proven[self.of] - self.lowered, own)
        triangle, share, least = face[self.of], weights[self.of].copy(), own[self.chosen]
        # Where a stand-in's best image is its own, that is a corner of a triangle for the others.
        corner = np.empty(surface.vertex_count, dtype=np.int64)
        corner[surface.faces.ravel()] = np.arange(surface.faces.size)
        at = corner[self.chosen][self.of]
        others = (triangle < 0) & (own > least[self.of] + self.lowered)
        triangle[others] = at[others] // 3
        share[others] = np.eye(3)[at[others] % 3]
        # A point's own image is as good as any that lowers the value by less than rounding of the points could.
        triangle[own - self.lowered <= proven[self.of]] = -1
        counted = np.zeros(len(own), dtype=np.int32)
        counted[self.chosen] = visited
        return everywhere, triangle, share, counted


@dataclass(frozen=True)
class Spread:
    """Integrals over the triangles at the x_i, the masses spread over them.

    Attributes:
        cost: of c(x, y), y the map between the vertices too.
        transform: of φ.
    """

    cost: float
    transform: float


class TransportDual:
    """The dual problem of a map x_i -> y_i with masses m_i.

    Args:
        surface: the faces, V vertices; positions are not used.
        x: the x_i, unit vectors, shape [V, 3].
        y: the y_i, unit vectors, shape [V, 3].
        mass: the m_i, shape [V].
        device: where kernels run.
        tolerance: see ``TOLERANCE``.

    Attributes:
        x, y: the points on the device.
        log: log_y(x) at every vertex, shape [V, 3].
        cost: c(x_i, y_i), shape [V].
        shared: the points that stand for others; None where few are so close.
    """

    def __init__(
        self, surface: Surface, x: Floats, y: Floats, mass: Floats, device: str | None, tolerance: float = TOLERANCE
    ):
        self.device = resolve_device(device)
        self.surface, self.mass = surface, mass
        self.x, self.y = vectors(x, self.device), vectors(y, self.device)
        vertices, faces = surface.vertex_count, surface.face_count
        displaced = wp.empty(vertices, dtype=wp.vec3d, device=self.device)
        self._launch(kernels.vertex_displacement, vertices, [self.y, self.x], [displaced])
        self.log: Floats = displaced.numpy()
        self.cost: Floats = 0.5 * (self.log**2).sum(axis=1)
        self.tolerance = tolerance * float(mass @ self.cost) / float(mass.sum())
        # Triangles near each other in space next to each other in the tree.
        triangles, corners = narrow_parts(y, surface.faces)
        order = order_by_halves((corners @ y[surface.faces[triangles]]).mean(axis=1))
        self._parts = [
            wp.array(triangles[order], dtype=wp.int32, device=self.device),
            wp.array(corners[order], dtype=wp.mat33d, device=self.device),
        ]
        self._faces = wp.array(surface.faces, dtype=wp.vec3i, device=self.device)
        self._edge = wp.empty(faces, dtype=wp.vec3d, device=self.device)
        self._launch(kernels.edge_bulges, faces, [self.y, self._faces, displaced], [self._edge])
        self._leaves = leaf_count(len(order))
        offsets, segments = tree_segments(self._leaves)
        # The work of a node is in proportion to its leaves: every part of a launch gets nodes of all sizes.
        nodes, spread = (_interleaved(count, core_count()) for count in (2 * self._leaves, len(segments)))
        self._nodes = wp.array(nodes, dtype=wp.int32, device=self.device)
        self._segments = wp.array(segments[spread], dtype=wp.vec2i, device=self.device)
        self._offsets = wp.array(offsets, dtype=wp.int32, device=self.device)
        # Where the conformal map shrinks limbs to points, all points of a limb have nearly the same transform, and all
        # of its image is a candidate for each: 8,000 nodes of the tree where others take 200. The transform is then
        # computed once for the points in each cube of this side, in units of the tolerance, and lowered for the others
        # by what it can differ, at most 0.43 of the tolerance. For a person of 27,000 vertices that takes a third of
        # the time.
        self.shared = shared_sources(x, surface.edges, 0.05 * self.tolerance)
        self._solver: EdgeLaplacianSolver | None = None

    @property
    def edge_terms(self) -> Floats:
        """The quadratic terms of ψ on the edges of every triangle, shape [F, 3]."""
        return self._edge.numpy()

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

    def admissible_differences(self, of_sources: bool = False) -> tuple[Floats, Floats]:
        """Return the least and the largest difference of ψ along every edge with which its ends do not swap partners.

        Args:
            of_sources: return those of φ, which belongs to the x_i.
        """
        edges = self.surface.edges
        ends = wp.array(edges, dtype=wp.vec2i, device=self.device)
        low, high = (wp.empty(len(edges), dtype=wp.float64, device=self.device) for _ in range(2))
        pair = [self.y, self.x] if of_sources else [self.x, self.y]
        self._launch(kernels.admissible_differences, len(edges), [*pair, ends], [low, high])
        return low.numpy(), high.numpy()

    def bound(self, potential: Floats) -> Bound:
        """Compute φ, the c-transform of ψ, at every x_i."""
        parts, nodes = len(self._parts[0]), 2 * self._leaves
        nodal = wp.array(potential, dtype=wp.float64, device=self.device)
        mesh = [self.y, self._faces, nodal, self._edge, *self._parts]
        places = wp.empty(kernels.SAMPLES * parts, dtype=wp.vec3d, device=self.device)
        values = wp.empty(kernels.SAMPLES * parts, dtype=wp.float64, device=self.device)
        self._launch(kernels.sample_triangles, parts, mesh, [places, values])
        node = (wp.vec3d, wp.vec3d, kernels.vec11d)
        tree = [wp.empty(nodes, dtype=kind, device=self.device) for kind in node]
        samples = [places, values, parts, self._leaves]
        extremes = wp.empty(self._segments.size, dtype=kernels.vec6d, device=self.device)
        launch_parts(kernels.fit_nodes, nodes, [*samples, Each(self._nodes)], tree, self.device)
        inputs = [*samples, *tree, self._offsets, Each(self._segments)]
        launch_parts(kernels.measure_segments, extremes.size, inputs, [extremes], self.device)
        self._launch(kernels.bound_nodes, nodes, [self._offsets, extremes], [tree[2]])
        own = self.cost - potential
        asked = slice(None) if self.shared is None else self.shared.chosen
        sources, seeds = (
            wp.array(values[asked], dtype=kind, device=self.device)
            for values, kind in ((self.x.numpy(), wp.vec3d), (own, wp.float64))
        )
        minimum = (wp.float64, wp.int32, wp.vec3d, wp.int32)
        lowest = [wp.empty(len(seeds), dtype=kind, device=self.device) for kind in minimum]
        inputs = [*each(sources, seeds), *mesh, places, values, self._leaves, self.tolerance, *tree]
        # Points whose transforms are worth a launch of their own on another core: each takes 10 microseconds.
        launch_parts(kernels.c_transform, len(seeds), inputs, each(*lowest), self.device, 128)
        proven, face, weights, visited = (array.numpy() for array in lowest)
        if self.shared is not None:
            proven, face, weights, visited = self.shared.spread(own, proven, face, weights, visited, self.surface)
        gap = own - proven
        return Bound(potential, gap, float(self.mass @ gap), face.astype(np.int64), weights, visited)

    def flatten(self) -> None:
        """Make ψ linear on every triangle from now on, which suits potentials that the map did not give."""
        self._edge.zero_()

    @property
    def shrunken(self) -> bool:
        """Whether many of the x_i are so close to others that their transforms are computed once for all of them."""
        return self.shared is not None

    def slope(self, current: Bound) -> Floats:
        """Return the derivative of Σ m_i (φ(x_i) + ψ(y_i)) by ψ: the map's own mass less the mass at the minimisers."""
        return missing_mass(self.mass, current.face, self.surface.faces, current.weights)

    def smoothed(self, slope: Floats) -> Floats:
        """Return the change of ψ that a slope asks for: the initial fit's matrix approximates the second derivative.

        Where the minima attract more mass than the map sends, ψ has to decrease, smoothly.
        """
        assert self._solver is not None
        return self._solver.solve(slope)

    def integral(self, potential: Floats) -> float:
        """Integrate ψ over the sphere: the mean of a quadratic on every triangle, times its solid angle."""
        a, b, c = self.y.numpy()[self.surface.faces.T]
        triple = np.einsum("ij,ij->i", a, np.cross(b, c))
        solid = 2.0 * np.arctan2(triple, 1.0 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1))
        return float(solid @ quadratic_means(potential, self.surface.faces, self.edge_terms))

    def spread(self, transform: Floats) -> Spread:
        """Integrate the cost and its dual φ, given at the x_i, shape [V], over the triangles that carry the masses.

        A triangle carries its share of the masses of its corners. Along an edge φ is the quadratic with the slopes
        -log_x(y) at both ends, as ψ is.
        """
        surface = self.surface
        count, corners = surface.face_count, surface.faces
        faces = surface.on(self.device).faces
        displaced = wp.empty(surface.vertex_count, dtype=wp.vec3d, device=self.device)
        bulges = wp.empty(count, dtype=wp.vec3d, device=self.device)
        means = wp.empty(count, dtype=wp.float64, device=self.device)
        self._launch(kernels.vertex_displacement, surface.vertex_count, [self.x, self.y], [displaced])
        self._launch(kernels.edge_bulges, count, [self.x, faces, displaced], [bulges])
        self._launch(kernels.triangle_costs, count, [self.x, self.y, faces], [means])
        masses = surface.face_areas * (self.mass / surface.vertex_areas)[corners].mean(axis=1)
        duals = quadratic_means(transform, corners, bulges.numpy())
        return Spread(float(masses @ means.numpy()), float(masses @ duals))

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[object], outputs: list[object]) -> None:
        wp.launch(kernel, dim=count, inputs=inputs, outputs=outputs, device=self.device)


def shared_sources(points: Floats, edges: Ints, side: float) -> SharedSources | None:
    """Choose one point in each cube of a grid to stand for the others there; None where few points are so close.

    Args:
        points: on the sphere, shape [V, 3].
        edges: of the mesh, shape [E, 2].
        side: of a cube.
    """
    if not side > 0.0:
        return None
    short = np.abs(points[edges[:, 0]] - points[edges[:, 1]]).max(axis=1) < side
    # Min shared, of the edges shorter than the cube, below which there is little to share
    if short.mean() < 0.05:
        return None
    cells = np.floor(points / side)
    _, chosen, of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    of = of.reshape(-1)
    apart = np.linalg.norm(points - points[chosen[of]], axis=1)
    # The gradient of half the squared distance is at most π long; arcs are at most π/2 times as long as chords.
    return SharedSources(chosen, of, 0.5 * np.pi**2 * apart)


def missing_mass(mass: Floats, triangle: NDArray[np.integer], faces: Ints, shares: Floats) -> Floats:
    """Return the mass that the map sends to every vertex less the mass of the points whose best image is there.

    Args:
        mass: of the points, shape [V].
        triangle: the one that the best image of a point lies in, shape [V]; -1 where that is its own image.
        faces: vertices of the triangles, shape [F, 3].
        shares: barycentric coordinates of the best images, shape [V, 3].
    """
    moved = triangle >= 0
    gone = mass[moved]
    arrived = (gone[:, None] * shares[moved]).ravel()
    corners = faces[triangle[moved]].ravel()
    return np.where(moved, mass, 0.0) - np.bincount(corners, weights=arrived, minlength=len(mass))


def quadratic_means(nodal: Floats, corners: Ints, edge_terms: Floats) -> Floats:
    """Return the mean over every triangle of the quadratic w0 f0 + w1 f1 + w2 f2 + Σ w_k w_(k+1) e_k, shape [F].

    Args:
        nodal: the f, values at vertices, shape [V].
        corners: vertices of the triangles, shape [F, 3].
        edge_terms: the e, shape [F, 3]; the mean of a product of two barycentric coordinates is 1/12.
    """
    return nodal[corners].mean(axis=1) + edge_terms.sum(axis=1) / 12.0


def narrow_parts(points: Floats, faces: Ints) -> tuple[NDArray[np.int64], Floats]:
    """Cut triangles of a sphere in strips along their shortest edge until no edge is longer than ``LONGEST``.

    Args:
        points: unit vectors, shape [V, 3].
        faces: shape [F, 3].

    Returns:
        The triangle that every part is of, shape [P], and the parts' corners in barycentric coordinates there, shape
        [P, 3, 3].
    """
    triangles, corners = np.arange(len(faces)), np.broadcast_to(np.eye(3), (len(faces), 3, 3))
    finished: list[tuple[NDArray[np.int64], Floats]] = []
    # Rounds: two cut a triangle both ways, others what is uneven; more need ends of edges that are nearly opposite
    for _ in range(8):
        places = corners @ points[faces[triangles]]
        places /= np.maximum(np.linalg.norm(places, axis=2), np.finfo(float).tiny)[:, :, None]
        arcs = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(places - np.roll(places, -1, axis=1), axis=2), 1.0))
        long = arcs.max(axis=1) > LONGEST
        finished.append((triangles[~long], corners[~long]))
        triangles, corners = triangles[long], corners[long]
        if len(triangles) == 0:
            break
        arc = arcs[long].max(axis=1)
        counts = np.ceil(arc / LONGEST).astype(np.int64)
        step = arc / counts

        def equal_arcs(strip: NDArray[np.int64], of: NDArray[np.intp], counts=counts, step=step) -> Floats:
            ahead, behind = np.sin(strip * step[of]), np.sin((counts[of] - strip) * step[of])
            return ahead / np.maximum(ahead + behind, np.finfo(float).tiny)

        of, corners = in_strips(corners, arcs[long].argmin(axis=1), counts, equal_arcs)
        triangles = triangles[of]
    finished.append((triangles, corners))
    return np.concatenate([part for part, _ in finished]), np.concatenate([part for _, part in finished])


def order_by_halves(points: Floats) -> Ints:
    """Order points so that those below each node of a complete binary tree in heap order lie close together.

    Each node's points are halved along the longest side of their bounding box. Along Hilbert's curve
    (:mod:`omtwarp.geometry.space_order`) halves lie less close: transforms then examine 1.5 to 1.6 times as many nodes,
    and a bound takes 1.2 to 1.5 times as long, on a blob and on a statue of 20,000 faces, with the same gap to 1e-6.

    Args:
        points: shape [N, 3].

    Returns:
        The order, shape [N]; the order's first N leaves of 2^k, the least such number that is at least N, are taken.
    """
    order = wp.array(np.arange(len(points), dtype=np.int32), device="cpu")
    places = wp.array(points, dtype=wp.vec3d, device="cpu")
    size = leaf_count(len(points))
    while size > 1:
        inputs = [places, size]
        wp.launch(
            kernels.split_segments, dim=(-(-len(points) // size), 1), inputs=inputs, outputs=[order], device="cpu"
        )
        size //= 2
    return order.numpy()


def _interleaved(count: int, parts: int) -> Ints:
    """Return the numbers below ``count``, first every ``parts``-th one, then those that follow them, and so on."""
    return np.concatenate([np.arange(first, count, parts, dtype=np.int32) for first in range(parts)])


def tree_segments(leaves: int) -> tuple[Ints, Ints]:
    """Cut the leaves below every node of a complete binary tree in heap order into segments.

    Args:
        leaves: a power of two.

    Returns:
        The first segment of every node, and the number of all segments at the end, shape [2 leaves + 1]; and of every
        segment its node and its number there, shape [S, 2].
    """
    nodes = np.arange(2 * leaves)
    below = leaves >> np.frexp(np.maximum(nodes, 1))[1] - 1
    counts = np.maximum(below // int(kernels.SEGMENT), 1)
    counts[0] = 1  # no node
    offsets = np.concatenate([[0], np.cumsum(counts)])
    node = np.repeat(nodes, counts)
    segments = np.stack([node, np.arange(len(node)) - offsets[node]], axis=1)
    return offsets.astype(np.int32), segments.astype(np.int32)


def leaf_count(items: int) -> int:
    """Return the smallest power of two that is at least 2 and at least ``items``."""
    return 1 << max(items - 1, 1).bit_length()


# Sources that are left out or looked at together: with 6,900 of them and 16,600 images a search takes 0.06 to 0.1 CPU
# seconds, a third of what it takes one by one.
BLOCK = 16


@dataclass(frozen=True)
class SourceBound:
    """A potential at the x_i, and the largest one at the y_i that goes with it.

    Attributes:
        potential: φ(x_i), shape [V].
        at_images: ψ(y_i), shape [V].
        excess: Σ m_i (c(x_i, y_i) - φ(x_i) - ψ(y_i)), never negative.
        nearest: which stand-in attains the minimum at every image, shape [V].
    """

    potential: Floats
    at_images: Floats
    excess: float
    nearest: NDArray[np.int64]


class SourceDual:
    """The dual problem of a map, as a function of φ at the points that it moves.

    Args:
        dual: the problem.
    """

    def __init__(self, dual: TransportDual):
        x, shared, count = dual.x.numpy(), dual.shared, len(dual.mass)
        self._dual = dual
        self._lowered = np.zeros(count) if shared is None else shared.lowered
        chosen = np.arange(count) if shared is None else shared.chosen
        order = order_by_halves(x[chosen])
        self._chosen = chosen[order]
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        self._of = place if shared is None else place[shared.of]
        sources = x[self._chosen]
        self._first = np.arange(0, len(sources), BLOCK)
        sizes = np.diff(np.r_[self._first, len(sources)])
        centres = np.add.reduceat(sources, self._first) / sizes[:, None]
        apart = np.linalg.norm(sources - np.repeat(centres, sizes, axis=0), axis=1)
        self._sources, self._centres = vectors(sources, dual.device), vectors(centres, dual.device)
        self._radii = wp.array(np.maximum.reduceat(apart, self._first), dtype=wp.float64, device=dual.device)
        ends = x[dual.surface.edges]
        # The second derivative of the bound couples neighbours x_a and x_b by the length of the border between their
        # images over |x_a - x_b|. Distances are at least this, in radians: after ten steps on an octopus the gap is
        # 0.61 % with this and with a tenth of it, 0.63 % with ten times as much; with the weights that ψ is fitted with
        # it is above 3 % after 40.
        weights = 1.0 / np.maximum(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), 1e-5)
        self._solver = EdgeLaplacianSolver(dual.surface, weights / weights.mean())

    def initial_potential(self) -> Floats:
        """Fit φ to the middles of the differences along edges with which neither end would swap partners, shape [V]."""
        low, high = self._dual.admissible_differences(of_sources=True)
        return self._solver.fit(0.5 * (low + high))

    def bound(self, potential: Floats) -> SourceBound:
        """Compute the largest ψ that goes with φ, shape [V], after points were raised to what their stand-in allows.

        With it φ(x_j) + ψ(y_i) <= c(x_j, y_i) for all i and j, whatever φ is.
        """
        dual, count = self._dual, len(potential)
        # c of a point is less than that of its stand-in by ``lowered`` at most.
        values = np.full(len(self._chosen), -np.inf)
        np.maximum.at(values, self._of, potential + self._lowered)
        potential = values[self._of] - self._lowered
        highest = np.maximum.reduceat(values, self._first)
        of_sources = [wp.array(array, dtype=wp.float64, device=dual.device) for array in (values, highest)]
        given = [BLOCK, self._sources, of_sources[0], self._centres, self._radii, of_sources[1]]
        seeds = wp.array(dual.cost - potential, dtype=wp.float64, device=dual.device)
        lowest = [wp.empty(count, dtype=kind, device=dual.device) for kind in (wp.float64, wp.int32)]
        launch_parts(kernels.largest_potentials, count, [*each(dual.y, seeds), *given], each(*lowest), dual.device)
        at_images, nearest = (array.numpy() for array in lowest)
        excess = float(dual.mass @ (dual.cost - potential - at_images))
        return SourceBound(potential, at_images, excess, np.where(nearest < 0, self._of, nearest))

    def slope(self, current: SourceBound) -> Floats:
        """Return the derivative of the bound by φ: the mass of each stand-in less that of the images nearest to it."""
        count = len(self._chosen)
        out = np.zeros(len(self._dual.mass))
        masses = np.bincount(self._of, self._dual.mass, count)
        out[self._chosen] = masses - np.bincount(current.nearest, self._dual.mass, count)
        return out

    def smoothed(self, slope: Floats) -> Floats:
        """Return the change of φ that a slope asks for, the same for all points of a stand-in."""
        mass, count = self._dual.mass, len(self._chosen)
        means = np.bincount(self._of, mass * self._solver.solve(slope), count) / np.bincount(self._of, mass, count)
        return means[self._of]
