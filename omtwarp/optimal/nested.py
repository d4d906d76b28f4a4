"""The road to the optimal map of a closed surface: from some of its points x to all of them.

Where the points of the conformal map are apart, the Delaunay triangulation of some of them on the sphere, with the
mesh's masses, is a small surface whose optimal map takes little time. It is carried to the mesh by linear interpolation
at the points x, and a few steps on the mesh itself end at the optimum; their number does not grow with the mesh. Where
points coincide, as at the ends of long limbs, there is no such triangulation: places in a coarse-to-fine embedding,
which are apart, then stand for them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import is_bijective
from omtwarp.geometry.axes import principal_axes, turned_towards
from omtwarp.location import Locator
from omtwarp.mesh.arrays import Floats, Ints, normalised, squared_norms
from omtwarp.mesh.surface import SPHERE_AREA, Surface, sums_around, triangle_areas
from omtwarp.metrics.distortion import measure_triangles
from omtwarp.moser import moser_map
from omtwarp.optimal.energy import TransportEnergy
from omtwarp.optimal.solver import minimise, optimal_map
from omtwarp.optimal.sphere import energy_on_sphere
from omtwarp.optimal.turns import turned_back
from omtwarp.transport.cost import transport_cost
from omtwarp.untangling.untangle import untangled

NESTED, EMBEDDED = "nested", "embedded"  # what the minimisation on the mesh begins with

# Share of the cost that angle distortion weighs: with half or twice as much, areas and angles of scans move by less
# than 2 %; more trades optimality for smoothness.
SHAPE_SHARE = 0.03
# Area distortion weighs this times √(S - 2) as much as angle distortion: more trades angles for areas of triangles.
AREA_FACTOR = 8.0
# Added to C, in radians², and to S - 2, which are 0 on a sphere. Their quotient is that of most surfaces, 0.1.
LEAST_COST, LEAST_BEND = 1e-4, 1e-3
# Vertices of the mesh for one of the coarse triangulation: fewer make the coarse map better and slower.
VERTICES_PER_COARSE = 8
LEAST_COARSE, MOST_COARSE = 200, 20_000  # vertices of the coarse triangulation
# Part of an embedding that is added to places in space, so that no coarse triangle is without area.
APART = 0.01
# Most of a minimisation: more trade time for areas. Of sixty made surfaces one, a needle, takes more, and with 24 none
# takes ten times as long as is usual for its size.
STEPS = 24
# Penalties on errors of areas, one after the other, in place of constraints where a map is far from the optimum, and
# the gain in radians² and the steps that end each. More of them take longer; without, or with constraints on smoothed
# slivers, one of ten long-limbed surfaces stops where no step lowers the cost.
PENALTIES, PENALISED_GAIN, PENALISED_STEPS = (1.0, 10.0, 100.0), 0.01, 6


@dataclass(frozen=True)
class ShapeTerm:
    """Weights of the shape term.

    Attributes:
        weight: β, of the shape term beside the mean squared distance.
        area: λ, of area distortion beside angle distortion in it.
    """

    weight: float
    area: float


def shape_term(surface: Surface, sphere: Floats, start: Floats, device: str | None = "auto") -> ShapeTerm:
    """Return the weights of the shape term for the minimisation that begins at a map.

    With C the mean squared distance and S the mean angle distortion of the map, angles weigh ``SHAPE_SHARE`` of the
    cost: β (S - 2) = 0.03 C, whatever the size and shape of the surface. Area distortion, which an optimal map hardly
    has, weighs λ = 8 √(S - 2) times as much as angle distortion.

    Args:
        surface: what is mapped, V vertices.
        sphere: the map, unit vectors, shape [V, 3].
        start: the points that it moves, shape [V, 3].
        device: where the kernels run.
    """
    cost = transport_cost(surface, sphere, start=start, device=device) / SPHERE_AREA
    mesh = surface.on(device)
    angle = measure_triangles(mesh.vertices, mesh.faces, sphere, device=device).angle["surface"]
    return shape_term_by_law(cost, angle)


def shape_term_by_law(cost: float, angle: float) -> ShapeTerm:
    """Return the weights of the shape term by the mean squared distance and the mean angle distortion of a map."""
    bend = angle - 2.0 + LEAST_BEND
    return ShapeTerm(SHAPE_SHARE * (cost + LEAST_COST) / bend, AREA_FACTOR * float(np.sqrt(bend)))


@dataclass(frozen=True)
class Coarse:
    """A Delaunay triangulation of some of a surface's points on the sphere.

    Attributes:
        surface: K vertices, with the masses of all vertices of the surface.
        vertices: which of the surface's they are, shape [K].
        carried: carries a map of it, shape [K, 3], to all vertices, shape [V, 3].
    """

    surface: Surface
    vertices: NDArray[np.intp]
    carried: Callable[[Floats], Floats]


def coarse_counts(vertex_count: int) -> list[int]:
    """Return about how many vertices the coarse triangulations have, the coarsest first: three where one is large."""
    count = int(np.clip(vertex_count / VERTICES_PER_COARSE, LEAST_COARSE, MOST_COARSE))
    return [count // VERTICES_PER_COARSE**power for power in ((2, 1, 0) if 2 * count > MOST_COARSE else (0,))]


def coarse_surface(
    surface: Surface,
    points: Floats,
    *,
    count: int | None = None,
    places: Floats | None = None,
    mirror: NDArray[np.int64] | None = None,
) -> Coarse:
    """Triangulate some of a surface's points on the sphere.

    One vertex is taken from each cell of a grid along the surface's own axes, the one nearest to the cell's centre:
    they are spread evenly, and their choice depends on the shape alone. The masses of all vertices are shared out to
    the corners of the triangle that holds their points.

    Args:
        surface: closed, V vertices.
        points: unit vectors, shape [V, 3]; triangles may be flipped there.
        count: about how many vertices it has; an eighth of all by default.
        places: those of the triangulation's vertices, by which distortion is measured, shape [V, 3]; the points by
            default.
        mirror: the copy of every vertex of a double, which lies where the vertex does: both are taken, shape [V].

    Raises:
        OmtwarpError: points coincide, so that there is no triangulation.
    """
    from scipy.spatial import ConvexHull, QhullError  # takes a twentieth of a second to import

    count = count or coarse_counts(surface.vertex_count)[-1]
    vertices = surface.scaled_vertices - surface.vertex_areas @ surface.scaled_vertices / SPHERE_AREA
    along = vertices @ principal_axes(surface).frame.T / np.sqrt(SPHERE_AREA / count)
    own = np.arange(surface.vertex_count)
    own = own if mirror is None else own[own <= mirror]
    cells = np.floor(along[own])
    order = np.lexsort((squared_norms(along[own] - cells - 0.5), *cells.T[::-1]))
    chosen = own[order[np.diff(cells[order], axis=0, prepend=np.nan).any(axis=1)]]
    chosen = chosen if mirror is None else np.union1d(chosen, mirror[chosen])
    try:
        hull = ConvexHull(points[chosen]).simplices
    except QhullError as error:
        raise OmtwarpError("the points of the conformal map have no triangulation") from error
    used, corners = np.unique(hull, return_inverse=True)
    faces: Ints = corners.reshape(-1, 3).astype(np.int32)
    used = chosen[used]
    kept = points[used]
    inwards = np.linalg.det(kept[faces]) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    place = Locator(kept, faces, device="cpu").find(points)
    shares = surface.vertex_areas[:, None] * place.coordinates
    mass = np.bincount(faces[place.faces].ravel(), shares.ravel(), len(used))
    areas = triangle_areas(kept, faces)
    density = 3.0 * mass / sums_around(areas, faces, len(used))
    coarse = Surface(kept if places is None else places[used], faces, areas=areas * density[faces].mean(axis=1))
    return Coarse(coarse, used, partial(place.on_sphere, faces))


def nested_start(
    surface: Surface, start: Floats, *, mirror: NDArray[np.int64] | None = None, device: str | None = "auto"
) -> Floats:
    """Return a map near the optimal one, made from the optimal maps of coarse triangulations of the points x.

    The coarsest begins with Moser's map, each finer one with the map of the one before.

    Args:
        surface: closed, V vertices.
        start: its points x, unit vectors, shape [V, 3].
        mirror: the copy of every vertex of a double, shape [V].
        device: where the kernels run.

    Raises:
        OmtwarpError: points coincide, or the map has flipped triangles that could not be repaired.
    """
    levels = [coarse_surface(surface, start, count=k, mirror=mirror) for k in coarse_counts(surface.vertex_count)]
    sphere = moser_map(levels[0].surface, levels[0].surface.vertices, device=device).sphere
    everywhere = np.arange(surface.vertex_count)
    for level, next_vertices in zip(levels, [*(each.vertices for each in levels[1:]), everywhere], strict=True):
        first = untangled(level.surface, sphere, device=device)
        sphere = _carried(level, first, level.surface.vertices, device)[next_vertices]
    return untangled(surface, sphere, device=device)


def embedded_start(
    surface: Surface,
    start: Floats,
    embedding: Floats | None = None,
    *,
    double: bool = False,
    device: str | None = "auto",
) -> Floats:
    """Return a map near the optimal one, made from a coarse-to-fine embedding of even areas.

    The embedding, turned towards the points x, is triangulated coarsely, and so is the triangulation, down to a few
    hundred vertices. The optimal map of each is carried to the next and turned back limb by limb; penalties that grow
    bring its areas near those wanted.

    Args:
        surface: closed, V vertices.
        start: the points x, unit vectors, shape [V, 3].
        embedding: the coarse-to-fine embedding, where it is known already, shape [V, 3].
        double: whether the surface is a double, whose triangulations are not symmetric: there are then none.
        device: where the kernels run.

    Raises:
        OmtwarpError: there is no embedding.
    """
    if embedding is None:
        from omtwarp.start.hierarchical import hierarchical_embedding  # its kernels are read for few surfaces

        embedding = hierarchical_embedding(surface, device=device).sphere
    sphere = turned_onto(surface, embedding, start, device)
    if surface.vertex_count >= VERTICES_PER_COARSE * LEAST_COARSE and not double:
        try:
            coarse = coarse_surface(surface, sphere, places=surface.scaled_vertices + APART * sphere)
            points = start[coarse.vertices]
            first = embedded_start(coarse.surface, points, sphere[coarse.vertices], device=device)
            sphere = untangled(surface, _carried(coarse, first, points, device), device=device)
        except OmtwarpError:
            pass  # the carried map has flips that cannot be repaired: steps begin on the mesh itself
    sphere = turned_back(surface, sphere, start, device=device)
    term = shape_term(surface, sphere, start, device)
    energy = energy_on_sphere(surface, start, resolve_device(device), term.weight, area_weight=term.area)
    return approached(energy, sphere)


def approached(energy: TransportEnergy, points: Floats) -> Floats:
    """Return a map nearer to the optimal one, by penalties on errors of areas that grow.

    Args:
        energy: what is minimised.
        points: a map without flips, shape [V, 3], or [V, 2] in the plane.
    """
    least = partial(minimise, energy, gain=PENALISED_GAIN, iterations=PENALISED_STEPS, progress=None)
    for penalty in PENALTIES:
        points = least(points, penalty=penalty).points
    return points


def _carried(coarse: Coarse, first: Floats, start: Floats, device: str | None) -> Floats:
    """Return the optimal map of a triangulation from a first one, carried to the surface; triangles may be flipped."""
    term = shape_term(coarse.surface, first, start, device)
    solve = partial(optimal_map, shape_weight=term.weight, area_weight=term.area, iterations=STEPS, device=device)
    return coarse.carried(solve(coarse.surface, first, start=start).sphere)


def turned_onto(surface: Surface, sphere: Floats, towards: Floats, device: str | None) -> Floats:
    """Return a map turned onto other points, or as it is where turning flips a triangle."""
    turned = normalised(turned_towards(sphere, towards, surface.vertex_areas))
    return turned if is_bijective(turned, surface.faces, device=device) else sphere
