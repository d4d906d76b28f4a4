"""The three ways of laying the sphere out on a picture: equirectangular, cube map and octahedral map.

An atlas defines where the mesh has to be cut so that no triangle straddles two charts, where a point of a chart lies on
the picture, and which direction a texel shows, gutters included. Image coordinates are (u, v) in 0..1 with v up.

* ``equirectangular``: one chart; cut along one meridian, from pole to pole. u wraps, so the sampler has to repeat in u.
* ``cube``: six charts, each an equiangular cube face (the angle, not its tangent, is linear in the picture, which keeps
  the texels within a factor 1.3 of equal area [1]_). No seam is drawn across a pole. The charts lie in three by two
  cells or, on a picture twice as wide as high, in four by two of which two are empty. Where three by two cells do not
  fill a picture whose sides are powers of two, what is left is one colour.
* ``octahedral``: the sphere folded out into one square [2]_, the south pole in its four corners.

Cube and octahedral pictures have a gutter whose texels show the sphere beyond the border, so that bilinear filtering
and mip maps have no seams. The equirectangular one has no seam either, but its texels are stretched so
much next to the poles that a viewer which chooses mip maps by the larger stretch blurs everything there.

.. [1] C. Ronchi, R. Iacono, P. S. Paolucci, "The 'Cubed Sphere'", J. Comput. Phys. 124 (1996).
.. [2] Z. Cigolle et al., "A Survey of Efficient Representations for Independent Unit Vectors", JCGT 3 (2014).
"""

from abc import ABC, abstractmethod
from enum import IntEnum
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError, check_word
from omtwarp.files.limits import LONGEST_SIDE, MOST_TEXELS
from omtwarp.mesh import arrays
from omtwarp.mesh.arrays import TINY, Floats, Ints, direction_from_angles, normalised, octahedral_directions
from omtwarp.options import AtlasName

ATLASES = tuple(AtlasName)
QUARTER = np.pi / 4.0

# normal, right and up of the six faces of the cube; right x up = normal, so that nothing is mirrored from outside
_NORMAL = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=np.float64)
_UP = np.array([[0, 0, 1]] * 4 + [[-1, 0, 0], [1, 0, 0]], dtype=np.float64)
CUBE_FRAMES = np.stack([_NORMAL, np.cross(_UP, _NORMAL), _UP], axis=1) + 0.0  # which makes -0 and 0 the same bits

SIZE = 2048  # texels across a picture where no size is given


# Sine of the angle below which a point counts as lying on a cut: far below any texel, far above round-off.
ON_CUT = 1e-9


class Arc(NamedTuple):
    """A piece of a great circle: the points with ``normal · p = 0`` and ``h · p > 0`` for every half-space h."""

    normal: ArrayLike
    half_spaces: tuple[ArrayLike, ...] = ()


class Kind(IntEnum):
    """Kinds of picture; the first three are the atlases, the last is one that repeats both ways."""

    EQUIRECTANGULAR, CUBE, OCTAHEDRAL, SINUSOIDAL, REPEATED = 0, 1, 2, 3, 4


