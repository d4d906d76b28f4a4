"""Maps to disks and caps whose boundary stays where it is: repair, less distortion, and exact areas of triangles.

A projection to the disk turns triangles over: all vertices are placed anew. On a cap patches around them are untangled.

Lambert's projection keeps areas of regions, but a triangle with straight sides is not the region that its corners came
from, and the polygon of the boundary's vertices lacks the segments up to its circle. So the map of a quartered mesh is
moved, with its boundary fixed, until each original triangle has its share of that polygon. The polygon's area does not
change on the way. The remaining errors of areas are corrected as on the sphere (:mod:`omtwarp.optimal.exact`). Where
that takes more than a few steps it leaves slivers: then distortion is minimised among the maps with exact areas. Where
it fails, distortion is minimised with a penalty on the errors first, and if need be with more weight on areas of parts.
"""

from copy import copy
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import brentq
from scipy.sparse.linalg import splu

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces
from omtwarp.geometry.sphere_hierarchy import triangle_solid_angles
from omtwarp.measures import area_distortions
from omtwarp.mesh.arrays import TINY, Floats, dots, marked, norms
from omtwarp.mesh.patches import grow
from omtwarp.mesh.quarter import PARTS, QuarteredSurface
from omtwarp.mesh.surface import SPHERE_AREA, Surface, plane_areas
from omtwarp.open_surfaces.caps import disk_to_cap
from omtwarp.optimal.cells import MeasuredRings, TriangleCells
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.optimal.exact import restore_areas
from omtwarp.optimal.plane import Plane, PlaneCost, PlaneShape
from omtwarp.optimal.refinement import MOST_WEIGHT, match_area
from omtwarp.optimal.shape import DistortionEnergy
from omtwarp.optimal.solver import PENALTY, minimise
from omtwarp.optimal.sphere import NoCost, Sphere
from omtwarp.solvers.cholesky.saddle import COORDINATES, SaddleMatrix
from omtwarp.solvers.mesh_factor import SaddlePointFactor
from omtwarp.topology.kind import boundary_loops, on_boundary
from omtwarp.untangling.untangle import RINGS, RepairBudget, untangle_patches

NO_CELLS = np.empty((0, 1), dtype=np.int32)
SETTLED = 1e-9  # largest relative error at which areas are right; corrections converge quadratically


class HeldEnergy(TransportEnergy):
    """The distortion of maps of a mesh whose boundary stays, with a cost of no weight."""

    exact_tolerance = SETTLED

    @cached_property
    def held(self) -> NDArray[np.bool_]:
        """The vertices of the boundary, which stay, shape [V]."""
        return on_boundary(self.surface.faces, self.surface.vertex_count)

    def cost(self, terms: MapTerms) -> float:
        """Return 4π, a mean of 1: gains are compared with the distortion, not with a cost."""
        return SPHERE_AREA

    def saddle_factor(self) -> SaddlePointFactor:
        """Return what factorises matrices in which the boundary does not move."""
        of_cells = self.cells.vertices if isinstance(self.cells, TriangleCells) else NO_CELLS
        return HeldFactor(super().saddle_factor(), self.held, self.surface.edges, of_cells)


class HeldFactor(SaddlePointFactor):
    """Factorises matrices with a multiplier for every cell, or with none, without the coordinates of some vertices.

    Args:
        factor: of all coordinates.
        held: vertices that stay, shape [V].
        edges: shape [E, 2].
        cells: the vertices of every cell, shape [N, K].
    """

    def __init__(
        self, factor: SaddlePointFactor, held: NDArray[np.bool_], edges: NDArray[np.int32], cells: NDArray[np.int32]
    ):
        self._factor, self._held = factor, held
        self._touching: NDArray[np.bool_] = np.asarray(held[edges].any(axis=1))
        self._in_cells = held[cells]

    def factorise(self, matrix: SaddleMatrix) -> None:
        """Factorise one matrix."""
        own, others, slopes, compliance = matrix.on_host()
        own[self._held] = 0.5 * np.trace(own, axis1=1, axis2=2).mean() * np.eye(2)
        others = np.where(self._touching[:, None, None], 0.0, others)
        slopes = np.where(self._in_cells[..., None], 0.0, slopes.reshape(*self._in_cells.shape, COORDINATES))
        self._factor.factorise(SaddleMatrix.of(own, others, slopes, compliance))

    def solve(self, right: wp.array) -> wp.array:
        """Solve for a right-hand side; coordinates of vertices that stay are 0."""
        numbers = right.numpy().copy()
        numbers[: COORDINATES * len(self._held)].reshape(-1, COORDINATES)[self._held] = 0.0
        return self._factor.solve(wp.array(numbers, dtype=wp.float64, device=right.device))


