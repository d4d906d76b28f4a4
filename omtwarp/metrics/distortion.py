"""Area and angle distortion of a sphere map, its flips and its degree (section 6 of the paper).

For every triangle, with s1 >= s2 the singular values of the Jacobian between the original triangle (total area scaled
to 4π) and the flat triangle of its three sphere points (scaled likewise), the distortions of Degener et al. (2003) and
Hormann and Greiner (2000) that the paper uses are

    area = s1 s2 + 1 / (s1 s2),     angle = s1 / s2 + s2 / s1;

both are at least 2, and 2 is perfect.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from omtwarp._warp import wp

WEIGHTINGS = ("mean", "surface", "sphere")


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
    face_area: NDArray[np.float64]
    face_angle: NDArray[np.float64]
    area_ratio: NDArray[np.float64]
    triple: NDArray[np.float64]

    def to_dict(self) -> dict[str, Any]:
        """The aggregates as plain numbers, ready for JSON."""
        names = ("flips", "degree", "finite", "area", "angle")
        return {name: getattr(self, name) for name in names}

    def __str__(self) -> str:
        return (
            f"flips {self.flips}  degree {self.degree:.6f}"
            f"  area {self.area['surface']:.4f} (p95 {self.area['p95']:.4f})"
            f"  angle {self.angle['surface']:.4f} (p95 {self.angle['p95']:.3f})"
        )


def distortion(
    vertices: ArrayLike | wp.array, faces: ArrayLike | wp.array, sphere: ArrayLike, *, device: str | None = "auto"
) -> Distortion:
    """Measure a sphere map.

    Args:
        vertices: the surface, shape [V, 3], any unit; or a Warp array of vec3d.
        faces: vertex indices, shape [F, 3], counter-clockwise seen from outside; or a Warp array of vec3i.
        sphere: the images of the vertices, shape [V, 3]; normalised here.
        device: where the per-triangle kernel runs.

    Returns:
        The distortion, section 6 of the paper, in all three weightings.
    """
    from omtwarp._warp import resolve_device, wp
    from omtwarp.metrics.kernels import triangle_distortion
    from omtwarp.points import triangles, vectors

    where = resolve_device(device)
    inputs = [vectors(vertices, where), vectors(sphere, where), triangles(faces, where)]
    count = len(inputs[2])
    outputs = [wp.empty(count, dtype=wp.float64, device=where) for _ in range(6)]
    wp.launch(triangle_distortion, dim=count, inputs=inputs, outputs=outputs, device=where)
    surface_area, sphere_area, determinant, angle, triple, solid = (array.numpy() for array in outputs)
    return summarize(surface_area, sphere_area, determinant, angle, triple, solid, bool(np.isfinite(sphere).all()))


def summarize(
    surface_area: NDArray[np.float64],
    sphere_area: NDArray[np.float64],
    determinant: NDArray[np.float64],
    angle: NDArray[np.float64],
    triple: NDArray[np.float64],
    solid: NDArray[np.float64],
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

    def aggregate(values: NDArray[np.float64]) -> dict[str, float]:
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
