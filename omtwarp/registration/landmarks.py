"""Landmarks: points and curves that are known to correspond, as a term of the energy of registration."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError, naming
from omtwarp.files.inputs import table_rows, table_text
from omtwarp.location import Locator
from omtwarp.mesh.arrays import TINY, Floats, listed, normalised, norms, real_number, real_numbers, whole_numbers
from omtwarp.mesh.surface import Surface
from omtwarp.registration.warp_shape import VertexDerivatives, VertexTerm

ROUNDS = 20  # of pulling exact landmarks on
SIDES = ("moving", "target")


@dataclass(frozen=True, eq=False)
class Landmark:
    """A point or a curve that is known on both sides.

    Attributes:
        label: its name.
        moving: on the map: numbers of vertices, shape [P], or points of its sphere, shape [P, 3]. More than one are a
            curve, in order.
        target: the same on the other sphere; a curve may have another number of points there.
        weight: of the mean square of the distance in radians that is left, against distortion and features; infinite
            where none is to be left.
    """

    label: str
    moving: ArrayLike
    target: ArrayLike
    weight: float = 3.0


LandmarksLike = Sequence[Landmark] | str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points that are to meet: those of all landmarks in a row.

    Attributes:
        labels: of the landmarks.
        owners: which landmark each point is of, shape [P].
        points: on the sphere that moves, unit vectors, shape [P, 3].
        places: where they are to come to, unit vectors, shape [P, 3].
        weights: of their squared distances; infinite where they are to meet, shape [P].
    """

    labels: tuple[str, ...]
    owners: NDArray[np.int64]
    points: Floats
    places: Floats
    weights: Floats

    @property
    def exact(self) -> NDArray[np.bool_]:
        """Which are to meet, shape [P]."""
        return np.isinf(self.weights)

    def turned(self, rotation: Floats) -> Pairs:
        """Return the same landmarks with the moving points rotated."""
        return Pairs(self.labels, self.owners, self.points @ rotation.T, self.places, self.weights)

    def distances(self, images: Floats) -> dict[str, float]:
        """Return how far landmarks are from their places, in degrees, root mean square over curves."""
        angles = np.degrees(2.0 * np.arcsin(np.clip(0.5 * norms(images - self.places), 0.0, 1.0)))
        squares = np.bincount(self.owners, angles**2) / np.bincount(self.owners)
        return {label: float(np.sqrt(square)) for label, square in zip(self.labels, squares, strict=True)}


def pairs_of(landmarks: LandmarksLike, moving: Floats, target: Floats, counts: tuple[int, int]) -> Pairs:
    """Return the points of landmarks that are to meet; those of curves at equal shares of their length.

    Args:
        landmarks: or a file of :func:`read_landmarks`.
        moving, target: the vertices of both spheres, unit vectors.
        counts: how many of these may be named, the first ones.

    Raises:
        OmtwarpError: no landmark, two of one name, vertices that do not exist, or a point beside a curve.
    """
    rows = read_landmarks(landmarks) if isinstance(landmarks, str | os.PathLike) else landmarks
    given = listed(rows, "landmarks", "omtwarp.registration.Landmark", Landmark)
    if not given:
        raise OmtwarpError("there are no landmarks: give at least one, or none at all")
    labels = tuple(str(one.label) for one in given)
    if twice := [label for label in labels if labels.count(label) > 1]:
        raise OmtwarpError(f"two landmarks are called '{twice[0]}'")
    meeting = []  # of each landmark its number, both sides' points and their weights
    for k, one in enumerate(given):
        ours = _on_sphere(one.moving, moving, counts[0], f"landmark '{one.label}' on the map")
        theirs = _on_sphere(one.target, target, counts[1], f"landmark '{one.label}' on the target")
        if (len(ours) == 1) != (len(theirs) == 1):
            raise OmtwarpError(f"landmark '{one.label}' is a point on one side and a curve on the other")
        count = max(len(ours), len(theirs))
        share = _positive(one.weight, f"weight of '{one.label}'") / count
        meeting.append((np.full(count, k), _even(ours, count), _even(theirs, count), np.full(count, share)))
    return Pairs(labels, *map(np.concatenate, zip(*meeting, strict=True)))


