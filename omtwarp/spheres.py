"""Targets of resampling: triangulated spheres, and grids of pixels.

Every grid has points and cells. The cells are convex polygons of great circles that cover the sphere once, one or more
to each point: the pixels, or around the vertices of a triangulation what is nearer to a vertex than to the other
corners in the triangles' barycentric coordinates.

=======================  ===========================================================================================
``ico0`` to ``ico8``     the icosahedron, each triangle split in four so many times; 10 · 4ⁿ + 2 points, coarse first
``fsaverage3`` to ``7``  the spheres of FreeSurfer's average subjects (642 to 163,842 points; 7 is ``fsaverage``),
                         in FreeSurfer's order of vertices and faces, computed and not rounded to four digits
``healpix:NSIDE``        12 NSIDE² pixels of equal area in ring order [1]_; ``healpix-nested:NSIDE`` in nested order
``equiangular:HxW``      pixels of equal steps in latitude and longitude, laid out as an equirectangular picture:
                         the top row next to the north pole, longitude from -180° at the left
``octahedral:N``         N x N pixels of the sphere folded out into a square over an octahedron [2]_; N is even
=======================  ===========================================================================================

.. [1] K. M. Górski et al., "HEALPix: A Framework for High-Resolution Discretization and Fast Analysis of Data
   Distributed on the Sphere", Astrophys. J. 622 (2005).
.. [2] E. Praun, H. Hoppe, "Spherical Parametrization and Remeshing", ACM Trans. Graph. 22 (2003).
"""

import re
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.flips.exact import flipped_faces
from omtwarp.geometry.sphere_hierarchy import sphere_hierarchy, triangle_solid_angles
from omtwarp.mesh import arrays
from omtwarp.mesh.arrays import TINY, Floats, Ints, normalised, norms
from omtwarp.mesh.shapes import sphere_from_directions

NAMES = "ico0 to ico8, fsaverage3 to fsaverage7, healpix:NSIDE, healpix-nested:NSIDE, equiangular:HxW, octahedral:N"


@dataclass(frozen=True, eq=False)
class SphereGrid:
    """Points on the unit sphere with their cells.

    Attributes:
        name: how messages call it.
        points: unit vectors, float64, shape [N, 3].
        faces: corners counter-clockwise from outside, int32, shape [F, 3]; None for a grid of pixels.
        shape: how N values are laid out: (N,), or (height, width) for pictures, row by row.
        pixel_corners: corners of the pixels' polygons, in order, shape [M, 4, 3]; two are equal in a triangle.
        pixel_owners: the point that each polygon belongs to, shape [M].
        own: how many points and faces are of a surface itself; later ones fill its holes and hold no data. None where
            all are of the surface.
    """

    name: str
    points: Floats
    faces: Ints | None
    shape: tuple[int, ...]
    pixel_corners: Floats | None = None
    pixel_owners: Ints | None = None
    own: tuple[int, int] | None = None

    def __repr__(self) -> str:
        return f"SphereGrid({self.name}, {len(self.points)} points)"

    @cached_property
    def triangles(self) -> Ints:
        """The grid's faces, or the Delaunay triangulation of its points, int32, shape [F, 3]."""
        return sphere_from_directions(self.points).faces if self.faces is None else self.faces

    @property
    def own_points(self) -> int:
        """Number of points that hold data, the first ones."""
        return len(self.points) if self.own is None else self.own[0]

    @property
    def own_triangles(self) -> Ints:
        """The triangles without those that fill holes, int32, shape [F, 3]."""
        return self.triangles if self.own is None else self.triangles[: self.own[1]]

    @cached_property
    def cells(self) -> tuple[Floats, Ints]:
        """Corners [M, 4, 3] of convex spherical polygons that cover the sphere once, and the point of each [M].

        What fills holes has none.

        Raises:
            OmtwarpError: triangles are turned over, so that nothing is covered once.
        """
        if self.pixel_corners is not None and self.pixel_owners is not None:
            return self.pixel_corners, self.pixel_owners
        flips = np.flatnonzero(flipped_faces(self.points, self.triangles))
        if len(flips):
            raise OmtwarpError(
                f"{self.name}: {len(flips)} triangles are turned over, first face {flips[0]}: areas of overlap need a "
                "sphere without flips; use barycentric or nearest"
            )
        return vertex_cells(self.points, self.own_triangles)

    @cached_property
    def areas(self) -> Floats:
        """Area of the cells of every point on the unit sphere, shape [N]; the sum is 4π where no holes are filled."""
        corners, owners = self.cells
        return np.bincount(owners, weights=polygon_areas(corners), minlength=len(self.points)).astype(np.float64)


