"""How far a map to a flat torus is from optimal: the curl left over, and a lower bound on the cost.

As :mod:`omtwarp.metrics.optimality` on the sphere. The displacement y - x of an optimal map is a gradient in the image.
For any periodic function ψ, with φ(x) = min over z of |x - z|²/2 - ψ(z), every plan that takes {x_i, m_i} to {y_i, m_i}
costs at least 2 Σ m_i (φ(x_i) + ψ(y_i)), with z running over the images y_j and more points. ψ is fitted to the
displacements along edges, quadratic on each image triangle. The best image is found for all x at once, as the nearest
neighbour in space with sqrt(2 max ψ - 2 ψ(z)) for height (F. Aurenhammer, "Power diagrams", SIAM J. Computing 16,
1987); then a grid in the triangles around it is searched, without which curl of less than half an edge could not show.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.solvers.mesh_factor import surface_factor

Floats = NDArray[np.float64]

GRID = 4  # parts of an edge of an image triangle, between which the potential's minimum is sought


@dataclass(frozen=True)
class TorusOptimality:
    """How far a map to a torus is from optimal.

    Attributes:
        relative_curl: norm of the part of y - x that is no gradient, over the norm of y - x; 0 for an optimal map.
        cost: Σ m |y - x|², with masses 4π and a torus of area 4π.
        lower_bound: what no rearrangement can go below, same unit.
        gap: cost / lower_bound - 1.
        wrapped: vertices that a copy of their image is nearer to; none for an optimal map.
    """

    relative_curl: float
    cost: float
    lower_bound: float
    gap: float
    wrapped: int

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, ready for JSON; None for one that is not finite."""
        return {name: value if np.isfinite(value) else None for name, value in vars(self).items()}


def torus_optimality(surface: Surface, x: Floats, y: Floats, shift: Floats, lattice: Floats) -> TorusOptimality:
    """Measure how far a map to a torus of area 4π is from optimal.

    Args:
        surface: V vertices; their areas are the masses.
        x: the points that are transported, in the plane, shape [V, 2].
        y: their images in the universal cover, shape [V, 2].
        shift: what is added at the corners of triangles, shape [F, 3, 2].
        lattice: vectors that the torus repeats along, as rows, shape [2, 2].
    """
    faces, mass = surface.faces, surface.vertex_areas
    moved = y - x
    corner = y[faces] + shift
    cost = float(mass @ (moved**2).sum(axis=1))
    potential = _potential(surface, x, y, shift)
    nearest = _transform(surface, x, y, corner, potential, lattice)
    excess = 0.5 * (moved**2).sum(axis=1) - potential - nearest
    lower = max(cost - 2.0 * float(mass @ excess), 0.0)
    gap = cost / lower - 1.0 if lower > 0.0 else (0.0 if cost == 0.0 else float("inf"))
    steps = np.array([(i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)]) @ lattice
    other = ((moved[:, None] + steps) ** 2).sum(axis=2).min(axis=1)
    wrapped = int((other < (moved**2).sum(axis=1) * (1.0 - 1e-9)).sum())
    return TorusOptimality(_relative_curl(surface, corner, moved), cost, lower, gap, wrapped)


