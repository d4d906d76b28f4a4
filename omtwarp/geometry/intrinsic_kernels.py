"""Kernel of the intrinsic Delaunay triangulation: edges are flipped one after another, on one thread."""

from omtwarp.device.start import HALF, KERNEL_OPTIONS, TWO, ZERO, wp

wp.set_module_options(KERNEL_OPTIONS)

# An edge is Delaunay where the sine of the sum of its two opposite angles is above minus this: round-off flips nothing.
ROUND_OFF = wp.constant(wp.float64(1e-12))


@wp.func
def doubled_area(a: wp.float64, b: wp.float64, c: wp.float64) -> wp.float64:
    """Return twice the area of a triangle of these sides (Heron)."""
    product = (a + b + c) * (b + c - a) * (a - b + c) * (a + b - c)
    return HALF * wp.sqrt(wp.max(product, ZERO))


@wp.func
def is_delaunay(half: int, other: int, following: wp.array[wp.int32], lengths: wp.array[wp.float64]) -> bool:
    """Return whether the angles opposite to the edge of two half-edges add up to at most π."""
    edge = lengths[half]
    a, b = lengths[following[half]], lengths[following[following[half]]]
    c, d = lengths[following[other]], lengths[following[following[other]]]
    one, two = a * a + b * b - edge * edge, c * c + d * d - edge * edge
    sine = one * doubled_area(edge, c, d) + two * doubled_area(edge, a, b)
    return sine >= -ROUND_OFF * a * b * c * d


@wp.kernel
def flip_to_delaunay(
    twins: wp.array[wp.int32],
    most: int,
    # Data out:
    origins: wp.array[wp.int32],
    following: wp.array[wp.int32],
    lengths: wp.array[wp.float64],
    steps: wp.array[wp.vec2i],
    queue: wp.array[wp.int32],
    queued: wp.array[wp.int32],
    flips: wp.array[wp.int32],
):
    """Flip edges until each is Delaunay; ``queue`` holds one half-edge of every edge, and ``queued`` is 1 for them.

    A half-edge starts at its origin, has a length and a step (what the coordinates' whole parts grow by along it), and
    is followed by the next one of its triangle. A flipped edge keeps its two half-edges, so that twins stay twins.
    """
    size = int(queue.shape[0])
    count = int(0)
    while size > 0 and count < most:
        size -= 1
        h = queue[size]
        t = twins[h]
        queued[wp.min(h, t)] = 0
        if not is_delaunay(h, t, following, lengths):
            # One assignment each: of several at once, Warp reads the array where the name is used, after the writes.
            h1 = following[h]
            t1 = following[t]
            h2 = following[h1]
            t2 = following[t1]
            edge = lengths[h]
            # The edge on the x axis from 0; one apex above, the other below.
            above = (lengths[h2] * lengths[h2] + edge * edge - lengths[h1] * lengths[h1]) / (TWO * edge)
            below = (lengths[t1] * lengths[t1] + edge * edge - lengths[t2] * lengths[t2]) / (TWO * edge)
            apart = doubled_area(edge, lengths[h1], lengths[h2]) + doubled_area(edge, lengths[t1], lengths[t2])
            length = wp.length(wp.vec2d(above - below, apart / edge))
            origins[h] = origins[t2]
            origins[t] = origins[h2]
            steps[h] = steps[t2] + steps[h1]
            steps[t] = -steps[h]
            lengths[h] = length
            lengths[t] = length
            following[h] = h2
            following[h2] = t1
            following[t1] = h
            following[t] = t2
            following[t2] = h1
            following[h1] = t
            count += 1
            for k in range(4):
                side = h1
                if k == 1:
                    side = h2
                elif k == 2:
                    side = t1
                elif k == 3:
                    side = t2
                key = wp.min(side, twins[side])
                if queued[key] == 0:
                    queued[key] = 1
                    queue[size] = key
                    size += 1
    flips[0] = count
