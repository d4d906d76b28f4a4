# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
"""Fields of a chess board on the sphere."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, PI, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import whole_number
from omtwarp.texturing.patterns import Pattern, cell_of, latitude, longitude, near_multiple, srgb_colours

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
        self.columns, self.rows = whole_number(columns, "checker: columns"), whole_number(rows, "checker: rows")
        if columns < 2 or columns % 2 or rows < 1:
            raise OmtwarpError(f"checker: {columns} columns and {rows} rows: columns must be even and both positive")
        self.colours = srgb_colours("#f3ede2", "#2f5d73")

    def _tables(self) -> list[object]:
        return [self.columns, self.rows, (self.colours, wp.vec3d)]


__all__ = ["Checker"]
