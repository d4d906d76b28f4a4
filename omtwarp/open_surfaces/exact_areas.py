"""Exact areas of triangles on the disk and on caps, where straight sides make those of a projected map slightly wrong.

Lambert's projection keeps areas of regions, but a triangle with straight sides is not the region that its corners came
from, and the polygon of the boundary's vertices lacks the segments up to its circle. So the map of a quartered mesh is
moved, with its boundary fixed, until each original triangle has its share of that polygon. The polygon's area does not
change on the way.

Flows (:mod:`omtwarp.open_surfaces.area_steps`) reach that from the projected map where errors are small. Where they do
not, the map of the original triangles is quartered anew. It has larger errors but no slivers; even steps under growing
penalties lower the errors until flows correct the rest. A cap then grows from the disk, a cap of no size, in steps
after each of which flows correct the areas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from omtwarp.errors import OmtwarpError
from omtwarp.flips.predicates import flipped_faces
from omtwarp.geometry.lambert import cap_to_disk, disk_to_cap
from omtwarp.mesh.quarter import PARTS
from omtwarp.open_surfaces.area_steps import AreaSteps, Measured, Placed
from omtwarp.open_surfaces.planar import flipped_in_plane, untangle_on_sphere
from omtwarp.spheres import triangle_solid_angles

Floats = NDArray[np.float64]
EXACT = 1e-6  # largest relative error that is promised
PENALTIES = (3e2, 3e3, 3e4)  # of the errors of areas in even steps, beside a distortion of some units
HALVINGS = 6  # of a step of a flow after even steps: one that has to be shorter leads nowhere
LEVELS, FASTER = 8, 2.0  # of the growth of a cap: steps that are tried, and the factor of the next after one taken


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
    def whole(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """The vertices of the original triangles, and these triangles in terms of them, shape [F, 3]."""
        used, faces = np.unique(self.faces.reshape(-1, PARTS, 3)[:, :3, 0], return_inverse=True)
        return used, faces.reshape(-1, 3).astype(np.int32)

    def refined(self, corners: Floats, points: Floats) -> Floats:
        """Extend a map of the original triangles by the middles of their sides; those of the boundary are given.

        Args:
            corners: images of the original triangles' vertices in the order of :attr:`whole`, shape [K, D].
            points: a map of the quartered mesh with the same boundary, shape [V, D].
        """
        used, faces = self.whole
        middles, found = self.faces.reshape(-1, PARTS, 3)[:, 3], points.copy()
        for k in range(3):
            found[middles[:, k]] = 0.5 * (corners[faces[:, k]] + corners[faces[:, (k + 1) % 3]])
        if points.shape[1] == 3:
            found /= np.linalg.norm(found, axis=1)[:, None]
        found[used] = corners
        return np.where(self.held[:, None], points, found)


def exact_in_plane(points: Floats, mesh: Quartered, anew: Callable[[], Floats]) -> tuple[Floats, float]:
    """Move a map to the unit disk until each original triangle has its share of the boundary's polygon.

    Args:
        points: a map, shape [V, 2].
        mesh: what is mapped.
        anew: returns another map to begin with where this one leads nowhere: of the original triangles, quartered.

    Returns:
        The map, and its largest relative error.

    Raises:
        OmtwarpError: no such map without flips was found.
    """
    steps = _steps(mesh, points, _in_plane)
    found, right = _flowed(steps, points)
    if not right:
        found, right = _evened(steps, steps.placed(anew()))
    if not right:
        found, right = _evened(steps, steps.placed(points))
    return _checked(found, right, steps, flipped_in_plane(found.points, mesh.faces))


def exact_on_cap(points: Floats, mesh: Quartered, share: float, disk: Callable[[], Floats]) -> tuple[Floats, float]:
    """Do the same for a map to a cap, whose triangles have great circles as sides.

    Args:
        points: unit vectors, shape [V, 3].
        mesh: as of :func:`exact_in_plane`, and so is what is returned and raised.
        share: of the sphere, the cap's.
        disk: returns a map to the disk with the same boundary and exact areas, to begin with where ``points`` leads
            nowhere.
    """
    steps = _steps(mesh, points, _on_sphere)
    found, right = _flowed(steps, points)
    if not right:
        found, right = _evened(steps, steps.placed(points))
    if not right:
        places, grown, growth = disk(), 0.0, share
        for _ in range(LEVELS):
            to = min(grown + growth, share)
            larger = disk_to_cap(places, to)
            if flipped_faces(larger, mesh.faces).any():
                larger = untangle_on_sphere(larger, mesh.faces, mesh.held)
            found, right = _flowed(steps, larger)
            if not right:
                found, right = _evened(steps, steps.placed(larger))
            if right:
                places = np.where(mesh.held[:, None], places, cap_to_disk(found.points, to))
                grown, growth = to, FASTER * growth
                if grown >= share:
                    break
            else:
                growth *= 0.5
        right = grown >= share
    return _checked(found, right, steps, flipped_faces(found.points, mesh.faces))


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


def _in_plane(corners: Floats) -> tuple[Floats, Floats]:
    """Return the areas of triangles, shape [N], and their derivatives by the corners, shape [N, 3, 2]."""
    opposite = np.roll(corners, -2, axis=1) - np.roll(corners, -1, axis=1)
    gradients = 0.5 * np.stack([-opposite[..., 1], opposite[..., 0]], axis=2)
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]), gradients


def _on_sphere(corners: Floats) -> tuple[Floats, Floats]:
    """Return the areas of spherical triangles and their tangential derivatives by the corners, shape [N, 3, 3].

    The tangent of half the area is det(a, b, c) / (1 + a.b + b.c + c.a).
    """
    after, before = np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1)
    across, along = np.cross(after, before), after + before
    volume = np.einsum("ij,ij->i", corners[:, 0], across[:, 0])
    below = 1.0 + 0.5 * np.einsum("ikj,ikj->i", corners, along)
    gradients = below[:, None, None] * across - volume[:, None, None] * along
    gradients *= (2.0 / (below**2 + volume**2))[:, None, None]
    gradients -= corners * np.einsum("ikj,ikj->ik", corners, gradients)[:, :, None]
    return 2.0 * np.arctan2(volume, below), gradients


def _steps(mesh: Quartered, points: Floats, measured: Measured) -> AreaSteps:
    return AreaSteps(points, mesh.faces, mesh.held, mesh.wanted, measured, mesh.surface[mesh.faces])


def _flowed(steps: AreaSteps, points: Floats) -> tuple[Placed, bool]:
    """Correct the areas of a map by flows in whole steps; returns the map and whether they are right then."""
    begun = steps.placed(points)
    return steps.flow(begun, 0) if (begun.parts > 0.0).all() else (begun, False)


def _evened(steps: AreaSteps, at: Placed) -> tuple[Placed, bool]:
    """Do the same for larger errors, by shorter steps after even ones, or else without these."""
    if not (at.parts > 0.0).all():
        return at, False
    begun = at
    for penalty in PENALTIES:
        at = steps.even(at, penalty)
        found, right = steps.flow(at, HALVINGS)
        if right:
            return found, right
    return steps.flow(begun, HALVINGS)


def _checked(found: Placed, right: bool, steps: AreaSteps, flipped: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Return a map and its largest error, or refuse it."""
    error = steps.largest_error(found)
    if not right or error > EXACT or flipped.any():
        raise OmtwarpError(
            "no map with straight sides was found that keeps the areas of triangles: use a finer mesh, map to the "
            "hemisphere, or leave exact out"
        )
    return found.points, error


__all__ = ["Quartered", "exact_in_plane", "exact_on_cap", "shares_of_polygons"]
