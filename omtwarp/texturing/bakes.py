"""Quantities of a surface as pictures: ambient occlusion, normals, curvature, area, and data of files.

And the openness of the space in front of a surface by ray casting, along which seams are hidden.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from omtwarp.colors import colormap_table
from omtwarp.device.arrays import sent
from omtwarp.device.start import KERNEL_OPTIONS, wp
from omtwarp.device.threads import each, launch_parts
from omtwarp.errors import OmtwarpError
from omtwarp.geometry.operators import corner_cotangents, cotangent_laplacian
from omtwarp.geometry.space_order import in_strips
from omtwarp.mesh.arrays import TINY, Bytes, Floats, Ints, normalised
from omtwarp.mesh.data import LabelTable, read_data
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.surface import plane_areas, sums_around, triangle_areas, vertex_normals
from omtwarp.texturing import kernels
from omtwarp.texturing.baking import PADDING, bake_corners, covered

wp.set_module_options(KERNEL_OPTIONS)

BAKES = ("normal", "ao", "curvature", "area")
MOST_RAYS = 2_100_000  # of one picture of ambient occlusion; a core casts about a million in a second


@dataclass(frozen=True)
class Target:
    """A surface, and its triangles on a picture.

    Attributes:
        vertices, faces: the surface, shapes [V, 3] and [F, 3].
        uv: coordinates of the corners, shape [T, 3, 2].
        face: triangle of the surface that each is, or is a part of, shape [T].
        weights: the corners as combinations of that triangle's corners, shape [T, 3, 3]; None where they are the same.
        size: width and height of the picture in texels.
        device: where to compute.
    """

    vertices: Floats
    faces: Ints
    uv: Floats
    face: NDArray
    weights: Floats | None
    size: tuple[int, int]
    device: wp.Device

    def spread(self, values: Floats) -> Floats:
        """Spread values at vertices, shape [V] or [V, C], to this target's corners, shape [T, 3, C]."""
        at = values.reshape(len(values), -1)[self.faces[self.face]]
        return at if self.weights is None else np.einsum("tij,tjc->tic", self.weights, at)

    @cached_property
    def points(self) -> Floats:
        """Positions of the corners, shape [T, 3, 3]."""
        return self.spread(self.vertices)

    @cached_property
    def normals(self) -> Floats:
        """Unit normals at the corners, shape [T, 3, 3]."""
        return normalised(self.spread(vertex_normals(self.vertices, self.faces)))


