"""The stages of a map to a flat torus: conformal, optimal, then exact areas or refinement where they are asked for."""

import time
import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import resolve_device, solving_with
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.maps.result import MapResult, MeshReport, StageReport, Warned, origin_arrays
from omtwarp.mesh.quarter import QuarteredSurface, in_parts, quarter
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.metrics.optimality import torus_optimality
from omtwarp.optimal.cells import TriangleCells
from omtwarp.optimal.exact import largest_error, minimise_cells
from omtwarp.optimal.refinement import not_matched
from omtwarp.optimal.solver import OptimalMap
from omtwarp.options import AreaMatch, Domain, MapOptions, Progress, Record, Refinement, continued, tell
from omtwarp.torus.harmonic import QUANTUM, FlatTorus, conformal_torus, embedded_torus, quantised
from omtwarp.torus.transport import TorusMaps

REMEDY = "remesh with more triangles, evenly shaped"
WRONG_AREA = 1e-4  # largest relative error of an area around a vertex without a warning


def map_to_torus(surface: Surface, options: MapOptions, *, progress: Progress | None = None) -> MapResult:
    """Map a closed surface of genus 1 to a flat torus, areas around vertices kept, by optimal transport.

    Args:
        surface: closed, connected, of genus 1.
        options: of the map: ``refine``, ``exact``, ``optimality``, ``strict``, and where and how it is computed.
        progress: called as ``progress(stage, done, total, details)``.

    Raises:
        OmtwarpError: the mesh is too coarse, no map without flips was found, or options that only maps to the sphere
            have.
    """
    for name in ("method", "until", "cost", "scheme"):
        if getattr(options, name) != getattr(MapOptions, name):
            raise OmtwarpError(f"'{name}' is an option of maps to the sphere: a map to a torus has none")
    device = str(resolve_device(options.device))
    with solving_with(options.solver, device):
        run = _TorusComputation(surface, progress, device)
        run.optimal()
        if options.exact:
            run.keep_every_area()
        if options.refine is not None:
            run.refine(options.refine)
        return run.result(options)


