"""What the minimisation asks of the place where vertices move, of their cost, and of the shape of triangles.

A sphere (:mod:`omtwarp.optimal.sphere`) and the plane (:mod:`omtwarp.optimal.plane`) have each a class of the three.
Points and vectors of vertices are arrays on the device, of vec3d on the sphere and vec2d in the plane. Every point has
a frame, two directions of unit length at right angles: matrices are written in coordinates along them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.device.sums import Reading
from omtwarp.mesh.surface import Surface
from omtwarp.untangling.steps import FlipFreeSteps

Numbers = NDArray[np.float64]


class Domain(Protocol):
    """Where the vertices of one surface's maps move: V vertices, F triangles, D coordinates a point.

    Attributes:
        surface: what is mapped.
        device: a Warp device.
    """

    surface: Surface
    device: wp.Device

    def sent(self, values: Numbers) -> wp.array:
        """Return points or vectors of the vertices, shape [V, D], as an array on the device."""

    def flipped(self, points: Numbers) -> NDArray[np.bool_]:
        """Return a mask of the triangles that are turned over, shape [F]."""

    def areas(self, points: wp.array) -> wp.array:
        """Return the area of every triangle, negative where it is turned over, float64, shape [F]."""

    def area_slopes(self, points: wp.array) -> wp.array:
        """Return the derivatives of every area by its corners, in their frames, vec2d, shape [F, 3]."""

    def coordinates(self, points: wp.array, vectors: wp.array) -> wp.array:
        """Return vectors, shape [V], in the frames at ``points``, float64, shape [V, 2]."""

    def vectors(self, points: wp.array, coordinates: wp.array) -> wp.array:
        """Return the vectors with these coordinates, float64, shape [V, 2], in the frames at ``points``, shape [V]."""

    def steps(self) -> FlipFreeSteps:
        """Return an object that moves maps along vectors without flipping triangles."""


class VertexCost(Protocol):
    """A cost of every vertex's place; arrays are float64 on the device."""

    def values(self, points: wp.array) -> wp.array:
        """Return the cost of every vertex, shape [V]."""

    def gradient(
        self, points: wp.array, masses: wp.array, potential: wp.array, further: wp.array, weight: float
    ) -> wp.array:
        """Return the gradient of Σ masses_v cost_v + Σ potential_f area_f by the vertices, shape [V].

        Masses, shape [V], and the potential of every triangle, shape [F], are taken as constant. ``weight`` times a
        further gradient is added.
        """

    def hessian(self, points: wp.array, masses: wp.array, least: float) -> wp.array:
        """Return the second derivative of what :meth:`gradient` differentiates, at the optimum, shape [V, 4].

        Of each 2x2 matrix row by row, in the frame of the point. Eigenvalues are raised to ``least`` times twice the
        mass.
        """


class ShapeTerms(Protocol):
    """The distortion of one map.

    Attributes:
        angle, area: mean distortions of the triangles, less 2.
        d_volume: what steps keep positive of every triangle, float64, shape [F], on the device.
    """

    @property
    def angle(self) -> float: ...

    @property
    def area(self) -> float: ...

    @property
    def d_volume(self) -> wp.array: ...

    def total(self, weight: float) -> float:
        """Return angle plus ``weight`` times area distortion, and what keeps triangles from turning over."""


class Shape(Protocol):
    """The distortion of the triangles of one surface's maps."""

    def begin(self, points: wp.array, reading: Reading) -> Callable[[Numbers], ShapeTerms]:
        """Begin to measure the distortion of a map; return what makes its terms of the numbers that are read."""

    def gradient(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return the gradient by the vertices of the total of ``terms``."""

    def hessian(self, points: wp.array, terms: ShapeTerms, weight: float) -> wp.array:
        """Return every triangle's Hessian in its corners' frames, semidefinite: on and above the diagonal, [F, 21]."""
