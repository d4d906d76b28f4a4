# mypy: ignore-errors
"""Kernels between texels and directions: directions of texels, values of pictures, owners of texels, calm blocks.

And the normals of a detailed mesh.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, PI, TWO, ZERO, wp
from omtwarp.geometry.spherical import TINY
from omtwarp.location import clamped, spherical_coordinates
from omtwarp.texturing.atlas import Kind

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def cube_face(d: wp.vec3d):
    """Return the face of the cube that a direction passes through: +x, +y, -x, -y, +z, -z."""
    ax, ay, az = wp.abs(d[0]), wp.abs(d[1]), wp.abs(d[2])
    if ax >= ay and ax >= az:
        return wp.where(d[0] < ZERO, 2, 0)
    if ay >= az:
        return wp.where(d[1] < ZERO, 3, 1)
    return wp.where(d[2] < ZERO, 5, 4)


@wp.func
def cube_frame(face: int):
    """Return normal, right and up of a face of the cube as rows, as omtwarp.texturing.atlas has them."""
    c = wp.float64(wp.where(face % 2 == 0, 1 - face, 0))
    s = wp.float64(wp.where(face % 2 == 1, 2 - face, 0))
    frame = wp.mat33d(c, s, ZERO, -s, c, ZERO, ZERO, ZERO, ONE)
    if face > 3:
        z = wp.float64(9 - 2 * face)
        frame = wp.mat33d(ZERO, ZERO, z, ZERO, ONE, ZERO, -z, ZERO, ZERO)
    return frame


@wp.func
def cube_columns(width: int, height: int):
    """Return how many cells of a cube map lie in a row."""
    return wp.where(width == 2 * height, 4, 3)


@wp.func
def picture_direction(
    kind: int, x: wp.float64, y: wp.float64, width: int, height: int, offset: wp.float64, gutter: wp.float64
):
    """Return the direction, a unit vector, that a point of a picture shows.

    The point has x to the right and y **down**, in texels. Gutters continue past borders. ``offset`` and ``gutter`` are
    the parameters of omtwarp.texturing.atlas.
    """
    w, h = wp.float64(width), wp.float64(height)
    d = wp.vec3d(ONE, ZERO, ZERO)
    if kind == Kind.CUBE:
        cell = offset
        columns = cube_columns(width, height)
        column = wp.clamp(int(wp.floor(x / cell)), 0, columns - 1)
        row = wp.clamp(int(wp.floor(y / cell)), 0, 1)
        half = HALF * (cell - TWO * gutter)
        right = (x - wp.float64(column) * cell - gutter) / half - ONE
        up = ONE - (y - wp.float64(row) * cell - gutter) / half
        quarter = wp.float64(0.25) * PI
        local = wp.vec3d(ONE, wp.tan(right * quarter), wp.tan(up * quarter))
        d = wp.transpose(cube_frame(row * columns + column)) * local
    elif kind == Kind.OCTAHEDRAL:
        half = HALF * (w - TWO * gutter)
        a = (x - gutter) / half - ONE
        b = ONE - (y - gutter) / half
        if wp.abs(a) > ONE:  # beyond the border lies the other half of the same side, back to front
            a = wp.sign(a) * (TWO - wp.abs(a))
            b = -b
        if wp.abs(b) > ONE:
            b = wp.sign(b) * (TWO - wp.abs(b))
            a = -a
        z = ONE - wp.abs(a) - wp.abs(b)
        if z < ZERO:
            d = wp.vec3d((ONE - wp.abs(b)) * wp.sign(a), (ONE - wp.abs(a)) * wp.sign(b), z)
        else:
            d = wp.vec3d(a, b, z)
    else:
        lat = (HALF - y / h) * PI
        lon = (x / w - HALF) * TWO * PI + offset
        c = wp.cos(lat)
        d = wp.vec3d(c * wp.cos(lon), c * wp.sin(lon), wp.sin(lat))
    return wp.normalize(d)


@wp.func
def picture_point(kind: int, d: wp.vec3d, width: int, height: int, offset: wp.float64, gutter: wp.float64):
    """Return the point of a picture that shows a direction: x to the right and y down, in texels.

    Of a picture that repeats, the direction is (u, v, 0), v up.
    """
    w, h = wp.float64(width), wp.float64(height)
    x, y = ZERO, ZERO
    if kind == Kind.CUBE:
        cell = offset
        half = HALF * (cell - TWO * gutter)
        face = cube_face(d)
        local = cube_frame(face) * d
        largest = wp.max(local[0], TINY)
        columns = cube_columns(width, height)
        column = face % columns
        row = face // columns
        quarter = wp.float64(0.25) * PI
        x = wp.float64(column) * cell + gutter + (wp.atan2(local[1], largest) / quarter + ONE) * half
        y = wp.float64(row) * cell + gutter + (ONE - wp.atan2(local[2], largest) / quarter) * half
    elif kind == Kind.OCTAHEDRAL:
        half = HALF * (w - TWO * gutter)
        total = wp.max(wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2]), TINY)
        a = d[0] / total
        b = d[1] / total
        if d[2] < ZERO:
            c = a
            a = (ONE - wp.abs(b)) * wp.sign(c)
            b = (ONE - wp.abs(c)) * wp.sign(b)
        x = gutter + (a + ONE) * half
        y = gutter + (ONE - b) * half
    elif kind == Kind.REPEATED:
        x = (d[0] - wp.floor(d[0])) * w
        y = (wp.ceil(d[1]) - d[1]) * h
    else:
        lat = wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))
        lon = wp.atan2(d[1], d[0]) - offset
        if kind == Kind.SINUSOIDAL:
            lon = lon * wp.cos(lat)
        u = HALF + lon / (TWO * PI)
        x = (u - wp.floor(u)) * w
        if kind == Kind.SINUSOIDAL:
            x = u * w
        y = (HALF - lat / PI) * h
    return wp.vec2d(x, y)


@wp.func
def texel(picture: wp.array3d[wp.float32], kind: int, row: int, column: int, c: int):
    """Return a texel's value; an equirectangular picture is continued around the sphere and over the poles.

    Other pictures are continued by themselves where they repeat, and by their borders where not.
    """
    height, width = picture.shape[0], picture.shape[1]
    r, q = row, column
    if kind == Kind.EQUIRECTANGULAR:
        if r < 0:
            r = -1 - r
            q = q + width // 2
        elif r >= height:
            r = 2 * height - 1 - r
            q = q + width // 2
        if q < 0:
            q = q + width
        q = q % width
    elif kind == Kind.REPEATED:
        r = (r % height + height) % height
        q = (q % width + width) % width
    else:
        r = wp.clamp(r, 0, height - 1)
        q = wp.clamp(q, 0, width - 1)
    return wp.float64(picture[r, q, c])


@wp.func
def bilinear(picture: wp.array3d[wp.float32], kind: int, x: wp.float64, y: wp.float64, c: int):
    """Interpolate the four texels nearest to a point, given in texels with centres at halves."""
    column, row = int(wp.floor(x - HALF)), int(wp.floor(y - HALF))
    s = x - HALF - wp.float64(column)
    t = y - HALF - wp.float64(row)
    top = (ONE - s) * texel(picture, kind, row, column, c) + s * texel(picture, kind, row, column + 1, c)
    low = (ONE - s) * texel(picture, kind, row + 1, column, c) + s * texel(picture, kind, row + 1, column + 1, c)
    return (ONE - t) * top + t * low


@wp.func
def sample_place(number: int, width: int, k: int, samples: int):
    """Return where sample k of a texel lies in the picture, in texels; samples x samples are in a regular grid."""
    step = ONE / wp.float64(samples)
    x = wp.float64(number % width) + (wp.float64(k % samples) + HALF) * step
    y = wp.float64(number // width) + (wp.float64(k // samples) + HALF) * step
    return x, y


@wp.kernel
def sample_picture(
    kind: int,
    offset: wp.float64,
    gutter: wp.float64,
    picture: wp.array3d[wp.float32],
    directions: wp.array[wp.vec3d],
    # Data out:
    out: wp.array2d[wp.float64],
):
    """Compute the bilinear samples of a picture in directions."""
    i = wp.tid()
    p = picture_point(kind, directions[i], picture.shape[1], picture.shape[0], offset, gutter)
    for c in range(picture.shape[2]):
        out[i, c] = bilinear(picture, kind, p[0], p[1], c)


@wp.func
def as_byte(value: wp.float64):
    return wp.uint8(int(wp.clamp(value * wp.float64(255.0) + wp.float64(0.5), wp.float64(0.0), wp.float64(255.0))))


@wp.kernel
def average_samples(
    values: wp.array2d[wp.float64],
    samples: int,
    texels: wp.array[wp.int32],
    # Data out:
    numbers: wp.array2d[wp.float32],
    bytes: wp.array2d[wp.uint8],
):
    """Compute the mean of the samples of every texel, written to the texel's place in the picture that is not empty."""
    i, _compiled_once = wp.tid()
    per_texel = samples * samples
    for c in range(values.shape[1]):
        total = wp.float64(0.0)
        for k in range(per_texel):
            total = total + values[i * per_texel + k, c]
        mean = total / wp.float64(per_texel)
        if bytes.shape[0] > 0:
            bytes[texels[i], c] = as_byte(mean)
        else:
            numbers[texels[i], c] = wp.float32(mean)


