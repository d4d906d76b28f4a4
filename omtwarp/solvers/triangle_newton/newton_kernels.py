"""Kernels that gather the Hessians of triangles into blocks of the sparse matrix that the host factorises."""

from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def packed(row: int, column: int) -> int:
    """Return the index of an entry in a symmetric 6x6 matrix stored by its upper triangle, row by row."""
    return (row * (11 - row)) // 2 + column


@wp.func
def vertex_block(
    v: int,
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    blocks: wp.array2d[wp.float64],
) -> wp.vec4d:
    """Sum the 2x2 block of a vertex over the triangles around it."""
    s0, s1, s2 = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        face = corners[k] // 3
        row = 2 * (corners[k] - 3 * face)
        at = packed(row, row)
        s0 += blocks[face, at]
        s1 += blocks[face, at + 1]
        s2 += blocks[face, packed(row + 1, row + 1)]
    return wp.vec4d(s0, s1, s1, s2)


@wp.func
def edge_block(
    end: int,
    opposite_corners: wp.vec2i,
    faces: wp.array[wp.vec3i],
    blocks: wp.array2d[wp.float64],
) -> wp.vec4d:
    """Sum the 2x2 block of an edge, rows of one end and columns of the other, over its two triangles."""
    s0, s1, s2, s3 = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for k in range(2):
        if opposite_corners[k] >= 0:
            face = opposite_corners[k] // 3
            opposite = opposite_corners[k] - 3 * face
            i = (opposite + 1) % 3
            j = (opposite + 2) % 3
            if faces[face][i] != end:
                i = (opposite + 2) % 3
                j = (opposite + 1) % 3
            upper = packed(2 * wp.min(i, j), 2 * wp.max(i, j))
            lower = packed(2 * wp.min(i, j) + 1, 2 * wp.max(i, j))
            s0 += blocks[face, upper]
            s3 += blocks[face, lower + 1]
            if i < j:
                s1 += blocks[face, upper + 1]
                s2 += blocks[face, lower]
            else:
                s1 += blocks[face, lower]
                s2 += blocks[face, upper + 1]
    return wp.vec4d(s0, s1, s2, s3)


@wp.kernel
def gather_vertex_blocks(
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    blocks: wp.array2d[wp.float64],
    # Data out:
    diagonal: wp.array2d[wp.float64],
):
    """Compute the block of every vertex."""
    v = wp.tid()
    block = vertex_block(v, offsets, corners, blocks)
    for q in range(4):
        diagonal[v, q] = block[q]


@wp.kernel
def gather_edge_blocks(
    edges: wp.array[wp.vec2i],
    faces: wp.array[wp.vec3i],
    corners: wp.array[wp.vec2i],
    blocks: wp.array2d[wp.float64],
    weight: wp.float64,
    # Data out:
    off_diagonal: wp.array2d[wp.float64],
):
    """Compute the block of every edge, rows of its first end, times a weight."""
    e = wp.tid()
    block = weight * edge_block(edges[e][0], corners[e], faces, blocks)
    for q in range(4):
        off_diagonal[e, q] = block[q]
