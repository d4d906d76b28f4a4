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
  is left out of the V-cycle unless ``resolutions`` contains it.
* Step sizes. "Smaller time steps at higher resolutions" is all the paper gives. Each level starts with a step
  proportional to the square of its node spacing, which then adapts: a step that does not lower the cost is
  taken back and halved, one that does lets the next grow. A Courant condition bounds it; the one triangle in a thousand
  that moves fastest is slowed down instead of all the others.
* Flips. Where a step would turn a triangle over, its vertices and their surroundings do not move in that step.
  Triangles that the conformal map has flipped do not move g.
* Mass. Each step keeps areas only up to the discretisation, so that many steps lose area, and a cost that falls because
  mass is lost is no improvement. The flow ends, one step earlier, when the mean area distortion has grown by more than
  ``area_loss``; the paper's own tables show such a loss (2.004 to 2.007 on Max Planck, 2.51 to 2.61 on Gargoyle).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import empty, sent
from omtwarp.device.start import KERNEL_OPTIONS, ONE, TWO, ZERO, wp
from omtwarp.errors import OmtwarpError, choose
from omtwarp.flips.exact import flipped_faces
from omtwarp.geometry import DifferentialOperators, circumcentric_coordinates
from omtwarp.geometry.spherical import TINY, geodesic_distance, hat_gradient
from omtwarp.mesh.arrays import Floats, cross, marked, normalised, norms, real_number, whole_number, whole_numbers
from omtwarp.mesh.patches import touching
from omtwarp.mesh.surface import MeshLike, Surface, as_sphere, as_surface, triangle_areas
from omtwarp.options import Cost, CostLike, Progress, Record, tell
from omtwarp.wavelets import SphereSampler, SphericalWavelets, level_for, sphere_hierarchy

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def rotated_cost_gradients(
    dual_points: wp.array[wp.vec3d],
    dual_map: wp.array[wp.vec3d],
    squared: wp.int32,
    smallest: wp.float64,
    # Data out:
    field: wp.array[wp.vec3d],
):
    """Compute J Phi_x(x, g) in the tangent plane at x: that of section 2.5, times 2 theta for Phi = theta squared.

    ``smallest`` bounds the denominator |x × g| from below, smoothly: Phi = theta has no gradient where g = x.
    """
    f = wp.tid()
    x, g = dual_points[f], dual_map[f]
    turned = wp.cross(x, g)
    sine = wp.length(turned)
    if squared != 0:
        # theta / sin(theta) is 1 at coincident points and unbounded at antipodal ones, where no direction is shortest.
        ratio = ONE
        if sine > smallest or wp.dot(x, g) < ZERO:
            ratio = geodesic_distance(x, g) / wp.max(sine, smallest)
        field[f] = -TWO * ratio * turned
    else:
        field[f] = -turned / wp.max(wp.sqrt(sine * sine + smallest * smallest), TINY)


@wp.kernel
def correct_and_normalise(
    correction: wp.array[wp.vec3d],
    # Data in and out:
    field: wp.array[wp.vec3d],
):
    i = wp.tid()
    field[i] = wp.normalize(field[i] + correction[i])


@wp.kernel
def dual_velocity(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    sphere_areas: wp.array[wp.float64],
    masses: wp.array[wp.float64],
    hamiltonian: wp.array[wp.float64],
    # Data out:
    velocity: wp.array[wp.vec3d],
    rate: wp.array[wp.float64],
):
    """Compute v = -(1 / mu) x × grad H at dual vertices (line 16), and the triangle sizes it crosses per unit of time.

    At its circumcentre an inscribed triangle's unit normal is the point x itself.
    """
    f = wp.tid()
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = vertices[i], vertices[j], vertices[k]
    slope = (hamiltonian[j] - hamiltonian[i]) * hat_gradient(b, c, a)
    slope += (hamiltonian[k] - hamiltonian[i]) * hat_gradient(c, a, b)
    normal = wp.normalize(wp.cross(b - a, c - a))
    v = -(sphere_areas[f] / masses[f]) * wp.cross(normal, slope)
    if wp.dot(normal, a) <= ZERO:
        v = wp.vec3d(ZERO, ZERO, ZERO)  # a flipped triangle of the conformal image has no density to move
    velocity[f] = v
    rate[f] = wp.length(v) / wp.max(wp.sqrt(sphere_areas[f]), TINY)


