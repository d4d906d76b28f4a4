"""A certificate that a map is a bijection: orientation decided exactly, and the degree counted in two ways."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import triangles, vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.flips.exact import Examined, examine
from omtwarp.geometry.spherical import triple_product
from omtwarp.mesh.arrays import Floats, Ints, cross, marked, normalised, real_numbers, require_unit_length
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, as_faces, as_triangles, triangle_areas

wp.set_module_options(KERNEL_OPTIONS)

RAYS = 32  # all have to count the same degree; without flips one would suffice


@wp.kernel
def count_crossings(
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    signs: wp.array[wp.int8],
    rays: wp.array[wp.vec3d],
    clearance: wp.float64,
    # Data out:
    crossings: wp.array[wp.int32],
    doubtful: wp.array[wp.int32],
):
    """Compute the signed number of spherical triangles over every ray from the centre.

    Rays too near an edge are marked. A ray is inside a triangle where its three triple products have the sign of the
    triangle's own, which was decided exactly; with the opposite sign all three, its antipode is. The counts are
    integers, so the order of the additions does not matter.
    """
    f, r = wp.tid()
    face = faces[f]
    a, b, c = sphere[face[0]], sphere[face[1]], sphere[face[2]]
    ray = rays[r]
    w0, w1, w2 = triple_product(ray, b, c), triple_product(ray, c, a), triple_product(ray, a, b)
    upright = signs[f] > wp.int8(0)
    positive = upright and w0 > -clearance and w1 > -clearance and w2 > -clearance
    negative = not upright and w0 < clearance and w1 < clearance and w2 < clearance
    if positive or negative:
        if wp.min(wp.min(wp.abs(w0), wp.abs(w1)), wp.abs(w2)) < clearance:
            wp.atomic_add(doubtful, r, 1)
        elif positive:
            wp.atomic_add(crossings, r, 1)
        else:
            wp.atomic_add(crossings, r, -1)


@dataclass(frozen=True)
class Certificate:
    """Properties of a map that were decided exactly.

    Attributes:
        flips: triangles whose exact orientation is not positive.
        first_flip: index of the first of them, or -1.
        wound: vertices whose ring of neighbours does not go around them exactly once, decided exactly.
        first_wound: index of the first of them, or -1.
        degree: total signed solid angle over 4π, rounded; 1 when the sphere is covered once.
        ray_degree: signed number of triangles that a ray from the centre crosses, the same for all rays cast; None if
            rays disagree, which a closed surface cannot.
        rays: how many rays were cast.
        smallest_area: area of the smallest image triangle, with all of them scaled to 4π, to twelve digits.
        smallest_face: its index.
    """

    flips: int
    first_flip: int
    wound: int
    first_wound: int
    degree: int
    ray_degree: int | None
    rays: int
    smallest_area: float
    smallest_face: int

    @property
    def bijective(self) -> bool:
        """No flip, every ring once around and degree 1, both ways: the map is one to one and onto."""
        return self.flips == 0 and self.wound == 0 and self.degree == 1 and self.ray_degree == 1

    def __str__(self) -> str:
        where_flipped = f" (the first is face {self.first_flip})" if self.flips else ""
        where_wound = f" (the first is vertex {self.first_wound})" if self.wound else ""
        return (
            f"{self.flips} flipped triangles{where_flipped}, {self.wound} rings that do not turn once{where_wound}, "
            f"degree {self.degree}"
        )

    def to_dict(self) -> dict[str, int | float | None]:
        return asdict(self) | {"bijective": self.bijective}


def certify(surface: MeshLike, sphere: ArrayLike, *, device: str | None = "auto") -> Certificate:
    """Decide exactly whether a sphere map of a surface is one to one and onto.

    A map of a closed surface to the sphere whose triangles are all positively oriented is a covering, branched where
    the ring of a vertex goes around it more than once; a degree of 1 makes it one to one. Orientation and turns are
    decided with exact arithmetic wherever rounding could matter.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices; only its faces count.
        sphere: unit vectors, float64, shape [V, 3]; triangles with one that is not finite count as flipped.
        device: where floating point is tried, and rays are cast.

    Returns:
        What was found; ``bijective`` says whether the map is one to one and onto.

    Raises:
        OmtwarpError: no mesh, arrays that are not of numbers or do not fit together, points that are not of unit
            length, or a corner that is not among the vertices.

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(8)
        >>> certificate = omtwarp.certify(ball, ball.vertices, device="cpu")
        >>> certificate.bijective, certificate.flips
        (True, 0)
        >>> omtwarp.certify(ball, -ball.vertices, device="cpu").bijective  # inside out
        False
    """
    vertices, faces = as_triangles(surface)
    points = real_numbers(sphere, "the map", (len(vertices), 3), finite=False)
    require_unit_length(points[np.isfinite(points).all(axis=1)], "the map")
    return certify_triangles(faces, points, device=device)


def certify_triangles(
    faces: ArrayLike, sphere: ArrayLike, *, examined: Examined | None = None, device: str | None = "auto"
) -> Certificate:
    """Decide the same as :func:`certify`, for a map that is given by its faces, shape [F, 3], and points.

    Args:
        faces, sphere, device: as of :func:`certify`.
        examined: orientations and turns, where they are known of this very map.

    Raises:
        OmtwarpError: the arrays are not of numbers, or a corner is not among the points.
    """
    sphere = real_numbers(sphere, "the map", (None, 3), finite=False)
    faces = as_faces(faces, len(sphere))
    facts = examine(sphere, faces, device=device) if examined is None else examined
    signs, turns = facts.signs, facts.turns
    bad = np.flatnonzero(signs <= 0)
    wound = np.flatnonzero(marked(len(turns), faces) & (turns != 1))
    areas = triangle_areas(sphere, faces)
    smallest = int(np.argmin(areas))
    a, b, c = sphere.take(faces.T, axis=0)
    # The exact sign decides which half of the sphere a triangle of nearly half the sphere covers.
    triple = np.abs(np.einsum("ij,ij->i", a, cross(b, c))) * signs
    dots = 1.0 + sum(np.einsum("ij,ij->i", u, v) for u, v in ((a, b), (b, c), (c, a)))
    degree = float((2.0 * np.arctan2(triple, dots)).sum() / SPHERE_AREA)
    least = areas[smallest] * SPHERE_AREA / max(areas.sum(), np.finfo(float).tiny)
    return Certificate(
        flips=len(bad),
        first_flip=int(bad[0]) if len(bad) else -1,
        wound=len(wound),
        first_wound=int(wound[0]) if len(wound) else -1,
        degree=round(degree) if np.isfinite(degree) else 0,
        ray_degree=_ray_degree(faces, sphere, signs, device),
        rays=RAYS,
        smallest_area=float(f"{least:.12g}"),  # further digits depend on the order of faces and corners
        smallest_face=smallest,
    )


def _ray_degree(faces: Ints, sphere: Floats, signs: NDArray[np.int8], device: str | None) -> int | None:
    seed = 20_240_229  # fixed, so that results are the same bits; any other gives the same degree
    where = resolve_device(device)
    points, corners = vectors(sphere, where), triangles(faces, where)
    upright: wp.array = wp.array(signs, dtype=wp.int8, device=where)
    rng = np.random.default_rng(seed)
    wanted, counted = RAYS, []
    for _ in range(8):
        directions = wp.array(normalised(rng.normal(size=(wanted, 3))), dtype=wp.vec3d, device=where)
        crossings = wp.zeros(wanted, dtype=wp.int32, device=where)
        doubtful = wp.zeros(wanted, dtype=wp.int32, device=where)
        # Rays that pass an edge this closely (as a triple product of unit vectors) are drawn again.
        wp.launch(
            count_crossings,
            dim=(len(faces), wanted),
            inputs=[points, corners, upright, directions, wp.float64(1e-13)],
            outputs=[crossings, doubtful],
            device=where,
        )
        counted.extend(crossings.numpy()[doubtful.numpy() == 0].tolist())
        wanted = RAYS - len(counted)
        if wanted <= 0:
            break
    return counted[0] if counted and len(set(counted)) == 1 else None
