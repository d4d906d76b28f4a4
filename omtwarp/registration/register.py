"""Registration of one map to another: the same place of two surfaces at the same point of the sphere."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.alignment import Alignment
from omtwarp.alignment.rotation_search import Best
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpWarning
from omtwarp.location import Locator
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, by_name, real_number
from omtwarp.mesh.surface import Surface
from omtwarp.metrics.certificate import Certificate, certify_triangles
from omtwarp.options import MAX_STRAIN, STIFFNESS, Progress, Record, tell
from omtwarp.registration.folding import FOLDING_WEIGHTS
from omtwarp.registration.group_template import Template
from omtwarp.registration.landmarks import LandmarksLike, Pairs, pairs_of
from omtwarp.registration.sides import Side, feature_weights_of, two_sides
from omtwarp.registration.strain import area_changes, kept_within, octaves, with_areas
from omtwarp.registration.warp import AREA_WEIGHT, COARSE, FINE, MATCHED, Warp, Warping
from omtwarp.resampling.resample import PointsLike

FACTS = ("score", "margin", "doubtful", "flips", "degree", "area_p95", "stretch_p95", "strain")  # of every registration


@dataclass(frozen=True, eq=False)
class Registration:
    """A map's sphere registered to another.

    Attributes:
        sphere: unit vectors, float64, shape [V, 3].
        start: the rotation that the warp started from. Its ``score`` is that of the best rotation, its ``runner_up``
            that of the next best one, whichever was taken.
        doubtful: whether the two scores were so near to each other that further rotations were tried.
        starts: the ``score`` of the rotation and the ``energy`` at the end of the coarse levels for every start that
            was tried, the match of places first; the one with the least energy was taken.
        correlations: of every feature, at the target's vertices: ``before`` (after the rotation) and ``after``.
        area_strain: log2 of the ratio of areas of every triangle on the spheres after and before, shape [F].
        stretch_strain: log2 of the ratio of the larger to the smaller stretch of every triangle, shape [F].
        most_strain: the bound of both that was asked for.
        landmarks: of every landmark by its label, how far it was from its place ``before`` (after the rotation) and
            ``after``, in degrees, root mean square over a curve.
        area_changes: relative changes of the areas around the vertices, by the warp: ``rms`` and ``largest``.
        certificate: whether the registered map is one to one, decided exactly.
        levels: a record for every level from coarse to fine.
        closed_sphere: the sphere with what fills holes, shape [N, 3]; its first points are ``sphere``.
        features: what was compared, by name: at the vertices of the map and at those of the target.
    """

    sphere: Floats
    start: Alignment
    doubtful: bool
    starts: list[Record]
    correlations: dict[str, dict[str, float]]
    area_strain: Floats
    stretch_strain: Floats
    most_strain: float
    certificate: Certificate
    area_changes: dict[str, float]
    landmarks: dict[str, dict[str, float]] = field(default_factory=dict)
    levels: list[Record] = field(default_factory=list)
    closed_sphere: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    features: tuple[dict[str, Floats], dict[str, Floats]] = field(default_factory=lambda: ({}, {}))

    @property
    def _strains(self) -> dict[str, Floats]:
        return {"area": self.area_strain, "stretch": self.stretch_strain}

    @property
    def largest_strain(self) -> float:
        """The largest of both strains, in size."""
        return float(max(np.abs(self.area_strain).max(), self.stretch_strain.max()))

    def __repr__(self) -> str:
        agreement = ", ".join(f"{name} {values['after']:.3f}" for name, values in self.correlations.items())
        return f"Registration({agreement}, strain {self.largest_strain:.2f}, {self.certificate.flips} flips)"

    def registered(self, result: MapResult) -> MapResult:
        """Return the map with its sphere registered, and its other stages turned as at the start.

        The report gains ``registration``, and its certificate is that of the registered map. What it says about
        distance from the optimum is left out: that was the map's before. Save it as any map:
        ``register(left, right).registered(left).save("left.npz")``.
        """
        turned = self.start.turned(result)
        report = turned.report.copy()
        report.pop("optimality", None)
        report["registration"], report["certificate"] = self.to_dict(), self.certificate.to_dict()
        filled = None if turned.filled_sphere is None else self.closed_sphere
        return turned.with_arrays({"sphere": self.sphere, "filled_sphere": filled, "report": report})

    def to_dict(self) -> dict[str, object]:
        """Return what is no array as plain values, ready for JSON, with percentiles of the strains."""

        def percentiles(strain: Floats) -> dict[str, float]:
            sizes = np.abs(strain)
            return {f"p{k}": float(np.percentile(sizes, k)) for k in (50, 95)} | {"max": float(sizes.max())}

        names = ("doubtful", "starts", "correlations", "most_strain", "area_changes", "landmarks", "levels")
        start = {"score": self.start.score, "runner_up": self.start.runner_up}
        plain = {name: getattr(self, name) for name in names} | {"certificate": self.certificate.to_dict()}
        return start | plain | {f"{name}_strain": percentiles(strain) for name, strain in self._strains.items()}

    def facts(self) -> dict[str, float]:
        """Return the numbers by which registrations are told apart, for a table.

        They are the score of the best rotation and its margin to the next best one, whether the start is doubtful (1),
        flips and degree, both strains at 95 %
        of the triangles and the largest, and every feature's correlation at the end.
        """
        start, certificate = self.start, self.certificate
        ends = [np.percentile(np.abs(strain), 95) for strain in self._strains.values()]
        of_map = start.score, start.score - start.runner_up, self.doubtful, certificate.flips, certificate.degree
        agreement = {name: agreement_of["after"] for name, agreement_of in self.correlations.items()}
        facts = {**dict(zip(FACTS, (*of_map, *ends, self.largest_strain), strict=True)), **agreement}
        return {f"registration_{name}": float(value) for name, value in facts.items()}


@blas_threads(1)
def register(
    moving: PointsLike,
    target: PointsLike | Template,
    *,
    features: Mapping[str, ArrayLike] | None = None,
    to_features: Mapping[str, ArrayLike] | None = None,
    feature_weights: Mapping[str, float] | None = None,
    stiffness: float = STIFFNESS,
    max_strain: float = MAX_STRAIN,
    landmarks: LandmarksLike | None = None,
    keep_areas: float | str = 0.0,
    progress: Progress | None = None,
) -> Registration:
    """Warp a map's sphere so that features of its surface lie where they lie on another sphere.

    Minimised is the sum over features of weight times mean squared difference on the target, plus ``stiffness`` / 2
    times the mean distortion of triangles between the sphere before and after, R + 1/R - 2 + 3 (D + 1/D - 2) of the
    ratios of stretches and areas, with a barrier that keeps it below what ``max_strain`` allows. It is minimised coarse
    to fine on grids, from two starts, of which the one with less energy after the coarse levels is taken: the rotation
    under which the features agree best, and a match of places around which they look alike, found by a discrete
    optimisation over all places (:mod:`omtwarp.registration.matching`). Where the next best rotation agrees nearly as
    well, it and further ones are tried too. The warp is then carried to the map's own vertices, where flips and strain
    over the bound are removed.

    Args:
        moving: a map, with its surface where no features are given (:func:`omtwarp.resampling.as_points` lists the
            forms), V vertices and F faces.
        target: another map or sphere in any of the same forms, or the name of an average that is
            installed (``fsaverage5-left``, ``fsaverage-left``, ``fsLR32k-left``, the same with ``-right``, or with
            neither for a map that says of which hemisphere it is), or a template of a group
            (:func:`omtwarp.registration.register_group`) or its file, which has features of its own.
        features: numbers per vertex of the map, by name, shape [V] each; with ``to_features`` of the same names they
            take the place of sulcal depth and curvature of the two surfaces.
        to_features: the same for the target.
        feature_weights: by name; 1 for those left out, 0.48 for the curvature of the surfaces.
        stiffness: λ. More leaves less strain and less agreement.
        max_strain: bound of |log2| of the ratio of areas, and of the ratio of the two stretches, of every triangle.
        landmarks: points and curves that correspond (:class:`Landmark`), or a file of them
            (:func:`omtwarp.registration.read_landmarks`). Added is the sum over them of weight times mean squared
            distance in radians; those of infinite weight are brought to their places.
        keep_areas: weight of the mean squared relative change of the areas around vertices, which is added; ``exact``
            keeps these areas to 1e-6: an area-preserving map stays one.
        progress: called as ``progress("register", step, steps, details)``.

    Returns:
        The registered sphere, its start, agreement, strain and certificate.

    Raises:
        OmtwarpError: something that is not a map or sphere, features that do not belong together or are constant, a
            surface that is missing, or numbers out of range.

    Warns:
        OmtwarpWarning: triangles of the map's own mesh stayed beyond ``max_strain``, or exact landmarks stayed away
            from their places.

    Example:
        >>> import omtwarp
        >>> target = omtwarp.shapes.icosphere(12)
        >>> x, y, z = target.vertices.T
        >>> found = omtwarp.register(
        ...     target, target, features={"height": x * y + z}, to_features={"height": x * y + z}, max_strain=1.0
        ... )
        >>> found.certificate.bijective, found.largest_strain < 0.1
        (True, True)
    """
    stiffness = real_number(stiffness, "the stiffness", above=0.0)
    max_strain = min(real_number(max_strain, "max_strain", above=0.0), 500.0)  # powers of two: float64 ends at 1,024
    weight_of_areas = area_penalty(keep_areas)
    here, there = two_sides(moving, target, features, to_features)
    usual = {} if features else FOLDING_WEIGHTS
    weights = feature_weights_of(here.features, {**usual, **by_name(feature_weights, "feature_weights")})
    grids = here.points.grid, there.points.grid
    counts = grids[0].own_points, grids[1].own_points
    pairs = None if landmarks is None else pairs_of(landmarks, grids[0].points, grids[1].points, counts)
    rotations, doubtful = here.rotations(there)
    tell(progress, "register", 1, 3, {})
    coarser = min(len(grid.points) for grid in grids)
    warping = Warping(*there.on_grid, weights, stiffness, max_strain, coarser, weight_of_areas)
    match = warping.match(*here.on_grid, pairs)
    sides = [here.moved(grids[0].points @ rotation.rotation.T) for rotation in rotations]
    nearest = min(range(len(rotations)), key=lambda k: match.apart(rotations[k].rotation))
    tried = [_Try.of(warping, sides[nearest], rotations[nearest], pairs, match)]
    tried += [_Try.of(warping, side, rotation, pairs) for side, rotation in zip(sides, rotations, strict=True)]
    best = min(tried, key=lambda one: one.warp.energy)
    tell(progress, "register", 2, 3, {})
    warp = warping.run(*best.turned.on_grid, FINE, best.warp, best.marks)
    before = best.turned.points.grid.points
    surface = Surface(before, grids[0].triangles)
    sphere, distances = _arrived(surface, warp, best.marks, max_strain, weight_of_areas)
    tell(progress, "register", 3, 3, {})
    by_area, by_stretch = octaves(before, sphere, grids[0].own_triangles)
    _warn_of_strain(np.maximum(np.abs(by_area), by_stretch), max_strain, pairs is not None and bool(pairs.exact.any()))
    agreement = [side.agreement(there) for side in (best.turned, best.turned.moved(sphere))]
    turn, first, own = best.rotation.rotation, rotations[0], before[: counts[0]]
    return Registration(
        sphere=sphere[: counts[0]],
        start=Alignment(turn, own, "features", first.score, first.runner_up, False, basis=", ".join(here.features)),
        doubtful=doubtful,
        starts=[{"score": one.rotation.score, "energy": one.warp.energy} for one in tried],
        correlations={name: {"before": agreement[0][name], "after": agreement[1][name]} for name in here.features},
        area_strain=by_area,
        stretch_strain=by_stretch,
        most_strain=max_strain,
        certificate=certify_triangles(grids[0].triangles, sphere, device="cpu"),
        area_changes=area_changes(before, sphere, surface.faces),
        landmarks=distances,
        levels=warp.levels,
        closed_sphere=sphere,
        features=(here.features, there.features),
    )


@dataclass(frozen=True, eq=False)
class _Try:
    """A warp at the coarse levels from one start.

    Attributes:
        rotation: of the sphere before.
        turned: what moves, after it.
        marks: landmarks after it.
        warp: of the last coarse level.
    """

    rotation: Best
    turned: Side
    marks: Pairs | None
    warp: Warp

    @classmethod
    def of(cls, warping: Warping, turned: Side, rotation: Best, pairs: Pairs | None, match: Warp | None = None) -> _Try:
        """Run the coarse levels from a rotation, or the last of them from a match of places before it."""
        marks = pairs and pairs.turned(rotation.rotation)
        start, levels = (match.after(rotation.rotation), MATCHED) if match else (None, COARSE)
        return cls(rotation, turned, marks, warping.run(*turned.on_grid, levels, start, marks))


def _arrived(
    surface: Surface, warp: Warp, marks: Pairs | None, max_strain: float, penalty: float
) -> tuple[Floats, dict[str, dict[str, float]]]:
    """Carry a warp to a map's own vertices, and return their places, [V, 3], and how far landmarks are from theirs."""
    if marks is None:
        return within_bounds(surface, warp.carry(surface.vertices), max_strain, penalty), {}
    place = Locator(surface.vertices, surface.faces, device="cpu").find(marks.points)
    held = surface.faces[place.faces[marks.exact]]
    sphere = within_bounds(surface, warp.carry(surface.vertices), max_strain, penalty, held)
    ends = [marks.distances(place.on_sphere(surface.faces, points)) for points in (surface.vertices, sphere)]
    distances = {label: {"before": ends[0][label], "after": ends[1][label]} for label in marks.labels}
    _warn_of_distant(marks, distances, max_strain)
    return sphere, distances