def _edge_ends(surface: Surface, shift: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Ends of the edges, and what is added to the second one in the cover of the first, shape [E, 2]."""
    corner = surface.edge_corners[:, 0].astype(np.int64)
    face, place = corner // 3, corner % 3
    one, two = (place + 1) % 3, (place + 2) % 3
    a, b = surface.faces[face, one].astype(np.int64), surface.faces[face, two].astype(np.int64)
    apart = shift[face, two] - shift[face, one]
    turned = a > b
    a, b = np.where(turned, b, a), np.where(turned, a, b)
    apart[turned] *= -1.0
    return a, b, apart


def _potential(surface: Surface, x: Floats, y: Floats, shift: Floats) -> Floats:
    """ψ at the images: on each edge in the middle of what no swap of partners allows, in the least squares."""
    a, b, apart = _edge_ends(surface, shift)
    along, before = y[b] - y[a] + apart, x[b] - x[a] + apart
    wanted = 0.5 * (along * (y[a] - x[a] + y[b] - x[b])).sum(axis=1)
    width = (along * before).sum(axis=1)
    width = np.maximum(width, 1e-3 * np.linalg.norm(along, axis=1) * np.linalg.norm(before, axis=1) + 1e-300)
    weights = 1.0 / width
    weights /= weights.mean()
    return _fitted(surface, a, b, weights, weights * wanted)


def _fitted(surface: Surface, a: NDArray[np.int64], b: NDArray[np.int64], weights: Floats, flow: Floats) -> Floats:
    """Solve the graph Laplacian for what flows along the edges from a to b, shape [V]."""
    count = surface.vertex_count
    diagonal: Floats = (np.bincount(a, weights, count) + np.bincount(b, weights, count)).astype(np.float64)
    right: Floats = (np.bincount(b, flow, count) - np.bincount(a, flow, count)).astype(np.float64)
    return _solved(surface, diagonal, -weights, right)


def _solved(surface: Surface, diagonal: Floats, off_diagonal: Floats, right: Floats) -> Floats:
    factor = surface_factor(surface)
    held = diagonal * (1.0 + 1e-12)
    held[0] *= 2.0
    factor.factorise(held, off_diagonal)
    return factor.solve(right)


def _transform(surface: Surface, x: Floats, y: Floats, corner: Floats, potential: Floats, lattice: Floats) -> Floats:
    """Minimum of |x - z|²/2 - ψ(z), shape [V]: over all images, then over a grid around the best of them."""
    top = float(potential.max())
    heights = np.sqrt(2.0 * (top - potential))
    moved = y - x
    worst = 0.5 * (moved**2).sum(axis=1) - potential  # what its own image gives every x
    reach = float(np.sqrt(2.0 * (worst + top).max()))  # no image farther than this is better than that
    back = np.linalg.inv(lattice)
    around = np.linalg.norm(back, axis=0) * reach  # in multiples of the lattice's vectors
    home, places = (points @ back % 1.0 for points in (x, y))
    copies, owners = [], []
    far = np.ceil(around).astype(int) + 1
    for i in range(-far[0], far[0] + 1):
        for j in range(-far[1], far[1] + 1):
            shifted = places + (i, j)
            inside = np.flatnonzero(((shifted >= -around) & (shifted <= 1.0 + around)).all(axis=1))
            copies.append(np.concatenate([shifted[inside] @ lattice, heights[inside, None]], axis=1))
            owners.append(inside)
    sought = np.concatenate([home @ lattice, np.zeros((len(x), 1))], axis=1)
    stacked, owner = np.concatenate(copies), np.concatenate(owners)
    distance, found = cKDTree(stacked).query(sought)
    least = 0.5 * distance**2 - top
    # The triangles around the best image, in a cover in which that lies where it was found.
    best, image = stacked[found, :2] - sought[:, :2], owner[found]
    offsets, corners = surface.vertex_corners
    count = np.diff(offsets)[image]
    which = np.repeat(np.arange(len(x)), count)
    within = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    at = corners[offsets[image][which] + within]
    face, place = at // 3, at % 3
    points, values = _grid(corner, moved[surface.faces], potential[surface.faces])
    for k in range(points.shape[1]):
        apart = best[which] + points[face, k] - corner[face, place]
        value = 0.5 * (apart**2).sum(axis=1) - values[face, k]
        np.minimum.at(least, which, value)
    return least


def _grid(corner: Floats, slope: Floats, own: Floats) -> tuple[Floats, Floats]:
    """Points inside and on the edges of the image triangles, shape [F, K, 2], and ψ there, shape [F, K].

    ψ is quadratic on a triangle; the slope that displacements give it along an edge makes its value in the middle.
    """
    middles = []
    for k in range(3):
        n = (k + 1) % 3
        along = corner[:, n] - corner[:, k]
        middles.append(0.5 * (own[:, k] + own[:, n]) + 0.125 * ((slope[:, k] - slope[:, n]) * along).sum(axis=1))
    points, values = [], []
    for i in range(GRID):
        for j in range(GRID + 1 - i):
            share = np.array([i, j, GRID - i - j]) / GRID
            if share.max() == 1.0:
                continue
            points.append(np.einsum("k,fkc->fc", share, corner))
            value = own @ (share * (2.0 * share - 1.0))
            for k in range(3):
                value = value + 4.0 * share[k] * share[(k + 1) % 3] * middles[k]
            values.append(value)
    return np.stack(points, axis=1), np.stack(values, axis=1)


def _relative_curl(surface: Surface, corner: Floats, moved: Floats) -> float:
    """The part of the displacement on the image triangles that is the rotated gradient of a function."""
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    areas = 0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    field = moved[surface.faces].mean(axis=1)
    norm = float(areas @ (field**2).sum(axis=1))
    if norm <= 1e-24 * SPHERE_AREA:
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
    stream = _solved(surface, diagonal, -weights, right)
    return float(np.sqrt(max(float(stream @ right), 0.0) / norm))


__all__ = ["TorusOptimality", "torus_optimality"]
