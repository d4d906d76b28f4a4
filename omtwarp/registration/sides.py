"""The two sides of a registration: points on the sphere and the features at them, and how well these agree."""

import functools
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.linalg import splu

from omtwarp.alignment.align import checked_features, feature_rotations, filled_by_means, sphere_weights
from omtwarp.alignment.rotation_search import Best
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.operators import cotangent_edge_weights
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, by_name, real_number
from omtwarp.registration.folding import folding_features
from omtwarp.registration.group_template import Template, is_template
from omtwarp.registration.warp import feature_grid
from omtwarp.resampling import SpherePoints, as_points, resample
from omtwarp.resampling.averages import average_surface, is_average, with_side
from omtwarp.resampling.resample import PointsLike
from omtwarp.solvers.poisson import edge_laplacian
from omtwarp.spheres import SphereGrid, mesh_grid

STARTS = 3  # rotations of each degree that a doubtful start is tried from


@dataclass(frozen=True, eq=False)
class Side:
    """Points on the sphere with features.

    Attributes:
        points: with what fills holes, N in all.
        features: by name, shape [N] each, or shorter by what fills holes; NaN where there is no number.
    """

    points: SpherePoints
    features: dict[str, Floats]

    def moved(self, sphere: Floats) -> "Side":
        """Return the same features at other places, unit vectors, shape [N, 3]."""
        return Side(self.points.moved(sphere), self.features)

    @property
    def own(self) -> dict[str, Floats]:
        """The features at the surface's own points, without those that fill holes, shape [V] each."""
        return {name: values[: self.points.grid.own_points] for name, values in self.features.items()}

    def at(self, places: SphereGrid) -> tuple[Floats, NDArray[np.bool_]]:
        """Return the features at points, shape [P, K], and at which of them all are known, shape [P].

        They are in no filled hole, nor where there is no number.
        """
        values = resample(self.points, places, device="cpu")
        columns = np.column_stack(list(self.features.values()))
        carried = values.apply(columns[: values.matrix.shape[1]])
        return carried, ~values.empty & np.isfinite(carried).all(axis=1)

    @functools.cached_property
    def on_grid(self) -> tuple[Floats, Floats]:
        """The features on the feature grid, shape [N, K], and 1 where they are known, 0 elsewhere, shape [N].

        There they go on from what is around, see :func:`continued`.
        """
        values, known = self.at(_grid())
        return continued(values, known), known.astype(np.float64)

    def rotations(self, target: "Side") -> tuple[list[Best], bool]:
        """Return the rotations at which the features agree best with a target's, and whether the best is doubtful.

        There are several where it is. They are found on the feature grid, which is finer than the harmonics.

        Raises:
            OmtwarpError: a feature is constant.
        """
        grid = SpherePoints(_grid())
        both = [np.where(side.on_grid[1][:, None] > 0.0, side.on_grid[0], np.nan) for side in (self, target)]
        ours, theirs = (filled_by_means(dict(zip(self.features, each.T, strict=True)), grid) for each in both)
        best = feature_rotations(grid, grid, ours, theirs, most=STARTS)
        # A best rotation whose correlation is not this much above the next best one's may be the wrong one.
        if best[0].score - best[0].runner_up >= 0.1:
            return best[:1], False
        # Then the best rotations of the lower degree are tried too: features that a warp moves by up to 30 degrees
        # still agree in their longest waves. Of two made cortices at 20 and 40 degrees degree 6 has the nearest
        # rotation among its two best each time, degree 16 once.
        return best + feature_rotations(grid, grid, ours, theirs, 6, most=STARTS), True

    def agreement(self, target: "Side") -> dict[str, float]:
        """Return the correlation of every feature at the points of a target, by their cells, where both know all."""
        there = target.points
        values, known = self.at(there.grid)
        count = there.grid.own_points
        theirs = np.column_stack([target.features[name][:count] for name in self.features])
        known = known[:count] & np.isfinite(theirs).all(axis=1)
        weights = sphere_weights(there)[:count][known]
        weights /= weights.sum()
        correlations = {}
        for name, *both in zip(self.features, values[:count][known].T, theirs[known].T, strict=True):
            a, b = (column - weights @ column for column in both)
            correlations[name] = float((weights * a) @ b / np.sqrt(((weights * a) @ a) * ((weights * b) @ b)))
        return correlations


