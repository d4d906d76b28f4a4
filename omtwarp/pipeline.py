"""From a mesh to its map: the stages of section 4 in order, each measured and each returning a map without flips."""

from __future__ import annotations

import platform
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from omtwarp.conformal import density
from omtwarp.device.arrays import vectors
from omtwarp.device.memory import give_back
from omtwarp.device.policy import resolve_device, solves_with_scipy, solving_with, wanted_solver
from omtwarp.device.start import wp
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.flips.guard import hold_back
from omtwarp.flips.rings import Examined, examine, is_bijective
from omtwarp.geometry.axes import principal_axes, rotation_onto_axes, turned_about_pole, turned_towards
from omtwarp.geometry.space_order import OrderedSurface, in_space_order
from omtwarp.measures import TargetDensity, weighted_surface
from omtwarp.measures.target import mass_distortion
from omtwarp.mesh.arrays import TINY
from omtwarp.mesh.checks import MeshLike, as_surface
from omtwarp.mesh.names import InputNames
from omtwarp.mesh.quarter import quarter
from omtwarp.mesh.surface import SPHERE_AREA, Surface, triangle_areas
from omtwarp.metrics.certificate import Certificate, certify_triangles
from omtwarp.metrics.distortion import measure
from omtwarp.metrics.optimality import Curl, Optimality, map_curl, optimality, relative_curl
from omtwarp.moser import moser_map
from omtwarp.open_surfaces.hemisphere import is_symmetric, mirror_frame, symmetric_map, symmetric_start, symmetrised
from omtwarp.open_surfaces.symmetric import symmetric_exact_map, symmetric_optimal_map
from omtwarp.optimal import GAIN, SHAPE_WEIGHT, OptimalMap, optimal_map
from omtwarp.optimal.cells import LIGHT_PENALTIES, exact_map
from omtwarp.optimal.energy import AREA_WEIGHT
from omtwarp.optimal.refinement import refine_map, refinement_weight
from omtwarp.options import AreaMatch, Cost, MapOptions, Method, Progress, Record, Scheme, Stage, WeightsAt, continued
from omtwarp.refine.solver import Refiner
from omtwarp.result import MapReport, MapResult, StageRecord, renumbered
from omtwarp.solvers.mesh_factor import begin_saddle_order
from omtwarp.start.choice import bijective_start, mostly_shrunken, shrunken_triangles
from omtwarp.texturing.density import TargetLike, as_target
from omtwarp.topology.doubling import Double, quartered_double
from omtwarp.topology.long_edges import SplitClosed, SplitDouble, split_long_edges, split_long_edges_of_double
from omtwarp.transport.area import AreaMonitor
from omtwarp.transport.cost import transport_cost
from omtwarp.untangling.untangle import RepairBudget, untangle
from omtwarp.verdict import judge, refusal
from omtwarp.version import package_version

