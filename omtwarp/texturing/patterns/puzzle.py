# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
"""A jigsaw puzzle on the sphere."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, ONE, PI, ZERO, wp
from omtwarp.mesh.arrays import Floats, normalised, whole_number
from omtwarp.texturing.atlas import CUBE_FRAMES
from omtwarp.texturing.kernels import cube_face, cube_frame
from omtwarp.texturing.patterns import Pattern, colour_groups, srgb_colours

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def smooth_union(a: wp.float64, b: wp.float64, k: wp.float64):
    """Return the distance to a union of two shapes with the corner between them rounded (polynomial smooth minimum)."""
    h = wp.max(k - wp.abs(a - b), ZERO) / k
    return wp.min(a, b) - h * h * k * wp.float64(0.25)


@wp.func
def jigsaw_edge(s: wp.float64, t: wp.float64):
    """Return the signed distance to a jigsaw edge: negative on the side of the piece that has the tab.

    The edge runs along t = 0 for s in 0..1, the tab reaches into t > 0; lengths are in sides of a piece.
    """
    x = s - HALF
    body = t
    neck = wp.max(wp.abs(x) - wp.float64(0.055), t - wp.float64(0.16))
    knob_x = x / wp.float64(1.16)  # a little wider than high
    knob_t = t - wp.float64(0.185)
    knob = wp.sqrt(knob_x * knob_x + knob_t * knob_t) - wp.float64(0.105)
    return smooth_union(smooth_union(knob, neck, wp.float64(0.035)), body, wp.float64(0.05))


@wp.kernel
def puzzle_colours(
    directions: wp.array[wp.vec3d],
    side: int,
    neighbours: wp.array2d[wp.int32],
    tabs: wp.array2d[wp.int32],
    shifts: wp.array2d[wp.float64],
    colours: wp.array[wp.vec3d],
    line: wp.float64,
    line_colour: wp.vec3d,
    # Data out:
    out: wp.array2d[wp.float64],
    reach: wp.array[wp.float64],
):
    i, _compiled_once = wp.tid()
    d = directions[i]
    face = cube_face(d)
    local = cube_frame(face) * d
    # Equiangular coordinates: pieces of nearly the same size from the middle of a face of the cube to its corners.
    scale = wp.float64(side) * HALF
    x = (wp.atan2(local[1], local[0]) * wp.float64(4.0) / PI + ONE) * scale
    y = (wp.atan2(local[2], local[0]) * wp.float64(4.0) / PI + ONE) * scale
    column = wp.clamp(int(wp.floor(x)), 0, side - 1)
    row = wp.clamp(int(wp.floor(y)), 0, side - 1)
    x = x - wp.float64(column)
    y = y - wp.float64(row)
    piece = (face * side + row) * side + column
    owner = piece
    nearest = wp.float64(10.0)
    depths = wp.vec4d(y, ONE - x, ONE - y, x)  # into this piece from its bottom, right, top and left edge
    for edge in range(4):
        s = wp.where(edge % 2 == 0, x, y) + shifts[piece, edge]
        # This piece's tab reaches over the edge, to negative depths; its neighbour's into it
        sign = wp.where(tabs[piece, edge] > 0, -ONE, ONE)
        distance = sign * jigsaw_edge(s, sign * depths[edge])
        if distance < ZERO:
            owner = neighbours[piece, edge]
        nearest = wp.min(nearest, wp.abs(distance))
    colour = colours[owner]
    # A soft edge of light and dark makes the pieces look cut out.
    bevel = wp.float64(0.045)
    if nearest < line + bevel:
        colour = colour * (wp.float64(0.86) + wp.float64(0.14) * (nearest - line) / bevel)
    if nearest < line:
        colour = line_colour
    for c in range(3):
        out[i, c] = colour[c]
    # Edges of other pieces are no nearer than half a tab; a piece's side is an angle of this, and the cube's faces
    # shrink no length to less than half of it.
    apart = wp.min(wp.abs(nearest - line), wp.abs(nearest - line - bevel))
    reach[i] = wp.min(apart, wp.float64(0.1)) * HALF * HALF * PI / wp.float64(side)


class Puzzle(Pattern):
    """A jigsaw puzzle: six faces of a cube blown up to the sphere, ``side`` by ``side`` pieces each.

    Args:
        side: pieces along the side of a face of the cube; 6 side² pieces in all.
        seed: which pieces have their tabs on which side.
    """

    name = "puzzle"
    title = "A jigsaw puzzle"
    _kernel = puzzle_colours

    def __init__(self, side: int = 5, seed: int = 7):
        self.side = whole_number(side, "puzzle: pieces along a side", least=1, most=64)
        self.seed = whole_number(seed, "puzzle: seed")
        self.palette = srgb_colours("#4f8fa8", "#e9c46a", "#e08e6d", "#86b08a", "#c9ada7", "#f1e3c6")
        self.line_colour = srgb_colours("#2b2f3a")[0]

    @property
    def count(self) -> int:
        """The number of pieces."""
        return 6 * self.side**2

    def _points(self, face: NDArray, x: NDArray, y: NDArray) -> Floats:
        """Return the directions of points of faces, in pieces from the lower left corner."""
        slope = np.tan((np.stack([x, y], axis=-1) / self.side * 2.0 - 1.0) * np.pi / 4.0)
        local = np.concatenate([np.ones_like(slope[..., :1]), slope], axis=-1)
        return normalised(np.einsum("...i,...ij->...j", local, CUBE_FRAMES[face]))

    @cached_property
    def _edges(self) -> tuple[NDArray, NDArray, Floats]:
        """Return, for every side of every piece, its neighbour, tab (1 own, 0 the neighbour's) and tab's shift."""
        n = self.side
        piece = np.arange(self.count)
        face, row, column = piece // n**2, piece // n % n, piece % n

        def on_edge(s: float) -> Floats:
            """Return the points at s on the bottom, right, top and left side, in the kernel's order, [P, 4, 3]."""
            places = [(s, 0.0), (1.0, s), (s, 1.0), (0.0, s)]
            return np.stack([self._points(face, column + x, row + y) for x, y in places], axis=1)

        from scipy.spatial import cKDTree

        middle = on_edge(0.5).reshape(-1, 3)
        _, partner = cKDTree(middle).query(middle, k=2)
        own = np.arange(len(middle))
        other = np.where(partner[:, 0] == own, partner[:, 1], partner[:, 0])
        rng = np.random.default_rng(self.seed)
        first = np.minimum(own, other)
        tab = (rng.integers(0, 2, len(own))[first] ^ (own > other)).astype(np.int32)
        # The two pieces may run along their common side in opposite ways.
        quarter = on_edge(0.25).reshape(-1, 3)
        # Same place, chord: places on the two sides of an edge are the same, or a quarter of a side apart
        same_way = np.linalg.norm(quarter - quarter[other], axis=1) < 1e-6
        shift = rng.uniform(-0.07, 0.07, len(own))[first]
        shift = np.where((own > other) & ~same_way, -shift, shift)
        return (other // 4).reshape(-1, 4).astype(np.int32), tab.reshape(-1, 4), shift.reshape(-1, 4)

    def _tables(self) -> list[object]:
        neighbours, tabs, shifts = self._edges
        pairs = np.stack([np.repeat(np.arange(self.count), 4), neighbours.ravel()], axis=1)
        colours = self.palette[colour_groups(pairs, len(self.palette))]
        tables = [(neighbours, wp.int32), (tabs, wp.int32), (shifts, wp.float64), (colours, wp.vec3d)]
        return [self.side, *tables, wp.float64(0.016), wp.vec3d(*self.line_colour)]


__all__ = ["Puzzle"]