def polygon_areas(corners: Floats) -> Floats:
    """Return the areas of convex polygons of four great-circle arcs, shape [M], from corners [M, 4, 3]."""
    a, b, c, d = (corners[:, k] for k in range(4))
    return triangle_solid_angles(a, b, c) + triangle_solid_angles(a, c, d)


def vertex_cells(points: Floats, faces: Ints) -> tuple[Floats, Ints]:
    """Split triangles into one quadrilateral per corner: the points nearest to it in barycentric coordinates.

    Its corners are the vertex, the middles of its two edges and the triangle's centre, pushed out to the sphere; seen
    from the centre it is the quadrilateral of the flat triangle, which is convex.
    """
    a, b, c = points.take(faces.T, axis=0)
    ab, bc, ca, centre = normalised(a + b), normalised(b + c), normalised(c + a), normalised(a + b + c)
    quads = [(a, ab, centre, ca), (b, bc, centre, ab), (c, ca, centre, bc)]
    return np.concatenate([np.stack(quad, axis=1) for quad in quads]), faces.T.ravel().astype(np.int32)


def unit_sphere(points: ArrayLike, name: str = "the sphere") -> Floats:
    """Scale the vertices of a sphere about the origin, of any radius, to unit vectors, float64, shape [V, 3].

    Raises:
        OmtwarpError: not three finite numbers per vertex, or distances from the origin that differ by more than 0.1 %.
    """
    array = arrays.in_range(arrays.real_numbers(points, f"{name}: vertices", (None, 3)))
    if len(array) == 0:
        raise OmtwarpError(f"{name}: there are no vertices")
    radii = norms(array)
    low, high = float(radii.min()), float(radii.max())
    # Radii of FreeSurfer's spheres, written with four digits, differ by 7e-5 of their mean.
    if low <= 0.0 or high - low > 1e-3 * high:
        raise OmtwarpError(
            f"{name}: not a sphere about the origin: its vertices are {low:.6g} to {high:.6g} away from there"
        )
    return array / radii[:, None]


def mesh_grid(
    points: ArrayLike, faces: ArrayLike, name: str = "the sphere", own: tuple[int, int] | None = None
) -> SphereGrid:
    """Return a triangulated sphere as a grid.

    Args:
        points: vertices of a sphere about the origin, of any radius, shape [V, 3].
        faces: whole numbers, shape [F, 3].
        name: how messages call it.
        own: see :class:`SphereGrid`.

    Raises:
        OmtwarpError: not a sphere, faces that name other vertices, or triangles that do not cover the sphere once.
    """
    whole_cover = 1e-6  # of the sphere: coverings are whole numbers but for the round-off of a million solid angles
    unit = unit_sphere(points, name)
    corners = arrays.whole_numbers(faces, f"{name}: faces", (None, 3), below=len(unit)).astype(np.int32)
    if len(corners) == 0:
        raise OmtwarpError(f"{name}: there are no faces")
    a, b, c = unit.take(corners.T, axis=0)
    cover = float(triangle_solid_angles(a, b, c).sum() / (4.0 * np.pi))
    if round(cover) == -1 and abs(cover + 1.0) < whole_cover:
        raise OmtwarpError(f"{name}: the triangles are clockwise seen from outside; reverse them")
    if abs(cover - 1.0) > whole_cover:
        raise OmtwarpError(
            f"{name}: its triangles do not cover the sphere once, but {cover:.6g} times: give the sphere of a closed "
            "surface, or the .npz of one with filled holes, which has the filling"
        )
    return SphereGrid(name, unit, corners, (len(unit),), own=own)


