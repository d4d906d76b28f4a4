"""Kernels of Newton steps whose vectors and inner products stay on the device."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, wp
from omtwarp.mesh import surface
from omtwarp.solvers.triangle_newton.newton_kernels import edge_block, vertex_block
from omtwarp.solvers.triangle_newton.triangle import first_tangent

wp.set_module_options(KERNEL_OPTIONS)

SPHERE_AREA = wp.constant(wp.float64(surface.SPHERE_AREA))  # of the unit sphere, 4π


@wp.kernel
def distortion_summands(
    ratio: wp.array[wp.float64],
    total: wp.array[wp.float64],
    # Data out:
    excess: wp.array[wp.float64],
    inverse: wp.array[wp.float64],
):
    """Compute r + 1/r - 2 without cancellation, r the area ratio scaled by the image's total area, and 1/ratio.

    Neither is multiplied by the areas yet.
    """
    t = wp.tid()
    scaled = SPHERE_AREA / total[0] * ratio[t]
    excess[t] = (scaled - ONE) * (scaled - ONE) / scaled
    inverse[t] = ONE / ratio[t]


@wp.kernel
def subtract_share(
    numerator: wp.array[wp.float64],
    denominator: wp.array[wp.float64],
    vectors: wp.array[wp.vec3d],
    # Data in and out:
    result: wp.array[wp.vec3d],
):
    """Compute result - numerator / denominator vectors."""
    i = wp.tid()
    result[i] = result[i] - numerator[0] / denominator[0] * vectors[i]


@wp.kernel
def add_share(
    numerator: wp.array[wp.float64],
    less: wp.array[wp.float64],
    denominator: wp.array[wp.float64],
    vectors: wp.array[wp.vec3d],
    # Data in and out:
    result: wp.array[wp.vec3d],
):
    """Compute result + (numerator - less) / denominator vectors."""
    i = wp.tid()
    result[i] = result[i] + (numerator[0] - less[0]) / denominator[0] * vectors[i]


@wp.kernel
def gradient_differences(
    after: wp.array[wp.vec3d],
    before: wp.array[wp.vec3d],
    # Data out:
    change: wp.array[wp.vec3d],
):
    i = wp.tid()
    change[i] = after[i] - before[i]


@wp.kernel
def descent_direction(
    points: wp.array[wp.vec3d],
    step: wp.array[wp.vec3d],
    gradient: wp.array[wp.vec3d],
    # Data out:
    direction: wp.array[wp.vec3d],
    along: wp.array[wp.float64],
    reach: wp.array[wp.float64],
):
    """Compute minus the tangential part of a step, its product with the gradient, and its length."""
    i = wp.tid()
    tangent = wp.dot(step[i], points[i]) * points[i] - step[i]
    direction[i] = tangent
    along[i] = wp.dot(tangent, gradient[i])
    reach[i] = wp.length(tangent)


@wp.kernel
def largest_of_strides(
    values: wp.array[wp.float64],
    # Data out:
    largest: wp.array[wp.float64],
):
    """Compute in thread t the largest of values t, t + T, t + 2T and so on (none negative), T the number of threads."""
    t = wp.tid()
    best = wp.float64(0.0)
    for i in range(t, values.shape[0], largest.shape[0]):
        best = wp.max(best, values[i])
    largest[t] = best


@wp.kernel
def rotation_blocks(
    points: wp.array[wp.vec3d],
    # Data out:
    blocks: wp.array[wp.float64],
):
    """Compute how a rotation ω moves a vertex in its tangent basis: (ω × y) · t = ω · (y × t), blocks 2 by 3."""
    i = wp.tid()
    y = points[i]
    t = first_tangent(y)
    s = wp.cross(y, t)
    for k in range(3):
        blocks[6 * i + k] = s[k]
        blocks[6 * i + 3 + k] = -t[k]


@wp.kernel
def gather_rows(
    source: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    edges: wp.array[wp.vec2i],
    faces: wp.array[wp.vec3i],
    edge_corners: wp.array[wp.vec2i],
    blocks: wp.array2d[wp.float64],
    # Data out:
    values: wp.array[wp.float64],
):
    """Compute the 2x2 blocks of compressed rows from the Hessians of triangles.

    See ``fill_rows`` of the multigrid kernels.

    A vertex sums over the triangles around it, an edge over its two.
    """
    k = wp.tid()
    index = source[k] // 3
    kind = source[k] - 3 * index
    block = wp.vec4d()
    if kind == 0:
        block = vertex_block(index, offsets, corners, blocks)
    else:
        # Entries of kind 1 lie in the row of the edge's first end.
        block = edge_block(edges[index][kind - 1], edge_corners[index], faces, blocks)
    for q in range(4):
        values[4 * k + q] = block[q]


@wp.kernel
def block_traces(
    diagonal: wp.array[wp.int32],
    values: wp.array[wp.float64],
    # Data out:
    trace: wp.array[wp.float64],
):
    """Compute the trace of every vertex's own block."""
    i = wp.tid()
    trace[i] = values[4 * diagonal[i]] + values[4 * diagonal[i] + 3]


@wp.kernel
def add_to_diagonal(
    diagonal: wp.array[wp.int32],
    trace: wp.array[wp.float64],
    shift: wp.float64,
    growth: wp.float64,
    # Data in and out:
    values: wp.array[wp.float64],
):
    """Add to the diagonal parts of its mean, from the sum of its entries, and of its mean at each vertex."""
    i = wp.tid()
    first = 4 * diagonal[i]
    more = shift * trace[0] / wp.float64(2 * diagonal.shape[0])
    more += growth * HALF * (values[first] + values[first + 3])
    values[first] = values[first] + more
    values[first + 3] = values[first + 3] + more
