# mypy: ignore-errors
"""Kernels that fill blocks of texels without an edge between their corners, and find texels that need more samples."""

from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.texturing.kernels import mean_sample

wp.set_module_options(KERNEL_OPTIONS)

# Points of a block's lattice along a side, one more than parts of the block.
LATTICE = wp.constant(5)


@wp.func
def as_byte(value: wp.float64):
    return wp.uint8(int(wp.clamp(value * wp.float64(255.0) + wp.float64(0.5), wp.float64(0.0), wp.float64(255.0))))


@wp.kernel
def fill_calm(
    corners: wp.array[wp.int32],
    step: int,
    width: int,
    height: int,
    gradient: wp.float64,
    directions: wp.array[wp.vec3d],
    reach: wp.array[wp.float64],
    colours: wp.array2d[wp.float64],
    # Data out:
    picture: wp.array2d[wp.uint8],
    busy: wp.array2d[wp.uint8],
):
    """Fill the parts of blocks that no edge of the pattern touches by interpolation between their corners.

    ``corners`` are the numbers of the blocks' first texels. Directions, reach and colours are given at the lattice of
    middles of texels that are ``step`` apart, all of the first block before those of the second. Parts in which there
    may be an edge, or colours that differ by more than ``gradient``, are left alone and marked in ``busy`` by a 1.
    """
    i, _compiled_once = wp.tid()
    first_x = corners[i] % width
    first_y = corners[i] // width
    parts = LATTICE - 1
    base = i * LATTICE * LATTICE
    for part in range(parts * parts):
        column = part % parts
        row = part // parts
        x0 = first_x + column * step
        y0 = first_y + row * step
        busy[i, part] = wp.uint8(0)
        if x0 < width and y0 < height:
            k = base + row * LATTICE + column
            m = k + LATTICE
            across = wp.max(wp.length(directions[m + 1] - directions[k]), wp.length(directions[k + 1] - directions[m]))
            least = wp.min(wp.min(reach[k], reach[k + 1]), wp.min(reach[m], reach[m + 1]))
            # A point of a part of a block is no farther from one of its corners than half of its diagonal; a fifth more
            # leaves room for directions that are not quite linear in between.
            calm = least > wp.float64(0.6) * across
            for c in range(3):
                low = wp.min(wp.min(colours[k, c], colours[k + 1, c]), wp.min(colours[m, c], colours[m + 1, c]))
                high = wp.max(wp.max(colours[k, c], colours[k + 1, c]), wp.max(colours[m, c], colours[m + 1, c]))
                if high - low > gradient:
                    calm = False
            if calm:
                columns = wp.float64(wp.max(wp.min(x0 + step, width - 1) - x0, 1))
                rows = wp.float64(wp.max(wp.min(y0 + step, height - 1) - y0, 1))
                for y in range(y0, wp.min(y0 + step, height)):
                    t = wp.float64(y - y0) / rows
                    for c in range(3):
                        left = colours[k, c] + t * (colours[m, c] - colours[k, c])
                        right = colours[k + 1, c] + t * (colours[m + 1, c] - colours[k + 1, c])
                        for x in range(x0, wp.min(x0 + step, width)):
                            value = left + wp.float64(x - x0) / columns * (right - left)
                            picture[y * width + x, c] = as_byte(value)
            else:
                busy[i, part] = wp.uint8(1)


@wp.kernel
def average_to_bytes(
    values: wp.array2d[wp.float64],
    samples: int,
    texels: wp.array[wp.int32],
    # Data out:
    picture: wp.array2d[wp.uint8],
):
    """Write the mean of the samples of every texel, rounded, to the texel's place."""
    i, _compiled_once = wp.tid()
    per_texel = samples * samples
    for c in range(values.shape[1]):
        picture[texels[i], c] = as_byte(mean_sample(values, i * per_texel, per_texel, c))


@wp.kernel
def flag_edges(
    picture: wp.array2d[wp.uint8],
    texels: wp.array[wp.int32],
    width: int,
    height: int,
    threshold: int,
    # Data out:
    flags: wp.array[wp.uint8],
):
    """Mark with 1 where a texel differs from one of its four neighbours by more than a threshold in some channel."""
    i, _compiled_once = wp.tid()
    number = texels[i]
    row = number // width
    column = number % width
    flag = wp.uint8(0)
    for way in range(4):
        r = row
        q = column
        if way == 0:
            q = (column + 1) % width
        elif way == 1:
            q = (column + width - 1) % width
        elif way == 2:
            r = wp.min(row + 1, height - 1)
        else:
            r = wp.max(row - 1, 0)
        for c in range(picture.shape[1]):
            if wp.abs(int(picture[r * width + q, c]) - int(picture[number, c])) > threshold:
                flag = wp.uint8(1)
    flags[i] = flag
