"""Built-in patterns: functions of direction on the sphere, exact at every resolution and without a seam or a pole.

``circles``, ``puzzle``, ``globe`` and ``checker`` are those of section 5 of the paper. A pattern is called with
directions and gives colours::

    pattern("circles", count=162)(directions)  # [N, 3] -> [N, 3], red, green and blue in 0..1

They need no file and no network. The coastlines of the globe are Natural Earth's (public domain), simplified.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from functools import cached_property, lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.shapes import icosphere
from omtwarp.texturing import pattern_kernels as kernels
from omtwarp.texturing.atlas import CUBE_FRAMES
from omtwarp.texturing.coastlines import coastline_segments
from omtwarp.texturing.cutting import normalised
from omtwarp.texturing.projection import direction_from_angles, longitude_latitude

Floats = NDArray[np.float64]

REPULSIONS = 120  # rounds: with 30 to 240 the nearest two of 150 points are 0.272 to 0.277 apart
STORED = 162  # circles, the default, whose places are in a file: computing them takes 0.05 s
MOST_CIRCLES = 20_000  # whose repulsion takes 6.5 s
BESIDE = 1e-7  # degrees beside a multiple of the data's hundredth: no parallel goes through a vertex of a coast
NO_REACH = 1e-6  # degrees that an edge of the map, which is no coast, is seen from
WITHIN = 1e-9  # chord that is added to a circle's reach, so that rounding leaves no cell's list without it
SAME_PLACE = 1e-6  # chord: places on the two sides of an edge are the same, or a quarter of a side apart
CELL = 0.7  # side, in radii of circles, of the cells of a cube on which circles are looked up
MOST_CELLS = 128  # along the side of a face of that cube


def _colours(*names: str) -> Floats:
    return np.array([[int(name[k : k + 2], 16) for k in (1, 3, 5)] for name in names]) / 255.0


class Pattern(ABC):
    """A colour for every direction on the sphere.

    Attributes:
        name: as in ``PATTERNS``.
    """

    name: str

    def __call__(self, directions: ArrayLike, device: str | wp.Device = "cpu") -> Floats:
        """Return the colours of directions of any length, shape [N, 3], as float64 from 0 to 1, shape [N, 3]."""
        d = np.ascontiguousarray(np.asarray(directions, dtype=np.float64).reshape(-1, 3))
        where = resolve_device(device)
        out = wp.empty((len(d), 3), dtype=wp.float64, device=where)
        if len(d):
            self.launch(wp.array(d, dtype=wp.vec3d, device=where), out)
        return out.numpy()

    def launch(self, directions: wp.array, out: wp.array) -> wp.array:
        """Colour an array of directions (vec3d, shape [N]) into ``out`` (float64, shape [>= N, 3]) on their device.

        Returns:
            The reach of every direction, float64, shape [N]: an angle in radians within which there is no edge.
        """
        device = directions.device
        inputs = self._inputs(device)
        reach = wp.empty(len(directions), dtype=wp.float64, device=device)
        launch_parts(
            self._kernel,
            len(directions),
            lambda part: ([directions[part], *inputs], [out[part], reach[part]]),
            device,
        )
        return reach

    _kernel: wp.Kernel

    def _inputs(self, device: wp.Device) -> list[object]:
        if not hasattr(self, "_uploaded"):
            self._uploaded: dict[str, list[object]] = {}
        if device.alias not in self._uploaded:
            self._uploaded[device.alias] = [
                wp.array(np.ascontiguousarray(x[0]), dtype=x[1], device=device) if isinstance(x, tuple) else x
                for x in self._tables()
            ]
        return self._uploaded[device.alias]

    @abstractmethod
    def _tables(self) -> list[object]:
        """Return the kernel's inputs that stand between the directions and the output.

        A pair (array, Warp dtype) is uploaded once per device.
        """


class Checker(Pattern):
    """Fields of a chess board, equal in longitude and in latitude.

    Args:
        columns: fields around the equator, an even number.
        rows: fields from pole to pole.
    """

    name = "checker"
    _kernel = kernels.checker_colours

    def __init__(self, columns: int = 24, rows: int = 12):
        if columns < 2 or columns % 2 or rows < 1:
            raise OmtwarpError(f"checker: {columns} columns and {rows} rows: columns must be even and both positive")
        self.columns, self.rows = int(columns), int(rows)
        self.colours = _colours("#f3ede2", "#2f5d73")

    @property
    def count(self) -> int:
        """The number of fields."""
        return self.columns * self.rows

    def cells(self, directions: ArrayLike) -> NDArray[np.int64]:
        """Return the number of the field that each direction lies in, row by row from the north-west, shape [N]."""
        lon, lat = longitude_latitude(directions)
        column = np.clip(np.floor((lon / (2.0 * np.pi) + 0.5) * self.columns), 0, self.columns - 1)
        row = np.clip(np.floor((0.5 - lat / np.pi) * self.rows), 0, self.rows - 1)
        return (row * self.columns + column).astype(np.int64)

    def _tables(self) -> list[object]:
        return [self.columns, self.rows, (self.colours, wp.vec3d)]


class Circles(Pattern):
    """Circles (spherical caps) of one size, spread evenly: every one covers the same area of the sphere.

    The centres start from the vertices of a geodesic icosahedron where ``count`` is 10 f² + 2 and from a Fibonacci
    spiral otherwise, and repel each other until they are even.

    Args:
        count: how many.
        coverage: part of the sphere that they cover together.

    Attributes:
        centres: unit vectors, shape [count, 3].
        radius: angle in radians; a circle's area is 2π (1 - cos radius).
        groups: which of the palette's colours each one has, shape [count].
    """

    name = "circles"
    _kernel = kernels.circle_colours

    def __init__(self, count: int = STORED, coverage: float = 0.56):
        if not 4 <= count <= MOST_CIRCLES or not 0 < coverage < 1:
            raise OmtwarpError(f"circles: count {count}, coverage {coverage}: give 4 to 20000 circles, a share below 1")
        self.count = int(count)
        self.palette = _colours("#1f6f78", "#e2725b", "#f0b95b", "#5b8e7d", "#35507a", "#b5838d")
        self.background = _colours("#f6f1e7")[0]
        self.centres, self.groups = stored_circles() if self.count == STORED else self.spread(self.count)
        self.radius = float(np.arccos(1.0 - 2.0 * coverage / self.count))
        _, gap = _neighbours(self.centres, 1)
        if 2.0 * self.radius >= gap.min():
            most = 0.5 * self.count * (1.0 - np.cos(gap.min() / 2.0))
            raise OmtwarpError(
                f"circles: {self.count} circles over {coverage:.2f} of the sphere touch: at most {most:.2f}"
            )

    def spread(self, count: int) -> tuple[Floats, NDArray[np.int32]]:
        """Compute the centres of so many circles, shape [count, 3], and their groups, shape [count]."""
        from scipy.spatial import ConvexHull

        centres = _even_points(count)
        triangles = ConvexHull(centres).simplices
        return centres, _colour_groups(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), len(self.palette))

    def cells(self, directions: ArrayLike) -> NDArray[np.int64]:
        """Return the number of the circle that each direction lies in, -1 between the circles, shape [N]."""
        from scipy.spatial import cKDTree

        distance, index = cKDTree(self.centres).query(normalised(np.asarray(directions, dtype=np.float64)))
        return np.where(distance <= 2.0 * np.sin(0.5 * self.radius), index, -1).astype(np.int64)

    def _tables(self) -> list[object]:
        side = int(np.clip(2.0 / (CELL * self.radius), 1, MOST_CELLS))
        middle = (np.arange(side) + 0.5) * 2.0 / side - 1.0
        cells = np.empty((6, side, side, 3))  # of the faces +x, +y, -x, -y, +z, -z of a cube
        for face, (axis, sign) in enumerate(((0, 1.0), (1, 1.0), (0, -1.0), (1, -1.0), (2, 1.0), (2, -1.0))):
            cells[face, :, :, axis] = sign
            cells[face, :, :, (axis + 1) % 3] = middle[None, :]
            cells[face, :, :, (axis + 2) % 3] = middle[:, None]
        half = np.sqrt(2.0) / side  # no cell reaches farther than this from its middle
        beyond = 0.5 * half  # and of circles outside of a cell's list no edge is nearer to it than this
        from scipy.spatial import cKDTree

        chord = 2.0 * np.sin(min(self.radius + half + beyond, np.pi) / 2.0) + WITHIN
        tree = cKDTree(self.centres)
        lists = tree.query_ball_point(normalised(cells.reshape(-1, 3)), chord, return_sorted=True)
        offsets = np.concatenate([[0], np.cumsum([len(x) for x in lists])]).astype(np.int32)
        members = np.concatenate([np.asarray(x, dtype=np.int32) for x in lists] + [np.zeros(1, dtype=np.int32)])
        inner = self.palette[self.groups]
        background = wp.vec3d(*self.background)
        return [
            side,
            (offsets, wp.int32),
            (members, wp.int32),
            (self.centres, wp.vec3d),
            (inner, wp.vec3d),
            (inner * 0.8, wp.vec3d),
            wp.float64(4.0 * np.sin(0.5 * self.radius) ** 2),
            wp.float64(4.0 * np.sin(0.455 * self.radius) ** 2),
            wp.float64(beyond),
            background,
        ]


class Puzzle(Pattern):
    """A jigsaw puzzle: six faces of a cube blown up to the sphere, ``side`` by ``side`` pieces each.

    Args:
        side: pieces along the side of a face of the cube; 6 side² pieces in all.
        seed: which pieces have their tabs on which side.
    """

    name = "puzzle"
    _kernel = kernels.puzzle_colours

    def __init__(self, side: int = 5, seed: int = 7):
        if not 1 <= side <= 64:
            raise OmtwarpError(f"puzzle: {side} pieces along a side: give 1 to 64")
        self.side, self.seed = int(side), int(seed)
        self.palette = _colours("#4f8fa8", "#e9c46a", "#e08e6d", "#86b08a", "#c9ada7", "#f1e3c6")
        self.line_colour = _colours("#2b2f3a")[0]

    @property
    def count(self) -> int:
        """The number of pieces."""
        return 6 * self.side**2

    def middles(self) -> Floats:
        """Return the directions of the middles of the pieces, shape [count, 3]."""
        piece = np.arange(self.count)
        row, column = piece // self.side % self.side, piece % self.side
        return self._points(piece // self.side**2, column + 0.5, row + 0.5)

    def _points(self, face: NDArray, x: NDArray, y: NDArray) -> Floats:
        """Return the directions of points of faces, in pieces from the lower left corner."""
        slope = np.tan((np.stack([x, y], axis=-1) / self.side * 2.0 - 1.0) * np.pi / 4.0)
        local = np.concatenate([np.ones_like(slope[..., :1]), slope], axis=-1)
        return normalised(np.einsum("...i,...ij->...j", local, CUBE_FRAMES[face]))

    @cached_property
    def _edges(self) -> tuple[NDArray, NDArray, Floats]:
        """Return, for every side of every piece, its neighbour, tab (1 own, 0 the neighbour's) and tab's shift."""
        n = self.side
        piece = np.arange(self.count)
        face, row, column = piece // n**2, piece // n % n, piece % n

        def on_edge(s: float) -> Floats:
            """Return the points at s on the bottom, right, top and left side, in the kernel's order, [P, 4, 3]."""
            places = [(s, 0.0), (1.0, s), (s, 1.0), (0.0, s)]
            return np.stack([self._points(face, column + x, row + y) for x, y in places], axis=1)

        from scipy.spatial import cKDTree

        middle = on_edge(0.5).reshape(-1, 3)
        _, partner = cKDTree(middle).query(middle, k=2)
        own = np.arange(len(middle))
        other = np.where(partner[:, 0] == own, partner[:, 1], partner[:, 0])
        rng = np.random.default_rng(self.seed)
        first = np.minimum(own, other)
        tab = (rng.integers(0, 2, len(own))[first] ^ (own > other)).astype(np.int32)
        # The two pieces may run along their common side in opposite ways.
        quarter = on_edge(0.25).reshape(-1, 3)
        same_way = np.linalg.norm(quarter - quarter[other], axis=1) < SAME_PLACE
        shift = rng.uniform(-0.07, 0.07, len(own))[first]
        shift = np.where((own > other) & ~same_way, -shift, shift)
        return (other // 4).reshape(-1, 4).astype(np.int32), tab.reshape(-1, 4), shift.reshape(-1, 4)

    def _tables(self) -> list[object]:
        neighbours, tabs, shifts = self._edges
        pairs = np.stack([np.repeat(np.arange(self.count), 4), neighbours.ravel()], axis=1)
        return [
            (CUBE_FRAMES, wp.mat33d),
            self.side,
            (neighbours, wp.int32),
            (tabs, wp.int32),
            (shifts, wp.float64),
            (self.palette[_colour_groups(pairs, len(self.palette))], wp.vec3d),
            wp.float64(0.016),
            wp.vec3d(*self.line_colour),
        ]


class Globe(Pattern):
    """Land, sea and graticule.

    Args:
        step: degrees between the lines of the graticule.
    """

    name = "globe"
    _kernel = kernels.globe_colours
    coast_width, shelf_width, line_width = 0.32, 3.0, 0.3  # degrees

    def __init__(self, step: float = 15.0):
        if not 1.0 <= step <= 90.0 or 90.0 % step:
            raise OmtwarpError(f"globe: graticule every {step} degrees: give a divisor of 90, from 1")
        self.step = float(step)
        self.palette = _colours("#1d5376", "#3b7894", "#5f9fae", "#c3b585", "#eef1ee", "#4b4a3c", "#f2f0e6")

    def _tables(self) -> list[object]:
        columns, rows = 720, 360
        pieces, real, offsets, members, land = _coast_table(columns, rows, self.shelf_width)
        return [
            columns,
            rows,
            (offsets, wp.int32),
            (members, wp.int32),
            (pieces, wp.vec4d),
            (real, wp.int32),
            (land, wp.int32),
            (self.palette, wp.vec3d),
            wp.float64(self.coast_width),
            wp.float64(self.shelf_width),
            wp.float64(self.step),
            wp.float64(self.line_width),
        ]


PATTERNS: dict[str, type[Pattern]] = {p.name: p for p in (Circles, Puzzle, Globe, Checker)}


@lru_cache(maxsize=16)
def _default(name: str) -> Pattern:
    return PATTERNS[name]()


def pattern(name: str | Pattern, **options: int | str) -> Pattern:
    """Return a built-in pattern by name, with the options of its class.

    Raises:
        OmtwarpError: a name that does not exist, or an option that the pattern does not have.
    """
    if isinstance(name, Pattern):
        return name
    if name not in PATTERNS:
        *most, last = PATTERNS
        raise OmtwarpError(f"unknown pattern '{name}': use {', '.join(most)} or {last}")
    if not options:
        return _default(name)
    try:
        return PATTERNS[name](**options)
    except TypeError as error:
        raise OmtwarpError(f"pattern {name}: {error}") from error


def stored_circles() -> tuple[Floats, NDArray[np.int32]]:
    """Read the centres and groups of the default number of circles, as :meth:`Circles.spread` computes them."""
    with (files("omtwarp.texturing") / "assets" / "circles.npy").open("rb") as stream:
        table = np.load(stream)
    return np.ascontiguousarray(table[:, :3]), table[:, 3].astype(np.int32)


def _even_points(count: int) -> Floats:
    """Spread points evenly over the sphere, shape [count, 3]; they are the same every time."""
    frequency = round(((count - 2) / 10.0) ** 0.5)
    if count > 12 and 10 * frequency**2 + 2 == count:
        points = icosphere(frequency).vertices
    else:
        k = np.arange(count) + 0.5
        points = direction_from_angles(k * np.pi * (3.0 - 5.0**0.5), np.arcsin(1.0 - 2.0 * k / count))
    # Repulsion by the inverse fourth power of the distance to the nearest few: the closest pair moves apart first.
    spacing = (4.0 * np.pi / count) ** 0.5
    for _ in range(REPULSIONS):
        near, _ = _neighbours(points, min(7, count - 1))
        apart = points[:, None, :] - points[near]
        distance = np.linalg.norm(apart, axis=2, keepdims=True)
        push = (apart / distance * (spacing / distance) ** 4).sum(axis=1)
        push -= np.einsum("ij,ij->i", push, points)[:, None] * points
        points = normalised(points + 0.02 * spacing * push)
    return points


def _neighbours(points: Floats, count: int) -> tuple[NDArray, Floats]:
    """Return the nearest other points of each, nearest first, [N, count], and the angle to the first, shape [N]."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree(points).query(points, k=count + 1)
    return index[:, 1:], 2.0 * np.arcsin(np.minimum(distance[:, 1] / 2.0, 1.0))


def _colour_groups(neighbours: NDArray, colours: int) -> NDArray[np.int32]:
    """Colour every cell unlike its neighbours, using colours as evenly as that allows, shape [N].

    Cells are coloured in smallest-last order (Matula and Beck, J. ACM 30, 1983): in a planar graph every cell meets
    at most five coloured neighbours then, so that six colours always suffice.

    Args:
        neighbours: pairs of neighbouring cells, shape [E, 2].
        colours: how many there are.
    """
    count = int(neighbours.max()) + 1
    around: list[set[int]] = [set() for _ in range(count)]
    for one, other in neighbours.tolist():  # a few hundred cells of a pattern, not elements of a mesh
        around[one].add(other)
        around[other].add(one)
    degree = [len(x) for x in around]
    queue = [(degree[cell], cell) for cell in range(count)]
    heapq.heapify(queue)
    removed = [False] * count
    order = []
    while queue:
        d, cell = heapq.heappop(queue)
        if removed[cell] or d != degree[cell]:
            continue
        removed[cell] = True
        order.append(cell)
        for other in around[cell]:
            if not removed[other]:
                degree[other] -= 1
                heapq.heappush(queue, (degree[other], other))
    group = np.full(count, -1, dtype=np.int32)
    used = np.zeros(colours, dtype=np.int64)
    for cell in reversed(order):
        taken = np.zeros(colours, dtype=bool)
        taken[[group[other] for other in around[cell] if group[other] >= 0]] = True
        group[cell] = np.lexsort((used, taken))[0]
        used[group[cell]] += 1
    return group


@lru_cache(maxsize=2)
def _coast_table(columns: int, rows: int, reach: float) -> tuple[NDArray, ...]:
    """Return a grid over longitude and latitude with the coast pieces near each cell, and whether its centre is land.

    Returns:
        pieces [S, 4] (two ends, degrees), which of them are coast rather than edge of the map [S], offsets and members
        of the cells' lists, and whether the centre of every cell is land.
    """
    segments = coastline_segments()
    a, b = segments[:, 0], segments[:, 1]
    height = 180.0 / rows
    # Land at the centres, row by row: the number of crossings of the parallel to the west of the centre is odd.
    centre = (np.arange(columns) + 0.5) * 360.0 / columns - 180.0
    land = np.zeros((rows, columns), dtype=np.int32)
    for row in range(rows):
        y = (row + 0.5) * height - 90.0 + BESIDE
        cut = (a[:, 1] < y) != (b[:, 1] < y)
        x = a[cut, 0] + (y - a[cut, 1]) / (b[cut, 1] - a[cut, 1]) * (b[cut, 0] - a[cut, 0])
        land[row] = np.searchsorted(np.sort(x), centre) & 1
    edge = (np.abs(a[:, 0]) >= 179.995) & (np.abs(b[:, 0]) >= 179.995)
    edge |= (a[:, 1] <= -89.995) & (b[:, 1] <= -89.995)
    # Copies beyond ±180 degrees let distances to the coast cross the map's edge.
    west, east = (segments[..., 0].min(axis=1) < -150) & ~edge, (segments[..., 0].max(axis=1) > 150) & ~edge
    pieces = np.concatenate([segments, segments[west] + (360.0, 0.0), segments[east] - (360.0, 0.0)])
    real = np.concatenate([~edge, np.ones(west.sum() + east.sum(), dtype=bool)]).astype(np.int32)

    low, high = pieces.min(axis=1), pieces.max(axis=1)
    farthest = np.minimum(np.maximum(np.abs(low[:, 1]), np.abs(high[:, 1])) + reach, 88.0)
    wide = reach / np.cos(np.deg2rad(farthest))
    wide, tall = np.where(real == 1, wide, NO_REACH), np.where(real == 1, reach, NO_REACH)
    first = np.stack([(low[:, 0] - wide + 180.0) * columns / 360.0, (low[:, 1] - tall + 90.0) / height], axis=1)
    last = np.stack([(high[:, 0] + wide + 180.0) * columns / 360.0, (high[:, 1] + tall + 90.0) / height], axis=1)
    limit = np.array([columns - 1, rows - 1])
    seen = np.all((last >= 0) & (first <= limit + 1), axis=1)
    first, last = (np.clip(np.floor(x), 0, limit).astype(np.int64) for x in (first, last))
    size = np.where(seen[:, None], last - first + 1, 0)
    number = size.prod(axis=1)
    piece = np.repeat(np.arange(len(pieces)), number)
    local = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
    x = first[piece, 0] + local % np.maximum(size[piece, 0], 1)
    y = first[piece, 1] + local // np.maximum(size[piece, 0], 1)
    cell = y * columns + x
    order = np.argsort(cell, kind="stable")
    offsets = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=rows * columns))]).astype(np.int32)
    members = piece[order].astype(np.int32)
    return pieces.reshape(-1, 4), real, offsets, members, land.ravel()
