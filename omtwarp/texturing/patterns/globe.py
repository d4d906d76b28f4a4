# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
"""Land, sea and graticule.

The coastlines were made from Natural Earth (naturalearthdata.com), which is in the public domain: the outlines of the
countries at 1:110 million with every border between two countries dropped, rounded to a hundredth of a degree.
"""

from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, PI, ZERO, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Floats
from omtwarp.texturing.patterns import Pattern, cell_of, latitude, longitude, near_multiple, srgb_colours

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def crosses(px: wp.float64, py: wp.float64, qx: wp.float64, qy: wp.float64, a: wp.vec4d):
    """Return 1 where the straight piece with its ends in ``a`` crosses the path from p to q in the plane, else 0."""
    ax, ay, bx, by = a[0], a[1], a[2], a[3]
    # Half-open tests, so that a vertex of the coast that lies on the path's line counts once.
    side_a = (qx - px) * (ay - py) - (qy - py) * (ax - px) >= ZERO
    side_b = (qx - px) * (by - py) - (qy - py) * (bx - px) >= ZERO
    side_p = (bx - ax) * (py - ay) - (by - ay) * (px - ax) >= ZERO
    side_q = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax) >= ZERO
    return wp.where(side_a != side_b and side_p != side_q, 1, 0)


@wp.func
def piece_distance(px: wp.float64, py: wp.float64, stretch: wp.float64, a: wp.vec4d):
    """Return the distance in degrees from a point to a straight piece of coast, longitudes scaled by ``stretch``."""
    ex, ey = (a[2] - a[0]) * stretch, a[3] - a[1]
    dx, dy = (px - a[0]) * stretch, py - a[1]
    # Squared degrees, that are divided by: a shorter piece of coast is a point.
    t = wp.clamp((dx * ex + dy * ey) / wp.max(ex * ex + ey * ey, wp.float64(1.0e-12)), ZERO, ONE)
    return wp.length(wp.vec2d(dx - t * ex, dy - t * ey))


@wp.kernel
def globe_colours(
    directions: wp.array[wp.vec3d],
    columns: int,
    rows: int,
    offsets: wp.array[wp.int32],
    members: wp.array[wp.int32],
    pieces: wp.array[wp.vec4d],
    real_coast: wp.array[wp.int32],
    land_at_centre: wp.array[wp.int32],
    colours: wp.array[wp.vec3d],
    coast_width: wp.float64,
    shelf_width: wp.float64,
    step: wp.float64,
    line_width: wp.float64,
    # Data out:
    out: wp.array2d[wp.float64],
    reach: wp.array[wp.float64],
):
    i, _compiled_once = wp.tid()
    d = directions[i]
    degree = wp.float64(180.0) / PI
    lon = longitude(d) * degree
    lat = latitude(d) * degree
    column = cell_of(lon, wp.float64(-180.0), wp.float64(180.0), columns)
    row = cell_of(lat, wp.float64(-90.0), wp.float64(90.0), rows)
    cell = row * columns + column
    centre_x = (wp.float64(column) + HALF) * wp.float64(360.0) / wp.float64(columns) - wp.float64(180.0)
    centre_y = (wp.float64(row) + HALF) * wp.float64(180.0) / wp.float64(rows) - wp.float64(90.0)
    land = land_at_centre[cell]
    stretch = wp.cos(lat / degree)
    coast = wp.float64(1.0e3)
    for k in range(offsets[cell], offsets[cell + 1]):
        m = members[k]
        land = land + crosses(lon, lat, centre_x, centre_y, pieces[m])
        if real_coast[m] == 1:
            coast = wp.min(coast, piece_distance(lon, lat, stretch, pieces[m]))
    # colours: deep sea at the equator, at the poles, shallow sea, land, ice, coast, graticule
    north = wp.abs(lat) / wp.float64(90.0)
    colour = colours[0] * (ONE - north) + colours[1] * north
    if coast < shelf_width:
        w = ONE - coast / shelf_width
        colour = colour * (ONE - w) + colours[2] * w
    ink = wp.float64(0.55)
    if (land & 1) == 1:
        ice = wp.clamp((wp.abs(lat) - wp.float64(62.0)) / wp.float64(14.0), ZERO, ONE)
        if lat < -wp.float64(60.0):
            ice = ONE
        colour = colours[3] * (ONE - ice) + colours[4] * ice
        ink = wp.float64(0.28)
    # Meridians of one width everywhere; only every sixth reaches the poles, where more would merge into a blot.
    polar = wp.abs(lat)
    spacing = wp.where(polar > wp.float64(90.0) - step, step * wp.float64(6.0), step)
    meridian = wp.where(polar > wp.float64(89.0), wp.float64(1.0e3), near_multiple(lon, spacing) * stretch)
    parallel = wp.where(polar > wp.float64(89.5), wp.float64(1.0e3), near_multiple(lat, step))
    grid = wp.min(meridian, parallel)
    if wp.abs(lat) < line_width:
        grid = ZERO
    if grid < HALF * line_width:
        line = colours[6]
        if (land & 1) == 1 and wp.abs(lat) > wp.float64(66.0):
            line = colours[1]  # white on ice would not show
        colour = colour * (ONE - ink) + line * ink
    if coast < HALF * coast_width:
        colour = colours[5]
    for c in range(3):
        out[i, c] = colour[c]
    near = wp.abs(wp.min(coast, shelf_width) - HALF * coast_width)  # at the shelf's edge the slope alone changes
    near = wp.min(near, wp.abs(near_multiple(lon, step) * stretch - HALF * line_width))
    near = wp.min(near, wp.abs(parallel - HALF * line_width))
    # Where the spacing of the lines, and the colours of land, change at once.
    near = wp.min(near, wp.abs(wp.abs(lat) - line_width))
    near = wp.min(near, wp.abs(lat + wp.float64(60.0)))
    near = wp.min(near, wp.abs(wp.abs(lat) - wp.float64(66.0)))
    near = wp.min(near, wp.abs(wp.abs(lat) - wp.float64(90.0) + step))
    near = wp.min(near, wp.abs(wp.abs(lat) - wp.float64(89.0)))
    near = wp.min(near, wp.abs(wp.abs(lat) - wp.float64(89.5)))
    # Lengths along parallels are shortened as at the point's own latitude, which changes over the reach.
    reach[i] = HALF * wp.min(near, shelf_width) / degree
    if wp.abs(lat) > wp.float64(80.0):
        reach[i] = ZERO