# Weight of area against angle distortion where a map to the disk is minimised, since the disk is to keep areas, and the
# largest number of steps. With 10, 100 and 300 a part of a caudate nucleus with all of its tail has area distortion
# 2.28, 2.03 and 2.01; others have up to 8 % more angle distortion with 300 than with 100.
AREA_WEIGHT, STEPS = 300.0, 150
GAIN = 1e-4  # of the distortion: a step that is expected to gain less ends the minimisation
# Refinement until an area distortion is matched: how near, and how many weights are tried.
MATCH_TOLERANCE, MATCH_TRIALS = 3e-4, 10
SOLVES = 3  # of the convex combinations: the first leaves no flips except by rounding


def flipped_in_plane(points: Floats, faces: NDArray) -> NDArray[np.bool_]:
    """Return a mask of the triangles of a plane map that are not counter-clockwise, decided exactly, shape [F].

    Twice the area of a triangle is the determinant of its corners (x, y, 1), which the predicate of the sphere decides.

    Args:
        points: shape [V, 2].
        faces: shape [F, 3].
    """
    return flipped_faces(np.concatenate([points, np.ones((len(points), 1))], axis=1), faces)


def untangle_in_plane(points: Floats, surface: Surface, area_weight: float | None = AREA_WEIGHT) -> tuple[Floats, int]:
    """Return a map to the unit disk without flipped triangles, with the boundary fixed.

    Where triangles are flipped, every vertex becomes a convex combination of its neighbours with its mean value
    coordinates, or with equal ones at flipped triangles. Then none is flipped, since the polygon of the boundary's
    vertices is convex [1]_, but areas are no longer right. The distortion of all triangles is minimised from there.

    Args:
        points: a map to the unit disk with few flips, the boundary on the circle, shape [V, 2].
        surface: what is mapped, with the areas that those in the plane are to be in proportion to.
        area_weight: of area against angle distortion; None to minimise neither.

    Returns:
        The map, and the number of remaining flips, 0 except for rounding.

    .. [1] M. S. Floater, "Mean value coordinates", Computer Aided Geometric Design 20 (2003).
    """
    moved, faces = points, surface.faces
    for _ in range(SOLVES):
        flipped = flipped_in_plane(moved, faces)
        if not flipped.any():
            break
        moved = _convex(moved, faces, flipped)
    if area_weight is not None and not flipped.any():
        surface = surface.with_areas(surface.face_areas)
        energy, scale = _energy_in_plane(moved, surface, MeasuredRings(surface, resolve_device("cpu")), area_weight)
        least = minimise(energy, scale * moved, gain=GAIN, iterations=STEPS, progress=None, penalty=0.0)
        moved = np.where(energy.held[:, None], moved, least.points / scale)
        flipped = flipped_in_plane(moved, faces)
    return moved, int(flipped.sum())


def _energy_in_plane(
    points: Floats, surface: Surface, cells: TriangleCells | MeasuredRings, area_weight: float = 1.0
) -> tuple[HeldEnergy, float]:
    """Return the distortion of maps of a surface to the plane, and what brings points to its area, 4π."""
    scale = float(np.sqrt(SPHERE_AREA / plane_areas(points[surface.faces]).sum()))
    plane = Plane(surface, np.zeros((surface.face_count, 3, 2)), resolve_device("cpu"))
    cost, shape = PlaneCost(plane, scale * points), PlaneShape(plane)
    return HeldEnergy(plane, cells, cost, shape, shape_weight=1.0, cost_weight=0.0, area_weight=area_weight), scale


def match_in_plane(points: Floats, surface: Surface, own: int, area: float) -> tuple[Floats, int]:
    """Refine a map to the disk with the least weight of areas that leaves at most an area distortion.

    Args:
        points, surface: as of :func:`untangle_in_plane`.
        own: number of the first faces, whose distortion counts; others fill holes.
        area: the mean of r + 1/r over the surface, r being the ratio of areas.

    Returns:
        The map, that with the largest weight where all have more distortion, and the number of remaining flips.
    """
    sizes = surface.face_areas[:own] / surface.face_areas[:own].sum()

    def refined(start: tuple[Floats, int], weight: float) -> tuple[Floats, int]:
        return untangle_in_plane(start[0], surface, weight)

    def area_of(candidate: tuple[Floats, int]) -> float:
        images = plane_areas(candidate[0][surface.faces[:own]])
        return float(sizes @ area_distortions(images, sizes)[1]) if candidate[1] == 0 else np.inf

    first = refined((points, 0), MOST_WEIGHT)
    return match_area(first, area, refined, area_of, tolerance=MATCH_TOLERANCE, trials=MATCH_TRIALS)[0]


