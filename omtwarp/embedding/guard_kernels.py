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
    everywhere: int,
    changed: wp.array[wp.int32],
    # Data out:
    flags: wp.array[wp.int32],
    count: wp.array[wp.int32],
):
    """Triangles that a step flips, or shrinks below their floor; one that is below it already may grow.

    Unless ``everywhere``, only where a corner has changed since the last time: a triangle that was bad has had all of
    them changed.
    """
    f = wp.tid()
    face = faces[f]
    touched = int(everywhere)
    if touched == 0:
        touched = changed[face[0]] + changed[face[1]] + changed[face[2]]
    if touched > 0:
        after = wp.dot(end[face[0]], wp.cross(end[face[1]], end[face[2]]))
        bad = int(1)
        if after > ZERO:
            if after >= floors[f]:
                bad = int(0)
            elif after >= wp.dot(start[face[0]], wp.cross(start[face[1]], start[face[2]])):
                bad = int(0)
        flags[f] = bad
        if bad == 1:
            wp.atomic_add(count, 0, 1)


@wp.kernel
def end_round(
    most: int,
    # Data in and out:
    count: wp.array[wp.int32],
    rounds: wp.array[wp.int32],
    # Data out:
    again: wp.array[wp.int32],
):
    """Go on while there are bad triangles; in the round after the last one all vertices go back."""
    again[0] = 0
    if count[0] > 0 and rounds[0] <= most:
        again[0] = 1
        rounds[0] = rounds[0] + 1
    count[0] = 0


@wp.kernel
def shorten_steps(
    old: wp.array[wp.vec3d],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    flags: wp.array[wp.int32],
    limit: int,
    rounds: wp.array[wp.int32],
    most: int,
    # Data in and out:
    halvings: wp.array[wp.int32],
    wanted: wp.array[wp.vec3d],
    moved: wp.array[wp.vec3d],
    held: wp.array[wp.int32],
    # Data out:
    changed: wp.array[wp.int32],
):
    """Halve the steps of bad triangles' corners; ``wanted`` keeps where those were going in the first place."""
    v = wp.tid()
    flipped = int(0)
    for k in range(offsets[v], offsets[v + 1]):
        flipped += flags[corners[k] // 3]
    times = int(limit)
    if rounds[0] > most:
        flipped = 1
    else:
        times = halvings[v] + 1
    changed[v] = flipped
    if flipped > 0:
        if halvings[v] == 0:
            wanted[v] = moved[v]
            wp.atomic_add(held, 0, 1)
        halvings[v] = times
        if times >= limit:
            moved[v] = old[v]
        else:
            part = wp.pow(wp.float64(0.5), wp.float64(times))
            moved[v] = wp.normalize(old[v] + part * (wanted[v] - old[v]))
