"""A group of shapes: their mean, principal components, distances, and where its parts differ."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from omtwarp.alignment import GroupAlignment, procrustes_mean
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats
from omtwarp.mesh.surface import Surface, vertex_normals
from omtwarp.options import Progress
from omtwarp.resampling import as_points
from omtwarp.shape_analysis.distance import DEGREE, distance_matrix, transport_matrix
from omtwarp.shape_analysis.linear_model import PERMUTATIONS, Effect, check_table, linear_effects

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
    if components < 1 or permutations < 1:
        raise OmtwarpError(f"{components} components, {permutations} permutations: give at least 1 of each")
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
    normals = vertex_normals(mean.surfaces.mean(axis=0), mean.faces)
    heights = np.einsum("nvd,vd->nv", mean.surfaces, normals)
    effects = linear_effects(heights, table, factors=GROUP, permutations=permutations, seed=seed) if table else {}
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
        OmtwarpError: a covariate has the name of the labels.
    """
    table: dict[str, Sequence[object]] = {} if labels is None else {GROUP[0]: labels}
    twice = next((name for name in covariates or {} if name in table), None)
    if twice is not None:
        raise OmtwarpError(f"'{twice}' is the column of groups already: give other covariates")
    return {**table, **(covariates or {})}


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
