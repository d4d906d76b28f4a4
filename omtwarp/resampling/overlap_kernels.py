"""Exact areas in which convex polygons of great-circle arcs overlap."""

# mypy: ignore-errors
from omtwarp.device.start import KERNEL_OPTIONS, ZERO, wp
from omtwarp.geometry.spherical import solid_angle

wp.set_module_options(KERNEL_OPTIONS)

# Two quadrilaterals overlap in a polygon of up to eight corners; while it is cut there may be one more.
mat93d = wp.types.matrix(shape=(9, 3), dtype=wp.float64)


@wp.func
def overlap_area(subject: wp.array2d[wp.vec3d], s: int, cutter: wp.array2d[wp.vec3d], t: int) -> wp.float64:
    """Return the area of the intersection of polygons s and t.

    The first is cut by the sides of the other (Sutherland and Hodgman 1974).
    """
    polygon = mat93d()
    count = int(4)
    for k in range(4):
        polygon[k] = subject[s, k]
    for k in range(4):
        start = cutter[t, k]
        end = cutter[t, (k + 1) % 4]
        side = wp.cross(start, end - start)
        if count > 0 and wp.length_sq(side) > ZERO:  # a triangle has one side of no length
            kept = mat93d()
            kept_count = int(0)
            previous = polygon[count - 1]
            height_before = wp.dot(side, previous - start)
            for m in range(count):
                current = polygon[m]
                height = wp.dot(side, current - start)
                if (height >= ZERO) != (height_before >= ZERO) and kept_count < 9:
                    where = height_before / (height_before - height)
                    kept[kept_count] = wp.normalize(previous + where * (current - previous))
                    kept_count += 1
                if height >= ZERO and kept_count < 9:
                    kept[kept_count] = current
                    kept_count += 1
                previous = current
                height_before = height
            polygon = kept
            count = kept_count
    area = wp.float64(0.0)
    first = polygon[0]
    for m in range(1, count - 1):
        area += solid_angle(first, polygon[m], polygon[m + 1])
    return area


@wp.kernel
def list_overlaps(
    lower: wp.array[wp.vec3],
    upper: wp.array[wp.vec3],
    targets: wp.array2d[wp.vec3d],
    first: wp.array[wp.int32],
    boxes: wp.uint64,
    sources: wp.array2d[wp.vec3d],
    smallest: wp.float64,
    # Data out:
    counts: wp.array[wp.int32],
    partners: wp.array[wp.int32],
    areas: wp.array[wp.float64],
):
    """Compute the number of source polygons that share more than a smallest area with each target polygon.

    Where the last two arrays have room, these polygons and the areas are listed there, from ``first`` on.
    """
    i, _compiled_once = wp.tid()
    count = int(0)
    query = wp.bvh_query_aabb(boxes, lower[i], upper[i])
    s = int(0)
    while wp.bvh_query_next(query, s):
        area = overlap_area(sources, s, targets, i)
        if area > smallest:
            if partners.shape[0] > 0:
                partners[first[i] + count] = s
                areas[first[i] + count] = area
            count += 1
    counts[i] = count