class Globe(Pattern):
    """Land, sea and graticule.

    Args:
        step: degrees between the lines of the graticule.
    """

    name = "globe"
    title = "A globe"
    _kernel = globe_colours
    coast_width, shelf_width, line_width = 0.32, 3.0, 0.3  # degrees

    def __init__(self, step: float = 15.0):
        if not 1.0 <= step <= 90.0 or 90.0 % step:
            raise OmtwarpError(f"globe: graticule every {step} degrees: give a divisor of 90, from 1")
        self.step = float(step)
        self.palette = srgb_colours("#1d5376", "#3b7894", "#5f9fae", "#c3b585", "#eef1ee", "#4b4a3c", "#f2f0e6")

    def _tables(self) -> list[object]:
        columns, rows = 720, 360
        pieces, real, offsets, members, land = _coast_table(columns, rows, self.shelf_width)
        tables = [(offsets, wp.int32), (members, wp.int32), (pieces, wp.vec4d), (real, wp.int32), (land, wp.int32)]
        degrees = map(wp.float64, (self.coast_width, self.shelf_width, self.step, self.line_width))
        return [columns, rows, *tables, (self.palette, wp.vec3d), *degrees]


def coastline_segments() -> Floats:
    """Return the two ends of every straight piece of coast as (longitude, latitude) in degrees, shape [S, 2, 2].

    The pieces form closed rings in the plane of longitude and latitude, with land on one side: a point is on land when
    a path from the outside crosses them an odd number of times. The rings of Antarctica and of the far east of Asia run
    along the map's edge where longitude wraps; those pieces close the rings and are no coast.
    """
    with (files("omtwarp.texturing") / "assets" / "coastlines.npy").open("rb") as stream:
        hundredths: Floats = np.load(stream) / 100.0
    return hundredths


@lru_cache(maxsize=2)
def _coast_table(columns: int, rows: int, reach: float) -> tuple[NDArray, ...]:
    """Return a grid over longitude and latitude with the coast pieces near each cell, and whether its centre is land.

    Returns:
        pieces [S, 4] (two ends, degrees), which of them are coast rather than edge of the map [S], offsets and members
        of the cells' lists, and whether the centre of every cell is land.
    """
    no_reach = 1e-6  # degrees that an edge of the map, which is no coast, is seen from
    segments = coastline_segments()
    a, b = segments[:, 0], segments[:, 1]
    height = 180.0 / rows
    # Land at the centres, row by row: the number of crossings of the parallel to the west of the centre is odd.
    centre = (np.arange(columns) + 0.5) * 360.0 / columns - 180.0
    land = np.zeros((rows, columns), dtype=np.int32)
    for row in range(rows):
        # Beside, degrees beside a multiple of the data's hundredth: no parallel goes through a vertex of a coast
        y = (row + 0.5) * height - 90.0 + 1e-7
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
    wide, tall = np.where(real == 1, wide, no_reach), np.where(real == 1, reach, no_reach)
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
    return pieces.reshape(-1, 4), real, offsets, piece[order].astype(np.int32), land.ravel()


__all__ = ["Globe", "coastline_segments"]
