"""How far a map is from optimal transport: the remaining curl, and a lower bound on the cost.

The map sends x_i on the conformal sphere, with mass m_i (the original area around vertex i, 4π in all), to y_i. The
cost is the squared geodesic one, M = Σ m_i d(x_i, y_i)² (equation 6); c = d²/2 inside, where gradients are simpler.

**Curl.** A map is optimal exactly when x is the exponential of a gradient: log_y(x) = -∇ψ(y) with ψ c-concave (McCann
2001). The displacement log_y(x) on the image mesh is split as -∇ψ + J∇H (Hodge), both parts weak, with the operators of
appendix A; the relative curl is ||J∇H|| / ||log_y(x)||.

**Lower bound** (Kantorovich's dual). For any function ψ on the sphere let φ(x) = min over z of c(x, z) - ψ(z). Then
φ(x_i) + ψ(y_j) <= c(x_i, y_j) for all i and j, so every plan that takes {x_i, m_i} to {y_j, m_j} costs at least
Σ m_i (φ(x_i) + ψ(y_i)). Three properties make the bound tight:

* ψ is a function on the whole sphere, and the minimum is taken over all of it, by branch and bound in a tree of parts
  of triangles, with a proof for every branch left out (the tolerance of the proofs, at most 1e-5 of the mean cost, is
  subtracted) and the minimum of a quadratic in each other part. With z restricted to the points y_j the bound would
  still hold, but would not detect curl that shifts points by less than half an edge: Moser's maps, 0.2 to 1 % off the
  optimum, would pass as optimal to 1e-4. The proofs hold at the corners of parts and the middles of their edges, to
  round-off; the y_j are among them, so the bound is a theorem about the discrete problem. In between they hold to third
  order in the edge length of parts, which is at most 0.12. To that accuracy the bound also holds for mass spread out in
  between.
* ψ has the slopes that it has to have, -log_y(x) but for the curl, at both ends of every edge, along which it is cubic.
  For the optimal map of a closed form the gap is 1e-7 on edges of 0.35 radians. With the slopes of log_y(x) itself
  every map would pass; curl moves the minimum away from y_i.
* ψ comes from the map itself: along an edge (a, b), ψ_b - ψ_a has to lie between c(x_b, y_b) - c(x_b, y_a) and
  c(x_a, y_b) - c(x_a, y_a), or else a and b would gain by swapping partners. The middles of these intervals, weighted
  by one over their widths, are a Poisson problem on the mesh's graph. Ascent steps with the same matrix improve it.

The target of that problem is the image of the masses, which is uniform as far as the map preserves area.

**On a flat torus** the method is the same, with c = |x - z|²/2 over the copies of all triangles: in a plane the least
value on a triangle is found exactly.

**Exact optimum.** On small meshes, the optimal plan between two sets of points from the package POT.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError, choose
from omtwarp.mesh.arrays import (
    TINY,
    FinishedMap,
    Floats,
    InOneLine,
    cross,
    dots,
    normalised,
    norms,
    real_number,
    real_numbers,
    squared_norms,
    whole_number,
)
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_sphere, as_surface
from omtwarp.metrics.dual import Bound, MapDual, ascend, log_maps
from omtwarp.options import Cost, CostLike, Progress, Record, tell
from omtwarp.solvers.poisson import EdgeLaplacianSolver

ASCENT_STEPS = 3  # by default, as each costs as much as the bound itself
GOOD_ENOUGH = 1e-4
"""Ascent stops at this gap by default: a tenth of what separates the maps of practice from the optimum."""
STEPS_BEFORE = 3  # ascent, for progress: the curl, the first potential and its bound


@dataclass(frozen=True)
class Curl:
    """The part of a map's displacement that is no gradient.

    Attributes:
        relative: its norm over that of the displacement.
        stream: its stream function H at the y_i, float64, shape [V].
        field: J∇H at the y_i, the mean of the triangles around each, shape [V, 3].
    """

    relative: float
    stream: Floats
    field: Floats


@dataclass(frozen=True, repr=False, kw_only=True)
class TransportGap(InOneLine):
    """How far a map is from optimal.

    Attributes:
        relative_curl: norm of the part of the displacement that is no gradient over that of all of it; 0 for an optimal
            map.
        cost: Σ m_i d(x_i, y_i)², squared lengths times area; the masses sum to 4π.
        lower_bound: a lower bound on the cost of every rearrangement, same unit.
        gap: cost / lower_bound - 1.
        ascent_steps: improvements of the potential that were made.
    """

    relative_curl: float
    cost: float
    lower_bound: float
    gap: float
    ascent_steps: int

    def to_dict(self) -> dict[str, float | int | None]:
        """Return the numbers by name, ready for JSON, with None for one that is not finite."""
        values = {name: value for name, value in vars(self).items() if not isinstance(value, np.ndarray)}
        return {name: value if np.isfinite(value) else None for name, value in values.items()}


@dataclass(frozen=True, repr=False, kw_only=True)
class Optimality(TransportGap):
    """How far a map to the sphere is from optimal: what :class:`TransportGap` has, in radians, and more.

    Attributes:
        swapped_edges: edges whose two ends would gain by swapping partners; 0 for an optimal map without flips.
        potential: ψ at the y_i, float64, shape [V].
        vertex_gap: what each vertex adds to cost - lower_bound, float64, shape [V].
        stream: H, the part of the displacement that is curl, float64, shape [V].
    """

    swapped_edges: int
    potential: Floats
    vertex_gap: Floats
    stream: Floats

    def __str__(self) -> str:
        return (
            f"relative curl {self.relative_curl:.4f}  cost {self.cost:.6f}  lower bound {self.lower_bound:.6f}"
            f"  gap {100 * self.gap:.4f} %"
        )


@blas_threads(1)
def optimality(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    masses: ArrayLike | None = None,
    potential: ArrayLike | None = None,
    ascent_steps: int = ASCENT_STEPS,
    enough: float = GOOD_ENOUGH,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> Optimality:
    """Measure how far a map is from the optimal one (squared geodesic cost).

    Sparse systems are solved in the order of elimination that a :class:`Surface` keeps, so that a second call for one
    surface takes less time.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices.
        sphere: the y_i, unit vectors, shape [V, 3].
        start: the x_i that are transported (the conformal or substitute start), in the same way.
        masses: the m_i, shape [V], positive; scaled to sum to 4π. The surface's areas around vertices by default.
        potential: ψ at the y_i, shape [V], radians²; estimated from the map by default.
        ascent_steps: at most this many improvements of the potential; none where the first bound is below a twentieth
            of the cost.
        enough: the gap at which the improvements end.
        device: where kernels run.
        progress: called as ``progress("optimality", step, most steps, {"gap": gap})``.

    Returns:
        The report. The bound holds for every map; flips make it loose, not wrong.

    Raises:
        OmtwarpError: the mesh or a map cannot be used, or masses that are not positive.

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(3)
        >>> omtwarp.optimality(ball, ball.vertices, start=ball.vertices).gap
        0.0
    """
    surface = as_surface(surface)
    # Normalised again, since the bound's accuracy depends on lengths.
    x, y = normalised(as_sphere(start, surface, "start")), normalised(as_sphere(sphere, surface, "map"))
    mass = _masses(surface.vertex_areas if masses is None else masses, surface.vertex_count)
    enough = real_number(enough, "enough", least=0.0)
    # Of the cost, what a first bound must reach for steps to be taken: one below cannot be raised to a gap that says
    # anything of the map, and each step takes as long. Fans of 20,000 triangles begin at a thirtieth of the cost, and
    # nine bounds brought them to a seventh; fans of 8,000 begin above this, and end at two thirds.
    worth_raising = 0.05
    ascent_steps = whole_number(ascent_steps, "ascent_steps")
    total = STEPS_BEFORE + ascent_steps + 1  # the report itself is the last step

    def notify(step: int, details: Record) -> None:
        tell(progress, "optimality", step, total, details)

    notify(0, {})
    log = log_maps(y, x)
    curl = _curl(surface, y.take(surface.faces, axis=0), log)
    dual = MapDual(surface, x, y, mass, device, slopes=curl.field - log)
    notify(1, {})
    fitted, swapped = dual.initial_potential()
    notify(2, {})
    best = dual.bound(fitted)
    if potential is not None:
        given = real_numbers(potential, "potential", mass.shape)
        best = min(best, dual.bound(given), key=lambda bound: bound.excess)
    cost = 2.0 * float(mass @ dual.cost)
    most = ascent_steps if cost - 2.0 * best.excess >= worth_raising * cost else 0

    def ascended(done: int, ascent: Bound) -> None:
        notify(STEPS_BEFORE + done, {"gap": 2.0 * ascent.excess / cost})

    best, steps = ascend(dual, best, most, _excess_at(cost, enough), ascended)
    vertex_gap = 2.0 * mass * best.vertex_gap
    lower = max(cost - float(vertex_gap.sum()), 0.0)  # no plan costs less than nothing
    notify(total, {"gap": _excess(cost, lower)})
    return Optimality(
        relative_curl=curl.relative,
        cost=cost,
        lower_bound=lower,
        gap=_excess(cost, lower),
        swapped_edges=swapped,
        ascent_steps=steps,
        potential=best.potential,
        vertex_gap=vertex_gap,
        stream=curl.stream,
    )


def map_optimality(
    result: FinishedMap,
    stage: Literal["sphere", "moser", "transported"] = "sphere",
    *,
    ascent_steps: int = ASCENT_STEPS,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> Optimality:
    """Measure how far a map is from optimal: :func:`optimality` of a result.

    Args:
        result: what :func:`omtwarp.map_to_sphere` or :meth:`omtwarp.MapResult.load` returned.
        stage: the final map (``sphere``), or ``moser`` or ``transported`` for the map of that stage.
        ascent_steps: at most this many improvements of the potential.
        device: where kernels run.
        progress: called as ``progress("optimality", step, most steps, {"gap": gap})``.

    Returns:
        The report.

    Raises:
        OmtwarpError: the result has no map of that stage, or is of a surface with holes, handles or several parts,
            whose report says how far it is from optimal.

    Example:
        >>> import omtwarp
        >>> from omtwarp.mesh import shapes
        >>> result = omtwarp.map_to_sphere(shapes.blob(1, 0.3, 4, shapes.icosphere(8)))
        >>> bool(omtwarp.map_optimality(result).gap < 0.1)
        True
    """
    partly = any(getattr(result, name, None) is not None for name in ("part", "filled_faces"))
    if partly or getattr(result, "domain", "sphere") != "sphere":
        raise OmtwarpError(
            "this measure is for closed surfaces of genus 0: of others see report['optimality'], of parts "
            "report['parts']"
        )
    points = getattr(result, stage, None) if str(stage) in ("sphere", "moser", "transported") else None
    if points is None:
        raise OmtwarpError(f"this map has no stage '{stage}'")
    surface, source = Surface(result.vertices, result.faces), getattr(result, "source", None)
    surface.checked = True  # before it was mapped
    start = cast("ArrayLike", result.conformal) if source is None else source
    return optimality(surface, points, start=start, ascent_steps=ascent_steps, device=device, progress=progress)


def _excess_at(cost: float, gap: float) -> float:
    """Return half of what a bound lies below the cost where the gap is as given."""
    return 0.5 * cost * gap / (1.0 + gap)


def _excess(cost: float, bound: float) -> float:
    """Return cost / bound - 1, infinite where the bound is zero."""
    if bound > 0.0:
        return cost / bound - 1.0
    return 0.0 if cost == bound else float("inf")


@dataclass(frozen=True, repr=False, kw_only=True)
class TorusOptimality(TransportGap):
    """How far a map to a torus is from optimal: what :class:`TransportGap` has, on a torus of area 4π, and more.

    Attributes:
        wrapped: vertices that a copy of their image is nearer to; none for an optimal map.
    """

    wrapped: int


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
    x, y, shift, lattice = (np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, 1)]) for a in (x, y, shift, lattice))
    moved = y - x
    cost = float(surface.vertex_areas @ squared_norms(moved))
    curl = _curl(surface, y.take(surface.faces, axis=0) + shift, moved).relative
    dual = MapDual(surface, x, y, surface.vertex_areas, "cpu", shift, lattice)
    best, taken = ascend(dual, dual.bound(dual.initial_potential()[0]), ASCENT_STEPS, _excess_at(cost, GOOD_ENOUGH))
    lower = max(cost - 2.0 * best.excess, 0.0)
    steps = np.array([(i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) != (0, 0)]) @ lattice
    other = squared_norms(moved[:, None] + steps).min(axis=1)
    # As many lattices are symmetric, two ways may be equally long but for rounding.
    wrapped = int((other < squared_norms(moved) * (1.0 - 1e-9)).sum())
    numbers = {"relative_curl": curl, "cost": cost, "lower_bound": lower, "gap": _excess(cost, lower)}
    return TorusOptimality(**numbers, ascent_steps=taken, wrapped=wrapped)


def _curl(surface: Surface, places: Floats, moved: Floats) -> Curl:
    """Compute the part of a displacement on image triangles that is the rotated gradient of a function.

    Args:
        surface: F faces.
        places: of the corners of image triangles, shape [F, 3, 3].
        moved: the displacement of every vertex, shape [V, 3].
    """
    field = moved.take(surface.faces, axis=0).mean(axis=1)
    normal = cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
    doubled = np.maximum(norms(normal)[..., None], TINY)
    field -= dots(field, normal)[..., None] / doubled**2 * normal
    norm = 0.5 * float(doubled[:, 0] @ squared_norms(field))
    if norm <= 1e-24 * SPHERE_AREA:  # a map that moves points by less than 1e-12 has no curl to speak of
        return Curl(0.0, np.zeros(surface.vertex_count), np.zeros((surface.vertex_count, 3)))
    # J times the gradient of a hat function is half the opposite side over the area, turned: the side itself. Weakly,
    # <J∇φ, field> is div(J field) tested with φ, since J is antisymmetric and div = -grad'.
    after, before = np.roll(places, -1, axis=1), np.roll(places, 1, axis=1)
    flux = -0.5 * dots(before - after, field[:, None])
    vorticity: Floats = np.bincount(surface.faces.ravel(), flux.ravel(), surface.vertex_count).astype(np.float64)
    cotangents = dots(after - places, before - places) / doubled
    one, other = cotangents.take(surface.edge_corners.T)
    stream = EdgeLaplacianSolver(surface, 0.5 * (one + other)).solve(vorticity)
    turned = (stream.take(surface.faces)[..., None] * (after - before)).sum(axis=1)  # twice the area times J∇H
    sums = np.stack([surface.sum_to_vertices(of_faces) for of_faces in (*turned.T, doubled[:, 0])], axis=1)
    field = sums[:, :3] / np.maximum(sums[:, 3:], TINY)
    return Curl(float(np.sqrt(max(float(stream @ vorticity), 0.0) / norm)), stream, field)


def relative_curl(
    surface: MeshLike,
    sphere: ArrayLike | wp.array,
    *,
    start: ArrayLike | wp.array,
    cost: CostLike = Cost.SQUARED,
    device: str | None = "auto",
) -> float:
    """Measure ||J∇H|| / ||log_y(x)|| on the image mesh: the part of the displacement that is no gradient.

    With the cost d the optimal map's direction of displacement, log_y(x) / d, is a gradient, and its curl is measured.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes.
        sphere: the y_i, unit vectors, shape [V, 3]; or a Warp array of vec3d.
        start: the x_i, in the same way.
        cost: ``squared`` or ``geodesic`` distance.
        device: not used, as every measure of a map takes it.

    Raises:
        OmtwarpError: the mesh, a map or the cost cannot be used.
    """
    surface, cost = as_surface(surface), choose(Cost, cost)
    x, y = (p.numpy() if isinstance(p, wp.array) else as_sphere(p, surface) for p in (start, sphere))
    log = log_maps(y, x)
    return _curl(surface, y.take(surface.faces, axis=0), normalised(log) if cost == Cost.GEODESIC else log).relative


def _masses(given: ArrayLike, count: int) -> Floats:
    """Check that masses, shape [V], are positive, and scale them to the sum 4π.

    Raises:
        OmtwarpError: another shape, or masses that are not positive.
    """
    mass = real_numbers(given, "masses", (count,))
    if not (mass > 0).all():
        raise OmtwarpError(f"masses must be positive: {int((~(mass > 0)).sum())} are not; remove unused vertices")
    return mass / mass.max() * (SPHERE_AREA / (mass / mass.max()).sum())
