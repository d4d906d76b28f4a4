# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
"""Fields of a chess board on the sphere."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, PI, wp
from omtwarp.errors import OmtwarpError
from omtwarp.texturing.image import longitude_latitude
from omtwarp.texturing.patterns.base import Pattern, cell_of, latitude, longitude, near_multiple, srgb_colours

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def checker_colours(
    directions: wp.array[wp.vec3d],
    columns: int,
    rows: int,
    colours: wp.array[wp.vec3d],
    # Data out:
    out: wp.array2d[wp.float64],
    reach: wp.array[wp.float64],
):
    i, _compiled_once = wp.tid()
    d = directions[i]
    lon = longitude(d)
    lat = latitude(d)
    column = cell_of(lon, -PI, PI, columns)
    row = cell_of(-lat, -HALF * PI, HALF * PI, rows)
    colour = colours[(column + row) & 1]
    for c in range(3):
        out[i, c] = colour[c]
    parallel = near_multiple(lat + HALF * PI, PI / wp.float64(rows))
    meridian = near_multiple(lon + PI, (PI + PI) / wp.float64(columns))
    reach[i] = wp.min(parallel, wp.asin(wp.min(wp.cos(lat) * wp.sin(wp.min(meridian, HALF * PI)), ONE)))


class Checker(Pattern):
    """Fields of a chess board, equal in longitude and in latitude.

    Args:
        columns: fields around the equator, an even number.
        rows: fields from pole to pole.
    """

    name = "checker"
    title = "A checker"
    _kernel = checker_colours

    def __init__(self, columns: int = 24, rows: int = 12):
        if columns < 2 or columns % 2 or rows < 1:
            raise OmtwarpError(f"checker: {columns} columns and {rows} rows: columns must be even and both positive")
        self.columns, self.rows = int(columns), int(rows)
        self.colours = srgb_colours("#f3ede2", "#2f5d73")

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


__all__ = ["Checker"]
