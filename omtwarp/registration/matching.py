"""Where a warp begins: places of two spheres that look alike, found by discrete optimisation over all rotations.

At each of a few points of the sphere that moves, one of many rotations is chosen. A rotation costs the difference of
the features around the point and around the place that it goes to, and the rotations of neighbours cost how far each is
from taking the neighbour where that goes. The sum of both is minimised by passing messages along the edges [1]_; from
round to round rotations that fit worse are replaced by those of neighbours [2]_, so that what is right spreads. A
descent ends at the folds that lie next to where it begins; here all places are candidates, however far away.

.. [1] P. F. Felzenszwalb, D. P. Huttenlocher, "Efficient belief propagation for early vision", IJCV 70 (2006).
.. [2] F. Besse, C. Rother, A. Fitzgibbon, J. Kautz, "PMBP: PatchMatch belief propagation", IJCV 110 (2014).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from omtwarp.location import Locator, combined
from omtwarp.mesh.arrays import ROUND_OFF, Floats, cross, normalised
from omtwarp.mesh.surface import Surface
from omtwarp.registration.landmarks import Pairs

Singles = NDArray[np.float32]
Whole = NDArray[np.int64]

RINGS = (0.0, 6.0, 12.0, 18.0)  # degrees from a point at which the features around it are read
TURNS = 24  # directions in which they are read, and turns of a place that are told apart
CHOICES = 64  # rotations that each point has at a time
# Of the squared gradient of the warp, against the weighted mean of squared differences of features with variance 1. Of
# made cortices warped by 30 and 40 degrees 0.3 to 0.8 find the same.
SMOOTHNESS = 0.4
# The most that a squared gradient counts, from round to round: first what is right may lie next to what is not.
MOST = (1.0, 2.0, 4.0, 8.0)
PASSES = 10  # of messages in a round
KEPT, LEADING = 16, 4  # rotations with the least cost that a point keeps, and that its neighbours try
EXACT = 100.0  # weight of landmarks that are to meet


class Matching:
    """Matches what lies around points of a sphere with places of another.

    Args:
        points: a coarse grid of N points, none with more than six neighbours.
        places: the grid of the places where they may go.
        grid: the vertices that features are given at, M.
    """

    def __init__(self, points: Surface, places: Surface, grid: Surface):
        self.points = points
        self._places = places.vertices
        self._frames, self._place_frames = _frames(points.vertices), _frames(places.vertices)
        self._samples, self._place_samples = (_samples(grid, frames) for frames in (self._frames, self._place_frames))
        self._tree = cKDTree(self._places)
        self._around = self._tree.query(self._places, k=7)[1]  # a place and those next to it
        edges = np.asarray(points.edges, dtype=np.int64)
        self._ends = np.concatenate([edges, edges[:, ::-1]]).T
        self._order = np.argsort(self._ends[1], kind="stable")
        self._first = np.searchsorted(self._ends[1][self._order], np.arange(points.vertex_count))
        start, end = self._ends
        self._squares = ((points.vertices[start] - points.vertices[end]) ** 2).sum(axis=1).astype(np.float32)
        # The neighbours of each point, [N, 6], with the edges to it, -1 where there are fewer
        slots = np.arange(len(start)) - self._first[end[self._order]]
        self._edges_to = np.full((points.vertex_count, 6), -1)
        self._edges_to[end[self._order], slots] = self._order

    def match(self, moving: Floats, counted: Floats, target: Floats, weights: Floats, pairs: Pairs | None) -> Floats:
        """Return where the points go, unit vectors, shape [N, 3].

        Args:
            moving: features of the sphere that moves, each of variance 1, shape [M, K].
            counted: 1 where these are known, 0 in filled holes, shape [M].
            target: the same features of the other sphere, shape [M, K].
            weights: of the features, shape [K].
            pairs: landmarks.
        """
        costs = self._costs(moving, counted, target, weights / weights.sum())
        if pairs is not None:
            self._add_landmarks(costs, pairs, len(costs) / weights.sum())
        choice = np.argpartition(costs.min(axis=2), CHOICES, axis=1)[:, :CHOICES]
        choice = choice * TURNS + np.take_along_axis(costs.argmin(axis=2), choice, axis=1)
        costs = costs.reshape(len(costs), -1)
        for number, most in enumerate(MOST, start=1):
            rotations = self._rotations(choice)
            beliefs, best = self._pass(np.take_along_axis(costs, choice, axis=1), rotations, most)
            if number < len(MOST):
                choice = self._renewed(costs, choice, rotations, beliefs, most)
        chosen = rotations[np.arange(len(best)), best]
        # The mean of where a point goes by its own rotation and by those of its neighbours: its own is one of a grid.
        start, end = self._ends
        by_others = np.zeros_like(self.points.vertices)
        np.add.at(by_others, end, np.einsum("eij,ej->ei", chosen[start], self.points.vertices[end]))
        return normalised(by_others + np.einsum("nij,nj->ni", chosen, self.points.vertices))

    def _costs(self, moving: Floats, counted: Floats, target: Floats, weights: Floats) -> Singles:
        """Return the difference of features around all points and all places, turned by all turns, [N, L, TURNS]."""
        roots = np.sqrt(weights)
        # A sample is known where all that it is read from is.
        known = (self._samples @ counted > 1.0 - ROUND_OFF).astype(np.float64)
        ours, theirs = self._samples @ (moving * roots), self._place_samples @ (target * roots)
        # Σ known (theirs - ours)² around rings is, but for a constant, a correlation of these by the turn.
        here = np.column_stack([known, -2.0 * known[:, None] * ours])
        there = np.column_stack([(theirs**2).sum(axis=1), theirs])
        # What a sample of every ring counts: its part of the area around, less with the distance; the sum is 1
        rings = np.radians(RINGS)
        areas = np.maximum(np.sin(rings), np.sin(rings[1]) / 4.0) * np.exp(-0.72 * (rings / rings[-1]) ** 2)
        shares = areas / (TURNS * areas.sum())
        here, there = (
            np.fft.rfft(one.reshape(-1, len(RINGS), TURNS, one.shape[1]), axis=2).transpose(2, 0, 1, 3)
            for one in (here, there)
        )
        here = (here * shares[:, None]).reshape(*here.shape[:2], -1)
        there = there.reshape(*there.shape[:2], -1)
        alone = (known * (ours**2).sum(axis=1)).reshape(-1, len(RINGS), TURNS).sum(axis=2) @ shares
        both = np.fft.irfft((here.conj() @ there.transpose(0, 2, 1)).transpose(1, 2, 0), n=TURNS, axis=2)
        return np.asarray(both + alone[:, None, None], dtype=np.float32)

    def _add_landmarks(self, costs: Singles, pairs: Pairs, scale: float) -> None:
        """Add the squared distances that landmarks are left from their places by the rotations of the points around."""
        place = Locator(self.points.vertices, self.points.faces, device="cpu").find(pairs.points)
        corners, shares = self.points.faces[place.faces], place.coordinates
        weights = scale * np.where(pairs.exact, EXACT, pairs.weights)[:, None] * shares
        for point in np.unique(corners):
            weight = np.where(corners == point, weights, 0.0).sum(axis=1)
            products = np.einsum("p,pi,pj->ij", weight, pairs.points, pairs.places)
            # Of Σ w |R p - q|² = 2 Σ w - 2 tr(R Σ w p qᵀ), R from the frame here, turned, to the frame there
            inner = self._frames[point].T @ products @ self._place_frames
            traces = np.einsum("tij,lji->lt", _turns(), inner)
            costs[point] += 2.0 * (weight.sum() - traces)

    def _rotations(self, choice: Whole) -> Singles:
        """Return the rotations of choices, place times TURNS plus turn, shape [N, C], as [N, C, 3, 3]."""
        place, turn = np.divmod(choice, TURNS)
        turned = self._place_frames[place] @ _turns()[turn]
        return np.asarray(turned @ self._frames.transpose(0, 2, 1)[:, None], dtype=np.float32)

    def _gaps(self, edge: Whole, starts: Singles, ends: Singles) -> Singles:
        """Return the squared gradients of the warp along edges for all rotations of both ends, [E, C at start, at end].

        That is |R p' - R' p'|² and |R p - R' p|² in the mean, over |p - p'|².
        """
        p, other = (self.points.vertices[end].astype(np.float32)[:, None, :, None] for end in self._ends[:, edge])
        ours = np.concatenate([starts @ other, starts @ p], axis=2)[..., 0]
        theirs = np.concatenate([ends @ other, ends @ p], axis=2)[..., 0]
        return np.asarray((2.0 - ours @ theirs.transpose(0, 2, 1)) / self._squares[edge][:, None, None])

    def _pass(self, costs: Singles, rotations: Singles, most: float) -> tuple[Singles, Whole]:
        """Pass messages along the edges, and return what every choice costs by them, [N, C], and the best choices, [N].

        The best are those with the least sum of all costs in any pass.
        """
        start, end = self._ends
        half, count = len(start) // 2, np.arange(len(costs))
        first, last = start[:half], end[:half]
        gaps = SMOOTHNESS * np.minimum(self._gaps(np.arange(half), rotations[first], rotations[last]), most)
        # Of a message to the end of an edge: by the choice there, and by that at the start
        forth, back = np.ascontiguousarray(gaps.transpose(0, 2, 1)), gaps
        messages = np.zeros((2 * half, costs.shape[1]), dtype=np.float32)
        nearest: tuple[float, Singles, Whole] | None = None
        for _ in range(PASSES + 1):
            beliefs = costs + np.add.reduceat(messages[self._order], self._first, axis=0)
            best = beliefs.argmin(axis=1)
            total = costs[count, best].sum() + gaps[np.arange(half), best[first], best[last]].sum()
            if nearest is None or total < nearest[0]:
                nearest = float(total), beliefs, best
            # Without what came along the same edge from the other side
            sent = beliefs[start] - np.concatenate([messages[half:], messages[:half]])
            both = (forth, sent[:half]), (back, sent[half:])
            new = np.concatenate([(gap + one[:, None]).min(axis=2) for gap, one in both])
            messages = 0.5 * (messages + new - new.min(axis=1, keepdims=True))
        assert nearest is not None
        return nearest[1:]

    def _renewed(self, costs: Singles, choice: Whole, rotations: Singles, beliefs: Singles, most: float) -> Whole:
        """Return new choices, [N, CHOICES]: of each point's own and of its neighbours' best and those near, the best.

        Args:
            costs: of all choices that there are, [N, L TURNS].
            choice, rotations, beliefs: of the last round.
            most: as the squared gradients counted there.
        """
        order = np.argsort(beliefs, axis=1)[:, :KEPT]
        leading = np.take_along_axis(rotations, order[:, :, None, None], axis=1)
        edges = self._edges_to
        others = np.where(edges < 0, np.arange(len(edges))[:, None], self._ends[0][edges])
        tried = leading[:, :LEADING][np.column_stack([np.arange(len(edges)), others])].reshape(len(edges), -1, 3, 3)
        own = np.take_along_axis(choice, order, axis=1)
        new = np.sort(np.concatenate([own, self._nearest(tried)], axis=1), axis=1)
        estimates = np.take_along_axis(costs, new, axis=1)
        estimates[:, 1:][new[:, 1:] == new[:, :-1]] = np.inf
        above = np.take_along_axis(beliefs, order, axis=1)
        above = above - above[:, :1]
        turned = self._rotations(new)
        for edge, other in zip(edges.T, others.T, strict=True):
            there = edge >= 0
            gaps = np.minimum(self._gaps(edge[there], leading[other[there]], turned[there]), most)
            estimates[there] += (SMOOTHNESS * gaps + above[other[there]][:, :, None]).min(axis=1)
        return np.take_along_axis(new, np.argpartition(estimates, CHOICES, axis=1)[:, :CHOICES], axis=1)

    def _nearest(self, rotations: Singles) -> Whole:
        """Return the choices nearest to rotations, [N, C, 3, 3], and those with the places around, [N, 7 C]."""
        images = (rotations @ self.points.vertices.astype(np.float32)[:, None, :, None])[..., 0]
        places = self._around[self._tree.query(images)[1]]
        axes = rotations @ self._frames[:, None, :, :2].astype(np.float32)
        inner = self._place_frames[places][..., :2].swapaxes(-1, -2).astype(np.float32) @ axes[:, :, None]
        angles = np.arctan2(inner[..., 1, 0] - inner[..., 0, 1], inner[..., 0, 0] + inner[..., 1, 1])
        turns = np.rint(angles * TURNS / (2.0 * np.pi)).astype(np.int64) % TURNS
        return np.asarray(places * TURNS + turns).reshape(len(rotations), -1)


def _frames(points: Floats) -> Floats:
    """Return two tangents and the normal at unit vectors, as columns, shape [P, 3, 3]."""
    across = np.where(np.abs(points[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    along = normalised(cross(across, points))
    return np.stack([along, cross(points, along), points], axis=2)


def _turns() -> Floats:
    """Return the rotations about the third axis, shape [TURNS, 3, 3]."""
    angles = 2.0 * np.pi * np.arange(TURNS) / TURNS
    turns = np.zeros((TURNS, 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angles)
    turns[:, 1, 0], turns[:, 2, 2] = np.sin(angles), 1.0
    turns[:, 0, 1] = -turns[:, 1, 0]
    return turns


def _samples(grid: Surface, frames: Floats) -> csr_matrix:
    """Return the matrix that reads values at a grid's vertices on the rings around points, [P RINGS TURNS, M]."""
    rings, angles = np.radians(RINGS)[:, None], 2.0 * np.pi * np.arange(TURNS) / TURNS
    across, up = np.sin(rings), np.broadcast_to(np.cos(rings), (len(rings), TURNS))
    around = np.stack([across * np.cos(angles), across * np.sin(angles), up], axis=2)
    places = np.einsum("pij,raj->prai", frames, around).reshape(-1, 3)
    place = Locator(grid.vertices, grid.faces, device="cpu").find(places)
    return combined(grid.faces[place.faces], place.coordinates, grid.vertex_count)