@wp.kernel
def advance_map(
    vertices: wp.array[wp.vec3d],
    faces: wp.array2d[wp.int32],
    velocity: wp.array[wp.vec3d],
    rate: wp.array[wp.float64],
    largest_rate: wp.float64,
    held: wp.array[wp.bool],
    step: wp.float64,
    map_at_vertices: wp.array[wp.vec3d],
    dual_map: wp.array[wp.vec3d],
    # Data out:
    advanced: wp.array[wp.vec3d],
):
    """Compute g - dt grad g · v (line 17), the Jacobian from the map at the vertices by the gradient of appendix A."""
    f = wp.tid()
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = vertices[i], vertices[j], vertices[k]
    # A bound on the few triangles far beyond the Courant condition, so that they do not hold back all the others.
    v = velocity[f] * wp.min(ONE, largest_rate / wp.max(rate[f], TINY))
    if held[f]:
        v = wp.vec3d(ZERO, ZERO, ZERO)
    g = map_at_vertices[i]
    change = wp.dot(hat_gradient(b, c, a), v) * (map_at_vertices[j] - g)
    change += wp.dot(hat_gradient(c, a, b), v) * (map_at_vertices[k] - g)
    advanced[f] = wp.normalize(dual_map[f] - step * change)


V_CYCLE = (1, 2, 3, 4, 5, 4, 3, 2, 1)  # levels of wavelets in turn, as the paper's Algorithm 2 goes through them
COURANT = 0.1  # of the size of the triangle that a point crosses: the longest way it goes in a step
# How much the mean area distortion may grow where no bound is given: a constant, and a share of what it is above 2. The
# paper's tables show a growth of 0.003 on Max Planck, from 2.004, and of 0.10 on Gargoyle, from 2.51.
AREA_LOSS, RELATIVE_AREA_LOSS = 0.002, 0.15


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

    sphere: Floats
    history: list[Record] = field(default_factory=list)
    stopped: str = "cycles"

    @property
    def converged(self) -> bool:
        """Whether the flow ended before all its cycles were used."""
        return self.stopped != "cycles"


