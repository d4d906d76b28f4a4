"""Exact areas of triangles on the disk and on caps, where straight sides make those of a projected map slightly wrong.

Lambert's projection keeps areas of regions, but a triangle with straight sides is not the region that its corners came
from, and the polygon of the boundary's vertices lacks the segments up to its circle. So the map of a quartered mesh is
moved, with its boundary fixed, until each original triangle has its share of that polygon. The polygon's area does not
change on the way. Every step of Newton's method is the smallest, in the mean square over the disk or cap, that corrects
the areas to first order.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import brentq
from scipy.sparse.linalg import splu

from omtwarp.errors import OmtwarpError
from omtwarp.flips.predicates import flipped_faces
from omtwarp.mesh.quarter import PARTS
from omtwarp.open_surfaces.lambert import disk_to_cap
from omtwarp.open_surfaces.planar import flipped_in_plane
from omtwarp.spheres import triangle_solid_angles

Floats = NDArray[np.float64]
Gradients = Callable[[Floats], tuple[Floats, Floats]]

ROUNDS = 40  # largest number of steps
MAX_HALVINGS = 12  # of a step, down to 1/4096
SUFFICIENT = 0.1  # a step is taken where it lowers the errors by this share of what the first derivative predicts
SETTLED = 1e-9  # largest relative error at which steps end; they converge quadratically
EXACT = 1e-6  # largest relative error that is promised
LEAST_PART = 1e-2  # share of its area that a part of a triangle keeps in a step at least


def exact_in_plane(points: Floats, faces: NDArray, held: NDArray[np.bool_], wanted: Floats) -> tuple[Floats, float]:
    """Move a map to the unit disk until each original triangle has its share of the boundary's polygon.

    Args:
        points: a map without flips, shape [V, 2].
        faces: of the quartered mesh, the parts of a triangle one after the other, shape [4 F, 3].
        held: vertices that stay where they are: those of the boundary, shape [V].
        wanted: the areas of the triangles up to a factor, shape [F].

    Returns:
        The map, and its largest relative error.

    Raises:
        OmtwarpError: no such map without flips was found.
    """
    return _restored(points, faces, held, wanted, _in_plane, flipped_in_plane)


def exact_on_cap(points: Floats, faces: NDArray, held: NDArray[np.bool_], wanted: Floats) -> tuple[Floats, float]:
    """Do the same for a map to a cap, whose triangles have great circles as sides.

    Args:
        points: unit vectors, shape [V, 3].
        faces, held, wanted: as of :func:`exact_in_plane`, and so is what is returned and raised.
    """
    return _restored(points, faces, held, wanted, _on_sphere, flipped_faces)


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


def _restored(
    points: Floats,
    faces: NDArray,
    held: NDArray[np.bool_],
    wanted: Floats,
    measured: Gradients,
    flipped: Callable[[Floats, NDArray], NDArray[np.bool_]],
) -> tuple[Floats, float]:
    """Restore areas as :func:`exact_in_plane` describes, with areas and the test of orientation of either domain."""
    parts, gradients = measured(points[faces])
    target = wanted * (parts.sum() / wanted.sum())
    missing = target - _sums(parts)
    for _ in range(ROUNDS):
        if np.abs(missing / target).max() <= SETTLED:
            break
        step = _smallest(faces, held, parts, gradients, missing)
        taken = _taken(points, faces, step, parts, target, measured)
        if taken is None:
            break
        points, parts, gradients = taken
        missing = target - _sums(parts)
    error = float(np.abs(missing / target).max())
    if error > EXACT or flipped(points, faces).any():
        raise OmtwarpError(
            f"areas of triangles with straight sides cannot be kept here (the largest error is {error:.1g}): use a "
            "finer mesh, map to the hemisphere, or leave exact out"
        )
    return points, error


def _sums(parts: Floats) -> Floats:
    """Add up the parts of every original triangle."""
    return parts.reshape(-1, PARTS).sum(axis=1)


def _smallest(faces: NDArray, held: NDArray[np.bool_], parts: Floats, gradients: Floats, missing: Floats) -> Floats:
    """Return the smallest motion that corrects areas to first order, shape [V, D].

    With a fixed boundary the areas have a constant sum, so that the last triangle's condition follows from the others.
    """
    count, axes = len(held), gradients.shape[2]
    cells = np.repeat(np.arange(len(missing)), PARTS * 3 * axes)
    columns = axes * faces.reshape(-1, 1) + np.arange(axes)
    shape = (len(missing), axes * count)
    slopes = sparse.csr_array((gradients.ravel(), (cells, columns.ravel())), shape=shape)[:-1]
    mass = np.bincount(faces.ravel(), np.repeat(np.abs(parts), 3), count)
    mobility = sparse.diags_array(np.repeat(np.where(held, 0.0, 1.0 / mass), axes))
    moved = mobility @ slopes.T
    return (moved @ splu((slopes @ moved).tocsc()).solve(missing[:-1])).reshape(count, axes)


def _taken(
    points: Floats, faces: NDArray, step: Floats, parts: Floats, target: Floats, measured: Gradients
) -> tuple[Floats, Floats, Floats] | None:
    """Return the map, its parts and their derivatives after the longest share of a step that flips none, or None."""
    before, length = _error(parts, target), 1.0
    for _ in range(MAX_HALVINGS):
        moved = points + length * step
        if points.shape[1] == 3:
            moved /= np.linalg.norm(moved, axis=1)[:, None]
        moved = np.where((step == 0.0).all(axis=1)[:, None], points, moved)
        after, gradients = measured(moved[faces])
        if (after > LEAST_PART * parts).all() and _error(after, target) <= (1.0 - SUFFICIENT * length) * before:
            return moved, after, gradients
        length *= 0.5
    return None


def _error(parts: Floats, target: Floats) -> float:
    """Return the norm of the area errors, each over the square root of the wanted area."""
    return float(np.sqrt(((_sums(parts) - target) ** 2 / target).sum()))


__all__ = ["exact_in_plane", "exact_on_cap", "shares_of_polygons"]