def untangle_on_cap(points: Floats, surface: Surface) -> Floats:
    """Untangle the patches around flipped triangles of a map to a cap with the boundary fixed; flips may be left.

    A fan of triangles around the south pole closes the map.

    Args:
        points: a map to a cap around the north pole, shape [V, 3].
        surface: what is mapped, with the areas that those on the cap are to be in proportion to.
    """
    if not flipped_faces(points, surface.faces).any():
        return points
    of_cap = float(triangle_solid_angles(*points.take(surface.faces.T, axis=0)).sum())
    areas = surface.face_areas * (of_cap / surface.face_areas.sum())
    faces, apex = surface.faces, len(points)
    (rim,) = boundary_loops(faces, apex)
    fan = np.stack([np.roll(rim, -1), rim, np.full(len(rim), apex)], axis=1)
    rest = np.full(len(fan), max(SPHERE_AREA - of_cap, TINY) / len(fan))
    vertices = np.concatenate([surface.vertices, surface.vertices.mean(axis=0, keepdims=True)])
    closed = Surface(vertices, np.concatenate([faces, fan]), np.concatenate([areas, rest]))
    sphere = np.concatenate([points, [[0.0, 0.0, -1.0]]])
    fixed, budget = marked(apex + 1, np.append(rim, apex)), RepairBudget(closed)
    for rings in RINGS:
        wrong = flipped_faces(sphere, closed.faces)
        if not wrong[: len(faces)].any():
            break
        freed = grow(closed.faces, marked(apex + 1, closed.faces[wrong]), rings) & ~fixed
        sphere = untangle_patches(closed, sphere, freed, budget)
    return sphere[:apex]


def _convex(points: Floats, faces: NDArray, flipped: NDArray[np.bool_]) -> Floats:
    """Place all inner vertices at convex combinations of their neighbours."""
    count = len(points)
    corners = points[faces]
    one, other = np.roll(corners, -1, axis=1) - corners, np.roll(corners, -2, axis=1) - corners
    lengths = norms(one), norms(other)
    sine = np.abs(one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0])
    tiny = np.finfo(float).tiny
    tangent = sine / np.maximum(lengths[0] * lengths[1] + dots(one, other), tiny)  # of half the angle
    weights = np.stack([tangent / np.maximum(length, tiny) for length in lengths])
    weights = np.where(marked(count, faces[flipped])[faces], 1.0, weights)
    rows = np.concatenate([faces.ravel(), faces.ravel()])
    columns = np.concatenate([np.roll(faces, -1, axis=1).ravel(), np.roll(faces, -2, axis=1).ravel()])
    matrix = sparse.coo_array((weights.ravel(), (rows, columns)), shape=(count, count)).tocsr()
    matrix = sparse.diags_array(1.0 / np.asarray(matrix.sum(axis=1)).ravel()) @ matrix
    held = on_boundary(faces, count)
    free = np.flatnonzero(~held)
    right = matrix[free][:, np.flatnonzero(held)] @ points[held]
    own = (sparse.eye_array(len(free)) - matrix[free][:, free]).tocsc()
    moved = points.copy()
    moved[free] = splu(own).solve(right)
    return moved


FEW = 3  # steps of a correction that leaves the map as it is but at the boundary
EXACT_GAIN, EXACT_STEPS = 1e-3, 60  # of the minimisation where more are needed, whose maps have slivers
# Weights of area distortion of parts beside the penalty on errors, one after the other until areas are reached: of five
# caps with limbs 1, 3, 10, 30 and 100 leave 3, 1, 0, 0 and 0 without, and 10 leaves the least angle distortion on most.
PENALISED_AREAS = 1.0, 10.0


def exact_in_plane(points: Floats, quartered: Surface, wanted: Floats) -> tuple[Floats, float]:
    """Move a map to the unit disk until each original triangle has its share of the boundary's polygon.

    Args:
        points: a map, the boundary where it is to stay, shape [V, 2].
        quartered: what is mapped: the parts of a triangle one after the other, 4 F triangles.
        wanted: the areas of the original triangles up to a factor, shape [F].

    Returns:
        The map, and its largest relative error.

    Raises:
        OmtwarpError: no such map without flips was found.
    """
    surface, cells = _original_triangles(quartered, wanted, SPHERE_AREA)
    energy, scale = _energy_in_plane(points, surface, cells)
    return _exact(energy, points, scale)