class _TorusComputation:
    """The maps of one surface, stage by stage."""

    def __init__(self, surface: Surface, progress: Progress | None, device: str | None):
        self.clock = self.begin = time.perf_counter()
        self.history: list[Record] = []
        self.stages: list[StageReport] = []
        self.shape_weight = 0.0  # of the last stage
        self.warnings: list[Warned] = []
        tell(progress, "conformal", 0, 1, {})
        conformal = conformal_torus(surface)
        self.maps = TorusMaps(surface, conformal, progress, device)
        self.torus = embedded_torus(surface, conformal)
        self.finish("conformal", {}, conformal)

    def optimal(self) -> None:
        """Find the discrete optimal map."""
        optimum, self.shape_weight = self.maps.optimal(self.maps.near(self.torus))
        wrong = optimum.history[-1]["ring_largest"]
        self.take("omt", optimum, {"largest_ring_error": wrong})
        if wrong > WRONG_AREA:
            self.warn("vertex-areas", f"areas around vertices are kept to {wrong:.1%} at worst: {REMEDY}")

    def keep_every_area(self) -> None:
        """Find the optimal map of the quartered mesh, in which every triangle of the mesh keeps its area."""
        surface, maps = self.maps.surface, (self.maps.conformal, self.torus)
        quartered = quarter(surface)
        conformal, self.torus = (quartered_torus(quartered, surface.faces, torus) for torus in maps)
        self.maps = replace(self.maps, surface=quartered.surface, conformal=conformal)
        energy = self.maps.energy(self.shape_weight, cells=TriangleCells(quartered, resolve_device(self.maps.device)))

        def notify(_stage: str, done: int, total: int, details: Record) -> None:
            tell(self.maps.progress, "exact", done, total, details)

        exact = minimise_cells(energy, self.torus.points, notify)
        self.warnings.clear()  # they were about the map before
        self.take("exact", exact, {"largest_area_error": largest_error(exact)})

    def refine(self, weight: Refinement | AreaMatch | float) -> None:
        """Reduce the distortion of shape, at a higher cost."""
        refined, used = self.maps.refined(self.torus.points, weight)
        self.shape_weight = 1.0
        self.take("refine", refined, {"weight": used})
        if isinstance(weight, AreaMatch) and (missed := not_matched(weight.area, refined.history[-1]["area"])):
            self.warn("not-matched", "; ".join(missed))

    def take(self, name: str, result: OptimalMap, details: StageReport) -> None:
        """Continue with a map that was found."""
        self.history = continued(self.history, result.history)
        moved = self.torus.at(result.points)
        self.torus = replace(moved, coordinates=quantised(moved.coordinates))
        last = result.history[-1]
        whole: StageReport = {
            **details,
            "iterations": len(result.history) - 1,
            "converged": result.converged,
            "ended": result.ended,
            "transport_cost": last["cost"],
            "area_error": last["ring_rms"],
            "shape_weight": self.shape_weight,
        }
        self.finish(name, whole, self.torus)
        if not result.converged and name != "refine":
            self.warn("not-converged", f"the stage {name} did not converge: {result.ended}; {REMEDY}")

    def warn(self, kind: str, text: str) -> None:
        """Note a warning about the map."""
        self.warnings.append({"kind": kind, "where": -1, "text": text})

    def finish(self, name: str, details: StageReport, torus: FlatTorus) -> None:
        """Record a stage."""
        now = time.perf_counter()
        shown = self.made(torus).distortion().to_dict()
        self.stages.append({"name": name, "seconds": now - self.clock, **details, **shown})
        self.clock = now

    def made(self, torus: FlatTorus) -> MapResult:
        """Make the result with these coordinates."""
        surface = self.maps.surface
        area = float(triangle_areas(surface.vertices, surface.faces).sum())
        return MapResult(
            domain=Domain.TORUS,
            vertices=surface.vertices,
            faces=surface.faces,
            coordinates=torus.coordinates,
            wraps=torus.wraps,
            lattice=torus.lattice * np.sqrt(area / SPHERE_AREA),
            conformal=self.maps.conformal.coordinates,
            history=self.history,
        ).with_arrays(origin_arrays(surface.origins))

    def result(self, options: MapOptions) -> MapResult:
        """Return the finished map; with a warning, or an error if ``options.strict``, where areas are wrong.

        Raises:
            OmtwarpError: the map is not one to one.
        """
        result = self.made(self.torus)
        if not result.bijective:
            raise OmtwarpError(f"the map to the torus is not one to one: {result.certificate}")
        for finding in self.warnings:
            if options.strict:
                raise OmtwarpError(f"the map is not as good as strict=True requires: {finding['text']}")
            warnings.warn(OmtwarpWarning(finding["text"]), stacklevel=5)
        mesh: MeshReport = {"vertices": len(result.vertices), "faces": len(result.faces)}
        report = result.report
        report |= {"domain": "torus", "mesh": mesh, "quantum": QUANTUM, "seconds": time.perf_counter() - self.begin}
        report |= {"stages": self.stages, "certificate": result.certificate.to_dict(), "warnings": self.warnings}
        if options.optimality:
            x, torus = self.maps.conformal.points, self.torus
            measured = torus_optimality(self.maps.surface, x, torus.points, torus.shift, torus.lattice)
            report["optimality"] = measured.to_dict()
        return result


def quartered_torus(quartered: QuarteredSurface, faces: NDArray[np.integer], torus: FlatTorus) -> FlatTorus:
    """Extend a map to a torus to the quartered mesh, with new vertices at the midpoints of the edges' images.

    Args:
        quartered: the mesh's triangles in four parts each.
        faces: those of the mesh itself, shape [F, 3].
        torus: the map of the mesh.
    """
    # A middle has the wraps of the first end of its edge.
    first = quartered.split_edges[quartered.middles - len(torus.coordinates), 0]
    own = np.where((faces == first)[..., None], torus.wraps, np.roll(torus.wraps, -1, axis=1))
    corners = torus.corners(faces)
    points = np.pad(torus.coordinates, ((0, len(quartered.split_edges)), (0, 0)))
    points[quartered.middles] = quantised(0.5 * (corners + np.roll(corners, -1, axis=1)) - own)
    return FlatTorus(points, in_parts(torus.wraps, own), torus.lattice)
