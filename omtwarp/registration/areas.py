"""The energy of registration, and registration among maps that keep the areas around vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.mesh.surface import Surface
from omtwarp.optimal.cells import MeasuredRings, RingCells
from omtwarp.optimal.exact import restore_areas
from omtwarp.optimal.sphere import ShapeEnergy
from omtwarp.refine.further import VertexTerm
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


def warp_energy(
    sphere: Surface,
    area_weight: float,
    most_strain: float | None = None,
    vertex_term: VertexTerm | None = None,
    keep_areas: bool = True,
) -> ShapeEnergy:
    """Return the energy of registration: the distortion, the barrier of strain and a term at vertices.

    Args:
        sphere: what is warped.
        area_weight, most_strain, vertex_term: as of :class:`omtwarp.optimal.sphere.ShapeEnergy`.
        keep_areas: whether the areas around the vertices of the sphere are constraints, or have a penalty.
    """
    device = resolve_device("cpu")
    cells = RingCells(sphere, device) if keep_areas else MeasuredRings(sphere, device)
    cells.wanted = areas_around(sphere.vertices, sphere.faces)
    return ShapeEnergy(sphere, device, area_weight, most_strain=most_strain, vertex_term=vertex_term, cells=cells)


def with_areas(sphere: Surface, warp: Floats, area_weight: float) -> Floats:
    """Return the warp nearest to one given, shape [V, 3], that keeps the areas around all vertices to 1e-6.

    Args:
        sphere: before the warp.
        warp: unit vectors, no triangle flipped, shape [V, 3].
        area_weight: as of :func:`warp_energy`.
    """
    return restore_areas(warp_energy(sphere, area_weight), warp)[0]


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