def exact_on_cap(points: Floats, quartered: Surface, wanted: Floats) -> tuple[Floats, float]:
    """Give the triangles of a map to a cap their areas, as :func:`exact_in_plane` does; sides are great circles."""
    device, total = resolve_device("cpu"), triangle_solid_angles(*points[quartered.faces].transpose(1, 0, 2)).sum()
    surface, cells = _original_triangles(quartered, wanted, float(total))
    cost, shape = NoCost(surface, vectors(points, device), device), DistortionEnergy(surface, device)
    sphere = Sphere(surface, device)
    energy = HeldEnergy(sphere, cells, cost, shape, shape_weight=1.0, cost_weight=0.0, area_weight=1.0)
    return _exact(energy, points)


def _original_triangles(quartered: Surface, wanted: Floats, total: float) -> tuple[Surface, TriangleCells]:
    """Return a quartered mesh with the wanted areas, and its original triangles, whose areas are to add up to a total.

    Args:
        quartered, wanted: as of :func:`exact_in_plane`.
        total: the sum of all areas of the map.
    """
    surface = quartered.with_areas(np.repeat(wanted / PARTS, PARTS))
    parents, middles = np.arange(surface.face_count) // PARTS, surface.faces.reshape(-1, PARTS, 3)[:, 3]
    original = QuarteredSurface(np.arange(surface.vertex_count), parents, surface, middles)
    cells = TriangleCells(original, resolve_device("cpu"))
    cells.wanted = cells.wanted * (total / cells.wanted.sum())
    return surface, cells


def shares_of_polygons(rims: list[Floats], shares: Floats, wanted: Floats) -> Floats:
    """Shrink caps until the polygons on their rims, not the caps, have areas in given proportions.

    Args:
        rims: of each cap, the points on the unit circle, one after the other, that its boundary's vertices come from,
            shape [K, 2].
        shares: of the sphere that each cap may have at most, shape [P].
        wanted: the areas up to a factor, shape [P].

    Returns:
        The shares of the caps, none above its own in ``shares``.
    """
    areas = np.array([_polygon(rim, share) for rim, share in zip(rims, shares, strict=True)])
    unit = float((areas / wanted).min())
    polygons = shares.copy()
    for k, rim in enumerate(rims):
        if areas[k] > unit * wanted[k]:
            polygons[k] = brentq(lambda share, r=rim, area=unit * wanted[k]: _polygon(r, share) - area, 0.0, shares[k])
    return polygons


def _polygon(rim: Floats, share: float) -> float:
    """Return the area of the spherical polygon that a cap's boundary vertices span."""
    points = disk_to_cap(rim, share)
    pole = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return float(triangle_solid_angles(pole, points, np.roll(points, -1, axis=0)).sum())


def _less_distorted(energy: HeldEnergy, points: Floats, penalty: float | None = None) -> Floats:
    """Return a map with less distortion, among those with the wanted areas or with a penalty on their errors."""
    return minimise(energy, points, gain=EXACT_GAIN, iterations=EXACT_STEPS, progress=None, penalty=penalty).points


def _exact(energy: HeldEnergy, given: Floats, scale: float = 1.0) -> tuple[Floats, float]:
    """Return a map with exact areas, and its largest error: the nearest, or where that is far the least distorted.

    The energy is of the map that is given times a scale.
    """
    points = scale * given
    if not energy.domain.flipped(points).any():
        moved, right = restore_areas(energy, points, rounds=FEW)
        if not right:
            moved, right = restore_areas(energy, points)
            for weight in PENALISED_AREAS:
                if right:
                    break
                weighted = copy(energy)
                weighted.area_weight = weight
                moved, right = restore_areas(weighted, _less_distorted(weighted, points, PENALTY))
            if right:
                least, still = restore_areas(energy, _less_distorted(energy, moved))
                moved = least if still else moved
        if right:
            error = energy.terms(energy.domain.sent(moved)).largest
            return np.where(energy.held[:, None], given, moved / scale), error
    raise OmtwarpError(
        "no map with straight sides was found that keeps the areas of triangles: use a finer mesh, map to the "
        "hemisphere, or leave exact out"
    )