def within_bounds(
    surface: Surface, warp: Floats, max_strain: float, penalty: float, held: NDArray[np.integer] | None = None
) -> Floats:
    """Return the warp of a map's sphere, [V, 3], without flips, within the bound, and with its areas if need be.

    Args:
        surface: the sphere before.
        warp: unit vectors, shape [V, 3].
        max_strain, held: as of :func:`omtwarp.registration.strain.kept_within`.
        penalty: of :func:`area_penalty`.
    """
    sphere = kept_within(surface, warp, max_strain, held)
    return with_areas(surface, sphere, AREA_WEIGHT) if np.isinf(penalty) else sphere


def area_penalty(keep_areas: object) -> float:
    """Return the weight of the areas around vertices, infinite where they are to be kept exactly."""
    return np.inf if keep_areas == "exact" else real_number(keep_areas, "keep_areas (unless 'exact')", least=0.0)


def _warn_of_distant(marks: Pairs, distances: dict[str, dict[str, float]], max_strain: float) -> None:
    """Warn of exact landmarks that are not at their places."""
    apart = 0.1  # degrees that exact landmarks may be from their places, a tenth of an edge of 160,000 vertices
    exact = [marks.labels[k] for k in np.unique(marks.owners[marks.exact])]
    if away := [label for label in exact if distances[label]["after"] > apart]:
        farthest = distances[away[0]]["after"]
        text = f"exact landmarks stayed away from their places, '{away[0]}' by {farthest:.2f} degrees"
        warnings.warn(f"{text}: the strain that they need is over {max_strain:g}", OmtwarpWarning, stacklevel=3)


def _warn_of_strain(strain: Floats, max_strain: float, exact: bool) -> None:
    """Warn of triangles that are strained more than they may be; triangles around exact landmarks are not relaxed."""
    if over := int((strain > max_strain).sum()):
        reason = "exact landmarks need it, or " if exact else ""
        text = f"{over} triangles are strained beyond {max_strain:g}: {reason}the mesh has slivers there"
        warnings.warn(f"{text}, or too few triangles", OmtwarpWarning, stacklevel=3)