def named_grid(name: str) -> SphereGrid:
    """Make a grid from its name (see the module's table).

    Example:
        >>> named_grid("ico2")
        SphereGrid(ico2, 162 points)
        >>> named_grid("healpix:4").shape
        (192,)

    Raises:
        OmtwarpError: no such grid, or one that is out of range.
    """
    # Twice the pixels of the finest grid in use (HEALPix with NSIDE 1024); more is a typing error.
    most_points = 25_165_824
    most_healpix, most_octahedral = 1024, 4096  # pixels along a side: 12.6 and 16.8 million points
    text = name.strip().lower()
    if match := re.fullmatch(r"ico(\d+)", text):
        level = _within(int(match[1]), 0, 8, name)

        hierarchy = sphere_hierarchy(level)
        return SphereGrid(text, hierarchy.vertices.copy(), hierarchy.faces.copy(), (hierarchy.node_count,))
    if match := re.fullmatch(r"fsaverage(\d*)", text):
        level = _within(int(match[1] or 7), 3, 7, name)
        points, faces = freesurfer_icosahedron(level)
        return SphereGrid(text, points, faces, (len(points),))
    if match := re.fullmatch(r"healpix(-nested)?:(\d+)", text):
        return healpix(_within(int(match[2]), 1, most_healpix, name), nested=match[1] is not None)
    if match := re.fullmatch(r"equiangular:(\d+)x(\d+)", text):
        height, width = int(match[1]), int(match[2])
        if height < 2 or width < 4 or height * width > most_points:
            raise OmtwarpError(f"'{name}': use at least 2 rows and 4 columns, and no more than {most_points} pixels")
        return equiangular(height, width)
    if match := re.fullmatch(r"octahedral:(\d+)", text):
        size = _within(int(match[1]), 4, most_octahedral, name)
        if size % 2:
            raise OmtwarpError(f"'{name}': the number of pixels along a side has to be even")
        return octahedral(size)
    raise OmtwarpError(f"there is no sphere '{name}': use {NAMES}, or a file")


def is_named(name: str) -> bool:
    """Return whether a text has the form of a grid's name, whether or not there is such a grid."""
    form = r"(ico|fsaverage)\d*|(healpix(-nested)?|equiangular|octahedral):.*"
    return re.fullmatch(form, name.strip().lower()) is not None


