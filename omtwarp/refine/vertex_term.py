"""An energy at vertices that is minimised together with the distortion of triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import wp
from omtwarp.solvers.triangle_newton.motion_kernels import from_tangent


@dataclass(frozen=True)
class VertexDerivatives:
    """The value of a term at a map, and its derivatives by the positions of the vertices.

    Attributes:
        value: the term, in the unit of the distortion: a mean over the sphere.
        gradient: by every vertex, shape [V, 3]; what is not tangent to the sphere does not count.
        hessian: of every vertex, symmetric positive semidefinite, shape [V, 3, 3]; of it the solver takes the 2x2 block
            in the tangent plane. Steps go downhill with any such matrix, and are longest with the true one: where that
            is indefinite, leave out its negative part, as Gauss and Newton do with squares.
    """

    value: float
    gradient: NDArray[np.float64]
    hessian: NDArray[np.float64]


class VertexTerm(Protocol):
    """An energy that is a sum over the vertices of a function of where each lies.

    A class with the method below is one; :class:`omtwarp.refine.solver.Refiner` takes it as ``vertex_term``. The value
    has to be continuous, and the gradient its derivative: the line search compares the two.
    """

    def at(self, points: NDArray[np.float64]) -> VertexDerivatives:
        """Return the term and its derivatives at a map, unit vectors, shape [V, 3]."""


def tangent_blocks(points: wp.array, hessian: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return matrices in space, [V, 3, 3], as the blocks of the tangent bases of points, shape [V, 2, 2].

    Args:
        points: vec3d, shape [V], on the host.
        hessian: symmetric, shape [V, 3, 3].
    """
    count = points.size
    bases = []
    for k in range(2):
        one = np.zeros((count, 2))
        one[:, k] = 1.0
        vectors = wp.empty(count, dtype=wp.vec3d, device="cpu")
        inputs = [points, wp.array(one, dtype=wp.float64, device="cpu", copy=False)]
        wp.launch(from_tangent, dim=count, inputs=inputs, outputs=[vectors], device="cpu")
        bases.append(vectors.numpy())
    basis = np.stack(bases, axis=1)
    return np.asarray(basis @ hessian @ basis.transpose(0, 2, 1))
