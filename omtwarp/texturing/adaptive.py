"""Baking of 8-bit pictures with more samples only where the picture needs them.

A pattern says of every direction how far there is no edge. Blocks of texels without one are filled from their corners;
only next to edges is every texel looked at, and only those that an edge crosses get more than one sample. Texels look
in the directions of their atlas, as these are or moved from the linear map of a mesh to its smooth one.
"""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from omtwarp.device.arrays import sent
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import FIRST_THREAD, Each, launch_parts
from omtwarp.mesh.arrays import Bytes, Floats, Ints, Numbers, whole_number
from omtwarp.mesh.surface import face_neighbours
from omtwarp.texturing import kernels
from omtwarp.texturing.atlas import Atlas, Equirectangular, check_size
from omtwarp.texturing.baking import GROW, NOBODY, Look, Source, bake_texels, claimed, in_texels, source_of
from omtwarp.texturing.patterns import Pattern, pattern
from omtwarp.texturing.seams import Unwrapped
from omtwarp.texturing.smooth import SmoothCurves


def bake_bytes(source: Source, look: Look, *, projection: str = "equirectangular", supersample: int = 3) -> Bytes:
    """Bake a function on the sphere into the picture of an atlas, of 8 bits a channel.

    Args:
        source: as in :func:`omtwarp.texturing.baking.bake`.
        look: where the texels look, and on which device.
        projection, supersample: as in :func:`omtwarp.texturing.baking.bake`.

    Returns:
        uint8, shape [H, W, C], row 0 on top.

    Raises:
        OmtwarpError: an unknown projection, or a picture that cannot be read.
    """
    atlas, given = look.atlas, source_of(source, projection, look.where)
    picture = wp.zeros((atlas.width * atlas.height, given.channels), dtype=wp.uint8, device=look.where)
    texels = fill_calm(given, look, picture) if isinstance(given, Pattern) else atlas.texels
    return bake_texels(texels, given, look, supersample, picture)


