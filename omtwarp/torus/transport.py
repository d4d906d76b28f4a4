"""The optimal map to a flat torus: least squared distance among the maps that keep the areas around vertices.

A step solves the saddle point of a quadratic model under linearised areas; its Hessian is that of the cost plus a
small multiple of the triangles' distortion, which keeps them from collapsing. Steps are shortened until no triangle
turns over and the augmented Lagrangian falls. Before that the areas asked for go from those of the conformal map to
those of the surface in stages, a discrete form of Moser's flow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.surface import SPHERE_AREA, Surface
from omtwarp.torus.harmonic import FlatTorus
from omtwarp.torus.kernels import plane_triangle_distortion
from omtwarp.triangle_newton.frames import triangle_frames

Floats = NDArray[np.float64]

SHAPE_WEIGHT = 0.01  # of the triangles' distortion beside the mean squared distance
AREA_WEIGHT = 10.0  # of area against angle distortion of triangles
HALVINGS = 30
GAIN = 1e-7  # a step that promises less, relative to cost and areas, ends the iteration
AREA_ERROR = 1e-6  # relative error of areas around vertices (rms) that is small enough to end with


@dataclass(frozen=True)
class TorusTransport:
    """How the optimal map was found.

    Attributes:
        displacement: of every vertex from the conformal map, in the plane, shape [V, 2].
        history: one record per step: ``cost`` (mean squared distance), ``area_error`` (relative, rms), ``length``.
        converged: whether the last step promised next to nothing.
    """

    displacement: Floats
    history: list[dict[str, Any]]
    converged: bool


class _Problem:
    """Cost, areas and distortion of maps of one surface to one torus."""

    def __init__(self, surface: Surface, torus: FlatTorus):
        self.faces, self.count = surface.faces.astype(np.int64), surface.vertex_count
        self.start = torus.coordinates @ torus.lattice
        self.shift = torus.wraps @ torus.lattice
        self.masses, self.weights = surface.vertex_areas, SHAPE_WEIGHT * surface.face_areas / SPHERE_AREA
        self.frames = triangle_frames(surface)
        flat = 2 * np.repeat(self.faces, 2, axis=1) + np.tile([0, 1], 3)  # places of the six coordinates, [F, 6]
        self.places = flat
        self.rows = np.repeat(flat, 6, axis=1).ravel()
        self.columns = np.tile(flat, (1, 6)).ravel()

    def corners(self, points: Floats) -> Floats:
        return points[self.faces] + self.shift

    def areas(self, points: Floats) -> tuple[Floats, Floats]:
        """Signed areas of triangles, shape [F], and a third of those around vertices, shape [V]."""
        corner = self.corners(points)
        one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        areas = 0.5 * (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        return areas, np.bincount(self.faces.ravel(), np.repeat(areas, 3), minlength=self.count) / 3.0

    def area_gradient(self, points: Floats) -> sparse.csr_array:
        """Derivative of the areas around vertices, shape [V, 2V]."""
        corner = self.corners(points)
        opposite = np.roll(corner, -2, axis=1) - np.roll(corner, -1, axis=1)
        slopes = np.stack([-opposite[..., 1], opposite[..., 0]], axis=2).reshape(-1, 6) / 6.0
        rows = np.repeat(self.faces, 6, axis=1).ravel()
        columns, values = np.tile(self.places, (1, 3)).ravel(), np.tile(slopes, (1, 3)).ravel()
        return sparse.coo_array((values, (rows, columns)), shape=(self.count, 2 * self.count)).tocsr()

    def distortion(self, points: Floats, whole: bool) -> tuple[float, Floats, Any]:
        """The triangles' energy, and where asked for its gradient, shape [2V], and Hessian, shape [2V, 2V]."""
        count = len(self.faces)
        shapes: dict[str, tuple[int, ...]] = {"e": (count,), "g": (count, 6), "h": (count, 6, 6), "d": (count,)}
        out = {name: wp.empty(shape, dtype=wp.float64, device="cpu") for name, shape in shapes.items()}
        corners = wp.array(np.ascontiguousarray(self.corners(points)), dtype=wp.vec2d, device="cpu")
        frames = wp.array(self.frames, dtype=wp.vec3d, device="cpu")
        weights = wp.array(self.weights, dtype=wp.float64, device="cpu")
        inputs = [corners, frames, weights, wp.float64(AREA_WEIGHT)]
        wp.launch(plane_triangle_distortion, dim=count, inputs=inputs, outputs=list(out.values()), device="cpu")
        energy = float(out["e"].numpy().sum())
        if not whole:
            return energy, np.zeros(0), None
        gradient = np.bincount(self.places.ravel(), out["g"].numpy().ravel(), minlength=2 * self.count)
        size = (2 * self.count, 2 * self.count)
        hessian = sparse.coo_array((out["h"].numpy().ravel(), (self.rows, self.columns)), shape=size).tocsr()
        return energy, gradient.astype(np.float64), hessian