def occlusion(target: Target) -> Bytes:
    """Return the ambient occlusion: the cosine-weighted share of the rays from a point that meet no surface.

    Rays are cast from texels of a picture that is smaller by a power of two where there would be more than
    :data:`MOST_RAYS` in all. Neighbouring texels cast theirs between each other's, and share them.

    Returns:
        255 where no ray is blocked, uint8, shape [H, W, 3].
    """
    from scipy.ndimage import distance_transform_edt

    rays = 8  # from a texel, which takes part in those of its eight neighbours: 72 in all
    # Share of a ray by which patterns begin after those of the texel before: the plastic number's square below 1
    ahead = 0.5698403
    # Of the disc below the hemisphere: rays within 5 degrees of the surface, which meet the facets of a coarse ball
    flat = 1.0 / 128.0
    width, height = target.size
    texels = min(float(np.abs(plane_areas(target.uv)).sum()), 1.0) * width * height
    factor = 2 ** max(0, int(np.ceil(0.5 * np.log2(max(texels * rays / MOST_RAYS, TINY)))))
    size = (max(width // factor, 1), max(height // factor, 1))
    values = np.concatenate([target.points, target.normals], axis=2)
    picture = bake_corners(target.uv, values, size, padding=-1, samples=1, device=target.device)
    rows = picture.reshape(-1, 6).astype(np.float64)
    # Not from the padding: beyond their triangles, positions leave the surface.
    inside = covered(target.uv, size, padding=0, device=target.device)
    known = np.flatnonzero(inside.ravel())
    low, high = target.vertices.min(axis=0), target.vertices.max(axis=0)
    scale = float((high - low).max())
    normal = normalised(rows[known, 3:])
    # Of the extent: how far off the surface rays begin. Single precision resolves 1e-7 of it.
    origins = (rows[known, :3] - low) / scale + 1e-4 * normal
    x, begin = (target.vertices - low) / scale, (1.0 - rays * flat) * (ahead * known % 1.0)
    normals, open_part = np.zeros((len(rows), 3)), np.zeros(len(rows))
    normals[known] = normal
    open_part[known] = open_shares(x[target.faces], origins, normal, known, begin, rays, target.device)
    shared = _among_neighbours(open_part.reshape(inside.shape), normals.reshape(*inside.shape, 3))
    grey = np.rint(255.0 * shared).astype(np.uint8)
    if len(known):
        row, column = distance_transform_edt(~inside, return_distances=False, return_indices=True)
        grey = grey[row, column]
    return np.repeat(grey[..., None], 3, axis=2)


def _among_neighbours(values: Floats, normals: Floats) -> Floats:
    """Return the mean of each texel's value and those of its neighbours with about the same normal, shape [H, W].

    Args:
        values: shape [H, W].
        normals: unit vectors, shape [H, W, 3]; zero where a texel has no value.
    """
    height, width = values.shape
    around, about = np.pad(values, 1), np.pad(normals, ((1, 1), (1, 1), (0, 0)))
    total, count = np.zeros(values.shape), np.zeros(values.shape)
    for row, column in np.ndindex(3, 3):
        window = np.s_[row : row + height, column : column + width]
        # Cosine of 25 degrees: edges that are sharper stay so
        alike = np.einsum("hwc,hwc->hw", normals, about[window]) > 0.9
        total += np.where(alike, around[window], 0.0)
        count += alike
    return total / np.maximum(count, 1.0)


def detail_normals(target: Target, tangents: Floats, detail: tuple[Floats, Ints]) -> Bytes:
    """Bake the normals of a detailed surface in the frames of a coarser one, as glTF's ``normalTexture`` holds them.

    Each texel takes the normal at the nearest point of the detailed surface.

    Args:
        target: the coarser surface.
        tangents: at its corners, shape [T, 3, 4], as :func:`omtwarp.texturing.export.corner_tangents` gives them.
        detail: vertices and faces of the detailed surface, in the same place.

    Returns:
        uint8, shape [H, W, 3].
    """
    fine, triangles = detail
    low, high = fine.min(axis=0), fine.max(axis=0)
    scale = float((high - low).max())
    values = np.concatenate([(target.points - low) / scale, target.normals, tangents], axis=2)
    picture = bake_corners(target.uv, values, target.size, samples=1, device=target.device)
    known = np.flatnonzero(covered(target.uv, target.size, device=target.device).ravel())
    rows = picture.reshape(-1, 10)[known].astype(np.float64)
    where = target.device
    numbers = sent(triangles.astype(np.int32), wp.int32, where)
    mesh = wp.Mesh(sent(((fine - low) / scale).astype(np.float32), wp.vec3, where), numbers.flatten())
    normals = sent(vertex_normals(fine, triangles), wp.vec3d, where)
    kinds = ((slice(3), wp.vec3d), (slice(3, 6), wp.vec3d), (slice(6, 10), wp.vec4d))
    columns = [sent(rows[:, part], kind, where) for part, kind in kinds]
    out = wp.zeros(len(known), dtype=wp.vec3d, device=where)
    launch_parts(kernels.tangent_normals, len(known), [mesh.id, numbers, normals, *each(*columns)], each(out), where)
    local = np.tile((0.0, 0.0, 1.0), (target.size[0] * target.size[1], 1))
    local[known] = out.numpy()
    return _as_picture(local, target.size)


def object_normals(target: Target) -> Bytes:
    """Encode normals in the mesh's own axes as colours: red, green and blue are x, y and z from -1 to 1."""
    picture = bake_corners(target.uv, target.normals, target.size, device=target.device)
    return _as_picture(normalised(picture), target.size)


def _as_picture(vectors: NDArray[np.floating], size: tuple[int, int]) -> Bytes:
    """Encode unit vectors as bytes, where 0 is -1 and 255 is 1, as glTF decodes them."""
    return np.rint((np.clip(vectors, -1.0, 1.0) * 0.5 + 0.5) * 255.0).astype(np.uint8).reshape(size[1], size[0], 3)


def data_in(path: Path, count: int, origins: Origins | None, structure: str | None) -> tuple[Floats, LabelTable | None]:
    """Read the numbers at a surface's vertices from a file of data, NaN where there is none, shape [count].

    Labels come with their table, other data with None.

    Args:
        path: the file (see :mod:`omtwarp.mesh.data`).
        count: of the vertices.
        origins: what the vertices are in the input, whose data are taken too.
        structure: the part of the brain that the surface is, as GIFTI names it; None where that is not known.

    Raises:
        OmtwarpError: no file, or one that cannot be read, or with another number of vertices.
    """
    if not path.suffix:
        raise OmtwarpError(f"cannot bake '{path}': use {', '.join(BAKES)}, or a file of data at the vertices")
    data = read_data(path, structure)
    given = data.values[:, 0]
    given = given if origins is None or len(given) == count else origins.prolong(given)
    if len(given) != count:
        raise OmtwarpError(f"{path}: {len(given)} values for {count} vertices")
    values = given.astype(np.float64)
    bad = np.flatnonzero(np.isinf(values))
    if len(bad):
        raise OmtwarpError(f"{path}: {len(bad)} values are infinite, first vertex {bad[0]}")
    if np.isnan(values).all():
        raise OmtwarpError(f"{path}: no number in it")
    return values, data.table


def colored(values: Floats, colormap: str | LabelTable, low: float, high: float, target: Target) -> Bytes:
    """Return the picture of numbers at the vertices, uint8 sRGB, shape [H, W, 3]; grey where there is none.

    Args:
        values: shape [V].
        colormap: its name, or the table of labels, whose own colours are shown; those without opacity are grey.
        low, high: the values at its ends.
        target: the triangles on the picture.
    """
    if not isinstance(colormap, str):
        rgba = np.array([colormap.get(key, ("", (0.0,) * 4))[1] for key in values.tolist()])
        shown = target.spread(255.0 * np.where(rgba[:, 3:] > 0.0, rgba[:, :3], 0.5))
        return np.rint(bake_corners(target.uv, shown, target.size, device=target.device)).astype(np.uint8)
    missing = np.isnan(values)
    # Texels sum samples: the colours' ends are scaled to a size of 1, since sums of large numbers would overflow.
    scale = -int(np.frexp(max(abs(low), abs(high)))[1])
    values, low, high = np.ldexp(values, scale), np.ldexp(low, scale), np.ldexp(high, scale)
    channels = target.spread(np.column_stack([np.where(missing, 0.0, values), missing]))
    picture = bake_corners(target.uv, channels, target.size, padding=PADDING, device=target.device)
    sums, without = picture[..., 0], picture[..., 1]
    baked = np.divide(sums, 1.0 - without, out=np.zeros_like(sums), where=without < 0.5)
    part = np.clip((baked - low) / (high - low), 0.0, 1.0) if high > low else np.full(baked.shape, 0.5)
    table = colormap_table(colormap)
    colors = table[np.rint(part * (len(table) - 1)).astype(np.int64)]
    colors[without >= 0.5] = 128
    return colors


def mean_curvature(vertices: Floats, faces: Ints) -> Floats:
    """Return the mean curvature at vertices, 1 / length unit, positive where the surface bulges outward, shape [V].

    Half the length of the cotangent Laplacian of the positions over the mixed Voronoi area around a vertex [1]_.

    .. [1] M. Meyer et al., "Discrete differential-geometry operators for triangulated 2-manifolds", VisMath III (2003).
    """
    flow = cotangent_laplacian(vertices, faces) @ vertices
    cotangent = corner_cotangents(vertices, faces)
    corner = vertices[faces]
    # squares[:, k]: of the side opposite to corner k; its two ends share it by the cotangent there.
    squares = ((np.roll(corner, -1, axis=1) - np.roll(corner, 1, axis=1)) ** 2).sum(axis=2)
    parts = squares * cotangent / 8.0
    voronoi = parts.sum(axis=1, keepdims=True) - parts
    whole = triangle_areas(vertices, faces)[:, None]
    obtuse = cotangent < 0
    share = np.where(obtuse.any(axis=1, keepdims=True), np.where(obtuse, 0.5, 0.25) * whole, voronoi)
    area = np.bincount(faces.ravel(), share.ravel(), minlength=len(vertices))
    outward = np.where((flow * vertex_normals(vertices, faces)).sum(axis=1) < 0, -1.0, 1.0)
    return outward * np.linalg.norm(flow, axis=1) / (2.0 * np.maximum(area, TINY))


def area_ratio(vertices: Floats, faces: Ints, on_map: Floats, parts: NDArray[np.intp] | None = None) -> Floats:
    """Return the area around vertices on the map over that on the surface, both totals set to 1, shape [V].

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        on_map: areas of the triangles' images, shape [F].
        parts: the sphere of every triangle, shape [F], where totals are those of each by itself.
    """
    number = np.zeros(len(faces), dtype=np.intp) if parts is None else parts
    shares = []
    for areas in (on_map, triangle_areas(vertices, faces)):
        share = areas / np.maximum(np.bincount(number, areas), TINY)[number]
        shares.append(np.maximum(sums_around(share, faces, len(vertices)), TINY))
    return shares[0] / shares[1]


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
    """Compute the share of cosine-weighted rays from points that meet no surface.

    Their pattern is rotated by a number of the point, and begins at a share of the disc's area, of a ray.
    """
    i, _compiled_once = wp.tid()
    n = normals[i]
    helper = wp.vec3(1.0, 0.0, 0.0)
    # Of a normal's x: below 1/sqrt(2) the axis is 45 degrees or more from the normal.
    if wp.abs(n[0]) > wp.float32(0.7):
        helper = wp.vec3(0.0, 1.0, 0.0)
    t = wp.normalize(wp.cross(n, helper))
    b = wp.cross(n, t)
    # Turns, a prime: so many are told apart, and float32 still resolves each to 1e-4
    # Radians, 1 / 1.3247 (the plastic number): turned by it, no two patterns are near.
    turn = float(numbers[i] % 1021) * wp.float32(0.7548777)
    free = int(0)
    for k in range(rays):
        # A spiral over the disc lifted to the hemisphere: cosine-weighted, and the same for every run.
        r = wp.sqrt((float(k) + firsts[i]) / float(rays))
        # Golden angle, π (3 - sqrt(5)): Vogel's spiral covers a disc evenly
        angle = float(k) * wp.float32(2.3999632) + turn
        up = wp.sqrt(wp.max(1.0 - r * r, 0.0))
        direction = t * (r * wp.cos(angle)) + b * (r * wp.sin(angle)) + n * up
        if not wp.mesh_query_ray_anyhit(mesh, origins[i], direction, 4.0):
            free += 1
    openness[i] = float(free) / float(rays)


MOST_STRIPS = 100_000  # that slivers are cut in: a tree of them takes a tenth of a second


def face_openness(vertices: Floats, faces: Ints) -> Floats:
    """Return the openness of every face, 0 (enclosed) to 1 (open in all directions), shape [F].

    Large meshes are sampled: a face without a sample takes the value of the face before it.
    """
    rays = 24  # from a vertex: openness in steps of 4 %
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    p = ((vertices - low) / (high - low).max())[faces]
    normal = normalised(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    # Ray budget: about half a second on one CPU core
    step = max(1, int(np.ceil(len(faces) * rays / 400_000)))
    chosen = np.arange(0, len(faces), step)
    # Ray start, of the extent, off the surface: single precision resolves 1e-7 of it
    origins = p[chosen].mean(axis=1) + 1e-4 * normal[chosen]
    numbers, middle = np.arange(len(chosen)), np.full(len(chosen), 0.5)
    shares = open_shares(p, origins, normal[chosen], numbers, middle, rays, wp.get_device("cpu"))
    return np.repeat(shares, step)[: len(faces)]


def open_shares(
    triangles: Floats, origins: Floats, normals: Floats, numbers: NDArray, firsts: NDArray, rays: int, where: wp.Device
) -> Floats:
    """Return the shares of cosine-weighted rays from points that meet no triangle, shape [N].

    Args:
        triangles: the surface, of an extent near 1, shape [F, 3, 3].
        origins: shape [N, 3], off the surface.
        normals: the middles of the rays, unit vectors, shape [N, 3].
        numbers: by which the points' rays are turned against each other, shape [N].
        firsts: where they begin, from 0 to 1 of the share of the disc that belongs to a ray, shape [N].
        rays: from each point.
        where: the device.
    """
    corners = without_slivers(triangles).reshape(-1, 3)
    points, start, ways = (sent(x.astype(np.float32), wp.vec3, where) for x in (corners, origins, normals))
    which, indices = (sent(x.astype(np.int32), wp.int32, where) for x in (numbers, np.arange(len(corners))))
    mesh, begin = wp.Mesh(points, indices), sent(firsts.astype(np.float32), wp.float32, where)
    out = wp.zeros(len(origins), dtype=wp.float32, device=where)
    launch_parts(cast_open_rays, len(origins), [mesh.id, *each(start, ways, which, begin), rays], each(out), where)
    return out.numpy().astype(np.float64)


def without_slivers(corners: Floats) -> Floats:
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


def least_visible_meridian(vertices: Floats, faces: Ints, sphere: Floats) -> float:
    """Return the longitude of the meridian that shows least on the surface, in radians in (-π, π].

    The measure is the length of the meridian's image on the surface, weighted by the openness of the space around each
    piece: short lines in folds are preferred to long lines on exposed parts.

    Args:
        vertices: shape [V, 3].
        faces: shape [F, 3].
        sphere: the map, in the frame in which longitude is meant, shape [V, 3].
    """
    meridians = 180  # compared for the seam, evenly spaced
    # Least openness, added to every face's: where nothing is hidden the shortest seam wins; 0 lets it wander in folds
    weight = 0.1 + face_openness(vertices, faces)
    x = (vertices - vertices.min(axis=0)) / np.ptp(vertices, axis=0).max()
    longitudes = (np.arange(meridians) + 1) / meridians * 2.0 * np.pi - np.pi
    costs = np.empty(meridians)
    for k, longitude in enumerate(longitudes):
        c, s = np.cos(longitude), np.sin(longitude)
        height = sphere[:, 1] * c - sphere[:, 0] * s
        along = sphere[:, 0] * c + sphere[:, 1] * s
        side = (height >= 0)[faces]
        crossing = np.flatnonzero(side.any(axis=1) & ~side.all(axis=1))
        crossing = crossing[along[faces[crossing]].sum(axis=1) > 0]
        corner = faces[crossing]
        lonely = np.where(side[crossing].sum(axis=1) == 1, np.argmax(side[crossing], 1), np.argmin(side[crossing], 1))
        tip, a, b = np.take_along_axis(corner, (lonely[:, None] + np.arange(3)) % 3, axis=1).T
        ends = []
        for other in (a, b):
            t = (height[tip] / (height[tip] - height[other]))[:, None]
            ends.append((1.0 - t) * x[tip] + t * x[other])
        costs[k] = (np.linalg.norm(ends[0] - ends[1], axis=1) * weight[crossing]).sum()
    return float(longitudes[np.argmin(costs)])
