"""Measures other than area: weights on a surface, and a prescribed density on the sphere."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError, choose
from omtwarp.geometry.sphere_hierarchy import sphere_hierarchy
from omtwarp.mesh.arrays import ROUND_OFF, Floats, Ints, normalised, real_number, real_numbers
from omtwarp.mesh.surface import SPHERE_AREA, MeshLike, Surface, as_surface, triangle_areas
from omtwarp.options import WeightsAt, WeightsAtLike


class TargetDensity:
    """A positive density ρ on the unit sphere, scaled to the mean 1 (total mass 4π).

    A map that reaches it puts mass ρ(y) dA at every point y of the sphere: a triangle of mass m covers the area m / ρ.

    Args:
        density: takes unit vectors, float64, shape [N, 3], and returns N numbers in any unit.
        floor: densities below this share of the mean are raised to it, before scaling.

    Attributes:
        mass: the integral over the sphere before scaling, in the density's own unit.

    Raises:
        OmtwarpError: the density is not positive and finite at every point tested, or returns another shape.

    Example:
        >>> import numpy as np
        >>> from omtwarp.measures import TargetDensity
        >>> north = TargetDensity(lambda points: 2.0 + points[:, 2])
        >>> float(round(north.mass / (8 * np.pi), 6))
        1.0
        >>> north.at([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]).round(3).tolist()
        [1.5, 0.5]
    """

    def __init__(self, density: Callable[[Floats], ArrayLike], floor: float = 0.0):
        if not 0.0 <= real_number(floor, "the floor of the target density") < 1.0:
            raise OmtwarpError(f"the floor of the target density is {floor:g}: give a share of its mean, 0 to below 1")
        self._density = density
        self._lowest = 0.0

        # Level of the icosahedron's subdivision that the total mass is taken on: 40,962 nodes, one and a quarter
        # degrees apart.
        hierarchy = sphere_hierarchy(6)
        values = self._values(hierarchy.vertices, positive=floor == 0.0)
        if floor > 0.0:
            self._lowest = floor * float(hierarchy.node_areas @ values) / SPHERE_AREA
            values = np.maximum(values, self._lowest)
        self.mass = float(hierarchy.node_areas @ values)
        if not (np.isfinite(self.mass) and self.mass > 0.0):
            raise OmtwarpError(f"the target density has the total mass {self.mass:g}: it must be positive and finite")

    def at(self, points: ArrayLike) -> Floats:
        """Evaluate the density, mean 1 over the sphere, at unit vectors, shape [N, 3]; returns shape [N]."""
        values = self._values(real_numbers(points, "points", (None, 3)), positive=self._lowest == 0.0)
        return np.maximum(values, self._lowest) * (SPHERE_AREA / self.mass)

    def on_triangles(self, sphere: Floats, faces: Ints) -> Floats:
        """Return the mean density over every spherical triangle, shape [F], exact for plane quadratics."""
        centres = normalised(sphere[faces].sum(axis=1))
        return 3.0 / 4.0 * self.at(centres) + self.at(sphere)[faces].sum(axis=1) / 12.0

    def goal(self, surface: Surface, sphere: Floats) -> Surface:
        """Give every triangle the area m / ρ that it is to cover where it is now; stages then treat ρ as uniform.

        Args:
            surface: its measure is the mass m.
            sphere: a map of it, unit vectors, shape [V, 3].
        """
        return surface.with_areas(surface.face_areas / self.on_triangles(sphere, surface.faces))

    def _values(self, points: Floats, positive: bool) -> Floats:
        try:
            values = real_numbers(self._density(points.copy()), "values", None, finite=False)
        except (TypeError, ValueError) as error:
            raise OmtwarpError(f"the target density cannot be evaluated: {error}") from error
        if values.shape != (len(points),):
            raise OmtwarpError(
                f"the target density gave shape {list(values.shape)} for {len(points)} points: expected one number each"
            )
        wrong = ~np.isfinite(values) | (values <= 0.0 if positive else values < 0.0)
        if wrong.any():
            first = int(np.argmax(wrong))
            place = ", ".join(f"{x:.3f}" for x in points[first])
            raise OmtwarpError(
                f"the target density is {values[first]:g} at ({place}): it must be positive and finite everywhere"
            )
        return values


def area_distortions(image: Floats, wanted: Floats) -> tuple[Floats, Floats]:
    """Return the ratios r of areas of images to those wanted, in shares of all, and r + 1/r, shape [F] each."""
    with np.errstate(divide="ignore"):
        ratio = image / image.sum() * wanted.sum() / wanted
        return ratio, ratio + 1.0 / ratio


def mass_distortion(goal: Surface, sphere: Floats, own: NDArray[np.bool_] | None = None) -> dict[str, float]:
    """Measure how well images keep the mass asked for: r + 1/r, r the area of an image over the area wanted.

    Args:
        goal: a surface whose measure is the area wanted, see :meth:`TargetDensity.goal`.
        sphere: the map, unit vectors, shape [V, 3].
        own: the triangles that count, where others fill holes, shape [F]; all by default.

    Returns:
        ``mean`` weighted by the area wanted, ``p95`` and ``max`` over triangles; 2 is perfect.
    """
    chosen = slice(None) if own is None else own
    return kept_mass(triangle_areas(sphere, goal.faces[chosen]), goal.face_areas[chosen])


def kept_mass(image: Floats, wanted: Floats) -> dict[str, float]:
    """Return the figures of :func:`mass_distortion` of areas of images and those wanted, in shares, shape [F] each."""
    _, error = area_distortions(image, wanted)
    mean = float(wanted @ error) / float(wanted.sum())
    return {"mean": mean, "p95": float(np.percentile(error, 95)), "max": float(error.max())}


def weighted_surface(surface: MeshLike, weights: ArrayLike | None, at: WeightsAtLike = WeightsAt.AUTO) -> Surface:
    """Multiply the area of every triangle by a weight; the result is the measure that maps of the surface keep.

    Args:
        surface: a mesh in any form that :func:`omtwarp.map_to_sphere` takes, V vertices and F triangles.
        weights: positive and finite, shape [V] or [F]; a triangle takes the mean of its vertices. Only ratios count, up
            to 1e12: a part of weight 2 among parts of weight 1 covers twice as much of the sphere for its area. None
            returns the surface itself.
        at: what they belong to: ``vertices`` or ``triangles``; ``auto`` goes by their number.

    Returns:
        The surface with its measure, of total 4π; see :class:`omtwarp.Surface`.

    Raises:
        OmtwarpError: another number of weights, one that is not positive and finite, or ``auto`` where there are as
            many vertices as triangles.

    Example:
        >>> import numpy as np, omtwarp
        >>> from omtwarp.measures import weighted_surface
        >>> surface = omtwarp.shapes.icosphere(8)
        >>> north = weighted_surface(surface, np.where(surface.vertices[:, 2] > 0, 3.0, 1.0))
        >>> bool(north.vertex_areas[surface.vertices[:, 2] > 0.2].sum() > 2 * 4 * np.pi / 4)
        True
    """
    surface = surface if isinstance(surface, Surface) else as_surface(surface)
    if weights is None:
        return surface
    return surface.with_areas(surface.face_areas * face_weights(weights, surface.faces, surface.vertex_count, at))


def face_weights(weights: ArrayLike, corners: NDArray, vertices: int, at: WeightsAtLike = WeightsAt.AUTO) -> Floats:
    """Convert weights of vertices or triangles to weights of triangles, the largest being 1, shape [F].

    Args:
        weights: positive and finite, shape [V] or [F].
        corners: the vertices of every triangle, shape [F, 3].
        vertices: how many there are, V.
        at: what the weights belong to, as of :func:`weighted_surface`.

    Raises:
        OmtwarpError: another number of weights, one that is not positive and finite, or ``auto`` where there are as
            many vertices as triangles.
    """
    given = real_numbers(weights, "the weights", None, positive=True)
    where = weights_belong_to(given.shape, vertices, len(corners), at)
    given = given / given.max()
    if given.min() < ROUND_OFF:
        raise OmtwarpError("the weights: the largest must be at most 1e12 times the smallest: less is lost in rounding")
    return given if where is WeightsAt.TRIANGLES else np.asarray(given[corners].mean(axis=1))


def weights_belong_to(shape: tuple[int, ...], vertices: int, faces: int, at: str = WeightsAt.AUTO) -> WeightsAt:
    """Return whether weights are of vertices or of triangles.

    Args:
        shape: of their array.
        vertices: how many vertices the surface has.
        faces: how many triangles it has.
        at: what is said about them.

    Raises:
        OmtwarpError: another number of weights, or nothing is said where both numbers are the same.
    """
    said = choose(WeightsAt, at)
    counts = {WeightsAt.VERTICES: vertices, WeightsAt.TRIANGLES: faces}
    fitting = [name for name, count in counts.items() if shape == (count,) and said in (name, WeightsAt.AUTO)]
    if not fitting:
        wanted = " or ".join(f"{count} {name}" for name, count in counts.items() if said in (name, WeightsAt.AUTO))
        raise OmtwarpError(f"the weights have shape {list(shape)}: give one for each of {wanted}")
    if len(fitting) > 1:
        raise OmtwarpError(
            f"{shape[0]} weights are given for a surface of as many vertices as triangles: say which they belong to, "
            "by weights_at='vertices' or weights_at='triangles'"
        )
    return fitting[0]
