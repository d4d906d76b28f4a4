"""How far a map to a flat torus is from optimal: the remaining curl, and a lower bound on the cost.

The method is that of :mod:`omtwarp.metrics.optimality` on the sphere. The displacement y - x of an optimal map is a
gradient in the image. For any periodic function ψ, with φ(x) = min over z of |x - z|²/2 - ψ(z), every plan that takes
{x_i, m_i} to {y_i, m_i} costs at least 2 Σ m_i (φ(x_i) + ψ(y_i)). ψ is fitted to the displacements along edges and
improved by steps that raise the bound; on each image triangle it is quadratic, and z runs over all of them: in a plane
the least value on a triangle is found exactly, and a branch of triangles is skipped only where it is proven not to
contain it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import sent
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads, each, launch_parts
from omtwarp.mesh.arrays import TINY, Floats, Ints
from omtwarp.mesh.surface import SPHERE_AREA, Surface, plane_areas
from omtwarp.metrics.ascent import ascend
from omtwarp.metrics.optimality import ASCENT_STEPS, GOOD_ENOUGH
from omtwarp.metrics.optimality_dual import TOLERANCE, leaf_count, missing_mass, order_by_halves
from omtwarp.solvers.mesh_factor import MeshFactor, surface_factor
from omtwarp.torus.optimality_kernels import best_images, build_plane_nodes, vec7d

NARROWEST = 1e-3  # of an edge's lengths and of the median interval: turned triangles make empty ones


@dataclass(frozen=True)
class TorusOptimality:
    """How far a map to a torus is from optimal.

    Attributes:
        relative_curl: norm of the part of y - x that is no gradient, over the norm of y - x; 0 for an optimal map.
        cost: Σ m |y - x|², with masses 4π and a torus of area 4π.
        lower_bound: a lower bound on the cost of every rearrangement, same unit.
        gap: cost / lower_bound - 1.
        wrapped: vertices that a copy of their image is nearer to; none for an optimal map.
        ascent_steps: improvements of the potential that were made.
    """

    relative_curl: float
    cost: float
    lower_bound: float
    gap: float
    wrapped: int
    ascent_steps: int

    def to_dict(self) -> dict[str, float | None]:
        """Convert to plain values ready for JSON, with None for one that is not finite."""
        return {name: value if np.isfinite(value) else None for name, value in vars(self).items()}


@blas_threads(1)
def torus_optimality(surface: Surface, x: Floats, y: Floats, shift: Floats, lattice: Floats) -> TorusOptimality:
    """Measure how far a map to a torus of area 4π is from optimal.

    Args:
        surface: V vertices; their areas are the masses.
        x: the points that are transported, in the plane, shape [V, 2].
        y: their images in the universal cover, shape [V, 2].
        shift: what is added at the corners of triangles, shape [F, 3, 2].
        lattice: vectors that the torus repeats along, as rows, shape [2, 2].
    """
    moved = y - x
    cost = float(surface.vertex_areas @ (moved**2).sum(axis=1))
    curl = _relative_curl(surface, y[surface.faces] + shift, moved)
    dual = _Dual(surface, x, y, shift, lattice)
    best, taken = ascend(dual, dual.bound(dual.fitted()), ASCENT_STEPS, 0.5 * GOOD_ENOUGH * cost)
    lower = max(cost - 2.0 * best.excess, 0.0)
    gap = cost / lower - 1.0 if lower > 0.0 else (0.0 if cost == 0.0 else float("inf"))
    steps = np.array([(i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)]) @ lattice
    other = ((moved[:, None] + steps) ** 2).sum(axis=2).min(axis=1)
    # As many lattices are symmetric, two ways may be equally long but for rounding.
    wrapped = int((other < (moved**2).sum(axis=1) * (1.0 - 1e-9)).sum())
    return TorusOptimality(curl, cost, lower, gap, wrapped, taken)


def _edge_ends(surface: Surface, shift: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Return the ends of the edges, and what is added to the second one in the cover of the first, shape [E, 2]."""
    corner = surface.edge_corners[:, 0].astype(np.int64)
    face, place = corner // 3, corner % 3
    one, two = (place + 1) % 3, (place + 2) % 3
    a, b = surface.faces[face, one].astype(np.int64), surface.faces[face, two].astype(np.int64)
    apart = shift[face, two] - shift[face, one]
    turned = a > b
    a, b = np.where(turned, b, a), np.where(turned, a, b)
    apart[turned] *= -1.0
    return a, b, apart


