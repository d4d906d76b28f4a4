"""Registration among maps that keep the areas around vertices, with the multipliers of the optimal map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.optimal.cells import RingCells
from omtwarp.optimal.energy import MapTerms, TransportEnergy
from omtwarp.optimal.restoration import restore_areas
from omtwarp.optimal.sphere import GeodesicCost, Sphere, SphereShape
from omtwarp.refine.energy import DistortionEnergy, Terms
from omtwarp.refine.vertex_term import VertexTerm
from omtwarp.spheres import triangle_solid_angles

Floats = NDArray[np.float64]


def areas_around(points: Floats, faces: NDArray[np.int32]) -> Floats:
    """Return the solid angles of the triangles around every vertex of a sphere, shape [V]; they sum to 12π.

    Args:
        points: unit vectors, shape [V, 3].
        faces: shape [F, 3].
    """
    solid = triangle_solid_angles(*(points[faces[:, k]] for k in range(3)))
    return np.bincount(faces.ravel(), np.repeat(solid, 3), len(points)).astype(np.float64)


class WarpEnergy(TransportEnergy):
    """The energy of registration, with the areas around the vertices of a sphere as constraints.

    The cost of transport counts nothing; in its place are the distortion, the barrier of strain and a term at vertices.

    Args:
        sphere: what is warped.
        area_weight: of the areas of triangles against their angles.
        most_strain, vertex_term: as of :class:`omtwarp.refine.energy.DistortionEnergy`.
    """

    def __init__(
        self,
        sphere: Surface,
        area_weight: float,
        most_strain: float | None = None,
        vertex_term: VertexTerm | None = None,
    ):
        device = resolve_device("cpu")
        self.distortion = DistortionEnergy(sphere, device, most_strain=most_strain, vertex_term=vertex_term)
        cells, shape = RingCells(sphere, device), SphereShape(self.distortion)
        cells.wanted = areas_around(sphere.vertices, sphere.faces)
        cost = GeodesicCost(sphere, vectors(sphere.vertices, device), device)
        domain, workspace = Sphere(sphere, device), self.distortion.workspace
        super().__init__(domain, cells, cost, shape, 1.0, 0.0, area_weight, workspace=workspace)

    def cost(self, terms: MapTerms) -> float:
        """Return 4π, a mean of 1: gains are compared with the distortion, not with a cost."""
        return SPHERE_AREA

    def blocks(
        self, points: wp.array, terms: MapTerms, curvature_share: float, least: float
    ) -> tuple[Floats, Floats, Floats]:
        """Return what the base class does, with the term at vertices on the diagonal."""
        diagonal, off_diagonal, gradients = super().blocks(points, terms, curvature_share, least)
        assert isinstance(terms.shape, Terms)
        further = self.distortion.vertex_blocks(points, terms.shape)
        return (diagonal if further is None else diagonal + further), off_diagonal, gradients


def with_areas(sphere: Surface, warp: Floats, area_weight: float) -> Floats:
    """Return the warp nearest to one given, shape [V, 3], that keeps the areas around all vertices to 1e-6.

    Args:
        sphere: before the warp.
        warp: unit vectors, no triangle flipped, shape [V, 3].
        area_weight: as of :class:`WarpEnergy`.
    """
    return restore_areas(WarpEnergy(sphere, area_weight), warp)[0]


def area_changes(before: Floats, after: Floats, faces: NDArray[np.int32]) -> dict[str, float]:
    """Return the root mean square and the largest relative change of the areas around vertices.

    Args:
        before, after: unit vectors, shape [V, 3].
        faces: shape [F, 3].
    """
    wanted = areas_around(before, faces)
    relative = areas_around(after, faces) / wanted - 1.0
    return {
        "rms": float(np.sqrt(wanted @ relative**2 / wanted.sum())),
        "largest": float(np.abs(relative).max()),
    }
