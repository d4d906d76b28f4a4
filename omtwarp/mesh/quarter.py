"""Every triangle cut into four at the midpoints of its edges, with maps and measures of the parts.

A map of the quartered mesh has enough freedom to keep the area of every triangle of the mesh itself, the sum of its
four parts, and to be optimal and smooth as well: 4 E unknowns and F conditions, where the mesh has 2 V of both.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.mesh.arrays import Floats, Ints, normalised
from omtwarp.mesh.origins import Numbers, Origins
from omtwarp.mesh.surface import Surface

PARTS = 4  # of a triangle: one at each corner, and the one in the middle


@dataclass(frozen=True, eq=False)
class QuarteredSurface(Origins):
    """A surface whose triangles are the parts of another's; the new vertices are halfway between two.

    Part 4 f + k of triangle f lies at its corner k and has the corners (corner k, middle of the edge from corner k to
    the next, middle of the edge from the one before to corner k); part 4 f + 3 has the three middles for corners.

    Attributes:
        surface: V + E vertices, those of the mesh first, then the middles of its edges; 4 F triangles. Its origins are
            those in the input that the mesh was made from.
        middles: of the edges from corner k to the next of every triangle of the mesh, int32, shape [F, 3].
    """

    surface: Surface
    middles: Ints

    @property
    def parents(self) -> Ints:
        """The triangle that every part belongs to, int32, shape [4 F]."""
        return self.face_origin.astype(np.int32)

    def on_sphere(self, sphere: Floats) -> Floats:
        """Extend a map: new vertices go to the midpoints of the images of their edges.

        If the map flips no triangle, neither does this: each spherical triangle is cut into four along great circles.

        Args:
            sphere: unit vectors, shape [V, 3].

        Returns:
            Unit vectors, shape [V + E, 3]. Where the ends of an edge are opposite points it is the first end.
        """
        one, other = sphere[self.split_edges[:, 0]], sphere[self.split_edges[:, 1]]
        middle = normalised(one + other)
        return np.concatenate([sphere, np.where(middle.any(axis=1, keepdims=True), middle, one)])

    def sum_of_parts(self, per_part: Floats) -> Floats:
        """Sum numbers on the parts, shape [4 F], over every original triangle; returns shape [F]."""
        return per_part.reshape(-1, PARTS).sum(axis=1)


def in_parts(corners: NDArray[Numbers], middles: NDArray[Numbers]) -> NDArray[Numbers]:
    """Return what belongs to the corners of the four parts of every triangle, shape [4 F, 3, ...].

    Args:
        corners: what belongs to the triangles' own corners, shape [F, 3, ...].
        middles: what belongs to the middles of the edges from corner k to the next, shape [F, 3, ...].
    """
    at_corners = [np.stack([corners[:, k], middles[:, k], middles[:, k - 1]], axis=1) for k in range(3)]
    return np.stack([*at_corners, middles], axis=1).reshape(-1, *corners.shape[1:])


def quarter(surface: Surface) -> QuarteredSurface:
    """Cut every triangle of a closed surface into four.

    Args:
        surface: V vertices, E edges, F triangles; each part has a quarter of its triangle's measure.

    Raises:
        OmtwarpError: the surface is not closed.

    Example:
        >>> from omtwarp.mesh import shapes
        >>> from omtwarp.mesh.quarter import quarter
        >>> quarter(shapes.icosphere(2)).surface
        Surface(162 vertices, 320 faces)
    """
    edges, faces = surface.edges, surface.faces
    opposite = np.empty(3 * surface.face_count, dtype=np.int32)  # edge of every corner
    for side in range(2):
        opposite[surface.edge_corners[:, side]] = np.arange(len(edges), dtype=np.int32)
    # The edge from corner k to the next lies opposite to the one after.
    middles = surface.vertex_count + np.roll(opposite.reshape(-1, 3), -2, axis=1)
    points = surface.vertices
    # Halves first: the sum of two large coordinates need not be finite.
    between = 0.5 * points[edges[:, 0]] + 0.5 * points[edges[:, 1]]
    measure = np.repeat(surface.face_areas / PARTS, PARTS) if surface.weighted else None
    cut = Surface(np.concatenate([points, between]), in_parts(faces, middles), measure)
    cut.checked = surface.checked
    vertices, parents = np.r_[np.arange(len(points)), np.full(len(edges), -1)], np.arange(4 * len(faces)) // PARTS
    ends, middles = edges.astype(np.int64), middles.astype(np.int32)
    quartered = QuarteredSurface(vertices, parents, cut, middles, split_edges=ends, given=len(points))
    cut.origins = quartered if surface.origins is None else surface.origins.compose(quartered)
    return quartered
