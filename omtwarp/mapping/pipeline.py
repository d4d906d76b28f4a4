"""From a mesh to its map: the stages of section 4 in order, each measured and each returning a map without flips."""

from __future__ import annotations

import platform
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypedDict, Unpack, cast

import numpy as np
import scipy
from numpy.typing import ArrayLike

from omtwarp.conformal import density
from omtwarp.device.policy import resolve_device, solves_with_scipy, solving_with, wanted_solver
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.flips.exact import Examined, examine, is_bijective
from omtwarp.flips.guard import hold_back
from omtwarp.geometry.axes import principal_axes, rotation_onto_axes, towards_coordinates, turned_towards
from omtwarp.geometry.space_order import OrderedSurface, in_space_order
from omtwarp.mapping.verdict import accepted, judge
from omtwarp.maps.result import MapReport, MapResult, StageReport, origin_arrays
from omtwarp.measures import TargetDensity, mass_distortion, weighted_surface
from omtwarp.mesh.arrays import TINY, Bools, Floats, normalised
from omtwarp.mesh.quarter import PARTS, quarter
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_surface, as_unit_vectors, triangle_areas
from omtwarp.metrics.certificate import Certificate, certify_triangles
from omtwarp.metrics.distortion import measure_triangles
from omtwarp.metrics.optimality import Optimality, optimality, relative_curl
from omtwarp.open_surfaces.hemisphere import is_symmetric, mirror_frame, symmetric_map, symmetric_start, symmetrised
from omtwarp.open_surfaces.symmetric import MirroredSphere
from omtwarp.optimal import OptimalMap, nested, optimal_map
from omtwarp.optimal.density import map_to_density
from omtwarp.optimal.exact import exact_map, largest_error, smoothed
from omtwarp.optimal.refinement import refine_map, refinement_weight
from omtwarp.options import (
    AreaMatch,
    Cost,
    MapKeywords,
    MapOptions,
    Method,
    Progress,
    Record,
    Scheme,
    Stage,
    WeightsAt,
    WeightsAtLike,
    continued,
    takes_map_options,
    tell,
)
from omtwarp.solvers.mesh_factor import saddle_order
from omtwarp.start.choice import bijective_start
from omtwarp.texturing.density import TargetLike, as_target
from omtwarp.topology.closing import Double, quartered_double
from omtwarp.transport.cost import area_loss, transport_cost
from omtwarp.untangling.untangle import RepairBudget, untangle
from omtwarp.version import package_version

# What the measurement after the last stage is called in progress and in the records of stages.
OPTIMALITY = "optimality"
# What the map of the quartered mesh is called there.
EXACT = "exact"
# The road of a minimisation that begins at a map of the user's.
GIVEN = "given"
# A map above all of these, the last a mean squared distance in radians², is not said to be optimal, whatever the
# minimisation reached. Where points move less, gap and curl are the mesh's own error. Smaller ones warn of more maps.
FAR_GAP, FAR_CURL, FAR_COST = 0.01, 0.05, 0.02
NO_BOUND = 1.0  # a gap above this says nothing of a map: bound and gap are reported as none
# Weight of the shape term for the distance itself, relative to that for its square: mean distances are 0.2 % smaller
# with this than with 1, at 3 % more angle distortion.
DISTANCE_SHAPE = 0.3
# How many times as much area distortion weighs in halves: limbs that a boundary cuts off keep areas less well. With
# 1, 2, 4 and 8 the area distortion of a part of a caudate nucleus is 2.059, 2.031, 2.016 and 2.010, its angle 8.1, 8.8,
# 9.5 and 10.2; parts of eleven scans have less area distortion with 10 than with 1, and 3 % more angle distortion.
AREAS_OF_HALVES = 10.0
# Ascent steps of the bound: each takes as long as the bound itself. 0, 3, 6 and 8 leave a person's gap at 2.6, 0.18,
# 0.12 and 0.10 %.
GAP_ASCENT_STEPS = 8


