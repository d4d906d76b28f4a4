"""The dual problem with its potential at the points that are transported, for shrunken limbs.

Where the conformal map shrinks limbs to points, much of the mass lies on a few points x, each of which is spread over
the whole image of a limb (semi-discrete transport). There every image is as good as every other for such a point, so
that ψ has to be c(x, ·) up to a constant all over the limb's image. A potential that is fitted at the images is far
from that. With φ given at the x_j in place of ψ, and

    ψ(y_i) = min over j of c(x_j, y_i) - φ(x_j),

it is so by itself, and φ has one unknown for a whole limb. The bound Σ m_i (φ(x_i) + ψ(y_i)) is concave in φ, its slope
the mass of x_j less that of the images whose minimum is at x_j (Kitagawa, Mérigot and Thibert 2019).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.start import wp
from omtwarp.device.threads import Arguments, launch_parts
from omtwarp.metrics import optimality_kernels as kernels
from omtwarp.metrics.optimality_dual import TransportDual, order_by_halves
from omtwarp.solvers.poisson import EdgeLaplacianSolver

Array = NDArray[np.float64]

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

    potential: Array
    at_images: Array
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

    def initial_potential(self) -> Array:
        """Fit φ to the middles of the differences along edges with which neither end would swap partners, shape [V]."""
        low, high = self._dual.admissible_differences(of_sources=True)
        return self._solver.fit(0.5 * (low + high))

    def bound(self, potential: Array) -> SourceBound:
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

        def of_images(part: slice) -> Arguments:
            return [dual.y[part], seeds[part], *given], [array[part] for array in lowest]

        launch_parts(kernels.largest_potentials, count, of_images, dual.device)
        at_images, nearest = (array.numpy() for array in lowest)
        excess = float(dual.mass @ (dual.cost - potential - at_images))
        return SourceBound(potential, at_images, excess, np.where(nearest < 0, self._of, nearest))

    def slope(self, current: SourceBound) -> Array:
        """Return the derivative of the bound by φ: the mass of each stand-in less that of the images nearest to it."""
        count = len(self._chosen)
        out = np.zeros(len(self._dual.mass))
        masses = np.bincount(self._of, self._dual.mass, count)
        out[self._chosen] = masses - np.bincount(current.nearest, self._dual.mass, count)
        return out

    def smoothed(self, slope: Array) -> Array:
        """Return the change of φ that a slope asks for, the same for all points of a stand-in."""
        mass, count = self._dual.mass, len(self._chosen)
        means = np.bincount(self._of, mass * self._solver.solve(slope), count) / np.bincount(self._of, mass, count)
        return means[self._of]
