"""Rotation of a map by the surface's own axes, so that it depends on the shape alone.

A map is unique up to a rotation of the sphere, which must not depend on the order of faces. The principal
axes of the surface's area make a frame of its own; the sphere is turned so that points lie, in the least squares, in
the directions that they have from the surface's centre in that frame. Which ends of the axes are which, the axes of the
coordinates say: the picture of a body that stands on its shortest axis in its file is upright.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.arrays import Floats, cross
from omtwarp.mesh.surface import Surface

# Where second moments, relative to the largest, differ by less than this, rounding decides the axes; where third
# moments, relative to the cubed spread along the axis, are smaller, it decides the directions.
SMALLEST_DIFFERENCE = 1e-6
OBLIQUE = np.array([0.6180, 0.2361, 0.7503])  # chosen: any direction that is along none of the axes will do


@dataclass(frozen=True)
class Axes:
    """The principal axes of a surface's area.

    Attributes:
        frame: unit vectors as rows, float64, shape [3, 3], right-handed: the direction of the largest extent first.
        note: empty where the shape determines the axes, else what replaces them.
    """

    frame: Floats
    note: str


def principal_axes(surface: Surface) -> Axes:
    """Find the axes of a surface by the second moments of its area, and their directions by the third, once.

    Moments are integrals over the triangles, which do not depend on how the surface is cut into them. Where the shape
    has no such axes (a ball, a cube) or no such directions (an ellipsoid), the axes of the coordinates decide.

    Args:
        surface: a surface, in any position.
    """
    return surface.cached("principal axes", lambda: _axes_of_moments(surface))


def _axes_of_moments(surface: Surface) -> Axes:
    corners = surface.scaled_vertices.take(surface.faces, axis=0)
    areas = surface.own_areas / surface.own_areas.sum()
    centre = areas @ (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3.0
    corners = corners - centre
    sums = corners[:, 0] + corners[:, 1] + corners[:, 2]
    # Integral of x x' over a triangle: area / 12 (sum of p p' + s s'), with s the sum of the corners p.
    second = (corners * areas[:, None, None]).reshape(-1, 3).T @ corners.reshape(-1, 3)
    second += (sums * areas[:, None]).T @ sums
    sizes, vectors = np.linalg.eigh(second / 12.0)
    sizes, frame = sizes[::-1], vectors[:, ::-1].T.copy()
    apart = -np.diff(sizes) > SMALLEST_DIFFERENCE * sizes[0]
    if not apart.any():
        return Axes(np.eye(3), "the shape has no axes of its own: those of the coordinates were taken")
    note = ""
    if not apart.all():
        lone = frame[2 if apart[1] else 0]
        frame = _around(lone, first=not apart[1])
        note = "the shape has one axis of its own: around it, the axes of the coordinates decide"
    a, b, c = (np.ascontiguousarray((corners[:, k] @ frame.T).T) for k in range(3))
    # Integral of x³ over a triangle: area / 10 times the sum of all products of three of its corners' values.
    one, two, three = a + b + c, a * a + b * b + c * c, a * a * a + b * b * b + c * c * c
    third = ((one * (one * one + 3.0 * two) + 2.0 * three) / 60.0) @ areas
    spread = np.sqrt(np.maximum(np.einsum("ai,ij,aj->a", frame, second / 12.0, frame), 0.0))
    lopsided = np.abs(third) > SMALLEST_DIFFERENCE * np.maximum(spread, np.finfo(float).tiny) ** 3
    if note:
        lopsided &= np.abs(frame @ lone) > 0.5  # third moments count only along axes that the shape determines
    # Two directions determine the third; directions that the shape leaves open follow a coordinate.
    known = next((pair for pair in combinations(range(3), 2) if lopsided[list(pair)].all()), None)
    if known is None:
        known = (int(np.argmax(lopsided)), 1 if lopsided[0] or not lopsided.any() else 0)
        note = note or "the shape is alike in opposite directions: the axes of the coordinates decide between them"
    for axis in known:
        largest = frame[axis, int(np.argmax(np.abs(frame[axis])))]
        frame[axis] *= np.sign(third[axis]) if lopsided[axis] else np.sign(largest)
    left = 3 - sum(known)
    frame[left] *= np.sign(np.linalg.det(frame))
    return Axes(frame, note)


def towards_coordinates(frame: Floats) -> Floats:
    """Reverse axes, two at a time, so that the last and then the first point along coordinates and not against them.

    Args:
        frame: unit vectors as rows, right-handed, shape [3, 3].

    Returns:
        The rows, of the last and the first of which the largest component is positive; right-handed.
    """
    first, _, last = frame[np.arange(3), np.argmax(np.abs(frame), axis=1)] > 0.0
    return frame * np.where([first, first == last, last], 1.0, -1.0)[:, None]


def rotation_onto_axes(surface: Surface, sphere: Floats, axes: Floats) -> tuple[Floats, bool]:
    """Find the rotation of the sphere that brings points nearest to their directions in a frame of the surface.

    Args:
        surface: a surface, V vertices.
        sphere: its map, unit vectors, shape [V, 3].
        axes: the frame, as :class:`Axes` has it.

    Returns:
        The rotation to multiply points with from the left, shape [3, 3], and whether it is determined: a map that
        agrees with no direction has no best rotation (Kabsch 1976).
    """
    weights = surface.sum_to_vertices(surface.own_areas)
    points = surface.scaled_vertices
    places = (points - weights @ points / weights.sum()) @ axes.T
    left, sizes, right = np.linalg.svd((weights[:, None] * places).T @ sphere)
    sign = np.sign(np.linalg.det(left @ right))
    left[:, 2] *= sign
    return left @ right, bool(sizes[1] + sign * sizes[2] > SMALLEST_DIFFERENCE * sizes[0])


def fitted_rotation(products: Floats) -> tuple[Floats, float]:
    """Return the rotation R that brings points p nearest to others q, and the largest Σ q·Rp, from Σ p qᵀ [3, 3]."""
    left, values, right = np.linalg.svd(products)
    sign = np.sign(np.linalg.det(left @ right))
    rotation = (left @ np.diag([1.0, 1.0, sign]) @ right).T
    return rotation, float(values[0] + values[1] + sign * values[2])


def order_by_place(surface: Surface) -> NDArray[np.intp]:
    """Sort the vertices by their places in the surface's own axes, so that their order depends on the shape alone.

    Returns:
        Numbers of the vertices, the farthest along a direction oblique to the axes last, shape [V].
    """
    return np.argsort(surface.scaled_vertices @ (OBLIQUE @ principal_axes(surface).frame), kind="stable")


def turned_towards(sphere: Floats, target: Floats, weights: Floats) -> Floats:
    """Turn points on the sphere to agree best with others, in the least squares of their distances (Kabsch 1976).

    Args:
        sphere: unit vectors, shape [V, 3].
        target: unit vectors, shape [V, 3].
        weights: of the points, shape [V].

    Returns:
        ``sphere`` after the best rotation, shape [V, 3].
    """
    rotation, _ = fitted_rotation((weights[:, None] * sphere).T @ target)
    return np.ascontiguousarray(sphere @ rotation.T)


def turned_about_pole(sphere: Floats, target: Floats, weights: Floats) -> Floats:
    """Turn points about the z axis to agree best with others; arguments as of :func:`turned_towards`."""
    here, there = (points[:, 0] + 1j * points[:, 1] for points in (sphere, target))
    agreement = complex((weights * there * here.conj()).sum())
    turned = here * (agreement / abs(agreement)) if agreement else here
    return np.stack([turned.real, turned.imag, sphere[:, 2]], axis=1)


def _around(axis: Floats, first: bool) -> Floats:
    """Return a right-handed frame with an axis first or last; the coordinate axis farthest from it gives another."""
    towards = np.eye(3)[int(np.argmin(np.abs(axis)))]
    other = towards - (towards @ axis) * axis
    other /= np.linalg.norm(other)
    third = cross(axis, other)
    return np.stack([axis, other, third] if first else [other, third, axis])
