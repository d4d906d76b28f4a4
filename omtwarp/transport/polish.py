"""The last of the curl, removed on the image mesh itself.

The flow on the subdivided solid leaves what its wavelets cannot show. Here the stream function lives on the vertices of
the image: one Poisson problem takes the curl out of log_y(x) (section 2.3, with Angenent, Haker and Tannenbaum's (2003)
projection in place of steepest descent), and another, with the same factorised matrix, restores the areas, as one step
of Moser's flow would (section 4.2). A few rounds leave a map that is closer to optimal and to area preserving at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp._warp import resolve_device, wp
from omtwarp.embedding.guard import StepGuard
from omtwarp.linear import SurfaceLaplacianSolver
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.moser.kernels import vertex_field
from omtwarp.transport.area import AreaMonitor
from omtwarp.transport.flow import TransportMap, transport_cost
from omtwarp.transport.polish_kernels import displacements, move_by_potentials, weak_curl_and_area

ROUNDS = 12
# Half of the way: where the map contracts strongly a full step overshoots.
STEP = 0.5
# A round has to take at least this part off the curl to be worth another.
WORTHWHILE = 0.03
NEGLIGIBLE = 1e-3


def polish_transport(
    surface: Surface,
    start: NDArray[np.float64],
    sphere: NDArray[np.float64],
    *,
    rounds: int = ROUNDS,
    device: str | None = "cpu",
    progress: Callable[[int, int, dict[str, Any]], None] | None = None,
) -> TransportMap:
    """Remove the curl left in a nearly optimal map, and its area error with it.

    Args:
        surface: the surface; its vertex areas, total 4π, are the masses.
        start: the points x that are transported, unit vectors, shape [V, 3].
        sphere: a mass-preserving map of them without flips, unit vectors, shape [V, 3].
        rounds: the most rounds.
        device: where the kernels run; the sparse systems are solved on the host.
        progress: called after each round with its number, the most there can be, and its record.

    Returns:
        The map of the last round that lowered both the curl and the area error, and a record of all rounds:
        ``iteration``, ``cost``, ``curl``, ``held``, ``area_error``.
    """
    where = resolve_device(device)
    count = surface.vertex_count
    faces = wp.array(surface.faces, dtype=wp.vec3i, device=where)
    rows = [wp.array(array, dtype=wp.int32, device=where) for array in surface.vertex_corners]
    origin = wp.array(np.ascontiguousarray(start), dtype=wp.vec3d, device=where)
    points = wp.array(np.array(sphere, dtype=np.float64), dtype=wp.vec3d, device=where)
    moved, pull, curl_field, area_field = (wp.empty_like(points) for _ in range(4))
    curl, energy, area = (wp.empty(count, dtype=wp.float64, device=where) for _ in range(3))
    guard = StepGuard(surface, where)
    monitor = AreaMonitor(surface, where)
    guarded = guard.count(points) == 0
    solver = SurfaceLaplacianSolver(surface, sphere)
    history: list[dict[str, Any]] = []
    best, least, held, area_error = points.numpy().copy(), np.inf, 0, np.inf
    for number in range(rounds + 1):
        wp.launch(displacements, dim=count, inputs=[origin, points], outputs=[pull], device=where)
        wp.launch(
            weak_curl_and_area,
            dim=count,
            inputs=[points, pull, faces, *rows],
            outputs=[curl, energy, area],
            device=where,
        )
        weak, areas = curl.numpy(), area.numpy()
        missing = surface.vertex_areas - areas * (SPHERE_AREA / areas.sum())
        potentials = solver.solve(np.stack([weak, missing], axis=1))
        relative = float(np.sqrt(max(weak @ potentials[:, 0], 0.0) / max(float(energy.numpy().sum()), 1e-300)))
        values = points.numpy()
        record = {
            "iteration": number,
            "cost": transport_cost(surface, start, values),
            "curl": relative,
            "step": STEP,
            "held": held,
            "area_error": monitor.error(points),
        }
        history.append(record)
        if progress is not None:
            progress(number, rounds, record)
        # Where the mesh is too coarse for the motion, areas are what it is paid for with: that round is one too many.
        kept = record["area_error"] <= area_error
        improved = kept and relative < (1.0 - WORTHWHILE) * least
        if kept and relative < least:
            best, least, area_error = values.copy(), relative, record["area_error"]
        if not improved or relative <= NEGLIGIBLE or number == rounds:
            break
        for potential, field in ((potentials[:, 0], curl_field), (potentials[:, 1], area_field)):
            theta = wp.array(np.ascontiguousarray(potential), dtype=wp.float64, device=where)
            wp.launch(vertex_field, dim=count, inputs=[points, faces, theta, *rows], outputs=[field], device=where)
        wp.launch(
            move_by_potentials,
            dim=count,
            inputs=[points, curl_field, area_field, wp.float64(STEP)],
            outputs=[moved],
            device=where,
        )
        held = guard.limit(points, moved) if guarded else 0
        points, moved = moved, points
    return TransportMap(best, history, True)
