"""A linear model at every point of a group of shapes, tested by permutations."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import false_discovery_control

from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats

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
    found = {}
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
            found[name] = np.array([[float(text == level) for level in levels[1:]] for text in texts]), levels
            continue
        if not np.isfinite(numbers).all():
            raise OmtwarpError(f"column '{name}' has a number that is not finite")
        if np.ptp(numbers) == 0.0:
            raise OmtwarpError(f"column '{name}' is {numbers[0]:g} in all rows: it explains no difference")
        found[name] = numbers[:, None], ()
    return found


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
        values: of N shapes at V points, shape [N, V], or D each, shape [N, V, D].
        table: columns by name, N values each: numbers as they are, words as factors.
        factors: columns whose numbers are words too, such as those of sites.
        permutations: how many; the smallest p is 1 over one more.
        seed: of the permutations, the same for every column.

    Returns:
        The effect of each column.

    Raises:
        OmtwarpError: a missing value, a column that is constant or that others determine, or too few shapes.

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
    given = np.asarray(values, dtype=np.float64)
    given = given[:, :, None] if given.ndim == 2 else given
    if permutations < 1:
        raise OmtwarpError(f"{permutations} permutations: give at least 1")
    columns = check_table(table, len(given), factors, given.shape[2])
    found = {}
    for name, (tested, levels) in columns.items():
        others = [numbers for other, (numbers, _) in columns.items() if other != name]
        nuisance = np.column_stack([np.ones(len(given)), *others])
        squares, size, p_values, fdr = _tested(given, tested, nuisance, permutations, seed)
        shown = None if size is None else size if size.shape[1] > 1 else size[:, 0]
        signed = shown is not None and shown.ndim == 1
        statistic = np.sign(shown) * np.sqrt(squares) if signed and shown is not None else squares
        found[name] = Effect(name, levels, shown, statistic, signed, p_values, fdr)
    return found


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
        rare = next((one for one in levels if [str(value).strip() for value in table[name]].count(one) < 2), None)
        if rare is not None:
            raise OmtwarpError(f"too few shapes with '{rare}' in column '{name}': 1, at least 2")
        others = np.column_stack([np.ones(count), *(c for other, (c, _) in columns.items() if other != name)])
        rank = np.linalg.matrix_rank(_scaled(np.column_stack([others, numbers])))
        if rank < others.shape[1] + numbers.shape[1]:
            raise OmtwarpError(f"column '{name}' follows from the other columns: leave one of them out")
    return columns


def _scaled(columns: Floats) -> Floats:
    """Return columns of length 1, all but the first with mean 0, so that units do not count."""
    centred = np.column_stack([columns[:, 0], columns[:, 1:] - columns[:, 1:].mean(axis=0)])
    return np.asarray(centred / np.linalg.norm(centred, axis=0))


def _tested(
    values: Floats, tested: Floats, nuisance: Floats, permutations: int, seed: int
) -> tuple[Floats, Floats | None, Floats, Floats]:
    """Return the statistic, the size for one tested column, p corrected by the largest, and by the rate of discoveries.

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
    size = None
    if tested.shape[1] == 1:
        size = (left.T @ residuals / (left**2).sum()).reshape(points, width)
    shaped = residuals.reshape(count, points, width)
    scales, axes = np.linalg.eigh(np.einsum("nvi,nvj->vij", shaped, shaped))
    # Scatter of a point below this part of the largest is round-off: there is nothing to be explained.
    real = scales > 1e-10 * max(float(scales.max()), np.finfo(float).tiny)
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
    return observed, size, np.asarray(p_values), np.asarray(false_discovery_control(larger / (permutations + 1)))
