# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
"""Circles of one size, spread evenly over the sphere."""

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import HALF, KERNEL_OPTIONS, wp
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import TINY, Floats, direction_from_angles, normalised
from omtwarp.mesh.shapes import icosphere
from omtwarp.texturing.kernels import cube_face
from omtwarp.texturing.patterns import Pattern, colour_groups, srgb_colours

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def circle_colours(
    directions: wp.array[wp.vec3d],
    side: int,
    offsets: wp.array[wp.int32],
    candidates: wp.array[wp.int32],
    centres: wp.array[wp.vec3d],
    inner: wp.array[wp.vec3d],
    rim: wp.array[wp.vec3d],
    outer: wp.float64,
    rim_starts: wp.float64,
    beyond: wp.float64,
    background: wp.vec3d,
    # Data out:
    out: wp.array2d[wp.float64],
    reach: wp.array[wp.float64],
):
    i, _compiled_once = wp.tid()
    d = wp.normalize(directions[i])
    # Only circles that reach this cell of the faces of a cube are looked at.
    face = cube_face(d)
    axis = wp.where(face > 3, 2, face % 2)
    scale = HALF * wp.float64(side) / wp.abs(d[axis])
    column = wp.clamp(int((d[(axis + 1) % 3]) * scale + HALF * wp.float64(side)), 0, side - 1)
    row = wp.clamp(int((d[(axis + 2) % 3]) * scale + HALF * wp.float64(side)), 0, side - 1)
    cell = (face * side + row) * side + column
    colour = background
    near = beyond
    for k in range(offsets[cell], offsets[cell + 1]):
        centre = candidates[k]
        chord = wp.length_sq(d - centres[centre])  # squared, as the two limits are
        if chord <= outer:
            colour = inner[centre]
            if chord > rim_starts:
                colour = rim[centre]
        distance = wp.sqrt(chord)  # and a chord is shorter than its arc
        near = wp.min(near, wp.min(wp.abs(distance - wp.sqrt(outer)), wp.abs(distance - wp.sqrt(rim_starts))))
    for c in range(3):
        out[i, c] = colour[c]
    reach[i] = near


class Circles(Pattern):
    """Circles (spherical caps) of one size, spread evenly: every one covers the same area of the sphere.

    The centres start from the vertices of a geodesic icosahedron where ``count`` is 10 f² + 2 and from a Fibonacci
    spiral otherwise, and repel each other until they are even.

    Args:
        count: how many.
        coverage: part of the sphere that they cover together.

    Attributes:
        centres: unit vectors, shape [count, 3].
        radius: angle in radians; a circle's area is 2π (1 - cos radius).
        groups: which of the palette's colours each one has, shape [count].
    """

    name = "circles"
    title = "Circles of equal size"
    _kernel = circle_colours

    def __init__(self, count: int = 162, coverage: float = 0.56):
        from scipy.spatial import ConvexHull

        # Most circles: whose repulsion takes 6.5 s
        if not 4 <= count <= 20_000 or not 0 < coverage < 1:
            raise OmtwarpError(f"circles: count {count}, coverage {coverage}: give 4 to 20000 circles, a share below 1")
        self.count = int(count)
        self.palette = srgb_colours("#1f6f78", "#e2725b", "#f0b95b", "#5b8e7d", "#35507a", "#b5838d")
        self.background = srgb_colours("#f6f1e7")[0]
        self.centres = _even_points(self.count)
        triangles = ConvexHull(self.centres).simplices
        self.groups = colour_groups(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), len(self.palette))
        self.radius = float(np.arccos(1.0 - 2.0 * coverage / self.count))
        _, gap = _neighbours(self.centres, 1)
        if 2.0 * self.radius >= gap.min():
            most = 0.5 * self.count * (1.0 - np.cos(gap.min() / 2.0))
            raise OmtwarpError(f"circles: {self.count} over {coverage:.2f} of the sphere touch: at most {most:.2f}")

    def _tables(self) -> list[object]:
        within = 1e-9  # chord that is added to a circle's reach, so that rounding leaves no cell's list without it
        # Cell: side, in radii of circles, of the cells of a cube on which circles are looked up
        # Most cells: along the side of a face of that cube
        side = int(np.clip(2.0 / max(0.7 * self.radius, TINY), 1, 128))
        middle = (np.arange(side) + 0.5) * 2.0 / side - 1.0
        cells = np.empty((6, side, side, 3))  # of the faces +x, +y, -x, -y, +z, -z of a cube
        for face, (axis, sign) in enumerate(((0, 1.0), (1, 1.0), (0, -1.0), (1, -1.0), (2, 1.0), (2, -1.0))):
            cells[face, :, :, axis] = sign
            cells[face, :, :, (axis + 1) % 3] = middle[None, :]
            cells[face, :, :, (axis + 2) % 3] = middle[:, None]
        half = np.sqrt(2.0) / side  # no cell reaches farther than this from its middle
        beyond = 0.5 * half  # and of circles outside of a cell's list no edge is nearer to it than this
        from scipy.spatial import cKDTree

        chord = 2.0 * np.sin(min(self.radius + half + beyond, np.pi) / 2.0) + within
        tree = cKDTree(self.centres)
        lists = tree.query_ball_point(normalised(cells.reshape(-1, 3)), chord, return_sorted=True)
        offsets = np.concatenate([[0], np.cumsum([len(x) for x in lists])]).astype(np.int32)
        members = np.concatenate([np.asarray(x, dtype=np.int32) for x in lists] + [np.zeros(1, dtype=np.int32)])
        inner = self.palette[self.groups]
        vectors = [(rows, wp.vec3d) for rows in (self.centres, inner, inner * 0.8)]
        limits = 4.0 * np.sin(0.5 * self.radius) ** 2, 4.0 * np.sin(0.455 * self.radius) ** 2, beyond
        numbers = [*map(wp.float64, limits), wp.vec3d(*self.background)]
        return [side, (offsets, wp.int32), (members, wp.int32), *vectors, *numbers]


def _even_points(count: int) -> Floats:
    """Spread points evenly over the sphere, shape [count, 3]; they are the same every time."""
    frequency = round(((count - 2) / 10.0) ** 0.5)
    if count > 12 and 10 * frequency**2 + 2 == count:
        points = icosphere(frequency).vertices
    else:
        k = np.arange(count) + 0.5
        points = direction_from_angles(k * np.pi * (3.0 - 5.0**0.5), np.arcsin(1.0 - 2.0 * k / count))
    # Repulsion by the inverse fourth power of the distance to the nearest few: the closest pair moves apart first.
    spacing = (4.0 * np.pi / count) ** 0.5
    # Repulsions, rounds: with 30 to 240 the nearest two of 150 points are 0.272 to 0.277 apart
    for _ in range(120):
        near, _ = _neighbours(points, min(7, count - 1))
        apart = points[:, None, :] - points[near]
        distance = np.linalg.norm(apart, axis=2, keepdims=True)
        push = (apart / distance * (spacing / distance) ** 4).sum(axis=1)
        push -= np.einsum("ij,ij->i", push, points)[:, None] * points
        points = normalised(points + 0.02 * spacing * push)
    return points


def _neighbours(points: Floats, count: int) -> tuple[NDArray, Floats]:
    """Return the nearest other points of each, nearest first, [N, count], and the angle to the first, shape [N]."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree(points).query(points, k=count + 1)
    return index[:, 1:], 2.0 * np.arcsin(np.minimum(distance[:, 1] / 2.0, 1.0))


__all__ = ["Circles"]
