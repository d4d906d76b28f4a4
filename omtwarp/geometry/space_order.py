"""A surface with its vertices and faces numbered along a curve through space.

Kernels gather from the neighbours of vertices and triangles, and these lie near in memory if they have numbers near to
each other. In files they often do not: on a bunny of 35,000 vertices, kernels that gather take five to six times as
long in the order of the file. The order depends on the positions alone, so that a map is the same, to the bit, however
the vertices of the input are numbered.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import vectors
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.mesh.arrays import Floats, edge_keys
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.quarter import PARTS, QuarteredSurface
from omtwarp.mesh.surface import Surface

wp.set_module_options(KERNEL_OPTIONS)

BITS = 20  # of every coordinate of a cell: three of them fit into one number of 64 bits
HIGHEST_BIT = wp.constant(1 << (BITS - 1))
LAST_CELL = wp.constant((1 << BITS) - 1)


@wp.func
def cell_of(x: wp.float64):
    """Return the cell along one axis of a coordinate between 0 and 1."""
    return wp.clamp(int(x * wp.float64(LAST_CELL + 1)), 0, LAST_CELL)


@wp.func
def turned_back(x: int, other: int, bit: int):
    """Undo the curve's turn at one bit for the first coordinate and another one."""
    if other & bit:
        return x ^ (bit - 1), other
    swapped = (x ^ other) & (bit - 1)
    return x ^ swapped, other ^ swapped


@wp.kernel
def number_along_curve(
    points: wp.array[wp.vec3d],
    corner: wp.vec3d,
    side: wp.float64,
    # Data out:
    place_out: wp.array[wp.int64],
):
    i, _compiled_once = wp.tid()
    p = (points[i] - corner) / side
    x, y, z = cell_of(p[0]), cell_of(p[1]), cell_of(p[2])
    # Undo the turns of the curve, from the coarsest cells to the finest.
    bit = int(HIGHEST_BIT)
    while bit > 1:
        if x & bit:
            x = x ^ (bit - 1)
        x, y = turned_back(x, y, bit)
        x, z = turned_back(x, z, bit)
        bit = bit >> 1
    # Gray code.
    y = y ^ x
    z = z ^ y
    turned = int(0)
    bit = int(HIGHEST_BIT)
    while bit > 1:
        if z & bit:
            turned = turned ^ (bit - 1)
        bit = bit >> 1
    x, y, z = x ^ turned, y ^ turned, z ^ turned
    # The number has the highest bits of x, y and z first, then the next.
    place = wp.int64(0)
    bit = int(HIGHEST_BIT)
    while bit > 0:
        digit = wp.where(x & bit, 4, 0) + wp.where(y & bit, 2, 0) + wp.where(z & bit, 1, 0)
        place = place * wp.int64(8) + wp.int64(digit)
        bit = bit >> 1
    place_out[i] = place


Places = NDArray[np.int64]
# A triangle's first corner is the one with the smallest number, so that its number of turns is 0, 1 or 2.


@dataclass(frozen=True, eq=False)
class OrderedSurface(Origins):
    """A surface numbered anew, and what its vertices and faces are in the one that it was made from.

    Attributes:
        surface: V vertices, F faces.
        turns: which corner of that face the first corner of each face is, shape [F].
    """

    surface: Surface
    turns: Places

    def of_parts(self, given: QuarteredSurface) -> tuple[Places, Places]:
        """Return what vertices and faces are in the given surface when both surfaces are quartered.

        Args:
            given: the surface that this one was made from, quartered.

        Returns:
            Of every vertex and every face of this surface quartered: the number of its equal, shapes [V + E] and [4 F].
        """
        count = self.surface.vertex_count
        known = edge_keys(given.split_edges, count)
        order = np.argsort(known)
        middles = order[np.searchsorted(known, edge_keys(self.vertex_origin[self.surface.edges], count), sorter=order)]
        parts = np.full((len(self.face_origin), PARTS), PARTS - 1)
        parts[:, :3] = (np.arange(3) + self.turns[:, None]) % 3
        return np.r_[self.vertex_origin, count + middles], (PARTS * self.face_origin[:, None] + parts).ravel()


