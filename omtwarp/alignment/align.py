"""Alignment of one sphere: by its shape's axes, or to another map by features, functions on the sphere."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.alignment.rotation_search import Best, best_rotations, complex_coefficients, improved
from omtwarp.device.threads import blas_threads
from omtwarp.errors import OmtwarpError, OmtwarpWarning, choose, truth
from omtwarp.geometry.axes import fitted_rotation
from omtwarp.geometry.harmonics import harmonics_in_parts
from omtwarp.geometry.sphere_hierarchy import triangle_solid_angles
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import TINY, Floats, by_name, in_range, normalised, norms, real_numbers, whole_number
from omtwarp.mesh.surface import sums_around
from omtwarp.options import AlignBy, AlignByLike
from omtwarp.resampling import SpherePoints, as_points
from omtwarp.resampling.resample import PointsLike
from omtwarp.spheres import SphereGrid


def sphere_weights(points: SpherePoints) -> Floats:
    """Return a third of the spherical triangles' areas around every vertex, shape [V].

    The sum is 4π, less what fills holes: values there are not the surface's, and count for nothing.
    """
    faces = points.grid.own_triangles
    angles = triangle_solid_angles(*points.grid.points.take(faces.T, axis=0))
    return sums_around(angles / 3.0, faces, len(points.grid.points))


def own_features(points: SpherePoints) -> dict[str, Floats]:
    """Return the default features: distance from the centre, and area on the surface over area on the sphere.

    Neither depends on rotation or scale. Areas are left out where the map preserves them.

    Raises:
        OmtwarpError: the sphere is given without its surface.
    """
    # Standard deviation of the logarithm of area below which areas carry no information, as in area-preserving maps.
    least_area_spread = 0.1
    # Of the whole: the least share of a vertex's area that has a logarithm; a vertex of no area takes it in place of
    # infinity.
    smallest_share = 1e-12
    if points.vertices is None:
        raise OmtwarpError(
            f"{points.grid.name}: a sphere without its surface has no features of its own: give the surface, or data"
        )
    masses, weights, vertices = points.surface_areas(), sphere_weights(points), in_range(points.vertices)
    centre = masses @ vertices / masses.sum()
    features = {"radius": norms(vertices - centre)}
    here, there = (np.maximum(areas / areas.sum(), smallest_share) for areas in (masses, weights))
    ratio = np.log(here / there)
    if spread(ratio, weights) > least_area_spread:
        features["areas"] = ratio
    return features


def checked_features(given: Mapping[str, ArrayLike], points: SpherePoints, whose: str) -> dict[str, Floats]:
    """Return the features as float64 arrays of one number per vertex, 0 in what fills holes, NaN where there is none.

    Raises:
        OmtwarpError: a feature has another length, infinite numbers, or none at all.
    """
    count = points.grid.own_points
    filling = np.zeros(len(points.grid.points) - count)
    out = {}
    for name, values in given.items():
        what = f"feature '{name}' of {whose}"
        own = points.at_own_points(real_numbers(values, what, None, finite=False))
        array: Floats = real_numbers(own, what, (count,), finite=False)
        if np.isinf(array).any() or np.isnan(array).all():
            raise OmtwarpError(f"feature '{name}' of {whose} has infinite numbers, or none at all")
        out[name] = np.concatenate([in_range(array), filling])
    return out


def filled_by_means(features: Mapping[str, Floats], points: SpherePoints) -> dict[str, Floats]:
    """Return features with their means over the sphere where there is no number: they count for nothing there."""
    weights, out = sphere_weights(points), {}
    for name, values in features.items():
        known = ~np.isnan(values)
        here = np.where(known, values, 0.0)
        out[name] = np.where(known, values, weights @ here / (weights @ known))
    return out


def spread(values: Floats, weights: Floats) -> float:
    """Return the standard deviation of a feature over the sphere."""
    mean = weights @ values / weights.sum()
    return float(np.sqrt(max(weights @ (values - mean) ** 2 / weights.sum(), 0.0)))


def is_constant(values: Floats, weights: Floats, least: float = 1e-9) -> bool:
    """Return whether a feature is the same all over the sphere.

    Args:
        values: shape [V].
        weights: of the vertices, shape [V].
        least: variation, as a part of the largest value, up to which it is; less than the default is rounding around a
            constant (1e-16 times the root of the vertices).
    """
    return not spread(values, weights) > least * np.abs(values).max()


def varying_features(points: SpherePoints) -> dict[str, Floats]:
    """Return the default features that are not constant, as those of a ball are."""
    weights = sphere_weights(points)
    # Up to this variation they are constant; positions come from files: six digits and single precision vary by 1e-6.
    return {k: values for k, values in own_features(points).items() if not is_constant(values, weights, 1e-5)}


def feature_coefficients(features: Mapping[str, Floats], points: SpherePoints, degree: int) -> Floats:
    """Return the real coefficients of features of mean 0 and standard deviation 1, shape [(L + 1)², K].

    By quadrature with the vertices' areas on the sphere, which turns with the sphere: no position is preferred.
    """
    weights = sphere_weights(points)
    columns = []
    for name, values in features.items():
        if is_constant(values, weights):
            raise OmtwarpError(f"feature '{name}' is constant and determines no rotation: leave it out")
        columns.append(weights * (values - weights @ values / weights.sum()) / spread(values, weights))
    weighted = np.stack(columns, axis=1)
    total = np.zeros(((degree + 1) ** 2, len(columns)))
    for part, basis in harmonics_in_parts(points.grid.points, degree):
        total += basis.T @ weighted[part]
    return total


def coefficient_errors(features: Mapping[str, Floats], points: SpherePoints) -> Floats:
    """Estimate the noise of each feature's coefficients from the differences between neighbours, shape [K].

    Noise that is independent between vertices enters a coefficient with the vertex's area on the sphere.
    """
    weights = sphere_weights(points)
    faces = points.grid.own_triangles
    count = len(points.grid.points)
    around = np.bincount(faces.ravel(), minlength=count) * 2.0
    errors = []
    for values in features.values():
        others = values[faces[:, [1, 2, 0]]] + values[faces[:, [2, 0, 1]]]
        apart = values - np.bincount(faces.ravel(), others.ravel(), minlength=count) / np.maximum(around, 1.0)
        errors.append(np.linalg.norm(weights * apart) / spread(values, weights))
    return np.array(errors)


DEGREE = 16  # of the harmonics that are correlated by default: they resolve about 180 / 16 = 11 degrees
MIRROR = np.diag([-1.0, 1.0, 1.0])  # reflects in the plane x = 0


@dataclass(frozen=True, eq=False, repr=False)
class Alignment:
    """A map's sphere in its new position, and the rotation that brought it there.

    Attributes:
        rotation: the rotation that was applied to the sphere, shape [3, 3]; its determinant is -1 if the shape was
            mirrored.
        sphere: the sphere's points after it, float64, shape [V, 3].
        method: ``axes``, ``vertices`` (each vertex to that of the same number), ``features``, or ``places`` (each
            surface as it lies in space).
        basis: in words, what was compared, and why.
        score: how well it fits: for features their correlation, for vertices 1 less half the mean squared distance, for
            axes the smaller of the two skewnesses that determine the signs (near 0 they are not determined), for places
            1 less half the mean squared distance of the sphere's points from the surface's directions.
        runner_up: the score of the next best position that is at least 5 degrees away; -1 if there is none.
        mirrored: whether the shape's mirror image was aligned; then the surface has to be mirrored in x and its faces
            reversed too.
        frame: for ``axes``, rows are the shape's main axes from the longest to the shortest, shape [3, 3]; else None.
    """

    rotation: Floats
    sphere: Floats
    method: str
    score: float
    runner_up: float
    mirrored: bool
    frame: Floats | None = None
    basis: str = ""

    @property
    def margin(self) -> float:
        """How much better it fits than the next best position; infinite if there is none."""
        return self.score - self.runner_up if self.runner_up > -1.0 else float("inf")

    def to_dict(self) -> dict[str, object]:
        """Return all fields but the sphere, and the margin (None if infinite) as plain values, ready for JSON."""
        plain = {name: value for name, value in vars(self).items() if name not in ("sphere", "rotation", "frame")}
        frame = None if self.frame is None else self.frame.tolist()
        margin = self.margin if np.isfinite(self.margin) else None
        return plain | {"margin": margin, "rotation": self.rotation.tolist(), "frame": frame}

    def __repr__(self) -> str:
        mirrored = ", mirrored" if self.mirrored else ""
        return f"Alignment(by {self.method}, score {self.score:.4f}, next best {self.runner_up:.4f}{mirrored})"

    def turned(self, result: MapResult) -> MapResult:
        """Return the map that was aligned in its new position, all stages turned, with the alignment in its report.

        After a mirror image has been aligned, the surface is mirrored in x and its faces are reversed too. Save it as
        any map: ``align(left, right).turned(left).save("left.npz")``. A registered map is none any more.
        """
        report = {**result.report, "alignment": self.to_dict()}
        report.pop("registration", None)
        changed: dict[str, object] = {"report": report}
        if self.mirrored:
            own = result.arrays
            changed |= {name: own[name] @ MIRROR for name in ("vertices", "filled_vertices") if name in own}
            changed |= {name: own[name][:, ::-1] for name in ("faces", "filled_faces") if name in own}
        return result.turned(self.rotation.T).with_arrays(changed)


def mirror_image(points: SpherePoints) -> SpherePoints:
    """Mirror a map: x changes its sign on surface and sphere, and every face its orientation."""
    faces = np.ascontiguousarray(points.grid.triangles[:, ::-1])
    name, own = f"{points.grid.name}, mirrored", points.grid.own
    grid = SphereGrid(name, points.grid.points @ MIRROR, faces, points.grid.shape, own=own)
    return SpherePoints(grid, None if points.vertices is None else points.vertices @ MIRROR, points.origins)


def align_to_axes(given: PointsLike) -> Alignment:
    """Rotate a map's sphere by the main axes of its shape, as in SPHARM.

    The part of degree 1 of the surface's coordinates, x ≈ c + A u, maps the sphere to the first-order ellipsoid. The
    sphere is turned so that the end of the ellipsoid's longest axis lies at longitude 0 on the equator (+x), that of
    the middle one at +y and that of the shortest at the north pole (+z) [1]_.

    An ellipsoid does not determine the directions: each axis points to where the surface has its longer tail (positive
    third moment of area). If the three signs make a mirror image, the least certain one is reversed. Filled holes count
    as they are filled, as in the harmonics of :func:`omtwarp.shape_analysis.expand`.

    Args:
        given: a map with its surface (see :func:`omtwarp.resampling.as_points`).

    Raises:
        OmtwarpError: the sphere is given without its surface.

    .. [1] C. Brechbühler, G. Gerig, O. Kübler, "Parametrization of closed surfaces for 3-D shape description",
       Comput. Vis. Image Underst. 61 (1995), section 4.4.
    """
    open_points = as_points(given, "the map")
    points = open_points.closed()
    if points.vertices is None:
        raise OmtwarpError(f"{points.grid.name}: a sphere without its surface has no axes: give a map")
    weights, vertices = sphere_weights(points), in_range(points.vertices)
    first_order = 3.0 / weights.sum() * (vertices * weights[:, None]).T @ points.grid.points
    axes, _, parameters = np.linalg.svd(first_order)
    masses = points.surface_areas()
    along = (vertices - masses @ vertices / masses.sum()) @ axes
    moments = [masses @ along**power / masses.sum() for power in (2, 3)]
    skewness = moments[1] / np.maximum(moments[0], TINY) ** (3.0 / 2.0)
    signs = np.where(skewness < 0, -1.0, 1.0)
    certain = np.sort(np.abs(skewness))
    if np.linalg.det(signs[:, None] * parameters) < 0:
        signs[np.argmin(np.abs(skewness))] *= -1.0
    rotation = signs[:, None] * parameters
    frame = (axes * signs).T
    turned = _own_turned(open_points, rotation)
    return Alignment(rotation, turned, "axes", float(certain[1]), -1.0, False, frame, "the shape's own axes")


@blas_threads(1)
def align(
    given: PointsLike,
    to: PointsLike = "axes",
    *,
    features: Mapping[str, ArrayLike] | None = None,
    to_features: Mapping[str, ArrayLike] | None = None,
    by: AlignByLike = "auto",
    mirror: bool = False,
    degree: int = DEGREE,
    check: bool = True,
) -> Alignment:
    """Rotate a map's sphere to that of another map, or to the shape's own axes.

    Two maps are aligned where the features of their surfaces agree best: distance from the surface's centre and, where
    a map does not preserve area, area over area on the sphere; or the given features. Their spherical harmonics are
    correlated over all rotations at once, and Newton's method ends at the maximum, where noisy features, whose values
    differ between neighbours, have less weight. Surfaces without features, such as two balls, stay as they lie in
    space: their directions from their centres correspond.

    What fills the holes of a surface (:func:`omtwarp.map_surface`) has no weight, in features as in scores.

    Two maps of one surface need no search: each vertex is brought to the vertex of the same number by least squares
    [1]_. ``by="auto"`` does so where both have the same faces, no features are given, and the two surfaces are one up
    to a similarity and noise, or a side is a sphere without a surface. Equal faces alone do not suffice:
    surfaces that were resampled to one grid have them, and correspond only if their spheres were aligned before. Where
    different surfaces correspond, such as a deformed template, use ``by="vertices"``.

    Args:
        given: a map, with its surface where that is needed (:func:`omtwarp.resampling.as_points` lists the forms).
        to: ``axes`` (:func:`align_to_axes`), or another map or sphere in any of the same forms.
        features: numbers per vertex of the map, by name; with ``to_features`` of the same names they take the place of
            the surface's own.
        to_features: the same for the other map.
        by: ``auto``, ``features`` or ``vertices``; the result's ``method`` and ``basis`` say what was used
            and why.
        mirror: also try the mirror image of the shape, and take it if it fits better.
        degree: the highest degree of the harmonics, 1 to 64.
        check: by features, also try the mirror image, and every given feature with the other sign, and warn
            (:class:`omtwarp.OmtwarpWarning`) where that fits clearly better.

    Returns:
        The turned map, the rotation, and how well the two agree.

    Raises:
        OmtwarpError: something that is not a map or sphere, features that do not belong together, too few features,
            or an option that such an alignment does not use.

    Example:
        >>> from omtwarp import align, shapes
        >>> blob = shapes.blob(sphere=shapes.icosphere(8))
        >>> turned = align((shapes.icosphere(8).vertices, blob.faces), shapes.icosphere(8))
        >>> round(turned.score, 6), turned.method
        (1.0, 'vertices')

    .. [1] W. Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Cryst. A32 (1976).
    """
    own, theirs = by_name(features, "features"), by_name(to_features, "to_features")
    if set(own) != set(theirs):
        raise OmtwarpError("features have to be given for both sides, with the same names")
    degree, by = whole_number(degree, "the degree", least=1, most=64), choose(AlignBy, by)
    mirror, check = truth(mirror, "mirror"), truth(check, "check")
    of_features = {"features": own, "degree": degree != DEGREE}
    if isinstance(to, str) and to == "axes":
        _leave_out({**of_features, "mirror": mirror, "by": by != AlignBy.AUTO}, "to another map", "to='axes'")
        return align_to_axes(given)
    if by == AlignBy.VERTICES:
        _leave_out(of_features, "by features", "by='vertices'")
    moving, fixed = as_points(given, "the map"), as_points(to, "the template")
    if by == AlignBy.VERTICES and not _same_faces(moving, fixed):
        raise OmtwarpError("the two meshes have different faces: align them by features")
    one_surface = _why_one_surface(moving, fixed) if by == AlignBy.AUTO and not own else ""
    by_vertices = bool(one_surface) | (by == AlignBy.VERTICES)

    def aligned(points: SpherePoints, ours: Mapping[str, ArrayLike] = own) -> Alignment:
        if by_vertices:
            return _by_vertices(points, fixed)
        here, there = common_features(points, fixed, ours, theirs)
        if not here:
            return aligned_by_places(points, fixed)
        best = feature_rotations(points, fixed, here, there, degree, most=1)[0]
        turned = _own_turned(points, best.rotation)
        return Alignment(best.rotation, turned, "features", best.score, best.runner_up, False, basis=", ".join(here))

    alignment = aligned(moving)
    check = check and alignment.method == "features"
    image = aligned(mirror_image(moving)) if mirror or check else alignment
    if mirror and image.score > alignment.score:
        alignment = replace(image, rotation=image.rotation @ MIRROR, mirrored=True)
        moving = mirror_image(moving)
    if check:
        others = {"the mirror image fits better": image.score}
        for name, values in own.items():
            turned = own | {name: -np.asarray(values, dtype=np.float64)}
            others[f"feature '{name}' fits better with the other sign"] = aligned(moving, turned).score
        _warn_of_better(others, alignment.score)
    return replace(alignment, basis=one_surface) if one_surface else alignment


def _warn_of_better(others: dict[str, float], score: float) -> None:
    """Warn of everything that fits clearly better than what was taken, by what it is."""
    for words, other in others.items():
        # Difference of correlations: those of nearly symmetric shapes and their mirror images differ by less
        if other > score + 0.05:
            warnings.warn(f"{words}: score {other:.3f}, not {score:.3f}", OmtwarpWarning, stacklevel=3)


def _leave_out(options: Mapping[str, object], of: str, given: str) -> None:
    """Refuse options that alignments of one kind have, where another kind is asked for.

    Raises:
        OmtwarpError: one of them is given.
    """
    if wrong := [name for name, value in options.items() if value]:
        raise OmtwarpError(f"'{wrong[0]}' is of alignments {of}: leave it out with {given}")


def _same_faces(one: SpherePoints, other: SpherePoints) -> bool:
    """Return whether two spheres have the same triangles."""
    first, second = one.grid.triangles, other.grid.triangles
    return first.shape == second.shape and np.array_equal(first, second)


def _why_one_surface(moving: SpherePoints, fixed: SpherePoints) -> str:
    """Say why two spheres count as those of one surface with the same faces; empty where they do not."""
    if not _same_faces(moving, fixed):
        return ""
    if moving.vertices is None or fixed.vertices is None:
        return "equal faces, and a side is a sphere alone"
    ours, theirs = (points - points.mean(axis=0) for points in map(in_range, (moving.vertices, fixed.vertices)))
    ours, theirs = ours / max(np.linalg.norm(ours), TINY), theirs / max(np.linalg.norm(theirs), TINY)
    _, agreement = fitted_rotation(ours.T @ theirs)
    # The least squares of a rotation and a scale leave 1 - agreement² of the square.
    apart = np.sqrt(max(1.0 - agreement**2, 0.0))
    # Two surfaces with the same faces are taken as one where a similarity brings them this near, as a part of their
    # size: noise of a thousandth of the size at every vertex leaves 0.0045, another of the made hippocampi 0.026 or
    # more.
    return "equal faces, and one surface in both" if apart < 0.01 else ""


def _own_turned(points: SpherePoints, rotation: Floats) -> Floats:
    """Return a sphere's points, without those that fill holes, after a rotation."""
    return (points.grid.points @ rotation.T)[: points.grid.own_points]


