"""The warp of registration: features that move onto others, coarse to fine, on grids that no mesh determines."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache, partial

import numpy as np

from omtwarp.geometry.axes import fitted_rotation
from omtwarp.location import Locator
from omtwarp.mesh.arrays import Floats, normalised
from omtwarp.mesh.shapes import icosphere
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.solver import OptimalMap, minimise
from omtwarp.options import Record
from omtwarp.registration.feature_term import FeatureField, FeatureTerm
from omtwarp.registration.folding import smoothed, vertex_areas
from omtwarp.registration.landmarks import LandmarkTerm, Pairs, TermSum
from omtwarp.registration.matching import Matching
from omtwarp.registration.strain import has_room, kept_within, warp_energy
from omtwarp.registration.warp_shape import VertexTerm, strain_limit

FEATURE_GRID = 32  # frequency of the icosphere that features are read from: its edges are 2 degrees
# Levels from coarse to fine: the frequency of the grid that moves, the width in degrees that features are smoothed to
# (full width at half maximum), and how many times stiffer the grid is: shapes have less in common in detail, and a grid
# that is stiff until the detail comes takes no detours.
Levels = tuple[tuple[int, float, float], ...]
COARSE = ((8, 40.0, 16.0), (8, 40.0, 4.0), (8, 40.0, 2.0), (16, 20.0, 1.6))
MATCHED = COARSE[-1:]  # of these, from a match of places
FINE = ((16, 12.0, 1.6), (24, 8.0, 1.3), (32, 4.4, 1.0))
MATCHED_GRID, PLACES = 3, 8  # frequencies of the grids of points that are matched, and of places where they may go
MATCHED_WIDTH = 12.0  # degrees that features are smoothed to for the match
ITERATIONS = 40  # at a level
# Of areas against angles: less strains areas more and stretches less. With 4.5 an average of 32,492 vertices has 0.785
# of HCP's labels where HCP's own spheres have them, with 3 0.79 and with 2 0.80; but with 2, where 95 % of areas change
# by no more than 0.60 octaves, the depth of a second average agrees to 0.9625, with 3 to 0.963.
AREA_WEIGHT = 3.0


@dataclass(frozen=True, eq=False)
class Warp:
    """A grid on the sphere, and where its vertices move.

    Attributes:
        grid: the vertices before.
        points: after, unit vectors, shape [N, 3].
        energy: at the end of the last level.
        levels: one record for each.
    """

    grid: Surface
    points: Floats
    energy: float = np.inf
    levels: list[Record] = field(default_factory=list)

    def after(self, rotation: Floats) -> "Warp":
        """Return the same warp of a sphere that was rotated."""
        return Warp(Surface(self.grid.vertices @ rotation.T, self.grid.faces), self.points, self.energy, self.levels)

    def apart(self, rotation: Floats) -> float:
        """Return how far the warp moves its vertices from where a rotation does, the mean square of chords."""
        return float(((self.grid.vertices @ rotation.T - self.points) ** 2).sum(axis=1).mean())

    def carry(self, points: Floats) -> Floats:
        """Return where the warp moves points of the sphere, unit vectors, shape [P, 3]."""
        place = Locator(self.grid.vertices, self.grid.faces, device="cpu").find(points)
        return place.on_sphere(self.grid.faces, self.points)


class Warping:
    """Warps features towards those of one sphere.

    Args:
        target: its features at the vertices of :attr:`grid`, shape [N, K].
        known: 1 where these are known, 0 elsewhere, shape [N].
        weights: of the features, shape [K].
        stiffness: λ, the weight of distortion.
        most_strain: bound of :func:`omtwarp.registration.strain.octaves`.
        vertex_count: of the coarser of the two meshes that the features come from.
        penalty: on areas around vertices that change; infinite where none may.
    """

    def __init__(
        self,
        target: Floats,
        known: Floats,
        weights: Floats,
        stiffness: float,
        most_strain: float,
        vertex_count: int,
        penalty: float,
    ):
        self.grid = feature_grid()
        self._target, self._known = target, known
        self._weights, self._stiffness, self._penalty = weights, stiffness, penalty
        # Of the bound: between the grid's vertices a mesh is strained a little more than the grid.
        self._bound = 0.9 * most_strain
        # Of the coarser mesh two mean edges, those of equilateral triangles: smoothed to less, features would show it.
        self._finest = 2.0 * np.degrees(np.sqrt(8.0 * np.pi / (np.sqrt(3.0) * vertex_count)))
        self._fields: dict[float, FeatureField] = {}

    def match(self, moving: Floats, counted: Floats, marks: Pairs | None = None) -> Warp:
        """Return the warp of a coarse grid to where features look alike, which may flip triangles.

        Args:
            moving, counted, marks: as of :meth:`run`, in any position.
        """
        matching, width = _matching(FEATURE_GRID), max(MATCHED_WIDTH, self._finest)
        ours, theirs = self._smooth(moving, width), self._smooth(self._target, width)
        return Warp(matching.points, matching.match(ours, counted, theirs, self._weights, marks))

    def run(
        self, moving: Floats, counted: Floats, levels: Levels, start: Warp | None = None, marks: Pairs | None = None
    ) -> Warp:
        """Minimise feature differences and distortion at one level after another.

        Args:
            moving: features at the vertices of :attr:`grid` before the warp, shape [N, K].
            counted: 1 where these are known, 0 in filled holes, shape [N].
            levels: as of ``COARSE``; those finer than the meshes are left out.
            start: a warp to go on from, of :meth:`match` or of levels; none moves nothing.
            marks: landmarks before the warp, and their places; exact ones get there at the last level after others.
        """
        warp, last = start, start is not None and bool(start.levels)
        kept = [level for level in levels if level[1] >= self._finest]
        if not kept and (not last or marks is not None):
            kept = [levels[0]]
        for number, (frequency, width, stiffer) in enumerate(kept, start=1):
            grid = grid_of(frequency)
            points = grid.vertices if warp is None else self._begun(grid, warp)
            values = np.column_stack([self._smooth(moving, width), counted])
            here = FeatureField(self.grid, values).at(grid.vertices)[0]
            # Of the target, where each place is to agree: what shrinks on the way counts less.
            areas = here[:, -1] * vertex_areas(points, grid.faces) / SPHERE_AREA
            # Energy over λ / 2, so that the distortion of triangles has the factor 1.
            scale = 2.0 / (stiffer * self._stiffness)
            term: VertexTerm = FeatureTerm(here[:, :-1], areas, self._field(width), scale * self._weights)
            pulls = None if marks is None else LandmarkTerm(marks, grid, scale)
            if pulls is not None:
                term = TermSum([term, pulls])
            minimised = self._minimiser(grid, term, scale)
            moved = minimised(points)
            if pulls is not None and last and number == len(kept):
                while pulls.pulled_on(moved.sphere):
                    moved = minimised(moved.sphere)
            energy = float(moved.history[-1]["energy"]) / scale
            record: Record = {"vertices": grid.vertex_count, "width": width, "stiffness": stiffer * self._stiffness}
            record |= {"energy": energy, "iterations": len(moved.history) - 1, "converged": moved.converged}
            warp = Warp(grid, moved.sphere, energy, [*(warp.levels if warp else []), record])
        assert warp is not None
        return warp

    def _begun(self, grid: Surface, warp: Warp) -> Floats:
        """Carry a warp to a grid, and return where its vertices begin, within the bound with room, shape [V, 3].

        A warp that is not brought within it is halved, towards the rotation that is nearest to it.
        """
        halvings = 6  # then what is left is a strain of a few hundredths
        points = warp.carry(grid.vertices)
        rigid = grid.vertices @ fitted_rotation(grid.vertices.T @ points)[0].T
        for _ in range(halvings):
            begun = kept_within(grid, points, self._bound, leave_room=True)
            if has_room(grid, begun, self._bound):
                return begun
            points = normalised(points + rigid)
        return rigid

    def _minimiser(self, grid: Surface, term: VertexTerm, scale: float) -> Callable[[Floats], OptimalMap]:
        """Return what minimises the energy from a warp of a grid, with a penalty or constraints on areas if wanted."""
        tolerance = 2e-4  # of the mean distortion
        # Σ m (a / m - 1)² / 4π is Σ (a - m)² / m over 4π; the penalty of areas a that sum to 12π is half of that.
        penalty = None if np.isinf(self._penalty) else 2.0 * scale * self._penalty
        energy = warp_energy(grid, AREA_WEIGHT, strain_limit(self._bound), term, self._penalty > 0.0)
        return partial(minimise, energy, gain=tolerance, iterations=ITERATIONS, progress=None, penalty=penalty)

    def _field(self, width: float) -> FeatureField:
        if width not in self._fields:
            features = self._smooth(self._target, width)
            if not self._known.all():
                known = smoothed(self.grid, self.grid.vertices, self._known, np.radians(width))
                features = np.column_stack([features, np.clip(known, 0.0, 1.0)])
            self._fields[width] = FeatureField(self.grid, features)
        return self._fields[width]

    def _smooth(self, values: Floats, width: float) -> Floats:
        """Smooth features, and scale them to mean 0 and standard deviation 1."""
        out = smoothed(self.grid, self.grid.vertices, values, np.radians(width))
        areas = self.grid.vertex_areas / SPHERE_AREA
        out = out - areas @ out
        return np.asarray(out / np.sqrt(areas @ out**2))


@cache
def grid_of(frequency: int) -> Surface:
    """Return an icosphere, which is kept with the order of elimination that belongs to it."""
    return icosphere(frequency)


@cache
def _matching(frequency: int) -> Matching:
    """Return what matches points of a coarse grid with places, by features on an icosphere; it is kept."""
    return Matching(grid_of(MATCHED_GRID), grid_of(PLACES), grid_of(frequency))


def feature_grid() -> Surface:
    """Return the grid that features are read from."""
    return grid_of(FEATURE_GRID)
