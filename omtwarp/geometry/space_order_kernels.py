"""Warp kernel of the place of points on Hilbert's curve.

The curve goes through every cell of a grid in a cube, and neighbours on it are neighbours in space. Skilling's
algorithm [1] turns coordinates of cells into their number along it, one bit of the three coordinates after another.

References:
    [1] J. Skilling, "Programming the Hilbert curve", AIP Conference Proceedings 707 (2004), pages 381 to 387.
"""

# mypy: ignore-errors
from omtwarp.device.start import KERNEL_OPTIONS, wp

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
    x = x ^ turned
    y = y ^ turned
    z = z ^ turned
    # The number has the highest bits of x, y and z first, then the next.
    place = wp.int64(0)
    bit = int(HIGHEST_BIT)
    while bit > 0:
        place = place * wp.int64(8)
        if x & bit:
            place = place + wp.int64(4)
        if y & bit:
            place = place + wp.int64(2)
        if z & bit:
            place = place + wp.int64(1)
        bit = bit >> 1
    place_out[i] = place
