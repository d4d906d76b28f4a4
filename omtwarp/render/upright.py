"""Guess of the upward and the front axis of a surface from its shape, among the axes of its coordinates.

The rules hold for animals, people and heads: they are symmetric, which determines the axis across; they stand on their
feet; the front has more detail than the back; and a body much longer than wide has its head at the end that rises
higher. Where the shape has no such plane of symmetry, the default axes are kept: y upwards and z towards the viewer, or
z upwards and -y towards the viewer.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from omtwarp.render.camera import axis_vector
from omtwarp.render.scene import SurfaceView

Floats = NDArray[np.float64]

SAMPLES = 4000  # points by which symmetry is measured: 1 to 2 hundredths of the extent apart
# Mean distance between a surface and its mirror image, as a share of its extent, where it counts as symmetric, and that
# of the best plane over the next one's. Ten heads, figures and animals, scanned or modelled, have 0.006 to 0.021 and
# 0.2 to 0.63.
SYMMETRIC, BETTER = 0.025, 0.66
FIRM = 0.3  # least share of the footprint between the feet of a surface that stands

LEAST_DETAIL = 1e-9  # added to both sides' bends and areas, in extents, so that a side without a face can be compared


def posed(view: SurfaceView, up: str | None = None, front: str | None = None) -> SurfaceView:
    """Complete a view by the axes that point up and to the viewer, as given or guessed from the shape.

    Args:
        view: a surface; axes that it has itself are taken before guesses.
        up: the axis upwards, such as ``"z"`` or ``"-y"``.
        front: the axis towards the viewer.
    """
    if front is None and (up is None or up == view.up):
        front = view.front  # otherwise the subject's own may lie along the new upward axis
    up = view.up if up is None else up
    if up is None or (front is None and view.up is None):
        vertices, faces = np.asarray(view.vertices), np.asarray(view.faces)
        guessed_up, guessed_front = upright(vertices, faces)
        if up is None:
            away = front is None or abs(axis_vector(guessed_up) @ axis_vector(front)) < 0.5
            up = guessed_up if away else next(axis for axis in "yz" if axis not in str(front))
        if front is None and up.lstrip("+") == guessed_up:
            front = guessed_front
    return replace(view, up=up, front=front)


def upright(vertices: Floats, faces: NDArray[np.int32]) -> tuple[str, str | None]:
    """Guess the axis upwards, and the front axis, None where the shape does not determine it.

    Args:
        vertices: shape [V, 3], finite.
        faces: shape [F, 3].

    Example:
        >>> from omtwarp.mesh import shapes
        >>> from omtwarp.render.upright import upright
        >>> creature = shapes.demo_shape(4000)
        >>> upright(creature.vertices, creature.faces)
        ('z', 'x')
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    extent = max(float((high - low).max()), np.finfo(float).tiny)
    places = (vertices - low) / extent
    corner = places[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    # Flat, of the extent: a flat sheet, which has no front of its own, is seen from +z
    if not area.sum() > 0.0 or (high - low).min() < 0.01 * extent:
        return "y", None
    normal /= np.maximum(area, np.finfo(float).tiny)[:, None]
    middle = corner.mean(axis=1)
    centre = area @ middle / area.sum()
    across = _mirror_axis(corner, area, centre)
    if across == 1:
        up = 2
    else:
        used = places[np.unique(faces)]
        up = 2 if _standing(used, centre, 1) == 0.0 and _standing(used, centre, 2) > FIRM and across != 2 else 1
    if across is None:
        return "xyz"[up], None
    ahead = 3 - up - across
    score = float(np.log(_detail(places, faces, normal, area, ahead)))
    spread = np.ptp(places[np.unique(faces)], axis=0)
    # Long: length over width of bodies with a head at one end
    if spread[ahead] > 1.5 * spread[across]:
        # Head, of the height: where the head begins
        head = middle[:, up] > places[:, up].min() + 0.7 * spread[up]
        if head.any() and area[head].sum() > 0.0:
            score += float(area[head] @ middle[head, ahead] / area[head].sum() - centre[ahead]) / spread[ahead]
    return "xyz"[up], ("" if score >= 0.0 else "-") + "xyz"[ahead]


def _mirror_axis(corner: Floats, area: Floats, centre: Floats) -> int | None:
    """Return the axis across the surface's plane of symmetry, if it has one at right angles to an axis."""
    from scipy.spatial import cKDTree

    # Evenly over the area, in the order of faces: the same points every time.
    at = np.searchsorted(np.cumsum(area), (np.arange(SAMPLES) + 0.5) / SAMPLES * area.sum())
    share = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), SAMPLES)
    points = np.einsum("nk,nkj->nj", share, corner[np.minimum(at, len(corner) - 1)])
    tree = cKDTree(points)
    off = np.empty(3)
    for axis in range(3):
        mirrored = points.copy()
        mirrored[:, axis] = 2.0 * centre[axis] - points[:, axis]
        off[axis] = tree.query(mirrored)[0].mean()
    best, second = np.sort(off)[:2]
    return int(np.argmin(off)) if best < SYMMETRIC and best < BETTER * second else None


def _standing(points: Floats, centre: Floats, up: int) -> float:
    """Return the area between a surface's feet over that of its outline from above, 0 where it would fall over."""
    from scipy.spatial import ConvexHull, QhullError

    flat = np.delete(points, up, axis=1)
    try:
        # Ground, of the extent: points at most this far above the lowest one touch the ground
        feet = ConvexHull(flat[points[:, up] < points[:, up].min() + 0.03])
        whole = ConvexHull(flat)
    except (QhullError, ValueError):  # fewer than three feet, or all in line
        return 0.0
    falls = (feet.equations[:, :2] @ np.delete(centre, up) + feet.equations[:, 2]).max() >= 0.0
    return 0.0 if falls else float(feet.volume / whole.volume)


def _detail(places: Floats, faces: NDArray[np.int32], normal: Floats, area: Floats, axis: int) -> float:
    """Return how much more the surface bends, per area, where it faces along an axis than against it."""
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    keys = ends[:, 0].astype(np.int64) * len(places) + ends[:, 1]
    order = np.argsort(keys, kind="stable")
    pair = np.flatnonzero(keys[order][1:] == keys[order][:-1])
    one, other = order[pair] // 3, order[pair + 1] // 3
    ends = ends[order[pair]]
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", normal[one], normal[other]), -1.0, 1.0))
    bend = angle * np.linalg.norm(places[ends[:, 0]] - places[ends[:, 1]], axis=1)
    sides = []
    for sign in (1.0, -1.0):
        facing = sign * normal[:, axis] > 0.5
        edges = sign * (normal[one, axis] + normal[other, axis]) > 1.0
        sides.append((bend[edges].sum() + LEAST_DETAIL) / (area[facing].sum() + LEAST_DETAIL))
    return float(sides[0] / sides[1])