def _by_vertices(moving: SpherePoints, fixed: SpherePoints) -> Alignment:
    weights = sphere_weights(fixed)
    rotation, agreement = fitted_rotation((moving.grid.points * weights[:, None]).T @ fixed.grid.points)
    turned, score = _own_turned(moving, rotation), agreement / float(weights.sum())
    return Alignment(rotation, turned, "vertices", score, -1.0, False, basis="equal faces, as asked for")


def feature_rotations(
    moving: SpherePoints,
    fixed: SpherePoints,
    ours: Mapping[str, Floats],
    theirs: Mapping[str, Floats],
    degree: int = DEGREE,
    *,
    most: int,
) -> list[Best]:
    """Find the rotations of a sphere at which its features agree best with another's, the best first.

    Args:
        moving, fixed: the two spheres.
        ours, theirs: their features, a number at every point.
        degree: the highest degree of the harmonics.
        most: how many rotations to return at most.

    Raises:
        OmtwarpError: a feature is constant.
    """
    a = complex_coefficients(feature_coefficients(ours, moving, degree))
    b = complex_coefficients(feature_coefficients(theirs, fixed, degree))
    rotations = best_rotations(a, b)[:most]
    if len(ours) > 1:  # all features determine the region; the exact rotation is that of the least noisy ones
        errors = np.hypot(coefficient_errors(ours, moving), coefficient_errors(theirs, fixed))
        weights = errors.min() / np.maximum(errors, np.finfo(float).tiny)
        rotations = [improved(a, b, best, weights) for best in rotations]
    return rotations


