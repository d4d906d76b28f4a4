"""Maps that the paper compares with and that are not stages of its own method: spherical barycentric maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from omtwarp.conformal.centring import centre_points
from omtwarp.conformal.maps import dipole, most_regular_face, plane_to_sphere
from omtwarp.device.policy import resolve_device
from omtwarp.errors import OmtwarpError, check_word
from omtwarp.mesh.arrays import TINY, Floats, InOneLine, cross, dots, normalised, norms, tangential_parts
from omtwarp.mesh.surface import MeshLike, Surface, as_surface, triangle_areas
from omtwarp.options import Progress, tell
from omtwarp.solvers.poisson import Factorization, LaplacianSolver

Weights = Literal["tutte", "mean-value"]
Balance = Literal["centroid", "free"]
Report = Callable[[str, int, float], None]

# Newton's method does what the relaxation leaves, and doubles its digits at each step once it is near.
MOST_STEPS = {"relax": 300, "newton": 40}


@dataclass(frozen=True, repr=False)
class BarycentricMap(InOneLine):
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

    sphere: Floats
    weights: str
    balance: str
    residual: float
    multiplier: Floats
    shares: Floats
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
        device: ``auto``, ``cpu`` or ``cuda:N``, as of other stages; SciPy does the work of this one on the CPU.
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
    check_word("weights", weights, get_args(Weights))
    check_word("balance", balance, get_args(Balance))
    surface = as_surface(surface)
    resolve_device(device)
    springs = _Springs(barycentric_weights(surface, weights))
    start, masses = _planar_start(surface, springs, weights)
    history: list[dict[str, str | float]] = []

    def report(stage: str, step: int, residual: float) -> None:
        history.append({"iteration": len(history), "stage": stage, "residual": residual})
        tell(progress, stage, step, MOST_STEPS[stage], {"residual": residual})

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


def barycentric_weights(surface: Surface, weights: Weights = "tutte") -> sparse.csr_matrix:
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
        corners = surface.scaled_vertices[faces]
        ahead = np.roll(corners, -1, axis=1) - corners
        behind = np.roll(corners, 1, axis=1) - corners
        lengths = norms(ahead)
        across = norms(cross(ahead, behind))
        with np.errstate(divide="ignore", invalid="ignore"):
            # tan(θ/2) = sin θ / (1 + cos θ), which stays accurate at both ends.
            tangents = across / (lengths * np.roll(lengths, 1, axis=1) + dots(ahead, behind))
            per_edge = 0.5 * (tangents + np.roll(tangents, -1, axis=1)) / lengths
        # The tangent at an angle of π, of a triangle folded flat, is 1.6e16 in float64.
        bad = ~(np.isfinite(per_edge) & (per_edge > 0) & (per_edge < 1e15)).all(axis=1)
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

    force: Floats
    tension: Floats
    residual: float
    energy: float


class _Springs:
    """The weights, scaled so that the mean weight sum of a vertex is 1, and what they do to points of the sphere."""

    def __init__(self, matrix: sparse.csr_matrix):
        self.matrix = sparse.csr_matrix(matrix / (matrix.sum() / matrix.shape[0]))
        self.degree = np.asarray(self.matrix.sum(axis=1)).ravel()
        self.count: int = self.matrix.shape[0]

    def sweep(self, points: Floats) -> _State:
        sums = self.matrix @ points
        tension = dots(sums, points)
        deviation = norms(points - sums / np.maximum(norms(sums), TINY)[:, None])
        # E = ½ Σ_ij w_ij (1 - x_i·x_j); the difference is taken per vertex, before anything large is summed.
        energy = 0.5 * float((self.degree - tension).sum())
        return _State(tangential_parts(points, sums), tension, float(deviation.max()), energy)

    def newton_system(
        self, points: Floats, tension: Floats, aligned: int, axis: Floats
    ) -> tuple[sparse.csc_matrix, Floats]:
        """Return the second derivative of E in tangent coordinates, [2V, 2V], and the frames, shape [V, 2, 3].

        The first vector of the frame of vertex ``aligned`` is ``axis``.
        """
        first = normalised(cross(np.eye(3)[np.abs(points).argmin(axis=1)], points))
        first[aligned] = axis
        frames = np.stack([first, cross(points, first)], axis=1)
        rows = np.repeat(np.arange(self.count), np.diff(self.matrix.indptr))
        products = np.einsum("kad,kbd->kab", frames[rows], frames[self.matrix.indices])
        blocks = -self.matrix.data[:, None, None] * products
        off = sparse.bsr_matrix((blocks, self.matrix.indices, self.matrix.indptr), shape=(2 * self.count,) * 2)
        return sparse.csc_matrix(off.tocsc() + sparse.diags(np.repeat(tension, 2))), frames


def _planar_start(surface: Surface, springs: _Springs, weights: str) -> tuple[Floats, Floats]:
    """Compute Tutte's plane embedding without one triangle, centred on the sphere, and each vertex' share of it.

    The equations are those of section 4.1 with these weights for the cotangents: every vertex but three is a positive
    mean of its neighbours, so the planar drawing is an embedding (Tutte 1963), and the right-hand side gives the outer
    triangle the shape that suits the weights instead of an arbitrary one.
    """
    points = surface.scaled_vertices
    face = surface.faces[most_regular_face(points, surface.faces)]
    equilateral = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, np.sqrt(0.75), 0.0]])
    right = dipole(springs.count, face, equilateral if weights == "tutte" else points[face])
    plane = LaplacianSolver(sparse.diags(springs.degree) - springs.matrix, pinned=int(face[0])).solve(right)
    masses = surface.vertex_areas if weights == "mean-value" else np.ones(springs.count)
    sphere = centre_points(plane_to_sphere(plane, masses), masses)[0]
    shares = surface.sum_to_vertices(triangle_areas(sphere, surface.faces))
    shares /= shares.sum()
    return centre_points(sphere, shares)[0], shares


def _relax(springs: _Springs, points: Floats, masses: Floats, report: Report) -> Floats:
    """Minimise E with Σ a_i x_i = 0, by gradient steps preconditioned with the weights' Laplacian.

    Steps are taken at right angles to the Möbius transformations and followed by the one that restores the centroid.
    """
    # The relaxation ends when the root mean square force at right angles to the constraint is below this.
    relaxation_tolerance = 1e-6
    # Of the weights' sums: makes the Laplacian definite, which has constants for its kernel. It is a preconditioner
    # alone.
    regularisation = 0.001
    # Share of the decrease by the slope (Nocedal & Wright, Numerical Optimization, section 3.1)
    sufficient = 1e-4
    solver = Factorization(sparse.diags((1.0 + regularisation) * springs.degree) - springs.matrix)
    state = springs.sweep(points)
    step = 1.0
    for iteration in range(MOST_STEPS["relax"]):
        force = state.force - tangential_parts(points, masses[:, None] * _multiplier(points, masses, state.force))
        if np.sqrt((force**2).sum() / springs.count) <= relaxation_tolerance:
            break
        direction = tangential_parts(points, solver.solve(force))
        # Take out the part along Möbius transformations: centring would undo it.
        inertia = np.eye(3) - np.einsum("v,vi,vj->ij", masses, points, points)
        boost = np.linalg.solve(inertia, masses @ direction)
        direction -= tangential_parts(points, np.broadcast_to(boost, points.shape))
        slope = float((force * direction).sum())
        # Shortest step, of the preconditioned gradient: the energy falls by less than its round-off along a shorter one
        while step > 1e-6:
            trial, _ = centre_points(_moved(points, direction, step), masses)
            new = springs.sweep(trial)
            if new.energy <= state.energy - sufficient * step * slope:
                break
            step *= 0.5
        else:
            break  # the decrease is below the round-off of float64
        points, state = trial, new
        report("relax", iteration, state.residual)
        # Step growth, after a step that was taken, which halving had shortened before; by convention
        step = min(1.0, 1.5 * step)
    return points


def _newton(springs: _Springs, points: Floats, masses: Floats | None, report: Report) -> tuple[Floats, Floats, bool]:
    """Find stationary points of E by Newton's method, rotations pinned; with masses, of E where Σ a_i x_i = 0.

    Returns:
        The points, the multiplier λ and whether the tolerance was met.
    """
    # Newton's method ends at this force on any vertex; a vertex' mean weight sum is 1.
    newton_tolerance = 1e-12
    multiplier = np.zeros(3)
    for iteration in range(MOST_STEPS["newton"] + 1):
        state = springs.sweep(points)
        if iteration:
            report("newton", iteration - 1, state.residual)
        force, tension = state.force, state.tension
        if masses is not None:
            multiplier = _multiplier(points, masses, force)
            pull = masses[:, None] * multiplier
            tension = tension - dots(pull, points)
            force = force - tangential_parts(points, pull)
        if np.abs(force).max() <= newton_tolerance:
            return points, multiplier, True
        if iteration == MOST_STEPS["newton"]:
            break
        # Vertex 0 is fixed, and a second about a right angle away in the direction of the axis: the forces add up to no
        # torque, so that the three equations left out hold by themselves.
        second = int(np.argmin(np.abs(points @ points[0])))
        matrix, frames = springs.newton_system(points, tension, second, normalised(cross(points[0], points[second])))
        free = np.ones(2 * springs.count, dtype=bool)
        free[[0, 1, 2 * second]] = False
        factor = splu(matrix[free][:, free].tocsc())

        def solve(right: Floats, free: NDArray[np.bool_] = free, factor=factor) -> Floats:
            out = np.zeros_like(right)
            out[free] = factor.solve(right[free])
            return out

        solution = solve(np.einsum("vkd,vd->vk", frames, force).ravel())
        if masses is not None:
            constraint = (masses[:, None, None] * frames).reshape(-1, 3)
            answers = solve(constraint)
            solution -= answers @ np.linalg.solve(constraint.T @ answers, constraint.T @ solution + masses @ points)
        direction = np.einsum("vk,vkd->vd", solution.reshape(-1, 2), frames)
        longest = float(norms(direction).max())
        if not np.isfinite(longest):
            break
        # Longest step, radians: farther away a tangent plane does not approximate the sphere
        points = _moved(points, direction, min(1.0, 0.3 / max(longest, TINY)))
    return points, multiplier, False


def _multiplier(points: Floats, masses: Floats, force: Floats) -> Floats:
    """Return the λ whose pull a_i λ comes nearest to the forces, in the least squares sense."""
    gram = np.einsum("v,vij->ij", masses**2, np.eye(3) - points[:, :, None] * points[:, None, :])
    return np.linalg.solve(gram, masses @ force)


def _moved(points: Floats, direction: Floats, step: float) -> Floats:
    """Step along the tangential part of a direction and return to the sphere."""
    return normalised(points + step * tangential_parts(points, direction))
