# mypy: ignore-errors
"""Kernels on the texels of a mesh's texture."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, ZERO, wp
from omtwarp.texturing.kernels import edge_side, sign_of, texels_within

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def count_claims(
    corners: wp.array2d[wp.vec2d],
    width: int,
    height: int,
    inside: wp.float64,
    # Data out:
    claims: wp.array[wp.int32],
):
    """Count the triangles in which the centre of every texel lies, farther than a distance from their sides.

    ``corners`` are in texels, y down. Whole numbers are added, so that the order of threads does not matter.
    """
    f = wp.tid()
    a = corners[f, 0]
    b = corners[f, 1]
    c = corners[f, 2]
    area = edge_side(a[0], a[1], b[0], b[1], c[0], c[1])
    if area == ZERO:
        return
    flip = sign_of(area)
    ab = wp.length(b - a) * flip
    bc = wp.length(c - b) * flip
    ca = wp.length(a - c) * flip
    low_x, high_x = texels_within(a[0], b[0], c[0], ZERO, 0, width)
    low_y, high_y = texels_within(a[1], b[1], c[1], ZERO, 0, height)
    for row in range(low_y, high_y + 1):
        for column in range(low_x, high_x + 1):
            x = wp.float64(column) + HALF
            y = wp.float64(row) + HALF
            if edge_side(a[0], a[1], b[0], b[1], x, y) / ab > inside:
                if edge_side(b[0], b[1], c[0], c[1], x, y) / bc > inside:
                    if edge_side(c[0], c[1], a[0], a[1], x, y) / ca > inside:
                        wp.atomic_add(claims, row * width + column, 1)


@wp.func
def repeated(index: int, count: int):
    """Bring an index into [0, count)."""
    rest = index % count
    if rest < 0:
        rest = rest + count
    return rest


@wp.kernel
def sample_repeated(
    picture: wp.array3d[wp.float32],
    points: wp.array2d[wp.float64],
    # Data out:
    out: wp.array2d[wp.float64],
):
    """Compute the bilinear samples of a picture that repeats both ways, at texture coordinates (v up)."""
    i = wp.tid()
    height = picture.shape[0]
    width = picture.shape[1]
    u = points[i, 0]
    v = points[i, 1]
    x = (u - wp.floor(u)) * wp.float64(width) - HALF
    y = (wp.ceil(v) - v) * wp.float64(height) - HALF
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    s = x - wp.float64(column)
    t = y - wp.float64(row)
    left = repeated(column, width)
    right = repeated(column + 1, width)
    above = repeated(row, height)
    below = repeated(row + 1, height)
    for c in range(picture.shape[2]):
        top = (ONE - s) * wp.float64(picture[above, left, c]) + s * wp.float64(picture[above, right, c])
        low = (ONE - s) * wp.float64(picture[below, left, c]) + s * wp.float64(picture[below, right, c])
        out[i, c] = (ONE - t) * top + t * low


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
        u = wp.float64(hit.u)
        v = wp.float64(hit.v)
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
