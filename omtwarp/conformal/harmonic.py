"""The discrete harmonic map to the sphere: the points x that transport is measured from.

Section 4.1's map solves a Laplace equation in the plane with one triangle removed, which is exact to first order in the
size of the triangles. From there this module minimises the Dirichlet energy on the sphere itself (Gu, Wang, Chan,
Thompson and Yau 2004) [1]_,

    E(y) = ½ Σ w_ij |y_i - y_j|²   subject to   |y_v| = 1,   Σ m_v y_v = 0,

with the cotangent weights w of the intrinsic Delaunay triangulation, which are positive, and with m the areas around
vertices. The second condition chooses one of the maps that differ by a Möbius transformation, and keeps the image from
shrinking to a point. The minimum is exact to second order; triangles may be flipped in it, as it is a set of points.

Steps are conjugate gradients, preconditioned by the Laplacian, which is factorised once. On a sphere, and by conformal
invariance near every minimum, the second derivative is 1 - 2 / l (l + 1) times the Laplacian on harmonics of degree l:
between 2/3 and 1 times, since the condition on the mean takes away degree 1. Each step divides the error by ten.

.. [1] X. Gu, Y. Wang, T. Chan, P. Thompson, S.-T. Yau, "Genus zero surface conformal mapping and its application to
   brain surface mapping", IEEE Transactions on Medical Imaging 23 (2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.conformal.centring import centre_points
from omtwarp.conformal.haker import conformal_map, intrinsic_solver
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.intrinsic import intrinsic_edges
from omtwarp.mesh.arrays import Floats, normalised
from omtwarp.mesh.checks import MeshLike, as_sphere, as_surface
from omtwarp.mesh.surface import Surface
from omtwarp.options import Progress, Record, tell
from omtwarp.solvers.poisson import PoissonSolver, edge_laplacian

STEPS = 60  # most steps
GAIN = 1e-13  # relative to the energy: a step that is expected to gain less is not taken


@dataclass(frozen=True)
class HarmonicMap:
    """The points of a discrete harmonic map.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3]; their mean, weighted by area, is 0.
        history: one record per step, the start first: ``energy``, and ``length``, that of the step.
        converged: whether the last step was expected to gain a share of ``GAIN`` or less.
    """

    sphere: Floats
    history: list[Record]
    converged: bool


@blas_threads(1)
def harmonic_points(
    surface: MeshLike, *, start: ArrayLike | None = None, device: str | None = "auto", progress: Progress | None = None
) -> HarmonicMap:
    """Return the discrete harmonic map of a closed genus-0 surface, Möbius-centred.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices.
        start: points near the map, unit vectors, shape [V, 3]; section 4.1's map with the same weights if left out.
        device: where the per-vertex kernels run; the linear systems are solved on the host.
        progress: called as ``progress("conformal", step, most, record)``, the last time with the most.

    Returns:
        The points. Their second-order error falls with the square of the triangles' size on closed forms.

    Raises:
        OmtwarpError: the mesh cannot be mapped, or its points crowd so that they cannot be centred.

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(8)
        >>> found = omtwarp.harmonic_points(ball, device="cpu")
        >>> found.converged, omtwarp.distortion(ball, found.sphere).angle["surface"] < 2.0001
        (True, True)
    """
    surface = as_surface(surface)
    if start is None:
        mapped = conformal_map(surface, intrinsic=True, device=device)
        given, solver = mapped.sphere, mapped.solver
    else:
        given, solver = as_sphere(start, surface), intrinsic_solver(surface)
    masses = surface.vertex_areas
    energy = _DirichletEnergy(surface, solver)
    sphere, _ = centre_points(given, masses, device=device)
    value = energy.value(sphere)
    history: list[Record] = [{"iteration": 0, "energy": value, "length": 0.0}]
    before: tuple[Floats, Floats, float] | None = None  # direction, slope and gain of the step before
    converged = False
    for number in range(1, STEPS + 1):
        tell(progress, "conformal", number - 1, STEPS, history[-1])
        pull = energy.pull(sphere)
        slope = _tangent(sphere, pull)
        steepest = energy.preconditioned(sphere, slope)
        gain = float((slope * steepest).sum())
        if gain <= GAIN * value:
            converged = True
            break
        direction = -steepest
        if before is not None:
            turned = max(float((steepest * (slope - before[1])).sum()) / before[2], 0.0)
            conjugate = direction + turned * _tangent(sphere, before[0])
            direction = conjugate if float((conjugate * slope).sum()) < 0.0 else direction
        curvature = energy.curvature(sphere, pull, direction)
        length = -float((direction * slope).sum()) / curvature if curvature > 0.0 else 1.0
        shortest, moved = 2.0**-10 * length, None  # below this share of a step none lowers the energy
        while length >= shortest:
            moved = _centred(normalised(sphere + length * direction), masses, device)
            if moved is not None and (lower := energy.value(moved)) < value:
                break
            moved, length = None, 0.5 * length
        if moved is None:
            break
        before = direction, slope, gain
        sphere, value = moved, lower
        history.append({"iteration": number, "energy": value, "length": length})
    tell(progress, "conformal", STEPS, STEPS, history[-1])
    return HarmonicMap(sphere, history, converged)


class _DirichletEnergy:
    """The Dirichlet energy of centred maps of a surface to the sphere, and its derivatives.

    Args:
        surface: closed, V vertices.
        solver: of the Laplacian of its intrinsic Delaunay triangulation.
    """

    def __init__(self, surface: Surface, solver: PoissonSolver):
        self._ends, self._weights = intrinsic_edges(surface)
        self._masses, self._solver = surface.vertex_areas, solver
        self._laplacian = edge_laplacian(self._ends, self._weights, surface.vertex_count)

    def value(self, sphere: Floats) -> float:
        """Return ½ Σ w |y_i - y_j|²."""
        i, j = self._ends.T
        return 0.5 * float(self._weights @ ((sphere[i] - sphere[j]) ** 2).sum(axis=1))

    def pull(self, sphere: Floats) -> Floats:
        """Return L y, shape [V, 3]; its tangent part is the gradient."""
        return np.asarray(self._laplacian @ sphere)

    def curvature(self, sphere: Floats, pull: Floats, direction: Floats) -> float:
        """Return the second derivative d · (L - y · L y) d along a tangent direction d, from L y."""
        normal = (sphere * pull).sum(axis=1)
        return float((direction * (self._laplacian @ direction - normal[:, None] * direction)).sum())

    def preconditioned(self, sphere: Floats, slope: Floats) -> Floats:
        """Return the tangent step z that L and the condition on the mean give a slope r, shape [V, 3].

        With B = m P, P the projections to the tangent planes, L u + B p = r and Bᵀ u = 0 determine u, and z = P u.
        """
        masses = self._masses[:, None]
        mean = float(masses.sum()) * np.eye(3) - (masses * sphere).T @ sphere  # Σ B
        pull = np.linalg.solve(mean, slope.sum(axis=0))
        moved = self._solver.solve(slope - masses * _tangent(sphere, pull))
        shift = np.linalg.solve(mean, (masses * _tangent(sphere, moved)).sum(axis=0))
        return _tangent(sphere, moved - shift)


def _tangent(sphere: Floats, vectors: Floats) -> Floats:
    """Return vectors, shape [V, 3] or [3], less their parts normal to the sphere at its points."""
    return vectors - (sphere * vectors).sum(axis=1)[:, None] * sphere


def _centred(sphere: Floats, masses: Floats, device: str | None) -> Floats | None:
    """Return points moved by the Möbius transformation that centres them; None where there is none."""
    try:
        return centre_points(sphere, masses, device=device)[0]
    except OmtwarpError:
        return None
