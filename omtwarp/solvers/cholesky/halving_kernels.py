"""Kernels that cut the parts of a mesh in two, on the CPU, a thread for every part."""

from omtwarp.device.start import KERNEL_OPTIONS, wp

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Parts:
    """A mesh whose parts have a stretch of its vertices and one of its edges each, and memory.

    A part is the first of its vertices and the one behind the last, and the same of its edges.
    """

    vertices: wp.array[wp.int32]  # part after part
    edges: wp.array[wp.vec2i]  # part after part
    # By vertex:
    positions: wp.array[wp.vec3d]
    node: wp.array[wp.int64]  # in the tree of dissection
    second: wp.array[wp.bool]  # whether it is in the second half of its part
    separates: wp.array[wp.bool]
    ring: wp.array[wp.int32]  # 1 and more near the vertices that separate, 0 elsewhere
    rank: wp.array[wp.int32]  # how many vertices of its part come before it along a direction
    # By place in the stretches:
    along: wp.array[wp.float64]
    counts: wp.array[wp.int32]
    passed: wp.array[wp.int32]
    edges_passed: wp.array[wp.vec2i]


# Raw pointers, because the compiler computes the place of every entry of Warp's arrays anew: a third of the time.
CUT_ACROSS = """
    const int begin = part[0], count = part[1] - begin;
    const int* vertex = parts.vertices.data + begin;
    int *rank = parts.rank.data, *counter = parts.counts.data + begin;
    double *along = parts.along.data + begin, lowest = 1e300, highest = -1e300;
    for (int i = 0; i < count; ++i) {
        const auto& at = parts.positions.data[vertex[i]];
        along[i] = direction[0] * at[0] + direction[1] * at[1] + direction[2] * at[2];
        if (along[i] < lowest) lowest = along[i];
        if (along[i] > highest) highest = along[i];
        counter[i] = 0;
    }
    for (int i = 0; i < count; ++i) {
        along[i] = highest > lowest ? (along[i] - lowest) / (highest - lowest) * (count - 1) : 0.0;
        counter[(int)along[i]] += 1;
    }
    for (int i = 0, before = 0; i < count; ++i) {
        const int own = counter[i];
        counter[i] = before;
        before += own;
    }
    for (int i = 0; i < count; ++i) rank[vertex[i]] = counter[(int)along[i]]++;
    for (int i = 0; i < count; ++i) counter[i] = 0;
    for (int e = part[2]; e < part[3]; ++e) {
        const auto& ends = parts.edges.data[e];
        const int one = rank[ends[0]], other = rank[ends[1]];
        counter[one < other ? one : other] += 1;
        counter[one < other ? other : one] -= 1;
    }
    double best = least;
    int cut = -1;
    for (int i = 0, crossing = 0; i < count - 1; ++i) {
        crossing += counter[i];
        const double share = (i + 1.0) / count - 0.5;
        if (share * share > window * window && i != count / 2 - 1) continue;
        const double ratio = crossing / (0.25 - share * share);
        if (ratio < best) {
            best = ratio;
            cut = i;
        }
    }
    if (cut >= 0)
        for (int i = 0; i < count; ++i) parts.second.data[vertex[i]] = rank[vertex[i]] > cut;
    return best;
"""


@wp.func_native(CUT_ACROSS)
def cut_across(  # type: ignore[empty-body]
    part: wp.vec4i, direction: wp.vec3d, window: wp.float64, least: wp.float64, parts: Parts
) -> wp.float64:
    """Cut a part across a direction where the ratio of the cut is least, if that is less than of the cut before.

    Vertices are sorted into as many bins along the direction as there are; those of one keep their order.

    Returns:
        The edges that cross over the product of the halves' shares of the vertices; ``least`` where that is less.
    """


@wp.func
def principal_axes(part: wp.vec4i, parts: Parts) -> wp.mat33d:
    """Return the principal axes of a part's vertices as columns."""
    mean = wp.vec3d()
    for i in range(part[0], part[1]):
        mean += parts.positions[parts.vertices[i]]
    mean /= wp.float64(part[1] - part[0])
    moments = wp.mat33d()
    for i in range(part[0], part[1]):
        centred = parts.positions[parts.vertices[i]] - mean
        moments += wp.outer(centred, centred)
    axes, _spread = wp.eig3(moments)
    return axes


