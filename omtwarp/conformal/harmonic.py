"""The discrete harmonic map to the sphere: the points x that transport is measured from.

Section 4.1's map solves a Laplace equation in the plane with one triangle removed, which is exact to first order in the
size of the triangles. From there this module minimises the Dirichlet energy on the sphere itself (Gu, Wang, Chan,
Thompson and Yau 2004) [1]_,

    E(y) = ½ Σ w_ij |y_i - y_j|²   subject to   |y_v| = 1,   Σ m_v y_v = 0,

with the cotangent weights w of the intrinsic Delaunay triangulation, which are positive, and with m the areas around
vertices. The second condition chooses one of the maps that differ by a Möbius transformation, and keeps the image from
shrinking to a point. The minimum is exact to second order; triangles may be flipped in it, as it is a set of points.

.. [1] X. Gu, Y. Wang, T. Chan, P. Thompson, S.-T. Yau, "Genus zero surface conformal mapping and its application to
   brain surface mapping", IEEE Transactions on Medical Imaging 23 (2004).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.conformal.centring import centre_points
from omtwarp.conformal.haker import conformal_map
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.intrinsic import INTRINSIC_EDGES, intrinsic_edges
from omtwarp.mesh.arrays import normalised
from omtwarp.mesh.checks import MeshLike, as_sphere, as_surface
from omtwarp.mesh.surface import Surface
from omtwarp.options import Progress, Record
from omtwarp.solvers.cholesky import NotPositiveDefinite
from omtwarp.solvers.cholesky.dissection import dissect
from omtwarp.solvers.mesh_factor import mesh_factor
from omtwarp.solvers.poisson import edge_laplacian

Numbers = NDArray[np.float64]

STEPS = 30  # most Newton steps
# Masses times these are added to the second derivative until it is positive definite. It has six eigenvalues near zero,
# of rotations and Möbius transformations; a smaller first number costs digits, a larger one steps.
DAMPING = (1e-4, 1e-2, 1.0, 100.0)
SHORTEST = 2.0**-10  # share of a Newton step below which none lowers the energy
GAIN = 1e-10  # relative to the energy: a step that is expected to gain less is the last


@dataclass(frozen=True)
class HarmonicMap:
    """The points of a discrete harmonic map.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3]; their mean, weighted by area, is 0.
        history: one record per Newton step, the start first: ``energy``, and ``length``, the share of the step taken.
        converged: whether the last step was expected to gain a share of ``GAIN`` or less.
    """

    sphere: Numbers
    history: list[Record]
    converged: bool


@blas_threads(1)
def harmonic_points(
    surface: MeshLike,
    *,
    start: ArrayLike | None = None,
    device: str | None = "auto",
    progress: Progress | None = None,
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
    problem = _DirichletEnergy(surface)
    if start is None:
        given = conformal_map(surface, intrinsic=True, device=device).sphere
    else:
        given = as_sphere(start, surface)
    surface.let_go(INTRINSIC_EDGES)  # not needed again, and large
    masses = surface.vertex_areas
    sphere, _ = centre_points(given, masses, device=device)
    energy = problem.value(sphere)
    history: list[Record] = [{"iteration": 0, "energy": energy, "length": 0.0}]
    if progress is not None:
        progress("conformal", 0, STEPS, history[-1])
    converged = False
    for number in range(1, STEPS + 1):
        step, gain = problem.newton_step(sphere)
        if gain <= GAIN * energy:
            converged = True
            break
        length, moved = 1.0, None
        while length >= SHORTEST:
            moved = _centred(normalised(sphere + length * step), masses, device)
            if moved is not None and (lower := problem.value(moved)) < energy:
                break
            moved, length = None, 0.5 * length
        if moved is None:
            break
        sphere, energy = moved, lower
        history.append({"iteration": number, "energy": energy, "length": length})
        if progress is not None:
            progress("conformal", number, STEPS, history[-1])
    if progress is not None:
        progress("conformal", STEPS, STEPS, history[-1])
    return HarmonicMap(sphere, history, converged)


class _DirichletEnergy:
    """The Dirichlet energy of maps of a surface to the sphere, and its Newton steps.

    Args:
        surface: closed, V vertices.
    """

    def __init__(self, surface: Surface):
        found = intrinsic_edges(surface)
        count = surface.vertex_count
        low, high = np.minimum(*found.ends.T), np.maximum(*found.ends.T)
        apart = low != high  # an edge from a vertex to itself has no length on the sphere
        keys, place = np.unique(low[apart] * count + high[apart], return_inverse=True)
        self._ends: NDArray[np.int32] = np.stack([keys // count, keys % count], axis=1).astype(np.int32)
        self._weights: Numbers = np.bincount(place, found.weights[apart]).astype(np.float64)
        self._masses = surface.vertex_areas
        self._laplacian = edge_laplacian(self._ends, self._weights, count)
        points, ends = surface.scaled_vertices, self._ends
        self._factor = mesh_factor(count, ends, lambda: dissect(points, ends), block=2)

    def value(self, sphere: Numbers) -> float:
        """Return ½ Σ w |y_i - y_j|²."""
        i, j = self._ends.T
        return 0.5 * float(self._weights @ ((sphere[i] - sphere[j]) ** 2).sum(axis=1))

    def newton_step(self, sphere: Numbers) -> tuple[Numbers, float]:
        """Return the Newton step of centred points, tangent vectors [V, 3], and the gain that it is expected to have.

        With T the tangent bases, g = Tᵀ L y and H = Tᵀ L T - diag(y · L y), the step T u and the multipliers p of the
        condition on the mean solve H u + B p = -g, Bᵀ u = 0, where B = Tᵀ m.

        Raises:
            OmtwarpError: the second derivative is not finite.
        """
        i, j = self._ends.T
        frames = _tangent_frames(sphere)
        pull = self._laplacian @ sphere
        slope = np.einsum("vki,vi->vk", frames, pull)
        across = -self._weights[:, None, None] * (frames[i] @ frames[j].transpose(0, 2, 1))
        own = self._laplacian.diagonal() - (sphere * pull).sum(axis=1)
        mean = frames * self._masses[:, None, None]
        for share in DAMPING:
            diagonal = (own + share * self._masses)[:, None, None] * np.eye(2)
            try:
                self._factor.factorise(diagonal, across)
            except NotPositiveDefinite:
                continue
            solved = self._factor.solve(np.concatenate([-slope[:, :, None], mean], axis=2))
            free, held = solved[:, :, 0], solved[:, :, 1:]
            multipliers = np.linalg.solve(np.einsum("vki,vkj->ij", mean, held), np.einsum("vki,vk->i", mean, free))
            step = free - held @ multipliers
            return np.einsum("vk,vki->vi", step, frames), -0.5 * float((step * slope).sum())
        raise OmtwarpError("the second derivative of the Dirichlet energy is not finite")


def _tangent_frames(sphere: Numbers) -> Numbers:
    """Return two orthonormal tangent vectors at unit vectors, shape [V, 2, 3]."""
    axes = np.eye(3)[np.argmin(np.abs(sphere), axis=1)]
    first = normalised(np.cross(sphere, axes))
    return np.stack([first, np.cross(sphere, first)], axis=1)


def _centred(sphere: Numbers, masses: Numbers, device: str | None) -> Numbers | None:
    """Return points moved by the Möbius transformation that centres them; None where there is none."""
    try:
        return centre_points(sphere, masses, device=device)[0]
    except OmtwarpError:
        return None


__all__ = ["HarmonicMap", "harmonic_points"]
