"""Texture coordinates for a mesh's own triangles, without a cut through any of them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.maps.domains import is_torus_map
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import TINY, Floats, Ints, SphereMap, in_range, real_number
from omtwarp.mesh.surface import plane_areas, triangle_areas
from omtwarp.texturing.atlas import CUBE_FRAMES, angles_from_middle
from omtwarp.texturing.export import Material
from omtwarp.texturing.painted import PaintedMesh
from omtwarp.texturing.textured import MapLike, as_map, domains_of

MARGIN = 1.0 / 128.0
"""Free space around a chart, in heights of the picture: 8 texels at 1024, enough for three levels of mip maps."""


ASPECTS, MOST_MARGIN = (0.1, 10.0), 0.1
"""Widths of the picture over its height, and free room in heights of it: beyond these charts have next to no room."""


_Charts: TypeAlias = tuple[Floats, NDArray[np.intp]]
"""Triangles in the plane, in the surface's own unit, shape [F, 3, 2], and the chart of each: none overlap in one."""


def unwrap_uv(
    result: SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike], *, aspect: float = 1.0, margin: float = MARGIN
) -> PaintedMesh:
    """Lay a surface out on a picture through its map, as texture coordinates for the triangles that it has.

    Every triangle belongs to one chart as a whole: no vertex is added, and charts have jagged borders, a triangle wide.
    All charts are at one scale and apart from each other, and no triangle overlaps another. What the charts are:

    * On the sphere the faces of the cube. A triangle belongs to the one in which its centroid lies, a long one to the
      one that contains it best. Angles from the middle of a chart are linear on the picture, so that its texels are of
      nearly the same size all over the sphere, and on the surface where the map preserves areas.
    * With several parts, each on a sphere of its own, the charts of all of them, in proportion to the parts' areas.
    * Of a map to the disk, the disk: one chart without a cut, or one for each part.
    * Of a map to a torus, a rectangle that one of the lattice's vectors bounds, cut across into as many equal strips
      as fill the picture best; texels are of the same size and square where the map is.

    Args:
        result: a :class:`~omtwarp.MapResult`, anything with ``vertices``, ``faces`` and
            ``sphere``, or the three as a tuple; a map that is one to one.
        aspect: width of the picture over its height; for one sphere 1.5 leaves no part of the cells unused, 1 is what
            game engines expect.
        margin: free space around each chart, in heights of the picture.

    Returns:
        The mesh with its coordinates and one plain material; ``.export("name.obj")`` writes it.

    Raises:
        OmtwarpError: triangles that reach too far around the sphere, flipped triangles, or a margin that leaves no
            space.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> result = omtwarp.map_to_sphere(surface, until="conformal", device="cpu")
        >>> mesh = omtwarp.unwrap_uv(result)
        >>> mesh.uv.shape == (len(surface.faces), 3, 2), bool(0 < mesh.uv.min() and mesh.uv.max() < 1)
        (True, True)
    """
    return laid_out(result, aspect, margin)[0]


def laid_out(result: MapLike, aspect: float = 1.0, margin: float = MARGIN) -> tuple[PaintedMesh, int]:
    """Lay a surface out as :func:`unwrap_uv` does; return the mesh and the number of its charts.

    Raises:
        OmtwarpError: as of :func:`unwrap_uv`.
    """
    aspect, margin = real_number(aspect, "aspect"), real_number(margin, "margin")
    if not ASPECTS[0] <= aspect <= ASPECTS[1] or not 0.0 <= margin <= MOST_MARGIN:
        raise OmtwarpError(f"aspect {aspect}, margin {margin}: give 0.1 to 10, and 0 to 0.1")
    if is_torus_map(result):
        vertices, faces = result.vertices, result.faces
        charts = _strips(result, aspect)
    else:
        vertices, faces, sphere = as_map(result)
        parts = domains_of(result, len(faces))
        disk = getattr(result, "disk", None)
        if disk is None:
            beside = getattr(result, "part", None)  # parts side by side on one sphere have charts of their own too
            charts = _cubes(vertices, faces, sphere, parts if beside is None else beside)
        else:  # one chart for each part, without a cut
            plane = disk[faces]
            scale = _scales(triangle_areas(in_range(vertices), faces), np.abs(plane_areas(plane)), parts)
            charts = plane * scale[parts][:, None, None], parts
    turned = plane_areas(charts[0]) <= 0
    if turned.any():
        raise OmtwarpError(
            f"{turned.sum()} of {len(faces)} faces are flipped or without area in the map, first face "
            f"{int(np.argmax(turned))}: remake the map"
        )
    mesh = PaintedMesh(vertices, faces, _packed(charts, aspect, margin), (Material("surface"),))
    return mesh, len(np.unique(charts[1]))


