"""Kernels that find flipped triangles and shorten the steps of their vertices."""

from omtwarp._warp import ZERO, wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def flag_flips(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    flags: wp.array[wp.int32],
    count: wp.array[wp.int32],
):
    f = wp.tid()
    face = faces[f]
    flags[f] = 1
    if wp.dot(points[face[0]], wp.cross(points[face[1]], points[face[2]])) > ZERO:
        flags[f] = 0
    else:
        wp.atomic_add(count, 0, 1)  # an integer: the order of the additions does not matter


@wp.kernel
def flag_bad_steps(
    start: wp.array[wp.vec3d],
    end: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    floors: wp.array[wp.float64],
    changed: wp.array[wp.int32],
    # Data out:
    flags: wp.array[wp.int32],
    count: wp.array[wp.int32],
):
    """Triangles that a step flips, or shrinks below their floor; one that is below it already may grow.

    Only where a corner has changed since the last time: a triangle that was bad has had all of them changed.
    """
    f = wp.tid()
    face = faces[f]
    if changed[face[0]] + changed[face[1]] + changed[face[2]] > 0:
        after = wp.dot(end[face[0]], wp.cross(end[face[1]], end[face[2]]))
        before = wp.dot(start[face[0]], wp.cross(start[face[1]], start[face[2]]))
        if after > ZERO and (after >= before or after >= floors[f]):
            flags[f] = 0
        else:
            flags[f] = 1
            wp.atomic_add(count, 0, 1)


@wp.kernel
def shorten_steps(
    old: wp.array[wp.vec3d],
    trial: wp.array[wp.vec3d],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    flags: wp.array[wp.int32],
    limit: int,
    # Data in and out:
    halvings: wp.array[wp.int32],
    # Data out:
    changed: wp.array[wp.int32],
    moved: wp.array[wp.vec3d],
):
    v = wp.tid()
    flipped = int(0)
    for k in range(offsets[v], offsets[v + 1]):
        flipped += flags[corners[k] // 3]
    changed[v] = flipped
    if flipped > 0:
        times = halvings[v] + 1
        halvings[v] = times
        if times >= limit:
            moved[v] = old[v]
        else:
            part = wp.pow(wp.float64(0.5), wp.float64(times))
            moved[v] = wp.normalize(old[v] + part * (trial[v] - old[v]))