def in_space_order(surface: Surface) -> OrderedSurface:
    """Number the vertices of a surface along Hilbert's curve, and its faces by their corners.

    Faces are turned so that their smallest corner comes first. The numbering is computed once, and kept with the
    surface together with what is computed from the surface it makes.

    Args:
        surface: any surface.

    Example:
        >>> from omtwarp.geometry.space_order import in_space_order
        >>> from omtwarp.mesh import shapes
        >>> in_space_order(shapes.icosphere(2)).surface
        Surface(42 vertices, 80 faces)
    """
    kept = surface.cached("space order", lambda: _ordered(surface))
    areas = surface.face_areas[kept.face_origin] if surface.weighted else None
    other = kept.surface if areas is None else kept.surface.with_areas(areas)
    other.checked = surface.checked
    other.origins = kept if surface.origins is None else surface.origins.compose(kept)
    return replace(kept, surface=other)


def order_along_curve(points: Floats) -> Places:
    """Return the numbers of points in their order along Hilbert's curve through their bounding cube, shape [N].

    Points in one cell of it are ordered by their coordinates.

    Args:
        points: finite, shape [N, 3].
    """
    low = points.min(axis=0)
    side = max(float((points.max(axis=0) - low).max()), np.finfo(float).tiny)
    place = wp.empty(len(points), dtype=wp.int64, device="cpu")
    inputs = [vectors(points, resolve_device("cpu")), wp.vec3d(*low), wp.float64(side)]
    wp.launch(number_along_curve, dim=(len(points), 1), inputs=inputs, outputs=[place], device="cpu")
    along = place.numpy()
    order = np.argsort(along, kind="stable")
    if (np.diff(along[order]) == 0).any():
        order = np.lexsort([*points.T, along])
    return order


def _ordered(surface: Surface) -> OrderedSurface:
    vertices = order_along_curve(surface.moderate_vertices)
    place = np.empty_like(vertices)
    place[vertices] = np.arange(len(vertices))
    renumbered = place[surface.faces]
    turns = renumbered.argmin(axis=1)
    turned = np.take_along_axis(renumbered, (turns[:, None] + np.arange(3)) % 3, axis=1)
    # No two faces of an oriented surface have the same two corners first; those of others keep their order.
    faces = np.argsort(turned[:, 0] * len(vertices) + turned[:, 1], kind="stable")
    return OrderedSurface(vertices, faces, Surface(surface.vertices[vertices], turned[faces]), turns[faces])


Cut = Callable[[NDArray[np.int64], NDArray[np.intp]], Floats]


def in_strips(
    corners: Floats, shortest: NDArray[np.intp], counts: NDArray[np.int64], cut: Cut
) -> tuple[NDArray[np.intp], Floats]:
    """Cut triangles in strips along one of their edges.

    Args:
        corners: of the triangles, in any coordinates, shape [N, 3, D].
        shortest: the edge (k, k + 1) that strips are parallel to, shape [N].
        counts: of the strips, shape [N].
        cut: returns the share of the way from the corner opposite that edge to it where a strip begins, shape [M], from
            the number of the strip and that of its triangle, shape [M] each; 0 at the corner, 1 at the edge.

    Returns:
        The triangle that every part is of, shape [P], and the parts' corners in the same sense of rotation, shape
        [P, 3, D]; a strip is two parts, and that at the corner one.
    """
    turn = (shortest[:, None] + np.array([2, 0, 1])) % 3
    apex, one, other = np.take_along_axis(corners, turn[:, :, None], axis=1).transpose(1, 0, 2)
    whole = np.repeat(np.arange(len(counts)), counts)
    strip = np.arange(len(whole)) - np.repeat(np.cumsum(counts) - counts, counts)
    above, below = (cut(number, whole)[:, None] for number in (strip, strip + 1))
    (a, b), (c, d) = (
        [(1.0 - share) * apex[whole] + share * end[whole] for end in (one, other)] for share in (above, below)
    )
    inner = strip > 0
    parts = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)[inner]])
    return np.concatenate([whole, whole[inner]]), parts