def _cubes(vertices: Floats, faces: Ints, sphere: Floats, parts: NDArray[np.intp]) -> _Charts:
    """Return the charts of spheres: six for each, the faces of a cube.

    Args:
        vertices, faces, sphere: the map, shapes [V, 3], [F, 3] and [V, 3].
        parts: the sphere of every triangle, shape [F].
    """
    # From the middle of a chart: what lies 90 degrees away lies on no plane in front of it.
    farthest = np.deg2rad(87.0)
    corners = sphere[faces]
    chart = np.argmax(corners.sum(axis=1) @ CUBE_FRAMES[:, 0].T, axis=1)
    angle = angles_from_middle(corners, chart)
    far = np.abs(angle).max(axis=(1, 2)) > farthest
    if far.any():  # a long triangle may fit better on a neighbouring chart
        at = np.flatnonzero(far)
        tried = (angles_from_middle(corners[at], np.full(len(at), k)) for k in range(len(CUBE_FRAMES)))
        chart[at] = np.argmin([np.abs(one).max(axis=(1, 2)) for one in tried], axis=0)
        angle[at] = angles_from_middle(corners[at], chart[at])
        far = np.abs(angle).max(axis=(1, 2)) > farthest
    if far.any():
        raise OmtwarpError(
            f"{far.sum()} of {len(faces)} faces reach more than {np.rad2deg(farthest):.0f} degrees from the middle of "
            f"their chart, first face {int(np.argmax(far))}: quarter the mesh first, or use texture, which cuts faces"
        )
    # In gnomonic coordinates great circles are straight lines, so that no triangle flips that was not flipped.
    bent = np.bincount(parts, plane_areas(angle) <= 0) > 0
    plane = np.where(bent[parts][:, None, None], np.tan(angle), angle)
    scale = _scales(triangle_areas(in_range(vertices), faces), triangle_areas(sphere, faces), parts)
    return plane * scale[parts][:, None, None], len(CUBE_FRAMES) * parts + chart


def _scales(on_surface: Floats, on_map: Floats, parts: NDArray[np.intp]) -> Floats:
    """Return the factors on lengths that give every part its surface's area, shape [P]."""
    return np.sqrt(np.bincount(parts, on_surface) / np.maximum(np.bincount(parts, on_map), TINY))


def _strips(result: MapResult, aspect: float) -> _Charts:
    """Return the charts of a map to a torus: strips of a rectangle along the longer of the lattice's vectors.

    A triangle lies where its centroid is in the rectangle; no two overlap, as the map is one to one.
    """
    # Pieces of a torus at most, and the share of the largest scale at which fewer of them are taken.
    most_strips, fewer_cuts = 12, 0.9
    lattice = result.lattice
    long, other = lattice[::-1] if np.linalg.norm(lattice[1]) > np.linalg.norm(lattice[0]) else lattice
    length = float(np.linalg.norm(long))
    along = long / length
    axes = np.array([along, [-along[1], along[0]]])  # turned, not mirrored
    other, plane = axes @ other, result.corners @ lattice @ axes.T
    plane -= np.floor(plane[..., 1].mean(axis=1) / other[1])[:, None, None] * other
    plane[..., 0] -= length * np.floor(plane[..., 0].mean(axis=1) / length)[:, None]
    height = abs(float(other[1]))
    count = np.arange(1, most_strips + 1)
    scale = np.minimum(aspect * count / length, 1.0 / (count * height))
    strips = int(count[np.argmax(scale >= fewer_cuts * scale.max())])
    at = np.floor(plane[..., 0].mean(axis=1) * (strips / length)).astype(np.intp)
    return plane, np.clip(at, 0, strips - 1)