class PaperFlow:
    """The state of Algorithm 1 on a device: operators built once, and one step at a chosen resolution.

    Args:
        surface: what is mapped; its areas are the masses.
        start: conformal image of the vertices, unit vectors, shape [V, 3].
        sphere: image of the vertices under a mass-preserving map g^0, unit vectors, shape [V, 3].
        wavelets: of a hierarchy one level above the highest resolution that will be used, on the device.
        cost: ``geodesic`` (theta) or ``squared`` (theta squared).

    Attributes:
        dual_map: g at the dual vertices, Warp vec3d [F].
        map: g at the mesh vertices, Warp vec3d [V].
        advanced, advanced_map: the same of the map that :meth:`advance` made last.
        hamiltonian: H at the wavelets' nodes, Warp float64 [N].
        mean_displacement: mean of |x × g| over the surface.
    """

    def __init__(self, surface: Surface, start: Floats, sphere: Floats, wavelets: SphericalWavelets, cost: CostLike):
        masses = surface.face_areas * (4 * np.pi / surface.face_areas.sum())
        # Smallest mass, of the mean: velocities are divided by masses, and a triangle without area carries nothing
        masses = np.maximum(masses, 1e-12 * masses.mean())
        self.faces, self.masses = surface.faces, masses
        self.squared = int(choose(Cost, cost) is Cost.SQUARED)
        self.device, self.wavelets = wavelets.device, wavelets
        self.operators = DifferentialOperators(start, surface.faces, device=str(self.device))
        self._mesh = [self.operators.vertices, self.operators.faces]
        self.sampler = SphereSampler(wavelets.hierarchy, start, device=str(self.device))
        areas = triangle_areas(start, surface.faces)
        self.sampler.set_masses(surface.sum_to_vertices(areas) / 3)

        self._areas, self._masses = (sent(sizes, wp.float64, self.device) for sizes in (areas, masses))
        self._field, self._velocity = (empty(surface.face_count, wp.vec3d, self.device) for _ in range(2))
        self._rate = empty(surface.face_count, wp.float64, self.device)

        # Barycentric coordinates of the dual vertices, clamped to their triangles
        inside = np.maximum(circumcentric_coordinates(start, surface.faces), 0.0)
        total = inside.sum(axis=1)
        inside[~np.isfinite(total) | (total <= 0)] = 1 / 3
        weights = (inside / inside.sum(axis=1)[:, None])[..., None]
        self._points, self.dual_map = (
            sent(normalised((weights * places[surface.faces]).sum(axis=1)), wp.vec3d, self.device)
            for places in (start, sphere)
        )
        interpolated = self.operators.interpolate_dual(self.dual_map).numpy()
        self._correction = sent(sphere - interpolated, wp.vec3d, self.device)
        self.map = self._at_vertices(self.dual_map)

        sine = norms(cross(self._points.numpy(), self.dual_map.numpy()))
        self.mean_displacement = float((masses * sine).sum() / (4 * np.pi))
        # Smallest displacement, of the mean displacement: the geodesic cost has no gradient at zero
        relative = 0.0 if self.squared else 0.1 * self.mean_displacement
        # Resolved displacement, radians: the sine of a smaller angle is lost in the round-off of a cross product
        self._smallest = max(relative, 1e-8)

    def _launch(self, kernel: wp.Kernel, size: int, inputs: list[object], outputs: list[object]) -> None:
        wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device=self.device)

    def cost_of(self, dual_map: wp.array) -> float:
        """Return M(g), equation (6): the sum over triangles of surface area times Phi at the dual vertex."""
        x, g = self._points.numpy(), dual_map.numpy()
        distance = np.arctan2(norms(cross(x, g)), (x * g).sum(axis=1))
        return float((self.masses * (distance * distance if self.squared else distance)).sum())

    def area_of(self, image: wp.array) -> float:
        """Return the mean of r + 1/r over the image of the mesh, r = image area / surface area of a triangle."""
        areas = triangle_areas(image.numpy(), self.faces)
        return float((areas * areas / self.masses + self.masses).sum() / areas.sum())

    def _at_vertices(self, dual_map: wp.array) -> wp.array:
        """Return g at the mesh vertices from the dual ones (Algorithm 1, lines 7 and 8)."""
        values = self.operators.interpolate_dual(dual_map)
        self._launch(correct_and_normalise, len(values), [self._correction], [values])
        return values

    def set_hamiltonian(self, resolution: int) -> None:
        """Compute H at the wavelets' nodes from g, without levels j > ``resolution`` (Algorithm 1, lines 2 to 14)."""
        inputs = [self._points, self.dual_map, self.squared, self._smallest]
        self._launch(rotated_cost_gradients, len(self.dual_map), inputs, [self._field])
        self._flux = self.operators.divergence(self._field)
        self.hamiltonian = self.sampler.restrict(self._flux)
        self.wavelets.analyse(self.hamiltonian)
        self.wavelets.truncate(self.hamiltonian, resolution)
        self.wavelets.synthesise(self.hamiltonian)

    def hamiltonian_norm(self) -> float:
        """Return the integral of H^2 over the sphere (section 2.4's second stopping rule)."""
        values = self.hamiltonian.numpy()
        return float(self.wavelets.hierarchy.node_areas @ (values * values))

    def set_velocity(self) -> float:
        """Compute v at the dual vertices (Algorithm 1, line 16), and return the largest rate |v| / (triangle size)."""
        inputs = [*self._mesh, self._areas, self._masses, self.sampler.interpolate(self.hamiltonian)]
        self._launch(dual_velocity, len(self.dual_map), inputs, [self._velocity, self._rate])
        # Within courant: share of the points that COURANT is kept for; the others are held back
        return float(np.quantile(self._rate.numpy(), 0.999))

    def advance(self, step: float) -> bool:
        """Compute the map after a step dt (Algorithm 1, line 17), without accepting it; return False where it flips.

        Where the step turns triangles over, it is repeated first with their vertices and surroundings held.
        """
        held: NDArray[np.bool_] = np.zeros(len(self.faces), dtype=bool)
        upright = ~flipped_faces(self.map, self.faces, device=self.device)
        self.advanced = wp.empty_like(self.dual_map)
        # Holding rounds, in which points around flipped triangles are held back before a step is refused
        for _ in range(8):
            stay = sent(held, wp.bool, self.device)
            inputs = [*self._mesh, self._velocity, self._rate, COURANT / step, stay, step, self.map, self.dual_map]
            self._launch(advance_map, len(held), inputs, [self.advanced])
            self.advanced_map = self._at_vertices(self.advanced)
            flipped = upright & flipped_faces(self.advanced_map, self.faces, device=self.device)
            if not flipped.any():
                return True
            held |= touching(self.faces, marked(len(self.map), self.faces[flipped]))
        return False


def default_resolutions(vertex_count: int) -> tuple[int, ...]:
    """Return the paper's V-cycle without resolutions whose nodes outnumber the mesh's vertices; at least level 1."""
    highest = min(max(1, level_for(vertex_count) - 1), max(V_CYCLE))
    return (*range(1, highest), *range(highest, 0, -1))


