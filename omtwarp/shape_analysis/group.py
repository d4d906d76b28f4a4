"""A group of shapes: their mean, principal components and distances, and where its parts differ, point by point.

Differences are those of a linear model at every point, tested by permutations.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import false_discovery_control

from omtwarp.alignment import GroupAlignment, procrustes_mean
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, by_name, listed, real_numbers, whole_number
from omtwarp.mesh.surface import Surface, vertex_normals
from omtwarp.options import Progress
from omtwarp.resampling import as_points
from omtwarp.shape_analysis.distance import DEGREE, distance_matrix, transport_matrix

PERMUTATIONS = 999  # the smallest p value is then 0.001


@dataclass(frozen=True, eq=False)
class Effect:
    """The effect of one column of a group's table, given all others, point by point.

    Attributes:
        name: of the column.
        levels: what a column of words holds, in the order of the alphabet; empty for one of numbers.
        size: of numbers the change for 1 more, of two words that from the first to the second; shape [V] (or [V, D] for
            D values at a point). None for more than two words.
        statistic: Student's t, or Fisher's F for more than two words, of one value at a point; of several Hotelling's
            T², or its form for more than two words, E⁻¹ H's trace times the degrees of freedom of E over those of H.
        signed: whether the statistic is t.
        p_values: share of the permutations whose largest statistic in size over all points is at least as large as that
            here: corrected for the number of points; shape [V].
        fdr: Benjamini and Hochberg's corrected p of the share of permutations with a statistic at least as large at the
            same point: of the points with at most q, q are expected to be false findings; shape [V].
    """

    name: str
    levels: tuple[str, ...]
    size: Floats | None
    statistic: Floats
    signed: bool
    p_values: Floats
    fdr: Floats


def columns_of(
    table: Mapping[str, Sequence[object]], factors: Collection[str] = ()
) -> dict[str, tuple[Floats, tuple[str, ...]]]:
    """Return the columns of a linear model for each column of a table: numbers as they are, words as factors.

    Args:
        table: a value for each of N shapes in every column.
        factors: columns whose numbers are words too.

    Returns:
        By name the model's columns, shape [N, q], and the words, of which the first has none.

    Raises:
        OmtwarpError: a value is missing, or all are equal.
    """
    columns = {}
    for name, values in table.items():
        texts = ["" if value is None else str(value).strip() for value in values]
        for k, text in enumerate(texts):
            if text.lower() in ("", "nan", "na", "n/a"):
                raise OmtwarpError(f"column '{name}' has no value in row {k + 1} of {len(texts)}")
        levels = tuple(sorted(set(texts)))
        if len(levels) < 2:
            raise OmtwarpError(f"column '{name}' is '{levels[0]}' in all rows: it explains no difference")
        try:
            numbers = np.array([float(text if name not in factors else "word") for text in texts])
        except ValueError:
            columns[name] = np.array([[float(text == level) for level in levels[1:]] for text in texts]), levels
            continue
        if not np.isfinite(numbers).all():
            raise OmtwarpError(f"column '{name}' has a number that is not finite")
        if np.ptp(numbers) == 0.0:
            raise OmtwarpError(f"column '{name}' is {numbers[0]:g} in all rows: it explains no difference")
        columns[name] = numbers[:, None], ()
    return columns


def linear_effects(
    values: ArrayLike,
    table: Mapping[str, Sequence[object]],
    *,
    factors: Collection[str] = (),
    permutations: int = PERMUTATIONS,
    seed: int = 0,
) -> dict[str, Effect]:
    """Test what every column of a table explains at every point beyond all other columns.

    Residuals of the model without the column are permuted (Freedman and Lane [1]_), so that the others may be
    correlated with it; with one column alone labels are exchanged. The largest statistic of all points corrects for
    their number [2]_.

    Args:
        values: of N shapes at V points, shape [N, V], or D each, shape [N, V, D]. A point at which one is not finite or
            masked is not tested: what is found there is NaN.
        table: columns by name, N values each: numbers as they are, words as factors.
        factors: columns whose numbers are words too, such as those of sites.
        permutations: how many; the smallest p is 1 over one more.
        seed: of the permutations, the same for every column.

    Returns:
        The effect of each column.

    Raises:
        OmtwarpError: values that are no real numbers or of another shape, or none at all; a missing value, a column
            that is constant or that others determine, or factors that are no column; or too few shapes.

    Example:
        >>> import numpy as np
        >>> from omtwarp.shape_analysis import linear_effects
        >>> age = np.arange(20.0)
        >>> values = np.random.default_rng(1).normal(size=(20, 4)) + age[:, None] * [0.0, 0.0, 0.0, 2.0]
        >>> found = linear_effects(values, {"age": age, "sex": ["f", "m"] * 10}, permutations=99)
        >>> np.flatnonzero(found["age"].p_values <= 0.05), int((found["sex"].p_values <= 0.05).sum())
        (array([3]), 0)

    .. [1] A. M. Winkler, G. R. Ridgway, M. A. Webster, S. M. Smith, T. E. Nichols, "Permutation inference for the
       general linear model", NeuroImage 92 (2014).
    .. [2] T. E. Nichols, A. P. Holmes, "Nonparametric permutation tests for functional neuroimaging", Human Brain
       Mapping 15 (2002).
    """
    numbers = np.ma.filled(values.astype(np.float64), np.nan) if isinstance(values, np.ma.MaskedArray) else values
    given = real_numbers(numbers, "values", None, finite=False, truths=True)
    if given.ndim not in (2, 3):
        raise OmtwarpError(f"values of shapes have the shape [N, V] or [N, V, D], not {list(given.shape)}")
    given = given[:, :, None] if given.ndim == 2 else given
    known = np.asarray(np.isfinite(given).all(axis=(0, 2)))
    if not known.any():
        raise OmtwarpError("there is no point at which the values of all shapes are known")
    permutations, seed = whole_number(permutations, "permutations", least=1), whole_number(seed, "the seed")
    columns = check_table(table, len(given), factors, given.shape[2])
    if unknown := [name for name in factors if name not in columns]:
        raise OmtwarpError(f"the table has no column '{unknown[0]}', which the factors name")
    effects = {}
    for name, (tested, levels) in columns.items():
        others = [numbers for other, (numbers, _) in columns.items() if other != name]
        nuisance = np.column_stack([np.ones(len(given)), *others])
        found, sizes = _tested(given[:, known], tested, nuisance, permutations, seed)
        squares, p_values, fdr = (_at(known, one) for one in found)
        shown = None if sizes is None else _at(known, sizes if sizes.shape[1] > 1 else sizes[:, 0])
        signed = shown is not None and shown.ndim == 1
        statistic = np.sign(shown) * np.sqrt(squares) if signed and shown is not None else squares
        effects[name] = Effect(name, levels, shown, statistic, signed, p_values, fdr)
    return effects


def _at(known: NDArray[np.bool_], found: Floats) -> Floats:
    """Return what was found at the points known, NaN at all others."""
    whole = np.full((len(known), *found.shape[1:]), np.nan)
    whole[known] = found
    return whole


def check_table(
    table: Mapping[str, Sequence[object]], count: int, factors: Collection[str] = (), width: int = 1
) -> dict[str, tuple[Floats, tuple[str, ...]]]:
    """Return :func:`columns_of` a table, and refuse one that cannot be tested with so many shapes.

    Args:
        table: columns by name.
        count: of shapes.
        factors: columns whose numbers are words too.
        width: values at every point.

    Raises:
        OmtwarpError: as :func:`linear_effects`.
    """
    table = {name: listed(column, f"column '{name}'", "values") for name, column in by_name(table, "the table").items()}
    for name, values in table.items():
        if len(values) != count:
            raise OmtwarpError(f"column '{name}' has {len(values)} values for {count} shapes")
    columns = columns_of(table, factors)
    model = np.column_stack([np.ones(count), *(numbers for numbers, _ in columns.values())])
    # Fewest: with four shapes in two groups there are six labellings, and no p value below a sixth
    fewest = max(5, model.shape[1] + 1 + width)
    if count < fewest:
        raise OmtwarpError(f"too few shapes for a model of {model.shape[1]} columns: {count}, at least {fewest}")
    for name, (numbers, levels) in columns.items():
        if rare := [one for one in levels if [str(value).strip() for value in table[name]].count(one) < 2]:
            raise OmtwarpError(f"too few shapes with '{rare[0]}' in column '{name}': 1, at least 2")
        others = np.column_stack([np.ones(count), *(c for other, (c, _) in columns.items() if other != name)])
        whole, rest = (np.linalg.matrix_rank(_scaled(part)) for part in (model, others))
        if whole < rest + numbers.shape[1]:
            raise OmtwarpError(f"column '{name}' follows from the other columns: leave one of them out")
    return columns


def _scaled(columns: Floats) -> Floats:
    """Return columns of length 1, all but the first with mean 0, so that units do not count."""
    centred = np.column_stack([columns[:, 0], columns[:, 1:] - columns[:, 1:].mean(axis=0)])
    return np.asarray(centred / np.linalg.norm(centred, axis=0))


def _tested(
    values: Floats, tested: Floats, nuisance: Floats, permutations: int, seed: int
) -> tuple[tuple[Floats, Floats, Floats], Floats | None]:
    """Return statistic, p corrected by the largest, and by the rate of discoveries; and the size for one tested column.

    The scatter of residuals of the smaller model does not depend on their order: in coordinates in which it is 1 every
    permutation takes two products of small matrices.
    """
    count, points, width = values.shape
    kept = np.linalg.qr(_scaled(nuisance))[0]
    left = tested - tested.mean(axis=0)
    left = left - kept @ (kept.T @ left)
    added = np.linalg.qr(left)[0]
    residuals = values.reshape(count, -1)
    residuals = residuals - kept @ (kept.T @ residuals)
    size = (left.T @ residuals / (left**2).sum()).reshape(points, width) if tested.shape[1] == 1 else None
    # Residuals of a point below this part of its values are round-off: there is nothing to be explained.
    sizes = np.linalg.norm(residuals, axis=0)
    residuals = np.where(sizes > 1e-12 * np.linalg.norm(values.reshape(count, -1), axis=0), residuals, 0.0)
    shaped = (residuals / np.where(sizes > 0.0, sizes, 1.0)).reshape(count, points, width)  # units do not count
    scales, axes = np.linalg.eigh(np.einsum("nvi,nvj->vij", shaped, shaped))
    # Scatter in a direction below this part of the point's largest is that of columns that follow from others.
    real = scales > 1e-10 * np.maximum(scales.max(axis=1, keepdims=True), np.finfo(float).tiny)
    inverse = np.where(real, 1.0 / np.sqrt(np.where(real, scales, 1.0)), 0.0)
    white = (np.einsum("nvi,vij->nvj", shaped, axes) * inverse).reshape(count, -1)
    first, freedom = kept.shape[1], count - kept.shape[1] - added.shape[1]
    # Of 1, so that what is explained to round-off has a statistic too
    unit = np.eye(width) * (1.0 + 1e-12)
    directions = np.column_stack([kept, added])
    rng = np.random.default_rng(seed)
    observed, extremes, larger = np.zeros(points), np.empty(permutations + 1), np.zeros(points)
    for k in range(permutations + 1):
        order = np.arange(count) if k == 0 else rng.permutation(count)
        parts = (directions[order].T @ white).reshape(-1, points, width)
        explained = parts[first:]
        scatter = unit - np.einsum("pvi,pvj->vij", parts, parts)
        solved = np.linalg.solve(scatter, explained.transpose(1, 2, 0))
        statistic = freedom / len(explained) * np.maximum(np.einsum("vik,kvi->v", solved, explained), 0.0)
        if k == 0:
            # Equal, relative: statistics of two permutations that differ by less are the same one, summed differently
            observed, least = statistic, statistic * (1.0 - 1e-9)
        larger += statistic >= least
        extremes[k] = statistic.max()
    p_values = (extremes[:, None] >= least).mean(axis=0)
    return (observed, np.asarray(p_values), np.asarray(false_discovery_control(larger / (permutations + 1)))), size


GROUP = ("group",)  # the column of labels, whose numbers are names too


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
class GroupStudy:
    """Findings about a group of shapes.

    Attributes:
        alignment: all shapes in one position with the same faces, and their mean.
        components: their principal components.
        distances: root mean square distances of all pairs, shape [N, N]; see
            :func:`omtwarp.shape_analysis.shape_distance`.
        from_mean: of each shape at the grid's points, shape [N].
        effects: of the groups, where labels were given, and of every covariate, on displacements along the mean
            surface's normal, in the surfaces' unit, outwards positive.
        transport: transport distances of all pairs in radians, shape [N, N], where they were asked for; else None.
    """

    alignment: GroupAlignment
    components: PrincipalComponents
    distances: Floats
    from_mean: Floats
    effects: dict[str, Effect]
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
    covariates: Mapping[str, Sequence[object]] | None = None,
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
        labels: which of two or more groups each shape belongs to.
        covariates: what else may explain differences, by name, a value for each shape: numbers as they are, words as
            factors. Each, and the groups, are tested given all others (:func:`linear_effects`); displacements within
            the surface are left out: where a part grows, an area-preserving map moves points along it everywhere.
        grid: a triangulated sphere by name, whose points are compared.
        components: the largest number of principal components.
        scale: scale shapes to the same size.
        degree: the highest degree of the harmonics in distances.
        permutations: number of random orders for the tests.
        seed: of these.
        transport: also measure the transport distances of all pairs (:func:`omtwarp.shape_analysis.shape_distance`);
            a pair of shapes with 700 vertices takes half a second.
        device: where surfaces are resampled and transport is computed.
        progress: called as ``progress(stage, done, total, {})`` with the stages ``align``, ``resample`` and
            ``transport``.

    Returns:
        The findings.

    Raises:
        OmtwarpError: fewer than two maps, labels or covariates that :func:`linear_effects` refuses, or too few vertices
            for the degree.

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
    maps = listed(maps, "maps", "omtwarp.MapResult", MapResult)
    components = whole_number(components, "components", least=1)
    permutations, seed = whole_number(permutations, "permutations", least=1), whole_number(seed, "the seed")
    table = table_of(labels, covariates)
    if table:
        check_table(table, len(maps), GROUP)
    # Highest degree of the features that spheres are aligned by: coarse form determines positions, detail varies. Tubes
    # that vary by 5 % end within 2 to 4 degrees of one another with degree 4.
    mean = procrustes_mean(maps, grid=grid, scale=scale, degree=4, device=device, progress=progress)
    if mean.mirrored.any():
        warnings.warn(mirrored_words(mean, [f"shape {k}" for k in range(len(maps))]), OmtwarpWarning, stacklevel=2)
    weights = as_points(grid, "the grid").grid.areas
    moved = mean.surfaces - mean.mean
    shares = weights / weights.sum()
    heights = np.einsum("nvd,vd->nv", mean.surfaces, vertex_normals(mean.surfaces.mean(axis=0), mean.faces))
    factors = table.keys() & GROUP
    effects = linear_effects(heights, table, factors=factors, permutations=permutations, seed=seed) if table else {}
    whole = [one.closed() for one in maps]
    spheres = [one.sphere @ turn.T for one, turn in zip(whole, mean.rotations, strict=True)]
    return GroupStudy(
        mean,
        principal_components(moved, shares, components),
        distance_matrix(spheres, whole, degree, scale),
        np.sqrt(np.einsum("v,nvd->n", shares, moved**2)),
        effects,
        transport_matrix(maps, device=device, progress=progress) if transport else None,
    )


def table_of(
    labels: Sequence[str] | None, covariates: Mapping[str, Sequence[object]] | None
) -> dict[str, Sequence[object]]:
    """Return the columns of a group's linear model: its labels, if any, and the covariates.

    Raises:
        OmtwarpError: covariates are no mapping, or one has the name of the labels.
    """
    given = by_name(covariates, "covariates")
    if labels is not None and GROUP[0] in given:
        raise OmtwarpError(f"'{GROUP[0]}' is the column of groups already: give other covariates")
    return ({} if labels is None else {GROUP[0]: labels}) | given


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
        "one side before, by align with mirror=True, to compare left and right"
    )


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
    return PrincipalComponents(
        values[:kept] / np.sqrt(count - 1),
        directions * signs[:, None, None],
        left[:, :kept] * signs * np.sqrt(count - 1),
        values[:kept] ** 2 / max(float((values**2).sum()), np.finfo(float).tiny),
    )