@blas_threads(1)
@takes_map_options
def map_to_sphere(
    mesh: MeshLike,
    *,
    weights: ArrayLike | None = None,
    weights_at: WeightsAtLike = WeightsAt.AUTO,
    target: TargetLike | None = None,
    start: ArrayLike | MapResult | None = None,
    progress: Progress | None = None,
    **options: Unpack[MapKeywords],
) -> MapResult:
    """Map a closed genus-0 surface to the unit sphere.

    Args:
        mesh: a ``trimesh.Trimesh``, ``(vertices, faces)`` or a :class:`Surface`; any unit, any position.
        weights: positive, per vertex [V] or per triangle [F]: parts of twice the weight cover twice as much of the
            sphere for their area, see :func:`omtwarp.measures.weighted_surface`.
        weights_at: what the weights belong to, ``vertices`` or ``triangles``; ``auto`` goes by their number.
        target: the density that the image is to have on the sphere in place of the uniform one: a function of unit
            vectors [N, 3], an equirectangular picture, or ``(sphere, faces, values)``; see
            :func:`omtwarp.texturing.density.as_target`.
        start: points x of your own, unit vectors [V, 3], that transport moves in place of the conformal map's;
            triangles may be flipped there, and nothing is turned onto the mesh's axes. Or a map of this mesh, from
            whose points the minimisation begins; transport is then measured from that map's own points x.
        progress: called as ``progress(stage, done, total, details)``.
        options: those of :class:`omtwarp.options.MapOptions`.

    Returns:
        The map, in the order of the input's vertices; with ``exact`` of the mesh with its triangles cut into four, of
        which ``face_origin`` and ``vertex_origin`` say what came from where in the input.

    Raises:
        OmtwarpError: the mesh cannot be mapped, or an option is unknown; with ``strict`` also in place of a warning.

    Warns:
        OmtwarpWarning: areas are not kept as they should be, or the optimal map was not found: the measure, the worst
            place and what would help. The texts are in ``report["warnings"]`` too.

    Example:
        >>> import omtwarp
        >>> result = omtwarp.map_to_sphere(omtwarp.shapes.blob(seed=3, sphere=320), device="cpu")
        >>> result.sphere.shape == result.vertices.shape, result.report["certificate"]["bijective"]
        (True, True)
        >>> result.distortion().area["mean"] < 2.05
        True
    """
    chosen = MapOptions.parse(**options)
    wanted = as_target(target, device=chosen.device)
    if wanted is not None and (chosen.method not in (Method.OMT, Method.MOSER) or chosen.scheme is Scheme.PAPER):
        raise OmtwarpError("a target density needs the methods omt or moser, and the schemes default or plain")
    if wanted is not None and chosen.exact:
        raise OmtwarpError("exact areas are for the uniform sphere: leave the target density out")
    surface = weighted_surface(as_surface(mesh), weights, weights_at)
    if start is not None and chosen.method in (Method.TUTTE, Method.MEAN_VALUE):
        raise OmtwarpError("a barycentric map begins nowhere: leave start out, or take the method omt, moser or haker")
    ordered = in_space_order(surface)
    given, given_map = (None, None) if start is None else _begun(start, surface, ordered)
    result = MapComputation(ordered.surface, chosen, progress, wanted, given=given, given_map=given_map).result()
    for finding in result.report["warnings"]:
        warnings.warn(finding["text"], OmtwarpWarning, stacklevel=3)
    return _in_order_of(surface, ordered, result)


@blas_threads(1)
def map_closed(
    surface: Surface, own: int, options: MapOptions, *, mirror: Double | None = None, progress: Progress | None = None
) -> MapResult:
    """Map a surface that was closed for it to the sphere; whether the map is good is for the caller to judge.

    Args:
        surface: with holes filled, or the double of one.
        own: how many of its first faces belong to what is mapped.
        options: those of :func:`map_to_sphere`.
        mirror: the double: its optimal map is solved on one half and is symmetric to the bit, the surface on the
            northern hemisphere; it is nearly symmetric where the last stage is not the optimal map.
        progress: called as ``progress(stage, done, total, details)``.

    Raises:
        OmtwarpError: the mesh cannot be mapped.
    """
    of_surface = np.arange(surface.face_count) < own
    if mirror is not None:
        return MapComputation(surface, options, progress, mirror=mirror, own=of_surface).result()
    ordered = in_space_order(surface)
    result = MapComputation(ordered.surface, options, progress, own=of_surface[ordered.face_origin]).result()
    return _in_order_of(surface, ordered, result)


class FromSource(TypedDict):
    """Where points are moved from, on which device, and who is told of it."""

    start: Floats
    device: str
    progress: Progress | None