def _positive(weight: float, name: str) -> float:
    """Return a weight, infinite or a finite number above 0.

    Raises:
        OmtwarpError: it is something else.
    """
    return weight if weight == np.inf else real_number(weight, name, above=0.0)


def _on_sphere(given: ArrayLike, sphere: Floats, count: int, name: str) -> Floats:
    """Return the points of one side of a landmark, unit vectors, shape [P, 3].

    Raises:
        OmtwarpError: no points, vertices that do not exist, or points at the centre.
    """
    array = real_numbers(given, name, None)
    if array.ndim < 2:
        points = sphere[whole_numbers(np.atleast_1d(array), name, (None,), below=count)]
    else:
        points = real_numbers(array, name, (None, 3))
    if len(points) == 0:
        raise OmtwarpError(f"{name} has no points")
    if norms(points).min() < TINY:
        raise OmtwarpError(f"{name} has a point at the centre of the sphere")
    return normalised(points)


def _even(curve: Floats, count: int) -> Floats:
    """Return so many points at equal shares of the length of a curve, from its first point to its last."""
    if len(curve) == 1:
        return curve
    ways = np.concatenate([[0.0], np.cumsum(norms(np.diff(curve, axis=0)))])
    shares = np.linspace(0.0, ways[-1], count)
    return normalised(np.column_stack([np.interp(shares, ways, column) for column in curve.T]))


class LandmarkTerm:
    """Σ_i weight_i |y_i - place_i|², y_i where a warp of a grid takes point i, linearly in its triangle.

    It is a :class:`omtwarp.registration.warp_shape.VertexTerm`. A square of a mean of three corners' moves is at most
    the mean of their squares, with the same weights: that bound is the matrix. Points that are to meet their places are
    pulled past them, by what is left after each minimisation more: the method of multipliers.

    Args:
        pairs: the points and places.
        grid: the sphere that is warped.
        scale: what the weights of landmarks that are not exact are multiplied by.
    """

    def __init__(self, pairs: Pairs, grid: Surface, scale: float):
        stiff = 30.0  # of exact landmarks, of the mean distortion: a round leaves about a third of the distance
        place = Locator(grid.vertices, grid.faces, device="cpu").find(pairs.points)
        self._corners, self._shares = grid.faces[place.faces], place.coordinates
        self._places, self._exact, self._pull = pairs.places, pairs.exact, pairs.places
        self._weights = np.where(pairs.exact, stiff, scale * np.where(pairs.exact, 0.0, pairs.weights))
        self._rounds, self._last = 0, np.inf

    def pulled_on(self, points: Floats) -> bool:
        """Pull exact landmarks on from where a warp, unit vectors, shape [V, 3], took them; say whether any is away.

        After ``ROUNDS``, and where a round no longer brings them nearer, none is pulled.
        """
        met = 1e-5  # radians that exact landmarks are left apart at most
        left = np.where(self._exact[:, None], self._places - self._images(points)[0], 0.0)
        farthest = float(norms(left).max())
        if farthest < met or self._rounds == ROUNDS or farthest > 0.9 * self._last:
            return False
        self._rounds, self._last, self._pull = self._rounds + 1, farthest, self._pull + left
        return True

    def _images(self, points: Floats) -> tuple[Floats, Floats]:
        """Return where a warp takes the points, shape [P, 3], and their lengths before they are scaled, [P, 1]."""
        sums = np.einsum("pk,pkd->pd", self._shares, points[self._corners])
        lengths = norms(sums)[..., None]
        return sums / lengths, lengths

    def at(self, points: Floats) -> VertexDerivatives:
        """Return the term and its derivatives at a warp, unit vectors, shape [V, 3]."""
        images, lengths = self._images(points)
        apart = images - self._pull
        value = float(self._weights @ (apart**2).sum(axis=1))
        across = np.eye(3) - images[:, :, None] * images[:, None, :]
        pulls = 2.0 * np.einsum("p,pde,pe->pd", self._weights / lengths[:, 0], across, apart)
        blocks = 2.0 * (self._weights / lengths[:, 0] ** 2)[:, None, None] * across
        gradient, hessian = np.zeros_like(points), np.zeros((len(points), 3, 3))
        np.add.at(gradient, self._corners, self._shares[:, :, None] * pulls[:, None, :])
        np.add.at(hessian, self._corners, self._shares[:, :, None, None] * blocks[:, None])
        return VertexDerivatives(value, gradient, hessian)


