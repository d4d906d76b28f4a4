"""Area and angle distortion of a sphere map, its flips and its degree (section 6 of the paper).

For every triangle, with s1 >= s2 the singular values of the Jacobian between the original triangle (total area scaled
to 4π) and the flat triangle of its three sphere points (scaled likewise), the distortions of Degener et al. (2003) and
Hormann and Greiner (2000) that the paper uses are

    area = s1 s2 + 1 / (s1 s2),     angle = s1 / s2 + s2 / s1;

both are at least 2, and 2 is perfect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypedDict, cast

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import triangles, vectors
from omtwarp.device.policy import HEAVY_LAUNCH, resolve_device
from omtwarp.device.start import HALF, KERNEL_OPTIONS, wp
from omtwarp.device.threads import Each, each, launch_parts
from omtwarp.geometry.spherical import TINY, solid_angle, triple_product
from omtwarp.mesh.arrays import Floats, cross, dots, in_range, norms, real_numbers, require_unit_length, squared_norms
from omtwarp.mesh.surface import MeshLike, as_faces, as_triangles

wp.set_module_options(KERNEL_OPTIONS)

WEIGHTINGS = ("mean", "surface", "sphere")


@wp.func
def triangle_frame(p0: wp.vec3d, p1: wp.vec3d, p2: wp.vec3d):
    """Return the base, foot and height of a triangle laid flat with its first edge along the x axis."""
    base = wp.length(p1 - p0)
    along = (p1 - p0) / wp.max(base, TINY)
    foot = wp.dot(p2 - p0, along)
    height = wp.length(p2 - p0 - foot * along)
    return base, foot, height


@wp.kernel
def triangle_distortion(
    surface: wp.array[wp.vec3d],
    sphere: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    surface_area: wp.array[wp.float64],
    sphere_area: wp.array[wp.float64],
    determinant: wp.array[wp.float64],
    angle: wp.array[wp.float64],
    triple: wp.array[wp.float64],
    solid: wp.array[wp.float64],
):
    f = wp.tid()
    face = faces[f]
    base, foot, height = triangle_frame(surface[face[0]], surface[face[1]], surface[face[2]])
    a, b, c = wp.normalize(sphere[face[0]]), wp.normalize(sphere[face[1]]), wp.normalize(sphere[face[2]])
    image_base, image_foot, image_height = triangle_frame(a, b, c)
    # The Jacobian between the two flat triangles is upper triangular in these frames: [[p, q], [0, r]].
    p = image_base / base
    r = image_height / height
    q = (image_foot - p * foot) / height
    surface_area[f] = HALF * base * height
    sphere_area[f] = HALF * image_base * image_height
    determinant[f] = p * r
    angle[f] = (p * p + q * q + r * r) / (p * r)
    triple[f] = triple_product(a, b, c)
    solid[f] = solid_angle(a, b, c)


class Aggregates(TypedDict, total=False):
    """The fields of :class:`Distortion` other than its arrays."""

    flips: int
    degree: float
    finite: bool
    area: dict[str, float]
    angle: dict[str, float]


@dataclass(frozen=True)
class Distortion:
    """How a sphere map distorts a surface.

    Attributes:
        flips: triangles with det[s0, s1, s2] <= 0 in floating point.
        degree: total signed solid angle over 4π; 1 for a map that covers the sphere once.
        finite: whether every coordinate of the map is finite.
        area: aggregates of the area distortion: ``mean`` over triangles, ``surface`` (weighted by original area),
            ``sphere`` (weighted by area on the sphere, the paper's tables), ``median``, ``p95`` and ``max``.
        angle: the same of the angle distortion.
        face_area: area distortion of every triangle, float64, shape [F].
        face_angle: angle distortion of every triangle, float64, shape [F].
        area_ratio: area on the sphere over original area of every triangle, float64, shape [F].
        triple: det[s0, s1, s2] of every triangle, float64, shape [F].
    """

    flips: int
    degree: float
    finite: bool
    area: dict[str, float]
    angle: dict[str, float]
    face_area: Floats
    face_angle: Floats
    area_ratio: Floats
    triple: Floats

    def __repr__(self) -> str:
        return f"Distortion({self}, {len(self.triple)} faces)"

    def to_dict(self) -> Aggregates:
        """Return the aggregates as plain numbers, ready for JSON."""
        return cast("Aggregates", {name: getattr(self, name) for name in Aggregates.__annotations__})

    def __str__(self) -> str:
        return (
            f"flips {self.flips}  degree {self.degree:.6f}"
            f"  area {self.area['surface']:.4f} (p95 {self.area['p95']:.4f})"
            f"  angle {self.angle['surface']:.4f} (p95 {self.angle['p95']:.3f})"
        )


def distortion(surface: MeshLike, sphere: ArrayLike | wp.array, *, device: str | None = "auto") -> Distortion:
    """Measure the area and angle distortion, the flips and the degree of a sphere map of a surface.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices, any unit; it may have
            defects that keep it from being mapped.
        sphere: the images of the vertices, unit vectors, shape [V, 3]. Or a Warp array of vec3d.
        device: where the per-triangle kernel runs.

    Returns:
        The distortion, section 6 of the paper, in all three weightings.

    Raises:
        OmtwarpError: no mesh, arrays that are not of numbers or do not fit together, points that are not of unit
            length, or a corner that is not among the vertices.

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(8)
        >>> measured = omtwarp.distortion((3.0 * ball.vertices, ball.faces), ball.vertices, device="cpu")
        >>> measured.flips, round(measured.area["mean"], 9), round(measured.angle["mean"], 9)  # a similarity
        (0, 2.0, 2.0)
    """
    vertices, faces = as_triangles(surface)
    if not isinstance(sphere, wp.array):
        sphere = real_numbers(sphere, "the map", (len(vertices), 3), finite=False)
        require_unit_length(sphere[np.isfinite(sphere).all(axis=1)], "the map")
    return measure_triangles(vertices, faces, sphere, device=device)


def measure_triangles(
    vertices: ArrayLike | wp.array,
    faces: ArrayLike | wp.array,
    sphere: ArrayLike | wp.array,
    *,
    device: str | None = "auto",
) -> Distortion:
    """Measure a sphere map as :func:`distortion` does, from arrays.

    Args:
        vertices: the surface, shape [V, 3], any unit; or a Warp array of vec3d.
        faces: vertex indices, shape [F, 3], counter-clockwise seen from outside; or a Warp array of vec3i.
        sphere: the images of the vertices, shape [V, 3]; normalised here. Or a Warp array of vec3d.
        device: where the per-triangle kernel runs.

    Raises:
        OmtwarpError: the arrays are not of numbers, do not fit together, or a corner is not among the vertices.
    """
    if not isinstance(vertices, wp.array):
        vertices = in_range(real_numbers(vertices, "vertices", (None, 3)))
    if not isinstance(sphere, wp.array):
        sphere = real_numbers(sphere, "the map", (len(vertices), 3), finite=False)
    if not isinstance(faces, wp.array):
        faces = as_faces(faces, len(vertices))
    where = resolve_device(device)
    inputs = [vectors(vertices, where), vectors(sphere, where), triangles(faces, where)]
    count = len(inputs[2])
    outputs = [wp.empty(count, dtype=wp.float64, device=where) for _ in range(6)]
    launch_parts(triangle_distortion, count, [*inputs[:2], Each(inputs[2])], each(*outputs), where, HEAVY_LAUNCH)
    finite = bool(np.isfinite(sphere.numpy() if isinstance(sphere, wp.array) else sphere).all())
    surface_area, sphere_area, determinant, angle, triple, solid = (array.numpy() for array in outputs)
    return summarize(surface_area, sphere_area, determinant, angle, triple, solid, finite)


def measure_in_plane(vertices: ArrayLike, faces: ArrayLike, plane: ArrayLike) -> Distortion:
    """Measure a map to the plane as :func:`distortion` measures one to the sphere; areas are scaled to the same total.

    Args:
        vertices: the surface, shape [V, 3], any unit.
        faces: vertex indices, shape [F, 3], counter-clockwise seen from outside.
        plane: the images of the vertices, shape [V, 2]; faces are counter-clockwise there too.

    Returns:
        The distortion; its degree is the signed area in the plane over the unsigned one.

    Raises:
        OmtwarpError: the arrays are not of numbers, do not fit together, or a corner is not among the vertices.
    """
    points = in_range(real_numbers(vertices, "vertices", (None, 3)))
    images = real_numbers(plane, "the map", (len(points), 2), finite=False)
    corners = as_faces(faces, len(points))
    return measure_corners(points[corners], images[corners])


def measure_corners(surface: Floats, plane: Floats, whole: float | None = None) -> Distortion:
    """Measure a map to the plane or to a flat torus by the corners of its triangles.

    Args:
        surface: the corners in space, shape [F, 3, 3].
        plane: those of the images, shape [F, 3, 2].
        whole: the area that a map of degree 1 covers; that of the images by default.
    """
    one, other = (surface[:, k] - surface[:, 0] for k in (1, 2))
    right, up = (plane[:, k] - plane[:, 0] for k in (1, 2))
    area = 0.5 * norms(cross(one, other))
    flat = 0.5 * (right[:, 0] * up[:, 1] - right[:, 1] * up[:, 0])
    # The sum of squares of the singular values over their product, from scalar products of edges (Pinkall and
    # Polthier, Computing discrete minimal surfaces and their conjugates, 1993, equation 7).
    stretch = squared_norms(right) * squared_norms(other) + squared_norms(up) * squared_norms(one)
    stretch -= 2.0 * dots(right, up) * dots(one, other)
    with np.errstate(all="ignore"):
        angle = stretch / (4.0 * area * flat)
        solid = 4.0 * np.pi * flat / (np.abs(flat).sum() if whole is None else whole)
        return summarize(area, np.abs(flat), flat / area, angle, flat, solid, bool(np.isfinite(plane).all()))


def summarize(
    surface_area: Floats,
    sphere_area: Floats,
    determinant: Floats,
    angle: Floats,
    triple: Floats,
    solid: Floats,
    finite: bool,
) -> Distortion:
    """Aggregate per-triangle quantities, each float64 of shape [F]; both areas are scaled to the same total."""
    surface_total, sphere_total = surface_area.sum(), sphere_area.sum()
    with np.errstate(all="ignore"):
        ratio = determinant * (surface_total / sphere_total)
        area = ratio + 1.0 / ratio
    weights = {
        "mean": np.full(len(area), 1.0 / len(area)),
        "surface": surface_area / surface_total,
        "sphere": sphere_area / sphere_total,
    }

    def aggregate(values: Floats) -> dict[str, float]:
        with np.errstate(all="ignore"):
            out = {name: float((weight * values).sum()) for name, weight in weights.items()}
        return out | {
            "median": float(np.median(values)),
            "p95": float(np.percentile(values, 95)),
            "max": float(values.max()),
        }

    return Distortion(
        flips=int((~(triple > 0)).sum()),
        degree=float(solid.sum() / (4 * np.pi)),
        finite=finite,
        area=aggregate(area),
        angle=aggregate(angle),
        face_area=area,
        face_angle=angle,
        area_ratio=ratio,
        triple=triple,
    )