@wp.func
def mark_ends(part: wp.vec4i, parts: Parts):
    """Let the ends of the edges that cross a part's cut, on the side with fewer of them, separate its halves."""
    for i in range(part[0], part[1]):
        parts.separates[parts.vertices[i]] = False
    for e in range(part[2], part[3]):
        one = parts.edges[e][0]
        other = parts.edges[e][1]
        if parts.second[one] != parts.second[other]:
            parts.separates[one] = True
            parts.separates[other] = True
    surplus = int(0)
    for i in range(part[0], part[1]):
        v = parts.vertices[i]
        if parts.separates[v]:
            surplus += wp.where(parts.second[v], 1, -1)
    for i in range(part[0], part[1]):
        v = parts.vertices[i]
        parts.separates[v] = parts.separates[v] and parts.second[v] == (surplus < 0)


@wp.func
def mark_rings(part: wp.vec4i, rings: int, parts: Parts):
    """Number the rings around the vertices that separate a part's halves, these with 1."""
    for i in range(part[0], part[1]):
        v = parts.vertices[i]
        parts.ring[v] = wp.where(parts.separates[v], 1, 0)
    for r in range(1, rings + 1):
        for e in range(part[2], part[3]):
            for k in range(2):
                v = parts.edges[e][k]
                if parts.ring[v] == 0 and parts.ring[parts.edges[e][1 - k]] == r:
                    parts.ring[v] = r + 1


@wp.kernel
def halve_parts(
    stretches: wp.array[wp.vec4i],
    window: wp.float64,
    largest_straight: int,
    rings: int,
    # Data in and out, of the part's vertices:
    parts: Parts,
):
    """Cut a part across the best of six directions, its principal axes and those of space, and mark what separates.

    Args:
        stretches: the parts.
        window: how far from its middle a part may be cut, as a share of its vertices.
        largest_straight: parts with more vertices get rings around those that separate.
        rings: so many.
    """
    part = stretches[wp.tid()]
    axes = principal_axes(part, parts)
    least = wp.float64(wp.inf)
    for k in range(6):
        direction = wp.vec3d()
        if k < 3:
            direction = wp.vec3d(axes[0, k], axes[1, k], axes[2, k])
        else:
            direction[k - 3] = wp.float64(1.0)
        least = cut_across(part, direction, window, least, parts)
    mark_ends(part, parts)
    if part[1] - part[0] > largest_straight:
        mark_rings(part, rings, parts)


@wp.kernel
def divide_parts(
    stretches: wp.array[wp.vec4i],
    # Data in and out, of the part's vertices:
    parts: Parts,
    # Data out:
    halves: wp.array[wp.vec4i],
):
    """Order the vertices and edges of a part by halves, without those that separate, and give vertices their node."""
    p = wp.tid()
    part = stretches[p]
    first = int(part[0])
    second = int(0)
    for i in range(part[0], part[1]):
        v = parts.vertices[i]
        if not parts.separates[v]:
            parts.node[v] = wp.int64(2) * parts.node[v]
            if parts.second[v]:
                parts.node[v] = parts.node[v] + wp.int64(1)
                parts.passed[part[0] + second] = v
                second += 1
            else:
                parts.vertices[first] = v
                first += 1
    for i in range(second):
        parts.vertices[first + i] = parts.passed[part[0] + i]
    for e in range(part[2], part[3]):
        parts.edges_passed[e] = parts.edges[e]
    middle_edge = int(part[2])
    last_edge = int(part[2])
    for half in range(2):
        middle_edge = last_edge
        for e in range(part[2], part[3]):
            ends = parts.edges_passed[e]
            gone = parts.separates[ends[0]] or parts.separates[ends[1]]
            if not gone and parts.second[ends[0]] == (half == 1):
                parts.edges[last_edge] = ends
                last_edge += 1
    halves[2 * p] = wp.vec4i(part[0], first, part[2], middle_edge)
    halves[2 * p + 1] = wp.vec4i(first, first + second, middle_edge, last_edge)
