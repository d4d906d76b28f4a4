"""The energy of maps to the sphere with NumPy arrays in and out, for work beside the package's own solver."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.mesh.arrays import real_number, real_numbers
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, as_surface, as_unit_vectors
from omtwarp.optimal.energy import AREA_WEIGHT
from omtwarp.optimal.solver import SHAPE_WEIGHT
from omtwarp.optimal.sphere import energy_on_sphere

Numbers = NDArray[np.float64]


class MapEnergy:
    """What the optimal map minimises, term by term, with its derivatives.

    The energy of a map y of points x is C + β (angle + λ area), C the mean of d(x, y)² or of the soft distance, under
    the condition that the areas around vertices are three times the masses: see :mod:`omtwarp.optimal.energy`.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices.
        start: the points x, unit vectors, shape [V, 3].
        shape_weight: β.
        area_weight: λ.
        softness: δ of the soft distance sqrt(d² + δ²) - δ, in radians; 0 for the squared distance.
        device: where the kernels run.

    Raises:
        OmtwarpError: the mesh, the points or a weight cannot be used.

    Example:
        >>> import omtwarp
        >>> from omtwarp.optimal import MapEnergy
        >>> surface = omtwarp.shapes.blob(sphere=320)
        >>> result = omtwarp.map_to_sphere(surface)
        >>> energy = MapEnergy(surface, result.conformal)
        >>> terms = energy.terms(result.sphere)
        >>> bool(terms["cost"] > 0.0 and abs(terms["areas"].sum() - 12 * 3.141592653589793) < 1e-9)
        True
    """

    def __init__(
        self,
        surface: MeshLike,
        start: ArrayLike,
        *,
        shape_weight: float = SHAPE_WEIGHT,
        area_weight: float = AREA_WEIGHT,
        softness: float = 0.0,
        device: str | None = "auto",
    ):
        where, mesh = resolve_device(device), as_surface(surface)
        x = vectors(as_unit_vectors(start, mesh.vertex_count), where)
        weight = real_number(shape_weight, "shape_weight", least=0.0)
        of_areas = real_number(area_weight, "area_weight", least=0.0)
        soft = real_number(softness, "softness", least=0.0)
        self._energy = energy_on_sphere(mesh, x, where, weight, area_weight=of_areas, softness=soft)
        self._count = mesh.vertex_count

    def terms(self, sphere: ArrayLike) -> dict[str, float | Numbers]:
        """Return the terms of a map.

        Args:
            sphere: unit vectors, shape [V, 3].

        Returns:
            ``cost``, the mean squared or soft distance; ``angle`` and ``area``, mean distortions of the triangles less
            2; ``areas`` around the vertices, shape [V], and ``wanted``, what they are to be.
        """
        terms, energy = self._energy.terms(self._sent(sphere)), self._energy
        numbers = {"cost": energy.cost(terms) / SPHERE_AREA, "angle": terms.shape.angle, "area": terms.shape.area}
        return numbers | {"areas": terms.areas.numpy().copy(), "wanted": energy.wanted.copy()}

    def value(self, sphere: ArrayLike, multipliers: ArrayLike | None = None) -> float:
        """Return the Lagrangian: the energy plus Σ p_v (a_v - 3 m_v), where a cost counts by areas in place of masses.

        Args:
            sphere: unit vectors, shape [V, 3].
            multipliers: p_v, shape [V]; zeros where left out.
        """
        return self._energy.lagrangian(self._energy.terms(self._sent(sphere), self._multipliers(multipliers)))

    def gradient(self, sphere: ArrayLike, multipliers: ArrayLike | None = None) -> Numbers:
        """Return the gradient of :meth:`value` by the vertices, tangent to the sphere, shape [V, 3]."""
        points = self._sent(sphere)
        gradient = self._energy.gradient(points, self._energy.terms(points), self._multipliers(multipliers))
        return np.array(gradient.numpy())

    def hessian_product(self, sphere: ArrayLike, direction: ArrayLike) -> Numbers:
        """Return the product of the matrix of Newton's steps with tangent vectors, shape [V, 3].

        The matrix is symmetric and positive semidefinite: of the distortion of every triangle the part that is, and of
        the cost what its second derivative is at the optimum.

        Args:
            sphere: unit vectors, shape [V, 3].
            direction: shape [V, 3], of which the tangent part counts.
        """
        points, u = self._coordinates(sphere, direction)
        own, others, _, _ = self._energy.matrix.on_host()
        i, j = self._energy.surface.edges.T
        product = np.einsum("vab,vb->va", own, u)
        np.add.at(product, i, np.einsum("eab,eb->ea", others, u[j]))
        np.add.at(product, j, np.einsum("eab,ea->eb", others, u[i]))
        back = wp.array(product, dtype=wp.float64, device=points.device)
        return np.array(self._energy.domain.vectors(points, back).numpy())

    def area_changes(self, sphere: ArrayLike, direction: ArrayLike) -> Numbers:
        """Return the derivative of the areas around vertices along tangent vectors, shape [V]; arguments as before."""
        _, u = self._coordinates(sphere, direction)
        slopes = self._energy.matrix.on_host()[2].reshape(2, -1, 2)
        i, j = self._energy.surface.edges.T
        changes = np.bincount(i, (slopes[0] * u[j]).sum(axis=1), self._count)
        return np.asarray(changes + np.bincount(j, (slopes[1] * u[i]).sum(axis=1), self._count))

    def _coordinates(self, sphere: ArrayLike, direction: ArrayLike) -> tuple[wp.array, Numbers]:
        """Compute the matrix of a map; return its points and a direction in their frames, shape [V, 2]."""
        points = self._sent(sphere)
        along = vectors(real_numbers(direction, "direction", (self._count, 3)), points.device)
        self._energy.blocks(points, self._energy.terms(points))
        return points, self._energy.domain.coordinates(points, along).numpy()

    def _sent(self, sphere: ArrayLike) -> wp.array:
        return self._energy.domain.sent(as_unit_vectors(sphere, self._count))

    def _multipliers(self, given: ArrayLike | None) -> wp.array:
        numbers = np.zeros(self._count) if given is None else real_numbers(given, "multipliers", (self._count,))
        return wp.array(numbers, dtype=wp.float64, device=self._energy.device)