@dataclass(eq=False)
class MapComputation:
    """The computation of one map: the maps of the stages so far, and their records.

    A stage is a method of no arguments: it reads ``sphere``, the map of the previous stage, and ends with
    :meth:`finish`. :meth:`result` runs them in the order of :attr:`MapOptions.stages`.

    Attributes:
        surface: what is mapped.
        options: of the map.
        progress: called at the begin and end of every stage, and during long ones.
        target: the density on the sphere that is to be reached; None for the uniform one.
        mirror: what the surface is the double of, if it is one: the map is kept symmetric where it can be.
        given: points x to begin with, where the user has some; those of the conformal map otherwise.
        given_map: a map of them without flips, where one is known.
        device: name of the device that kernels run on.
        own: which faces are the surface's own, where others only close it, shape [F]: the caller judges the map of it.
        source: the points that transport starts from, once they are known.
        given_up: what the current stage could not do; for the report each is said once.
        repair_given_up: whether a repair was given up after the work that it may take.
        origin: of the first map: the route that led to it, and why that one.
        measured: how far the map by Newton's method is from optimal.
        known: the map asked for last by :meth:`examine`, and what that returned.
    """

    surface: Surface
    options: MapOptions
    progress: Progress | None
    target: TargetDensity | None = None
    mirror: Double | None = None
    given: Floats | None = None
    given_map: Floats | None = None
    own: Bools | None = None
    source: Floats = field(init=False)
    given_up: list[str] = field(default_factory=list)
    repair_given_up: bool = False
    measured: Optimality | None = None
    known: tuple[Floats, Examined] | None = None
    records: list[StageReport] = field(default_factory=list)
    maps: dict[str, Floats] = field(default_factory=dict)
    history: list[Record] = field(default_factory=list)
    origin: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.device = str(resolve_device(self.options.device))
        self.begun = self.stage_begun = time.perf_counter()

    @property
    def sphere(self) -> Floats:
        """The map of the latest stage."""
        return next(reversed(self.maps.values()))

    @property
    def direct(self) -> bool:
        """Whether the optimal map comes by Newton's method."""
        return self.options.scheme is Scheme.DEFAULT and Stage.OMT in self.options.stages

    @property
    def common(self) -> FromSource:
        """What the functions that move points x from the source have in common."""
        return {"start": self.source, "device": self.device, "progress": self.progress}

    def notify(self, stage: str, done: int, total: int, details: Record) -> None:
        tell(self.progress, str(stage), done, total, details)

    def examine(self, sphere: Floats) -> Examined:
        """Return what decides whether a map is one to one; of the one asked for last it is known already."""
        if self.known is None or self.known[0] is not sphere:
            self.known = sphere, examine(sphere, self.surface.on(self.device).faces, device=self.device)
        return self.known[1]

    def goal(self, sphere: Floats) -> Surface:
        """Return the surface with the areas that its triangles should cover at their present places on the sphere."""
        return self.surface if self.target is None else self.target.goal(self.surface, sphere)

    def finish(self, name: str, sphere: Floats, iterations: int, **details: str | float | None) -> None:
        """End a stage: keep its map, and record its time and the quality of the map."""
        seconds = time.perf_counter() - self.stage_begun
        self.maps[name] = sphere
        if self.given_up:
            details["gave_up"] = "; ".join(dict.fromkeys(self.given_up))
            self.given_up.clear()
        mesh = self.surface.on(self.device)
        measured = measure_triangles(mesh.vertices, mesh.faces, sphere, device=self.device).to_dict()
        cost = transport_cost(self.surface, sphere, start=self.source, device=self.device)
        record = {"name": str(name), "seconds": seconds, "iterations": iterations, **measured, "transport_cost": cost}
        self.records.append(cast(StageReport, record | details))
        facts = {"flips": measured["flips"], "area": measured["area"]["surface"], "angle": measured["angle"]["surface"]}
        # Cost is counted from the first map, which has none.
        self.notify(name, 1, 1, facts if len(self.records) == 1 else facts | {"cost": cost})
        self.stage_begun = time.perf_counter()

    def result(self) -> MapResult:
        """Run the chosen stages, and assemble the result."""
        with solving_with(self.options.solver, self.device):
            self.run_stages()
            return self.assembled()

    def run_stages(self) -> None:
        """Run the chosen stages, each from the map of the one before."""
        options = self.options
        if options.method in (Method.TUTTE, Method.MEAN_VALUE):
            self.barycentric()
        else:
            stages = {
                Stage.CONFORMAL: self.conformal,
                Stage.MOSER: self.moser,
                Stage.OMT: self.transport,
                Stage.REFINE: self.refine,
            }
            # The optimal map of the uniform sphere, by Newton's method, needs no Moser map.
            for stage in options.stages:
                if stage is not Stage.MOSER or not self.direct or self.target is not None:
                    stages[stage]()
            if options.exact:
                self.keep_every_area()

    def assembled(self) -> MapResult:
        """Measure and judge the map of the last stage, and put the result together."""
        surface, options = self.surface, self.options
        optimality = self.optimality() if options.optimality and len(self.maps) > 1 else None
        first = next(iter(self.maps.values()))
        face_density, vertex_density = density(surface, first)
        certificate = self.certificate()
        report = self.report() | {"certificate": certificate.to_dict()}
        if self.own is None:
            goal, even, parts = self.goal(self.sphere), self.target is None, PARTS if options.exact else 1
            findings = judge(goal, self.sphere, self.records, options, uniform=even, parts=parts)
            report["warnings"] = accepted(findings, options.strict)
        if optimality is not None:
            report["optimality"] = optimality
        return MapResult(
            vertices=surface.vertices,
            faces=surface.faces,
            sphere=self.sphere,
            conformal=first,
            density=vertex_density,
            face_density=face_density,
            source=self.source,
            moser=self.maps.get(Stage.MOSER),
            transported=self.maps.get(Stage.OMT),
            history=self.history,
            report=report,
            measure=surface.face_areas if surface.weighted else None,
            target=None if self.target is None else self.target.at(self.sphere),
        ).certified(certificate)

    def conformal(self) -> None:
        """Compute the conformal map, or the start that replaces it."""
        self.notify(Stage.CONFORMAL, 0, 1, {})
        published = self.options.method is not Method.OMT or self.options.scheme is not Scheme.DEFAULT
        start = bijective_start(
            self.surface, published=published, given=self.given, device=self.device, progress=self.progress
        )
        self.origin = {"route": start.route, "reason": start.reason}
        sphere, repaired = start.sphere, start.repaired_flips
        self.repair_given_up = start.repair_given_up
        # The cost depends only on where points lie under the conformal map; triangles may be flipped there.
        self.source = sphere if start.points is None else start.points
        if start.points is not None and start.route == "hierarchical":
            sphere = turned_towards(sphere, self.source, self.surface.vertex_areas)
        if self.given is None:
            sphere = self.orient(sphere)
        if self.mirror is not None:
            frame = mirror_frame(self.mirror, self.source, self.surface.vertex_areas)
            self.source = symmetrised(self.mirror, self.source @ frame)
            sphere = self.symmetric(sphere @ frame)
            if start.route == "hierarchical" and not is_symmetric(self.mirror, sphere):
                coarse = self.coarse_start(self.mirror)
                sphere = sphere if coarse is None else coarse
        self.finish(Stage.CONFORMAL, sphere, 1, **self.origin, repaired=repaired)

    def orient(self, sphere: Floats) -> Floats:
        """Turn the first map, and the points that transport starts from, by the surface's own axes."""
        axes = principal_axes(self.surface)
        if axes.note:
            self.origin["axes"] = axes.note
        rotation, determined = rotation_onto_axes(self.surface, self.source, towards_coordinates(axes.frame))
        if not determined:
            self.origin["axes"] = "the map agrees with no direction of the surface: its rotation means nothing"
        turned = normalised(sphere @ rotation.T)
        faces = self.surface.faces
        if not is_bijective(turned, faces) and is_bijective(sphere, faces):
            # Triangles of the size of rounding errors can flip when they are rotated.
            turned = untangle(self.surface, turned, device=self.device).sphere
            if not is_bijective(turned, faces):
                return sphere
        self.source = turned if self.source is sphere else normalised(self.source @ rotation.T)
        return turned

    def coarse_start(self, mirror: Double) -> Floats | None:
        """Return a symmetric map without flips that was made from coarse to fine; None where there is none."""
        return symmetric_start(mirror, self.surface, self.source, device=self.device, progress=self.progress)

    def symmetric(self, sphere: Floats, repair: bool = False) -> Floats:
        """Make the map of a double symmetric where that flips nothing; otherwise return it unchanged."""
        if self.mirror is None:
            return sphere
        mended = symmetric_map(self.mirror, self.surface, sphere, repair=repair, device=self.device)
        return sphere if mended is None else mended

    def moser(self) -> None:
        """Run Moser's flow from the start, again from its own result, and repair flips after each pass.

        Where the optimal map to a density follows, the flow begins near that of the uniform sphere: from the conformal
        map it flips more triangles than can be repaired where limbs are crowded together.
        """
        # One pass of Moser's flow leaves an area error of the order of the mesh; a second, from where the first ended,
        # about halves it; a third gains little.
        moser_passes = 2
        from omtwarp.moser import moser_map  # its kernels are read for maps with this stage alone

        sphere = next(self.nearby_maps())[0] if self.direct and self.target is not None else self.sphere
        least = area_loss(self.goal(sphere), sphere)
        steps = repaired = 0
        fewest = self.surface.face_count  # flips of a pass so far
        for k in range(moser_passes):

            def notify(stage: str, done: int, total: int, details: Record, before: int = k) -> None:
                self.notify(stage, before * total + done, moser_passes * total, {})

            flowed = moser_map(self.surface, sphere, target=self.target, device=self.device, progress=notify)
            steps += flowed.steps
            flipped = self.examine(flowed.sphere).flips
            if flipped > fewest:
                break  # repair would lose more than the flow gains
            fewest = flipped
            untangled, flips = self.untangle(sphere, flowed.sphere)
            repaired += flips
            error = area_loss(self.goal(untangled), untangled)
            if error >= least:
                break  # where the image is badly stretched, repairs can lose more than the flow gains
            sphere, least = self.symmetric(untangled), error
        self.finish(Stage.MOSER, sphere, steps, repaired=repaired)

    def transport(self) -> None:
        """Compute the optimal map by the chosen scheme."""
        scheme, cost = self.options.scheme, self.options.cost
        # The kernels of flows are read where they are used: they are a third of all that a map would import.
        if scheme is Scheme.PAPER:  # Algorithms 1 and 2 as the paper prints them
            from omtwarp.transport.paper import paper_flow

            flowed = paper_flow(self.surface, self.sphere, cost=cost, **self.common)
            self.history = flowed.history
            self.finish_transport(flowed.sphere, converged=flowed.converged)
        elif scheme is Scheme.PLAIN:
            from omtwarp.transport.flow import optimal_transport

            moved = optimal_transport(
                self.surface, self.sphere, cost=cost, scheme=scheme, target=self.target, **self.common
            )
            self.history = moved.history
            self.finish_transport(moved.sphere, converged=moved.converged, ended=moved.ended)
        else:
            if self.mirror is None and not solves_with_scipy():
                saddle_order(self.surface)  # takes room of its own, before the largest matrices do
            if self.target is None:
                self.minimise_transport()
            else:
                self.transport_to_density(self.target)

    def minimise_transport(self) -> None:
        """Compute the discrete optimal map: areas around vertices kept, and the cost at its minimum."""
        solve: Callable[..., OptimalMap]
        found: list[tuple[str, Callable[..., OptimalMap], OptimalMap, float]] = []
        for sphere, road in self.nearby_maps():
            term = nested.shape_term(self.surface, sphere, self.source, self.device)
            areas = term.area if self.mirror is None else AREAS_OF_HALVES * term.area
            solve = partial(self.minimisation(sphere), self.surface, area_weight=areas)
            optimal = solve(sphere, shape_weight=term.weight, iterations=nested.STEPS, foresee=self.last)
            found.append((road, solve, optimal, term.weight))
            if optimal.converged:
                break
            if road == nested.NESTED:
                self.given_up.append(f"the minimisation from the nested map: {optimal.ended}")
        road, solve, optimal, weight = min(found, key=lambda it: (not it[2].converged, it[2].history[-1]["ring_rms"]))
        self.history = continued(self.history, optimal.history)
        if self.options.cost is Cost.GEODESIC:
            weight *= DISTANCE_SHAPE
            optimal = solve(optimal.sphere, shape_weight=weight, cost=Cost.GEODESIC)
            self.history = continued(self.history, optimal.history)
        elif self.options.optimality:
            self.measured = self.bounded(optimal.sphere)
        self.finish_transport(optimal.sphere, road=road, shape_weight=weight, **self.termination(optimal))

    @property
    def last(self) -> bool:
        """Whether no minimisation begins from the optimal map, and none of its vertices are held by symmetry.

        Those beside vertices that are held have gains left after a foreseen end: parts of a person had 0.001 more area
        distortion.
        """
        chosen = self.options
        follows = chosen.exact or chosen.refine is not None or chosen.cost is Cost.GEODESIC
        return self.mirror is None and not follows

    def finish_transport(self, moved: Floats, **details: str | float | None) -> None:
        """End the stage of the optimal map with one whose flips are still to be repaired."""
        sphere, repaired = self.untangle(self.sphere, moved)
        self.finish(Stage.OMT, sphere, len(self.history) - 1, repaired=repaired, **details)

    def minimisation(self, sphere: Floats) -> Callable[..., OptimalMap]:
        """Return what finds the optimal map from a map near it: among symmetric maps where that one is symmetric."""
        return partial(optimal_map, domain=self.mirrored(sphere), **self.common)

    def mirrored(self, sphere: Floats) -> MirroredSphere | None:
        """Return the domain of the maps of a double that are as symmetric as a map is; None where that is not."""
        if self.mirror is None or not is_symmetric(self.mirror, sphere):
            return None
        return MirroredSphere(self.mirror, self.surface, resolve_device(self.device))

    def transport_to_density(self, target: TargetDensity) -> None:
        """Compute the optimal map to a density, from Moser's map to it."""
        solve = self.minimisation(self.sphere)
        sphere, at = self.sphere, partial(map_to_density, self.surface, start=self.source, device=self.device)
        for cost in dict.fromkeys((Cost.SQUARED, self.options.cost)):
            share = DISTANCE_SHAPE if cost is Cost.GEODESIC else 1.0
            optimal = at(sphere, target, partial(solve, cost=cost), shape_share=share)
            self.history, sphere = continued(self.history, optimal.history), optimal.sphere
        self.finish_transport(sphere, converged=optimal.converged, ended=optimal.ended)

    def nearby_maps(self) -> Iterator[tuple[Floats, str]]:
        """Yield the maps to begin a minimisation with, and which they are: ``given``, or ``nested``, then ``embedded``.

        Of 100 made surfaces of up to 6,000 faces, one ends at an area distortion of 2.93 from the nested map, and at
        2.02 from the embedded one; so do two of eight rotations of another.
        """
        if self.given_map is not None:
            yield self.given_map, GIVEN
            return
        embedding, known = self.sphere if self.origin["route"] == "hierarchical" else None, False
        if embedding is None:
            try:
                mirror = None if self.mirror is None else self.mirror.mirror
                sphere = nested.nested_start(self.surface, self.source, mirror=mirror, device=self.device)
                sphere = self.symmetric(sphere, repair=True)
                known = self.mirror is None or is_symmetric(self.mirror, sphere)
                if not known:
                    self.given_up.append("the nested map could not be made symmetric")
            except OmtwarpError as error:
                self.given_up.append(str(error))
            if known:
                yield sphere, nested.NESTED
        if self.mirror is not None and (embedding is None or not is_symmetric(self.mirror, embedding)):
            embedding = self.coarse_start(self.mirror)
        try:
            sphere = nested.embedded_start(
                self.surface, self.source, embedding, double=self.mirror is not None, device=self.device
            )
        except OmtwarpError:
            if known:
                return  # with the nested map
            raise
        sphere = self.symmetric(sphere, repair=True)
        if self.mirror is not None and embedding is not None and not is_symmetric(self.mirror, sphere):
            sphere = embedding
        yield sphere, nested.EMBEDDED

    def termination(self, optimal: OptimalMap) -> dict[str, str | float | None]:
        """Record whether a minimisation reached an optimal map, and how it ended; ``measured`` is of its map."""
        found = self.measured
        if optimal.converged and found is not None and found.cost > FAR_COST * SPHERE_AREA:
            if found.gap > FAR_GAP and found.relative_curl > FAR_CURL:
                above = f"{100 * found.gap:.3g} % above the bound"
                where = above if found.gap <= NO_BOUND else "without a bound on its cost"
                return {"converged": False, "ended": f"a minimum with the shape term, {where}"}
        return {"converged": optimal.converged, "ended": optimal.ended}

    def bounded(self, sphere: Floats, improve: bool = True) -> Optimality:
        """Measure how far a map is from optimal, and improve the bound of an optimal one where the gap is too large."""
        enough, steps = 9.9e-4, GAP_ASCENT_STEPS if improve else 0  # a gap up to which the bound is not improved
        return optimality(self.surface, sphere, enough=enough, ascent_steps=steps, **self.common)

    def keep_every_area(self) -> None:
        """Compute the optimal map of the quartered mesh, in which every triangle of the mesh keeps its area."""
        quartered = quarter(self.surface)
        self.surface = quartered.surface
        self.own = None if self.own is None else np.repeat(self.own, PARTS)
        if self.mirror is not None:
            self.mirror = quartered_double(self.mirror, quartered)
        self.source = quartered.on_sphere(self.source)
        # Cutting along great circles keeps a map one to one, except for rounding.
        self.maps = {name: quartered.on_sphere(sphere) for name, sphere in self.maps.items()}
        before, crowded = self.untangle(self.sphere, self.sphere)
        smooth = self.symmetric(smoothed(self.surface, before, device=self.device), repair=True)
        # A mesh whose triangles are cut in four bears more of the shape term: more trades optimality for smoothness.
        weight = 2.0 * nested.shape_term(self.surface, before, self.source, self.device).weight
        exact = exact_map(
            quartered,
            smooth,
            start=self.source,
            shape_weight=weight,
            cost=self.options.cost,
            domain=self.mirrored(smooth),
            device=self.device,
            progress=lambda _stage, done, total, details: self.notify(EXACT, done, total, details),
        )
        self.history = continued(self.history, exact.history)
        if self.options.optimality and self.options.cost is Cost.SQUARED:
            self.measured = self.bounded(exact.sphere)
        sphere, repaired = self.untangle(before, exact.sphere)
        record = {"shape_weight": weight, "repaired": crowded + repaired, "largest_area_error": largest_error(exact)}
        self.finish(EXACT, sphere, len(exact.history) - 1, **record, **self.termination(exact))

    def refine(self) -> None:
        """Minimise distortion from the map, at the chosen weight of area against angle."""
        weight = self.options.refine
        assert weight is not None

        sphere = self.sphere if isinstance(weight, AreaMatch) else self.least_distorted(refinement_weight(weight))
        repaired = 0
        # With a target density the area that a triangle is to have depends on where it is: refinement is repeated with
        # the areas of where the last round left the triangles. One, two and three rounds leave a mean mass distortion
        # of 2.025, 2.008 and 2.002 on a picture with edges of contrast 5, and 2.0033, 2.0007 and 2.0004 on a smooth one
        # of contrast 20.
        for _ in range(1 if self.target is None else 3):
            refined = refine_map(
                self.goal(sphere), sphere, weight=weight, own=self.own, device=self.device, progress=self.progress
            )
            sphere, flips = self.untangle(sphere, refined.sphere)
            repaired += flips
        sphere = self.symmetric(sphere, repair=True)
        record = {"weight": self.options.to_dict()["refine"], "converged": refined.converged, "repaired": repaired}
        self.finish(Stage.REFINE, sphere, len(refined.history), **record)

    def least_distorted(self, weight: float) -> Floats:
        """Return the map made so far with the least angle + weight * area distortion, which is what refinement lowers.

        With a small weight that may be the first map: from the last one refinement would have to return to it along
        Möbius transformations, which hardly change its energy.
        """
        if self.target is not None:
            return self.sphere
        best = min(self.records, key=lambda record: record["angle"]["surface"] + weight * record["area"]["surface"])
        return self.maps[best["name"]]

    def optimality(self) -> dict[str, float | int | None]:
        """Measure how far the final map is from optimal, and what refinement added to the transport cost.

        The time that this takes is recorded as a stage.
        """
        self.notify(OPTIMALITY, 0, 1, {})
        last, steps = self.records[-1], 1
        figures: dict[str, float | int | None]
        if self.options.cost is Cost.GEODESIC:  # there is no lower bound
            cost_of = partial(transport_cost, self.surface, start=self.source, cost=Cost.GEODESIC, device=self.device)
            costs = {name: cost_of(sphere) for name, sphere in self.maps.items()}
            curl = relative_curl(self.surface, self.sphere, start=self.source, cost=Cost.GEODESIC, device=self.device)
            figures = {"relative_curl": curl, "cost": costs[last["name"]]}
        else:
            costs = {record["name"]: record["transport_cost"] for record in self.records}
            measured = self.measured
            if measured is None or last["name"] not in (Stage.OMT, EXACT):
                measured = self.bounded(self.sphere, improve=self.sphere is self.maps.get(Stage.OMT))
            figures, steps = measured.to_dict(), measured.ascent_steps
            if measured.gap > NO_BOUND:
                figures |= dict.fromkeys(("lower_bound", "gap"))
        if Stage.OMT in costs and self.sphere is not self.maps[Stage.OMT]:
            figures["added_by_refinement"] = costs[last["name"]] / max(costs[Stage.OMT], TINY) - 1.0
        own = {"name": OPTIMALITY, "seconds": time.perf_counter() - self.stage_begun, "iterations": steps}
        of_map = {name: last.get(name) for name in ("flips", "degree", "finite", "area", "angle", "transport_cost")}
        self.records.append(cast(StageReport, own | of_map))
        found = {name: value for name in ("cost", "gap") if (value := figures.get(name)) is not None}
        self.notify(OPTIMALITY, 1, 1, {"flips": last["flips"]} | found)
        return figures

    def barycentric(self) -> None:
        """Compute the whole map by one of the spherical barycentric systems that the paper compares with."""
        from omtwarp.baselines import Weights, barycentric_map  # its kernels are read for these maps alone

        method = self.options.method
        weights: Weights = "tutte" if method is Method.TUTTE else "mean-value"
        solved = barycentric_map(self.surface, weights=weights, device=self.device)
        self.origin, self.source = {"route": str(method)}, solved.sphere
        self.finish(method, self.orient(solved.sphere), solved.iterations, converged=solved.converged)

    def untangle(self, before: Floats, after: Floats) -> tuple[Floats, int]:
        """Make a stage's map one to one by repair, or by holding it back towards the map before it.

        Repair may end with all triangles positive and the sphere covered twice: such maps are rejected too.

        Returns:
            A bijection, and how many flips the stage's map had.
        """
        if self.examine(after).bijective:
            return after, 0
        flips = self.examine(after).flips
        # Where one repair of a map took all that it may take and failed, later ones mostly fail too, and may take a
        # tenth of it. Repairs of scans stay far below that.
        budget = RepairBudget(self.surface, 0.1 if self.repair_given_up else 1.0)
        repaired = untangle(self.goal(before), after, budget=budget, device=self.device)
        if repaired.bijective:
            return repaired.sphere, flips
        self.repair_given_up |= budget.exhausted
        why = "what repair may take was spent" if budget.exhausted else "repair failed"
        self.given_up.append(f"{flips} flipped triangles were held back towards the map before: {why}")
        return hold_back(self.surface, before, after, device=self.device), flips

    def report(self) -> MapReport:
        """Return the report of the map, ready for JSON."""
        surface = self.surface
        return {
            "mesh": {
                "vertices": surface.vertex_count,
                "faces": surface.face_count,
                "extent": np.ptp(surface.vertices, axis=0).tolist(),
            },
            "versions": versions(),
            "device": self.device,
            "solver": str(wanted_solver()),
            **self.options.to_dict(),
            "start": self.origin,
            "seconds": time.perf_counter() - self.begun,
            "mass": mass_distortion(self.goal(self.sphere), self.sphere, self.own) | {"weighted": surface.weighted},
            "stages": self.records,
        }

    def certificate(self) -> Certificate:
        """Certify the map that is returned.

        Raises:
            OmtwarpError: the map is not one to one.
        """
        examined = self.examine(self.sphere)
        certificate = certify_triangles(self.surface.faces, self.sphere, examined=examined, device=self.device)
        if not certificate.bijective:
            remedy = "repair or remesh the surface and try again"
            raise OmtwarpError(f"no map that is one to one was found: {certificate}; {remedy}")
        return certificate