def freesurfer_icosahedron(level: int) -> tuple[Floats, Ints]:
    """Return FreeSurfer's icosahedral sphere: that of ``fsaverage`` at level 7, of ``fsaverage5`` at level 5.

    The subdivided icosahedron in FreeSurfer's order: midpoints are numbered as they are met, triangle by triangle; the
    children at first corners come first, then the other three of each triangle. Faces are those of FreeSurfer's files
    exactly, and coordinates to the four digits that are written there.

    Args:
        level: how often the icosahedron is subdivided, 0 to 7.

    Returns:
        Unit vectors [V, 3] and faces [F, 3], counter-clockwise seen from outside.
    """
    turn = 2.0 * np.pi / 5.0 * np.arange(5)
    z, radius = 1.0 / np.sqrt(5.0), 2.0 / np.sqrt(5.0)
    upper, lower = (
        np.column_stack([radius * np.cos(turn - start), radius * np.sin(turn - start), np.full(5, height)])
        for start, height in ((np.pi * (2.0 / 5.0), z), (np.pi * (3.0 / 5.0), -z))
    )
    points = np.concatenate([[[0.0, 0.0, 1.0]], upper, lower, [[0.0, 0.0, -1.0]]])
    # Clockwise seen from outside while midpoints are numbered.
    faces = np.array(
        [[0, 4, 3], [0, 5, 4], [0, 1, 5], [0, 2, 1], [0, 3, 2], [3, 8, 2], [3, 9, 8], [3, 4, 9], [4, 10, 9], [4, 5, 10]]
        + [[5, 6, 10], [5, 1, 6], [1, 7, 6], [1, 2, 7], [2, 8, 7], [8, 9, 11], [9, 10, 11], [10, 6, 11]]
        + [[6, 7, 11], [7, 8, 11]]
    )
    for _ in range(level):
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        _, first, inverse = np.unique(ends @ [len(points), 1], return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(first))  # in the order in which they are met
        middles = (len(points) + rank[inverse.reshape(-1)]).reshape(-1, 3)
        halved = ends[np.sort(first)]
        points = np.concatenate([points, normalised(points[halved[:, 0]] + points[halved[:, 1]])])
        (a, b, c), (ab, bc, ca) = faces.T, middles.T
        others = np.stack([np.stack(f, axis=1) for f in ((ab, b, bc), (ca, ab, bc), (ca, bc, c))], axis=1)
        faces = np.concatenate([np.stack([a, ab, ca], axis=1), others.reshape(-1, 3)])
    return points, np.ascontiguousarray(faces[:, [0, 2, 1]], dtype=np.int32)


def healpix(side: int, nested: bool = False) -> SphereGrid:
    """Return the HEALPix grid of 12 ``side``² pixels, in ring order or nested (``side`` a power of two).

    Pixels' corners are HEALPix's; arcs of great circles join them, so that areas of cells are equal only nearly.

    Raises:
        OmtwarpError: nested order of a ``side`` that is no power of two.
    """
    name = f"healpix{'-nested' * nested}:{side}"
    if nested and side & (side - 1):
        raise OmtwarpError(f"'{name}': nested order needs a power of two")
    face, y, x = (index.ravel() for index in np.meshgrid(np.arange(12), *[np.arange(side)] * 2, indexing="ij"))
    points = _healpix_points(face, (x + 0.5) / side, (y + 0.5) / side)
    if nested:
        order = np.argsort(side * side * face + _spread_bits(x) + 2 * _spread_bits(y))
    else:
        ring = (_HEALPIX_ROWS[face] + 1) * side - x - y - 1
        order = np.lexsort((np.round(np.arctan2(points[:, 1], points[:, 0]) % (2.0 * np.pi), 12), ring))
    face, x, y = face[order], x[order], y[order]
    steps = ((0, 0), (1, 0), (1, 1), (0, 1))
    corners = np.stack([_healpix_points(face, (x + i) / side, (y + j) / side) for i, j in steps], axis=1)
    return SphereGrid(name, points[order], None, (len(order),), corners, np.arange(len(order), dtype=np.int32))


# Of the centres of the twelve base pixels (Górski et al. 2005, figure 3): rows between the poles at 0 and 4, and
# longitudes in quarters of π.
_HEALPIX_ROWS = np.array([1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3])
_HEALPIX_COLUMNS = np.array([1, 3, 5, 7, 0, 2, 4, 6, 1, 3, 5, 7])


def _healpix_points(face: NDArray[np.int64], x: Floats, y: Floats) -> Floats:
    """Return the unit vectors of points (x, y) of the twelve base pixels, unit squares (Górski et al., section 5)."""
    row = _HEALPIX_ROWS[face] + 1 - x - y
    cap = np.where(row < 1.0, row, np.where(row > 3.0, 4.0 - row, 1.0))
    z = np.where(row < 1.0, 1.0 - cap**2 / 3.0, np.where(row > 3.0, cap**2 / 3.0 - 1.0, (2.0 - row) * 2.0 / 3.0))
    # On the caps 1 - z² is (1 - |z|)(1 + |z|) with 1 - |z| = cap² / 3: no digits are lost next to the poles.
    radius = np.where(np.abs(row - 2.0) > 1.0, cap * np.sqrt((2.0 - cap**2 / 3.0) / 3.0), np.sqrt(1.0 - z * z))
    longitude = np.pi / 4.0 * (_HEALPIX_COLUMNS[face] + (x - y) / np.maximum(cap, TINY))
    return np.stack([radius * np.cos(longitude), radius * np.sin(longitude), z], axis=-1)


