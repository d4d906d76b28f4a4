"""Kernels for cells that are the triangles of a quartered mesh: see :class:`omtwarp.optimal.cells.TriangleCells`."""

# mypy: ignore-errors
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.mesh import quarter

wp.set_module_options(KERNEL_OPTIONS)

PARTS = wp.constant(quarter.PARTS)


@wp.kernel
def sums_of_parts(
    values: wp.array[wp.float64],
    # Data out:
    sums: wp.array[wp.float64],
):
    """Sum a number per part over the parts of every triangle, shape [N]."""
    c = wp.tid()
    total = wp.float64(0.0)
    for k in range(PARTS):
        total += values[PARTS * c + k]
    sums[c] = total


@wp.kernel
def on_parts(
    values: wp.array[wp.float64],
    # Data out:
    repeated: wp.array[wp.float64],
):
    """Give every part the number of its triangle, shape [4 N]."""
    f = wp.tid()
    repeated[f] = values[f // PARTS]


@wp.kernel
def cell_means(
    values: wp.array[wp.float64],
    vertices: wp.array2d[wp.int32],
    shares: wp.array[wp.float64],
    # Data out:
    means: wp.array[wp.float64],
):
    """Compute the mean over every cell's mass of a number per vertex, shape [N]."""
    c = wp.tid()
    total = wp.float64(0.0)
    for k in range(vertices.shape[1]):
        total += shares[k] * values[vertices[c, k]]
    means[c] = total


@wp.kernel
def cell_masses(
    areas: wp.array[wp.float64],
    shares: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    places: wp.array[wp.int32],
    factor: wp.float64,
    # Data out:
    masses: wp.array[wp.float64],
):
    """Sum the shares of the cells' areas at every vertex, times a factor, shape [V]."""
    v = wp.tid()
    total = wp.float64(0.0)
    width = shares.shape[0]
    for i in range(offsets[v], offsets[v + 1]):
        cell = places[i] // width
        total += shares[places[i] - width * cell] * areas[cell]
    masses[v] = factor * total


@wp.kernel
def cell_slopes(
    of_parts: wp.array2d[wp.vec2d],
    # Data out:
    slopes: wp.array3d[wp.float64],
):
    """Sum the derivatives of the parts' areas to those of every cell by its six vertices, shape [N, 6, 2]."""
    c = wp.tid()
    begin = PARTS * c
    for k in range(3):
        corner = of_parts[begin + k, 0]
        # The middle of the edge from corner k to the next is in the parts of both, and in the one in the middle.
        middle = of_parts[begin + k, 1] + of_parts[begin + (k + 1) % 3, 2] + of_parts[begin + 3, k]
        for axis in range(2):
            slopes[c, k, axis] = corner[axis]
            slopes[c, 3 + k, axis] = middle[axis]