def paper_flow(
    surface: MeshLike,
    sphere: ArrayLike,
    *,
    start: ArrayLike,
    cost: CostLike = Cost.GEODESIC,
    cycles: int = 100,
    resolutions: Sequence[int] | None = None,
    butterfly: bool = False,
    device: str = "auto",
    progress: Progress | None = None,
    tolerance: float = 1e-4,
    smallest_hamiltonian: float = 0.0,
    area_loss: float | None = None,
) -> FlowResult:
    """Run Algorithm 2: V-cycles of Algorithm 1 over the resolutions 1, 2, 3, 4, 5, 4, 3, 2, 1.

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
    # Highest resolution: its wavelets are on a hierarchy of 655,362 nodes and the next level
    levels = whole_numbers(resolutions, "resolutions", (None,), below=8 + 1).tolist()
    if not levels:
        raise OmtwarpError("resolutions: give at least one")
    cycles = whole_number(cycles, "cycles")
    tolerance = real_number(tolerance, "tolerance")
    smallest_hamiltonian = real_number(smallest_hamiltonian, "smallest_hamiltonian")
    if area_loss is not None and area_loss != np.inf:  # infinite: no bound
        area_loss = real_number(area_loss, "area_loss")
    x, g = as_sphere(start, surface, "start"), as_sphere(sphere, surface)
    wavelets = SphericalWavelets(sphere_hierarchy(max(levels) + 1), butterfly=butterfly, device=device)
    flow = PaperFlow(surface, x, g, wavelets, cost)
    descent = _Descent(flow, levels, area_loss)
    stopped = descent.run(cycles, smallest_hamiltonian, tolerance, progress)
    return FlowResult(np.array(flow.map.numpy()), descent.history, stopped)


class _Descent:
    """The cycles of Algorithm 2: steps of a flow at a sequence of resolutions, each with its own step length.

    Args:
        flow: Algorithm 1 on a map, which the steps move.
        resolutions: of one cycle, in their order.
        area_loss: how much the mean area distortion may grow, see :func:`paper_flow`.
    """

    def __init__(self, flow: PaperFlow, resolutions: Sequence[int], area_loss: float | None) -> None:
        self._flow, self._resolutions = flow, resolutions
        # The gradient of the distance has length one, so that its flow is faster than that of the squared distance, by
        # a factor of the displacement.
        # First step: times the squared spacing of the level's nodes
        # Least displacement, radians: of a map that is its own start, which is divided by
        scale = 0.1 * (0.5 if flow.squared else max(flow.mean_displacement, 1e-12))
        self._steps = {r: scale * flow.wavelets.hierarchy.node_spacing(r + 1) ** 2 for r in set(resolutions)}
        # Stalled, of the first step: a level whose step has become shorter is left out
        self._least = {r: 1e-6 * step for r, step in self._steps.items()}
        self._cost, self._area = flow.cost_of(flow.dual_map), flow.area_of(flow.map)
        default = AREA_LOSS + RELATIVE_AREA_LOSS * max(self._area - 2.0, 0.0)
        self._largest_area = self._area + (default if area_loss is None else area_loss)
        self.history: list[Record] = []
        self._record(0, 0, 0.0, True)

    def run(self, cycles: int, smallest_hamiltonian: float, tolerance: float, progress: Progress | None) -> str:
        """Take a step at every resolution, cycle by cycle, and return why the flow ends, see :class:`FlowResult`."""
        growth = 1.5  # of the step after one that was accepted; it is halved after one that was not
        most = cycles * len(self._resolutions)
        for number in range(1, cycles + 1):
            before, taken, tried = self._cost, 0, 0
            for resolution in self._resolutions:
                if self._steps[resolution] < self._least[resolution]:
                    continue
                self._flow.set_hamiltonian(resolution)
                if self._flow.hamiltonian_norm() <= smallest_hamiltonian:
                    return "hamiltonian"
                step = min(self._steps[resolution], COURANT / max(self._flow.set_velocity(), float(TINY)))
                accepted = self._flow.advance(step)
                reached = self._flow.cost_of(self._flow.advanced)
                accepted = accepted and reached < self._cost
                if accepted:
                    area = self._flow.area_of(self._flow.advanced_map)
                    if area > self._largest_area:
                        return "area"
                    self._flow.dual_map, self._flow.map = self._flow.advanced, self._flow.advanced_map
                    self._cost, self._area = reached, area
                self._steps[resolution] = (growth if accepted else 0.5) * step
                tried, taken = tried + 1, taken + accepted
                self._record(number, resolution, step, accepted)
                tell(progress, "omt", len(self.history) - 1, most, {"cost": self._cost})
            # Refused steps are about to be retried smaller: a cycle of them says nothing about convergence.
            if 2 * taken >= tried and before - self._cost <= tolerance * abs(self._cost):
                return "cost"
        return "cycles"

    def _record(self, cycle: int, level: int, step: float, accepted: bool) -> None:
        entry: Record = {"iteration": len(self.history), "cycle": cycle, "level": level, "cost": self._cost}
        self.history.append(entry | {"step": step, "accepted": accepted, "area": self._area})
