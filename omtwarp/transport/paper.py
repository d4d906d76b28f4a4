"""The paper's optimal-transport flow as it is written: Algorithms 1 and 2, with sections 2.4, 2.5 and 4.3.

The map g from the conformal sphere (density mu) to the uniform sphere is carried on the dual vertices of the conformal
mesh and evolves by g_t + v · grad g = 0 with v = -(1/mu) J grad H, where H is the divergence of J Phi_x without the
wavelet coefficients above the current resolution.

Departures from the text, each where the text is silent, misprinted, or cannot be taken literally:

* Sign. Section 2.5 finds J Phi_x = -(x × g) / |x × g|, and (11) sets H = div (J Phi_x); equation (18) and Algorithm 1
  then drop the minus sign. With v = -(1/mu) x × grad H as in (10) and line 16, the cost rises for the sign of (18); the
  sign of (11) is used.
* The geodesic cost has no gradient where g = x. |x × g| is replaced by sqrt(|x × g|^2 + delta^2), with delta a small
  fraction of the mean displacement: the cost it descends is smoothed where points hardly move.
* Dual vertices. Those of obtuse triangles lie outside; where that is so the barycentric coordinates are clamped to the
  triangle (the foot on the longest edge), since g would otherwise be extrapolated. The areas and fluxes keep the true
  circumcentres, whose signed lengths the identities of appendix B need.
* Going from g at the dual vertices to g at the vertices ("linear interpolation") and back smooths at the scale of
  the mesh. The difference between the initial map and its own interpolation is kept and added back before
  normalising, so that the map at the vertices starts as the initial map exactly and no area is lost before the first
  step.
* H at mesh vertices goes to the wavelets' nodes as a mass-normalised mean of fluxes, so no Voronoi area is divided by
  (they may vanish or be negative), and comes back by linear interpolation. The paper does not say how it is done.
* Levels. A resolution whose nodes outnumber the mesh's vertices has coefficients that the mesh does not determine; it
  is left out of the V-cycle unless ``resolutions`` asks for it.
* Step sizes. "Smaller time steps at higher resolutions" is all the paper gives. Each level starts with a step
  proportional to the square of its node spacing, which then adapts: a step that does not lower the cost is
  taken back and halved, one that does lets the next grow. A Courant condition bounds it; the one triangle in a thousand
  that moves fastest is slowed down instead of all the others.
* Flips. Where a step would turn a triangle over, the flow stands still in that step around its vertices. Triangles
  that the conformal map has flipped do not move g.
* Mass. Each step keeps areas only up to the discretisation, so that many steps leak area, and a cost that falls because
  mass is lost proves nothing. The flow ends, one step earlier, when the mean area distortion has grown by more than
  ``area_loss``; the paper's own tables show such a loss (2.004 to 2.007 on Max Planck, 2.51 to 2.61 on Gargoyle).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.geometry import DifferentialOperators, circumcentric_coordinates
from omtwarp.mesh.checks import MeshLike, as_sphere, as_surface
from omtwarp.mesh.surface import Surface, triangle_areas
from omtwarp.options import Cost, Progress, choose
from omtwarp.transport import paper_kernels as kernels
from omtwarp.wavelets import SphereSampler, SphericalWavelets, level_for, sphere_hierarchy

V_CYCLE = (1, 2, 3, 4, 5, 4, 3, 2, 1)
COURANT = 0.1  # of the size of the triangle that a point crosses: the longest way it goes in a step
WITHIN_COURANT = 0.999  # share of the points that COURANT is kept for; the others are held back
HOLDING_ROUNDS = 8  # in which points around flipped triangles are held back before a step is refused
FIRST_STEP = 0.1  # times the squared spacing of the level's nodes
GROWTH = 1.5  # of the step after one that was accepted; it is halved after one that was not
SMALLEST_DISPLACEMENT = 0.1  # of the mean displacement: the geodesic cost has no gradient at zero
STALLED = 1e-6  # of the first step: a level whose step has become shorter is left out
TINY = 1e-300  # keeps divisors from zero


@dataclass(frozen=True)
class FlowResult:
    """The result of a flow.

    Attributes:
        sphere: image of every vertex on the unit sphere, shape [V, 3].
        history: one entry per accepted or refused step: ``iteration``, ``cycle``, ``level`` (the resolution), ``cost``
            (after the step), ``step`` (dt), ``accepted``, and ``area``, the mean of r + 1/r over the image, where r is
            the ratio of areas (2 is perfect); entry 0 is the start, with level 0.
        stopped: why it ended: ``cost`` (a whole cycle no longer lowers it), ``hamiltonian`` (integral of H^2 below the
            bound), ``area`` (more mass would be lost than allowed) or ``cycles`` (all done).
    """

    sphere: NDArray[np.float64]
    history: list[dict[str, Any]] = field(default_factory=list)
    stopped: str = "cycles"

    @property
    def converged(self) -> bool:
        """Whether the flow ended before all its cycles were used."""
        return self.stopped != "cycles"


class PaperFlow:
    """The state of Algorithm 1 on a device: operators built once, and one step at a chosen resolution.

    Args:
        conformal: conformal image of the vertices, unit vectors, shape [V, 3].
        faces: triangles, shape [F, 3].
        initial_map: image of the vertices under a mass-preserving map g^0, unit vectors, shape [V, 3].
        face_areas_on_surface: areas on the original surface, shape [F]; scaled here to sum to 4π.
        cost: ``geodesic`` (theta) or ``squared`` (theta squared).
        highest_resolution: the highest wavelet level j that will be used.
        butterfly: use the butterfly wavelets instead of those of the hat functions.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Attributes:
        dual_map: g at the dual vertices, Warp vec3d [F].
        map: g at the mesh vertices, Warp vec3d [V].
        hamiltonian: H at the wavelets' nodes, Warp float64 [N].
        mean_displacement: mean of |x × g| over the surface.
    """

    def __init__(
        self,
        conformal: ArrayLike,
        faces: ArrayLike,
        initial_map: ArrayLike,
        face_areas_on_surface: ArrayLike,
        *,
        cost: str = Cost.GEODESIC,
        highest_resolution: int = max(V_CYCLE),
        butterfly: bool = False,
        device: str = "auto",
    ) -> None:
        surface = Surface(conformal, faces)
        start = np.ascontiguousarray(initial_map, dtype=np.float64)
        masses = np.array(face_areas_on_surface, dtype=np.float64)
        if start.shape != surface.vertices.shape or masses.shape != (surface.face_count,):
            raise OmtwarpError(
                f"expected a map of shape {surface.vertices.shape} and {surface.face_count} areas, "
                f"got {start.shape} and {masses.shape}"
            )
        masses *= 4 * np.pi / masses.sum()
        masses = np.maximum(masses, 1e-12 * masses.mean())  # mu is divided by; a triangle without area carries nothing
        self.squared = int(choose(Cost, cost) is Cost.SQUARED)
        self.operators = DifferentialOperators(surface.vertices, surface.faces, device=device)
        self.device = self.operators.device

        hierarchy = sphere_hierarchy(highest_resolution + 1)
        self.wavelets = SphericalWavelets(hierarchy, butterfly=butterfly, device=device)
        self.sampler = SphereSampler(hierarchy, surface.vertices, device=device)
        areas = triangle_areas(surface.vertices, surface.faces)
        self.sampler.set_masses(surface.sum_to_vertices(areas) / 3)

        def send(array: NDArray[np.float64], dtype: Any = wp.float64) -> Any:
            return wp.array(np.ascontiguousarray(array), dtype=dtype, device=self.device)

        inside = np.maximum(circumcentric_coordinates(surface.vertices, surface.faces), 0.0)
        total = inside.sum(axis=1)
        degenerate = ~np.isfinite(total) | (total <= 0)
        inside[degenerate] = 1 / 3
        inside /= inside.sum(axis=1)[:, None]
        self._weights = send(inside, wp.vec3d)
        self._areas, self._masses = send(areas), send(masses)
        count, vertex_count = surface.face_count, surface.vertex_count
        self._points: Any = wp.empty(count, dtype=wp.vec3d, device=self.device)
        self.dual_map: Any = wp.empty(count, dtype=wp.vec3d, device=self.device)
        self._advanced: Any = wp.empty(count, dtype=wp.vec3d, device=self.device)
        self._field = wp.empty(count, dtype=wp.vec3d, device=self.device)
        self._velocity = wp.empty(count, dtype=wp.vec3d, device=self.device)
        self._per_face: Any = wp.empty(count, dtype=wp.float64, device=self.device)
        self._image_areas: Any = wp.empty(count, dtype=wp.float64, device=self.device)
        self._rate: Any = wp.empty(count, dtype=wp.float64, device=self.device)
        self._flux = wp.empty(vertex_count, dtype=wp.float64, device=self.device)
        self._at_vertices: Any = wp.empty(vertex_count, dtype=wp.float64, device=self.device)
        self.hamiltonian: Any = wp.empty(hierarchy.node_count, dtype=wp.float64, device=self.device)

        at_vertices = send(start, wp.vec3d)
        to_dual = [self.operators.faces, self._weights]
        self._launch(kernels.average_to_dual, count, [*to_dual, self.operators.vertices], [self._points])
        self._launch(kernels.average_to_dual, count, [*to_dual, at_vertices], [self.dual_map])
        self.map: Any = wp.empty(vertex_count, dtype=wp.vec3d, device=self.device)
        self._advanced_map: Any = wp.empty(vertex_count, dtype=wp.vec3d, device=self.device)
        self._flipped: Any = wp.empty(count, dtype=wp.int32, device=self.device)
        self._held: Any = wp.empty(count, dtype=wp.int32, device=self.device)
        self._marked: Any = wp.empty(vertex_count, dtype=wp.int32, device=self.device)
        self.operators.interpolate_dual(self.dual_map, out=self.map)
        self._correction = send(start - self.map.numpy(), wp.vec3d)
        self._to_vertices(self.dual_map, self.map)

        points, images = self._points.numpy(), self.dual_map.numpy()
        sine = np.linalg.norm(np.cross(points, images), axis=1)
        mean = float((masses * sine).sum() / (4 * np.pi))
        self._smallest = 1e-8 if self.squared else max(SMALLEST_DISPLACEMENT * mean, 1e-8)
        self.mean_displacement = mean

    def _launch(self, kernel: Any, size: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device=self.device)

    def cost_of(self, dual_map: Any) -> float:
        """M(g), equation (6): the sum over triangles of surface area times Phi at the dual vertex."""
        inputs = [self._points, dual_map, self._masses, self.squared]
        self._launch(kernels.dual_costs, len(dual_map), inputs, [self._per_face])
        return float(self._per_face.numpy().sum())

    def area_of(self, image: Any) -> float:
        """Mean of r + 1/r over the image of the mesh, r = image area / surface area of a triangle."""
        inputs = [self.operators.faces, image, self._masses]
        self._launch(kernels.area_distortions, len(self.dual_map), inputs, [self._per_face, self._image_areas])
        return float(self._per_face.numpy().sum() / self._image_areas.numpy().sum())

    def _to_vertices(self, dual_map: Any, out: Any) -> None:
        """g at the mesh vertices from the dual ones (Algorithm 1, lines 7 and 8)."""
        self.operators.interpolate_dual(dual_map, out=out)
        self._launch(kernels.correct_and_normalise, len(out), [self._correction, out], [])

    def set_hamiltonian(self, resolution: int) -> None:
        """H at the wavelets' nodes from g, without levels j > ``resolution`` (Algorithm 1, lines 2 to 14)."""
        inputs = [self._points, self.dual_map, self.squared, self._smallest]
        self._launch(kernels.rotated_cost_gradients, len(self.dual_map), inputs, [self._field])
        self.operators.divergence(self._field, out=self._flux)
        self.sampler.restrict(self._flux, out=self.hamiltonian)
        self.wavelets.analyse(self.hamiltonian)
        self.wavelets.truncate(self.hamiltonian, resolution)
        self.wavelets.synthesise(self.hamiltonian)

    def hamiltonian_norm(self) -> float:
        """The integral of H^2 over the sphere (section 2.4's second stopping rule)."""
        values = self.hamiltonian.numpy()
        return float(self.wavelets.hierarchy.node_areas @ (values * values))

    def set_velocity(self) -> float:
        """v at the dual vertices (Algorithm 1, line 16); returns the largest rate |v| / (triangle size)."""
        self.sampler.interpolate(self.hamiltonian, out=self._at_vertices)
        mesh = [self.operators.vertices, self.operators.faces]
        inputs = [*mesh, self._areas, self._masses, self._at_vertices]
        self._launch(kernels.dual_velocity, len(self.dual_map), inputs, [self._velocity, self._rate])
        return float(np.quantile(self._rate.numpy(), WITHIN_COURANT))

    def advance(self, step: float) -> bool:
        """The map after a step dt (Algorithm 1, line 17), kept aside; False where it would flip triangles regardless.

        Where it turns triangles over, the step is repeated with the flow held still around them.
        """
        mesh = [self.operators.vertices, self.operators.faces]
        rows = [self.operators.corner_offsets, self.operators.corners]
        faces, count = self.operators.faces, len(self.dual_map)
        self._held.zero_()
        for _ in range(HOLDING_ROUNDS):
            inputs = [*mesh, self._velocity, self._rate, COURANT / step, self._held, step, self.map, self.dual_map]
            self._launch(kernels.advance_map, count, inputs, [self._advanced])
            self._to_vertices(self._advanced, self._advanced_map)
            inputs = [faces, self.map, self._advanced_map]
            self._launch(kernels.newly_flipped, count, inputs, [self._flipped])
            if not self._flipped.numpy().any():
                return True
            self._launch(kernels.mark_vertices, len(self.map), [*rows, self._flipped], [self._marked])
            self._launch(kernels.hold_faces, count, [faces, self._marked], [self._held])
        return False

    def advanced_cost(self) -> float:
        """M of the map that :meth:`advance` gave."""
        return self.cost_of(self._advanced)

    def advanced_area(self) -> float:
        """:meth:`area_of` the map that :meth:`advance` gave."""
        return self.area_of(self._advanced_map)

    def accept(self) -> None:
        """Take over the map that :meth:`advance` gave."""
        self.dual_map, self._advanced = self._advanced, self.dual_map
        self.map, self._advanced_map = self._advanced_map, self.map


