"""Kernels that find flipped triangles and shorten the steps of their vertices.

The first round examines all triangles, later rounds only those around vertices that have just been changed. Lists of
these are filled by counting upwards, in an order that differs from run to run; no result depends on it.
"""

from enum import IntEnum

from omtwarp.device.start import KERNEL_OPTIONS, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)

UNCERTAIN = wp.constant(2)  # instead of a sign


class Count(IntEnum):
    """Places of the counters.

    Triangles to be corrected in this round and the next, vertices changed, rounds begun, vertices held back in all.
    """

    BAD = 0
    NEXT = 1
    CHANGED = 2
    ROUND = 3
    HELD = 4


@wp.kernel
def count_nonpositive(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    # Data out:
    count: wp.array[wp.int32],
):
    """Count triangles with det[s0, s1, s2] <= 0 in floating point, which may be wrong for one that is nearly flat."""
    face = faces[wp.tid()]
    if not wp.dot(points[face[0]], wp.cross(points[face[1]], points[face[2]])) > ZERO:
        wp.atomic_add(count, 0, 1)


@wp.kernel
def certain_signs(
    points: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    relative: wp.float64,
    underflow: wp.float64,
    # Data out:
    signs: wp.array[wp.int8],
):
    """Compute the signs of det[a, b, c] that rounding cannot have changed, and UNCERTAIN for the others."""
    f = wp.tid()
    a, b, c = points[faces[f][0]], points[faces[f][1]], points[faces[f][2]]
    value = wp.dot(a, wp.cross(b, c))
    magnitude = wp.abs(a[0]) * (wp.abs(b[1] * c[2]) + wp.abs(b[2] * c[1]))
    magnitude += wp.abs(a[1]) * (wp.abs(b[2] * c[0]) + wp.abs(b[0] * c[2]))
    magnitude += wp.abs(a[2]) * (wp.abs(b[0] * c[1]) + wp.abs(b[1] * c[0]))
    signs[f] = wp.int8(UNCERTAIN)
    if wp.isfinite(value) and wp.abs(value) > relative * magnitude + underflow:
        signs[f] = wp.where(value > ZERO, wp.int8(1), wp.int8(-1))


@wp.func
def is_bad(before: wp.array[wp.vec3d], after: wp.array[wp.vec3d], face: wp.vec3i, floor: wp.float64):
    """Return whether a step flips a triangle, or shrinks it below its floor; one that is below it already may grow."""
    size = wp.dot(after[face[0]], wp.cross(after[face[1]], after[face[2]]))
    bad = bool(True)
    if size > ZERO:
        if size >= floor:
            bad = bool(False)
        elif size >= wp.dot(before[face[0]], wp.cross(before[face[1]], before[face[2]])):
            bad = bool(False)
    return bad


@wp.kernel
def find_bad(
    before: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    floors: wp.array[wp.float64],
    # Data in and out:
    counters: wp.array[wp.int32],
    # Data out:
    bad: wp.array2d[wp.int32],
):
    f = wp.tid()
    if is_bad(before, after, faces[f], floors[f]):
        bad[0, wp.atomic_add(counters, Count.NEXT, 1)] = f


@wp.kernel
def end_round(
    most: int,
    # Data in and out:
    counters: wp.array[wp.int32],
    # Data out:
    again: wp.array[wp.int32],
):
    """Go on while there are bad triangles; in the round after the last one all vertices go back."""
    again[0] = 0
    if counters[Count.NEXT] > 0 and counters[Count.ROUND] <= most:
        again[0] = 1
        counters[Count.ROUND] = counters[Count.ROUND] + 1
    counters[Count.BAD] = counters[Count.NEXT]
    counters[Count.NEXT] = 0
    counters[Count.CHANGED] = 0


@wp.kernel
def shorten_steps(
    before: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    bad: wp.array2d[wp.int32],
    limit: int,
    most: int,
    threads: int,
    # Data in and out:
    counters: wp.array[wp.int32],
    vertex_rounds: wp.array[wp.int32],
    halvings: wp.array[wp.int32],
    wanted: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    # Data out:
    changed: wp.array[wp.int32],
):
    """Halve the steps of bad triangles' corners, once each; ``wanted`` keeps where those were going at first."""
    thread, _compiled_once = wp.tid()
    this = counters[Count.ROUND]
    if this > most:
        for v in range(thread, before.shape[0], threads):
            if halvings[v] == 0:
                wp.atomic_add(counters, Count.HELD, 1)
            after[v] = before[v]
    else:
        for k in range(thread, counters[Count.BAD], threads):
            face = faces[bad[(this - 1) % 2, k]]
            for corner in range(3):
                v = face[corner]
                if wp.atomic_max(vertex_rounds, v, this) < this:
                    times = halvings[v] + 1
                    halvings[v] = times
                    if times == 1:
                        wanted[v] = after[v]
                        wp.atomic_add(counters, Count.HELD, 1)
                    if times >= limit:
                        after[v] = before[v]
                    else:
                        part = wp.pow(wp.float64(0.5), wp.float64(times))
                        after[v] = wp.normalize(before[v] + part * (wanted[v] - before[v]))
                    changed[wp.atomic_add(counters, Count.CHANGED, 1)] = v


@wp.kernel
def find_bad_around(
    before: wp.array[wp.vec3d],
    after: wp.array[wp.vec3d],
    faces: wp.array[wp.vec3i],
    floors: wp.array[wp.float64],
    offsets: wp.array[wp.int32],
    corners: wp.array[wp.int32],
    changed: wp.array[wp.int32],
    threads: int,
    # Data in and out:
    counters: wp.array[wp.int32],
    face_rounds: wp.array[wp.int32],
    # Data out:
    bad: wp.array2d[wp.int32],
):
    this = counters[Count.ROUND]
    for k in range(wp.tid(), counters[Count.CHANGED], threads):
        v = changed[k]
        for n in range(offsets[v], offsets[v + 1]):
            f = corners[n] // 3
            if wp.atomic_max(face_rounds, f, this) < this:
                if is_bad(before, after, faces[f], floors[f]):
                    bad[this % 2, wp.atomic_add(counters, Count.NEXT, 1)] = f