def transport_on_torus(
    surface: Surface, torus: FlatTorus, *, stages: int = 6, iterations: int = 40, progress: Any = None
) -> TorusTransport:
    """Find the optimal map of a surface to a flat torus.

    Args:
        surface: of genus 1; its vertex areas, total 4π, are the masses.
        torus: a conformal map without flips; distances are measured from it.
        stages: in how many parts the areas go from those of the conformal map to the surface's.
        iterations: most steps after that.
        progress: called as ``progress(done, total, details)``.

    Raises:
        OmtwarpError: a triangle of the conformal map is turned over.
    """
    problem = _Problem(surface, torus)
    points = problem.start.copy()
    flat, first = problem.areas(points)
    if (flat <= 0.0).any():
        raise OmtwarpError(f"the conformal map to the torus has {int((flat <= 0.0).sum())} flipped triangles")
    pressure = np.zeros(problem.count)
    history: list[dict[str, Any]] = []
    converged = False
    total = stages + iterations
    for step in range(total):
        share = min(1.0, (step + 1.0) / stages) if stages else 1.0
        # Geometric means, so that areas that differ by orders of magnitude change by equal factors.
        wanted = first ** (1.0 - share) * problem.masses**share
        wanted *= SPHERE_AREA / wanted.sum()
        points, pressure, record = _step(problem, points, pressure, wanted)
        history.append(record | {"iteration": step})
        if progress is not None:
            progress(step + 1, total, {"cost": record["cost"], "area": record["area_error"]})
        if share == 1.0 and record["promise"] < GAIN and record["area_error"] < AREA_ERROR:
            converged = True
            break
        if record["length"] == 0.0 and share == 1.0:
            break
    return TorusTransport(points - problem.start, history, converged)


def _step(problem: _Problem, points: Floats, pressure: Floats, wanted: Floats) -> tuple[Floats, Floats, dict[str, Any]]:
    """One step of sequential quadratic programming towards areas wanted around vertices."""
    count = problem.count
    mass = np.repeat(problem.masses, 2) / SPHERE_AREA
    _, around = problem.areas(points)
    error = around - wanted
    moved = (points - problem.start).ravel()
    energy, gradient, hessian = problem.distortion(points, True)
    gradient = gradient + 2.0 * mass * moved
    slopes = problem.area_gradient(points)
    # The areas add up to the torus's: one pressure is free, and a small entry on the diagonal fixes it.
    loose = sparse.diags_array(1e-9 * wanted)
    matrix = sparse.block_array([[hessian + sparse.diags_array(2.0 * mass), slopes.T], [slopes, -loose]]).tocsc()
    solution = _solve(matrix, np.concatenate([-gradient, -error]))
    move, pressure = solution[: 2 * count].reshape(-1, 2), solution[2 * count :]
    penalty = 2.0 * float(np.abs(pressure).max())

    def merit(at: Floats) -> float:
        flat, areas = problem.areas(at)
        if (flat <= 0.0).any():
            return np.inf
        away = (at - problem.start).ravel()
        return problem.distortion(at, False)[0] + float(mass @ away**2) + penalty * float(np.abs(areas - wanted).sum())

    before = energy + float(mass @ moved**2) + penalty * float(np.abs(error).sum())
    slope = float(gradient @ move.ravel()) - penalty * float(np.abs(error).sum())
    length = 1.0
    for _ in range(HALVINGS):
        if merit(points + length * move) <= before + 1e-4 * length * min(slope, 0.0):
            break
        length *= 0.5
    else:
        length = 0.0
    points = points + length * move
    _, around = problem.areas(points)
    away = (points - problem.start).ravel()
    relative = (around - problem.masses) / problem.masses
    record = {
        "cost": float(mass @ away**2),
        "area_error": float(np.sqrt(np.mean(relative**2))),
        "length": length,
        "promise": -slope / max(before, np.finfo(float).tiny),
    }
    return points, pressure, record


def _solve(matrix: sparse.csc_array, right: Floats) -> Floats:
    """Solve a quasi-definite system, which needs no pivots off the diagonal in any order (Vanderbei 1995)."""
    # Minimum degree is fast on a mesh only when its numbering is not regular.
    order = np.random.default_rng(0).permutation(len(right))
    factor = splu(
        matrix[order][:, order].tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    solution = np.empty_like(right)
    solution[order] = factor.solve(right[order])
    residual = right - matrix @ solution
    solution[order] += factor.solve(residual[order])  # what pivots without a search lose
    return solution


__all__ = ["TorusTransport", "transport_on_torus"]