class TermSum:
    """The sum of terms at vertices, itself one."""

    def __init__(self, terms: Sequence[VertexTerm]):
        self._terms = terms

    def at(self, points: Floats) -> VertexDerivatives:
        """Return the sum and its derivatives at a map, unit vectors, shape [V, 3]."""
        derivatives = [term.at(points) for term in self._terms]
        gradient, hessian = sum(one.gradient for one in derivatives), sum(one.hessian for one in derivatives)
        return VertexDerivatives(sum(one.value for one in derivatives), np.asarray(gradient), np.asarray(hessian))


def read_landmarks(path: str | os.PathLike[str]) -> list[Landmark]:
    """Read landmarks of both sides from a table.

    A ``.csv`` (or ``.tsv``) whose first line names the columns: ``label``; ``side``, ``moving`` or ``target``;
    ``vertex``, its number from 0, or ``x``, ``y`` and ``z``, a point of that side's sphere; and ``weight``, if wanted,
    a number or ``exact``. Rows of one label and side are a point where there is one, and else a curve, in order::

        label,side,vertex,weight
        pole,moving,120,exact
        pole,target,88,exact
        central,moving,57,
        central,moving,61,
        central,target,412,
        central,target,430,

    Raises:
        OmtwarpError: a file that cannot be read, a column that is missing, a row that is no such thing, or a weight
            that is not above 0.
    """
    places: dict[str, dict[str, list[list[float]]]] = {}
    weights: dict[str, float] = {}
    # Largest table: bytes; 100,000 rows of 160
    text = table_text(path, 2**24, "a table of landmarks (.csv, .tsv)")
    _, rows = table_rows(text, f"'{path}'", "\t" if Path(path).suffix.lower() == ".tsv" else ",", "label", "side")
    for line, row in rows:
        with naming(f"'{path}', line {line}"):
            label, side = (row["label"] or "").strip(), (row["side"] or "").strip()
            if side not in SIDES:
                raise OmtwarpError(f"the side is '{side}': use {' or '.join(SIDES)}")
            try:
                vertex = (row.get("vertex") or "").strip()
                place = [float(int(vertex))] if vertex else [float(row.get(axis) or "") for axis in "xyz"]
                weight = (row.get("weight") or "").strip()
                number = np.inf if weight == "exact" else float(weight or "nan")
            except ValueError:
                raise OmtwarpError("give a vertex, or x, y and z, and a weight or 'exact'") from None
            before = weights.setdefault(label, _positive(number, f"weight of '{label}'")) if weight else number
            if before is not number and before != number:
                raise OmtwarpError(f"landmark '{label}' has another weight in a line before")
            places.setdefault(label, {name: [] for name in SIDES})[side].append(place)
    return [_landmark(path, label, sides, weights) for label, sides in places.items()]


def _landmark(
    path: str | os.PathLike[str], label: str, sides: dict[str, list[list[float]]], weights: dict[str, float]
) -> Landmark:
    """Return a landmark of a table.

    Raises:
        OmtwarpError: a side is missing, or names vertices in some rows and points in others.
    """
    arrays = []
    for side, places in sides.items():
        if not places:
            raise OmtwarpError(f"'{path}': landmark '{label}' has no row with the side '{side}'")
        if len({len(place) for place in places}) > 1:
            raise OmtwarpError(f"'{path}': landmark '{label}' has vertices and points on the side '{side}'")
        array = np.array(places)
        arrays.append(array[:, 0].astype(np.int64) if array.shape[1] == 1 else array)
    return Landmark(label, arrays[0], arrays[1], weights.get(label, Landmark.weight))
