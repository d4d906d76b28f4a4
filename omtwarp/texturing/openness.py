# mypy: disable-error-code="no-untyped-def, no-any-return, untyped-decorator, misc"
"""Ambient occlusion by ray casting: the openness of the space in front of a surface."""

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.device.threads import launch_parts
from omtwarp.geometry.strips import in_strips

wp.set_module_options(KERNEL_OPTIONS)


# Radians, 1 / 1.3247 (the plastic number): turned by it, no two patterns are near.
TURN = wp.constant(wp.float32(0.7548777))


@wp.func
def open_share(mesh: wp.uint64, origin: wp.vec3, n: wp.vec3, turn: float, first: float, rays: int) -> float:
    """Return the share of cosine-weighted rays from a point that meet no surface.

    Their pattern is rotated, and begins at a share of the disc's area, of a ray, that ``first`` says.
    """
    helper = wp.vec3(1.0, 0.0, 0.0)
    # Of a normal's x: below 1/sqrt(2) the axis is 45 degrees or more from the normal.
    if wp.abs(n[0]) > wp.float32(0.7):
        helper = wp.vec3(0.0, 1.0, 0.0)
    t = wp.normalize(wp.cross(n, helper))
    b = wp.cross(n, t)
    free = int(0)
    for k in range(rays):
        # A spiral over the disc lifted to the hemisphere: cosine-weighted, and the same for every run.
        r = wp.sqrt((float(k) + first) / float(rays))
        # Golden angle, π (3 - sqrt(5)): Vogel's spiral covers a disc evenly
        angle = float(k) * wp.float32(2.3999632) + turn
        up = wp.sqrt(wp.max(1.0 - r * r, 0.0))
        direction = t * (r * wp.cos(angle)) + b * (r * wp.sin(angle)) + n * up
        if not wp.mesh_query_ray_anyhit(mesh, origin, direction, 4.0):
            free += 1
    return float(free) / float(rays)


@wp.kernel
def cast_open_rays(
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    numbers: wp.array[wp.int32],
    firsts: wp.array[wp.float32],
    rays: int,
    # Data out:
    openness: wp.array[wp.float32],
):
    """Compute the share of cosine-weighted rays from points that meet no surface; a number turns the point's rays."""
    i, _compiled_once = wp.tid()
    # Turns, a prime: so many are told apart, and float32 still resolves each to 1e-4
    turn = float(numbers[i] % 1021) * TURN
    openness[i] = open_share(mesh, origins[i], normals[i], turn, firsts[i], rays)


MOST_STRIPS = 100_000  # that slivers are cut in: a tree of them takes a tenth of a second


def face_openness(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the openness of every face, 0 (enclosed) to 1 (open in all directions), shape [F].

    Large meshes are sampled: a face without a sample takes the value of the face before it.
    """
    rays = 24  # from a vertex: openness in steps of 4 %
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    x = (vertices - low) / (high - low).max()
    p = x[faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal /= np.where(length > 0, length, 1.0)
    # Ray budget: about half a second on one CPU core
    step = max(1, int(np.ceil(len(faces) * rays / 400_000)))
    chosen = np.arange(0, len(faces), step)
    # Ray start, of the extent, off the surface: single precision resolves 1e-7 of it
    origins = p[chosen].mean(axis=1) + 1e-4 * normal[chosen]
    numbers, middle = np.arange(len(chosen)), np.full(len(chosen), 0.5)
    shares = open_shares(x, faces, origins, normal[chosen], numbers, middle, rays, wp.get_device("cpu"))
    return np.repeat(shares, step)[: len(faces)]


def open_shares(
    vertices: NDArray[np.float64],
    faces: NDArray[np.int32],
    origins: NDArray[np.float64],
    normals: NDArray[np.float64],
    numbers: NDArray[np.integer],
    firsts: NDArray[np.floating],
    rays: int,
    where: wp.Device,
) -> NDArray[np.float64]:
    """Return the shares of cosine-weighted rays from points that meet no triangle, shape [N].

    Args:
        vertices, faces: the surface, of an extent near 1.
        origins: shape [N, 3], off the surface.
        normals: the middles of the rays, unit vectors, shape [N, 3].
        numbers: by which the points' rays are turned against each other, shape [N].
        firsts: where they begin, from 0 to 1 of the share of the disc that belongs to a ray, shape [N].
        rays: from each point.
        where: the device.
    """
    corners = without_slivers(vertices[faces]).reshape(-1, 3)
    mesh = wp.Mesh(
        points=wp.array(corners.astype(np.float32), dtype=wp.vec3, device=where),
        indices=wp.array(np.arange(len(corners)), dtype=wp.int32, device=where),
    )
    start = wp.array(origins.astype(np.float32), dtype=wp.vec3, device=where)
    ways = wp.array(normals.astype(np.float32), dtype=wp.vec3, device=where)
    which = wp.array(numbers.astype(np.int32), dtype=wp.int32, device=where)
    begin = wp.array(firsts.astype(np.float32), dtype=wp.float32, device=where)
    out = wp.zeros(len(origins), dtype=wp.float32, device=where)
    launch_parts(
        cast_open_rays,
        len(origins),
        lambda part: ([mesh.id, start[part], ways[part], which[part], begin[part], rays], [out[part]]),
        where,
    )
    return out.numpy().astype(np.float64)


def without_slivers(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cut triangles that are much longer than wide in strips: their boxes would overlap, and every ray would meet many.

    Args:
        corners: shape [F, 3, 3].

    Returns:
        The corners of the parts, shape [P, 3, 3]; P is at most F + 2 :data:`MOST_STRIPS`.
    """
    edges = np.roll(corners, -1, axis=1) - corners
    lengths = np.linalg.norm(edges, axis=2)
    longest = lengths.max(axis=1)
    width = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / np.maximum(longest, np.finfo(float).tiny)
    # A strip is four times as long as wide at most, or as long as the number of strips allows
    step = np.maximum(4.0 * width, longest.sum() / MOST_STRIPS)
    counts = 1 + np.floor(longest / np.maximum(step, np.finfo(float).tiny)).astype(np.int64)
    return in_strips(corners, lengths.argmin(axis=1), counts, lambda strip, of: strip / counts[of])[1]