def _spread_bits(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """Insert a zero between each two bits of whole numbers below 2^16."""
    out = np.zeros_like(values)
    # Bits, of a place within a base pixel: MOST_HEALPIX has 10
    for k in range(16):
        out |= (values >> k & 1) << 2 * k
    return out


def equiangular(height: int, width: int) -> SphereGrid:
    """Return the grid of pixels with equal steps in latitude and longitude, whose centres are the points."""
    latitude = np.pi / 2.0 - np.pi * np.arange(height + 1) / height
    latitude[[0, -1]] = np.pi / 2.0, -np.pi / 2.0
    longitude = -np.pi + 2.0 * np.pi * np.arange(width + 1) / width
    nodes = arrays.direction_from_angles(longitude[None], latitude[:, None])
    nodes[0], nodes[-1], nodes[:, -1] = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), nodes[:, 0]  # the same to the bit
    corners = np.stack([nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:], nodes[:-1, :-1]], axis=2).reshape(-1, 4, 3)
    middle = (latitude[:-1] + latitude[1:]) / 2.0, (longitude[:-1] + longitude[1:]) / 2.0
    points = arrays.direction_from_angles(middle[1][None], middle[0][:, None]).reshape(-1, 3)
    owners = np.arange(len(points), dtype=np.int32)
    return SphereGrid(f"equiangular:{height}x{width}", points, None, (height, width), corners, owners)


def octahedral(size: int) -> SphereGrid:
    """Return the sphere projected from its centre to an octahedron and folded out.

    The north pole is in the middle, the south pole in the corners.

    Pixels that straddle an edge of the octahedron consist of two triangles.
    """
    steps = np.arange(size + 1) * 2.0 / size - 1.0
    x, y = np.meshgrid(steps, steps[::-1])  # the top row has the largest y
    nodes = arrays.octahedral_directions(x, y)
    square = np.stack([nodes[1:, :-1], nodes[1:, 1:], nodes[:-1, 1:], nodes[:-1, :-1]], axis=2).reshape(-1, 4, 3)
    centres = x[:-1, :-1] + 1.0 / size, y[:-1, :-1] - 1.0 / size
    points = arrays.octahedral_directions(*centres).reshape(-1, 3)
    owners = np.arange(size * size, dtype=np.int32)
    # The fold |x| + |y| = 1 cuts the squares on it in two, from corner to corner.
    across = np.isclose(np.abs(centres[0]) + np.abs(centres[1]), 1.0).ravel()
    falling = ((centres[0] * centres[1]) > 0).ravel()  # the fold runs from the upper left to the lower right
    first = np.where(falling[:, None], [[0, 1, 3, 3]], [[0, 1, 2, 2]])
    second = np.where(falling[:, None], [[1, 2, 3, 3]], [[0, 2, 3, 3]])
    halves = [np.take_along_axis(square, k[:, :, None], axis=1)[across] for k in (first, second)]
    corners = np.concatenate([square[~across], *halves])
    all_owners = np.concatenate([owners[~across], owners[across], owners[across]])
    return SphereGrid(f"octahedral:{size}", points, None, (size, size), corners, all_owners)


def _within(value: int, low: int, high: int, name: str) -> int:
    if not low <= value <= high:
        raise OmtwarpError(f"there is no sphere '{name}': the number goes from {low} to {high}")
    return value
