# mypy: ignore-errors
"""The kernel that turns directions of a picture into those that the smooth map gives to the same point of a surface."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.location.kernels import clamped, spherical_coordinates
from omtwarp.texturing.kernels import picture_direction, picture_point, sample_place

wp.set_module_options(KERNEL_OPTIONS)

# From the triangle that holds the middle of a block of texels to that of a sample: the meshes of most surfaces have
# fewer triangles across a block than this.
MOST_STEPS = wp.constant(64)
# How far outside of its triangle, in shares of it, a point may lie where the walk ends: ten times round-off's part of
# the least triangle that a texel shows.
SLACK = wp.constant(wp.float64(-1.0e-9))


@wp.func
def grid_place(bary: wp.vec3d, parts: int, first: int, grid: wp.array[wp.int32], points: wp.array[wp.vec3d]):
    """Return the point of a divided triangle at barycentric coordinates."""
    n = wp.float64(parts)
    x = wp.clamp(bary[1], ZERO, ONE) * n
    y = wp.clamp(bary[2], ZERO, ONE) * n
    a = wp.clamp(int(wp.floor(x)), 0, parts - 1)
    b = wp.clamp(int(wp.floor(y)), 0, parts - 1 - a)
    s = x - wp.float64(a)
    t = y - wp.float64(b)
    here = first + a * (2 * parts + 3 - a) // 2 + b
    after = first + (a + 1) * (2 * parts + 2 - a) // 2 + b  # one step towards corner 1
    if s + t <= ONE or a + b == parts - 1:
        return (ONE - s - t) * points[grid[here]] + s * points[grid[after]] + t * points[grid[here + 1]]
    return (
        (s + t - ONE) * points[grid[after + 1]] + (ONE - t) * points[grid[after]] + (ONE - s) * points[grid[here + 1]]
    )


@wp.kernel
def bent_sample_directions(
    kind: int,
    width: int,
    height: int,
    offset: wp.float64,
    gutter: wp.float64,
    texels: wp.array[wp.int32],
    samples: int,
    block: int,
    blocks_across: int,
    hints: wp.array[wp.int32],
    faces: wp.array[wp.vec3i],
    neighbours: wp.array[wp.vec3i],
    sphere: wp.array[wp.vec3d],
    first: wp.array[wp.int32],
    divided: wp.array[wp.int32],
    grid: wp.array[wp.int32],
    points: wp.array[wp.vec3d],
    # Data out:
    directions: wp.array[wp.vec3d],
):
    """Compute the directions of texels' samples, moved by the difference of the smooth map from the linear one.

    ``hints`` names a triangle of the mesh near every block of texels, -1 where there is none. ``divided`` says into how
    many parts the edges of a triangle are divided, 0 where the smooth map is the linear one; ``first`` where its points
    begin in the grid.
    """
    i, _compiled_once = wp.tid()
    number = texels[i]
    row = number // width
    column = number % width
    # All samples are moved as the middle is: across a texel that changes by a small part of one.
    d = picture_direction(kind, wp.float64(column) + HALF, wp.float64(row) + HALF, width, height, offset, gutter)
    f = hints[row // block * blocks_across + column // block]
    if f < 0:  # in a gutter, which shows what lies elsewhere on the picture
        place = picture_point(kind, d, width, height, offset, gutter)
        column_there = wp.clamp(int(wp.floor(place[0])), 0, width - 1)
        row_there = wp.clamp(int(wp.floor(place[1])), 0, height - 1)
        f = hints[row_there // block * blocks_across + column_there // block]
    weights = wp.vec3d()
    found = bool(False)
    steps = int(0)
    while f >= 0 and steps < MOST_STEPS and not found:
        face = faces[f]
        weights = spherical_coordinates(sphere[face[0]], sphere[face[1]], sphere[face[2]], d)
        total = weights[0] + weights[1] + weights[2]
        worst = int(0)
        if weights[1] < weights[worst]:
            worst = int(1)
        if weights[2] < weights[worst]:
            worst = int(2)
        if weights[worst] >= SLACK * total and total > ZERO:
            found = True
        else:
            f = neighbours[f][(worst + 1) % 3]  # corner k is opposite to the edge from corner k + 1
            steps = steps + 1
    move = wp.vec3d(ZERO, ZERO, ZERO)
    if found:
        parts = divided[f]
        if parts > 0:
            bary = clamped(weights)
            face = faces[f]
            linear = bary[0] * sphere[face[0]] + bary[1] * sphere[face[1]] + bary[2] * sphere[face[2]]
            smooth = grid_place(bary, parts, first[f], grid, points)
            move = wp.normalize(smooth) - wp.normalize(linear)
    if samples == 1:
        directions[i] = wp.normalize(d + move)
        return
    for k in range(samples * samples):
        x, y = sample_place(number, width, k, samples)
        sample = picture_direction(kind, x, y, width, height, offset, gutter)
        directions[i * samples * samples + k] = wp.normalize(sample + move)