@wp.func
def edge_side(ax: wp.float64, ay: wp.float64, bx: wp.float64, by: wp.float64, px: wp.float64, py: wp.float64):
    return (bx - ax) * (py - ay) - (by - ay) * (px - ax)


@wp.func
def texels_within(a: wp.float64, b: wp.float64, c: wp.float64, grow: wp.float64, first: int, end: int):
    """Return the first and the last texel along an axis whose centres are within ``grow`` of a triangle's extent."""
    low = int(wp.ceil(wp.min(wp.min(a, b), c) - HALF - grow))
    high = int(wp.floor(wp.max(wp.max(a, b), c) - HALF + grow))
    return wp.max(low, first), wp.min(high, end - 1)


@wp.kernel
def own_texels(
    corners: wp.array2d[wp.vec2d],
    width: int,
    grow: wp.float64,
    first_row: int,
    end_row: int,
    # Data out:
    owner: wp.array[wp.int32],
):
    """Give each texel to the lowest-numbered triangle that contains its centre, whatever the order of threads.

    ``corners`` are in texels, y down. ``grow`` lets a triangle claim centres up to that many texels outside, so that
    round-off cannot leave a hole between two triangles, or so that a ring around the charts gets an owner. Rows outside
    of the given ones are left alone, so that launches side by side write to places of their own.
    """
    f = wp.tid()
    a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
    area = edge_side(a[0], a[1], b[0], b[1], c[0], c[1])
    if area == ZERO:
        return
    flip = wp.sign(area)
    # Lengths turn the edge functions into distances.
    ab, bc, ca = wp.length(b - a) * flip, wp.length(c - b) * flip, wp.length(a - c) * flip
    low_x, high_x = texels_within(a[0], b[0], c[0], grow, 0, width)
    low_y, high_y = texels_within(a[1], b[1], c[1], grow, first_row, end_row)
    for row in range(low_y, high_y + 1):
        for column in range(low_x, high_x + 1):
            x, y = wp.float64(column) + HALF, wp.float64(row) + HALF
            if edge_side(a[0], a[1], b[0], b[1], x, y) / ab >= -grow:
                if edge_side(b[0], b[1], c[0], c[1], x, y) / bc >= -grow:
                    if edge_side(c[0], c[1], a[0], a[1], x, y) / ca >= -grow:
                        wp.atomic_min(owner, row * width + column, f)