# One pass of Moser's flow leaves an area error of the order of the mesh; a second, from where the first ended, about
# halves it; a third gains little.
MOSER_PASSES = 2
# With a target density the area that a triangle is to have depends on where it is: refinement is repeated with the
# areas of where the last round left the triangles. One, two and three rounds leave a mean mass distortion of 2.025,
# 2.008 and 2.002 on a picture with edges of contrast 5, and 2.0033, 2.0007 and 2.0004 on a smooth one of contrast 20.
TARGET_ROUNDS = 3
# On a smooth density of contrast 20 the curl falls from 0.049 after one pass to 0.006 after four and 0.0015 after
# eight, on a picture with edges from 0.066 to 0.020 and 0.013.
TARGET_POLISHES = 8
# Ascent steps of the bound on the cost in every report: each costs as much as the bound itself and gains little where
# the map is nearly optimal, where the bound matters.
ASCENT_STEPS = 0
# What the measurement after the last stage is called in progress and in the records of stages.
OPTIMALITY = "optimality"
# What the map of the quartered mesh is called there.
EXACT = "exact"
# Where one repair of a map took all that it may take and failed, later ones may take this share of it, as they fail
# too: a box with triangles of 0.001 degrees spent 4.5 s on each, for nothing. Repairs of scans stay far below that.
REPEATED_REPAIR = 0.1
# Of a stage's triangles: maps with a larger share flipped, and more than so many in number, are not repaired. Of twelve
# scans and made shapes at most 3 % are flipped by Moser's flow and all are repaired, except an octopus with 7.5 % and a
# box with triangles of 0.001 degrees with 26 %, where repair fails after all the work that it may take.
MOST_FLIPPED, MANY_FLIPS = 0.05, 300
# Slivers are removed from Moser's map before transport is optimised, by minimising angle distortion and area distortion
# with this weight to this tolerance, which saves several larger factorisations. With tolerances down to 5e-6 it takes
# up to 19 steps in place of 5, and as many of transport follow; with 0.05, at one of eight accuracies of the flow, a
# scan's transport takes 8 factorisations in place of 4. Of doubles whose map was repaired it ends at the third
# number: a double of 286 triangles, the cap of a tube with seven holes, has several minima, and ends at an area
# distortion of 2.17 with tolerances from 5e-6 to 1e-4, of 2.2 to 3.2 with larger ones.
SMOOTHING_WEIGHT, SMOOTHING_TOLERANCE, DOUBLE_TOLERANCE, SMOOTHING_STEPS = 30.0, 0.02, 5e-6, 20
# A map from a substitute start may turn limbs against the optimal map: by 18 degrees on a skull, where triangles around
# the foot of a limb then hold it under a heavy weight on areas. It is refined under this light weight first, then
# turned back, at most so many times and as long as that lowers the turns (rms) by this share. The map differs from the
# one on the conformal road by 0.009 radians (rms) on the skull, by 0.005 on a bunny and by 0.011 on a creature of 2,000
# vertices; by 0.028, 0.035 and 0.029 without turning back, and on the creature by 0.033 without refining first.
UNTWISTING_WEIGHT, UNTWISTING_TOLERANCE, UNTWISTING_STEPS = 1.0, 1e-4, 30
UNTWISTING_ROUNDS, LEAST_UNTWISTED = 6, 0.02
# The shape term that keeps a map smooth moves it away from the optimum. Its first weight is at most SHAPE_WEIGHT and
# this times the root mean squared distance; while gap or relative curl are above these the weight is lowered, to a
# share between these two, so many times at most, and as long as that lowers their excess by at least this power of the
# share, to 0.72 with a tenth of the weight and 0.88 with two fifths: below some weight only the error of the mesh is
# left, and triangles become irregular. The share is the square of what the excess asks for by proportion, as part of
# the gap is the mesh's: a cortex ends at 0.098 %, and at 0.102 % with the share itself.
SHAPE_BY_DISTANCE = 0.036
# A quartered mesh bears more of it: with twice as much the metric of neighbouring triangles differs by .012 in place of
# .020 on a bucket, whose default map has .015, and by .015 in place of .020 on a bust, at gaps of 0.04 and 0.06 %.
EXACT_SHARE = 2.0
# Power of the excess by which the weight is lowered. With 2 for exact maps too, that of a coarse cortex is lowered so
# far that the metric of neighbouring triangles differs by 0.117, more than in the default map.
SHAPE_POWER, EXACT_POWER = 2.0, 1.0
MAX_GAP, MAX_CURL = 9.9e-4, 0.025
# Where the conformal map shrinks limbs to points, the mesh's own error in the cost is larger: 0.07 and 0.29 % are left
# on two scans of that kind, 0.04 and 0.09 % with exact areas. With a third of the shape term the second of these moves
# parts of triangles by up to a tenth of their area, which the cost at vertices does not see.
MAX_GAP_SHRUNKEN = 9e-3
SHAPE_DECAY = (0.1, 0.4)
SHAPE_ROUNDS = 4
# After so many steps in all, or with the last weight, the weight is not lowered again, except on meshes of few vertices
# and with exact areas. Scans take up to 25 steps in all and 9 with one weight; a sphere with 50 spines took 112 and
# lost area distortion by it, 2.096 in place of 2.035.
MOST_LOWERED_STEPS, MOST_STEPS_OF_ONE = 30, 15
MIN_GAIN_POWER = 0.14
# A map above all of these, the last a mean squared distance in radians², is not said to be optimal: with limbs of a
# few vertices around them the shape term can hold it, as the part of an octopus above three quarters of its height, at
# a gap of 1150 % and a curl of .50. Maps of scans are below 1 % and .05. Where points hardly move, both are the mesh's
# error: the sphere of 80 triangles moves them by 0.075 radians (rms), at a gap of 73 % and a curl of .54.
FAR_GAP, FAR_CURL, FAR_COST = 0.05, 0.1, 0.02
# What area distortion counts in the shape term where the conformal map shrinks limbs to points: cost hardly determines
# triangles there. With the usual 10 their mean area distortion is 2.055 and 2.071 on two scans of that kind, with 20 it
# is 2.039 and 2.040, with 40 it is 2.031 and 2.022 at 3 % more angle distortion and a gap of up to 0.6 %.
SHRUNKEN_AREA_WEIGHT = 20.0
# There a step that would gain this share of the cost or less is the last: cost and shape have long flat valleys.
SHRUNKEN_GAIN = 2.0 * GAIN
# On hemispheres the weight is raised until the mean area distortion of triangles is below this, at most so many times
# and to at most so much. Its part above 2 falls with the power -0.77 of the weight: the part of a gargoyle above a
# plane through its middle is at 2.0109, 2.0064, 2.0038 and 2.0022 with 10, 20, 40 and 80, a caudate nucleus cut at a
# quarter of its length at 2.107, 2.059, 2.030 and 2.017, and at 2.010 with 160. Each time costs a few steps.
LARGEST_AREA, AREA_ROUNDS, MOST_AREA_WEIGHT = 2.0095, 3, 400.0
# Weight of the shape term for the distance itself, relative to that for its square: a gargoyle's mean distance is
# 0.4143 radians with 1 and 0.4135 with this, at 3 % more angle distortion.
DISTANCE_SHAPE = 0.3
# Most steps with a raised weight: parts of a human body, whose arms the conformal map shrinks to points, take 40 to 55.
HEAVY_STEPS = 100
# The reciprocal of that power, and how much further than needed the weight goes.
AREA_POWER, AREA_MARGIN = 1.3, 1.15
# On coarse meshes the triangles around a vertex differ more in area although their sum is kept: area distortion counts
# more by one plus this number over that of the vertices. On a creature of 2,000 vertices the mean area distortion of
# triangles is 2.0249 in place of 2.0263, at 0.3 % more angle distortion. The gain that ends the minimisation is larger
# by the same factor, as is the mesh's own error in the cost.
COARSE_VERTICES = 450
# Meshes of fewer vertices may take so many steps in place of the usual 40, as they are fast there: where the cost is
# a property of the few triangles alone, as on a sphere of 80, its valleys are flat, and 41 to 60 steps are needed.
FEW_VERTICES, STEPS_OF_FEW = 200, 100
# Where the conformal map shrinks most triangles to points, most of the cost depends on whole limbs alone, and under a
# heavy penalty on wrong areas steps shrink to a tenth: an octopus (58 %) was 116 % above the bound after 40 of them, at
# an area distortion of 2.14. With a light penalty that grows, less of the shape term and damped first steps it is at
# 2.038 and a gap of 0.7 % after 37. With 1e-5 in the last two rounds it is at 2.029 and 0.9 %, at a relative curl of
# .052; in two rounds, the second with 1e-5, 1e4, 30 and 22 steps, at 2.056 and 1.0 %, at .058.
# Scans with 9 and 27 % get near enough to the optimum without; a cross of four thin arms with 21 % does not, and is
# done again in this way.
# Rounds: weight of the shape term, of area in it, penalty on areas, most steps.
CONTINUATION = ((1e-4, 1e3, 3.0, 10), (1e-5, 1e4, 10.0, 10), (5e-6, 1e4, 30.0, 10), (4e-6, 1e4, 100.0, 8))
# A hemisphere keeps areas of triangles better: half of an octopus is at an area distortion of 2.031 and a gap of
# 1.3 % with the last round, at 2.071 and 0.6 % without.
CONTINUATION_OF_HALVES = (*CONTINUATION, (1e-5, 1e5, 300.0, 25))
# One more round where area distortion is still above the first number: an octopus cut at a quarter went from 2.055 to
# 2.046 by it at a gap of 0.07 %, with areas around vertices off by 0.1 % (rms).
ONE_MORE_ABOVE, ONE_MORE_ROUND = 2.05, (1e-4, 1e5, 1000.0, 25)
# Halves most of whose triangles are shrunken to points: shape comes first. From a start of even areas the limbs are
# twisted, which heavy weights on areas keep: an octopus cut at a quarter and in the middle was at 2.045 and 2.046 after
# the rounds above, at angle distortions of 66 and 50, as triangles of long sides cannot be small. Weights and steps of
# a refinement, which is free of areas around vertices and so undoes twists; a round as above, which carries area from
# one end of a limb to the other; then, with long edges split where area distortion is above LARGEST_AREA, rounds in
# which cost counts more and more. The two end at 2.0026 and 2.0056, areas around vertices off by less than 0.03 %
# (rms), at gaps of 0.2 and 0.9 %. Without splitting, and one round of the weight 1e-3, they ended at 2.019 and 2.004,
# at gaps of 0.4 and 2.6 %.
SHAPE_FIRST, ROUND_OF_SHAPE = ((30.0, 10), (100.0, 10)), (1e-2, 1e3, 300.0, 25)
ROUNDS_OF_COST = ((1e-3, 2e4, 300.0, 12), (1e-4, 5e4, 300.0, 12), (1e-5, 1e5, 300.0, 12))
# Of that refinement: it ends by its steps, far from its minimum.
SHAPE_TOLERANCE = 1e-3
# Where Moser's flow could not be repaired and the start is above this area distortion, as on plates of long triangles
# whose conformal map is flipped in large parts, points lie where they mean little, and the cost drives triangles flat:
# areas around the vertices of a bracket were off by 9 % (rms) after 40 steps, at an area distortion of 2.23. With the
# shape term before the cost they are off by 0.7 % after 76 steps, at 2.071. A box with fans of needles starts at 2.09
# and ends with areas off by 2.2 to 4.1 %, at 2.008 to 2.013, depending on rounding; without the last round by 4.6 to
# 5.0 %, at 2.019 to 2.022.
ROUGH_AREA = 2.05
ROUGH_ROUNDS = ((0.1, 300.0, 10.0, 15), (0.1, 400.0, 100.0, 30), (1.0, 400.0, 300.0, 35))
# Above this area distortion such maps have their long edges split, and the last round once more. On the bracket's own
# vertices the least found is 2.025, with areas around vertices free; with 226 of 6,096 edges split it ends at 2.012,
# areas of the input's triangles as sums of their parts, in 11 CPU seconds in place of 8.
ROUGH_LARGEST_AREA = 2.02
# Of Moser's map of a hemisphere: above, one made from coarse to fine takes its place where that is better. A ball with
# four limbs eight radii long, cut at a quarter, ends at 2.005 in place of 8.2.
FAR_AREA = 3.0
# Rough halves begin with a map refined at growing weights, so many steps each, with long edges split. In refinement and
# in the rounds after it triangles of fillings count this share of their area in the shape term: of half of a box they
# are half the area, in needles. It ends at 2.001 to 2.004, depending on rounding, areas around vertices off by 1 to 7 %
# (rms); with the rounds above at 2.05 to 2.09 and 3 to 15 %, where no edges are split at 2.009 to 2.021.
REFINED_ROUGH = (((30.0, 30), (100.0, 30)), ((300.0, 30), (1000.0, 30)))
ROUNDS_OF_ROUGH_HALVES = ((10.0, 1000.0, 3000.0, 30), (10.0, 1000.0, 3000.0, 30))
SHARE_OF_FILLINGS = 0.03
# A bound that is not improved by ascent makes gaps larger by a third, on scans with thin parts threefold. It is
# improved before a gap counts as too large, by at most the first of these steps, or by up to the second on meshes of at
# most so many vertices, where a step takes little time: the gap of a cortex falls from 0.13 to 0.0999 % in 20.
GAP_ASCENT_STEPS, GAP_ASCENT_VERTICES = (3, 20), 8_000
# Of exact maps of surfaces with shrunken limbs, of any size, the second number too where their gap is at most this
# times what is asked: a person's gap is 0.18 % after two steps, and 0.093 % after six, which take 12 CPU seconds more.
WITHIN_REACH = 2.5

# Of the weight that a map's excess asks for by proportion, so that the next map is within bounds rather than on them. A
# convention: 0.4 and 1 gave the same cost, to six digits, on five scans.
SHAPE_MARGIN = 0.7


