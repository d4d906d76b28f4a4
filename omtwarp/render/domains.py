"""Where the domains of maps are drawn: spheres, disks and parts of spheres, next to the parts of the surface."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from omtwarp.mesh.surface import SPHERE_AREA, triangle_areas
from omtwarp.render.subject import FinishedMap

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

SPACING = 1.08  # distance of two domains over the sum of their radii, as seen


def domains_of(result: FinishedMap, count: int) -> NDArray[np.intp]:
    """Return the number of the domain that every face has, shape [F]: zeros, but with parts that have one each."""
    part = getattr(result, "part", None)
    if part is None or getattr(result, "cap_centres", None) is not None:
        return np.zeros(count, dtype=np.intp)
    return np.unique(part, return_inverse=True)[1]


def domain_name(result: FinishedMap) -> str:
    """Return what a map goes to, in words."""
    one = str(getattr(result, "domain", "sphere"))
    if getattr(result, "cap_centres", None) is not None or one not in ("sphere", "hemisphere", "disk", "cap"):
        one = "sphere"
    return one + "s" if domains_of(result, len(np.asarray(result.faces))).any() else one


def vertex_areas(surface: Floats, faces: Ints) -> Floats:
    """Return three times the area around every vertex, and a little for those without, shape [V]."""
    areas = np.bincount(faces.ravel(), np.repeat(triangle_areas(surface, faces), 3), minlength=len(surface))
    return areas + 1e-9 * areas.mean()  # which turns a domain as little as that


def fits_of(
    surface: Floats, points: Floats, faces: Ints, number: NDArray[np.intp], kind: str, axes: Floats
) -> tuple[Floats, Floats]:
    """Return the matrices [P, 3, 3] and shifts [P, 3] that take every domain's points next to its part of the surface.

    Every domain gets the area of its part. Where there are several, none hides another from the camera.

    Args:
        surface: shape [V, 3].
        points: on the domains, shape [V, 3].
        faces: shape [F, 3].
        number: the domain of every face, shape [F].
        kind: of the domains.
        axes: the camera's, as columns.
    """
    matrices, shifts, radii = [], [], []
    for k in range(int(number.max(initial=0)) + 1):
        mine = faces[number == k]
        weights = vertex_areas(surface, mine)
        used = np.unique(mine)
        several = bool(number.any())
        area = float(triangle_areas(surface, mine).sum())
        covered = {"sphere": SPHERE_AREA, "disk": math.pi}.get(kind)
        covered = float(triangle_areas(points, mine).sum()) if covered is None else covered
        centre = np.average(surface[used], axis=0, weights=weights[used]) if several else np.zeros(3)
        here, there = surface[used] - centre, points[used]
        turn = _facing(surface, mine, here, there, weights[used]) if kind == "disk" else None
        if turn is None:
            turn = Rotation.align_vectors(here, there, weights=weights[used])[0].as_matrix()
        scale = math.sqrt(area / covered)
        matrices.append(scale * turn.T)
        shifts.append(centre)
        radii.append(scale)
    return np.array(matrices), _apart(np.array(shifts), np.array(radii), axes)


def _facing(surface: Floats, faces: Ints, here: Floats, there: Floats, weights: Floats) -> Floats | None:
    """Return the rotation of a disk to the side that a surface faces, nearest to it; None where it faces none.

    Args:
        surface, faces: the part, shapes [V, 3] and [F, 3].
        here: its vertices about their middle, shape [N, 3].
        there: the same on the disk, shape [N, 3].
        weights: of the vertices, shape [N].
    """
    corner = surface[faces]
    normal = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
    length = float(np.linalg.norm(normal))
    # Flat, of a surface's area: the length of its mean normal below which it has no side
    if length < 1e-3 * triangle_areas(surface, faces).sum():
        return None
    normal /= length
    across = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    across /= np.linalg.norm(across)
    above = np.cross(normal, across)
    x, y = here @ across, here @ above
    angle = math.atan2(weights @ (there[:, 0] * y - there[:, 1] * x), weights @ (there[:, 0] * x + there[:, 1] * y))
    right = math.cos(angle) * across + math.sin(angle) * above
    return np.column_stack([right, np.cross(normal, right), normal])


def _apart(centres: Floats, radii: Floats, axes: Floats) -> Floats:
    """Return the centres of balls moved across the line of sight until none hides another, shape [P, 3].

    Args:
        centres: shape [P, 3].
        radii: shape [P].
        axes: the camera's, as columns.
    """
    start = 1e-3  # of its radius: how far each is moved along that way at first
    count = len(centres)
    # Most pushed, domains: more are left where their parts are
    if count == 1 or count > 500:
        return centres
    # Spiral, radians: the golden angle, between the ways in which domains at one place go apart
    turns = 2.399963 * np.arange(count)
    flat = centres @ axes[:, :2] + start * radii[:, None] * np.column_stack([np.cos(turns), np.sin(turns)])
    wanted = SPACING * (radii[:, None] + radii[None])
    np.fill_diagonal(wanted, 0.0)
    # Pushes, of domains that hide each other, at most: 50 random ones took 41
    for _ in range(300):
        between = flat[:, None] - flat[None]
        far = np.linalg.norm(between, axis=2)
        lack = np.maximum(wanted - far, 0.0)
        if lack.max() <= 0.5 * (SPACING - 1.0) * radii.min():
            break
        way = between / np.maximum(far, np.finfo(float).tiny)[..., None]
        flat = flat + 0.5 * (lack[..., None] * way).sum(axis=1)
    return centres + (flat - centres @ axes[:, :2]) @ axes[:, :2].T


def placed_on(points: Floats, faces: Ints, number: NDArray[np.intp], matrices: Floats, shifts: Floats) -> Floats:
    """Return points on domains where they are drawn, shape [N, 3].

    Args:
        points: shape [N, 3].
        faces: triangles of them, shape [F, 3].
        number: the domain of every triangle, shape [F].
        matrices, shifts: of the domains, shapes [P, 3, 3] and [P, 3].
    """
    own = np.zeros(len(points), dtype=np.intp)
    own[faces] = number[:, None]
    return np.einsum("ni,nij->nj", points, matrices[own]) + shifts[own]