def continued(values: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return values on the feature grid, shape [N, K], where they are not known as the harmonic function from the rest.

    Unlike a constant that has no step at the edge, which features would be drawn to.
    """
    if known.all() or not known.any():
        return values
    grid = feature_grid()
    laplacian = edge_laplacian(grid.edges, cotangent_edge_weights(grid, grid.vertices), grid.vertex_count)[~known]
    out = values.copy()
    out[~known] = splu(laplacian[:, ~known].tocsc()).solve(-(laplacian[:, known] @ values[known]))
    return out


def _grid() -> SphereGrid:
    grid = feature_grid()
    return mesh_grid(grid.vertices, grid.faces)


Given = Mapping[str, ArrayLike] | None


def two_sides(
    moving: PointsLike, target: PointsLike | Template, features: Given, to_features: Given
) -> tuple[Side, Side]:
    """Return both sides with the same features in the same order: those given, or the folding of the surfaces.

    A template's own take the place of the target's where these are not given.

    Raises:
        OmtwarpError: something that is no map or sphere, names or lengths that do not fit, or a sphere without its
            surface.
    """
    features, to_features = by_name(features, "features"), by_name(to_features, "to_features")
    here = as_points(moving, "the map")
    if isinstance(target, str) and not features:
        target = with_side(target, moving.report.get("structure") if isinstance(moving, MapResult) else None)
    there, known = target_points(target)
    to_features = known if known and features and not to_features else to_features
    if set(features) != set(to_features):
        raise OmtwarpError("features have to be given for both sides, with the same names")
    if features and to_features:
        ours, theirs = checked_features(features, here, "the map"), checked_features(to_features, there, "the target")
    else:
        ours = folds(here, here.grid.name)
        theirs = folds(there, there.grid.name) if known is None else dict(known)
        if set(theirs) != set(ours):
            raise OmtwarpError(f"the template has the features {', '.join(theirs)}: give the map's of these names")
    return Side(here, ours), Side(there, {name: theirs[name] for name in ours})


def folds(points: SpherePoints, name: str) -> dict[str, Floats]:
    """Return sulcal depth and curvature of a surface by :func:`omtwarp.registration.folding_features`.

    Raises:
        OmtwarpError: there is a sphere alone.
    """
    if points.vertices is None:
        raise OmtwarpError(f"{name}: a sphere without its surface has no folds: give the surface, or features")
    return folding_features(points.vertices, points.grid.triangles)


def target_points(target: PointsLike | Template) -> tuple[SpherePoints, dict[str, Floats] | None]:
    """Return the points of a target, which may be a template, the name of one or its file, and features it has.

    Raises:
        OmtwarpError: it is no target of these kinds.
    """
    if isinstance(target, str | os.PathLike) and is_template(target):
        target = Template.load(target)
    if isinstance(target, Template):
        return target.sphere(), target.by_name()
    if isinstance(target, str) and is_average(target):
        return replace(as_points(target), vertices=average_surface(target)), None
    return as_points(target, "the target"), None


def feature_weights_of(features: Mapping[str, Floats], given: Mapping[str, float]) -> Floats:
    """Return the weights of the features in their order, shape [K]; 1 where none is given.

    Raises:
        OmtwarpError: a name that is no feature's, or a weight that is no number from 0 on.
    """
    if unknown := [name for name in given if name not in features]:
        raise OmtwarpError(f"there is no feature '{unknown[0]}' to weight: use {', '.join(features)}")
    weights = [real_number(given.get(name, 1.0), f"the weight of '{name}'", least=0.0) for name in features]
    if not any(weights):
        raise OmtwarpError("all weights of features are 0: nothing determines the registration")
    return np.array(weights)
