"""Kernels that gather the Hessians of triangles into blocks of a sparse matrix; on the CPU, where it is factorised."""

from omtwarp._warp import ZERO, wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def gather_vertex_blocks(
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    blocks: wp.array2d[wp.float64],
    # Data out:
    diagonal: wp.array2d[wp.float64],
):
    """The 2x2 block of every vertex: the sum over the triangles around it."""
    v = wp.tid()
    s0, s1, s2, s3 = wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0)
    for k in range(offsets[v], offsets[v + 1]):
        face = corners[k] // 3
        at = 14 * (corners[k] - 3 * face)  # row and column 2 i of the 6x6 matrix
        s0 += blocks[face, at]
        s1 += blocks[face, at + 1]
        s2 += blocks[face, at + 6]
        s3 += blocks[face, at + 7]
    diagonal[v, 0] = s0
    diagonal[v, 1] = s1
    diagonal[v, 2] = s2
    diagonal[v, 3] = s3


@wp.kernel
def gather_edge_blocks(
    edges: wp.array[wp.vec2i],
    faces: wp.array[wp.vec3i],
    corners: wp.array[wp.vec2i],
    blocks: wp.array2d[wp.float64],
    # Data out:
    off_diagonal: wp.array2d[wp.float64],
):
    """The 2x2 block of every edge, rows of its first end, columns of its second: the sum over its two triangles."""
    e = wp.tid()
    first = edges[e][0]
    for q in range(4):
        off_diagonal[e, q] = ZERO
    for k in range(2):
        face = corners[e][k] // 3
        opposite = corners[e][k] - 3 * face
        i = (opposite + 1) % 3
        j = (opposite + 2) % 3
        if faces[face][i] != first:
            i = (opposite + 2) % 3
            j = (opposite + 1) % 3
        at = 12 * i + 2 * j
        off_diagonal[e, 0] = off_diagonal[e, 0] + blocks[face, at]
        off_diagonal[e, 1] = off_diagonal[e, 1] + blocks[face, at + 1]
        off_diagonal[e, 2] = off_diagonal[e, 2] + blocks[face, at + 6]
        off_diagonal[e, 3] = off_diagonal[e, 3] + blocks[face, at + 7]
