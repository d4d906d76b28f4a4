"""A certificate that a map is a bijection: orientation decided exactly, and the degree counted in two ways."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import triangles, vectors
from omtwarp.device.start import resolve_device, wp
from omtwarp.flips.predicates import orientation_signs
from omtwarp.mesh.surface import SPHERE_AREA, triangle_areas
from omtwarp.metrics.kernels import count_crossings

RAYS = 32
# Rays that pass an edge this closely (as a triple product of unit vectors) are drawn again.
CLEARANCE = 1e-13


@dataclass(frozen=True)
class Certificate:
    """What was established about a map.

    Attributes:
        flips: triangles whose exact orientation is not positive.
        first_flip: index of the first of them, or -1.
        degree: total signed solid angle over 4π, rounded; 1 when the sphere is covered once.
        ray_degree: signed number of triangles that a ray from the centre crosses, the same for all rays cast; None if
            rays disagree, which a closed surface cannot.
        rays: how many rays were cast.
        smallest_area: area of the smallest image triangle, with all of them scaled to 4π.
        smallest_face: its index.
    """

    flips: int
    first_flip: int
    degree: int
    ray_degree: int | None
    rays: int
    smallest_area: float
    smallest_face: int

    @property
    def bijective(self) -> bool:
        """No flip and degree 1, both ways: together they prove that the map is one to one and onto."""
        return self.flips == 0 and self.degree == 1 and self.ray_degree == 1

    def to_dict(self) -> dict[str, Any]:
        return asdict(self) | {"bijective": self.bijective}


def certify(faces: NDArray[np.int32], sphere: NDArray[np.float64], *, device: str | None = "auto") -> Certificate:
    """Examine a sphere map.

    A piecewise map of a closed surface to the sphere whose triangles are all positively oriented is a covering; a
    degree of 1 makes it one to one. Orientation is decided with exact arithmetic wherever rounding could matter.

    Args:
        faces: shape [F, 3].
        sphere: unit vectors, float64, shape [V, 3].
        device: where floating point is tried, and rays are cast.
    """
    signs = orientation_signs(sphere, faces, device=device)
    bad = np.flatnonzero(signs <= 0)
    areas = triangle_areas(sphere, faces)
    smallest = int(np.argmin(areas))
    a, b, c = (sphere[faces[:, k]] for k in range(3))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = 1.0 + sum(np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    degree = float((2.0 * np.arctan2(triple, dots)).sum() / SPHERE_AREA)
    return Certificate(
        flips=len(bad),
        first_flip=int(bad[0]) if len(bad) else -1,
        degree=round(degree) if np.isfinite(degree) else 0,
        ray_degree=_ray_degree(faces, sphere, device),
        rays=RAYS,
        smallest_area=float(areas[smallest] * SPHERE_AREA / max(areas.sum(), np.finfo(float).tiny)),
        smallest_face=smallest,
    )


def _ray_degree(faces: NDArray[np.int32], sphere: NDArray[np.float64], device: str | None) -> int | None:
    where = resolve_device(device)
    points, corners = vectors(sphere, where), triangles(faces, where)
    rng = np.random.default_rng(20_240_229)
    wanted, counted = RAYS, []
    for _ in range(8):
        rays = rng.normal(size=(wanted, 3))
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        directions = wp.array(rays, dtype=wp.vec3d, device=where)
        crossings = wp.zeros(wanted, dtype=wp.int32, device=where)
        doubtful = wp.zeros(wanted, dtype=wp.int32, device=where)
        wp.launch(
            count_crossings,
            dim=(len(faces), wanted),
            inputs=[points, corners, directions, wp.float64(CLEARANCE)],
            outputs=[crossings, doubtful],
            device=where,
        )
        clear = doubtful.numpy() == 0
        counted.extend(crossings.numpy()[clear].tolist())
        wanted = RAYS - len(counted)
        if wanted <= 0:
            break
    return counted[0] if counted and len(set(counted)) == 1 else None
