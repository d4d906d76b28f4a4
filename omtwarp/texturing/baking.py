"""Baking: any function on the sphere into a picture, and pictures back onto the sphere.

A *source* assigns values to directions: the name of a pattern or a
:class:`~omtwarp.texturing.patterns.Pattern`, an equirectangular (or sinusoidal) picture, or a Python callable from
directions [N, 3] to values [N] or [N, C]. Numbers at the vertices of a mesh are baked through that mesh
(:func:`bake_vertex_values`).

Pictures are float32 arrays [H, W, C], row 0 on top. Texels in which the function changes are supersampled; gutters of
an atlas continue past its borders, pictures for a mesh's own texture coordinates are dilated past the edges of the
charts.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.colors import to_linear, to_srgb
from omtwarp.device.arrays import sent
from omtwarp.device.policy import launch_parts_of, resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import Each, core_count, each, launch_parts, load, run_all
from omtwarp.errors import OmtwarpError, check_word
from omtwarp.mesh.arrays import ROUND_OFF, Floats, Ints, normalised, real_numbers, whole_number, whole_numbers
from omtwarp.options import ProjectionName
from omtwarp.texturing import kernels
from omtwarp.texturing.atlas import Atlas, Kind, check_size, make_atlas
from omtwarp.texturing.export import Material, uv_of_corners
from omtwarp.texturing.image import PictureLike, as_floats, read_image, with_opacity
from omtwarp.texturing.patterns import ValueSource, is_name, pattern
from omtwarp.texturing.seams import Unwrapped, shares_of_corners, unwrap

Picture = NDArray[np.float32]

NOBODY = 2**31 - 1  # the largest int32, in place of the number of a triangle: the least number owns a texel
SAMPLES_AT_ONCE = 1 << 19  # bounds memory: about 25 MB of directions and values at a time
GROW = 1e-6  # texels by which a triangle may claim a centre outside it
PADDING = 16
"""Texels by which charts are continued beyond their borders: bilinear samples see them at the fifth mip level yet."""


DeviceLike: TypeAlias = "str | wp.Device | None"
Source: TypeAlias = "ValueSource | Callable[[Floats], ArrayLike] | PictureLike"
"""What can be baked: the name of a pattern, a pattern, a function of directions, or a picture."""


class _PictureSource(ValueSource):
    """A picture of the sphere in one of the atlases or projections."""

    def __init__(self, picture: NDArray[np.generic], kind: int, offset: float, gutter: float, device: wp.Device):
        self.channels = picture.shape[2]
        texels = wp.array(np.ascontiguousarray(as_floats(picture)), dtype=wp.float32, device=device)
        self._inputs = [kind, wp.float64(offset), wp.float64(gutter), texels]

    def launch(self, directions: wp.array, out: wp.array) -> None:
        inputs = [*self._inputs, Each(directions)]
        launch_parts(kernels.sample_picture, len(directions), inputs, each(out), directions.device)


class _CallableSource(ValueSource):
    def __init__(self, function: Callable[[Floats], ArrayLike]):
        self._function = function
        self.channels = self._call(np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])).shape[1]

    def _call(self, directions: Floats) -> Floats:
        got = np.asarray(self._function(directions), dtype=np.float64)
        if got.shape[:1] != (len(directions),) or got.ndim > 2:
            raise OmtwarpError(
                f"the function to bake gave shape {list(got.shape)} for {len(directions)} directions, not [N] or [N, C]"
            )
        return got.reshape(len(directions), -1)

    def launch(self, directions: wp.array, out: wp.array) -> None:
        got = self._call(normalised(directions.numpy()))
        wp.copy(out, wp.array(np.ascontiguousarray(got), dtype=wp.float64, device=out.device), count=got.size)


def source_of(given: Source, projection: str, device: wp.Device) -> ValueSource:
    """Convert anything that can be baked to a source of values for directions.

    Raises:
        OmtwarpError: an unknown projection, or a picture that cannot be read.
    """
    check_word("projection", projection, ProjectionName)
    if isinstance(given, ValueSource):
        return given
    if is_name(given):
        return pattern(given)
    if callable(given) and not hasattr(given, "__array__"):
        return _CallableSource(given)
    kind = Kind.EQUIRECTANGULAR if projection == "equirectangular" else Kind.SINUSOIDAL
    return _PictureSource(read_image(cast(PictureLike, given)), kind, 0.0, 0.0, device)


def _target(atlas: str | Atlas, size: int | tuple[int, int] | None) -> Atlas:
    return atlas if isinstance(atlas, Atlas) else make_atlas(atlas, size)


def bake(
    source: Source,
    atlas: str | Atlas = "equirectangular",
    *,
    size: int | tuple[int, int] | None = None,
    projection: str = "equirectangular",
    supersample: int = 3,
    device: DeviceLike = "auto",
) -> Picture:
    """Bake a function on the sphere into the picture of an atlas.

    Args:
        source: name of a pattern, :class:`~omtwarp.texturing.patterns.Pattern`, picture (path, PIL image, array), or
            callable from unit vectors [N, 3] to values [N] or [N, C].
        atlas: ``equirectangular``, ``cube`` or ``octahedral``, or an :class:`~omtwarp.texturing.atlas.Atlas`.
        size: width in texels (equirectangular: or width, height) where the atlas is given by name.
        projection: of a picture given as source.
        supersample: side of the grid of samples in texels where the function changes; 1 takes the middle only.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Returns:
        float32, shape [H, W, C], row 0 on top. Values are not clipped.

    Raises:
        OmtwarpError: an unknown atlas, projection or device, or a picture that cannot be read.
    """
    where = resolve_device(device)
    target = _target(atlas, size)
    given = source_of(source, projection, where)
    picture = wp.zeros((target.width * target.height, given.channels), dtype=wp.float32, device=where)
    return bake_texels(target.texels, given, Look(target, where), supersample, picture)


class Look:
    """The directions that the texels of an atlas show.

    Args:
        atlas: the picture's layout.
        where: the device.
    """

    _kinds = wp.int32, wp.vec3i, wp.vec3i, wp.vec3d, wp.int32, wp.int32, wp.int32, wp.vec3d  # of the kernel's tables

    def __init__(self, atlas: Atlas, where: wp.Device):
        offset, gutter = atlas.parameters
        self.atlas, self.where = atlas, where
        self._picture = [atlas.kind, atlas.width, atlas.height, wp.float64(offset), wp.float64(gutter)]
        self._tables: list[object] = [0, 0, *(wp.empty(0, dtype=kind, device=where) for kind in self._kinds)]

    def directions(self, texels: wp.array, samples: int) -> wp.array:
        """Return the directions of texels' samples, a regular grid in each texel, vec3d [N samples²]."""
        count = samples**2
        out = wp.empty(len(texels) * count, dtype=wp.vec3d, device=self.where)
        inputs = [*self._picture, Each(texels), samples, *self._tables]
        launch_parts(kernels.texel_sample_directions, len(texels), inputs, [Each(out, count)], self.where)
        return out


