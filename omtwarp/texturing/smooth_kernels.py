# mypy: ignore-errors
"""The kernel that turns directions of a picture into those that the smooth map gives to the same point of a surface."""

from omtwarp.device.start import KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.texturing.kernels import drawn_back, picture_point

wp.set_module_options(KERNEL_OPTIONS)

# How far outside of its triangle, in shares of it, a point may lie that is not drawn back.
SLACK = wp.constant(wp.float64(1.0e-9))


@wp.kernel
def bend_directions(
    kind: int,
    width: int,
    height: int,
    offset: wp.float64,
    gutter: wp.float64,
    owner: wp.array[wp.int32],
    source_face: wp.array[wp.int32],
    faces: wp.array2d[wp.int32],
    sphere: wp.array[wp.vec3d],
    grid: wp.array2d[wp.int32],
    points: wp.array[wp.vec3d],
    parts: int,
    directions: wp.array[wp.vec3d],
    # Data out:
    out: wp.array[wp.vec3d],
):
    """Add to a direction what the smooth map differs by from the linear one at that point of the surface.

    ``owner`` names the triangle of the layout for every texel, ``source_face`` the triangle of the mesh for that, a
    number above all others where nothing is to be added.
    """
    i, _compiled_once = wp.tid()
    d = directions[i]
    out[i] = d
    place = picture_point(kind, d, width, height, offset, gutter)
    column = wp.clamp(int(wp.floor(place[0])), 0, width - 1)
    row = wp.clamp(int(wp.floor(place[1])), 0, height - 1)
    part = owner[row * width + column]
    if part >= source_face.shape[0]:
        return
    f = source_face[part]
    if f >= faces.shape[0]:
        return
    p = sphere[faces[f, 0]]
    q = sphere[faces[f, 1]]
    r = sphere[faces[f, 2]]
    u = wp.dot(d, wp.cross(q, r))
    v = wp.dot(d, wp.cross(r, p))
    total = u + v + wp.dot(d, wp.cross(p, q))
    if total == ZERO:
        return
    # A texel's triangle may be a neighbour of the one that the direction lies in: the nearest point of it will do.
    bary = drawn_back(u / total, v / total, SLACK)
    n = wp.float64(parts)
    x = wp.clamp(bary[1], ZERO, ONE) * n
    y = wp.clamp(bary[2], ZERO, ONE) * n
    a = wp.clamp(int(wp.floor(x)), 0, parts - 1)
    b = wp.clamp(int(wp.floor(y)), 0, parts - 1 - a)
    s = x - wp.float64(a)
    t = y - wp.float64(b)
    here = a * (2 * parts + 3 - a) // 2 + b
    after = (a + 1) * (2 * parts + 2 - a) // 2 + b  # one step towards corner 1
    smooth = wp.vec3d(ZERO, ZERO, ZERO)
    if s + t <= ONE or a + b == parts - 1:
        smooth = (ONE - s - t) * points[grid[f, here]] + s * points[grid[f, after]] + t * points[grid[f, here + 1]]
    else:
        smooth = (
            (s + t - ONE) * points[grid[f, after + 1]]
            + (ONE - t) * points[grid[f, after]]
            + (ONE - s) * points[grid[f, here + 1]]
        )
    linear = wp.normalize(bary[0] * p + bary[1] * q + bary[2] * r)
    out[i] = wp.normalize(d + wp.normalize(smooth) - linear)
