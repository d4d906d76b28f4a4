"""Exact areas of triangles on the disk and on caps, where straight sides make those of a projected map slightly wrong.

Lambert's projection keeps areas of regions, but a triangle with straight sides is not the region that its corners came
from, and the polygon of the boundary's vertices lacks the segments up to its circle. So the map of a quartered mesh is
moved, with its boundary fixed, until each original triangle has its share of that polygon. The polygon's area does not
change on the way.

The remaining errors of areas are corrected as on the sphere (:mod:`omtwarp.optimal.restoration`). Where that takes more
than a few steps it leaves slivers: then distortion is minimised among the maps with exact areas. Where it fails,
distortion is minimised with a penalty on the errors first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.quarter import PARTS, QuarteredSurface
from omtwarp.mesh.surface import SPHERE_AREA, Surface, plane_areas
from omtwarp.open_surfaces.caps import disk_to_cap
from omtwarp.optimal.cells import TriangleCells
from omtwarp.optimal.held import HeldEnergy, HeldSphere
from omtwarp.optimal.plane import Plane, PlaneCost, PlaneShape
from omtwarp.optimal.restoration import restore_areas
from omtwarp.optimal.solver import PENALTY, minimise
from omtwarp.optimal.sphere import NoCost, SphereShape
from omtwarp.refine.energy import DistortionEnergy
from omtwarp.spheres import triangle_solid_angles

Floats = NDArray[np.float64]
FEW = 3  # steps of a correction that leaves the map as it is but at the boundary
GAIN, STEPS = 1e-3, 60  # of the minimisation where more are needed, whose maps have slivers


@dataclass(frozen=True)
class Quartered:
    """A quartered mesh that is mapped to a disk or cap, and the areas that its original triangles are to have.

    Attributes:
        faces: the parts of a triangle one after the other, shape [4 F, 3].
        held: vertices that stay where they are: those of the boundary, shape [V].
        surface: places of the vertices on the surface, shape [V, 3].
        wanted: the areas of the triangles up to a factor, shape [F].
    """

    faces: NDArray
    held: NDArray[np.bool_]
    surface: Floats
    wanted: Floats

    @property
    def middles(self) -> NDArray[np.int32]:
        """The middles of the sides of every original triangle, shape [F, 3]."""
        return self.faces.reshape(-1, PARTS, 3)[:, 3].astype(np.int32)

    def as_surface(self) -> Surface:
        """Return the quartered mesh, whose triangles count by the wanted areas."""
        return Surface(self.surface, self.faces, np.repeat(self.wanted / PARTS, PARTS))

    def cells(self, surface: Surface, total: float) -> TriangleCells:
        """Return the original triangles of the mesh as a surface, whose areas are to add up to a total."""
        quartered = QuarteredSurface(surface, np.empty((0, 2), np.int32), self.middles)
        cells = TriangleCells(quartered, resolve_device("cpu"))
        cells.wanted = cells.wanted * (total / cells.wanted.sum())
        return cells


def exact_in_plane(points: Floats, mesh: Quartered) -> tuple[Floats, float]:
    """Move a map to the unit disk until each original triangle has its share of the boundary's polygon.

    Args:
        points: a map, shape [V, 2].
        mesh: what is mapped.

    Returns:
        The map, and its largest relative error.

    Raises:
        OmtwarpError: no such map without flips was found.
    """
    surface = mesh.as_surface()
    scale = float(np.sqrt(SPHERE_AREA / plane_areas(points[mesh.faces]).sum()))
    plane = Plane(surface, np.zeros((len(mesh.faces), 3, 2)), resolve_device("cpu"))
    cost, shape = PlaneCost(plane, scale * points), PlaneShape(plane)
    energy = HeldEnergy(plane, mesh.held, mesh.cells(surface, SPHERE_AREA), cost, shape)
    found, error = _exact(energy, scale * points)
    return np.where(mesh.held[:, None], points, found / scale), error


def exact_on_cap(points: Floats, mesh: Quartered) -> tuple[Floats, float]:
    """Do the same for a map to a cap, unit vectors, shape [V, 3], whose triangles have great circles as sides."""
    surface, device = mesh.as_surface(), resolve_device("cpu")
    area = float(triangle_solid_angles(*(points[mesh.faces[:, k]] for k in range(3))).sum())
    cost = NoCost(surface, vectors(points, device), device)
    shape = SphereShape(DistortionEnergy(surface, device))
    energy = HeldEnergy(HeldSphere(surface, device), mesh.held, mesh.cells(surface, area), cost, shape)
    found, error = _exact(energy, points)
    return np.where(mesh.held[:, None], points, found), error


def shares_of_polygons(rims: list[Floats], shares: Floats, wanted: Floats) -> Floats:
    """Shrink caps until the polygons on their rims, not the caps, have areas in given proportions.

    Args:
        rims: of each cap, the points on the unit circle, one after the other, that its boundary's vertices come from,
            shape [K, 2].
        shares: of the sphere that each cap may have at most, shape [P].
        wanted: the areas up to a factor, shape [P].

    Returns:
        The shares of the caps, none above its own in ``shares``.
    """
    areas = np.array([_polygon(rim, share) for rim, share in zip(rims, shares, strict=True)])
    unit = float((areas / wanted).min())
    found = shares.copy()
    for k, rim in enumerate(rims):
        if areas[k] > unit * wanted[k]:
            found[k] = brentq(lambda share, r=rim, area=unit * wanted[k]: _polygon(r, share) - area, 0.0, shares[k])
    return found


def _polygon(rim: Floats, share: float) -> float:
    """Return the area of the spherical polygon that a cap's boundary vertices span."""
    points = disk_to_cap(rim, share)
    pole = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return float(triangle_solid_angles(pole, points, np.roll(points, -1, axis=0)).sum())


def _less_distorted(energy: HeldEnergy, points: Floats, penalty: float | None = None) -> Floats:
    """Return a map with less distortion, among those with the wanted areas or with a penalty on their errors."""
    return minimise(energy, points, gain=GAIN, iterations=STEPS, progress=None, penalty=penalty).points


def _largest_error(energy: HeldEnergy, points: Floats) -> float:
    """Return the largest relative error of an area."""
    return energy.terms(energy.domain.sent(points)).largest


def _exact(energy: HeldEnergy, points: Floats) -> tuple[Floats, float]:
    """Return a map with exact areas, and its largest error: the nearest, or where that is far the least distorted."""
    if not energy.domain.flipped(points).any():
        found, right = restore_areas(energy, points, rounds=FEW)
        if right:
            return found, _largest_error(energy, found)
        found, right = restore_areas(energy, points)
        if not right:
            found, right = restore_areas(energy, _less_distorted(energy, points, PENALTY))
        if right:
            least, still = restore_areas(energy, _less_distorted(energy, found))
            found = least if still else found
            return found, _largest_error(energy, found)
    raise OmtwarpError(
        "no map with straight sides was found that keeps the areas of triangles: use a finer mesh, map to the "
        "hemisphere, or leave exact out"
    )