def fill_calm(given: Pattern, look: Look, picture: wp.array) -> Ints:
    """Fill the parts of a picture without an edge of the pattern; return the texels that remain."""
    step = 4  # texels along the side of the blocks that are filled at once from their corners
    width, height = look.atlas.width, look.atlas.height
    across, down = -(-width // step), -(-height // step)
    columns = np.minimum(step * np.arange(across + 1), width - 1)
    rows = np.minimum(step * np.arange(down + 1), height - 1)
    corners = sent((rows[:, None] * width + columns).ravel().astype(np.int32), wp.int32, look.where)
    directions = look.directions(corners, 1)
    colours = wp.empty((len(corners), given.channels), dtype=wp.float64, device=look.where)
    reach = given.launch(directions, colours)
    busy = wp.empty(across * down, dtype=wp.uint8, device=look.where)
    # Gradient: colours of a block's corners that differ by more are not interpolated
    inputs = [FIRST_THREAD, step, width, height, wp.float64(4.0 / 255.0), directions, reach, colours]
    launch_parts(kernels.fill_calm, across * down, inputs, [picture, Each(busy)], look.where)
    left = (busy.numpy().reshape(down, across) > 0).repeat(step, axis=0).repeat(step, axis=1)[:height, :width]
    return np.flatnonzero(left & look.atlas.covered).astype(np.int32)


def rasterize(source: str | Pattern, width: int = 2048, *, supersample: int = 3, device: str | None = "auto") -> Bytes:
    """Draw a pattern as a supersampled equirectangular picture of the whole sphere.

    Args:
        source: name of a pattern, or a pattern.
        width: in texels; the height is half of it.
        supersample: side of the grid of samples per texel where the colour changes.

    Returns:
        uint8, shape [width / 2, width, 3], north on top.
    """
    target = Equirectangular(*check_size((width, max(whole_number(width, "width") // 2, 1))))
    return bake_bytes(pattern(source), Look(target, resolve_device(device)), supersample=supersample)


def _divided_as_shown(curves: SmoothCurves, atlas: Atlas) -> tuple[Ints, Ints, Ints, Floats]:
    """Divide a smooth map as finely as the texels of an atlas show.

    Returns:
        Where the points of every triangle begin in the grid, shape [F], into how many parts its edges are divided, 0
        where the map is as good as linear, shape [F], the grid of the numbers of points, and the points, unit vectors,
        shape [N, 3].
    """
    least_moved = 0.2  # texels: triangles in which the smooth map stays nearer to the linear one are left linear
    texel = atlas.texel_angle
    away = np.linalg.norm(curves.sphere - curves.given, axis=1)[curves.faces].max(axis=1)
    bend = curves.bend / texel
    # Divided into n parts, a curve that leaves a straight one by b texels is followed to b / n² texels.
    wanted = np.ceil(np.sqrt(bend / 0.1)).astype(np.int64)
    # Edges are divided into as many parts; 8 are 45 points in every triangle, and more would turn by less than 5
    # degrees from one to the next.
    divisions = np.array([1, 3, 8], dtype=np.int32)
    moved = (away > least_moved * texel) | (bend > least_moved)
    divided = np.where(moved, divisions[np.searchsorted(divisions[:2], wanted)], np.int32(0))
    first = np.zeros(len(divided), dtype=np.int32)
    grids, points, rows, count = [], [curves.sphere], 0, len(curves.sphere)
    sizes = np.unique(divided[divided > 0]).tolist()
    which_of = {parts: np.flatnonzero(divided == parts) for parts in sizes}
    # NumPy lets go of the interpreter in long operations.
    with ThreadPoolExecutor(2) as pool:
        finer = pool.map(lambda parts: curves.divided(parts, which_of[parts]), sizes)
    for which, made in zip(which_of.values(), finer, strict=True):
        grid = np.where(made.grid < len(curves.sphere), made.grid, made.grid + count - len(curves.sphere))
        points.append(made.sphere[len(curves.sphere) :])
        count += len(points[-1])
        first[which] = rows + np.arange(len(which)) * grid.shape[1]
        rows += grid.size
        grids.append(grid.ravel())
    return first, divided, np.concatenate([*grids, np.zeros(0, dtype=np.int32)]), np.concatenate(points)


class BentLook(Look):
    """The directions for the texels of a mesh's picture with which the mesh, linear in triangles, shows its smooth map.

    Args:
        curves: the smooth map.
        atlas: the picture's layout.
        cutting: gives the mesh unwrapped onto it.
        rotation: turns the function on the sphere, shape [3, 3].
        where: the device.
    """

    def __init__(
        self, curves: SmoothCurves, atlas: Atlas, cutting: Future[Unwrapped], rotation: Floats, where: wp.Device
    ):
        hint_block = 8  # texels along the side of a block that has a triangle of its own at which searches begin
        super().__init__(atlas, where)
        first, divided, grid, points = _divided_as_shown(curves, atlas)
        cut = cutting.result()
        faces, given = curves.faces, curves.given @ rotation
        across, down = -(-atlas.width // hint_block), -(-atlas.height // hint_block)
        corners = in_texels(cut.uv, atlas.width / hint_block, atlas.height / hint_block, where)
        part = claimed(corners, across, down, GROW, where)
        # Hint reach: blocks past the borders of charts to which the hints go, which is more than a gutter
        part = np.where(part == NOBODY, claimed(corners, across, down, 1.0, where), part)
        hints = np.where(part == NOBODY, -1, cut.source_face[np.minimum(part, len(cut.source_face) - 1)])
        mesh: list[Numbers] = [hints, faces, face_neighbours(faces, len(given)), given]
        tables = zip([*mesh, first, divided, grid, points @ rotation], self._kinds, strict=True)
        self._tables = [hint_block, across, *(sent(table, kind, where) for table, kind in tables)]
