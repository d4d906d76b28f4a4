"""Steps that correct the areas of a quartered mesh's original triangles in the plane or on a cap, the boundary fixed.

Two kinds of steps solve saddle-point systems of one pattern, with two coordinates for every vertex and one multiplier
for every original triangle. A flow corrects all areas to first order and deforms the parts as little as that allows:
of all motions u that do, it has the least Dirichlet energy ∫|∇u|² over the map, like the slow flow of a viscous fluid
with sources. An even step is one of Newton's method on the shapes of the parts, with a penalty on the errors of areas.
No vertex moves so far that a part is turned over.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.arrays import TINY
from omtwarp.mesh.quarter import PARTS
from omtwarp.solvers.cholesky import NotPositiveDefinite
from omtwarp.solvers.mesh_factor import cell_saddle_factor, solve_parts
from omtwarp.solvers.saddle_matrix import SaddleMatrix

Floats = NDArray[np.float64]
Measured = Callable[[Floats], tuple[Floats, Floats]]

SETTLED = 1e-9  # largest relative error at which a flow ends; it converges quadratically
FLOWS = 20  # most steps of a flow
SUFFICIENT = 0.1  # a step is taken where it lowers the errors by this share of what the first derivative predicts
HOLDS = 14  # halvings of the shares of a step that single vertices take
LEAST_FLOWING, LEAST_EVENED = 1e-2, 5e-2  # share of its area that a part keeps in a step of either kind at least
SOFTNESS = 1e-9  # of the areas in a flow, beside its stiffness: makes the matrix definite without pivoting
EVEN_STEPS, EVEN_HALVINGS = 15, 12  # most even steps with one penalty, and halvings of one
LEAST_STEPS, LEAST_GAIN = 3, 2e-2  # so many are taken; then those that gain less than this share are the last
DECREASE = 1e-4  # share of the predicted decrease that an even step has to reach
STIFFER = 1e-10  # added to the diagonal of the shapes' matrix, scaled to 1


@dataclass(frozen=True)
class Placed:
    """A map with what is measured on it.

    Attributes:
        points: shape [V, D], D = 2 in the plane and 3 on the sphere.
        parts: areas of the parts, shape [4 F].
        slopes: their derivatives by the corners, shape [4 F, 3, D].
    """

    points: Floats
    parts: Floats
    slopes: Floats


class AreaSteps:
    """Moves maps of one quartered mesh with a fixed boundary to given areas of its original triangles.

    Args:
        points: a map, by which unknowns are ordered for elimination, shape [V, D].
        faces: of the quartered mesh, the parts of a triangle one after the other, shape [4 F, 3].
        held: vertices that stay where they are, shape [V].
        wanted: the areas of the triangles up to a factor: on each map they are shares of its area, shape [F].
        measured: returns the areas of triangles with these corners and their derivatives.
        corners: of the flat parts on the surface, whose shapes an even step approaches, shape [4 F, 3, 3].
    """

    def __init__(
        self,
        points: Floats,
        faces: NDArray,
        held: NDArray[np.bool_],
        wanted: Floats,
        measured: Measured,
        corners: Floats,
    ):
        self._faces, self._held, self._measured = faces, held, measured
        self._count, self._shares = len(held), wanted / wanted.sum()
        after = np.roll(faces, -1, axis=1)
        keys = np.minimum(faces, after).astype(np.int64) * self._count + np.maximum(faces, after)
        edges, which = np.unique(keys, return_inverse=True)
        self._edges = np.stack([edges // self._count, edges % self._count], axis=1).astype(np.int32)
        self._edge = which.reshape(faces.shape)  # of every part, from a corner to the next
        self._forward = faces == self._edges[self._edge, 0]
        parts = faces.reshape(-1, PARTS, 3)
        self._cells = np.concatenate([parts[:, :3, 0], parts[:, 3]], axis=1).astype(np.int32)
        place = (parts.reshape(len(parts), -1, 1) == self._cells[:, None, :]).argmax(axis=2)
        self._place = (self._cells.shape[1] * np.arange(len(parts))[:, None] + place).ravel()
        flat = np.zeros((self._count, 3))
        flat[:, : points.shape[1]] = points
        self._factor = cell_saddle_factor(flat, self._edges, self._cells)
        self._weights = np.repeat(self._shares / PARTS, PARTS)
        self._shapes = _stiffness(corners)

    def placed(self, points: Floats) -> Placed:
        """Measure a map."""
        return Placed(points, *self._measured(points[self._faces]))

    def largest_error(self, at: Placed) -> float:
        """Return the largest relative error of an area."""
        return float(np.abs(self._missing(at) / (at.parts.sum() * self._shares)).max())

    def flow(self, at: Placed, halvings: int) -> tuple[Placed, bool]:
        """Correct areas by flows.

        Args:
            at: a map without flips.
            halvings: of a step, at most; 0 takes whole steps only, which move every vertex by all of it.

        Returns:
            The map, and whether all areas are right.
        """
        for _ in range(FLOWS):
            if self.largest_error(at) <= SETTLED:
                return at, True
            taken = self._flowed(at, halvings)
            if taken is None:
                break
            at = taken
        return at, self.largest_error(at) <= SETTLED

    def even(self, at: Placed, penalty: float) -> Placed:
        """Take even steps: minimise distortion of the parts plus a penalty on the errors of areas."""
        before = self._energy(at, penalty)
        for number in range(EVEN_STEPS):
            taken = self._evened(at, penalty, before)
            if taken is None:
                break
            at, after = taken
            gain, before = before - after, after
            if number + 1 >= LEAST_STEPS and gain < LEAST_GAIN * after:
                break
        return at

    def _missing(self, at: Placed) -> Floats:
        """Return the wanted areas less those of a map, shape [F]."""
        return at.parts.sum() * self._shares - at.parts.reshape(-1, PARTS).sum(axis=1)

    def _error(self, at: Placed) -> float:
        """Return the root mean square of the relative area errors, weighted by area."""
        return float(np.sqrt((self._missing(at) ** 2 / self._shares).sum()) / at.parts.sum())

    def _flowed(self, at: Placed, halvings: int) -> Placed | None:
        """Return the map after the longest share of one flow that lowers the errors, or None."""
        frames = _frames(at.points)
        local = frames[self._faces]
        stiffness = _along(_stiffness(at.points[self._faces]), local)
        still = np.zeros((self._count, 2))
        step = self._solved(at, local, stiffness, still, self._missing(at), None)
        if step is None:
            return None
        motion, before, length = np.einsum("na,nad->nd", step, frames), self._error(at), 1.0
        for _ in range(halvings + 1):
            moved = self._held_back(at, length * motion, LEAST_FLOWING, HOLDS if halvings else 0)
            if moved is not None and self._error(moved) <= (1.0 - SUFFICIENT * length) * before:
                return moved
            length *= 0.5
        return None

    def _energy(self, at: Placed, penalty: float) -> float:
        """Return the mean distortion of the parts and the penalty.

        For angles it is K. Hormann and G. Greiner's, "MIPS: an efficient global parametrization method" (2000), the
        Dirichlet energy over the area; for areas (r + 1/r) / 2, r being a part's area over a quarter of its triangle's.
        """
        if not (at.parts > 0.0).all():
            return float(np.inf)
        ratio = at.parts / (at.parts.sum() * self._weights)
        corners = at.points[self._faces]
        dirichlet = 0.5 * np.einsum("nij,nid,njd->n", self._shapes, corners, corners)
        distortion = dirichlet / at.parts + 0.5 * (ratio + 1.0 / ratio)
        return float(self._weights @ distortion) + 0.5 * penalty * self._error(at) ** 2

    def _evened(self, at: Placed, penalty: float, before: float) -> tuple[Placed, float] | None:
        """Return the map after one even step and its energy, or None where no step lowers it.

        The matrix is definite: Dirichlet energy over an area that is linear in the corners is a convex function, and
        the second derivative of the area is left out.
        """
        frames, missing, total = _frames(at.points), self._missing(at), at.parts.sum()
        local, corners = frames[self._faces], at.points[self._faces]
        pull = np.einsum("nij,njd->nid", self._shapes, corners)
        dirichlet = 0.5 * (pull * corners).sum(axis=(1, 2))
        along = np.einsum("nid,niad->nia", pull, local)
        widened = np.einsum("nid,niad->nia", at.slopes, local)
        area, own, weights = at.parts, total * self._weights, self._weights
        by_area = -dirichlet / area**2 + 0.5 * (1.0 / own - own / area**2)
        gradient = self._summed((weights / area)[:, None, None] * along + (weights * by_area)[:, None, None] * widened)
        both = np.einsum("nia,njb->niajb", along, widened)
        blocks = _along(self._shapes, local) / area[:, None, None, None, None]
        blocks -= (both + both.transpose(0, 3, 4, 1, 2)) / (area**2)[:, None, None, None, None]
        curvature = 2.0 * dirichlet / area**3 + own / area**3
        blocks += curvature[:, None, None, None, None] * np.einsum("nia,njb->niajb", widened, widened)
        blocks *= weights[:, None, None, None, None]
        step = self._solved(at, local, blocks, -gradient, missing, self._shares * total**2 / penalty)
        if step is None:
            return None
        pressure = np.repeat(-penalty * missing / (self._shares * total**2), PARTS)
        slope = float(((gradient + self._summed(pressure[:, None, None] * widened)) * step).sum())
        motion, length = np.einsum("na,nad->nd", step, frames), 1.0
        for _ in range(EVEN_HALVINGS):
            moved = self._held_back(at, length * motion, LEAST_EVENED, HOLDS)
            if moved is not None:
                after = self._energy(moved, penalty)
                if after <= before + DECREASE * length * slope:
                    return moved, after
            length *= 0.5
        return None

    def _summed(self, at_corners: Floats) -> Floats:
        """Add up vectors at the corners of the parts, shape [4 F, 3, 2], at the vertices that move, shape [V, 2]."""
        sums = [np.bincount(self._faces.ravel(), at_corners[..., a].ravel(), self._count) for a in range(2)]
        return np.where(self._held[:, None], 0.0, np.stack(sums, axis=1))

    def _solved(
        self, at: Placed, local: Floats, blocks: Floats, first: Floats, second: Floats, softness: Floats | None
    ) -> Floats | None:
        """Solve [A, Bᵀ; B, -C] [u; q] = [first; second] for the motion u in the frames of the vertices, shape [V, 2].

        Args:
            at: the map; B has the derivatives of the areas.
            local: the frames at the corners of the parts, shape [4 F, 3, 2, D].
            blocks: of A, for the corners of every part, shape [4 F, 3, 2, 3, 2].
            first, second: shape [V, 2] and [F].
            softness: C's diagonal, shape [F], or None for that of a flow.

        Returns:
            None where the matrix is not definite, to round-off.
        """
        diagonal = np.zeros((self._count, 2, 2))
        coupling = np.zeros((len(self._edges), 2, 2))
        for k in range(3):
            own, next_to = blocks[:, k, :, k, :], blocks[:, k, :, (k + 1) % 3, :]
            turned = np.where(self._forward[:, k, None, None], next_to, next_to.transpose(0, 2, 1))
            for a in range(2):
                for b in range(2):
                    diagonal[:, a, b] += np.bincount(self._faces[:, k], own[:, a, b], self._count)
                    coupling[:, a, b] += np.bincount(self._edge[:, k], turned[:, a, b], len(self._edges))
        # Rows and columns are scaled to a diagonal of 1; those of vertices that stay are taken out.
        scale = 1.0 / np.sqrt(np.maximum(0.5 * (diagonal[:, 0, 0] + diagonal[:, 1, 1]), TINY))
        scale[self._held] = 0.0
        diagonal *= (scale**2)[:, None, None]
        diagonal[:, [0, 1], [0, 1]] += np.where(self._held, 1.0, STIFFER)[:, None]
        coupling *= (scale[self._edges[:, 0]] * scale[self._edges[:, 1]])[:, None, None]
        entries = np.einsum("nkd,nkad->nka", at.slopes, local) * scale[self._faces][..., None]
        size = self._cells.size
        slopes = np.stack([np.bincount(self._place, entries[..., a].ravel(), size) for a in range(2)], axis=1)
        slopes = slopes.reshape(*self._cells.shape, 2)
        square = (slopes**2).sum(axis=(1, 2))
        rows = 1.0 / np.sqrt(np.maximum(square, TINY if softness is None else softness))
        soft = np.full(len(rows), SOFTNESS) if softness is None else softness * rows**2
        try:
            self._factor.factorise(SaddleMatrix.of(diagonal, coupling, slopes * rows[:, None, None], soft))
        except NotPositiveDefinite:
            return None
        found, _ = solve_parts(self._factor, first * scale[:, None], second * rows)
        return found * scale[:, None]

    def _held_back(self, at: Placed, motion: Floats, least: float, most: int) -> Placed | None:
        """Move vertices by the largest shares, halved corner by corner, with which each part keeps some of its area."""
        share = np.ones(self._count)
        for _ in range(most + 1):
            points = at.points + share[:, None] * motion
            if points.shape[1] == 3:
                points /= np.linalg.norm(points, axis=1)[:, None]
            points = np.where(self._held[:, None], at.points, points)
            found = self.placed(points)
            trouble = ~(found.parts > least * at.parts)
            if not trouble.any():
                return found
            share[np.unique(self._faces[trouble])] *= 0.5
        return None


def _frames(points: Floats) -> Floats:
    """Return two directions at every vertex: the axes of the plane, or tangents of the sphere, shape [V, 2, D]."""
    if points.shape[1] == 2:
        return np.broadcast_to(np.eye(2), (len(points), 2, 2))
    first = np.cross(points, np.eye(3)[np.abs(points).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1)[:, None]
    return np.stack([first, np.cross(points, first)], axis=1)


def _along(stiffness: Floats, local: Floats) -> Floats:
    """Return stiffness matrices of triangles, [N, 3, 3], in frames at their corners: shape [N, 3, 2, 3, 2]."""
    found: Floats = np.einsum("nij,niad,njbd->niajb", stiffness, local, local)
    return found


def _stiffness(corners: Floats) -> Floats:
    """Return the matrices of ∫ ∇f·∇g over triangles, for functions f, g linear on each, shape [N, 3, 3]."""
    sides = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    products = np.einsum("nid,njd->nij", sides, sides)
    square = products[:, 0, 0] * products[:, 1, 1] - products[:, 0, 1] ** 2
    return products / (2.0 * np.sqrt(np.maximum(square, TINY)))[:, None, None]


__all__ = ["AreaSteps", "Placed"]
