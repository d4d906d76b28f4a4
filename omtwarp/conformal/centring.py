"""Möbius centring: the conformal map whose area-weighted mean is the centre of the sphere.

Conformal maps to the sphere are unique up to Möbius transformations only. Centring picks one (up to rotation) and
shrinks the range of the density μ. Source: Baden, Crane and Kazhdan, "Möbius Registration" (2018).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.device.policy import resolve_device
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats, InOneLine, normalised, real_numbers, squared_norms
from omtwarp.mesh.surface import MeshLike, as_sphere, as_surface, as_unit_vectors
from omtwarp.options import Progress, Record, tell

TOLERANCE = 1e-13  # on the length of the mean of the points: some hundred times the round-off of float64
MAXIMUM_STEPS = 100  # at most; Newton's method needs few where there is a centre
# With 0.5 and 0.9 the map of a creature has the same bits.
MAX_CENTRE = 0.7  # of the ball's radius: Newton's centre can lie outside the ball, where there is no transformation


@dataclass(frozen=True, repr=False)
class CentredMap(InOneLine):
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
        device: a device; the few steps are taken on the host.
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

    resolve_device(device)  # an unknown one is an error here as elsewhere
    moved, _ = centre_points(as_sphere(sphere, surface), weights, report=report)
    return CentredMap(moved, history)


def centre_points(
    sphere: Floats, masses: Floats, *, report: Callable[[float], None] | None = None
) -> tuple[Floats, int]:
    """Apply the Möbius transformation that brings the mass-weighted mean of points to the origin.

    Args:
        sphere: unit vectors, float64, shape [V, 3].
        masses: non-negative weights, shape [V], any unit; no point may carry half of the mass.
        report: called before every step with the distance of the mean from the origin.

    Returns:
        The moved points, shape [V, 3], and the number of Newton steps.

    Raises:
        OmtwarpError: the arrays do not fit together or are not of numbers, or the masses are so concentrated that the
            centre cannot be reached.
    """
    points = as_unit_vectors(sphere, name="sphere")
    masses = real_numbers(masses, "masses", (len(points),))
    if masses.min(initial=0.0) < 0.0 or not masses.sum() > 0.0:
        raise OmtwarpError("masses must not be negative, and not all be zero")
    weights = masses / masses.sum()
    mean = weights @ points
    for step in range(MAXIMUM_STEPS):
        size = float(np.linalg.norm(mean))
        if report is not None:
            report(size)
        if size <= TOLERANCE:
            return points, step
        # The derivative of the mean with respect to the centre of inversion is 2 (I - sum of w p p').
        jacobian = 2.0 * (np.eye(3) - (weights[:, None] * points).T @ points)
        try:
            centre = -np.linalg.solve(jacobian, mean)
        except np.linalg.LinAlgError:
            break
        length = np.linalg.norm(centre)
        if length > MAX_CENTRE:
            centre *= MAX_CENTRE / length
        while True:
            moved = ball_inversion(points, centre)
            new_mean = weights @ moved
            # Of a smaller mean the decrease is lost in round-off: full steps are taken.
            if np.linalg.norm(new_mean) < size or size < 1e-10:
                break
            centre *= 0.5
            if np.linalg.norm(centre) < 1e-16:  # which moves nothing in float64
                raise OmtwarpError("Möbius centring stalled: the conformal map crowds half of the surface into a point")
        if np.linalg.norm(new_mean) >= size:
            return points, step  # at round-off
        points, mean = moved, new_mean
    raise OmtwarpError("Möbius centring did not converge: the conformal map crowds half of the surface into a point")


def ball_inversion(points: Floats, centre: Floats) -> Floats:
    """Apply the Möbius transformation of the unit ball of Baden, Crane and Kazhdan (2018) to unit vectors."""
    shifted = points + centre
    return normalised((1.0 - centre @ centre) / squared_norms(shifted)[:, None] * shifted + centre)
