"""From a mesh to its map: the stages of section 4 in order, each measured, each handing on a map without flips."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp.conformal import density
from omtwarp.device.arrays import vectors
from omtwarp.device.memory import give_back
from omtwarp.device.start import resolve_device, wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError
from omtwarp.flips.guard import hold_back
from omtwarp.flips.predicates import count_flips
from omtwarp.flips.rings import is_bijective
from omtwarp.mesh.surface import Surface
from omtwarp.mesh.validate import require_valid
from omtwarp.metrics.certificate import certify
from omtwarp.metrics.distortion import measure
from omtwarp.moser import moser_map
from omtwarp.refine.solver import refine_map
from omtwarp.result import MapResult
from omtwarp.start.choice import Start, bijective_start
from omtwarp.transport.area import AreaMonitor
from omtwarp.transport.flow import COSTS, optimal_transport, transport_cost
from omtwarp.transport.polish import polish_transport
from omtwarp.untangling.untangle import untangle

METHODS = ("omt", "haker", "moser", "tutte", "mean-value")
STAGES = ("conformal", "moser", "omt", "refine")
SCHEMES = ("default", "plain", "paper")
REFINEMENTS = ("none", "area", "balanced", "angle")
# One pass of Moser's flow leaves an area error of the order of the mesh; a second, from where the first ended, about
# halves it; a third no longer pays.
MOSER_PASSES = 2

Progress = Callable[[str, int, int, dict[str, Any]], None]


@blas_threads(1)
def map_to_sphere(
    mesh: Any,
    *,
    method: str = "omt",
    until: str = "refine",
    cost: str = "squared",
    scheme: str = "default",
    refine: str | float | None = "area",
    optimality: bool = False,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> MapResult:
    """Map a closed genus-0 surface to the unit sphere.

    Args:
        mesh: a ``trimesh.Trimesh``, ``(vertices, faces)`` or a :class:`Surface`; any unit, any position.
        method: ``omt``, the whole pipeline; or a system the paper compares with: ``haker`` (the conformal map),
            ``moser``, ``tutte`` or ``mean-value`` (spherical barycentric maps).
        until: the last stage: ``conformal``, ``moser``, ``omt`` or ``refine``.
        cost: ``squared`` geodesic distance, or the paper's ``geodesic`` distance.
        scheme: how transport is optimised: ``default``, ``plain`` or ``paper`` (Algorithms 1 and 2 as written).
        refine: ``none``, ``area``, ``balanced``, ``angle`` or the weight of area against angle.
        optimality: also measure how far the transported map is from optimal (a lower bound on the cost: slower).
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.
        progress: called as ``progress(stage, done, total, details)``.

    Returns:
        The map, in the order of the input's vertices.

    Raises:
        OmtwarpError: the mesh cannot be mapped, or an option is unknown.
    """
    _check("method", method, METHODS)
    _check("stage", until, STAGES)
    _check("cost", cost, COSTS)
    _check("scheme", scheme, SCHEMES)
    weight = parse_refinement(refine)
    where = resolve_device(device)
    surface = as_surface(mesh)
    with blas_threads(1):  # what is worth several threads is given them where it is done
        return _Run(surface, str(where), progress).run(method, until, cost, scheme, weight, optimality)


def as_surface(mesh: Any) -> Surface:
    """Take a mesh in any of the accepted forms, and make sure that it can be mapped.

    Raises:
        OmtwarpError: it cannot, or it is no mesh.
    """
    if isinstance(mesh, tuple | list) and len(mesh) == 2:
        vertices, faces = mesh
    elif hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        vertices, faces = mesh.vertices, mesh.faces
    else:
        raise OmtwarpError(f"expected a trimesh.Trimesh or (vertices, faces), got {type(mesh).__name__}")
    return Surface(*require_valid(vertices, faces))


def parse_refinement(value: str | float | None) -> str | float | None:
    """A named refinement, a positive weight, or None for none.

    Raises:
        OmtwarpError: neither.
    """
    if value is None or value == "none":
        return None
    if isinstance(value, str) and value in REFINEMENTS:
        return value
    try:
        weight = float(value)
    except (TypeError, ValueError):
        weight = -1.0
    if not (0.0 < weight < np.inf):
        raise OmtwarpError(f"unknown refinement '{value}': use {', '.join(REFINEMENTS)} or a positive number")
    return weight


def _check(what: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise OmtwarpError(f"unknown {what} '{value}': use {', '.join(known)}")


class _Run:
    """One map in the making: what was reached so far, and the record of how."""

    def __init__(self, surface: Surface, device: str, progress: Progress | None):
        self.surface = surface
        self.device = device
        self.progress = progress
        self.stages: list[dict[str, Any]] = []
        self.start: wp.array | None = None
        self.last: tuple[NDArray[np.float64], wp.array] | None = None
        self.begun = time.perf_counter()
        self.stage_begun = self.begun

    def tell(self, stage: str, done: int, total: int, details: dict[str, Any]) -> None:
        if self.progress is not None:
            self.progress(stage, done, total, details)

    def points(self, sphere: NDArray[np.float64]) -> wp.array:
        """A map where the kernels run; the one asked for last is there already."""
        if self.last is None or self.last[0] is not sphere:
            self.last = sphere, vectors(sphere, resolve_device(self.device))
        return self.last[1]

    def finish(self, name: str, sphere: NDArray[np.float64], iterations: int, **more: Any) -> None:
        """Close a stage: its time, and the map it hands on."""
        seconds = time.perf_counter() - self.stage_begun
        mesh = self.surface.on(self.device)
        measured = measure(mesh.vertices, mesh.faces, self.points(sphere), device=self.device)
        cost = 0.0
        if self.start is not None:
            cost = transport_cost(self.surface, self.start, self.points(sphere), device=self.device)
        record = {"name": name, "seconds": seconds, "iterations": iterations}
        record |= measured | {"transport_cost": cost} | more
        self.stages.append(record)
        self.tell(name, 1, 1, {"flips": measured["flips"], "cost": cost})
        self.stage_begun = time.perf_counter()

    def run(
        self, method: str, until: str, cost: str, scheme: str, weight: str | float | None, optimality: bool
    ) -> MapResult:
        surface = self.surface
        if method in ("tutte", "mean-value"):
            return self.barycentric(method)
        last = {"haker": 0, "moser": 1}.get(method, STAGES.index(until))
        self.tell("conformal", 0, 1, {})
        start = bijective_start(surface, device=self.device, progress=self.progress)
        start = replace(start, conformal=None)  # its factorisation is large, and not needed again
        self.start = self.points(start.sphere)
        self.finish("conformal", start.sphere, 1, road=start.road, reason=start.reason, repaired=start.repaired_flips)
        moser = transported = None
        history: list[dict[str, Any]] = []
        sphere = start.sphere
        if last >= 1:
            moser = sphere = self.moser(start)
        if last >= 2:
            sphere, history = self.transport(sphere, cost, scheme)
            transported = sphere
        if last >= 3 and weight is not None:
            sphere = self.refine(sphere, weight)
        face_density, vertex_density = density(surface, start.sphere)
        report = self.report(start, method, cost, scheme, weight, sphere)
        if optimality and transported is not None:
            report["optimality"] = self.optimality(start.sphere, moser, transported)
        return MapResult(
            vertices=surface.vertices,
            faces=surface.faces,
            sphere=sphere,
            conformal=start.sphere,
            density=vertex_density,
            face_density=face_density,
            moser=moser,
            transported=transported,
            history=history,
            report=report,
        )

    def moser(self, start: Start) -> NDArray[np.float64]:
        """Moser's flow from the start, repeated from its own result, flips repaired after each pass."""
        sphere = start.sphere
        monitor = AreaMonitor(self.surface, resolve_device(self.device))

        least = monitor.error(self.points(sphere))
        steps = repaired = 0
        for k in range(MOSER_PASSES):
            self.tell("moser", k, MOSER_PASSES, {})
            flowed = moser_map(self.surface, self.points(sphere), device=self.device)
            steps += flowed.steps
            mended, flips = self.mend(sphere, flowed.sphere)
            repaired += flips
            error = monitor.error(self.points(mended))
            if error >= least:
                break  # where the image is badly stretched, repairs can lose more than the flow gains
            sphere, least = mended, error
        self.finish("moser", sphere, steps, repaired=repaired)
        return sphere

    def transport(
        self, initial: NDArray[np.float64], cost: str, scheme: str
    ) -> tuple[NDArray[np.float64], list[dict[str, Any]]]:
        """The optimal map, by the scheme asked for."""

        def tell(done: int, total: int, details: dict[str, Any]) -> None:
            self.tell("omt", done, total, details)

        assert self.start is not None
        if scheme == "paper":
            from omtwarp.transport.paper import paper_flow

            result = paper_flow(
                self.start.numpy(), self.surface.faces, initial, self.surface.face_areas, cost=cost, device=self.device
            )
            sphere, repaired = self.mend(initial, result.map_at_vertices)
            history, converged = result.history, result.stopped != "cycles"
        else:
            moved = optimal_transport(
                self.surface,
                self.start,
                self.points(initial),
                cost=cost,
                scheme=scheme,
                device=self.device,
                progress=tell,
            )
            sphere, repaired = self.mend(initial, moved.sphere)
            history, converged = moved.history, moved.converged
            if scheme == "default" and cost == "squared":
                polished = polish_transport(
                    self.surface, self.start, self.points(sphere), device=self.device, progress=tell
                )
                sphere, more = self.mend(sphere, polished.sphere)
                repaired += more
                history = history + [
                    record | {"iteration": len(history) + k} for k, record in enumerate(polished.history[1:])
                ]
        self.finish("omt", sphere, len(history) - 1, repaired=repaired, converged=converged)
        return sphere, history

    def refine(self, sphere: NDArray[np.float64], weight: str | float) -> NDArray[np.float64]:
        def tell(text: str, done: int, total: int) -> None:
            self.tell("refine", done, total, {"text": text})

        give_back()  # the largest matrices follow
        refined = refine_map(self.surface, sphere, weight=weight, device=self.device, progress=tell)
        sphere, repaired = self.mend(sphere, refined.sphere)
        record = {"weight": weight, "converged": refined.converged, "repaired": repaired}
        self.finish("refine", sphere, len(refined.history), **record)
        return sphere

    def barycentric(self, method: str) -> MapResult:
        from omtwarp.baselines.barycentric import solve_barycentric

        solved = solve_barycentric(self.surface, "tutte" if method == "tutte" else "mean-value", device=self.device)
        sphere = solved.sphere
        self.start = self.points(sphere)
        self.finish(method, sphere, solved.iterations, converged=solved.converged)
        face_density, vertex_density = density(self.surface, sphere)
        return MapResult(
            vertices=self.surface.vertices,
            faces=self.surface.faces,
            sphere=sphere,
            conformal=sphere,
            density=vertex_density,
            face_density=face_density,
            report=self.report(None, method, "", "", None, sphere),
        )

    def mend(self, before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Repair what keeps a stage's map from being one to one, or hold it back towards the map before it.

        Repair may end with all triangles positive and the sphere covered twice: such maps are not taken either.

        Returns:
            A bijection, and how many flips the stage's map had.
        """
        faces = self.surface.on(self.device).faces
        if is_bijective(self.points(after), faces, device=self.device):
            return after, 0
        flips = count_flips(self.points(after), faces, device=self.device)
        repaired = untangle(self.surface, after, device=self.device).sphere
        if is_bijective(self.points(repaired), faces, device=self.device):
            return repaired, flips
        return hold_back(self.surface, before, after, device=self.device), flips

    def optimality(
        self, start: NDArray[np.float64], moser: NDArray[np.float64] | None, transported: NDArray[np.float64]
    ) -> dict[str, Any]:
        from omtwarp.metrics.optimality import optimality

        surface = self.surface
        measured = optimality(start, transported, surface.vertex_areas, surface.faces, device=self.device)
        return measured.to_dict()

    def report(
        self,
        start: Start | None,
        method: str,
        cost: str,
        scheme: str,
        weight: str | float | None,
        sphere: NDArray[np.float64],
    ) -> dict[str, Any]:
        surface = self.surface
        lengths = surface.vertices.max(axis=0) - surface.vertices.min(axis=0)
        return {
            "mesh": {
                "vertices": surface.vertex_count,
                "faces": surface.face_count,
                "extent": [float(x) for x in lengths],
            },
            "versions": versions(),
            "device": self.device,
            "method": method,
            "cost": cost,
            "scheme": scheme,
            "refine": weight,
            "start": {"road": start.road, "reason": start.reason} if start is not None else {"road": method},
            "seconds": time.perf_counter() - self.begun,
            "stages": self.stages,
            "certificate": self.certificate(sphere),
        }

    def certificate(self, sphere: NDArray[np.float64]) -> dict[str, Any]:
        """What is certain about the map that is handed out.

        Raises:
            OmtwarpError: it is not one to one.
        """
        certificate = certify(self.surface.faces, sphere, device=self.device)
        if not certificate.bijective:
            raise OmtwarpError(
                f"no map that is one to one was found: {certificate}; repair or remesh the surface and try again"
            )
        return certificate.to_dict()


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    import platform

    import scipy

    import omtwarp

    return {
        "omtwarp": omtwarp.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "warp": wp.config.version,
    }
