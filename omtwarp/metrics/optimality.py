"""How far a map is from optimal transport: the curl left over, a lower bound on the cost, and the exact optimum.

The map sends x_i on the conformal sphere, with mass m_i (the original area around vertex i, 4π in all), to y_i. The
cost is the squared geodesic one, M = Σ m_i d(x_i, y_i)² (equation 6); c = d²/2 inside, where gradients are simpler.

**Curl.** A map is optimal exactly when x is the exponential of a gradient: log_y(x) = -∇ψ(y) with ψ c-concave (McCann
2001). The displacement log_y(x) on the image mesh is split as -∇ψ + J∇H (Hodge), both parts weak, with the operators of
appendix A; the relative curl is ||J∇H|| / ||log_y(x)||.

**Lower bound** (Kantorovich's dual). For any function ψ on the sphere let φ(x) = min over z of c(x, z) - ψ(z). Then
φ(x_i) + ψ(y_j) <= c(x_i, y_j) for all i and j, so every plan that takes {x_i, m_i} to {y_j, m_j} costs at least
Σ m_i (φ(x_i) + ψ(y_i)). Two things make this bound mean something:

* ψ is a function on the whole sphere (quadratic on each image triangle), and the minimum is taken over all of it: over
  a lattice of ``divisions``² / 2 points per triangle by branch and bound, with a proof for every branch left out (what
  the proofs leave open, at most 1e-5 of the mean cost, is conceded), then downhill between them. Were z to run over
  the points y_j alone, the bound would still hold, but no curl that shifts points by less than half an edge could show
  in it: Moser's maps, 0.2 to 1 % off the optimum, would pass as optimal to 1e-4. The lattice contains the y_j, so the
  bound is a theorem about the discrete problem up to round-off; with the whole sphere in the minimum it also holds, up
  to the lattice, for the mass spread out in between.
* ψ comes from the map itself: along an edge (a, b), ψ_b - ψ_a has to lie between c(x_b, y_b) - c(x_b, y_a) and
  c(x_a, y_b) - c(x_a, y_a), or else a and b would gain by swapping partners. The middles of these intervals, weighted
  by one over their widths, are a Poisson problem on the mesh's graph. Ascent steps with the same matrix improve it.

The target of that problem is the image of the masses, which is uniform as far as the map preserves area. The bound
against the exactly uniform sphere, Σ m_i φ(x_i) + ∫ψ, is given too, but it is no yardstick for the map's cost, since
its problem is another one: spreading each point's mass over its own share of the sphere adds about 8π/V, and what the
map lacks in area preservation moves it either way.

**Exact optimum.** On small meshes, the optimal plan between two sets of points from the package POT.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.geometry import DifferentialOperators, cotangent_laplacian
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.metrics import optimality_kernels as kernels
from omtwarp.solvers.poisson import LaplacianSolver

Array = NDArray[np.float64]

DIVISIONS = 8
ASCENT_STEPS = 3
GOOD_ENOUGH = 1e-4
"""Ascent stops at this gap: a tenth of what separates the maps of practice from the optimum."""
TOLERANCE = 1e-5
"""How far below the true minimum, in units of the mean cost, the search for it may stay: what it adds to the gap."""
_NARROWEST = 1e-3  # of the median interval: flipped triangles make empty ones, whose weight must stay finite


@dataclass(frozen=True)
class Optimality:
    """How far a map is from optimal.

    Attributes:
        relative_curl: norm of the curl part of log_y(x) over the norm of log_y(x); 0 for an optimal map.
        cost: M = Σ m_i d(x_i, y_i)², radians² times area; the masses sum to 4π.
        lower_bound: what no rearrangement can go below, same unit.
        gap: cost / lower_bound - 1.
        uniform_lower_bound: the same bound with the exactly uniform sphere for target (see the module's text).
        swapped_edges: edges whose two ends would gain by swapping partners; 0 for an optimal map without flips.
        ascent_steps: improvements of the potential that were made.
        potential: ψ at the y_i, float64, shape [V].
        vertex_gap: what each vertex adds to cost - lower_bound, float64, shape [V].
        stream: H, the part of the displacement that is curl, float64, shape [V].
    """

    relative_curl: float
    cost: float
    lower_bound: float
    gap: float
    uniform_lower_bound: float
    swapped_edges: int
    ascent_steps: int
    potential: Array
    vertex_gap: Array
    stream: Array

    def to_dict(self) -> dict[str, float | int]:
        """The numbers alone, ready for JSON."""
        names = ("relative_curl", "cost", "lower_bound", "gap", "uniform_lower_bound", "swapped_edges", "ascent_steps")
        return {name: getattr(self, name) for name in names}

    def __str__(self) -> str:
        return (
            f"relative curl {self.relative_curl:.4f}  cost {self.cost:.6f}  lower bound {self.lower_bound:.6f}"
            f"  gap {100 * self.gap:.4f} %"
        )


@blas_threads(1)
def optimality(
    conformal: Any,
    sphere: ArrayLike | None = None,
    masses: ArrayLike | None = None,
    faces: ArrayLike | None = None,
    *,
    divisions: int = DIVISIONS,
    ascent_steps: int = ASCENT_STEPS,
    device: str | None = "auto",
    progress: Callable[[str, int, float], None] | None = None,
) -> Optimality:
    """Measure how far a map is from the optimal one (squared geodesic cost).

    Args:
        conformal: the x_i, unit vectors, shape [V, 3]; or a :class:`omtwarp.result.MapResult`, and nothing more.
        sphere: the y_i, unit vectors, shape [V, 3].
        masses: the m_i, shape [V], positive; scaled to sum to 4π.
        faces: shape [F, 3], outward.
        divisions: lattice points are multiples of 1 / divisions in barycentric coordinates.
        ascent_steps: at most this many improvements of the potential; none once the gap is below 1e-4.
        device: where kernels run.
        progress: called with the stage, the step and the gap.

    Returns:
        The report. The bound holds whatever the map is like; flips make it loose, not wrong.

    Raises:
        OmtwarpError: shapes that do not agree, points that are not finite, or masses that are not positive.
    """
    x, y, mass, triangles = _inputs(conformal, sphere, masses, faces)
    if divisions < 1:
        raise OmtwarpError(f"divisions is {divisions}: it must be at least 1")
    surface = Surface(y, triangles)
    dual = _Dual(surface, x, mass, divisions, device)
    curl, stream = _curl_part(surface, dual.log, dual.device)
    best = dual.bound(dual.initial_potential())
    steps = 0
    step: float | None = None
    cost = 2.0 * float(mass @ dual.cost)
    while steps < ascent_steps and 2.0 * best.excess > GOOD_ENOUGH * cost:
        if progress is not None:
            progress("optimality", steps, 2.0 * best.excess / cost)
        direction, slope = dual.ascent_direction(best)
        if slope <= 0:
            break
        if step is None:
            step = best.excess / slope
        for _ in range(6):
            trial = dual.bound(best.potential + step * direction)
            if trial.excess < best.excess:
                break
            step *= 0.4
        else:
            break
        best = trial
        step *= 1.6
        steps += 1
    vertex_gap = 2.0 * mass * best.vertex_gap
    transform = dual.cost - best.potential - best.vertex_gap
    lower = max(cost - float(vertex_gap.sum()), 0.0)  # no plan costs less than nothing
    if lower > 0:
        gap = cost / lower - 1.0
    else:
        gap = 0.0 if cost == lower else float("inf")
    return Optimality(
        relative_curl=curl,
        cost=cost,
        lower_bound=lower,
        gap=gap,
        uniform_lower_bound=2.0 * (float(mass @ transform) + dual.integral(best.potential)),
        swapped_edges=dual.swapped_edges,
        ascent_steps=steps,
        potential=best.potential,
        vertex_gap=vertex_gap,
        stream=stream,
    )


def relative_curl(conformal: ArrayLike, sphere: ArrayLike, faces: ArrayLike, *, device: str | None = "auto") -> float:
    """||J∇H|| / ||log_y(x)|| on the image mesh: the part of the displacement that no gradient accounts for."""
    x, y, _, triangles = _inputs(conformal, sphere, np.ones(len(np.asarray(sphere))), faces)
    surface = Surface(y, triangles)
    return _curl_part(surface, _log_maps(y, x, device), device)[0]


def exact_transport(
    sources: ArrayLike, source_masses: ArrayLike, targets: ArrayLike, target_masses: ArrayLike
) -> tuple[float, float]:
    """The optimal plan between two sets of points on the sphere, by network simplex (POT's ``emd``).

    Memory is 8 bytes for every pair of points, several times over: for a few thousand points.

    Args:
        sources: unit vectors, shape [N, 3].
        source_masses: shape [N], scaled to sum to 4π.
        targets: unit vectors, shape [K, 3].
        target_masses: shape [K], scaled to sum to 4π.

    Returns:
        The least Σ plan_ij d(x_i, z_j)², and Σ m_i d(x_i, z̄_i)² with z̄_i the mean of what the plan makes of x_i. The
        second is free of most of what it costs to spread a point over many targets, and is the one to compare with a
        map's cost when the targets are finer than the sources.

    Raises:
        OmtwarpError: POT is not installed, or its solver gives up.
    """
    try:
        import ot
    except ImportError as error:
        raise OmtwarpError("the exact optimum needs the package POT: pip install 'omtwarp[test]'") from error
    x, z = (np.ascontiguousarray(p, dtype=np.float64) for p in (sources, targets))
    a, b = (np.asarray(w, dtype=np.float64) / np.sum(w) for w in (source_masses, target_masses))
    squared = 2.0 * np.arcsin(np.clip(np.sqrt(np.maximum(2.0 - 2.0 * (x @ z.T), 0.0)) / 2.0, 0.0, 1.0))
    squared *= squared
    plan, log = ot.emd(a, b, squared, numItermax=10_000_000, log=True)
    if log.get("warning"):
        raise OmtwarpError(f"the exact optimum was not found: {log['warning']}")
    mean = plan @ z
    mean /= np.linalg.norm(mean, axis=1)[:, None]
    angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(x - mean, axis=1) / 2.0, 0.0, 1.0))
    return SPHERE_AREA * float((plan * squared).sum()), SPHERE_AREA * float(a @ angle**2)


def sampled_optimum(
    conformal: ArrayLike, sphere: ArrayLike, faces: ArrayLike, face_masses: ArrayLike, *, samples: int | None = None
) -> tuple[float, float]:
    """A map's cost beside the exact optimum onto a sphere sampled without knowledge of the map.

    Both take the mass of every triangle at its middle, which stands for a spread-out mass to second order where a
    vertex with a third of the triangles around it does not. The optimum's targets are points of equal mass on a golden
    spiral, and it is :func:`exact_transport`'s second number that is given: spreading each triangle's mass is no part
    of a map's cost. What is left between the two numbers besides the map's own excess is of the order of the squared
    edge length over the mean squared displacement, and the area that the map does not preserve, of either sign.

    Args:
        conformal: the x_i, unit vectors, shape [V, 3].
        sphere: the y_i, unit vectors, shape [V, 3].
        faces: shape [F, 3].
        face_masses: original areas, shape [F]; scaled to sum to 4π.
        samples: how many targets; twice as many as faces by default. Memory and time grow with F times this.

    Returns:
        The map's cost and the optimum's.

    Raises:
        OmtwarpError: as :func:`exact_transport`.
    """
    x, y, _, triangles = _inputs(conformal, sphere, np.ones(len(np.asarray(sphere))), faces)
    masses = np.asarray(face_masses, dtype=np.float64)
    sources, images = (p[triangles].mean(axis=1) for p in (x, y))
    sources /= np.linalg.norm(sources, axis=1)[:, None]
    images /= np.linalg.norm(images, axis=1)[:, None]
    count = 2 * len(triangles) if samples is None else samples
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - height**2)
    targets = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)
    _, optimum = exact_transport(sources, masses, targets, np.ones(count))
    angle = 2.0 * np.arcsin(np.clip(np.linalg.norm(sources - images, axis=1) / 2.0, 0.0, 1.0))
    return SPHERE_AREA * float(masses @ angle**2) / float(masses.sum()), optimum


@dataclass(frozen=True)
class _Bound:
    """A potential and the c-transform it leads to."""

    potential: Array
    vertex_gap: Array  # c(x_i, y_i) - ψ(y_i) - φ(x_i), never negative
    excess: float  # Σ m_i vertex_gap_i
    face: NDArray[np.int64]  # where the minimum is attained; -1 at y_i itself
    weights: Array
    visited: NDArray[np.int32]  # nodes of the tree that were looked at


class _Dual:
    """The dual problem on a device."""

    def __init__(
        self, surface: Surface, x: Array, mass: Array, divisions: int, device: str | None, tolerance: float = TOLERANCE
    ):
        self.device = resolve_device(device)
        self.surface, self.mass, self.divisions = surface, mass, divisions
        y, count = surface.vertices, surface.face_count
        self._x: Any = wp.array(x, dtype=wp.vec3d, device=self.device)
        self._y: Any = wp.array(y, dtype=wp.vec3d, device=self.device)
        log: Any = wp.empty(len(y), dtype=wp.vec3d, device=self.device)
        wp.launch(kernels.displacement, dim=len(y), inputs=[self._y, self._x, log], device=self.device)
        self.log: Array = log.numpy()
        self.cost: Array = 0.5 * (self.log**2).sum(axis=1)
        self.tolerance = tolerance * float(mass @ self.cost) / float(mass.sum())
        # Triangles near each other in space next to each other in the tree.
        self._order = np.argsort(_morton_codes(y[surface.faces].mean(axis=1)), kind="stable")
        self._faces: Any = wp.array(
            np.ascontiguousarray(surface.faces[self._order]), dtype=wp.vec3i, device=self.device
        )
        self._edge: Any = wp.empty(count, dtype=wp.vec3d, device=self.device)
        inputs = [self._y, self._faces, log, self._edge]
        wp.launch(kernels.edge_bulges, dim=count, inputs=inputs, device=self.device)
        self._leaves = 1 << max(count - 1, 1).bit_length()
        self._solver: Any = None
        self.swapped_edges = 0

    def initial_potential(self) -> Array:
        """The ψ that fits the middles of the admissible differences along all edges best."""
        edges = self.surface.edges
        ends: Any = wp.array(np.ascontiguousarray(edges), dtype=wp.vec2i, device=self.device)
        low: Any = wp.empty(len(edges), dtype=wp.float64, device=self.device)
        high: Any = wp.empty_like(low)
        inputs = [self._x, self._y, ends, low, high]
        wp.launch(kernels.admissible_differences, dim=len(edges), inputs=inputs, device=self.device)
        lowest, highest = low.numpy(), high.numpy()
        self.swapped_edges = int((highest < lowest).sum())
        width = highest - lowest
        floor = max(_NARROWEST * float(np.median(np.abs(width))), np.finfo(float).tiny)
        weights = 1.0 / np.maximum(width, floor)
        weights /= weights.mean()
        rows = np.arange(len(edges)).repeat(2)
        signs = np.tile([-1.0, 1.0], len(edges))
        difference = sparse.csr_matrix((signs, (rows, edges.ravel())), shape=(len(edges), len(self.mass)))
        transposed = difference.T @ sparse.diags(weights)
        self._solver = LaplacianSolver(transposed @ difference)
        return self._solver.solve(transposed @ (0.5 * (lowest + highest)))

    def bound(self, potential: Array) -> _Bound:
        """φ = the c-transform of ψ at every x_i."""
        nodes = 2 * self._leaves
        nodal: Any = wp.array(potential, dtype=wp.float64, device=self.device)
        tree: list[Any] = [
            wp.zeros(nodes, dtype=dtype, device=self.device)
            for dtype in (wp.vec3d, wp.vec3d, wp.vec2d, wp.vec2d, wp.float64, wp.float64)
        ]
        mesh = [self._y, self._faces, nodal, self._edge, self._leaves, self.divisions]
        wp.launch(kernels.build_nodes, dim=nodes, inputs=[*mesh, *tree], device=self.device)
        seeds = self.cost - potential
        count = len(seeds)
        out: list[Any] = [
            wp.empty(count, dtype=dtype, device=self.device)
            for dtype in (wp.float64, wp.float64, wp.int32, wp.vec3d, wp.int32)
        ]
        start: Any = wp.array(seeds, dtype=wp.float64, device=self.device)
        inputs = [self._x, start, *mesh, self.tolerance, *tree, *out]
        wp.launch(kernels.c_transform, dim=count, inputs=inputs, device=self.device)
        leaf = out[2].numpy()
        face = np.where(leaf >= 0, self._order[np.maximum(leaf, 0)], -1)
        gap = seeds - out[1].numpy()
        return _Bound(potential, gap, float(self.mass @ gap), face, out[3].numpy(), out[4].numpy())

    def ascent_direction(self, current: _Bound) -> tuple[Array, float]:
        """Newton-like: where the minima attract mass that the map does not send, ψ has to sink, smoothly.

        The slope of Σ m_i (φ(x_i) + ψ(y_i)) in ψ is the map's own mass minus the mass at the minimisers, and the
        matrix of the initial fit stands for its second derivative.
        """
        moved = current.face >= 0
        mass = self.mass[moved]
        corners = self.surface.faces[current.face[moved]]
        shares = (mass[:, None] * current.weights[moved]).ravel()
        slope = np.bincount(np.flatnonzero(moved), weights=mass, minlength=len(self.mass))
        slope = slope - np.bincount(corners.ravel(), weights=shares, minlength=len(self.mass))
        direction = self._solver.solve(slope)
        return direction, float(direction @ slope)

    def integral(self, potential: Array) -> float:
        """∫ψ over the sphere: the three edge midpoints of every triangle, times its solid angle."""
        y, faces = self.surface.vertices, self.surface.faces[self._order]
        a, b, c = (y[faces[:, k]] for k in range(3))
        triple = np.einsum("ij,ij->i", a, np.cross(b, c))
        solid = 2.0 * np.arctan2(triple, 1.0 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1))
        nodal = potential[faces].mean(axis=1)
        return float(solid @ (nodal + self._edge.numpy().sum(axis=1) / 12.0))


def _curl_part(surface: Surface, log: Array, device: Any) -> tuple[float, Array]:
    """The relative curl of the displacement and its stream function H, shape [V]."""
    where = resolve_device(device)
    mesh = surface.on(where)
    out: Any = wp.empty(surface.face_count, dtype=wp.vec3d, device=where)
    inputs = [mesh.vertices, mesh.faces, vectors(log, where), out]
    wp.launch(kernels.face_displacement, dim=len(out), inputs=inputs, device=where)
    field = out.numpy()
    norm = float(triangle_areas(surface.vertices, surface.faces) @ (field**2).sum(axis=1))
    if norm == 0.0:
        return 0.0, np.zeros(surface.vertex_count)
    operators = DifferentialOperators(surface.vertices, surface.faces, device=str(where))
    # Weakly, <J∇φ, field> = div(J field) tested with φ, since J is antisymmetric and div = -grad'.
    vorticity = operators.divergence(operators.rotate(out)).numpy()
    laplacian = cotangent_laplacian(surface.vertices, surface.faces)
    stream = LaplacianSolver(laplacian).solve(vorticity)
    return float(np.sqrt(max(float(stream @ vorticity), 0.0) / norm)), stream


def _log_maps(base: Array, target: Array, device: str | None) -> Array:
    where = resolve_device(device)
    out: Any = wp.empty(len(base), dtype=wp.vec3d, device=where)
    inputs: list[Any] = [wp.array(p, dtype=wp.vec3d, device=where) for p in (base, target)]
    wp.launch(kernels.displacement, dim=len(base), inputs=[*inputs, out], device=where)
    return out.numpy()


def _inputs(
    conformal: Any, sphere: ArrayLike | None, masses: ArrayLike | None, faces: ArrayLike | None
) -> tuple[Array, Array, Array, NDArray[np.int32]]:
    """Arrays that agree with each other, from arrays or from a result."""
    if sphere is None:
        result = conformal
        if not all(hasattr(result, name) for name in ("vertices", "faces", "sphere", "conformal")):
            raise OmtwarpError("optimality needs a MapResult, or conformal, sphere, masses and faces")
        conformal, sphere, faces = result.conformal, result.sphere, result.faces
        masses = Surface(result.vertices, result.faces).vertex_areas
    if masses is None or faces is None:
        raise OmtwarpError("optimality needs masses and faces beside the two sphere maps")
    x, y = (np.asarray(p, dtype=np.float64) for p in (conformal, sphere))
    mass = np.asarray(masses, dtype=np.float64)
    triangles = np.ascontiguousarray(faces, dtype=np.int32)
    if x.shape != y.shape or x.ndim != 2 or x.shape[1] != 3 or mass.shape != (len(x),):
        raise OmtwarpError(f"shapes do not agree: conformal {x.shape}, sphere {y.shape}, masses {mass.shape}")
    for name, points in (("conformal", x), ("sphere", y)):
        lengths = np.linalg.norm(points, axis=1)
        bad = ~(np.abs(lengths - 1.0) < 1e-3)
        if bad.any():
            raise OmtwarpError(
                f"{int(bad.sum())} points of the {name} map are not on the unit sphere, first {int(np.argmax(bad))}"
            )
    if not (mass > 0).all() or not np.isfinite(mass).all():
        raise OmtwarpError(f"masses must be positive: {int((~(mass > 0)).sum())} are not; remove unused vertices")
    x, y = (np.ascontiguousarray(p / np.linalg.norm(p, axis=1)[:, None]) for p in (x, y))
    return x, y, mass * (SPHERE_AREA / mass.sum()), triangles


def _morton_codes(points: Array) -> NDArray[np.int64]:
    """Interleaved bits of the coordinates of points in the unit ball, ten a coordinate, shape [n]."""
    cell = np.clip(((points + 1.0) * 512.0).astype(np.int64), 0, 1023)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cell = (cell | (cell << shift)) & mask
    return cell[:, 0] | (cell[:, 1] << 1) | (cell[:, 2] << 2)