def _begun(start: ArrayLike | MapResult, surface: Surface, ordered: OrderedSurface) -> tuple[Floats, Floats | None]:
    """Return a user's points x, and a map to begin with where one was given, in the order that the surface is solved.

    Raises:
        OmtwarpError: there is not one point on the sphere per vertex, or the map has flipped triangles.
    """
    if not isinstance(start, MapResult):
        points = as_unit_vectors(start, surface.vertex_count, "start")
        if not triangle_areas(points, surface.faces).any():
            raise OmtwarpError("corners of every triangle coincide in start: give points that cover the sphere")
        return points[ordered.vertex_origin], None
    if not np.array_equal(start.faces, surface.faces):
        raise OmtwarpError("start is a map of another mesh: its faces are not those of this one")
    if not start.bijective:
        raise OmtwarpError(f"start is not one to one: {start.certificate}")
    points = start.conformal if start.source is None else start.source
    return points[ordered.vertex_origin], start.sphere[ordered.vertex_origin]


def _in_order_of(surface: Surface, ordered: OrderedSurface, result: MapResult) -> MapResult:
    """Return the map of a surface, quartered or with edges split, from that of the surface in another order."""
    vertices, faces, made = ordered.vertex_origin, ordered.face_origin, surface
    if result.report.get("exact"):
        quartered = quarter(surface)
        vertices, faces, made = *ordered.of_parts(quartered), quartered.surface
    arrays: dict[str, object] = {"vertices": made.vertices, "faces": made.faces, **origin_arrays(made.origins)}
    if made.origins is not None and made.origins.given is not None:
        result.report["mesh"]["input_vertices"] = made.origins.given
    assert isinstance(result.certificate, Certificate)
    certificate = replace(result.certificate, smallest_face=int(faces[result.certificate.smallest_face]))
    rows = result.rows({"V": np.argsort(vertices), "F": np.argsort(faces)})
    result = result.with_arrays(rows | arrays).certified(certificate)
    result.report["certificate"] = certificate.to_dict()
    return result


def versions() -> dict[str, str]:
    """Return the versions of the packages that a result depends on."""
    return {
        "omtwarp": package_version(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "warp": wp.config.version,
    }