def _factorise(factor: MeshFactor, diagonal: Floats, off_diagonal: Floats) -> None:
    """Factorise a graph Laplacian with one vertex fixed, which takes the constants out, and made definite."""
    held = diagonal * (1.0 + 1e-12)
    held[0] *= 2.0
    factor.factorise(held, off_diagonal)


@dataclass(frozen=True)
class _Bound:
    """A potential at the images, and the best image of every point under it.

    Attributes:
        potential: ψ at the y_i, shape [V].
        excess: Σ m_i (|x_i - y_i|²/2 - ψ(y_i) - φ(x_i)), never negative.
        leaf: the triangle that the best image of x_i lies in, in the tree's order, shape [V]; -1 where that is y_i.
        shares: its barycentric coordinates there, shape [V, 3].
    """

    potential: Floats
    excess: float
    leaf: Ints
    shares: Floats


class _Dual:
    """Kantorovich's dual problem of a map to a torus.

    Args:
        surface, x, y, shift, lattice: as of :func:`torus_optimality`.
    """

    def __init__(self, surface: Surface, x: Floats, y: Floats, shift: Floats, lattice: Floats):
        self.surface, self.mass, self.lattice = surface, surface.vertex_areas, lattice
        moved = y - x
        self.own = 0.5 * (moved**2).sum(axis=1)
        self.tolerance = TOLERANCE * float(self.mass @ self.own) / float(self.mass.sum())
        back = np.linalg.inv(lattice)
        self._home = sent(x - np.floor(x @ back) @ lattice, wp.vec2d)
        corner = y[surface.faces] + shift
        middle = corner.mean(axis=1)
        corner -= (np.floor(middle @ back) @ lattice)[:, None]
        # Triangles near each other in the plane next to each other in the tree.
        self._order = order_by_halves(np.concatenate([corner.mean(axis=1), np.zeros((len(corner), 1))], axis=1))
        self._corner = np.ascontiguousarray(corner[self._order])
        self._faces = surface.faces[self._order]
        slope = moved[self._faces]
        along = np.roll(self._corner, -1, axis=1) - self._corner
        # |z|²/2 - ψ(z) on an edge: the first is what it is, and ψ has the slopes y - x at the ends of the edge.
        bulges = -0.5 * (along**2).sum(axis=2) - 0.5 * ((slope - np.roll(slope, -1, axis=1)) * along).sum(axis=2)
        self._bulges = sent(bulges, wp.vec3d)
        self._corners = sent(self._corner, wp.vec2d)
        self._slopes = sent((self._corner - slope).mean(axis=1), wp.vec2d)
        self._half_squares = 0.5 * (self._corner**2).sum(axis=2)
        self._leaves = leaf_count(len(corner))
        self._fit = _EdgeFit(surface, x, y, shift)

    def fitted(self) -> Floats:
        """Fit the potential ψ to the displacements along edges."""
        return self._fit.solve(self._fit.flow)

    def bound(self, potential: Floats) -> _Bound:
        """Return the best image of every point, over all of the torus."""
        count = len(self.own)
        mesh = [self._corners, sent(self._half_squares - potential[self._faces], wp.vec3d), self._bulges]
        nodes = wp.empty(2 * self._leaves, dtype=vec7d, device="cpu")
        inputs = [*mesh, self._slopes, len(self._faces), self._leaves]
        wp.launch(build_plane_nodes, dim=len(nodes), inputs=inputs, outputs=[nodes], device="cpu")
        own = self.own - potential
        seeds, copies = sent(own, wp.float64), sent(self._copies(potential), wp.vec2d)
        found = [wp.empty(count, dtype=kind, device="cpu") for kind in (wp.float64, wp.int32, wp.vec3d)]
        inputs = [*each(self._home, seeds), copies, *mesh, nodes, self._leaves, self.tolerance]
        launch_parts(best_images, count, inputs, each(*found), wp.get_device("cpu"))
        proven, leaf, shares = (array.numpy() for array in found)
        return _Bound(potential, float(self.mass @ (own - proven)), leaf, shares)

    def slope(self, current: _Bound) -> Floats:
        """Return the derivative of the bound by ψ: a vertex's mass less that of the points with best images there."""
        return missing_mass(self.mass, current.leaf, self._faces, current.shares)

    def smoothed(self, slope: Floats) -> Floats:
        """Return the change of ψ that a slope asks for, by the matrix of the fit."""
        return self._fit.solve(slope)

    def _copies(self, potential: Floats) -> Floats:
        """Return the lattice vectors that a best image may be shifted by, the shortest first, shape [N, 2]."""
        reach = float(np.sqrt(2.0 * (self.own - potential + potential.max()).max()))  # nothing farther is better
        far = np.ceil(np.linalg.norm(np.linalg.inv(self.lattice), axis=0) * reach).astype(int) + 1
        steps = [(i, j) for i in range(-far[0], far[0] + 1) for j in range(-far[1], far[1] + 1)]
        vectors = np.array(steps) @ self.lattice
        return vectors[np.argsort((vectors**2).sum(axis=1), kind="stable")]


