"""Möbius centring: the conformal map whose area-weighted mean is the centre of the sphere.

Conformal maps to the sphere are unique up to Möbius transformations only. Centring picks one (up to rotation) and
shrinks the range of the density μ. Source: Baden, Crane and Kazhdan, "Möbius Registration" (2018).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, ONE, TWO, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats, real_numbers
from omtwarp.mesh.surface import MeshLike, as_sphere, as_surface, as_unit_vectors
from omtwarp.options import Progress, Record, tell

wp.set_module_options(KERNEL_OPTIONS)

TOLERANCE = 1e-13  # on the length of the mean of the points: some hundred times the round-off of float64
MAXIMUM_STEPS = 100  # at most; Newton's method needs few where there is a centre
# With 0.5 and 0.9 the map of a creature has the same bits.
MAX_CENTRE = 0.7  # of the ball's radius: Newton's centre can lie outside the ball, where there is no transformation


@wp.func
def inverse_stereographic(x: wp.float64, y: wp.float64):
    """Map x + iy to (2x, 2y, 2r^2) / (1 + r^2) - (0, 0, 1) (section 4.1), without overflow at large r."""
    r2 = x * x + y * y
    if r2 <= ONE:
        s = ONE / (ONE + r2)
        return wp.vec3d(TWO * x * s, TWO * y * s, (r2 - ONE) * s)
    q = ONE / r2
    s = ONE / (ONE + q)
    return wp.vec3d(TWO * x * q * s, TWO * y * q * s, (ONE - q) * s)


@wp.func
def ball_inversion(p: wp.vec3d, c: wp.vec3d):
    """Apply the Möbius transformation of the unit ball of Baden, Crane and Kazhdan (2018) to a unit vector."""
    shifted = p + c
    return wp.normalize((ONE - wp.dot(c, c)) / wp.dot(shifted, shifted) * shifted + c)


@wp.kernel
def project_to_sphere(
    x: wp.array[wp.float64],
    y: wp.array[wp.float64],
    shift: wp.vec2d,
    scale: wp.float64,
    # Data out:
    sphere: wp.array[wp.vec3d],
):
    v = wp.tid()
    z = scale * (wp.vec2d(x[v], y[v]) - shift)
    sphere[v] = inverse_stereographic(z[0], z[1])


@wp.kernel
def apply_ball_inversion(
    sphere: wp.array[wp.vec3d],
    centre: wp.vec3d,
    # Data out:
    moved: wp.array[wp.vec3d],
):
    v = wp.tid()
    moved[v] = ball_inversion(sphere[v], centre)


@dataclass(frozen=True)
class CentredMap:
    """A map whose mean, weighted by mass, is the centre of the sphere.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        history: one record per Newton step, the start first: ``mean``, the distance of the mean from the centre.
        converged: True, as there is an error where the centre cannot be reached.
    """

    sphere: Floats
    history: list[Record]
    converged: bool = True


def mobius_centring(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    masses: ArrayLike | None = None,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> CentredMap:
    """Apply the Möbius transformation that brings the mass-weighted mean of a sphere map to the centre.

    Source: Baden, Crane and Kazhdan, "Möbius Registration" (2018).

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices.
        sphere: image of its vertices, unit vectors, shape [V, 3].
        masses: non-negative weights of the vertices, shape [V], any unit, of which none may be half of all; the areas
            around them where left out.
        device: where the per-vertex kernel runs.
        progress: called as ``progress("centring", step, most steps, {"mean": distance})``.

    Returns:
        The map moved by the transformation; angles between images are as before.

    Raises:
        OmtwarpError: the mesh or the map cannot be used, or the masses are so concentrated that the centre cannot be
            reached.

    Example:
        >>> import numpy as np, omtwarp
        >>> ball = omtwarp.shapes.icosphere(8)
        >>> crowded = ball.vertices + np.array([0.0, 0.0, 0.3])  # in the north
        >>> crowded /= np.linalg.norm(crowded, axis=1, keepdims=True)
        >>> centred = omtwarp.mobius_centring(ball, crowded, device="cpu")
        >>> bool(np.linalg.norm(ball.vertex_areas @ centred.sphere) < 1e-10)
        True
    """
    surface = as_surface(surface)
    weights = surface.vertex_areas if masses is None else real_numbers(masses, "masses", (surface.vertex_count,))
    history: list[Record] = []

    def report(mean: float) -> None:
        history.append({"iteration": len(history), "mean": mean})
        tell(progress, "centring", len(history) - 1, MAXIMUM_STEPS, {"mean": mean})

    moved, _ = centre_points(as_sphere(sphere, surface), weights, device=device, report=report)
    return CentredMap(moved, history)


def centre_points(
    sphere: Floats | wp.array,
    masses: Floats,
    *,
    device: str | None = "auto",
    report: Callable[[float], None] | None = None,
) -> tuple[Floats, int]:
    """Apply the Möbius transformation that brings the mass-weighted mean of points to the origin.

    Args:
        sphere: unit vectors, float64, shape [V, 3]; or a Warp array of vec3d on the device.
        masses: non-negative weights, shape [V], any unit; no point may carry half of the mass.
        device: where the per-vertex kernel runs.
        report: called before every step with the distance of the mean from the origin.

    Returns:
        The moved points, shape [V, 3], and the number of Newton steps.

    Raises:
        OmtwarpError: the arrays do not fit together or are not of numbers, or the masses are so concentrated that the
            centre cannot be reached.
    """
    if not isinstance(sphere, wp.array):
        sphere = as_unit_vectors(sphere, name="sphere")
    masses = real_numbers(masses, "masses", (len(sphere),))
    if masses.min(initial=0.0) < 0.0 or not masses.sum() > 0.0:
        raise OmtwarpError("masses must not be negative, and not all be zero")
    where = resolve_device(device)
    points = wp.clone(vectors(sphere, where))
    moved = wp.empty_like(points)
    weights = masses / masses.sum()
    mean = weights @ points.numpy()
    for step in range(MAXIMUM_STEPS):
        size = float(np.linalg.norm(mean))
        if report is not None:
            report(size)
        if size <= TOLERANCE:
            return points.numpy().copy(), step
        # The derivative of the mean with respect to the centre of inversion is 2 (I - sum of w p p').
        at = points.numpy()
        jacobian = 2.0 * (np.eye(3) - np.einsum("v,vi,vj->ij", weights, at, at))
        try:
            centre = -np.linalg.solve(jacobian, mean)
        except np.linalg.LinAlgError:
            break
        length = np.linalg.norm(centre)
        if length > MAX_CENTRE:
            centre *= MAX_CENTRE / length
        while True:
            wp.launch(apply_ball_inversion, dim=len(points), inputs=[points, wp.vec3d(*centre), moved], device=where)
            new_mean = weights @ moved.numpy()
            # Of a smaller mean the decrease is lost in round-off: full steps are taken.
            if np.linalg.norm(new_mean) < size or size < 1e-10:
                break
            centre *= 0.5
            if np.linalg.norm(centre) < 1e-16:  # which moves nothing in float64
                raise OmtwarpError("Möbius centring stalled: the conformal map crowds half of the surface into a point")
        if np.linalg.norm(new_mean) >= size:
            return points.numpy().copy(), step  # at round-off
        points, moved = moved, points
        mean = new_mean
    raise OmtwarpError("Möbius centring did not converge: the conformal map crowds half of the surface into a point")