Evaluate: TypeAlias = Callable[[wp.array, int, wp.array], None]
"""Writes the values of the samples of some texels, a square grid in each, to an array, float64 [N samples², C]."""


def fill(texels: Ints, samples: int, evaluate: Evaluate, picture: wp.array) -> None:
    """Write texels, some at a time, as the mean of their samples.

    Args:
        texels: their numbers, row by row.
        samples: side of the grid of samples in a texel.
        evaluate: writes the values of the samples.
        picture: float32 or uint8, [texels, channels].
    """
    where = picture.device
    of_bytes = picture.dtype is wp.uint8
    none = wp.empty((0, 0), dtype=wp.float32 if of_bytes else wp.uint8, device=where)
    pictures = [none, picture] if of_bytes else [picture, none]
    count, step = samples**2, max(SAMPLES_AT_ONCE // samples**2, 1)
    for start in range(0, len(texels), step):
        part = wp.array(texels[start : start + step], dtype=wp.int32, device=where)
        values = wp.empty((len(part) * count, picture.shape[1]), dtype=wp.float64, device=where)
        evaluate(part, samples, values)
        launch_parts(kernels.average_samples, len(part), [Each(values, count), samples, Each(part)], pictures, where)


def supersampled(texels: Ints, samples: int, evaluate: Evaluate, width: int, picture: wp.array) -> None:
    """Write texels of a picture of a width, with more samples where they differ from a neighbour."""
    fill(texels, 1, evaluate, picture)
    if samples > 1:
        # Neighbours that differ by more are worth more samples; a soft gradient is not.
        most = 5 if picture.dtype is wp.uint8 else np.float32(6.0 / 255.0)
        flags = changing(picture.numpy().reshape(-1, width, picture.shape[1]), most)
        fill(texels[flags.ravel()[texels]], samples, evaluate, picture)


def bake_texels(texels: Ints, given: ValueSource, look: Look, samples: int, picture: wp.array) -> NDArray:
    """Bake texels of an atlas's picture [texels, C]; return the whole of it, shape [H, W, C]."""

    def evaluate(some: wp.array, count: int, values: wp.array) -> None:
        given.launch(look.directions(some, count), values)

    supersampled(texels, whole_number(samples, "supersample", least=1, most=1024), evaluate, look.atlas.width, picture)
    baked: NDArray = picture.numpy().reshape(look.atlas.height, look.atlas.width, -1)
    look.atlas.fill_empty(baked)
    return baked


def changing(texels: NDArray[np.generic], most: float | np.generic) -> NDArray[np.bool_]:
    """Return a mask of the texels [H, W, C] that differ by more than ``most`` from one of their four neighbours.

    The first and the last column are neighbours.
    """

    def differ(one: NDArray, other: NDArray) -> NDArray[np.bool_]:
        apart = np.maximum(one, other) - np.minimum(one, other) > most
        return reduce(np.logical_or, np.moveaxis(apart, 2, 0))  # twice as fast as np.any for few channels

    beside, below = differ(np.roll(texels, -1, axis=1), texels), differ(texels[1:], texels[:-1])
    edges = beside | np.roll(beside, 1, axis=1)
    edges[:-1] |= below
    edges[1:] |= below
    return edges


def sample(
    picture: PictureLike, directions: ArrayLike, atlas: str | Atlas = "equirectangular", *, device: DeviceLike = "auto"
) -> Floats:
    """Sample the picture of an atlas in directions: the inverse of :func:`bake`, bilinear between texels.

    Args:
        picture: as baked, shape [H, W, C]; also a path or a PIL image.
        directions: shape [N, 3], of any length.
        atlas: the one it was baked to; by name it gets the size of the picture and the default gutter.

    Returns:
        float64, shape [N, C].
    """
    where = resolve_device(device)
    array = picture if isinstance(picture, np.ndarray) and picture.ndim == 3 else read_image(picture)
    return picture_source(array, atlas, where).at(real_numbers(directions, "directions", (None, 3)), where)


def picture_source(array: NDArray[np.generic], atlas: str | Atlas, where: wp.Device) -> _PictureSource:
    height, width = array.shape[:2]
    target = _target(atlas, width if atlas == "octahedral" else (width, height))
    if (target.width, target.height) != (width, height):
        raise OmtwarpError(
            f"a picture of {width}x{height} texels is not a {target.name} atlas of {target.width}x{target.height}"
        )
    offset, gutter = target.parameters
    return _PictureSource(array, target.kind, offset, gutter, where)


def in_texels(uv: Floats, width: float, height: float, where: wp.Device) -> wp.array:
    """Return coordinates of the corners of triangles, [F, 3, 2], in texels of a picture, y down, vec2d [F, 3]."""
    texels = np.stack([uv[..., 0] * width, (1.0 - uv[..., 1]) * height], axis=-1)
    return wp.array(np.ascontiguousarray(texels), dtype=wp.vec2d, device=where)


def claimed(corners: wp.array, width: int, height: int, grow: float, where: wp.Device) -> Ints:
    """Return the triangle that owns each texel of a picture, row by row, :data:`NOBODY` where there is none.

    Args:
        corners: of the triangles, in texels, y down, vec2d [F, 3].
        width, height: of the picture.
        grow: texels outside of a triangle up to which it owns what no other does; below 0, inside of it.
        where: the device.
    """
    owner = wp.full(width * height, NOBODY, dtype=wp.int32, device=where)

    def claim(rows: tuple[int, int]) -> None:
        inputs = [corners, width, wp.float64(grow), *rows, owner]
        wp.launch(kernels.own_texels, dim=len(corners), inputs=inputs, device=where)

    parts = launch_parts_of(where, height, core_count(), 1)
    if parts > 1:
        load(kernels.own_texels, where)
    run_all(claim, [(height * k // parts, height * (k + 1) // parts) for k in range(parts)])
    return owner.numpy()


class Layout:
    """Triangles laid out on a picture: which one owns each texel, and values linear over it."""

    def __init__(self, corner_uv: Floats, width: int, height: int, where: wp.Device, padding: int = -1):
        self.width, self.height, self.where = width, height, where
        # Of an atlas by whose directions samples are located: its kind and parameters, and the corners' chord points.
        self.on_sphere: list[object] = [0, wp.float64(0.0), wp.float64(0.0)]
        self.chords = wp.empty((0, 3), dtype=wp.vec3d, device=where)
        self.corners = in_texels(corner_uv, width, height, where)
        # Texels around the charts in which the function itself is continued, for filtering
        ring_width = 1.5 if padding < 0 else min(1.5, float(padding))
        owner = claimed(self.corners, width, height, GROW, where)
        if padding:
            owner = np.where(owner == NOBODY, claimed(self.corners, width, height, ring_width, where), owner)
        self.owner = wp.array(owner, dtype=wp.int32, device=where)
        self.known = owner != NOBODY

    def owned(self) -> Ints:
        return np.flatnonzero(self.known).astype(np.int32)

    def interpolate(self, values: wp.array, texels: wp.array, samples: int, out: wp.array) -> None:
        """Interpolate values at corners [F, 3, C] at the samples of texels, into ``out`` [texels * samples², C]."""
        inputs = [*self.on_sphere, self.corners, self.chords, values, self.owner, texels]
        inputs += [self.width, self.height, samples, out]
        wp.launch(kernels.owner_values, dim=len(texels) * samples**2, inputs=inputs, device=self.where)

    def look_up(self, source: ValueSource, corners: wp.array, texels: wp.array, samples: int, out: wp.array) -> None:
        """Write a source's values at vectors that are interpolated between those at corners, shape [F, 3, 3]."""
        vectors = wp.empty(len(out), dtype=wp.vec3d, device=self.where)
        rows = wp.array(ptr=vectors.ptr, shape=(len(out), 3), dtype=wp.float64, device=self.where)
        self.interpolate(corners, texels, samples, rows)
        source.launch(vectors, out)

    def dilate(self, picture: wp.array, rings: int) -> Picture:
        """Fill the texels up to some rings around the owned ones with the nearest of these, all of them with -1."""
        from scipy.ndimage import distance_transform_cdt

        texels: Picture = picture.numpy()
        if rings and self.known.any():
            empty = ~self.known.reshape(self.height, self.width)
            away, (row, column) = distance_transform_cdt(empty, "chessboard", return_indices=True)
            filled = np.flatnonzero(empty & (away <= rings if rings > 0 else True))
            texels[filled] = texels[(row * self.width + column).ravel()[filled]]
        return texels


def bake_to_uv(
    source: Source | VertexValues,
    sphere: ArrayLike,
    faces: ArrayLike,
    uv: ArrayLike,
    *,
    size: int | tuple[int, int] = 2048,
    rotation: ArrayLike | None = None,
    projection: str = "equirectangular",
    padding: int = 16,
    device: DeviceLike = "auto",
) -> Picture:
    """Bake a function on the sphere into a picture for a mesh's own texture coordinates.

    Args:
        source: as in :func:`bake`, or numbers at the vertices as an array of shape [V] or [V, C] wrapped in
            :class:`VertexValues`.
        sphere: the map, unit vectors, shape [V, 3].
        faces: shape [F, 3].
        uv: the mesh's texture coordinates in 0..1, v up: [V, 2], or one per corner [F, 3, 2].
        size: side of the picture, or (width, height), in texels.
        rotation: turns the function on the sphere, shape [3, 3].
        padding: texels by which the charts are dilated past their edges; -1 fills the picture.

    Returns:
        float32, shape [H, W, C]; texels outside of all triangles are 0. Where charts overlap, the face with the lowest
        number has the texel.
    """
    where = resolve_device(device)
    s = real_numbers(sphere, "sphere", (None, 3))
    samples = 3  # side of the grid in texels where the function changes, as of bake
    faces = whole_numbers(faces, "faces", (None, 3), below=len(s))
    sides = check_size(size, least=1)
    width, height = sides[0], sides[-1]
    layout = Layout(real_numbers(uv_of_corners(uv, faces), "texture coordinates", None), width, height, where, padding)
    if isinstance(source, VertexValues):
        return _bake_linear(layout, source.corner_values(faces), samples, padding)
    given = source_of(source, projection, where)
    turned = s if rotation is None else s @ real_numbers(rotation, "rotation", (3, 3))
    points = wp.array(np.ascontiguousarray(turned[faces]), dtype=wp.float64, device=where)

    picture = wp.zeros((width * height, given.channels), dtype=wp.float32, device=where)
    supersampled(layout.owned(), samples, partial(layout.look_up, given, points), width, picture)
    return layout.dilate(picture, padding).reshape(height, width, given.channels)


class VertexValues:
    """Numbers at the vertices of a mesh, to be baked: linear over every triangle of the surface.

    Args:
        values: shape [V] or [V, C], finite.
    """

    def __init__(self, values: ArrayLike):
        array = real_numbers(values, "values at vertices", None)
        if array.ndim not in (1, 2) or not array.size:
            raise OmtwarpError(f"values at vertices of shape {list(array.shape)}: give finite numbers, [V] or [V, C]")
        self.values: Floats = array.reshape(len(array), -1)

    def corner_values(self, faces: NDArray) -> Floats:
        """Return the values at the corners of faces, shape [F, 3, C]."""
        if faces.max(initial=-1) >= len(self.values):
            raise OmtwarpError(f"values at vertices: {len(self.values)} given for {faces.max() + 1} vertices")
        return self.values[faces]


def _bake_linear(layout: Layout, corner_values: Floats, supersample: int, padding: int) -> Picture:
    where = layout.where
    values = wp.array(np.ascontiguousarray(corner_values), dtype=wp.float64, device=where)
    picture = wp.zeros((layout.width * layout.height, corner_values.shape[2]), dtype=wp.float32, device=where)
    fill(layout.owned(), max(int(supersample), 1), partial(layout.interpolate, values), picture)
    return layout.dilate(picture, padding).reshape(layout.height, layout.width, -1)


def bake_vertex_values(
    values: ArrayLike | VertexValues,
    sphere: ArrayLike,
    faces: ArrayLike,
    atlas: str | Atlas = "equirectangular",
    *,
    size: int | tuple[int, int] | None = None,
    device: DeviceLike = "auto",
) -> Picture:
    """Bake numbers at the vertices of a mesh into the picture of an atlas, through the mesh's map to the sphere.

    Args:
        values: shape [V] or [V, C].
        sphere, faces: the map, [V, 3] and [F, 3].
        atlas, size: as in :func:`bake`.

    Returns:
        float32, shape [H, W, C]; gutters are filled by dilation.
    """
    where, target = resolve_device(device), _target(atlas, size)
    given = values if isinstance(values, VertexValues) else VertexValues(values)
    points = real_numbers(sphere, "sphere", (None, 3))
    corners = whole_numbers(faces, "faces", (None, 3), below=len(points)).astype(np.int32)
    if len(given.values) != len(points):
        raise OmtwarpError(f"values at vertices: {len(given.values)} given for {len(points)} vertices")
    cut = unwrap(points, corners, target)
    layout, part = sphere_layout(cut, target, points, where)
    return _bake_linear(layout, (cut.weights @ given.values)[cut.faces][part], 2, -1)


def sphere_layout(
    cut: Unwrapped, atlas: Atlas, sphere: ArrayLike, where: wp.Device
) -> tuple[Layout, NDArray[np.int64]]:
    """Lay parts of faces out on an atlas's picture; return the layout and the part of each of its triangles, [K]."""
    chords = (cut.weights @ np.asarray(sphere, dtype=np.float64))[cut.faces]
    corner_uv, part = cut.uv, np.arange(len(cut.faces))
    if atlas.wraps:
        # On the picture a pole is the whole top or bottom edge. A triangle at a pole has one point of it, but owns the
        # rectangle up to the edge; only the ownership is used.
        v = corner_uv[..., 1]
        at = np.flatnonzero(np.isin(v, (0.0, 1.0)).sum(axis=1) == 1)
        k = np.argmax(np.isin(v[at], (0.0, 1.0)), axis=1)
        pole, a, b = (corner_uv[at, (k + i) % 3] for i in range(3))
        over_a, over_b = np.stack([a[:, 0], pole[:, 1]], axis=1), np.stack([b[:, 0], pole[:, 1]], axis=1)
        corner_uv = np.concatenate([corner_uv, np.stack([over_a, a, b], 1), np.stack([over_a, b, over_b], 1)])
        part = np.concatenate([part, at, at])
    layout = Layout(corner_uv, atlas.width, atlas.height, where)
    layout.on_sphere = [atlas.kind, *map(wp.float64, atlas.parameters)]
    layout.chords = sent(chords[part], wp.vec3d, where)
    return layout, part


def own_at_parts(cut: Unwrapped, faces: NDArray, own: Floats) -> Floats:
    """Return the texture coordinates of the corners of the parts of faces, shape [M, 3, 2].

    Each corner is a combination of vertices of its source face; its coordinates are the same combination of that
    face's corners.
    """
    return np.einsum("tij,tjc->tic", shares_of_corners(cut, faces), own[cut.source_face])


def tiled_copies(uv: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Copy triangles so that each copy covers its part of the unit square, for pictures that repeat.

    Args:
        uv: coordinates of the corners, shape [F, 3, 2].

    Returns:
        Which triangle each copy is of, shape [T], and its coordinates, shape [T, 3, 2]; a copy may reach over the
        square's border, and another one then reaches over the opposite border.

    Raises:
        OmtwarpError: a triangle reaches over more than 16 pictures along a side.
    """
    # Copies of the picture that one triangle may reach over, along either side.
    most_tiles = 16
    low = np.floor(uv.min(axis=1) + ROUND_OFF).astype(np.int64)
    count = np.maximum(np.ceil(uv.max(axis=1) - ROUND_OFF).astype(np.int64), low + 1) - low
    if len(count) and count.max() > most_tiles:
        face = int(np.argmax(count.max(axis=1)))
        raise OmtwarpError(
            f"texture coordinates: face {face} reaches over {count[face].max()} copies of the picture, and "
            f"{most_tiles} is the most"
        )
    number = count.prod(axis=1)
    which = np.repeat(np.arange(len(uv)), number)
    step = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
    shift = low[which] + np.stack([step % count[which, 0], step // count[which, 0]], axis=1)
    return which, uv[which] - shift[:, None, :]


def overlap(uv: Floats, width: int, height: int, where: wp.Device) -> float:
    """Return the share of the covered texels that lie in more than one triangle, from 0 to 1."""
    corners = (in_texels(some, width, height, where) for some in (uv, uv[::-1]))
    # Texels by which a centre lies inside a triangle for certain: neighbours share their sides to round-off
    first, last = (claimed(some, width, height, -0.02, where) for some in corners)
    covered_texels = first != NOBODY
    return float((covered_texels & (first != len(uv) - 1 - last)).sum() / max(covered_texels.sum(), 1))


def bake_corners(
    uv: Floats, values: Floats, size: tuple[int, int], *, padding: int = PADDING, samples: int = 2, device: wp.Device
) -> Picture:
    """Bake values at corners, linear over every triangle, to a picture; texels outside of all triangles are 0.

    Args:
        uv: coordinates of the corners, shape [F, 3, 2].
        values: shape [F, 3, C].
        size: width and height in texels.
        padding: texels by which charts are continued, -1 for all.
        samples: side of the grid of samples in a texel.
        device: where to compute.

    Returns:
        float32, shape [H, W, C].
    """
    return _bake_linear(Layout(uv, *size, device, padding), values, samples, padding)


def covered(uv: Floats, size: tuple[int, int], *, padding: int = PADDING, device: wp.Device) -> NDArray[np.bool_]:
    """Return a mask of the texels that triangles and the padding around them cover, shape [H, W]."""
    return bake_corners(uv, np.ones((len(uv), 3, 1)), size, padding=padding, samples=1, device=device)[..., 0] > 0.5


def bake_materials(
    layout: Layout, own: Floats | None, which: Ints, materials: tuple[Material, ...], colors: Floats | None, rings: int
) -> Picture:
    """Bake the colours of materials to the texels of a layout, through the triangles' own coordinates.

    Args:
        layout: the triangles on the picture to be made.
        own: coordinates of the layout's corners on the materials' own pictures, shape [K, 3, 2]; None without any.
        which: number of the material of every triangle, shape [K].
        materials: whose colours are taken; pictures repeat.
        colors: sRGB and opacity at the corners from 0 to 1, shape [K, 3, 4], for materials without a picture.
        rings: texels by which charts are continued, -1 for all.

    Returns:
        sRGB and opacity from 0 to 1, float32, shape [H, W, 4]; opaque black where nothing is.
    """
    where = layout.where
    out = wp.zeros((layout.width * layout.height, 4), dtype=wp.float32, device=where)
    texels = layout.owned()
    number = which[layout.owner.numpy()[texels]]
    coordinates = np.zeros((len(which), 3, 3)) if own is None else np.pad(own, ((0, 0), (0, 0), (0, 1)))
    corners = sent(coordinates, wp.float64, where)

    for k, material in enumerate(materials):
        mine = texels[number == k]
        if not len(mine):
            continue
        if material.picture is None and colors is not None:
            shown = tinted(colors.astype(np.float32), np.array(material.color, dtype=np.float32))
            evaluate = partial(layout.interpolate, sent(shown, wp.float64, where))
        else:
            white = np.ones((1, 1, 4), dtype=np.float32)
            picture = white if material.picture is None else with_opacity(as_floats(material.picture))
            picture = tinted(picture, np.array(material.color, dtype=np.float32))
            evaluate = partial(layout.look_up, _PictureSource(picture, Kind.REPEATED, 0.0, 0.0, where), corners)
        fill(mine, 2, evaluate, out)
    sampled = layout.dilate(out, rings)
    # Texels outside of all triangles make no material transparent.
    sampled[~layout.known & (sampled[:, 3] == 0), 3] = 1.0
    return sampled.reshape(layout.height, layout.width, 4)


def tinted(picture: NDArray[np.float32], factor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Multiply a picture by a colour as light; both are sRGB with opacity from 0 to 1, shape [H, W, 4]."""
    if (factor == 1.0).all():
        return picture
    rgb = to_srgb(to_linear(picture[..., :3]) * to_linear(factor[:3]))
    return np.concatenate([rgb, picture[..., 3:] * factor[3]], axis=2).astype(np.float32)


def over(top: NDArray[np.float32], bottom: NDArray[np.float32], opacity: float) -> NDArray[np.float32]:
    """Lay one picture over another by Porter and Duff's "over" [1]_, in linear light.

    Args:
        top: sRGB and opacity from 0 to 1, shape [H, W, 4].
        bottom: the same.
        opacity: factor on the opacity of the top, from 0 to 1.

    Returns:
        sRGB and opacity, shape [H, W, 4].

    .. [1] T. Porter, T. Duff, "Compositing Digital Images", SIGGRAPH 1984.
    """
    above = top[..., 3:] * np.float32(opacity)
    below = bottom[..., 3:] * (1.0 - above)
    total = above + below
    # Least cover, of opacity: what is more transparent has no colour; eight bits resolve 4e-3
    light = (to_linear(top[..., :3]) * above + to_linear(bottom[..., :3]) * below) / np.maximum(total, np.float32(1e-6))
    return np.concatenate([to_srgb(light), total], axis=2).astype(np.float32)