class _EdgeFit:
    """The least-squares problem for ψ, whose matrix also approximates the second derivative of the bound.

    On each edge the target of ψ's difference is the middle of the interval in which swapping partners gains nothing;
    the weight is one over the width of that interval.
    """

    def __init__(self, surface: Surface, x: Floats, y: Floats, shift: Floats):
        a, b, apart = _edge_ends(surface, shift)
        along, before = y[b] - y[a] + apart, x[b] - x[a] + apart
        wanted = 0.5 * (along * (y[a] - x[a] + y[b] - x[b])).sum(axis=1)
        width = (along * before).sum(axis=1)
        narrow = NARROWEST * np.linalg.norm(along, axis=1) * np.linalg.norm(before, axis=1)
        weights = 1.0 / np.maximum(width, np.maximum(narrow, NARROWEST * float(np.median(np.abs(width)))) + TINY)
        weights /= weights.mean()
        flow, count = weights * wanted, surface.vertex_count
        self.flow: Floats = (np.bincount(b, flow, count) - np.bincount(a, flow, count)).astype(np.float64)
        diagonal: Floats = (np.bincount(a, weights, count) + np.bincount(b, weights, count)).astype(np.float64)
        self._factor = surface_factor(surface)
        _factorise(self._factor, diagonal, -weights)

    def solve(self, right: Floats) -> Floats:
        return self._factor.solve(right)


def _relative_curl(surface: Surface, corner: Floats, moved: Floats) -> float:
    """Return the part of the displacement on the image triangles that is the rotated gradient of a function."""
    areas = plane_areas(corner)
    field = moved[surface.faces].mean(axis=1)
    norm = float(areas @ (field**2).sum(axis=1))
    if norm <= 1e-24 * SPHERE_AREA:  # a map that moves points by less than 1e-12 has no curl to speak of
        return 0.0
    # J times the gradient of a hat function is half the opposite side over the area, turned: the side itself.
    sides = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
    flux = -0.5 * (sides * field[:, None]).sum(axis=2)
    right: Floats = np.bincount(surface.faces.ravel(), flux.ravel(), surface.vertex_count).astype(np.float64)
    cotangents = np.empty(surface.faces.shape)
    for k in range(3):
        p, q = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        cotangents[:, k] = (p * q).sum(axis=1) / (2.0 * areas)
    weights = 0.5 * cotangents.ravel()[surface.edge_corners].sum(axis=1)
    a, b = surface.edges.T.astype(np.int64)
    count = surface.vertex_count
    diagonal: Floats = (np.bincount(a, weights, count) + np.bincount(b, weights, count)).astype(np.float64)
    factor = surface_factor(surface)
    _factorise(factor, diagonal, -weights)
    stream = factor.solve(right)
    return float(np.sqrt(max(float(stream @ right), 0.0) / norm))