def aligned_by_places(moving: SpherePoints, fixed: SpherePoints) -> Alignment:
    """Align two maps so that their surfaces lie to each other as they do in space."""
    (ours, ours_score), (theirs, theirs_score) = _onto_directions(moving), _onto_directions(fixed)
    rotation = theirs.T @ ours
    basis = "directions in space, as a side has no features"
    score = min(ours_score, theirs_score)
    return Alignment(rotation, _own_turned(moving, rotation), "places", score, -1.0, False, basis=basis)


def _onto_directions(points: SpherePoints) -> tuple[Floats, float]:
    """Return the rotation of a sphere to the directions of its surface from the centre, and how well they agree."""
    assert points.vertices is not None  # of own_features
    masses = points.surface_areas()
    radial = normalised(points.vertices - masses @ points.vertices / masses.sum())
    rotation, agreement = fitted_rotation((points.grid.points * masses[:, None]).T @ radial)
    return rotation, agreement / float(masses.sum())


def common_features(
    moving: SpherePoints, fixed: SpherePoints, features: Mapping[str, ArrayLike], to_features: Mapping[str, ArrayLike]
) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return the features of both sides in the same order: the given ones that both have, or else the surfaces' own.

    Features of the surfaces' own that are constant on a side are left out, which may leave none.
    """
    if features and to_features:
        ours = filled_by_means(checked_features(features, moving, "the map"), moving)
        theirs = filled_by_means(checked_features(to_features, fixed, "the template"), fixed)
    else:
        ours, theirs = varying_features(moving), varying_features(fixed)
    names = [name for name in ours if name in theirs]
    return {name: ours[name] for name in names}, {name: theirs[name] for name in names}