class Atlas(ABC):
    """The base class of the three atlases.

    Attributes:
        name: one of ``ATLASES``.
        width, height: size of the picture in texels.
        kind: argument of the kernels (see :mod:`omtwarp.texturing.kernels`).
        parameters: more of them: longitude of the left border (equirectangular) or side of a cell (cube) in texels, and
            gutter in texels.
        texel_angle: roughly the smallest angle, in radians, that the side of a texel covers.
        wraps: whether u is periodic.
        corners: directions that must be vertices of the mesh.
        arcs: where the mesh is cut.
    """

    name: str
    kind: Kind
    texel_angle: float
    parameters: tuple[float, float]
    wraps = False
    gutter = 0
    corners: tuple[tuple[float, ...], ...] = ()
    arcs: tuple[Arc, ...] = ()
    chart_count = 1

    def __init__(self, width: int, height: int):
        self.width, self.height = int(width), int(height)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.width}x{self.height})"

    @property
    def row_lengths(self) -> Ints:
        """How many texels of every row, from the left, charts and gutters cover, shape [H]; the rest is empty."""
        return np.full(self.height, self.width, dtype=np.int32)

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Which texels charts and gutters cover, shape [H, W]."""
        return np.arange(self.width) < self.row_lengths[:, None]

    @property
    def texels(self) -> Ints:
        """Numbers of the texels that charts and gutters cover, row by row."""
        return np.flatnonzero(self.covered).astype(np.int32)

    def fill_empty(self, picture: NDArray[np.generic]) -> None:
        """Fill the texels of a picture [H, W, C] that no chart covers with the mean colour of the others."""
        # Mean samples: texels along a side that the mean colour of a picture is taken from
        step = max(self.width // 256, 1)
        mean = picture[::step, ::step][self.covered[::step, ::step]].mean(axis=0, dtype=np.float64)
        colour = np.rint(mean) if picture.dtype == np.uint8 else mean
        for row, length in zip(picture, self.row_lengths.tolist(), strict=True):
            row[length:] = colour

    @abstractmethod
    def charts(self, directions: Floats) -> Ints:
        """Return the chart of every direction, shape [N]."""

    @abstractmethod
    def corner_uv(self, points: Floats, chart: NDArray) -> Floats:
        """Return the image coordinates of the corners of triangles that lie in one chart each.

        Args:
            points: corners, of any length, shape [F, 3, 3].
            chart: shape [F].
        """

    @abstractmethod
    def uv_directions(self, uv: Floats, chart: NDArray) -> Floats:
        """Return the unit vectors of points of charts, shape [N, 3], from their uv [N, 2] and charts [N]."""

    def uv(self, directions: Floats) -> Floats:
        """Return the image coordinates of directions, each in the chart it falls in, shape [N, 2]."""
        points = np.repeat(np.asarray(directions, dtype=np.float64)[:, None, :], 3, axis=1)
        return self.corner_uv(points, self.charts(points[:, 0]))[:, 0]


class Equirectangular(Atlas):
    """Longitude and latitude, linear in the picture; the picture's left border is the seam's meridian.

    Attributes:
        seam: longitude of the cut in radians; π is the customary place.
    """

    name, kind, wraps = "equirectangular", Kind.EQUIRECTANGULAR, True
    corners = ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))

    def __init__(self, width: int, height: int, seam: float = np.pi):
        super().__init__(width, height)
        self.seam, self.texel_angle = arrays.real_number(seam, "seam"), np.pi / height
        self.parameters = self.seam - np.pi, 0.0
        # The cut is the half-plane y = 0, x < 0 after a rotation that brings the seam to longitude π. At π that
        # rotation is exactly the identity.
        self._cos, self._sin = float(np.cos(np.pi - self.seam)), float(np.sin(np.pi - self.seam))
        self.arcs = (Arc((self._sin, self._cos, 0.0), ((-self._cos, self._sin, 0.0),)),)

    def charts(self, directions: Floats) -> Ints:
        return np.zeros(len(directions), dtype=np.int32)

    def corner_uv(self, points: Floats, chart: NDArray) -> Floats:
        x, y, z = np.moveaxis(points, -1, 0)
        x, y = self._cos * x - self._sin * y, self._sin * x + self._cos * y
        length = np.sqrt(x * x + y * y + z * z)
        across = np.hypot(x, y)
        u = 0.5 + np.arctan2(y, x) / (2.0 * np.pi)
        v = 0.5 + np.arctan2(z, across) / np.pi
        # A corner on the seam belongs to the side on which its triangle lies.
        on_seam = (np.abs(y) <= ON_CUT * length) & (x < 0)
        east = np.where(on_seam, 0.0, y).sum(axis=1) > 0
        u = np.where(on_seam, east[:, None].astype(np.float64), u)
        # A pole has every longitude: in every triangle it takes the middle of the longitudes of the other corners.
        pole = across <= ON_CUT * length
        mean = np.where(pole, 0.0, u).sum(axis=1) / np.maximum((~pole).sum(axis=1), 1)
        u = np.where(pole, mean[:, None], u)
        v = np.where(pole, (z > 0).astype(np.float64), v)
        return np.stack([u, v], axis=-1)

    def uv_directions(self, uv: Floats, chart: NDArray) -> Floats:
        lon = (uv[..., 0] - 0.5) * 2.0 * np.pi + (self.seam - np.pi)
        return direction_from_angles(lon, (uv[..., 1] - 0.5) * np.pi)


def angles_from_middle(corners: Floats, chart: NDArray) -> Floats:
    """Return the angles of corners from the middles of a cube's faces, to the right and upwards, shape [F, 3, 2]."""
    local = np.einsum("fkj,fij->fki", corners, CUBE_FRAMES[chart])
    return np.arctan2(local[..., 1:], local[..., :1])


