"""Kernels of the lower bound on a torus: the best point of the image triangles for every point of the plane.

On an image triangle with corners p_k the potential is ψ = Σ_k b_k ψ_k + b_0 b_1 e_0 + b_1 b_2 e_1 + b_2 b_0 e_2 in
barycentric coordinates b. With U = |z|²/2 - ψ(z), which has the same form, |x - z|²/2 - ψ(z) = |x|²/2 + U(z) - x · z:
to find its least value is to minimise U less a linear function. Triangles are the leaves of a complete binary tree in
heap order, in which node k has the children 2k and 2k + 1.
"""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ZERO, wp
from omtwarp.metrics.optimality_kernels import LARGE, leaves_below, lowest_on_triangle, next_subtree, potential_at

wp.set_module_options(KERNEL_OPTIONS)

# Of a node: a slope, the least value of U less the slope, and the least and the largest coordinate along both axes.
vec7d = wp.types.vector(length=7, dtype=wp.float64)


@wp.func
def lowest_point(x: wp.vec2d, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, heights: wp.vec3d, bulge: wp.vec3d) -> wp.vec3d:
    """Return the barycentric coordinates of where U(z) - x · z is least on a triangle."""
    return lowest_on_triangle(heights - wp.vec3d(wp.dot(x, a), wp.dot(x, b), wp.dot(x, c)), bulge)


@wp.func
def height_at(x: wp.vec2d, a: wp.vec2d, b: wp.vec2d, c: wp.vec2d, heights: wp.vec3d, bulge: wp.vec3d, w: wp.vec3d):
    """Evaluate U(z) - x · z at barycentric coordinates of a triangle."""
    return potential_at(heights - wp.vec3d(wp.dot(x, a), wp.dot(x, b), wp.dot(x, c)), bulge, w)


@wp.kernel
def build_plane_nodes(
    corners: wp.array2d[wp.vec2d],
    heights: wp.array[wp.vec3d],
    bulges: wp.array[wp.vec3d],
    slopes: wp.array[wp.vec2d],
    face_count: int,
    leaf_count: int,
    # Data out:
    nodes: wp.array[vec7d],
):
    """Find a rectangle that holds the triangles below a node, and a linear function below U on them."""
    node = wp.tid()
    model = vec7d()
    model[2] = LARGE
    nodes[node] = model
    if node == 0:
        return
    first, last = leaves_below(node, leaf_count, face_count)
    if first > last:
        return
    slope = wp.vec2d()
    for f in range(first, last + 1):
        slope += slopes[f]
    slope = slope / wp.float64(last - first + 1)
    least = LARGE
    low = corners[first, 0]
    high = corners[first, 0]
    for f in range(first, last + 1):
        a = corners[f, 0]
        b = corners[f, 1]
        c = corners[f, 2]
        at = lowest_point(slope, a, b, c, heights[f], bulges[f])
        least = wp.min(least, height_at(slope, a, b, c, heights[f], bulges[f], at))
        low = wp.min(low, wp.min(a, wp.min(b, c)))
        high = wp.max(high, wp.max(a, wp.max(b, c)))
    model[0] = slope[0]
    model[1] = slope[1]
    model[2] = least
    model[3] = low[0]
    model[4] = high[0]
    model[5] = low[1]
    model[6] = high[1]
    nodes[node] = model


@wp.kernel
def best_images(
    points: wp.array[wp.vec2d],
    seeds: wp.array[wp.float64],
    copies: wp.array[wp.vec2d],
    corners: wp.array2d[wp.vec2d],
    heights: wp.array[wp.vec3d],
    bulges: wp.array[wp.vec3d],
    nodes: wp.array[vec7d],
    leaf_count: int,
    tolerance: wp.float64,
    # Data out:
    proven: wp.array[wp.float64],
    leaf: wp.array[wp.int32],
    shares: wp.array[wp.vec3d],
):
    """Compute φ(x), the least |x - z|²/2 - ψ(z) over the copies of all triangles.

    A branch is skipped where its bound proves that it has no value below the best so far less the tolerance. ``proven``
    is the lower of the least value found and of all bounds that were relied upon. ``leaf`` is -1 where nothing lower
    than the seed was found.
    """
    i = wp.tid()
    best = seeds[i] + ZERO
    best_leaf = int(-1)
    best_shares = wp.vec3d()
    relied = LARGE
    for copy in range(copies.shape[0]):
        x = points[i] - copies[copy]
        own = HALF * wp.dot(x, x)
        node = int(1)
        while node > 0:
            inside = bool(False)
            model = nodes[node]
            if model[2] < LARGE:
                dx = model[0] - x[0]
                dy = model[1] - x[1]
                bound = own + model[2] + wp.min(dx * model[3], dx * model[4]) + wp.min(dy * model[5], dy * model[6])
                inside = bound < best - tolerance
                if not inside:
                    relied = wp.min(relied, bound - wp.float64(1.0e-14))  # that rounding may add
            if inside and node < leaf_count:
                node = 2 * node
            else:
                if inside:
                    f = node - leaf_count
                    a = corners[f, 0]
                    b = corners[f, 1]
                    c = corners[f, 2]
                    at = lowest_point(x, a, b, c, heights[f], bulges[f])
                    value = own + height_at(x, a, b, c, heights[f], bulges[f], at)
                    if value < best:
                        best = value
                        best_leaf = f
                        best_shares = at
                node = next_subtree(node)
    proven[i] = wp.min(best, relied)
    leaf[i] = best_leaf
    shares[i] = best_shares
