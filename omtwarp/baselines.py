"""Maps that the paper compares with and that are not stages of its own method: spherical barycentric maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from omtwarp.conformal.centring import centre_points
from omtwarp.conformal.haker import most_regular_face
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.spherical import tangential
from omtwarp.mesh.arrays import TINY
from omtwarp.mesh.checks import MeshLike, as_surface
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.options import Progress
from omtwarp.solvers.poisson import Factorization, LaplacianSolver

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def half_angle_tangent(u: wp.vec3d, v: wp.vec3d) -> wp.float64:
    """Return tan(θ/2) of the angle θ between u and v; sin/(1 + cos) stays accurate at both ends."""
    return wp.length(wp.cross(u, v)) / (wp.length(u) * wp.length(v) + wp.dot(u, v))


@wp.kernel
def mean_value_edge_weights(
    # Mesh:
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    # Data out:
    weights_out: wp.array2d[wp.float64],
):
    """Compute the part of each face in the symmetric weight of its edges (k, k+1): the mean of both directed ones."""
    f = wp.tid()
    p0 = vertices[faces[f, 0]]
    p1 = vertices[faces[f, 1]]
    p2 = vertices[faces[f, 2]]
    t0 = half_angle_tangent(p1 - p0, p2 - p0)
    t1 = half_angle_tangent(p2 - p1, p0 - p1)
    t2 = half_angle_tangent(p0 - p2, p1 - p2)
    weights_out[f, 0] = HALF * (t0 + t1) / wp.length(p1 - p0)
    weights_out[f, 1] = HALF * (t1 + t2) / wp.length(p2 - p1)
    weights_out[f, 2] = HALF * (t2 + t0) / wp.length(p0 - p2)


@wp.kernel
def sweep_vertices(
    # Weights as compressed rows:
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    # Map:
    x: wp.array[wp.vec3d],
    # Data out:
    force_out: wp.array[wp.vec3d],
    tension_out: wp.array[wp.float64],
    deviation_out: wp.array[wp.float64],
):
    """Sweep over the vertices: s_i = Σ w_ij x_j, its tangential part (force), α_i = s_i·x_i (tension) and the
    distance from x_i to s_i / |s_i| (deviation: zero where x_i is the normalised mean of its neighbours)."""
    i = wp.tid()
    s = wp.vec3d()
    for k in range(offsets[i], offsets[i + 1]):
        s += weights[k] * x[columns[k]]
    tension_out[i] = wp.dot(s, x[i])
    force_out[i] = tangential(s, x[i])
    size = wp.length(s)
    deviation = wp.float64(2.0)
    if size > ZERO:
        deviation = wp.length(x[i] - s / size)
    deviation_out[i] = deviation


@wp.kernel
def newton_blocks(
    # Weights as compressed rows; row of every stored entry:
    rows: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    weights: wp.array[wp.float64],
    # Tangent frames:
    frame_u: wp.array[wp.vec3d],
    frame_v: wp.array[wp.vec3d],
    # Data out:
    blocks_out: wp.array[wp.mat22d],
):
    """Compute -w_ij times the 2 x 2 matrix that takes tangent coordinates at x_j to those at x_i."""
    k = wp.tid()
    i = rows[k]
    j = columns[k]
    w = weights[k]
    blocks_out[k] = wp.mat22d(
        -w * wp.dot(frame_u[i], frame_u[j]),
        -w * wp.dot(frame_u[i], frame_v[j]),
        -w * wp.dot(frame_v[i], frame_u[j]),
        -w * wp.dot(frame_v[i], frame_v[j]),
    )


@wp.kernel
def tangent_frames(
    x: wp.array[wp.vec3d],
    # Data out:
    frame_u_out: wp.array[wp.vec3d],
    frame_v_out: wp.array[wp.vec3d],
):
    """Compute an orthonormal frame (u, v) with u × v = x at every point."""
    i = wp.tid()
    p = x[i]
    axis = wp.vec3d(ONE, ZERO, ZERO)
    if wp.abs(p[1]) < wp.abs(p[0]):
        axis = wp.vec3d(ZERO, ONE, ZERO)
    if wp.abs(p[2]) < wp.min(wp.abs(p[0]), wp.abs(p[1])):
        axis = wp.vec3d(ZERO, ZERO, ONE)
    u = wp.normalize(wp.cross(axis, p))
    frame_u_out[i] = u
    frame_v_out[i] = wp.cross(p, u)


@wp.kernel
def move_on_sphere(
    x: wp.array[wp.vec3d],
    direction: wp.array[wp.vec3d],
    step: wp.float64,
    # Data out:
    x_out: wp.array[wp.vec3d],
):
    """Step along the tangential part of a direction and return to the sphere."""
    i = wp.tid()
    x_out[i] = wp.normalize(x[i] + step * tangential(direction[i], x[i]))


Array = NDArray[np.float64]
Weights = Literal["tutte", "mean-value"]
Balance = Literal["centroid", "free"]
Report = Callable[[str, int, float], None]

RELAXATION_STEPS = 300  # at most: Newton's method does the rest
NEWTON_STEPS = 40  # at most; it doubles its digits at each step once it is near
MOST_STEPS = {"relax": RELAXATION_STEPS, "newton": NEWTON_STEPS}

# Times a length: an angle of π, of a triangle folded flat, has tan(θ/2) = 1.6e16 in float64; more than this is that.
MOST_WEIGHT = 1e15
# Of the weights' sums: makes the Laplacian definite, which has constants for its kernel. It is a preconditioner alone.
SUFFICIENT_DECREASE = 1e-4  # share of the decrease by the slope (Nocedal & Wright, Numerical Optimization, section 3.1)


@dataclass(frozen=True)
class BarycentricMap:
    """A spherical barycentric map and how it was reached.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        weights: ``tutte`` or ``mean-value``.
        balance: ``centroid`` or ``free``.
        residual: largest distance from a vertex to the normalised mean of its neighbours.
        multiplier: the vector λ of the centroid constraint, where the mean weight sum of a vertex is 1; zero for a
            free solution.
        shares: the a_i of the centroid constraint, float64, shape [V], summing to 1.
        energy: E over the mean weight sum of a vertex.
        converged: whether the tolerance of the last stage was met.
        relaxation_steps: gradient steps with the centroid held.
        newton_steps: iterations of Newton's method, constrained and free together.
        history: ``iteration``, ``stage`` (``relax`` or ``newton``) and ``residual`` after it, of both stages.
    """

    sphere: Array
    weights: str
    balance: str
    residual: float
    multiplier: Array
    shares: Array
    energy: float
    converged: bool
    relaxation_steps: int
    newton_steps: int
    history: list[dict[str, str | float]] = field(default_factory=list)

    @property
    def iterations(self) -> int:
        """Iterations of all stages together."""
        return self.relaxation_steps + self.newton_steps


def barycentric_map(
    surface: MeshLike,
    *,
    weights: Weights = "tutte",
    balance: Balance = "centroid",
    device: str | None = "auto",
    progress: Progress | None = None,
) -> BarycentricMap:
    """Map a closed genus-0 surface to the sphere so that vertices are means of their neighbours.

    Solves the quadratic system of Gotsman, Gu and Sheffer (2003), see the module's docstring for the method: the maps
    ``Saba Tutte`` and ``Saba Mean`` of the paper's Tables 1 and 2 and Figure 13.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes.
        weights: ``tutte`` (all 1) or ``mean-value`` (Floater 2003, made symmetric).
        balance: ``centroid`` or ``free``, see above.
        device: where the sweeps over vertices run.
        progress: called as ``progress("relax" or "newton", iteration, most, {"residual": residual})``.

    Returns:
        The map with its residual and iterations. For any positive weights and any mesh the planar start is a valid
        embedding; flips of the result are measured by :func:`omtwarp.metrics.distortion`, not assumed away.

    Raises:
        OmtwarpError: the mesh cannot be mapped, an option is unknown, or weights are not finite (triangles without
            area).

    Example:
        >>> import numpy as np, omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> sphere = omtwarp.barycentric_map(surface, weights="mean-value", device="cpu").sphere
        >>> bool(np.allclose(np.linalg.norm(sphere, axis=1), 1.0))
        True
    """
    if weights not in ("tutte", "mean-value"):
        raise OmtwarpError(f"unknown weights '{weights}': use tutte or mean-value")
    if balance not in ("centroid", "free"):
        raise OmtwarpError(f"unknown balance '{balance}': use centroid or free")
    surface = as_surface(surface)
    matrix = barycentric_weights(surface, weights, device=device)
    springs = _Springs(matrix, device)
    start, masses = _planar_start(surface, springs, weights)
    history: list[dict[str, str | float]] = []

    def report(stage: str, step: int, residual: float) -> None:
        history.append({"iteration": len(history), "stage": stage, "residual": residual})
        if progress is not None:
            progress(stage, step, MOST_STEPS[stage], {"residual": residual})

    sphere = _relax(springs, start, masses, report)
    relaxation_steps = len(history)
    sphere, multiplier, converged = _newton(springs, sphere, masses, report)
    if balance == "free":
        sphere, multiplier, converged = _newton(springs, sphere, None, report)
    state = springs.sweep(sphere)
    return BarycentricMap(
        sphere=sphere,
        weights=weights,
        balance=balance,
        residual=state.residual,
        multiplier=multiplier,
        shares=masses,
        energy=state.energy,
        converged=converged,
        relaxation_steps=relaxation_steps,
        newton_steps=len(history) - relaxation_steps,
        history=history,
    )


def barycentric_weights(
    surface: Surface, weights: Weights = "tutte", *, device: str | None = "auto"
) -> sparse.csr_matrix:
    """Return the symmetric positive weights w_ij as a matrix, shape [V, V], zero diagonal.

    ``mean-value``: ½ (w_ij + w_ji) with w_ij = (tan(γ/2) + tan(δ/2)) / |x_i - x_j|, γ and δ the angles at i on both
    sides of the edge (Floater, "Mean value coordinates", 2003).

    Raises:
        OmtwarpError: a triangle without area.
    """
    faces = surface.faces
    if weights == "tutte":
        per_edge = np.full((len(faces), 3), 0.5)
    else:
        where = resolve_device(device)
        vertices = wp.array(surface.scaled_vertices, dtype=wp.vec3d, device=where)
        triangles = wp.array(faces, dtype=wp.int32, device=where)
        out = wp.empty((len(faces), 3), dtype=wp.float64, device=where)
        wp.launch(mean_value_edge_weights, dim=len(faces), inputs=[vertices, triangles, out], device=where)
        per_edge = out.numpy()
        # tan(θ/2) explodes at angles of π: a triangle folded flat.
        bad = ~(np.isfinite(per_edge) & (per_edge > 0) & (per_edge < MOST_WEIGHT)).all(axis=1)
        if bad.any():
            raise OmtwarpError(
                f"mean-value weights need triangles with area: {int(bad.sum())} have none, first face "
                f"{int(np.argmax(bad))}; collapse or remesh them"
            )
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    half = sparse.csr_matrix((per_edge.ravel(), (tail, head)), shape=(surface.vertex_count,) * 2)
    matrix = sparse.csr_matrix(half + half.T)
    matrix.sort_indices()
    return matrix


@dataclass(frozen=True)
class _State:
    """The result of one sweep over the vertices."""

    force: Array
    tension: Array
    residual: float
    energy: float


class _Springs:
    """The weights on a device, scaled so that the mean weight sum of a vertex is 1, and the sweeps over them."""

    def __init__(self, matrix: sparse.csr_matrix, device: str | None):
        self.matrix = sparse.csr_matrix(matrix / (matrix.sum() / matrix.shape[0]))
        self.degree = np.asarray(self.matrix.sum(axis=1)).ravel()
        self.count: int = self.matrix.shape[0]
        self.device = resolve_device(device)
        rows = np.repeat(np.arange(self.count), np.diff(self.matrix.indptr))
        self._offsets = wp.array(self.matrix.indptr.astype(np.int32), dtype=wp.int32, device=self.device)
        self._columns = wp.array(self.matrix.indices.astype(np.int32), dtype=wp.int32, device=self.device)
        self._rows = wp.array(rows.astype(np.int32), dtype=wp.int32, device=self.device)
        self._weights = wp.array(self.matrix.data, dtype=wp.float64, device=self.device)

    def _upload(self, points: Array):
        return wp.array(np.ascontiguousarray(points), dtype=wp.vec3d, device=self.device)

    def sweep(self, points: Array) -> _State:
        force = wp.empty(self.count, dtype=wp.vec3d, device=self.device)
        tension = wp.empty(self.count, dtype=wp.float64, device=self.device)
        deviation = wp.empty_like(tension)
        wp.launch(
            sweep_vertices,
            dim=self.count,
            inputs=[self._offsets, self._columns, self._weights, self._upload(points), force, tension, deviation],
            device=self.device,
        )
        stretch = tension.numpy()
        # E = ½ Σ_ij w_ij (1 - x_i·x_j); the difference is taken per vertex, before anything large is summed.
        energy = 0.5 * float((self.degree - stretch).sum())
        return _State(force.numpy(), stretch, float(deviation.numpy().max()), energy)

    def move(self, points: Array, direction: Array, step: float) -> Array:
        """Step along the tangential part of a direction and return to the sphere."""
        out = wp.empty(self.count, dtype=wp.vec3d, device=self.device)
        inputs = [self._upload(points), self._upload(direction), wp.float64(step), out]
        wp.launch(move_on_sphere, dim=self.count, inputs=inputs, device=self.device)
        return out.numpy()

    def newton_system(
        self, points: Array, tension: Array, aligned: int, axis: Array
    ) -> tuple[sparse.csc_matrix, Array]:
        """Return the second derivative of E in tangent coordinates, [2V, 2V], and the frames, shape [V, 2, 3].

        The first vector of the frame of vertex ``aligned`` is ``axis``.
        """
        u = wp.empty(self.count, dtype=wp.vec3d, device=self.device)
        v = wp.empty_like(u)
        blocks = wp.empty(len(self._rows), dtype=wp.mat22d, device=self.device)
        wp.launch(tangent_frames, dim=self.count, inputs=[self._upload(points), u, v], device=self.device)
        frames = np.stack([u.numpy(), v.numpy()], axis=1)
        frames[aligned] = axis, np.cross(points[aligned], axis)
        u, v = self._upload(frames[:, 0]), self._upload(frames[:, 1])
        inputs = [self._rows, self._columns, self._weights, u, v, blocks]
        wp.launch(newton_blocks, dim=len(self._rows), inputs=inputs, device=self.device)
        size = 2 * self.count
        off = sparse.bsr_matrix((blocks.numpy(), self.matrix.indices, self.matrix.indptr), shape=(size, size))
        matrix = sparse.csc_matrix(off.tocsc() + sparse.diags(np.repeat(tension, 2)))
        return matrix, frames


def _planar_start(surface: Surface, springs: _Springs, weights: str) -> tuple[Array, Array]:
    """Compute Tutte's plane embedding without one triangle, centred on the sphere, and each vertex' share of it.

    The equations are those of section 4.1 with these weights for the cotangents: every vertex but three is a positive
    mean of its neighbours, so the planar drawing is an embedding (Tutte 1963), and the right-hand side gives the outer
    triangle the shape that suits the weights instead of an arbitrary one.
    """
    points = surface.scaled_vertices
    a, b, c = surface.faces[most_regular_face(points, surface.faces)]
    if weights == "tutte":
        length, foot, height = 1.0, 0.5, np.sqrt(3.0) / 2.0
    else:
        ab = points[b] - points[a]
        length = float(np.linalg.norm(ab))
        foot = float(ab @ (points[c] - points[a])) / length
        height = float(np.linalg.norm(points[c] - points[a] - foot / length * ab))
    right = np.zeros((springs.count, 2))
    theta = foot / length
    right[[a, b, c], 0] = [-1.0 / length, 1.0 / length, 0.0]
    right[[a, b, c], 1] = [-(1.0 - theta) / height, -theta / height, 1.0 / height]
    laplacian = sparse.diags(springs.degree) - springs.matrix
    plane = LaplacianSolver(laplacian, pinned=int(a)).solve(right)
    plane = plane - np.median(plane, axis=0)
    plane /= np.median(np.linalg.norm(plane, axis=1))
    squares = (plane**2).sum(axis=1)
    sphere = np.column_stack([2.0 * plane, squares - 1.0]) / (1.0 + squares)[:, None]
    p0, p1, p2 = (sphere[surface.faces[:, k]] for k in range(3))
    if np.median(np.einsum("ij,ij->i", p0, np.cross(p1, p2))) < 0:
        sphere[:, 2] *= -1.0
    masses = surface.vertex_areas if weights == "mean-value" else np.ones(springs.count)
    sphere = centre_points(sphere, masses)[0]
    shares = surface.sum_to_vertices(triangle_areas(sphere, surface.faces))
    shares /= shares.sum()
    return centre_points(sphere, shares)[0], shares


def _relax(springs: _Springs, points: Array, masses: Array, report: Report) -> Array:
    """Minimise E with Σ a_i x_i = 0, by gradient steps preconditioned with the weights' Laplacian.

    Steps are taken at right angles to the Möbius transformations and followed by the one that restores the centroid.
    """
    # The relaxation ends when the root mean square force at right angles to the constraint is below this.
    relaxation_tolerance = 1e-6
    # Of the weights' sums: makes the Laplacian definite, which has constants for its kernel. It is a preconditioner
    # alone.
    regularisation = 0.001
    solver = Factorization(sparse.diags((1.0 + regularisation) * springs.degree) - springs.matrix)
    state = springs.sweep(points)
    step = 1.0
    for iteration in range(RELAXATION_STEPS):
        force = state.force - _tangential(points, masses[:, None] * _multiplier(points, masses, state.force))
        if np.sqrt((force**2).sum() / springs.count) <= relaxation_tolerance:
            break
        direction = _tangential(points, solver.solve(force))
        # Take out the part along Möbius transformations: centring would undo it.
        inertia = np.eye(3) - np.einsum("v,vi,vj->ij", masses, points, points)
        boost = np.linalg.solve(inertia, masses @ direction)
        direction -= _tangential(points, np.broadcast_to(boost, points.shape))
        slope = float((force * direction).sum())
        # Shortest step, of the preconditioned gradient: the energy falls by less than its round-off along a shorter one
        while step > 1e-6:
            trial, _ = centre_points(springs.move(points, direction, step), masses)
            new = springs.sweep(trial)
            if new.energy <= state.energy - SUFFICIENT_DECREASE * step * slope:
                break
            step *= 0.5
        else:
            break  # the decrease is below the round-off of float64
        points, state = trial, new
        report("relax", iteration, state.residual)
        # Step growth, after a step that was taken, which halving had shortened before; by convention
        step = min(1.0, 1.5 * step)
    return points


def _newton(springs: _Springs, points: Array, masses: Array | None, report: Report) -> tuple[Array, Array, bool]:
    """Find stationary points of E by Newton's method, rotations pinned; with masses, of E where Σ a_i x_i = 0.

    Returns:
        The points, the multiplier λ and whether the tolerance was met.
    """
    # Newton's method ends at this force on any vertex; a vertex' mean weight sum is 1.
    newton_tolerance = 1e-12
    multiplier = np.zeros(3)
    for iteration in range(NEWTON_STEPS + 1):
        state = springs.sweep(points)
        if iteration:
            report("newton", iteration - 1, state.residual)
        force, tension = state.force, state.tension
        if masses is not None:
            multiplier = _multiplier(points, masses, force)
            pull = masses[:, None] * multiplier
            tension = tension - (pull * points).sum(axis=1)
            force = force - _tangential(points, pull)
        if np.abs(force).max() <= newton_tolerance:
            return points, multiplier, True
        if iteration == NEWTON_STEPS:
            break
        pinned, second, axis = _pins(points)
        matrix, frames = springs.newton_system(points, tension, second, axis)
        free = np.ones(2 * springs.count, dtype=bool)
        free[[2 * pinned, 2 * pinned + 1, 2 * second]] = False
        factor = splu(matrix[free][:, free].tocsc())

        def solve(right: Array, free: NDArray[np.bool_] = free, factor=factor) -> Array:
            out = np.zeros_like(right)
            out[free] = factor.solve(right[free])
            return out

        solution = solve(np.einsum("vkd,vd->vk", frames, force).ravel())
        if masses is not None:
            constraint = (masses[:, None, None] * frames).reshape(-1, 3)
            answers = solve(constraint)
            solution -= answers @ np.linalg.solve(constraint.T @ answers, constraint.T @ solution + masses @ points)
        direction = np.einsum("vk,vkd->vd", solution.reshape(-1, 2), frames)
        longest = float(np.linalg.norm(direction, axis=1).max())
        if not np.isfinite(longest):
            break
        # Longest step, radians: farther away a tangent plane does not approximate the sphere
        points = springs.move(points, direction, min(1.0, 0.3 / max(longest, TINY)))
    return points, multiplier, False


def _multiplier(points: Array, masses: Array, force: Array) -> Array:
    """Return the λ whose pull a_i λ comes nearest to the forces, in the least squares sense."""
    gram = np.einsum("v,vij->ij", masses**2, np.eye(3) - points[:, :, None] * points[:, None, :])
    return np.linalg.solve(gram, masses @ force)


def _pins(points: Array) -> tuple[int, int, Array]:
    """Return the vertex to fix, a second about a right angle away, and the direction in which the second is fixed.

    The forces add up to no torque, so that the three equations left out hold by themselves.
    """
    second = int(np.argmin(np.abs(points @ points[0])))
    axis = np.cross(points[0], points[second])
    return 0, second, axis / np.linalg.norm(axis)


def _tangential(points: Array, vectors: Array) -> Array:
    return np.asarray(vectors - (points * vectors).sum(axis=1)[:, None] * points)
