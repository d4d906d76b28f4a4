"""Baking of 8-bit pictures with more samples only where the picture needs them.

A pattern says of every direction how far there is no edge. Blocks of texels without one are filled from their corners;
only next to edges is every texel looked at, and only those that an edge crosses get more than one sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.device.threads import launch_parts
from omtwarp.texturing import kernels
from omtwarp.texturing.atlas import Equirectangular, check_size
from omtwarp.texturing.baking import SAMPLES_AT_ONCE, PatternSource, Source, ValueSource, source_of
from omtwarp.texturing.bending import Look
from omtwarp.texturing.image import as_bytes
from omtwarp.texturing.patterns import Pattern, pattern
from omtwarp.texturing.projection import check_projection, direction_from_angles

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int32]

PARTS = 4  # of a block along a side, one level finer


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
    baking = _Baking(given, look)
    if isinstance(given, PatternSource):
        busy = baking.calm(given)
    else:
        busy = atlas.texels
    baking.fill(busy, 1)
    if supersample > 1:
        baking.fill(baking.changing(busy), int(supersample))
    baked = baking.picture.numpy().reshape(atlas.height, atlas.width, given.channels)
    atlas.fill_empty(baked)
    return baked


class _Baking:
    """A picture being filled."""

    def __init__(self, given: ValueSource, look: Look):
        self._given, self._look, self._where = given, look, look.where
        self._width, self._height = look.atlas.width, look.atlas.height
        self._row_lengths = look.atlas.row_lengths
        self.picture = wp.zeros((self._width * self._height, given.channels), dtype=wp.uint8, device=look.where)

    def calm(self, given: PatternSource) -> Ints:
        """Fill the parts without an edge; return the texels that remain."""
        steps = (16, 4)  # texels along the side of the blocks that are filled at once, coarse before fine
        side = steps[0] * PARTS
        x, y = np.arange(0, self._width, side), np.arange(0, self._height, side)
        covered = x < self._row_lengths[y][:, None]
        corners = (y[:, None] * self._width + x[None, :])[covered].astype(np.int32)
        lattice = np.arange(PARTS + 1)
        for step in steps:
            left = []
            at_once = max(SAMPLES_AT_ONCE // (PARTS + 1) ** 2, 1)
            for start in range(0, len(corners), at_once):
                some = corners[start : start + at_once]
                row, column = np.divmod(some, self._width)
                columns = np.minimum(column[:, None] + step * lattice, self._width - 1)
                rows = np.minimum(row[:, None] + step * lattice, self._height - 1)
                points = (rows[:, :, None] * self._width + columns[:, None, :]).ravel().astype(np.int32)
                busy = self._fill_calm(given, some, points, step)
                which, part = np.divmod(np.flatnonzero(busy), PARTS**2)
                left.append(some[which] + part // PARTS * step * self._width + part % PARTS * step)
            corners = np.concatenate(left) if left else np.zeros(0, dtype=np.int32)
        row, column = np.divmod(corners, self._width)
        offsets = np.arange(steps[-1])
        rows, columns = row[:, None] + offsets, column[:, None] + offsets
        texels = rows[:, :, None] * self._width + columns[:, None, :]
        lengths = np.where(rows < self._height, self._row_lengths[np.minimum(rows, self._height - 1)], 0)
        inside = columns[:, None, :] < lengths[:, :, None]
        return texels[inside].astype(np.int32)

    def _fill_calm(self, given: PatternSource, corners: Ints, points: Ints, step: int) -> Bytes:
        """Fill the parts of blocks without an edge from their lattices' texels; return the remaining, [N PARTS²]."""
        where, lattice = self._where, (PARTS + 1) ** 2
        directions = self._look.directions(wp.array(points, dtype=wp.int32, device=where), 1)
        colours = wp.empty((len(points), given.channels), dtype=wp.float64, device=where)
        reach = given.reach(directions, colours)
        first = wp.array(corners, dtype=wp.int32, device=where)
        busy = wp.empty((len(corners), PARTS**2), dtype=wp.uint8, device=where)

        def arguments(some: slice) -> tuple[list[object], list[object]]:
            at = slice(some.start * lattice, some.stop * lattice)
            # Gradient: colours of a block's corners that differ by more are not interpolated
            numbers = [step, self._width, self._height, wp.float64(4.0 / 255.0)]
            return [first[some], *numbers, directions[at], reach[at], colours[at]], [self.picture, busy[some]]

        launch_parts(kernels.fill_calm, len(corners), arguments, where)
        return busy.numpy().ravel()

    def fill(self, texels: Ints, samples: int) -> None:
        """Write texels, some at a time, as the mean of their samples."""
        step = max(SAMPLES_AT_ONCE // samples**2, 1)
        for start in range(0, len(texels), step):
            part = wp.array(texels[start : start + step], dtype=wp.int32, device=self._where)
            directions = self._look.directions(part, samples)
            values = wp.empty((len(directions), self._given.channels), dtype=wp.float64, device=self._where)
            self._given.values(directions, values)
            self._average(values, part, samples)

    def _average(self, values: wp.array, texels: wp.array, samples: int) -> None:
        """Write texels as the mean of their samples' values."""
        count = samples**2

        def arguments(some: slice) -> tuple[list[object], list[object]]:
            return [values[some.start * count : some.stop * count], samples, texels[some]], [self.picture]

        launch_parts(kernels.average_to_bytes, len(texels), arguments, self._where)

    def changing(self, texels: Ints) -> Ints:
        """Return the texels, among some, that differ from a neighbour."""
        part = wp.array(texels, dtype=wp.int32, device=self._where)
        flags = wp.empty(len(texels), dtype=wp.uint8, device=self._where)
        # Change, levels: neighbouring texels that differ by more are worth more samples; a soft gradient is not
        launch_parts(
            kernels.flag_edges,
            len(texels),
            lambda some: ([self.picture, part[some], self._width, self._height, 5], [flags[some]]),
            self._where,
        )
        return texels[flags.numpy() != 0]


def rasterize(
    source: str | Pattern,
    width: int = 2048,
    height: int | None = None,
    projection: str = "equirectangular",
    *,
    supersample: int = 3,
    device: str | None = "auto",
) -> NDArray[np.uint8]:
    """Draw a pattern as a supersampled picture of the whole sphere.

    Args:
        source: name of a pattern, or a pattern.
        width, height: in texels; the height is half the width by default.
        projection: ``equirectangular``, or ``sinusoidal``: a picture for ``texture(..., projection="sinusoidal")``,
            with the texels outside the two bounding curves filled from the nearest point inside.
        supersample: side of the grid of samples per texel where the colour changes.

    Returns:
        uint8, shape [height, width, 3], north on top.
    """
    check_projection(projection)
    width, height = check_size((width, max(width // 2, 1) if height is None else height))
    given = pattern(source)
    if projection == "equirectangular":
        target = Equirectangular(width, height)
        return bake_bytes(given, Look(target, resolve_device(device)), supersample=supersample)
    return as_bytes(_rasterize_sinusoidal(given, width, height, supersample, device))


def _rasterize_sinusoidal(
    given: Pattern, width: int, height: int, supersample: int, device: wp.Device
) -> NDArray[np.float32]:
    picture = np.empty((height, width, 3), dtype=np.float32)
    x = ((np.arange(width * supersample) + 0.5) / (width * supersample) - 0.5) * 2.0 * np.pi
    # At once, texels whose colours are computed together: 13 MB of directions
    rows = max(1, (1 << 19) // (width * supersample**2))
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        sub = np.arange(start * supersample, stop * supersample)
        lat = (0.5 - (sub + 0.5) / (height * supersample)) * np.pi
        lon = np.clip(x[None, :] / np.cos(lat)[:, None], -np.pi, np.pi)
        colours = given(direction_from_angles(lon, lat[:, None]).reshape(-1, 3), device)
        blocks = colours.reshape(stop - start, supersample, width, supersample, 3)
        picture[start:stop] = blocks.mean(axis=(1, 3))
    return picture
