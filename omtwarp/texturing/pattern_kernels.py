# mypy: ignore-errors
"""Kernels that colour directions on the sphere with the built-in patterns.

Every pattern is a function of the direction alone, exact at any resolution: nothing here knows of texels.

With its colour every direction gets its reach: an angle in radians within which the colour changes gradually, without
an edge. It is never too large; beyond some angle, which is small beside a pattern's cells, edges are not looked for.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, PI, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)

# Squared degrees, that are divided by: a shorter piece of coast is a point.
SMALLEST_PIECE = wp.constant(wp.float64(1.0e-12))


@wp.func
def longitude(d: wp.vec3d):
    return wp.atan2(d[1], d[0])


@wp.func
def latitude(d: wp.vec3d):
    return wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1]))


@wp.func
def cell_of(value: wp.float64, low: wp.float64, high: wp.float64, count: int):
    """Return which of ``count`` equal cells between two numbers a value falls in, the last one closed."""
    k = int(wp.floor((value - low) / (high - low) * wp.float64(count)))
    return wp.clamp(k, 0, count - 1)


@wp.func
def near_multiple(value: wp.float64, step: wp.float64):
    """Return the distance to the nearest multiple of a step."""
    return wp.abs(value - step * wp.floor(value / step + HALF))


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


@wp.func
def cube_face(d: wp.vec3d):
    """Return the face of the cube that a direction passes through: +x, +y, -x, -y, +z, -z."""
    ax = wp.abs(d[0])
    ay = wp.abs(d[1])
    az = wp.abs(d[2])
    face = int(0)
    if ax >= ay and ax >= az:
        if d[0] < ZERO:
            face = int(2)
    elif ay >= az:
        face = int(1)
        if d[1] < ZERO:
            face = int(3)
    else:
        face = int(4)
        if d[2] < ZERO:
            face = int(5)
    return face


@wp.kernel
def circle_colours(
    directions: wp.array[wp.vec3d],
    side: int,
    offsets: wp.array[wp.int32],
    candidates: wp.array[wp.int32],
    centres: wp.array[wp.vec3d],
    inner: wp.array[wp.vec3d],
    rim: wp.array[wp.vec3d],
    outer: wp.float64,
    rim_starts: wp.float64,
    beyond: wp.float64,
    background: wp.vec3d,
    # Data out:
    out: wp.array2d[wp.float64],
    reach: wp.array[wp.float64],
):
    i, _compiled_once = wp.tid()
    d = wp.normalize(directions[i])
    # Only circles that reach this cell of the faces of a cube are looked at.
    face = cube_face(d)
    axis = face % 2
    if face > 3:
        axis = int(2)
    scale = HALF * wp.float64(side) / wp.abs(d[axis])
    column = wp.clamp(int((d[(axis + 1) % 3]) * scale + HALF * wp.float64(side)), 0, side - 1)
    row = wp.clamp(int((d[(axis + 2) % 3]) * scale + HALF * wp.float64(side)), 0, side - 1)
    cell = (face * side + row) * side + column
    colour = background
    near = beyond
    for k in range(offsets[cell], offsets[cell + 1]):
        centre = candidates[k]
        chord = wp.length_sq(d - centres[centre])  # squared, as the two limits are
        if chord <= outer:
            colour = inner[centre]
            if chord > rim_starts:
                colour = rim[centre]
        distance = wp.sqrt(chord)  # and a chord is shorter than its arc
        near = wp.min(near, wp.min(wp.abs(distance - wp.sqrt(outer)), wp.abs(distance - wp.sqrt(rim_starts))))
    for c in range(3):
        out[i, c] = colour[c]
    reach[i] = near


@wp.func
def smooth_union(a: wp.float64, b: wp.float64, k: wp.float64):
    """Return the distance to a union of two shapes with the corner between them rounded (polynomial smooth minimum)."""
    h = wp.max(k - wp.abs(a - b), ZERO) / k
    return wp.min(a, b) - h * h * k * wp.float64(0.25)


@wp.func
def jigsaw_edge(s: wp.float64, t: wp.float64):
    """Return the signed distance to a jigsaw edge: negative on the side of the piece that has the tab.

    The edge runs along t = 0 for s in 0..1, the tab reaches into t > 0; lengths are in sides of a piece.
    """
    x = s - HALF
    body = t
    neck = wp.max(wp.abs(x) - wp.float64(0.055), t - wp.float64(0.16))
    knob_x = x / wp.float64(1.16)  # a little wider than high
    knob_t = t - wp.float64(0.185)
    knob = wp.sqrt(knob_x * knob_x + knob_t * knob_t) - wp.float64(0.105)
    return smooth_union(smooth_union(knob, neck, wp.float64(0.035)), body, wp.float64(0.05))


@wp.kernel
def puzzle_colours(
    directions: wp.array[wp.vec3d],
    frames: wp.array[wp.mat33d],
    side: int,
    neighbours: wp.array2d[wp.int32],
    tabs: wp.array2d[wp.int32],
    shifts: wp.array2d[wp.float64],
    colours: wp.array[wp.vec3d],
    line: wp.float64,
    line_colour: wp.vec3d,
    # Data out:
    out: wp.array2d[wp.float64],
    reach: wp.array[wp.float64],
):
    i, _compiled_once = wp.tid()
    d = directions[i]
    face = cube_face(d)
    local = frames[face] * d
    # Equiangular coordinates: pieces of nearly the same size from the middle of a face of the cube to its corners.
    scale = wp.float64(side) * HALF
    x = (wp.atan2(local[1], local[0]) * wp.float64(4.0) / PI + ONE) * scale
    y = (wp.atan2(local[2], local[0]) * wp.float64(4.0) / PI + ONE) * scale
    column = wp.clamp(int(wp.floor(x)), 0, side - 1)
    row = wp.clamp(int(wp.floor(y)), 0, side - 1)
    x = x - wp.float64(column)
    y = y - wp.float64(row)
    piece = (face * side + row) * side + column
    owner = piece
    nearest = wp.float64(10.0)
    for edge in range(4):  # bottom, right, top, left; t is the depth into this piece
        s = x
        t = y
        if edge == 1:
            s = y
            t = ONE - x
        elif edge == 2:
            t = ONE - y
        elif edge == 3:
            s = y
            t = x
        s = s + shifts[piece, edge]
        distance = ZERO
        if tabs[piece, edge] > 0:  # this piece's tab reaches over the edge, into t < 0
            distance = -jigsaw_edge(s, -t)
        else:
            distance = jigsaw_edge(s, t)
        if distance < ZERO:
            owner = neighbours[piece, edge]
        nearest = wp.min(nearest, wp.abs(distance))
    colour = colours[owner]
    # A soft edge of light and dark makes the pieces look cut out.
    bevel = wp.float64(0.045)
    if nearest < line + bevel:
        colour = colour * (wp.float64(0.86) + wp.float64(0.14) * (nearest - line) / bevel)
    if nearest < line:
        colour = line_colour
    for c in range(3):
        out[i, c] = colour[c]
    # Edges of other pieces are no nearer than half a tab; a piece's side is an angle of this, and the cube's faces
    # shrink no length to less than half of it.
    apart = wp.min(wp.abs(nearest - line), wp.abs(nearest - line - bevel))
    reach[i] = wp.min(apart, wp.float64(0.1)) * HALF * HALF * PI / wp.float64(side)


@wp.func
def crosses(px: wp.float64, py: wp.float64, qx: wp.float64, qy: wp.float64, a: wp.vec4d):
    """Return 1 where the straight piece with its ends in ``a`` crosses the path from p to q in the plane, else 0."""
    ax = a[0]
    ay = a[1]
    bx = a[2]
    by = a[3]
    # Half-open tests, so that a vertex of the coast that lies on the path's line counts once.
    side_a = (qx - px) * (ay - py) - (qy - py) * (ax - px) >= ZERO
    side_b = (qx - px) * (by - py) - (qy - py) * (bx - px) >= ZERO
    count = int(0)
    if side_a != side_b:
        side_p = (bx - ax) * (py - ay) - (by - ay) * (px - ax) >= ZERO
        side_q = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax) >= ZERO
        if side_p != side_q:
            count = int(1)
    return count


@wp.func
def piece_distance(px: wp.float64, py: wp.float64, stretch: wp.float64, a: wp.vec4d):
    """Return the distance in degrees from a point to a straight piece of coast, longitudes scaled by ``stretch``."""
    ex = (a[2] - a[0]) * stretch
    ey = a[3] - a[1]
    dx = (px - a[0]) * stretch
    dy = py - a[1]
    t = wp.clamp((dx * ex + dy * ey) / wp.max(ex * ex + ey * ey, SMALLEST_PIECE), ZERO, ONE)
    dx = dx - t * ex
    dy = dy - t * ey
    return wp.sqrt(dx * dx + dy * dy)


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
    spacing = step
    if wp.abs(lat) > wp.float64(90.0) - step:
        spacing = step * wp.float64(6.0)
    if wp.abs(lat) > wp.float64(89.0):
        spacing = wp.float64(720.0)
    meridian = near_multiple(lon, spacing) * stretch
    if wp.abs(lat) > wp.float64(89.0):
        meridian = wp.float64(1.0e3)
    parallel = near_multiple(lat, step)
    if wp.abs(lat) > wp.float64(89.5):
        parallel = wp.float64(1.0e3)
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