@blas_threads(1)
def map_to_sphere(
    mesh: MeshLike,
    *,
    method: str = MapOptions.method,
    until: str = MapOptions.until,
    cost: str = MapOptions.cost,
    scheme: str = MapOptions.scheme,
    refine: str | float | AreaMatch | None = MapOptions.refine,
    exact: bool = MapOptions.exact,
    keep_edges: bool = MapOptions.keep_edges,
    optimality: bool = MapOptions.optimality,
    weights: ArrayLike | None = None,
    weights_at: str = WeightsAt.AUTO,
    target: TargetLike | None = None,
    device: str | None = MapOptions.device,
    solver: str = MapOptions.solver,
    strict: bool = MapOptions.strict,
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
        refine: ``none``, or go on from the optimal map towards less distortion: ``area``, ``balanced``, ``angle`` or
            the weight of area against angle.
        exact: keep the area of every triangle to 1e-6: the map of the mesh with its triangles cut into four, whose
            parts add up to it. The result holds that mesh; ``face_origin`` and ``vertex_origin`` say what came from
            where in the input (-1 for new vertices).
        keep_edges: split no edges. Otherwise long edges are split at their midpoints where triangles have no room to
            keep their areas, as on plates of CAD parts; the result holds the split mesh, new vertices last, with
            ``face_origin`` and ``vertex_origin``.
        optimality: also measure how far the map is from optimal, by a lower bound on the cost of every map.
        weights: positive, per vertex [V] or per triangle [F]: parts of twice the weight cover twice as much of the
            sphere for their area, see :func:`omtwarp.measures.weighted_surface`.
        weights_at: what the weights belong to, ``vertices`` or ``triangles``; ``auto`` goes by their number.
        target: the density that the image is to have on the sphere in place of the uniform one: a function of unit
            vectors [N, 3], an equirectangular picture, or ``(sphere, faces, values)``; see
            :func:`omtwarp.texturing.density.as_target`.
        device: ``auto``, ``cpu``, ``cuda`` or ``cuda:N``.
        solver: how sparse systems are solved: ``scipy``; ``cholesky`` on the host or ``multigrid`` on the device,
            both built in; ``auto`` takes the faster built-in one. The maps are the same to round-off.
        strict: raise an error for a map that would come with a warning.
        progress: called as ``progress(stage, done, total, details)``.

    Returns:
        The map, in the order of the input's vertices.

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
    options = MapOptions.parse(
        method=method,
        until=until,
        cost=cost,
        scheme=scheme,
        refine=refine,
        exact=exact,
        keep_edges=keep_edges,
        optimality=optimality,
        device=device,
        solver=solver,
        strict=strict,
    )
    where = resolve_device(options.device)
    density = as_target(target, device=str(where))
    if density is not None and (options.method not in (Method.OMT, Method.MOSER) or options.scheme is Scheme.PAPER):
        raise OmtwarpError("a target density needs the methods omt or moser, and the schemes default or plain")
    if density is not None and options.exact:
        raise OmtwarpError("exact areas are for the uniform sphere: leave the target density out")
    surface = weighted_surface(as_surface(mesh), weights, weights_at)
    ordered = in_space_order(surface)
    with solving_with(options.solver, str(where)):
        result = _Run(ordered.surface, options, str(where), progress, density).result()
    for finding in result.report["warnings"]:
        warnings.warn(finding["text"], OmtwarpWarning, stacklevel=3)
    return _in_order_of(surface, ordered, result)


@blas_threads(1)
def map_double(
    double: Double, surface: Surface, options: MapOptions, *, progress: Progress | None = None, stacklevel: int = 3
) -> MapResult:
    """Map the double of a surface to the sphere; the optimal map is solved on one half, and is symmetric to the bit.

    Args:
        double: the surface and its copy.
        surface: the double as a surface.
        options: those of :func:`map_to_sphere`.
        progress: called as ``progress(stage, done, total, details)``.
        stacklevel: of warnings.

    Returns:
        The map of the double, the surface on the northern hemisphere. It is nearly symmetric where the last stage is
        not the optimal map.

    Raises:
        OmtwarpError: the mesh cannot be mapped.
    """
    where = str(resolve_device(options.device))
    with solving_with(options.solver, where):
        result = _Run(as_surface(surface), options, where, progress, mirror=double).result()
    for finding in result.report["warnings"]:
        warnings.warn(finding["text"], OmtwarpWarning, stacklevel=stacklevel + 1)
    return result


class _Run:
    """The computation of one map: the maps of the stages so far, and their records.

    A stage is a method of no arguments: it reads ``sphere``, the map of the previous stage, and ends with
    :meth:`finish`. :meth:`result` runs them in the order of :attr:`MapOptions.stages`.

    Args:
        surface: what is mapped.
        options: of the map.
        device: name of the device that kernels run on.
        progress: called at the begin and end of every stage, and during long ones.
        target: the density on the sphere that is to be reached; None for the uniform one.
        mirror: what the surface is the double of, if it is one: the map is kept symmetric where it can be.
    """

    def __init__(
        self,
        surface: Surface,
        options: MapOptions,
        device: str,
        progress: Progress | None,
        target: TargetDensity | None = None,
        mirror: Double | None = None,
    ):
        self.target = target
        self.mirror = mirror
        self.surface = surface
        self.options = options
        self.device = device
        self.progress = progress
        self.records: list[StageRecord] = []
        self.maps: dict[str, NDArray[np.float64]] = {}
        self.history: list[Record] = []
        self.given_up = ""  # what the current stage could not do
        self.repair_given_up = False  # after the work that it may take
        self.origin: dict[str, str] = {}  # of the first map: the route that led to it, and why that one
        self.origins: dict[str, NDArray[np.int64]] = {}  # of vertices and faces, where the mesh was quartered
        self.split_origins: dict[str, NDArray[np.int64]] = {}  # of vertices and faces, where long edges were split
        self.drawn_out = False  # whether the conformal map shrinks most triangles to points
        self.first: wp.array | None = None
        self.source: NDArray[np.float64] | None = None
        self.measured: Optimality | None = None  # of the map by Newton's method
        self.area_weight: float | None = None  # of the shape term; None before it is first used
        self.uploaded: tuple[NDArray[np.float64], wp.array] | None = None
        self.known: tuple[NDArray[np.float64], Examined] | None = None
        self.counted: tuple[NDArray[np.float64], int] | None = None  # triangles shrunken at the source
        self.begun = self.stage_begun = time.perf_counter()

    @property
    def sphere(self) -> NDArray[np.float64]:
        """The map of the latest stage."""
        return next(reversed(self.maps.values()))

    @property
    def start(self) -> wp.array:
        """The points that transport starts from, where the kernels run."""
        assert self.first is not None
        return self.first

    def notify(self, stage: str, done: int, total: int, details: Record) -> None:
        if self.progress is not None:
            self.progress(str(stage), done, total, details)

    def points(self, sphere: NDArray[np.float64]) -> wp.array:
        """Return a map as an array on the device; the one asked for last is kept there."""
        if self.uploaded is None or self.uploaded[0] is not sphere:
            self.uploaded = sphere, vectors(sphere, resolve_device(self.device))
        return self.uploaded[1]

    def examine(self, sphere: NDArray[np.float64]) -> Examined:
        """Return what decides whether a map is one to one; of the one asked for last it is known already."""
        if self.known is None or self.known[0] is not sphere:
            self.known = sphere, examine(self.points(sphere), self.surface.on(self.device).faces, device=self.device)
        return self.known[1]

    def goal(self, sphere: NDArray[np.float64]) -> Surface:
        """Return the surface with the areas that its triangles should cover at their present places on the sphere."""
        return self.surface if self.target is None else self.target.goal(self.surface, sphere)

    def area_error(self, sphere: NDArray[np.float64]) -> float:
        """Return the area error of a map: how far areas on the sphere are from those of the goal."""
        return AreaMonitor(self.goal(sphere), resolve_device(self.device)).error(self.points(sphere))

    def finish(self, name: str, sphere: NDArray[np.float64], iterations: int, **details: str | float | None) -> None:
        """End a stage: keep its map, and record its time and the quality of the map."""
        seconds = time.perf_counter() - self.stage_begun
        if self.first is None:
            self.source = sphere if self.source is None else self.source
            self.first = vectors(self.source, resolve_device(self.device))
        self.maps[name] = sphere
        if self.given_up:
            details["gave_up"] = self.given_up
            self.given_up = ""
        mesh = self.surface.on(self.device)
        measured = measure(mesh.vertices, mesh.faces, self.points(sphere), device=self.device)
        cost = transport_cost(self.surface, self.points(sphere), start=self.first, device=self.device)
        self.records.append(
            StageRecord(
                name=str(name), seconds=seconds, iterations=iterations, **measured, transport_cost=cost, details=details
            )
        )
        facts = {"flips": measured["flips"], "area": measured["area"]["surface"], "angle": measured["angle"]["surface"]}
        # Cost is counted from the first map, which has none.
        self.notify(name, 1, 1, facts if len(self.records) == 1 else facts | {"cost": cost})
        self.stage_begun = time.perf_counter()

    def result(self) -> MapResult:
        """Run the chosen stages, and assemble the result."""
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
            for stage in options.stages:
                stages[stage]()
            if options.exact:
                self.keep_every_area()
        surface = self.surface
        optimality = self.optimality() if options.optimality and len(self.maps) > 1 else None
        first = next(iter(self.maps.values()))
        transported = self.maps.get(Stage.OMT)
        face_density, vertex_density = density(surface, first)
        certificate = self.certificate()
        found = judge(self.goal(self.sphere), self.sphere, self.records, options, uniform=self.target is None)
        if found and options.strict:
            raise refusal(found)
        report = self.report() | {
            "certificate": certificate.to_dict(),
            "warnings": [finding.to_dict() for finding in found],
        }
        if optimality is not None:
            report["optimality"] = optimality
        result = MapResult(
            vertices=surface.vertices,
            faces=surface.faces,
            sphere=self.sphere,
            conformal=first,
            density=vertex_density,
            face_density=face_density,
            source=self.source,
            moser=self.maps.get(Stage.MOSER),
            transported=transported,
            history=self.history,
            report=report,
            vertex_origin=(self.origins or self.split_origins).get("vertex_origin"),
            face_origin=(self.origins or self.split_origins).get("face_origin"),
            measure=surface.face_areas if surface.weighted else None,
            target=None if self.target is None else self.target.at(self.sphere),
        )
        vars(result)["certificate"] = certificate  # established of these very arrays
        return result

    def conformal(self) -> None:
        """Compute the conformal map, or the start that replaces it."""
        self.notify(Stage.CONFORMAL, 0, 1, {})
        drawn_out_map = None if self.mirror is None or not self.optimal_by_newton else self.angle_start
        start = bijective_start(self.surface, drawn_out_map=drawn_out_map, device=self.device, progress=self.progress)
        self.origin = {"route": start.route, "reason": start.reason}
        sphere, repaired = start.sphere, start.repaired_flips
        self.repair_given_up = start.repair_given_up
        # The cost depends only on where points lie under the conformal map; triangles may be flipped there.
        if start.conformal is not None and np.isfinite(start.conformal.sphere).all():
            self.source = start.conformal.sphere
            # Now: limbs of a double may be points in one half alone, which the mean of both halves hides.
            self.drawn_out = mostly_shrunken(self.surface, self.source)
            if not start.route.startswith("conformal"):
                sphere = turned_towards(sphere, self.source, self.surface.vertex_areas)
        sphere = self.orient(sphere)
        if self.mirror is not None:
            sphere = self.lay_symmetric(self.mirror, sphere)
            if start.route == "hierarchical" and not is_symmetric(self.mirror, sphere):
                coarse = self.coarse_start(self.mirror, angle=self.drawn_out and self.optimal_by_newton)
                sphere = sphere if coarse is None else coarse
        del start  # its factorisation is large, and not needed again
        self.finish(Stage.CONFORMAL, sphere, 1, **self.origin, repaired=repaired)

    def orient(self, sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn the first map, and the points that transport starts from, by the surface's own axes."""
        axes = principal_axes(self.surface)
        if axes.note:
            self.origin["axes"] = axes.note
        given = sphere if self.source is None else self.source
        rotation, determined = rotation_onto_axes(self.surface, given, axes.frame)
        if not determined:
            self.origin["axes"] = "the map agrees with no direction of the surface: its rotation means nothing"
        turned = _normalised(sphere @ rotation.T)
        faces = self.surface.faces
        if not is_bijective(turned, faces) and is_bijective(sphere, faces):
            # Triangles of the size of rounding errors can flip when they are rotated.
            turned = untangle(self.surface, turned, device=self.device).sphere
            if not is_bijective(turned, faces):
                return sphere
        if self.source is not None:
            self.source = turned if self.source is sphere else _normalised(self.source @ rotation.T)
        return turned

    def lay_symmetric(self, mirror: Double, sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        """Turn the first map, and the points that transport starts from, to be symmetric about the equator."""
        given = sphere if self.source is None else self.source
        frame = mirror_frame(mirror, given, self.surface.vertex_areas)
        self.source = symmetrised(mirror, given @ frame)
        return self.symmetric(sphere @ frame)

    def coarse_start(
        self, mirror: Double, source: NDArray[np.float64] | None = None, angle: bool = False
    ) -> NDArray[np.float64] | None:
        """Return a symmetric map without flips that was made from coarse to fine; None where there is none.

        Args:
            mirror: what the surface is the double of.
            source: points to lay the map beside, symmetric, shape [V, 3]; those that transport starts from if left out.
            angle: whether angles count as much as areas in it, rather than areas more.
        """
        source = self.source if source is None else source
        assert source is not None
        return symmetric_start(mirror, self.surface, source, angle=angle, device=self.device, progress=self.progress)

    def angle_start(self, conformal: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return a symmetric map of a double of little angle distortion, beside its conformal map; None without one."""
        assert self.mirror is not None
        frame = mirror_frame(self.mirror, conformal, self.surface.vertex_areas)
        found = self.coarse_start(self.mirror, symmetrised(self.mirror, conformal @ frame), angle=True)
        return None if found is None else found @ frame.T

    def symmetric(self, sphere: NDArray[np.float64], repair: bool = False) -> NDArray[np.float64]:
        """Make the map of a double symmetric where that flips nothing; otherwise return it unchanged."""
        if self.mirror is None:
            return sphere
        found = symmetric_map(self.mirror, self.surface, sphere, repair=repair, device=self.device)
        return sphere if found is None else found

    def moser(self) -> None:
        """Run Moser's flow from the start, again from its own result, and repair flips after each pass."""
        sphere = self.sphere
        if self.optimal_by_newton and self.mirror is None and not solves_with_scipy():
            begin_saddle_order(self.surface)
        least = self.area_error(sphere)
        steps = repaired = 0
        fewest = self.surface.face_count  # flips of a pass so far
        for k in range(MOSER_PASSES):

            def notify(stage: str, done: int, total: int, details: Record, before: int = k) -> None:
                self.notify(stage, before * total + done, MOSER_PASSES * total, {})

            flowed = moser_map(
                self.surface, self.points(sphere), target=self.target, device=self.device, progress=notify
            )
            steps += flowed.steps
            flipped = self.examine(flowed.sphere).flips
            if flipped > fewest:
                break  # repair would lose more than the flow gains
            fewest = flipped
            untangled, flips = self.untangle(sphere, flowed.sphere)
            repaired += flips
            error = self.area_error(untangled)
            if error >= least:
                break  # where the image is badly stretched, repairs can lose more than the flow gains
            sphere, least = self.symmetric(untangled), error
        self.finish(Stage.MOSER, sphere, steps, repaired=repaired)

    def transport(self) -> None:
        """Compute the optimal map by the chosen scheme."""
        if self.options.scheme is Scheme.PAPER:
            self.transport_as_published()
            return
        initial = self.sphere
        if self.by_newton:
            found, weight = self.transport_by_newton()
            if self.options.cost is Cost.GEODESIC:
                found, weight = self.by_distance(found, weight)
            self.finish_optimal(found, weight)
            return
        # The kernels of the flow are read where they are used: they are a third of all that a map would import.
        from omtwarp.transport.flow import optimal_transport
        from omtwarp.transport.polish import polish_transport

        moved = optimal_transport(
            self.surface,
            self.points(initial),
            start=self.start,
            cost=self.options.cost,
            scheme=self.options.scheme,
            target=self.target,
            device=self.device,
            progress=self.progress,
        )
        last = moved
        sphere, repaired = self.untangle(initial, moved.sphere)
        self.history = moved.history
        if self.options.scheme is Scheme.DEFAULT and self.options.cost is Cost.SQUARED:
            # With a target the prescribed areas depend on where triangles are: few rounds at a time, then new areas.
            for _ in range(TARGET_POLISHES):
                polished = polish_transport(
                    self.goal(sphere),
                    self.points(sphere),
                    start=self.start,
                    rounds=2,
                    device=self.device,
                    progress=self.progress,
                )
                last = polished
                sphere, more = self.untangle(sphere, polished.sphere)
                repaired += more
                self.remember(polished.history[1:])
        ended: dict[str, str | float | None] = {"converged": last.converged, "ended": last.ended}
        self.finish(Stage.OMT, sphere, len(self.history) - 1, repaired=repaired, **ended)

    @property
    def by_newton(self) -> bool:
        """Whether the optimal map is the discrete one, found by Newton's method."""
        return self.options.scheme is Scheme.DEFAULT and self.target is None

    @property
    def optimal_by_newton(self) -> bool:
        """Whether the optimal map is among the stages, and found by Newton's method."""
        return self.by_newton and Stage.OMT in self.options.stages

    def transport_by_newton(self) -> tuple[OptimalMap, float]:
        """Return the discrete optimal map, areas around vertices kept and cost at its minimum, and its shape weight."""
        assert self.source is not None
        if self.mirror is not None and self.drawn_out:
            made = self.origin["route"] == "hierarchical"
            start = self.maps[Stage.CONFORMAL] if made else self.coarse_start(self.mirror, angle=True)
            if start is not None and is_symmetric(self.mirror, start):
                give_back()
                return self.by_shape_first(self.mirror, start)
        initial = self.nearer_in_area(self.sphere)
        symmetric = self.mirror is None or is_symmetric(self.mirror, initial)
        if symmetric and self.drawn_out:
            give_back()
            return self.from_afar(initial)
        sphere = self.without_slivers(initial)
        give_back()  # the largest matrices follow
        if symmetric and self.rough:
            return self.by_rough_rounds(initial, sphere)
        weight = self.first_shape_weight(sphere)
        sphere = self.made_symmetric(sphere, weight)
        found, weight = self.lowering_shape_weight(self.optimal, sphere, weight)
        if symmetric and self.shrunken:
            found, weight = self.nearer_to_optimal(initial, found, weight)
        return self.with_room(found, weight), weight

    def with_room(self, found: OptimalMap, weight: float) -> OptimalMap:
        """Return the map of a half with long edges split if its areas are not even without; any other unchanged."""
        mirror, sphere = self.mirror, found.sphere
        if mirror is None or not is_symmetric(mirror, sphere):
            return found
        split = self.split_uneven(mirror, sphere)
        if split is None:
            return found
        found = self.optimal(split.on_sphere(sphere), weight, split.interpolated(found.multipliers))
        self.keep_steps(found)
        self.measured = self.bounded(found.sphere)
        return found

    def from_afar(self, sphere: NDArray[np.float64]) -> tuple[OptimalMap, float]:
        """Return the optimal map by continuation from a map that is far from it, and its weight of the shape term."""
        if self.mirror is None:
            return self.by_continuation(sphere, CONTINUATION, far=True)
        found, weight = self.by_continuation(sphere, CONTINUATION_OF_HALVES, far=True)
        if found.history[-1]["area"] <= ONE_MORE_ABOVE:
            return found, weight
        return self.by_continuation(found.sphere, (ONE_MORE_ROUND,), found.multipliers, far=True)

    def by_shape_first(self, mirror: Double, sphere: NDArray[np.float64]) -> tuple[OptimalMap, float]:
        """Return the map of a hemisphere by refinement and then rounds, from a start of little angle distortion."""
        refiner = Refiner(self.surface, resolve_device(self.device))
        for weight, steps in SHAPE_FIRST:
            sphere = self.shaped(mirror, refiner, sphere, weight, steps)
        found, _ = self.by_continuation(sphere, (ROUND_OF_SHAPE,), far=True)
        sphere, multipliers = found.sphere, found.multipliers
        split = self.split_uneven(mirror, sphere)
        if split is not None:
            sphere, multipliers = split.on_sphere(sphere), split.interpolated(multipliers)
        return self.by_continuation(sphere, ROUNDS_OF_COST, multipliers, far=True)

    def own_area(self, sphere: NDArray[np.float64]) -> float:
        """Return the mean area distortion of the triangles that are not of fillings."""
        own = slice(None) if self.surface.names is None else self.surface.names.faces >= 0
        wanted = self.surface.face_areas[own]
        ratio = triangle_areas(sphere, self.surface.faces[own]) / wanted
        ratio *= wanted.sum() / float(ratio @ wanted)
        with np.errstate(divide="ignore"):
            return float(wanted @ (ratio + 1.0 / ratio) / wanted.sum())

    def split_uneven(self, mirror: Double, sphere: NDArray[np.float64]) -> SplitDouble | None:
        """Do what :meth:`split_double` does where areas of triangles are not as even as they are to be."""
        return self.split_double(mirror, sphere) if self.own_area(sphere) > LARGEST_AREA else None

    def split_double(self, mirror: Double, sphere: NDArray[np.float64]) -> SplitDouble | None:
        """Split edges of a double that a symmetric map makes long, as :meth:`continue_with` says."""
        split = None if self.keeps_edges else split_long_edges_of_double(mirror, self.surface, sphere)
        if split is None or not self.continue_with(split, sphere):
            return None
        self.mirror = split.double
        return split

    @property
    def keeps_edges(self) -> bool:
        """Whether no edges are split: as it was asked for, or because all are split in the end, for exact areas."""
        return self.options.keep_edges or self.options.exact

    def continue_with(self, split: SplitClosed, sphere: NDArray[np.float64]) -> bool:
        """Continue with a surface some of whose edges were split; return False, and do nothing, if the map flips."""
        if not is_bijective(split.on_sphere(sphere), split.surface.faces):
            return False
        assert self.source is not None
        self.surface = split.surface
        self.source = split.on_sphere(self.source)
        self.first = vectors(self.source, resolve_device(self.device))
        self.maps = {name: split.on_sphere(points) for name, points in self.maps.items()}
        self.split_origins = {"vertex_origin": split.vertex_origin, "face_origin": split.face_origin}
        return True

    @property
    def counted_areas(self) -> NDArray[np.float64] | None:
        """Areas by which triangles count in a shape term that hardly counts fillings; None where there are none."""
        names = self.surface.names
        if names is None or not (names.faces < 0).any():
            return None
        return self.surface.face_areas * np.where(names.faces < 0, SHARE_OF_FILLINGS, 1.0)

    def shaped(
        self,
        mirror: Double,
        refiner: Refiner,
        sphere: NDArray[np.float64],
        weight: float,
        steps: int,
    ) -> NDArray[np.float64]:
        """Return a symmetric map refined by some steps, symmetric again; unchanged where that would flip a triangle."""
        refined = self.symmetric(self.smoothed(sphere, weight, SHAPE_TOLERANCE, steps, refiner), repair=True)
        return refined if is_symmetric(mirror, refined) else sphere

    def nearer_in_area(self, sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Moser's map, or for a hemisphere whose areas it leaves far off a better one from coarse to fine."""
        if self.mirror is None or self.records[-1].area["surface"] <= FAR_AREA:
            return sphere
        coarse = self.coarse_start(self.mirror)
        if coarse is None or self.area_error(coarse) >= self.area_error(sphere):
            return sphere
        self.give_up("Moser's map: one made from coarse to fine has less wrong areas")
        return coarse

    def without_slivers(self, sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Moser's map smoothed, after twists of a substitute start were undone."""
        if self.origin["route"] == "hierarchical" and not self.shrunken and not self.rough:
            sphere = self.untwisted(sphere)
        repaired = self.origin["route"] != "conformal" or any(record.details.get("repaired") for record in self.records)
        fine = self.mirror is not None and repaired
        return self.smoothed(sphere, tolerance=DOUBLE_TOLERANCE if fine else SMOOTHING_TOLERANCE)

    def untwisted(self, sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the map of a substitute start without the twists of limbs that it has against the optimal map."""
        from omtwarp.transport.twist import turned_back, turns  # its kernels are read for few surfaces

        sphere = self.smoothed(self.smoothed(sphere, UNTWISTING_WEIGHT, UNTWISTING_TOLERANCE, UNTWISTING_STEPS))
        found = turns(self.surface, self.points(sphere), self.start)
        for _ in range(UNTWISTING_ROUNDS):
            moved, _ = self.untangle(sphere, turned_back(self.surface, self.points(sphere), found))
            moved, before = self.smoothed(moved), found.rms
            found = turns(self.surface, self.points(moved), self.start)
            if found.rms <= before:
                sphere = moved
            if found.rms > (1.0 - LEAST_UNTWISTED) * before:
                break
        return sphere

    def by_rough_rounds(self, initial: NDArray[np.float64], smooth: NDArray[np.float64]) -> tuple[OptimalMap, float]:
        """Return the map of a drawn part from a smoothed one, or for a hemisphere from a symmetric one."""
        if self.mirror is None:
            found, weight = self.by_continuation(smooth, ROUGH_ROUNDS)
            found = self.with_room_on_plates(found)
        else:
            sphere = self.symmetric(smooth, repair=True)
            sphere = self.refined_half(self.mirror, sphere if is_symmetric(self.mirror, sphere) else initial)
            found, weight = self.by_continuation(sphere, ROUNDS_OF_ROUGH_HALVES, shape_areas=self.counted_areas)
        if self.options.optimality:  # far above any bound, which ascent would take long to improve
            self.measured = self.bounded(found.sphere, improve=False)
        return found, weight

    def with_room_on_plates(self, found: OptimalMap) -> OptimalMap:
        """Return the map of a drawn part with long edges split if its areas are far off without; else unchanged."""
        if self.keeps_edges or self.own_area(found.sphere) <= ROUGH_LARGEST_AREA:
            return found
        split = split_long_edges(self.surface, found.sphere)
        if split is None or not self.continue_with(split, found.sphere):
            return found
        sphere, multipliers = split.on_sphere(found.sphere), split.interpolated(found.multipliers)
        return self.by_continuation(sphere, ROUGH_ROUNDS[-1:], multipliers)[0]

    def refined_half(self, mirror: Double, sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a symmetric map refined at growing weights and turned to where points come from, long edges split."""
        assert self.source is not None
        for number, turn in enumerate(REFINED_ROUGH):
            split = self.split_double(mirror, sphere) if number else None
            if split is not None:
                mirror, sphere = split.double, split.on_sphere(sphere)
            refiner = Refiner(self.surface, resolve_device(self.device), self.counted_areas)
            for weight, steps in turn:
                sphere = self.shaped(mirror, refiner, sphere, weight, steps)
        turned = _normalised(turned_about_pole(sphere, self.source, self.surface.vertex_areas))
        return turned if is_bijective(turned, self.surface.faces) else sphere

    def made_symmetric(self, sphere: NDArray[np.float64], weight: float) -> NDArray[np.float64]:
        """Return a symmetric map of a double near another one, if need be from the optimal map; others unchanged."""
        sphere = self.symmetric(sphere, repair=True)
        if self.mirror is not None and not is_symmetric(self.mirror, sphere):
            sphere = self.optimal(sphere, weight).sphere  # the optimal map is symmetric up to the mesh's error
            frame = mirror_frame(self.mirror, sphere, self.surface.vertex_areas)
            sphere = self.symmetric(sphere @ frame, repair=True)
        return sphere

    def smoothed(
        self,
        sphere: NDArray[np.float64],
        weight: float = SMOOTHING_WEIGHT,
        tolerance: float = SMOOTHING_TOLERANCE,
        steps: int = SMOOTHING_STEPS,
        refiner: Refiner | None = None,
    ) -> NDArray[np.float64]:
        """Return a map without its slivers, turned onto the map given; ``refiner`` is of the surface.

        Distortion does not change with rotations: what rounding turns the map by, 1e-6 on a scan of 40,000 faces, would
        stay, and decide which vertices take local steps.
        """
        refiner = refiner or Refiner(self.surface, resolve_device(self.device))
        found = refiner.minimise(sphere, weight, iterations=steps, tolerance=tolerance)
        turned = _normalised(turned_towards(found.sphere, sphere, self.surface.vertex_areas))
        return turned if is_bijective(self.points(turned), self.surface.faces, device=self.device) else found.sphere

    def finish_optimal(self, found: OptimalMap, weight: float) -> None:
        """Close the stage of the optimal map, found with a weight of the shape term."""
        sphere, repaired = self.untangle(self.sphere, found.sphere)
        converged, ended = self.how_it_ended(found)
        details: dict[str, str | float | None] = {
            "repaired": repaired,
            "converged": converged,
            "ended": ended,
            "shape_weight": weight,
        }
        if self.split_origins and self.mirror is None:
            details["split_edges"] = int((self.split_origins["vertex_origin"] < 0).sum())
        self.finish(Stage.OMT, sphere, len(self.history) - 1, **details)

    def how_it_ended(self, found: OptimalMap) -> tuple[bool, str]:
        """Return whether a minimisation reached an optimal map, and how it ended; ``measured`` is of its map."""
        if found.converged and self.is_far(self.measured):
            assert self.measured is not None
            return False, f"a minimum with the shape term, {100 * self.measured.gap:.3g} % above the bound"
        return found.converged, found.ended

    @staticmethod
    def is_far(measured: Optimality | None) -> bool:
        """Return whether a map is known to be no optimal one, whatever the minimisation reached."""
        if measured is None or measured.cost <= FAR_COST * SPHERE_AREA:
            return False
        return measured.gap > FAR_GAP and measured.relative_curl > FAR_CURL

    def lowering_shape_weight(
        self,
        solve: Callable[[NDArray[np.float64], float, NDArray[np.float64] | None], OptimalMap],
        sphere: NDArray[np.float64],
        weight: float,
    ) -> tuple[OptimalMap, float]:
        """Solve with decreasing weight of the shape term, until gap and curl are small or stop falling.

        Args:
            solve: called with a map, the weight, and multipliers of a map nearby if there is one.
            sphere: the map to begin with.
            weight: the first weight.

        Returns:
            The map, and the weight that it was made with; ``measured`` and ``history`` are set.
        """
        found = solve(sphere, weight, None)
        self.keep_steps(found)
        excess = self.shape_excess(found.sphere)
        bounded = self.surface.vertex_count >= FEW_VERTICES and not self.origins
        steps = len(found.history) - 1
        for _ in range(SHAPE_ROUNDS - 1):
            if excess <= 1.0 or not found.converged:
                break
            if bounded and (steps > MOST_LOWERED_STEPS or len(found.history) - 1 > MOST_STEPS_OF_ONE):
                self.give_up(f"the weight of the shape term was lowered no further after {steps} steps")
                break
            power = EXACT_POWER if self.origins else SHAPE_POWER
            lower = weight * float(np.clip((SHAPE_MARGIN / excess) ** power, *SHAPE_DECAY))
            measured, other = self.measured, solve(found.sphere, lower, found.multipliers)
            steps += len(other.history) - 1
            self.keep_steps(other)
            changed = self.shape_excess(other.sphere) if other.converged else np.inf
            # Where only the curl was known of the map before, its excess compares with nothing.
            useless = measured is not None and changed > excess * (lower / weight) ** MIN_GAIN_POWER
            if not other.converged or useless or self.less_even(found, other):
                self.measured = measured  # as good, and smoother
                break
            found, weight, excess = other, lower, changed
        return found, weight

    def less_even(self, found: OptimalMap, other: OptimalMap) -> bool:
        """Return whether a hemisphere's map has areas as even as they are to be, and the other has not."""
        if self.mirror is None:
            return False
        return float(found.history[-1]["area"]) <= LARGEST_AREA < float(other.history[-1]["area"])

    def first_shape_weight(self, sphere: NDArray[np.float64], share: float = 1.0) -> float:
        """Return the largest weight of the shape term that is tried: less for maps that move points little."""
        cost = transport_cost(self.surface, self.points(sphere), start=self.start, device=self.device)
        return min(SHAPE_WEIGHT, share * SHAPE_BY_DISTANCE * float(np.sqrt(cost / SPHERE_AREA)))

    def remember(self, records: Sequence[Record]) -> None:
        """Append the steps of a minimisation to the history, and count iterations on."""
        self.history = continued(self.history, records)

    def keep_steps(self, found: OptimalMap) -> None:
        """Append the steps that led to an optimal map to the history, and note what was given up on the way."""
        self.remember(found.history)
        self.give_up(found.gave_up)

    def optimal(
        self,
        sphere: NDArray[np.float64],
        weight: float,
        multipliers: NDArray[np.float64] | None = None,
        cost: Cost = Cost.SQUARED,
    ) -> OptimalMap:
        """Return the discrete optimal map with a weight of the shape term; symmetric where the map given is."""
        assert self.source is not None
        among: Callable[..., OptimalMap] = optimal_map
        symmetric = self.mirror is not None and is_symmetric(self.mirror, sphere)
        if self.mirror is not None and symmetric:
            among = partial(symmetric_optimal_map, self.mirror)
        coarse = 1.0 + COARSE_VERTICES / self.surface.vertex_count
        solve = partial(
            among,
            self.surface,
            start=self.source,
            shape_weight=weight,
            gain=SHRUNKEN_GAIN if self.shrunken else GAIN * coarse,
            cost=cost,
            device=self.device,
            progress=self.progress,
        )
        if self.surface.vertex_count < FEW_VERTICES:
            solve = partial(solve, iterations=STEPS_OF_FEW)
        if self.area_weight is None:
            self.area_weight = SHRUNKEN_AREA_WEIGHT if self.shrunken else AREA_WEIGHT * coarse
        solve = partial(solve, area_weight=self.area_weight)
        # Without light penalties, the part of a human body above its middle ends short of the optimum. Where areas are
        # nearly right they only turn the map away from it.
        far = symmetric and self.shrunken and multipliers is None and self.records[-1].area["surface"] > ROUGH_AREA
        for penalty, steps in LIGHT_PENALTIES if far else ():
            found = solve(sphere, area_penalty=penalty, multipliers=multipliers, iterations=steps)
            self.keep_steps(found)
            sphere, multipliers = found.sphere, found.multipliers
        found = solve(sphere, multipliers=multipliers)
        if not symmetric:
            return found
        for _ in range(AREA_ROUNDS):
            excess = found.history[-1]["area"] - 2.0
            if excess <= LARGEST_AREA - 2.0 or self.area_weight == MOST_AREA_WEIGHT:
                break
            heavier = self.area_weight * (AREA_MARGIN * excess / (LARGEST_AREA - 2.0)) ** AREA_POWER
            self.area_weight = min(heavier, MOST_AREA_WEIGHT)
            solve = partial(solve, area_weight=self.area_weight)
            weighed = solve(found.sphere, multipliers=found.multipliers, iterations=HEAVY_STEPS)
            if np.array_equal(weighed.sphere, found.sphere):
                break  # no step made it better: with still heavier areas none would
            self.keep_steps(found)
            found = weighed
        return found

    def by_continuation(
        self,
        sphere: NDArray[np.float64],
        rounds: tuple[tuple[float, float, float, int], ...],
        multipliers: NDArray[np.float64] | None = None,
        far: bool = False,
        shape_areas: NDArray[np.float64] | None = None,
    ) -> tuple[OptimalMap, float]:
        """Return the discrete optimal map by rounds of growing penalty on areas, and the last weight of the shape term.

        See ``CONTINUATION`` and ``ROUGH_ROUNDS``; ``multipliers``, of the first round, and ``far`` as of
        :func:`omtwarp.optimal_map`, ``shape_areas``, of hemispheres, as of :func:`symmetric_optimal_map`.
        """
        assert self.source is not None
        among: Callable[..., OptimalMap] = optimal_map
        if self.mirror is not None:
            among = partial(symmetric_optimal_map, self.mirror, shape_areas=shape_areas, local_steps=True)
        found: OptimalMap | None = None
        for weight, area_weight, penalty, steps in rounds:
            found = among(
                self.surface,
                sphere if found is None else found.sphere,
                start=self.source,
                shape_weight=weight,
                area_weight=area_weight,
                area_penalty=penalty,
                multipliers=multipliers if found is None else found.multipliers,
                iterations=steps,
                gain=SHRUNKEN_GAIN,
                far=far,
                device=self.device,
                progress=self.progress,
            )
            self.keep_steps(found)
        assert found is not None
        return found, weight

    def by_distance(self, found: OptimalMap, weight: float) -> tuple[OptimalMap, float]:
        """Return the optimal map of the distance itself, from that of its square, and its weight of the shape term."""
        self.measured = None  # of the other cost
        weight *= DISTANCE_SHAPE
        other = self.optimal(found.sphere, weight, cost=Cost.GEODESIC)
        self.keep_steps(other)
        return other, weight

    def nearer_to_optimal(
        self, sphere: NDArray[np.float64], found: OptimalMap, weight: float
    ) -> tuple[OptimalMap, float]:
        """Choose the map or one by continuation, whichever has the smaller gap; return it and its shape weight.

        Args:
            sphere: where continuation begins.
            found, weight: the map, and its weight of the shape term.
        """
        before = self.bounded(found.sphere) if self.measured is None else self.measured
        self.measured = before
        if before.gap <= self.largest_gap:
            return found, weight
        known = len(self.history)
        other, lower = self.from_afar(sphere)
        measured = self.bounded(other.sphere)
        if measured.gap >= before.gap:
            del self.history[known:]
            return found, weight
        self.measured = measured
        return other, lower

    def shape_excess(self, sphere: NDArray[np.float64]) -> float:
        """Return the larger of gap and curl over their limits for the shape term: at most 1 if both are within."""
        assert self.source is not None
        self.measured = None
        curl = map_curl(self.surface, sphere, start=self.source, device=self.device)
        curled = (curl.relative / MAX_CURL) ** 2
        small = self.surface.vertex_count <= GAP_ASCENT_VERTICES
        if curled > 1.0 and not small:  # the weight is lowered whatever the gap, which takes long to bound
            return float(curled)
        self.measured = self.bounded(sphere, curl=curl)
        return float(max(self.measured.gap / self.largest_gap, curled))

    @property
    def rough(self) -> bool:
        """Whether Moser's flow left the map as it was, with areas that are far from right."""
        unmoved = self.maps[Stage.MOSER] is self.maps[Stage.CONFORMAL]
        substitute = self.origin["route"] == "hierarchical"
        area = self.records[-1].area["surface"]
        return substitute and ((unmoved and area > ROUGH_AREA) or (self.mirror is not None and area > FAR_AREA))

    @property
    def shrunken(self) -> int:
        """Number of triangles that the conformal map shrinks to points, as it does on long limbs."""
        assert self.source is not None
        if self.counted is None or self.counted[0] is not self.source:
            self.counted = self.source, shrunken_triangles(self.surface, self.source)
        return self.counted[1]

    @property
    def largest_gap(self) -> float:
        """The gap up to which a map counts as optimal, as far as its bound is improved."""
        if self.shrunken:
            return MAX_GAP_SHRUNKEN
        return MAX_GAP

    def bounded(self, sphere: NDArray[np.float64], improve: bool = True, curl: Curl | None = None) -> Optimality:
        """Measure how far a map is from optimal, and improve the bound where the gap is too large.

        ``curl`` is that of the map, if it is known.
        """
        assert self.source is not None
        first, most = GAP_ASCENT_STEPS
        # Of exact maps the bound is improved as far on shrunken limbs, although their gap may be larger.
        enough = MAX_GAP if self.origins else self.largest_gap
        measure = partial(
            optimality,
            self.surface,
            sphere,
            start=self.source,
            enough=enough,
            curl=curl,
            device=self.device,
            progress=self.progress,
        )
        if self.drawn_out:
            first = 1  # further ones gain little there, while those at the sources are quick
            # Of doubles they are not: part of an octopus took 20 CPU seconds to a gap of 0.55 %, 42 to one of 0.22 %.
            measure = partial(measure, enough=MAX_GAP if self.mirror is None else self.largest_gap)
        elif self.surface.vertex_count <= GAP_ASCENT_VERTICES:
            first = most
        found = measure(ascent_steps=first if improve else ASCENT_STEPS)
        if improve and self.origins and self.shrunken and enough < found.gap <= WITHIN_REACH * enough:
            found = measure(ascent_steps=most, potential=found.potential)
        return found

    def keep_every_area(self) -> None:
        """Compute the optimal map of the quartered mesh, in which every triangle of the mesh keeps its area."""

        def notify(stage: str, done: int, total: int, details: Record) -> None:
            self.notify(EXACT, done, total, details)

        give_back()
        assert self.source is not None
        quartered = quarter(self.surface)
        vertices, faces = (np.arange(count) for count in (self.surface.vertex_count, self.surface.face_count))
        names = self.surface.names or InputNames(vertices, faces)
        self.surface = quartered.surface
        if self.mirror is not None:
            self.mirror = quartered_double(self.mirror, quartered)
        self.origins = {
            "vertex_origin": quartered.vertex_origin,
            "face_origin": quartered.parents.astype(np.int64),
        }
        self.surface.names = names.of(self.origins["vertex_origin"], self.origins["face_origin"])
        self.source = source = quartered.on_sphere(self.source)
        self.first = vectors(source, resolve_device(self.device))
        # Cutting along great circles keeps a map one to one, except for rounding.
        self.maps = {name: quartered.on_sphere(sphere) for name, sphere in self.maps.items()}
        before, crowded = self.untangle(self.sphere, self.sphere)
        on_cells = exact_map
        if self.mirror is not None and is_symmetric(self.mirror, before):
            on_cells = partial(symmetric_exact_map, self.mirror)

        def solve(sphere: NDArray[np.float64], weight: float, multipliers: NDArray[np.float64] | None) -> OptimalMap:
            return on_cells(
                quartered,
                sphere,
                start=source,
                shape_weight=weight,
                multipliers=multipliers,
                cost=self.options.cost,
                device=self.device,
                progress=notify,
            )

        weight = self.first_shape_weight(before, EXACT_SHARE)
        if self.options.cost is Cost.SQUARED:
            found, weight = self.lowering_shape_weight(solve, before, weight)
        else:  # gap and curl, which say how far the weight has to be lowered, are those of the squared distance
            weight *= DISTANCE_SHAPE
            found = solve(before, weight, None)
            self.keep_steps(found)
        sphere, repaired = self.untangle(before, found.sphere)
        squared = self.options.cost is Cost.SQUARED
        converged, ended = self.how_it_ended(found) if squared else (found.converged, found.ended)
        self.finish(
            EXACT,
            sphere,
            len(found.history) - 1,
            shape_weight=weight,
            repaired=crowded + repaired,
            converged=converged,
            ended=ended,
            largest_area_error=found.history[-1]["ring_largest"],
        )

    def transport_as_published(self) -> None:
        """Compute the optimal map by Algorithms 1 and 2 as the paper prints them."""
        initial = self.sphere
        from omtwarp.transport.paper import paper_flow  # its kernels are read for the paper's scheme alone

        flowed = paper_flow(
            self.surface,
            initial,
            start=self.start.numpy(),
            cost=self.options.cost,
            device=self.device,
            progress=self.progress,
        )
        sphere, repaired = self.untangle(initial, flowed.sphere)
        self.history = flowed.history
        self.finish(Stage.OMT, sphere, len(self.history) - 1, repaired=repaired, converged=flowed.converged)

    def refine(self) -> None:
        """Minimise distortion from the map, at the chosen weight of area against angle."""
        weight = self.options.refine
        assert weight is not None

        give_back()  # the largest matrices follow
        sphere = self.sphere if isinstance(weight, AreaMatch) else self.least_distorted(refinement_weight(weight))
        repaired = 0
        for _ in range(1 if self.target is None else TARGET_ROUNDS):
            refined = refine_map(self.goal(sphere), sphere, weight=weight, device=self.device, progress=self.progress)
            sphere, flips = self.untangle(sphere, refined.sphere)
            repaired += flips
        sphere = self.symmetric(sphere, repair=True)
        record = {"weight": self.options.to_dict()["refine"], "converged": refined.converged, "repaired": repaired}
        self.finish(Stage.REFINE, sphere, len(refined.history), **record)

    def least_distorted(self, weight: float) -> NDArray[np.float64]:
        """Return the map made so far with the least angle + weight * area distortion, which is what refinement lowers.

        With a small weight that may be the first map: from the last one refinement would have to return to it along
        Möbius transformations, which hardly change its energy.
        """
        if self.target is not None:
            return self.sphere
        best = min(self.records, key=lambda record: record.angle["surface"] + weight * record.area["surface"])
        return self.maps[best.name]

    def optimality(self) -> dict[str, float | int | None]:
        """Measure how far the final map is from optimal, and what refinement added to the transport cost."""
        give_back()
        assert self.source is not None
        self.notify(OPTIMALITY, 0, 1, {})
        if self.options.cost is Cost.GEODESIC:
            return self.timed_optimality(self.geodesic_optimality(), 1)
        measured = self.measured
        if measured is None or self.records[-1].name not in (Stage.OMT, EXACT):
            measured = self.bounded(self.sphere, improve=self.sphere is self.maps.get(Stage.OMT))
        found: dict[str, float | int | None] = measured.to_dict()
        if self.target is not None:  # the image does not have uniform density
            found = {name: value for name, value in found.items() if not name.startswith("uniform")}
        transported = self.record_of(Stage.OMT)
        if transported is not None and self.sphere is not self.maps[Stage.OMT]:
            last = self.records[-1].transport_cost
            found["added_by_refinement"] = last / max(transported.transport_cost, TINY) - 1.0
        return self.timed_optimality(found, measured.ascent_steps)

    def geodesic_optimality(self) -> dict[str, float | int | None]:
        """Measure curl and cost of the final map by the geodesic distance, for which there is no lower bound."""
        assert self.source is not None
        measure = partial(transport_cost, self.surface, start=self.source, cost=Cost.GEODESIC, device=self.device)
        curl = relative_curl(self.surface, self.sphere, start=self.source, cost=Cost.GEODESIC, device=self.device)
        cost = measure(self.sphere)
        found: dict[str, float | int | None] = {"relative_curl": curl, "cost": cost}
        if self.record_of(Stage.OMT) is not None and self.sphere is not self.maps[Stage.OMT]:
            found["added_by_refinement"] = cost / max(measure(self.maps[Stage.OMT]), TINY) - 1.0
        return found

    def timed_optimality(self, found: dict[str, float | int | None], steps: int) -> dict[str, float | int | None]:
        """Record the time of the measurement as a stage, and return what was found."""
        seconds = time.perf_counter() - self.stage_begun
        last_record = self.records[-1]
        self.records.append(replace(last_record, name=OPTIMALITY, seconds=seconds, iterations=steps, details={}))
        details: Record = {"flips": last_record.flips}
        for name in ("cost", "gap"):
            value = found.get(name)
            if value is not None:
                details[name] = value
        self.notify(OPTIMALITY, 1, 1, details)
        self.stage_begun = time.perf_counter()
        return found

    def record_of(self, stage: Stage) -> StageRecord | None:
        """Return the record of a stage, or None where it was not run."""
        return next((record for record in self.records if record.name == stage), None)

    def barycentric(self) -> None:
        """Compute the whole map by one of the spherical barycentric systems that the paper compares with."""
        from omtwarp.baselines.barycentric import Weights, barycentric_map  # its kernels are read for these maps alone

        method = self.options.method
        weights: Weights = "tutte" if method is Method.TUTTE else "mean-value"
        solved = barycentric_map(self.surface, weights=weights, device=self.device)
        self.origin = {"route": str(method)}
        sphere = self.orient(solved.sphere)
        self.finish(method, sphere, solved.iterations, converged=solved.converged)

    def give_up(self, what: str) -> None:
        """Note for the report what the current stage could not do, once."""
        if what and what not in self.given_up.split("; "):
            self.given_up = "; ".join([*filter(None, [self.given_up]), what])

    def untangle(self, before: NDArray[np.float64], after: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
        """Make a stage's map one to one by repair, or by holding it back towards the map before it.

        Repair may end with all triangles positive and the sphere covered twice: such maps are rejected too.

        Returns:
            A bijection, and how many flips the stage's map had.
        """
        if self.examine(after).bijective:
            return after, 0
        flips = self.examine(after).flips
        if flips > MANY_FLIPS and flips > MOST_FLIPPED * self.surface.face_count:
            self.give_up(f"{flips} flipped triangles were held back towards the map before: too many to repair")
            return hold_back(self.surface, before, after, device=self.device), flips
        budget = RepairBudget(self.surface, REPEATED_REPAIR if self.repair_given_up else 1.0)
        repaired = untangle(self.goal(before), after, budget=budget, device=self.device)
        if repaired.bijective:
            return repaired.sphere, flips
        self.repair_given_up |= budget.exhausted
        why = "what repair may take was spent" if budget.exhausted else "repair failed"
        self.give_up(f"{flips} flipped triangles were held back towards the map before: {why}")
        return hold_back(self.surface, before, after, device=self.device), flips

    def report(self) -> MapReport:
        """Return the report of the map, ready for JSON."""
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
            "solver": str(wanted_solver()),
            **self.options.to_dict(),
            "start": self.origin,
            "seconds": time.perf_counter() - self.begun,
            "mass": mass_distortion(self.goal(self.sphere), self.sphere) | {"weighted": surface.weighted},
            "stages": [record.to_dict() for record in self.records],
        }

    def certificate(self) -> Certificate:
        """Certify the map that is returned.

        Raises:
            OmtwarpError: the map is not one to one.
        """
        examined = self.examine(self.sphere)
        certificate = certify_triangles(self.surface.faces, self.sphere, examined=examined, device=self.device)
        if not certificate.bijective:
            raise OmtwarpError(
                f"no map that is one to one was found: {certificate}; repair or remesh the surface and try again"
            )
        return certificate


def _in_order_of(surface: Surface, ordered: OrderedSurface, result: MapResult) -> MapResult:
    """Return the map of a surface, quartered or with edges split, from that of the surface in another order."""
    vertices, faces = ordered.vertices, ordered.faces
    arrays: dict[str, NDArray] = {"vertices": surface.vertices, "faces": surface.faces}
    if result.report.get("exact"):
        quartered = quarter(surface)
        vertices, faces = ordered.of_parts(quartered)
        arrays = {"vertices": quartered.surface.vertices, "faces": quartered.surface.faces}
        arrays |= {"vertex_origin": quartered.vertex_origin, "face_origin": quartered.parents}
    elif result.face_origin is not None:
        vertices, faces, arrays = _split_in_order_of(surface, ordered, result)
    certificate = replace(result.certificate, smallest_face=int(faces[result.certificate.smallest_face]))
    result = renumbered(result, {"V": vertices, "F": faces}, arrays)
    vars(result)["certificate"] = certificate
    result.report["certificate"] = certificate.to_dict()
    return result


def _split_in_order_of(
    surface: Surface, ordered: OrderedSurface, result: MapResult
) -> tuple[NDArray[np.int64], NDArray[np.int64], dict[str, NDArray]]:
    """Return numbers and arrays for the map of a surface with edges split; parts of a face follow each other.

    Returns:
        The new number of every vertex and face of the result, shapes [V'] and [F'], and the arrays that hold numbers.
    """
    assert result.vertex_origin is not None and result.face_origin is not None
    count = len(result.vertices)
    vertices = np.r_[ordered.vertices, np.arange(surface.vertex_count, count)]
    origin = ordered.faces[result.face_origin]
    along = np.argsort(origin, kind="stable")
    numbers = np.empty_like(along)
    numbers[along] = np.arange(len(along))
    faces, origin = vertices[result.faces[along]].astype(np.int32), origin[along]
    whole = np.bincount(origin)[origin] == 1
    faces[whole] = surface.faces[origin[whole]]  # which begin at the same corner as in the input
    vertex_origin = np.where(np.arange(count) < surface.vertex_count, np.arange(count), -1)
    return vertices, numbers, {"faces": faces, "vertex_origin": vertex_origin, "face_origin": origin}


def versions() -> dict[str, str]:
    """Return the versions of the packages that a result depends on."""
    return {
        "omtwarp": package_version(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "warp": wp.config.version,
    }


def _normalised(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale points to unit length, shape [V, 3]."""
    return points / np.linalg.norm(points, axis=1, keepdims=True)