@wp.func
def drawn_back(u: wp.float64, v: wp.float64, slack: wp.float64):
    """Move barycentric coordinates towards the triangle's middle until none is below the slack."""
    w = ONE - u - v
    least = wp.min(wp.min(u, v), w)
    if least < -slack:
        third = ONE / wp.float64(3.0)
        t = (third + slack) / (third - least)
        u = third + t * (u - third)
        v = third + t * (v - third)
        w = ONE - u - v
    return wp.vec3d(u, v, w)


@wp.kernel
def owner_values(
    kind: int,
    offset: wp.float64,
    gutter: wp.float64,
    corners: wp.array2d[wp.vec2d],
    points: wp.array2d[wp.vec3d],
    values: wp.array3d[wp.float64],
    owner: wp.array[wp.int32],
    texels: wp.array[wp.int32],
    width: int,
    height: int,
    samples: int,
    # Data out:
    out: wp.array2d[wp.float64],
):
    """Interpolate values at corners linearly over the owning triangle, at the samples of texels that have an owner.

    Where a sample lies in its triangle is known from the ``corners`` on the picture or, with the triangles' ``points``
    on the sphere, from the direction that the sample shows: coordinates on an atlas are linear only to a fraction of a
    texel. Samples next to a border may lie up to half a texel outside the triangle; extrapolation is limited.
    """
    i = wp.tid()
    per_texel = samples * samples
    number = texels[i // per_texel]
    x, y = sample_place(number, width, i % per_texel, samples)
    f = owner[number]
    if points.shape[0] > 0:
        d = picture_direction(kind, x, y, width, height, offset, gutter)
        u = wp.dot(d, wp.cross(points[f, 1], points[f, 2]))
        v = wp.dot(d, wp.cross(points[f, 2], points[f, 0]))
        total = u + v + wp.dot(d, wp.cross(points[f, 0], points[f, 1]))
    else:
        a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
        u = edge_side(b[0], b[1], c[0], c[1], x, y)
        v = edge_side(c[0], c[1], a[0], a[1], x, y)
        total = edge_side(a[0], a[1], b[0], b[1], c[0], c[1])
    bary = wp.vec3d(ONE / wp.float64(3.0), ONE / wp.float64(3.0), ONE / wp.float64(3.0))
    if total != ZERO:
        bary = drawn_back(u / total, v / total, HALF)
    for k in range(values.shape[2]):
        out[i, k] = bary[0] * values[f, 0, k] + bary[1] * values[f, 1, k] + bary[2] * values[f, 2, k]


@wp.kernel
def fill_calm(
    first: int,
    step: int,
    width: int,
    height: int,
    gradient: wp.float64,
    directions: wp.array[wp.vec3d],
    reach: wp.array[wp.float64],
    colours: wp.array2d[wp.float64],
    # Data out:
    picture: wp.array2d[wp.uint8],
    busy: wp.array[wp.uint8],
):
    """Fill the blocks that no edge of the pattern touches by interpolation between their corners.

    Directions, reach and colours are given at every texel that is ``step`` from the next, and at the last of every row
    and column. Blocks in which there may be an edge, or colours that differ by more than ``gradient``, are left alone
    and marked in ``busy`` by a 1. ``first`` is the number of the first block.
    """
    i, _compiled_once = wp.tid()
    across = (width + step - 1) // step
    row = (first + i) // across
    column = (first + i) % across
    x0 = column * step
    y0 = row * step
    k = row * (across + 1) + column
    m = k + across + 1
    apart = wp.max(wp.length(directions[m + 1] - directions[k]), wp.length(directions[k + 1] - directions[m]))
    least = wp.min(wp.min(reach[k], reach[k + 1]), wp.min(reach[m], reach[m + 1]))
    # A point of a block is no farther from one of its corners than half of its diagonal; a fifth more leaves room for
    # directions that are not quite linear in between.
    calm = least > wp.float64(0.6) * apart
    for c in range(3):
        low = wp.min(wp.min(colours[k, c], colours[k + 1, c]), wp.min(colours[m, c], colours[m + 1, c]))
        high = wp.max(wp.max(colours[k, c], colours[k + 1, c]), wp.max(colours[m, c], colours[m + 1, c]))
        if high - low > gradient:
            calm = False
    busy[i] = wp.uint8(1)
    if calm:
        busy[i] = wp.uint8(0)
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


@wp.func
def grid_place(bary: wp.vec3d, parts: int, first: int, grid: wp.array[wp.int32], points: wp.array[wp.vec3d]):
    """Return the point of a divided triangle at barycentric coordinates."""
    n = wp.float64(parts)
    x, y = wp.clamp(bary[1], ZERO, ONE) * n, wp.clamp(bary[2], ZERO, ONE) * n
    a = wp.clamp(int(wp.floor(x)), 0, parts - 1)
    b = wp.clamp(int(wp.floor(y)), 0, parts - 1 - a)
    s, t = x - wp.float64(a), y - wp.float64(b)
    here = first + a * (2 * parts + 3 - a) // 2 + b
    after = first + (a + 1) * (2 * parts + 2 - a) // 2 + b  # one step towards corner 1
    if s + t <= ONE or a + b == parts - 1:
        return (ONE - s - t) * points[grid[here]] + s * points[grid[after]] + t * points[grid[here + 1]]
    return (
        (s + t - ONE) * points[grid[after + 1]] + (ONE - t) * points[grid[after]] + (ONE - s) * points[grid[here + 1]]
    )


@wp.kernel
def texel_sample_directions(
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
    """Compute the directions of the samples, a regular grid, of texels that are given by their numbers row by row.

    With hints they are moved by the difference of a smooth map from the linear one. ``hints`` names a triangle of the
    mesh near every block of texels, -1 where there is none. ``divided`` says into how many parts the edges of a
    triangle are divided, 0 where the smooth map is the linear one; ``first`` where its points begin in the grid.
    """
    i, _compiled_once = wp.tid()
    number = texels[i]
    move = wp.vec3d(ZERO, ZERO, ZERO)
    bent = bool(False)
    if hints.shape[0] > 0:
        row, column = number // width, number % width
        # All samples are moved as the middle is: across a texel that changes by a small part of one.
        d = picture_direction(kind, wp.float64(column) + HALF, wp.float64(row) + HALF, width, height, offset, gutter)
        f = hints[row // block * blocks_across + column // block]
        if f < 0:  # in a gutter, which shows what lies elsewhere on the picture
            place = picture_point(kind, d, width, height, offset, gutter)
            column_there = wp.clamp(int(wp.floor(place[0])), 0, width - 1)
            row_there = wp.clamp(int(wp.floor(place[1])), 0, height - 1)
            f = hints[row_there // block * blocks_across + column_there // block]
        weights = wp.vec3d()
        inside = bool(False)
        steps = int(0)
        # The meshes of most surfaces have fewer triangles across a block of texels than this.
        most_steps = int(64)
        while f >= 0 and steps < most_steps and not inside:
            face = faces[f]
            weights = spherical_coordinates(sphere[face[0]], sphere[face[1]], sphere[face[2]], d)
            total = weights[0] + weights[1] + weights[2]
            worst = int(wp.argmin(weights))
            # In shares of the triangle: ten times round-off's part of the least one that a texel shows
            if weights[worst] >= wp.float64(-1.0e-9) * total and total > ZERO:
                inside = True
            else:
                f = neighbours[f][(worst + 1) % 3]  # corner k is opposite to the edge from corner k + 1
                steps = steps + 1
        if inside:
            parts = divided[f]
            if parts > 0:
                bary = clamped(weights)
                face = faces[f]
                linear = bary[0] * sphere[face[0]] + bary[1] * sphere[face[1]] + bary[2] * sphere[face[2]]
                smooth = grid_place(bary, parts, first[f], grid, points)
                move = wp.normalize(smooth) - wp.normalize(linear)
                bent = True
    for k in range(samples * samples):
        x, y = sample_place(number, width, k, samples)
        sample = picture_direction(kind, x, y, width, height, offset, gutter)
        if bent:
            sample = wp.normalize(sample + move)
        directions[i * samples * samples + k] = sample


@wp.kernel
def tangent_normals(
    detail: wp.uint64,
    detail_faces: wp.array2d[wp.int32],
    detail_normals: wp.array[wp.vec3d],
    points: wp.array[wp.vec3d],
    normals: wp.array[wp.vec3d],
    tangents: wp.array[wp.vec4d],
    # Data out:
    out: wp.array[wp.vec3d],
):
    """Compute the normals of a detailed surface, nearest to points, in the frames of tangents and normals there.

    The frame is glTF 2.0's: x along the tangent, y along sign * cross(normal, tangent), z along the normal.
    """
    i = wp.tid()
    n = wp.normalize(normals[i])
    t = wp.normalize(wp.vec3d(tangents[i][0], tangents[i][1], tangents[i][2]))
    b = wp.cross(n, t) * tangents[i][3]
    # Single precision suffices to find the triangle: nothing else is taken from the query.
    p = wp.vec3(wp.float32(points[i][0]), wp.float32(points[i][1]), wp.float32(points[i][2]))
    hit = wp.mesh_query_point_no_sign(detail, p, 10.0)
    out[i] = wp.vec3d(ZERO, ZERO, ONE)
    if hit.result:
        u, v = wp.float64(hit.u), wp.float64(hit.v)
        n0 = detail_normals[detail_faces[hit.face, 0]]
        n1 = detail_normals[detail_faces[hit.face, 1]]
        n2 = detail_normals[detail_faces[hit.face, 2]]
        fine = u * n0 + v * n1 + (ONE - u - v) * n2
        # The frame need not be orthogonal after interpolation: solve for the coordinates.
        frame = wp.mat33d(t[0], b[0], n[0], t[1], b[1], n[1], t[2], b[2], n[2])
        local = fine
        # Of tangent, bitangent and normal: below, single precision's normals give no frame.
        if wp.abs(wp.determinant(frame)) > wp.float64(1.0e-6):
            local = wp.inverse(frame) * fine
        out[i] = wp.normalize(local)