class Cube(Atlas):
    """Six equiangular cube faces in two rows of cells at the top left of the picture, +x +y -x -y +z -z.

    Three cells lie in a row, or four where the picture is twice as wide as high.

    Args:
        cell: side of a cell in texels.
        gutter: texels around a face that continue it; a 24th of a cell by default.
        size: width and height of the picture; by default those of three by two cells.
    """

    name, kind, chart_count = "cube", Kind.CUBE, 6
    corners = tuple(product((-1.0, 1.0), repeat=3))

    def __init__(self, cell: int, gutter: int | None = None, size: tuple[int, int] | None = None):
        width, height = (3 * cell, 2 * cell) if size is None else size
        super().__init__(width, height)
        self.cell = int(cell)
        self.columns = 4 if width == 2 * height else 3
        self.gutter = max(2, self.cell // 24) if gutter is None else int(gutter)
        self._inner = self.cell - 2 * self.gutter  # texels along a face
        self.parameters, self.texel_angle = (float(cell), float(self.gutter)), 2.0 * QUARTER / self._inner
        axes = np.eye(3)
        self.arcs = tuple(  # the edges of the cube that run along an axis lie in the planes |a| = |b|
            Arc(sa * axes[k - 2] - sb * axes[k - 1], (sa * axes[k - 2] + axes[k], sa * axes[k - 2] - axes[k]))
            for k, sa, sb in product(range(3), (-1.0, 1.0), (-1.0, 1.0))
        )

    @property
    def row_lengths(self) -> Ints:
        lengths = np.zeros(self.height, dtype=np.int32)
        lengths[: self.cell] = self.columns * self.cell
        lengths[self.cell : 2 * self.cell] = (self.chart_count - self.columns) * self.cell
        return lengths

    def charts(self, directions: Floats) -> Ints:
        axis = np.argmax(np.abs(directions), axis=-1)
        value = np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0]
        return np.array([[0, 2], [1, 3], [4, 5]], dtype=np.int32)[axis, (value < 0).astype(int)]

    def corner_uv(self, points: Floats, chart: NDArray) -> Floats:
        angle = angles_from_middle(points, chart)
        limit = QUARTER * self.cell / self._inner  # a folded triangle must not reach another chart
        texel = self.gutter + (np.clip(angle, -limit, limit) / QUARTER + 1.0) * (0.5 * self._inner)
        left, bottom = self._corner(chart[:, None])
        return np.stack([(left + texel[..., 0]) / self.width, (bottom + texel[..., 1]) / self.height], axis=-1)

    def _corner(self, chart: NDArray) -> tuple[NDArray, NDArray]:
        """Return the lower left corners of charts' cells in texels, v up."""
        return chart % self.columns * self.cell, self.height - (1 + chart // self.columns) * self.cell

    def uv_directions(self, uv: Floats, chart: NDArray) -> Floats:
        left, bottom = self._corner(chart)
        texel = np.stack([uv[..., 0] * self.width - left, uv[..., 1] * self.height - bottom], axis=-1)
        slope = np.tan(((texel - self.gutter) / (0.5 * self._inner) - 1.0) * QUARTER)
        local = np.concatenate([np.ones_like(slope[..., :1]), slope], axis=-1)
        return normalised(np.einsum("...i,...ij->...j", local, CUBE_FRAMES[chart]))


class Octahedral(Atlas):
    """The octahedron |x| + |y| + |z| = 1 folded out into a square: the north pole in the middle."""

    name, kind, chart_count = "octahedral", Kind.OCTAHEDRAL, 8
    arcs = (Arc((1.0, 0.0, 0.0)), Arc((0.0, 1.0, 0.0)), Arc((0.0, 0.0, 1.0)))
    corners = ((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), *Equirectangular.corners)

    def __init__(self, size: int):
        super().__init__(size, size)
        self.gutter = max(2, int(size) // 64)
        self.parameters = 0.0, float(self.gutter)
        self._inner = (self.width - 2 * self.gutter) / self.width  # the share of a side that is no gutter
        self.texel_angle = 2.0 / (size - 2 * self.gutter)  # at the poles; up to 2.4 times that in an octant's middle

    def charts(self, directions: Floats) -> Ints:
        negative = np.asarray(directions) < 0
        return (negative[..., 0] + 2 * negative[..., 1] + 4 * negative[..., 2]).astype(np.int32)

    def corner_uv(self, points: Floats, chart: NDArray) -> Floats:
        # Signs come from the chart, sizes from the point: a corner on a border goes to its triangle's side.
        p = np.abs(points) / np.maximum(np.abs(points).sum(axis=-1, keepdims=True), TINY)
        south = (chart & 4 != 0)[:, None]
        x, y = np.where(south, 1.0 - p[..., 1], p[..., 0]), np.where(south, 1.0 - p[..., 0], p[..., 1])
        sign = np.stack([1.0 - 2.0 * (chart & 1), 1.0 - (chart & 2)], axis=-1)[:, None, :]
        return 0.5 + 0.5 * self._inner * sign * np.stack([x, y], axis=-1)

    def uv_directions(self, uv: Floats, chart: NDArray) -> Floats:
        x, y = np.moveaxis((uv - 0.5) * (2.0 / self._inner), -1, 0)
        return octahedral_directions(x, y)


def make_atlas(name: str, size: int | tuple[int, int] | None = None, *, seam: float = np.pi) -> Atlas:
    """Return an atlas by name.

    Args:
        name: ``equirectangular``, ``cube`` or ``octahedral``.
        size: width of the picture in texels; by default 2048. An equirectangular one may be (width, height). A cube
            map is square where the width is a power of two, otherwise 3 : 2 and rounded down to a multiple of twelve;
            it may be (width, width) or (width, width / 2) too.
        seam: longitude of the equirectangular cut, in radians.

    Raises:
        OmtwarpError: an unknown name, a size that is not a whole number from 16 to 32768, or sides that the atlas has
            not.
    """
    check_word("atlas", name, ATLASES)
    pair = check_size(SIZE if size is None else size)
    if len(pair) == 2 and name == "octahedral":
        raise OmtwarpError(f"texture size {size!r}: the octahedral atlas takes a width only")
    width = pair[0]
    atlas: Atlas
    if name == "equirectangular":
        atlas = Equirectangular(width, pair[1] if len(pair) == 2 else max(width // 2, 1), seam)
    else:
        atlas = _cube(pair) if name == "cube" else Octahedral(width)
    if atlas.width * atlas.height > MOST_TEXELS:
        texels = f"{atlas.width} x {atlas.height} texels"
        raise OmtwarpError(f"texture size {size!r}: {texels}, and {MOST_TEXELS / 1e6:.0f} million is the most")
    return atlas


def _cube(sides: tuple[int, ...]) -> Cube:
    """Return a cube map of a width, or of a width and a height."""
    least_square = 32  # texels: in a square one that is smaller no three cells of a cube map fit with their gutters
    width = sides[0]
    cell = max(width // 12, 2) * 4  # a multiple of four: so many mip maps have whole texels along the borders of cells
    square = width >= least_square and width.bit_count() == 1 if len(sides) == 1 else sides[1] == width
    if square and 3 * cell <= width:
        return Cube(cell, size=(width, width))
    if len(sides) == 1 or sides == (3 * cell, 2 * cell):
        return Cube(cell)
    if width == 2 * sides[1] and width % 16 == 0 and width >= least_square:
        return Cube(width // 4, size=(width, sides[1]))
    raise OmtwarpError(
        f"texture size {sides}: a cube map is a square of at least {least_square} texels, 2 : 1 with a width that is a "
        f"multiple of 16, or 3 : 2 with one that is a multiple of 12"
    )


def width_of(size: int | None) -> int | None:
    """Return :func:`check_size` of a width in texels, where one is given."""
    return None if size is None else check_size((size,))[0]


def check_size(size: int | tuple[int, ...], least: int = 16) -> tuple[int, ...]:
    """Check the size of a picture, one or two numbers; return its sides in texels.

    Raises:
        OmtwarpError: the sides are not whole numbers from the least to 32768.
    """
    pair = tuple(size) if isinstance(size, tuple | list) or (isinstance(size, np.ndarray) and size.ndim) else (size,)
    if len(pair) not in (1, 2):
        raise OmtwarpError(f"texture size {size!r}: give one or two numbers of texels")
    return tuple(arrays.whole_number(side, "texture size", least=least, most=LONGEST_SIDE) for side in pair)


LARGEST_SIZE = 8192  # texels: the largest picture that every graphics card of the last ten years takes
# The largest size that is chosen where none is asked for: a quarter of the time and memory.
LARGEST_UNASKED = 4096
# Widths of the picture, in texels, for one texel along a right angle of the sphere, where texels are largest: measured
# at 20,000 points and in 16 directions, gutters included. Of a cube map the width of three cells.
SIDES = {"cube": 3.76, "octahedral": 3.94, "equirectangular": 4.0}


def sharp_size(
    vertices: Floats, faces: Ints, sphere: Floats, atlas: str, limit: int = LARGEST_SIZE
) -> tuple[int | tuple[int, int], float]:
    """Return the least size at which no texel covers more than 1.5 pixels of 1024 x 1024 that the surface fills.

    Where a map makes a triangle small on the sphere, its texels are large on the surface; the triangle in which the map
    shrinks lengths most determines the size.

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        sphere: the map, unit vectors, shape [V, 3].
        atlas: name of the layout.
        limit: the largest width.

    Returns:
        Width of the texture in texels, or width and height of a cube map; and the part of the surface's area on which
        texels are larger than they should be, because of the limit.

    Example:
        >>> from omtwarp.mesh import shapes
        >>> from omtwarp.texturing.atlas import sharp_size
        >>> ball = shapes.icosphere(8)
        >>> sharp_size(ball.vertices, ball.faces, ball.vertices, "cube")[0]
        (2048, 2048)
    """
    extent = max(float(np.ptp(vertices, axis=0).max()), np.finfo(float).tiny)
    surface = (vertices - vertices.min(axis=0)) / extent
    stretch = largest_stretch(surface, faces, sphere)
    # Bilinear filtering hides the steps of texels that cover less than 1.5 of 1024 pixels.
    needed = stretch * 0.5 * np.pi * 1024 / 1.5 * SIDES[atlas]
    size, enough = picture_size(float(needed.max(initial=0.0)), atlas, limit)
    corner = surface[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    return size, float(area[needed > enough].sum() / max(float(area.sum()), np.finfo(float).tiny))


def picture_size(needed: float, atlas: str, limit: int) -> tuple[int | tuple[int, int], float]:
    """Return the least size of a picture with sides that are powers of two, and the width for which it is enough.

    Args:
        needed: texels across the picture, or across three cells of a cube map.
        atlas: name of the layout.
        limit: the largest width.
    """
    # Smallest size, texels: 200 kB; less would hardly save anything
    width = 256
    while True:
        # A cube map has cells of a quarter of its width where it is half as high as wide, and of a third in a square.
        enough = 3.0 * (width // 4) if atlas == "cube" else float(width)
        if needed <= enough or (2 * width > limit and atlas != "cube"):
            return (width, width // 2) if atlas == "cube" else width, enough
        if atlas == "cube" and (needed <= 12.0 * (width // 12) or 2 * width > limit):
            return (width, width), 12.0 * (width // 12)
        width *= 2


def largest_stretch(surface: Floats, faces: Ints, sphere: Floats) -> Floats:
    """Return the largest ratio of length on the surface to length on the sphere in every triangle, shape [F].

    The larger root of det(A - x² B) = 0, with A and B the metrics of a triangle here and there. Infinite where a
    triangle has no area on the sphere, 0 where it is a point on both.
    """
    here, there = _metric(surface[faces]), _metric(sphere[faces])
    (a, b, c), (p, q, r) = here.T, there.T
    lead, middle, last = p * r - q * q, a * r + c * p - 2.0 * b * q, np.maximum(a * c - b * b, 0.0)
    root = np.sqrt(np.maximum(middle * middle - 4.0 * lead * last, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        stretch = np.sqrt(np.maximum(middle + root, 0.0) / (2.0 * lead))
    return np.where(lead > 0.0, stretch, np.where(a + c > 0.0, np.inf, 0.0))


def _metric(corner: Floats) -> Floats:
    """Return the squared lengths of two edges and, between them, the edges' inner product, shape [F, 3]."""
    one, other = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return np.stack([np.einsum("ij,ij->i", x, y) for x, y in ((one, one), (one, other), (other, other))], axis=1)
