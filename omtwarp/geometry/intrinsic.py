"""The intrinsic Delaunay triangulation of a surface: its cotangent weights are never negative.

Edges are geodesics inside the surface, known by their lengths alone; an edge whose opposite angles add up to more than
π is flipped inside its two triangles, laid flat. The surface does not change. Of all its triangulations with
these vertices this one gives functions that are linear on triangles the least Dirichlet energy [1]_.

.. [1] A. Bobenko, B. Springborn, "A discrete Laplace-Beltrami operator for simplicial surfaces", Discrete and
   Computational Geometry 38 (2007).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.arrays import sent
from omtwarp.device.start import HALF, KERNEL_OPTIONS, TWO, ZERO, wp
from omtwarp.mesh.arrays import Floats, Ints, edge_keys, marked, norms
from omtwarp.mesh.surface import Surface

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
            sides = wp.vec4i(h1, h2, t1, t2)
            for k in range(4):
                side = sides[k]
                key = wp.min(side, twins[side])
                if queued[key] == 0:
                    queued[key] = 1
                    queue[size] = key
                    size += 1
    flips[0] = count


@dataclass(frozen=True)
class WeightedEdges:
    """Edges of a triangulation with their cotangent weights.

    Attributes:
        ends: the vertices, shape [E, 2]; an edge may join a vertex to itself, and two edges the same vertices.
        weights: half the sum of the cotangents of the opposite angles, shape [E].
        steps: what the whole parts of coordinates grow by from the first end to the second, shape [E, 2].
        flips: how many edges were flipped.
    """

    ends: NDArray[np.int64]
    weights: Floats
    steps: NDArray[np.int64]
    flips: int


def delaunay_edges(surface: Surface, jumps: NDArray[np.int64] | None = None) -> WeightedEdges:
    """Return the edges of the intrinsic Delaunay triangulation.

    Args:
        surface: closed; F faces.
        jumps: of coordinates that are no functions on the surface, whole numbers at corners, shape [F, 3, 2]; their
            differences along an edge agree on both of its sides. Zero if left out.
    """
    least, most = 1e-9, 1e6  # of cotangents; those of triangles without area are not finite
    jumps = np.zeros((surface.face_count, 3, 2), dtype=np.int64) if jumps is None else jumps
    faces, count = surface.faces, 3 * surface.face_count
    opposite = surface.edge_corners.astype(np.int64)
    # The half-edge that starts at a corner is the side opposite to the corner before.
    halves = 3 * (opposite // 3) + (opposite + 1) % 3
    twins = np.empty(count, dtype=np.int32)
    twins[halves[:, 0]], twins[halves[:, 1]] = halves[:, 1], halves[:, 0]
    first = halves.min(axis=1).astype(np.int32)
    points = surface.scaled_vertices
    sides = norms(points.take(np.roll(faces, -1, axis=1), axis=0) - points.take(faces, axis=0)).ravel()
    sides = np.maximum(sides, np.finfo(float).eps * sides.max())
    corner = np.arange(count)
    queued, origins = sent(marked(count, first).astype(np.int32), wp.int32), sent(faces.flatten(), wp.int32)
    following = sent((3 * (corner // 3) + (corner + 1) % 3).astype(np.int32), wp.int32)
    lengths = sent(sides, wp.float64)
    steps = sent((np.roll(jumps, -1, axis=1) - jumps).reshape(-1, 2).astype(np.int32), wp.vec2i)
    flips = wp.zeros(1, dtype=wp.int32, device="cpu")
    # Flips per edge: most flips; scans need 0.1 to 1 an edge
    inputs = [sent(twins, wp.int32), 50 * len(first)]
    outputs = [origins, following, lengths, steps, sent(first.copy(), wp.int32), queued, flips]
    wp.launch(flip_to_delaunay, dim=1, inputs=inputs, outputs=outputs, device="cpu")
    own, after, long = origins.numpy(), following.numpy(), lengths.numpy()
    cotangents = _opposite_cotangents(long, long[after], long[after[after]])
    return WeightedEdges(
        ends=np.stack([own[first], own[twins[first]]], axis=1).astype(np.int64),
        weights=0.5 * np.clip(cotangents[first] + cotangents[twins[first]], least, most),
        steps=steps.numpy()[first].astype(np.int64),
        flips=int(flips.numpy()[0]),
    )


def intrinsic_edges(surface: Surface) -> tuple[Ints, Floats]:
    """Return the pairs of vertices that intrinsic Delaunay edges join, and their weights; the surface keeps them.

    Edges that join the same two vertices are one pair, whose weight is their sum; one from a vertex to itself is none.

    Returns:
        The pairs (i, j), i < j, in order, shape [E, 2], and the weights, shape [E].
    """

    def pairs() -> tuple[Ints, Floats]:
        edges, count = delaunay_edges(surface), surface.vertex_count
        apart = edges.ends[:, 0] != edges.ends[:, 1]
        keys, place = np.unique(edge_keys(edges.ends[apart], count), return_inverse=True)
        weights = np.bincount(place, edges.weights[apart]).astype(np.float64)
        return np.stack([keys // count, keys % count], axis=1).astype(np.int32), weights

    return surface.cached("intrinsic Delaunay edges", pairs)


def _opposite_cotangents(side: Floats, one: Floats, other: Floats) -> Floats:
    """Return the cotangent of the angle opposite to a side, from the lengths of the three sides."""
    product = (side + one + other) * (one + other - side) * (side - one + other) * (side + one - other)
    doubled = 0.5 * np.sqrt(np.maximum(product, np.finfo(float).eps ** 2 * (side * side + one * one) ** 2))
    return (one * one + other * other - side * side) / (2.0 * doubled)
