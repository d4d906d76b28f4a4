"""The optimal map of a doubled surface among its mirror-symmetric maps, at the cost of solving on one half.

On symmetric maps the energy of the double is twice that of the half, and a step that keeps the symmetry is one of the
half in which vertices of the boundary slide along the equator: the natural condition. So the saddle-point system of
:mod:`omtwarp.optimal.solver` is solved on the half alone, with half the cells, masses and areas at the boundary and no
motion across it; the other half moves as the mirror image, and the boundary has z = 0 to the last bit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.mesh.surface import Surface
from omtwarp.optimal.energy import AREA_WEIGHT, MapTerms, TransportEnergy
from omtwarp.optimal.solver import GAIN, SHAPE_WEIGHT, OptimalMap, minimise
from omtwarp.options import Progress
from omtwarp.solvers.mesh_factor import SaddlePointFactor, saddle_factor
from omtwarp.topology.doubling import Double
from omtwarp.triangle_newton.motion_kernels import from_tangent, to_tangent
from omtwarp.untangling.steps import FlipFreeSteps

Floats = NDArray[np.float64]

ACROSS = np.array([1.0, 1.0, -1.0])  # what the reflection about the equator does to coordinates


def folded(double: Double, vectors_: Floats) -> Floats:
    """Points or tangent vectors made symmetric: the copy gets mirror images of the surface's, the boundary z = 0.

    Args:
        double: the surface and its copy, W vertices.
        vectors_: shape [W, 3].
    """
    out = vectors_.copy()
    out[double.on_boundary, 2] = 0.0
    count = double.half_count
    out[count:] = out[double.mirror[count:]] * ACROSS
    return out


def folded_map(double: Double, sphere: Floats) -> Floats:
    """A map made symmetric, shape [W, 3]: see :func:`folded`; the boundary is put back on its circle."""
    out = folded(double, sphere)
    rim = np.flatnonzero(double.on_boundary & (sphere[:, 2] != 0.0))
    out[rim] /= np.linalg.norm(out[rim], axis=1)[:, None]
    return out


@blas_threads(1)
def symmetric_optimal_map(
    double: Double,
    surface: Surface,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    shape_weight: float = SHAPE_WEIGHT,
    area_weight: float = AREA_WEIGHT,
    multipliers: ArrayLike | None = None,
    iterations: int = 40,
    gain: float = GAIN,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> OptimalMap:
    """Minimise transport cost over the mirror-symmetric maps of a double that keep the areas around vertices.

    Args:
        double: the surface and its copy, W vertices.
        surface: the double as a surface, with the areas that are to be kept.
        sphere: a symmetric map without flips to begin with (see :func:`folded_map`), shape [W, 3].
        start: the points x that are transported, symmetric, shape [W, 3].
        shape_weight, area_weight, multipliers, iterations, gain, device, progress: as of :func:`omtwarp.optimal_map`.

    Returns:
        The map, symmetric to the last bit.

    Raises:
        OmtwarpError: the map given has flipped triangles.
    """
    where = resolve_device(device)
    given, x = (np.array(points, dtype=np.float64) for points in (sphere, start))
    energy = SymmetricEnergy(double, surface, vectors(x, where), where, shape_weight, area_weight=area_weight)
    return minimise(energy, given, multipliers=multipliers, gain=gain, iterations=iterations, progress=progress)


class SymmetricEnergy(TransportEnergy):
    """Evaluates symmetric maps of a double: as its base, with systems and steps of one half.

    Args:
        double: the surface and its copy, W vertices.
        surface: the double as a surface.
        start, device, shape_weight, cost_weight, area_weight: as of :class:`TransportEnergy`.
    """

    local_steps = False  # those would move one half alone

    def __init__(
        self,
        double: Double,
        surface: Surface,
        start: wp.array,
        device: wp.Device,
        shape_weight: float,
        cost_weight: float = 1.0,
        area_weight: float = AREA_WEIGHT,
    ):
        super().__init__(surface, start, device, shape_weight, cost_weight, area_weight)
        self._double = double
        self._factor = MirrorFactor(double, surface, device)

    def saddle_factor(self) -> SaddlePointFactor:
        """Solve on the half the systems of the double that :meth:`blocks` gives."""
        return self._factor

    def flip_free_steps(self) -> FlipFreeSteps:
        """Move symmetric maps to symmetric maps."""
        return SymmetricSteps(self._double, self.surface, self.device)

    def blocks(
        self, points: wp.array, terms: MapTerms, curvature_share: float, least: float
    ) -> tuple[Floats, Floats, Floats]:
        """Blocks of the base, for a factorisation at these points."""
        self._factor.at(points)
        return super().blocks(points, terms, curvature_share, least)


class MirrorFactor:
    """Solves symmetric saddle-point systems of a double for their symmetric solutions, on the half.

    Args:
        double: the surface and its copy, W vertices.
        surface: the double as a surface, E edges.
        device: where maps are.
    """

    def __init__(self, double: Double, surface: Surface, device: wp.Device):
        self._double, self._device = double, device
        self._count = double.half_count
        self._kept = np.flatnonzero((surface.edges < self._count).all(axis=1))
        self._edges = surface.edges[self._kept]
        self._rim = np.flatnonzero(double.on_boundary)
        self._along = np.flatnonzero(double.on_boundary[self._edges].all(axis=1))  # edges of the boundary
        self._share = np.where(double.on_boundary[: self._count], 0.5, 1.0)
        self._factor = saddle_factor(surface.scaled_vertices[: self._count], self._edges)
        self._points: wp.array | None = None
        self._normals = np.zeros((self._count, 2))

    def at(self, points: wp.array) -> None:
        """Take the tangent bases of a symmetric map, vec3d, shape [W], for the matrices to come."""
        self._points = points
        up = np.zeros((len(points), 3))
        up[self._rim, 2] = 1.0
        self._normals = self._coordinates(up)[: self._count]

    def factorise(self, diagonal: Floats, off_diagonal: Floats, gradients: Floats, compliance: Floats) -> None:
        """Factorise a matrix of the double, see :meth:`omtwarp.solvers.cholesky.saddle.SaddleFactor.factorise`.

        Raises:
            NotPositiveDefinite: it is not definite on the half.
        """
        count, rim = self._count, self._rim
        # Across the boundary nothing moves: what would is projected out of the matrix, and given a pivot of its own.
        normal = self._normals[rim]
        outer = normal[:, :, None] * normal[:, None, :]
        projection = np.eye(2) - outer
        own = diagonal[:count] * self._share[:, None, None]
        own[rim] = projection @ own[rim] @ projection + np.trace(own[rim], axis1=1, axis2=2)[:, None, None] * outer
        others = off_diagonal[self._kept].copy()
        others[self._along] *= 0.5
        slopes = gradients[:, self._kept].copy()
        slopes[:, self._along] *= 0.5
        i, j = self._edges.T
        for end, transposed in ((i, False), (j, True)):
            touching = np.flatnonzero(self._double.on_boundary[end])
            across = self._normals[end[touching]]
            blocks = others[touching].transpose(0, 2, 1) if transposed else others[touching]
            blocks = blocks - across[:, :, None] * np.einsum("ea,eab->eb", across, blocks)[:, None, :]
            others[touching] = blocks.transpose(0, 2, 1) if transposed else blocks
            # The areas of the first end by the second one's coordinates come first.
            row = 0 if transposed else 1
            slopes[row, touching] -= across * np.einsum("ea,ea->e", across, slopes[row, touching])[:, None]
        self._factor.factorise(own, others, slopes, compliance[:count] * self._share)

    def solve(self, first: Floats, second: Floats) -> tuple[Floats, Floats]:
        """Solve for coordinates, shape [W, 2], and multipliers, shape [W], of symmetric right-hand sides."""
        count = self._count
        right = first[:count] * self._share[:, None]
        right = right - self._normals * np.einsum("va,va->v", self._normals, right)[:, None]
        u, q = self._factor.solve(right, second[:count] * self._share)
        coordinates = np.zeros((len(first), 2))
        coordinates[:count] = u
        step = wp.empty(len(first), dtype=wp.vec3d, device=self._device)
        inputs = [self._points, wp.array(coordinates, dtype=wp.float64, device=self._device)]
        wp.launch(from_tangent, dim=len(first), inputs=inputs, outputs=[step], device=self._device)
        return self._coordinates(folded(self._double, step.numpy())), np.concatenate(
            [q, q[self._double.mirror[count:]]]
        )

    def _coordinates(self, tangent: Floats) -> Floats:
        """Tangent vectors, shape [W, 3], in the bases of the map, shape [W, 2]."""
        out = wp.empty((len(tangent), 2), dtype=wp.float64, device=self._device)
        inputs = [self._points, vectors(tangent, self._device)]
        wp.launch(to_tangent, dim=len(tangent), inputs=inputs, outputs=[out], device=self._device)
        return out.numpy()


class SymmetricSteps(FlipFreeSteps):
    """Moves symmetric maps of a double; only the surface's own triangles are looked at, the others are their images.

    Args:
        double: the surface and its copy.
        surface: the double as a surface.
        device: a Warp device.
    """

    def __init__(self, double: Double, surface: Surface, device: wp.Device):
        super().__init__(surface, device)
        self._double = double

    def _admitted(self, sphere: Floats) -> Floats:
        return folded_map(self._double, sphere)

    def _counted(self, faces: NDArray[np.bool_]) -> NDArray[np.bool_]:
        own = faces.copy()
        own[len(faces) // 2 :] = False
        return own

    def _moved(self, points: wp.array, direction: wp.array, share: wp.array | None, length: float) -> wp.array:
        return vectors(self._admitted(super()._moved(points, direction, share, length).numpy()), self._device)

    def _trouble(self, moved: wp.array, volume: wp.array) -> NDArray[np.bool_] | None:
        trouble = super()._trouble(moved, volume)
        if trouble is None:
            return None
        own = self._counted(trouble)
        return own if own.any() else None


__all__ = ["MirrorFactor", "SymmetricEnergy", "SymmetricSteps", "folded", "folded_map", "symmetric_optimal_map"]