def _packed(charts: _Charts, aspect: float, margin: float) -> Floats:
    """Return the coordinates of charts, on shelves in the picture."""
    plane, number = charts
    order = np.argsort(number, kind="stable")
    numbers, first = np.unique(number[order], return_index=True)
    which = np.searchsorted(numbers, number)
    low = np.minimum.reduceat(plane.min(axis=1)[order], first)
    high = np.maximum.reduceat(plane.max(axis=1)[order], first)
    corner, scale = pack_rows(high - low, aspect, margin)
    return ((plane - low[which, None]) * scale + corner[which, None]) / (aspect, 1.0)


def pack_rows(sizes: Floats, width: float, margin: float, least: Floats | float = 0.0) -> tuple[Floats, float]:
    """Place boxes on a picture of height 1, as large as rows of them allow, all at one scale.

    The highest come first, each in the first row in which there is room for it [1]_; the scale is bisected.

    Args:
        sizes: width and height of the boxes, shape [N, 2].
        width: of the picture.
        margin: free space around every box, in heights of the picture.
        least: width and height that no box falls below, in the same unit, shape [2].

    Returns:
        Lower left corners of the boxes, without their margins, shape [N, 2], and the scale.

    Raises:
        OmtwarpError: the margins alone do not fit.

    >>> import numpy as np
    >>> corners, scale = pack_rows(np.array([[2.0, 1.0], [2.0, 1.0]]), 1.0, 0.0)
    >>> corners.tolist(), round(scale, 6)
    ([[0.0, 0.5], [0.0, 0.0]], 0.5)

    .. [1] E. G. Coffman, M. R. Garey, D. S. Johnson and R. E. Tarjan, "Performance bounds for level-oriented
       two-dimensional packing algorithms", SIAM J. Comput. 9 (1980).
    """
    low, high = 0.0, float((np.array([width, 1.0]) / np.maximum(sizes.max(axis=0), TINY)).min())
    fitted = _rows(np.maximum(high * sizes, least), width, margin)
    low = high if fitted is not None else low
    for _ in range(40 if fitted is None else 0):  # halvings of the interval, which is then known to rounding
        middle = 0.5 * (low + high)
        placed = _rows(np.maximum(middle * sizes, least), width, margin)
        if placed is None:
            high = middle
        else:
            low, fitted = middle, placed
    if fitted is None or low == 0.0:
        raise OmtwarpError(f"a margin of {margin} leaves no room for {len(sizes)} charts")
    placed_sizes = np.maximum(low * sizes, least)
    fitted = fitted + 0.5 * (np.array([width, 1.0]) - (fitted + placed_sizes + margin).max(axis=0))
    return np.stack([fitted[:, 0], 1.0 - fitted[:, 1] - placed_sizes[:, 1]], axis=1), low


def _rows(sizes: Floats, width: float, margin: float) -> Floats | None:
    """Return the upper left corners of boxes in rows, y downwards, shape [N, 2]; None where they do not fit."""
    places = np.empty((len(sizes), 2))
    ends: list[float] = []  # of the rows, to the right
    tops: list[float] = []
    below = 0.0
    for k in np.lexsort((-sizes[:, 0], -sizes[:, 1])):
        wide, high = sizes[k] + 2.0 * margin
        row = next((r for r, end in enumerate(ends) if end + wide <= width), None)
        if row is None:
            if wide > width or below + high > 1.0:
                return None
            row = len(ends)
            ends.append(0.0)
            tops.append(below)
            below += float(high)
        places[k] = ends[row] + margin, tops[row] + margin
        ends[row] += float(wide)
    return places
