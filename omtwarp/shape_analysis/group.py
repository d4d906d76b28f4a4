"""A group of shapes: their mean, principal components, distances, and where two parts of the group differ."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.alignment import GroupAlignment, procrustes_mean
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.maps.result import MapResult
from omtwarp.mesh.surface import Surface, vertex_normals
from omtwarp.options import Progress
from omtwarp.resampling import as_points
from omtwarp.shape_analysis.distance import DEGREE, distance_matrix, transport_matrix

Floats = NDArray[np.float64]

PERMUTATIONS = 999  # the smallest p value is then 0.001


@dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """Independent directions in which shapes vary, the largest variation first.

    Attributes:
        deviations: standard deviation along each, in the surfaces' unit, root mean square over the sphere; shape [K].
        directions: displacement of every point of the mean for one of these units, float64, shape [K, V, 3].
        scores: of the shapes, in standard deviations, shape [N, K].
        explained: share of the whole variance, shape [K].
    """

    deviations: Floats
    directions: Floats
    scores: Floats
    explained: Floats


@dataclass(frozen=True, eq=False)
class GroupDifference:
    """Where two groups differ, point by point of the mean.

    Attributes:
        names: of the two groups.
        displacement: mean of the second less mean of the first, in the surfaces' unit, float64, shape [V, 3].
        outward: its part along the mean surface's normal, shape [V].
        statistic: Student's two-sample t of displacements along the normal, shape [V].
        p_values: share of the permutations whose largest t in size over all points is at least as large as that here:
            corrected for the number of points; shape [V].
    """

    names: tuple[str, str]
    displacement: Floats
    outward: Floats
    statistic: Floats
    p_values: Floats


@dataclass(frozen=True, eq=False)
class GroupStudy:
    """Findings about a group of shapes.

    Attributes:
        alignment: all shapes in one position with the same faces, and their mean.
        components: their principal components.
        distances: root mean square distances of all pairs, shape [N, N]; see
            :func:`omtwarp.shape_analysis.shape_distance`.
        from_mean: of each shape at the grid's points, shape [N].
        difference: of two groups, where labels were given; else None.
        transport: transport distances of all pairs in radians, shape [N, N], where they were asked for; else None.
    """

    alignment: GroupAlignment
    components: PrincipalComponents
    distances: Floats
    from_mean: Floats
    difference: GroupDifference | None
    transport: Floats | None = None

    @property
    def mean(self) -> Surface:
        """The mean shape."""
        return Surface(self.alignment.mean, self.alignment.faces)

    def along(self, component: int, deviations: float) -> Surface:
        """Move the mean shape along a component by a number of standard deviations.

        Raises:
            OmtwarpError: there is no component of this number.
        """
        known = self.components
        if not 0 <= component < len(known.deviations):
            raise OmtwarpError(f"there is no component {component}: there are {len(known.deviations)}, numbered from 0")
        moved = deviations * known.deviations[component] * known.directions[component]
        return Surface(self.alignment.mean + moved, self.alignment.faces)


def study_group(
    maps: Sequence[MapResult],
    labels: Sequence[str] | None = None,
    *,
    grid: str = "ico4",
    components: int = 5,
    scale: bool = False,
    degree: int = DEGREE,
    permutations: int = PERMUTATIONS,
    seed: int = 0,
    transport: bool = False,
    device: str | None = "auto",
    progress: Progress | None = None,
) -> GroupStudy:
    """Find the mean, the components, the distances and the differences of a group of shapes.

    Args:
        maps: at least two maps with their surfaces.
        labels: which of two groups each shape belongs to; no difference is sought without them.
        grid: a triangulated sphere by name, whose points are compared.
        components: the largest number of principal components.
        scale: scale shapes to the same size.
        degree: the highest degree of the harmonics in distances.
        permutations: number of random exchanges of labels for the test.
        seed: of these.
        transport: also measure the transport distances of all pairs (:func:`omtwarp.shape_analysis.shape_distance`);
            a pair of shapes with 700 vertices takes half a second.
        device: where surfaces are resampled and transport is computed.
        progress: called as ``progress(stage, done, total, {})`` with the stages ``align``, ``resample`` and
            ``transport``.

    Returns:
        The findings.

    Raises:
        OmtwarpError: fewer than two maps, labels that do not fit, or too few vertices for the degree.

    Warns:
        OmtwarpWarning: some shapes fit the first better as mirror images, as left sides fit right ones. They are
            compared as they are.

    Example:
        >>> import omtwarp
        >>> from omtwarp.shape_analysis import study_group
        >>> shapes = [omtwarp.shapes.hippocampus(seed, face_count=500) for seed in range(3)]
        >>> maps = [omtwarp.map_to_sphere(one, until="moser", device="cpu") for one in shapes]
        >>> study = study_group(maps, grid="ico3", degree=6, device="cpu")
        >>> study.mean, study.components.scores.shape
        (Surface(642 vertices, 1280 faces), (3, 2))
    """
    if components < 1 or permutations < 1:
        raise OmtwarpError(f"{components} components, {permutations} permutations: give at least 1 of each")
    names = None if labels is None else two_groups(labels, len(maps))
    # Highest degree of the features that spheres are aligned by: coarse form determines positions, detail varies. Tubes
    # that vary by 5 % end within 2 to 4 degrees of one another with degree 4.
    mean = procrustes_mean(maps, grid=grid, scale=scale, degree=4, device=device, progress=progress)
    if mean.mirrored.any():
        warnings.warn(mirrored_words(mean, [f"shape {k}" for k in range(len(maps))]), OmtwarpWarning, stacklevel=2)
    weights = as_points(grid, "the grid").grid.areas
    moved = mean.surfaces - mean.mean
    shares = weights / weights.sum()
    difference = None
    if labels is not None and names is not None:
        chosen = np.array([label == names[1] for label in labels])
        difference = group_difference(mean.surfaces, chosen, names, mean.faces, permutations, seed)
    whole = [one.closed() for one in maps]
    spheres = [one.sphere @ turn.T for one, turn in zip(whole, mean.rotations, strict=True)]
    return GroupStudy(
        mean,
        principal_components(moved, shares, components),
        distance_matrix(spheres, whole, degree, scale),
        np.sqrt(np.einsum("v,nvd->n", shares, moved**2)),
        difference,
        transport_matrix(maps, device=device, progress=progress) if transport else None,
    )


def mirrored_words(alignment: GroupAlignment, names: Sequence[str]) -> str:
    """Say which shapes of a group fit the first better as mirror images; empty where none does.

    Args:
        alignment: of the group.
        names: of its shapes, the first named first.
    """
    named = [name for name, mirrored in zip(names, alignment.mirrored, strict=True) if mirrored]
    if not named:
        return ""
    which = named[0] if len(named) == 1 else f"{len(named)} of {len(names)} shapes, first {named[0]},"
    fits, images = ("fits", "mirror image") if len(named) == 1 else ("fit", "mirror images")
    return (
        f"{which} {fits} {names[0]} better as {images}, and the difference counts as one of shape: mirror "
        "one side before, with 'omtwarp align MAP --to FIRST --mirror', to compare left and right"
    )


def two_groups(labels: Sequence[str], count: int) -> tuple[str, str]:
    """Return the names of two groups, in the order of the alphabet.

    Raises:
        OmtwarpError: labels are missing, there are not two groups, or they are too small to be compared.
    """
    fewest = 5  # shapes; with four there are six labellings, and no p value below a sixth
    if len(labels) != count:
        raise OmtwarpError(f"{len(labels)} labels for {count} maps")
    names = sorted(set(labels))
    if len(names) != 2 or "" in names:
        raise OmtwarpError(f"the groups are {', '.join(repr(n) for n in names[:5])}: differences need two, named")
    if count < fewest or min(list(labels).count(name) for name in names) < 2:
        raise OmtwarpError(f"too few shapes for a difference: at least {fewest}, and 2 in each group")
    return names[0], names[1]


def principal_components(moved: Floats, shares: Floats, most: int) -> PrincipalComponents:
    """Compute the principal components of shapes about their mean.

    Args:
        moved: shapes less their mean, shape [N, V, 3].
        shares: of the sphere that points represent, sum 1, shape [V].
        most: how many components; no more than N - 1 exist.
    """
    count = len(moved)
    roots = np.sqrt(shares)[:, None]
    left, values, right = np.linalg.svd((moved * roots).reshape(count, -1), full_matrices=False)
    kept = min(most, count - 1)
    directions = right[:kept].reshape(kept, -1, 3) / roots
    # The sign is free: the coordinate that moves most moves towards larger values.
    signs = np.sign([one.ravel()[np.argmax(np.abs(one))] for one in directions])
    total = max(float((values**2).sum()), np.finfo(float).tiny)
    return PrincipalComponents(
        values[:kept] / np.sqrt(count - 1),
        directions * signs[:, None, None],
        left[:, :kept] * signs * np.sqrt(count - 1),
        values[:kept] ** 2 / total,
    )


def group_difference(
    surfaces: Floats,
    chosen: NDArray[np.bool_],
    names: tuple[str, str],
    faces: NDArray[np.int32],
    permutations: int = PERMUTATIONS,
    seed: int = 0,
) -> GroupDifference:
    """Test at every point whether one group lies outside the other, by t and permutations of the labels.

    Displacements along the mean surface's normal are compared. Those within it are left out: where a part grows,
    an area-preserving map moves points along the surface everywhere.

    Args:
        surfaces: corresponding points, shape [N, V, 3].
        chosen: which shapes are of the second group, shape [N].
        names: of the groups.
        faces: of all surfaces, shape [F, 3].
        permutations: how many.
        seed: of the permutations.
    """
    normals = vertex_normals(surfaces.mean(axis=0), faces)
    heights = np.einsum("nvd,vd->nv", surfaces, normals)
    squared, p_values = hotelling(heights[:, :, None], chosen, permutations, seed)
    displacement = surfaces[chosen].mean(axis=0) - surfaces[~chosen].mean(axis=0)
    outward = (displacement * normals).sum(axis=1)
    return GroupDifference(names, displacement, outward, np.sign(outward) * np.sqrt(squared), p_values)


def hotelling(
    values: Floats, chosen: NDArray[np.bool_], permutations: int = PERMUTATIONS, seed: int = 0
) -> tuple[Floats, Floats]:
    """Compute Hotelling's two-sample T² at every point, and p values corrected for the number of points.

    The largest T² over all points is compared with that of permuted labels, so that the chance of any false finding is
    bounded [1]_. The scatter about the common mean does not depend on labels: in coordinates in which it is 1 the share
    q that the groups' means take of it is a length, and T² = (N - 2) q / (1 - q).

    Args:
        values: D numbers at every point, shape [N, V, D]; with D = 1, T² is the square of Student's t.
        chosen: which of the N are of the second group, shape [N].
        permutations: how many.
        seed: of the permutations.

    Returns:
        T² and p, shape [V] each.

    .. [1] T. E. Nichols, A. P. Holmes, "Nonparametric permutation tests for functional neuroimaging", Human Brain
       Mapping 15 (2002).
    """
    count, points, width = values.shape
    centred = values - values.mean(axis=0)
    scatter = np.einsum("nvi,nvj->vij", centred, centred)
    sizes, axes = np.linalg.eigh(scatter)
    # Scatter of a point below this part of the largest is round-off: there is no direction in which groups could
    # differ.
    real = sizes > 1e-10 * max(float(sizes.max()), np.finfo(float).tiny)
    scales = np.where(real, 1.0 / np.sqrt(np.where(real, sizes, 1.0)), 0.0)
    white = (np.einsum("nvi,vij->nvj", centred, axes) * scales[None]).reshape(count, -1)

    rng = np.random.default_rng(seed)
    second = int(chosen.sum())
    first = count - second
    observed, extremes = np.zeros(points), np.empty(permutations + 1)
    for k in range(permutations + 1):
        order = chosen if k == 0 else rng.permutation(chosen)
        apart = np.where(order, 1.0 / second, -1.0 / first) @ white
        share = first * second / count * (apart.reshape(points, width) ** 2).sum(axis=1)
        squared = (count - 2) * share / np.maximum(1.0 - share, np.finfo(float).eps)
        extremes[k] = squared.max()
        if k == 0:
            observed = squared
    # Equal up to round-off counts as at least as large.
    # Equal, relative: statistics of two permutations that differ by less are the same one, summed in another order
    p_values = (extremes[:, None] >= observed * (1.0 - 1e-9)).mean(axis=0)
    return observed, np.asarray(p_values)