def default_resolutions(vertex_count: int) -> tuple[int, ...]:
    """The paper's V-cycle without resolutions whose nodes outnumber the mesh's vertices; at least level 1."""
    highest = min(max(1, level_for(vertex_count) - 1), max(V_CYCLE))
    return (*range(1, highest), *range(highest, 0, -1))


def paper_flow(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    cost: str = Cost.GEODESIC,
    cycles: int = 100,
    resolutions: Sequence[int] | None = None,
    butterfly: bool = False,
    device: str = "auto",
    progress: Progress | None = None,
    tolerance: float = 1e-4,
    smallest_hamiltonian: float = 0.0,
    area_loss: float | None = None,
) -> FlowResult:
    """Algorithm 2: V-cycles of Algorithm 1 over the resolutions 1, 2, 3, 4, 5, 4, 3, 2, 1.

    Stops, as section 2.4 says, when the cost ceases to decrease (a whole cycle lowers it by less than ``tolerance`` of
    its value) or when the integral of H^2 is below ``smallest_hamiltonian``; and when areas would no longer be kept.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes; its areas are the masses.
        sphere: image of the vertices under a mass-preserving map, unit vectors, shape [V, 3].
        start: the conformal image of the vertices, unit vectors, shape [V, 3].
        cost: ``geodesic`` (Phi = theta, as in section 2.5) or ``squared`` (theta squared, whose optimum is unique).
        cycles: most V-cycles.
        resolutions: the sequence of highest wavelet levels of one cycle; :func:`default_resolutions` where not given.
        butterfly: use the butterfly wavelets instead of those of the hat functions.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        progress: called as ``progress("omt", step, most, {"cost": cost})`` after every step.
        tolerance: relative decrease of the cost over a cycle below which the flow has converged.
        smallest_hamiltonian: bound on the integral of H^2.
        area_loss: how much the mean area distortion (2 is perfect) may grow; 0.002 and 15 % of the initial map's own
            where not given, and ``inf`` for no bound.

    Returns:
        The map at the vertices, the history, and why it stopped.

    Raises:
        OmtwarpError: the mesh or a map cannot be used, or an unknown cost.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> start = omtwarp.conformal_map(surface, device="cpu").sphere
        >>> initial = omtwarp.moser_map(surface, start, device="cpu").sphere
        >>> flow = omtwarp.paper_flow(surface, initial, start=start, cycles=2, device="cpu")
        >>> flow.history[-1]["cost"] < flow.history[0]["cost"]
        True
    """
    surface = as_surface(surface)
    if resolutions is None:
        resolutions = default_resolutions(surface.vertex_count)
    flow = PaperFlow(
        as_sphere(start, surface, "start"),
        surface.faces,
        as_sphere(sphere, surface),
        surface.face_areas,
        cost=cost,
        highest_resolution=max(resolutions),
        butterfly=butterfly,
        device=device,
    )
    # The plain distance's gradient has length one, so its flow is faster than the squared one's by the displacement.
    scale = FIRST_STEP * (0.5 if flow.squared else max(flow.mean_displacement, 1e-12))
    steps = {r: scale * flow.wavelets.hierarchy.node_spacing(r + 1) ** 2 for r in set(resolutions)}
    least = {r: STALLED * step for r, step in steps.items()}
    current, area = flow.cost_of(flow.dual_map), flow.area_of(flow.map)
    largest_area = area + (0.002 + 0.15 * max(area - 2.0, 0.0) if area_loss is None else area_loss)
    begun = {"cycle": 0, "level": 0, "cost": current, "step": 0.0, "accepted": True, "area": area}
    history: list[dict[str, Any]] = [{"iteration": 0, **begun}]
    stopped = ""
    for cycle in range(1, cycles + 1):
        before, taken, tried = current, 0, 0
        for resolution in resolutions:
            if steps[resolution] < least[resolution]:
                continue
            flow.set_hamiltonian(resolution)
            if flow.hamiltonian_norm() <= smallest_hamiltonian:
                stopped = "hamiltonian"
                break
            step = min(steps[resolution], COURANT / max(flow.set_velocity(), TINY))
            accepted = flow.advance(step)
            reached = flow.advanced_cost()
            accepted = accepted and reached < current
            if accepted:
                advanced_area = flow.advanced_area()
                if advanced_area > largest_area:
                    stopped = "area"
                    break
                flow.accept()
                current, area = reached, advanced_area
            steps[resolution] = (GROWTH if accepted else 0.5) * step
            tried, taken = tried + 1, taken + accepted
            entry = {"cycle": cycle, "level": resolution, "cost": current, "step": step, "accepted": accepted}
            history.append({"iteration": len(history), **entry, "area": area})
            if progress is not None:
                progress("omt", len(history) - 1, cycles * len(resolutions), {"cost": current})
        # Refused steps are about to be retried smaller: a cycle of them says nothing about convergence.
        if not stopped and 2 * taken >= tried and before - current <= tolerance * abs(current):
            stopped = "cost"
        if stopped:
            break
    return FlowResult(np.array(flow.map.numpy()), history, stopped or "cycles")


__all__ = ["V_CYCLE", "FlowResult", "PaperFlow", "default_resolutions", "paper_flow"]
