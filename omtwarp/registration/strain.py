"""Strain and areas of a warp of the sphere: how far it changes them, the energy of both, and what bounds them."""

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.flips.exact import flipped_faces
from omtwarp.geometry.sphere_hierarchy import triangle_solid_angles
from omtwarp.mesh.arrays import TINY, Floats, dots, marked
from omtwarp.mesh.patches import Patches, grow
from omtwarp.mesh.surface import Surface, sums_around, triangle_areas
from omtwarp.optimal.cells import MeasuredRings, RingCells
from omtwarp.optimal.exact import restore_areas
from omtwarp.optimal.local import LocalSteps
from omtwarp.optimal.solver import LEAST_PENALTY
from omtwarp.optimal.sphere import ShapeEnergy
from omtwarp.registration.warp_shape import VertexTerm, WarpShape, strain_limit
from omtwarp.untangling.untangle import untangle

ROUNDS = 24  # of relaxing around triangles over the bound
FREED_RINGS = 2  # that move with the corners of these triangles
STEPS = 3  # Newton steps of a patch in a round
# Of the limit at which the barrier of strain is infinite: where warps begin, steps have to find room.
NEAR_LIMIT = 0.9


def octaves(before: Floats, after: Floats, faces: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Return log2 of the ratio of areas, and of that of the larger stretch to the smaller, of every triangle, [F] each.

    Args:
        before, after: positions of the vertices, shape [V, 3].
        faces: triangles, shape [F, 3].
    """
    (p, q), (u, v) = ((x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]]) for x in (before, after))
    pp, pq, qq = (dots(a, b) for a, b in ((p, p), (p, q), (q, q)))
    uu, uv, vv = (dots(a, b) for a, b in ((u, u), (u, v), (v, v)))
    square = np.maximum(pp * qq - pq**2, TINY)
    areas = np.sqrt(np.maximum(uu * vv - uv**2, TINY) / square)
    # The squares of the stretches have this sum, and the square of the ratio of areas as their product.
    total = (qq * uu - 2.0 * pq * uv + pp * vv) / square
    half = np.maximum(total / (2.0 * areas), 1.0)  # of R + 1/R
    return np.log2(areas), np.log2(half + np.sqrt(half**2 - 1.0))


def strain_at_vertices(before: Floats, faces: NDArray[np.int32], strain: Floats) -> Floats:
    """Return the mean strain of the triangles around every vertex, weighted by their areas before, shape [V].

    Args:
        before: positions of the vertices, shape [V, 3].
        faces: triangles, shape [F, 3].
        strain: of the triangles, one of :func:`octaves`, shape [F].
    """
    areas = triangle_areas(before, faces)
    sums = [sums_around(x, faces, len(before)) for x in (areas * strain, areas)]
    return np.asarray(sums[0] / np.maximum(sums[1], TINY))


def kept_within(
    surface: Surface, sphere: Floats, bound: float, held: NDArray[np.integer] | None = None, *, leave_room: bool = False
) -> Floats:
    """Return a warp without flips and within the bound of strain, moved only around triangles that are not.

    Flips are untangled first. Then vertices around triangles with too much strain go to where they hold less
    distortion, with more rings around them the longer it takes.

    Args:
        surface: the sphere before the warp.
        sphere: the warp, unit vectors, shape [V, 3].
        bound: of both numbers of :func:`octaves`, in size.
        held: vertices that are not to move where nothing is flipped; by default all may.
        leave_room: whether both numbers together are to leave a minimisation with the barrier of the bound room to
            begin (:mod:`omtwarp.registration.warp_shape`), which is more than that each is within the bound.

    Returns:
        Unit vectors, shape [V, 3]; where no more is gained some triangles may stay over the bound.
    """
    if flipped_faces(sphere, surface.faces).any():
        sphere = untangle(surface, sphere, device="cpu").sphere
    energy: ShapeEnergy | None = None
    near_held = marked(surface.vertex_count, np.zeros(0, np.int64) if held is None else held)
    near_held = grow(surface.faces, near_held, FREED_RINGS)
    for done in range(ROUNDS):
        over = _beyond(surface, sphere, bound, leave_room)
        if not over.any():
            break
        energy = energy or ShapeEnergy(surface, resolve_device("cpu"), 1.0)
        # Rounds per ring, after so many, a ring of vertices more is freed
        chosen = grow(surface.faces, marked(surface.vertex_count, surface.faces[over]), done // 4) & ~near_held
        if not chosen.any():
            break
        sphere = _relaxed(energy, sphere, grow(surface.faces, chosen, FREED_RINGS))
    return sphere


def has_room(surface: Surface, sphere: Floats, bound: float) -> bool:
    """Say whether a minimisation with the barrier of a bound has room to begin at a warp, as of :func:`kept_within`."""
    return not (flipped_faces(sphere, surface.faces) | _beyond(surface, sphere, bound, True)).any()


def _beyond(surface: Surface, sphere: Floats, bound: float, leave_room: bool) -> NDArray[np.bool_]:
    """Return which triangles are strained more than they may be, shape [F]; arguments as of :func:`kept_within`."""
    by_area, by_stretch = octaves(surface.vertices, sphere, surface.faces)
    over = np.maximum(np.abs(by_area), by_stretch) > bound
    if leave_room:
        over |= strain_limit(by_area) + strain_limit(by_stretch) > NEAR_LIMIT * strain_limit(bound)
    return np.asarray(over)


def _relaxed(energy: ShapeEnergy, sphere: Floats, freed: NDArray[np.bool_]) -> Floats:
    """Move vertices, given as a mask of shape [V], to where they hold less distortion."""
    surface = energy.surface
    points = energy.domain.sent(sphere)
    terms, none = energy.terms(points), wp.zeros(surface.vertex_count, dtype=wp.float64, device=energy.device)
    patches, stiffness = Patches.of_vertices(surface.faces, freed), LEAST_PENALTY / energy.wanted
    steps = LocalSteps(energy, patches, stiffness, constrained=False)
    return steps.run(points, terms, none, 0.0, STEPS)[0].numpy() if steps.worthwhile else sphere


def areas_around(points: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return the solid angles of the triangles around every vertex of a sphere, shape [V]; they sum to 12π.

    Args:
        points: unit vectors, shape [V, 3].
        faces: shape [F, 3].
    """
    return sums_around(triangle_solid_angles(*points.take(faces.T, axis=0)), faces, len(points))


def warp_energy(
    sphere: Surface,
    area_weight: float,
    most_strain: float | None = None,
    vertex_term: VertexTerm | None = None,
    keep_areas: bool = True,
) -> ShapeEnergy:
    """Return the energy of registration: the distortion, the barrier of strain and a term at vertices.

    Args:
        sphere: what is warped.
        area_weight: λ, of area against angle distortion.
        most_strain, vertex_term: as of :class:`omtwarp.registration.warp_shape.WarpShape`.
        keep_areas: whether the areas around the vertices of the sphere are constraints, or have a penalty.
    """
    device = resolve_device("cpu")
    cells = RingCells(sphere, device) if keep_areas else MeasuredRings(sphere, device)
    cells.wanted = areas_around(sphere.vertices, sphere.faces)
    plain = most_strain is None and vertex_term is None
    shape = None if plain else WarpShape(sphere, device, most_strain=most_strain, vertex_term=vertex_term)
    return ShapeEnergy(sphere, device, area_weight, shape=shape, cells=cells)


def with_areas(sphere: Surface, warp: Floats, area_weight: float) -> Floats:
    """Return the warp nearest to one given, shape [V, 3], that keeps the areas around all vertices to 1e-6.

    Args:
        sphere: before the warp.
        warp: unit vectors, no triangle flipped, shape [V, 3].
        area_weight: as of :func:`warp_energy`.
    """
    return restore_areas(warp_energy(sphere, area_weight), warp)[0]


def area_changes(before: Floats, after: Floats, faces: NDArray[np.int32]) -> dict[str, float]:
    """Return the root mean square and the largest relative change of the areas around vertices.

    Args:
        before, after: unit vectors, shape [V, 3].
        faces: shape [F, 3].
    """
    wanted = areas_around(before, faces)
    relative = areas_around(after, faces) / wanted - 1.0
    return {"rms": float(np.sqrt(wanted @ relative**2 / wanted.sum())), "largest": float(np.abs(relative).max())}
