"""Surfaces laid out on one picture through their maps: an atlas of the sphere, atlases side by side, a flat torus."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError
from omtwarp.maps.torus_map import TorusMap
from omtwarp.mesh.arrays import TINY
from omtwarp.mesh.surface import triangle_areas, vertex_normals
from omtwarp.options import AtlasLike, PatternLike, ProjectionLike
from omtwarp.texturing.atlas import check_size, make_atlas
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.materials import Bytes, Floats, Ints
from omtwarp.texturing.patterns import Pattern, is_name
from omtwarp.texturing.textured import TexturedSurface, texture, texture_torus
from omtwarp.texturing.unwrap import pack_rows

SIZE = 2048
"""Texels of a side of a picture for own coordinates where the material has none whose size could be taken."""


PLAIN = np.zeros((16, 32, 3), dtype=np.uint8)
"""A picture for coordinates alone: one of one colour is the fastest."""


@dataclass(frozen=True)
class Look:
    """Arguments of :func:`omtwarp.texture` that say how a sheet looks.

    Attributes:
        source: a picture or a pattern; None for coordinates alone.
        projection, atlas, rotate, size: the options of that name.
        device: where to compute.
    """

    source: PictureLike | Pattern | None
    projection: ProjectionLike
    atlas: AtlasLike
    rotate: ArrayLike | str | None
    size: int | None
    device: wp.Device

    @property
    def given(self) -> tuple[PictureLike | None, PatternLike | Pattern | None]:
        """The picture and the pattern, one of which is None."""
        if isinstance(self.source, Pattern) or is_name(self.source):
            return None, self.source
        return self.source, None

    def textured(self, vertices: Floats, faces: Ints, sphere: Floats) -> TexturedSurface:
        """Return the atlas of a surface."""
        image, pattern = (PLAIN, None) if self.source is None else self.given
        size = SIZE if self.size is None and self.source is None else self.size
        return texture(
            (vertices, faces, sphere), image, pattern=pattern, projection=self.projection, atlas=self.atlas,
            rotate=self.rotate, size=size, smooth=self.source is not None, device=str(self.device),
        )  # fmt: skip


@dataclass(frozen=True)
class Sheet:
    """A surface on one picture.

    Attributes:
        vertices: shape [N, 3]; those of copies along seams are joined.
        faces: shape [K, 3].
        uv: coordinates of the corners, shape [K, 3, 2].
        normals: unit normals at the corners, shape [K, 3, 3].
        source_face: triangle of the surface that each is, or is a part of, shape [K].
        weights: the corners as combinations of that triangle's corners, shape [K, 3, 3].
        size: width and height of the picture in texels.
        picture: what was asked for, uint8; None for coordinates alone.
        repeats: whether coordinates leave [0, 1], and the picture closes up both ways.
    """

    vertices: Floats
    faces: Ints
    uv: Floats
    normals: Floats
    source_face: NDArray
    weights: Floats
    size: tuple[int, int]
    picture: Bytes | None
    repeats: bool = False


def sphere_sheet(vertices: Floats, faces: Ints, sphere: Floats, look: Look) -> Sheet:
    """Lay a surface out on the atlas of its sphere.

    Args:
        vertices, faces, sphere: the map, shapes [V, 3], [F, 3] and [V, 3].
        look: what is drawn.
    """
    made = look.textured(vertices, faces, sphere)
    first = np.zeros(int(made.welded.max()) + 1, dtype=np.int64)
    first[made.welded[::-1]] = np.arange(len(made.welded))[::-1]
    corners = made.vertices[made.faces]
    return Sheet(
        vertices=made.vertices[first],
        faces=made.welded[made.faces].astype(np.int32),
        uv=made.uv[made.faces],
        normals=made.normals[made.faces],
        source_face=made.source_face,
        weights=combinations(corners, vertices[faces[made.source_face]]),
        size=(made.image.shape[1], made.image.shape[0]),
        picture=None if look.source is None else made.image,
    )


def sheet_of_parts(vertices: Floats, faces: Ints, sphere: Floats, parts: NDArray, look: Look) -> Sheet:
    """Lay out the parts of a surface, each on the atlas of its own sphere, side by side in proportion to their areas.

    Args:
        vertices, faces, sphere: the map, shapes [V, 3], [F, 3] and [V, 3].
        parts: the sphere of every triangle, shape [F].
        look: what is drawn on every sphere; its size is that of the whole picture, a square.

    Raises:
        OmtwarpError: the picture is too small for so many parts.
    """
    # Texels around the atlas of a part: seen by bilinear samples at the third mip level yet, as the least gutters are.
    gap = 8
    # Widths of atlases of parts are multiples of so many texels, which every atlas takes, and at least two of them.
    step, fewest = 48, 2
    (side,) = check_size(SIZE if look.size is None else look.size)
    one = make_atlas(look.atlas, fewest * step)
    height = one.height / one.width
    least = np.array([one.width, one.height])
    sizes = np.sqrt(np.bincount(parts, triangle_areas(vertices, faces)))[:, None] * [1.0, height]
    try:
        corner, scale = pack_rows(sizes, 1.0, gap / side, least / side)
    except OmtwarpError:
        raise OmtwarpError(f"a picture of {side} x {side} texels has no room for {len(sizes)} parts") from None
    wide = np.maximum((sizes[:, 0] * (scale * side / step)).astype(np.int64), fewest) * step
    left, bottom = np.rint(corner * side).astype(np.int64).T
    picture = None
    drawn_parts = []
    for part, width in enumerate(wide.tolist()):
        mine = np.flatnonzero(parts == part)
        used, own = np.unique(faces[mine], return_inverse=True)
        numbers = np.asarray(own.reshape(-1, 3), dtype=np.int32)
        sheet = sphere_sheet(vertices[used], numbers, sphere[used], replace(look, size=width))
        across, high = sheet.size
        if sheet.picture is not None:
            if picture is None:
                picture = np.zeros((side, side, sheet.picture.shape[2]), dtype=np.uint8)
                picture[:] = np.rint(sheet.picture.mean(axis=(0, 1)))
            aside = (0, 0), (gap - 1, gap - 1), (0, 0)
            drawn = np.pad(sheet.picture, aside, "wrap") if one.wraps else np.pad(sheet.picture, aside, "edge")
            drawn = np.pad(drawn, ((gap - 1, gap - 1), (0, 0), (0, 0)), "edge")
            row, column = side - int(bottom[part]) - high - gap + 1, int(left[part]) - gap + 1
            picture[row : row + drawn.shape[0], column : column + drawn.shape[1]] = drawn
        uv = (sheet.uv * (across, high) + (left[part], bottom[part])) / side
        drawn_parts.append(replace(sheet, uv=uv, source_face=mine[sheet.source_face]))
    before = np.concatenate([[0], np.cumsum([len(sheet.vertices) for sheet in drawn_parts])])
    return Sheet(
        vertices=np.concatenate([sheet.vertices for sheet in drawn_parts]),
        faces=np.concatenate([sheet.faces + at for sheet, at in zip(drawn_parts, before[:-1], strict=True)]).astype(
            np.int32
        ),
        uv=np.concatenate([sheet.uv for sheet in drawn_parts]),
        normals=np.concatenate([sheet.normals for sheet in drawn_parts]),
        source_face=np.concatenate([sheet.source_face for sheet in drawn_parts]),
        weights=np.concatenate([sheet.weights for sheet in drawn_parts]),
        size=(side, side),
        picture=picture,
    )


def torus_sheet(result: TorusMap, look: Look) -> Sheet:
    """Lay a surface out on the picture of its flat torus, once along each of the lattice's vectors."""
    picture = torus_picture(result, look)
    corners = result.corners
    faces = result.faces
    return Sheet(
        vertices=result.vertices,
        faces=faces,
        uv=corners - np.floor(corners.min(axis=1, keepdims=True)),
        normals=vertex_normals(result.vertices, faces)[faces],
        source_face=np.arange(len(faces)),
        weights=np.broadcast_to(np.eye(3), (len(faces), 3, 3)),
        size=(picture.shape[1], picture.shape[0]),
        picture=None if look.source is None else picture,
        repeats=True,
    )


def torus_picture(result: TorusMap, look: Look) -> Bytes:
    """Return the picture of a flat torus: the one asked for, or circles in the size that they would have.

    Raises:
        OmtwarpError: an option or a pattern of textures on the sphere.
    """
    if (look.projection, look.atlas, look.rotate) != ("equirectangular", "cube", None):
        raise OmtwarpError("projection, atlas and rotation are for textures on the sphere: leave them out")
    image, pattern = (None, None) if look.source is None else look.given
    if isinstance(pattern, Pattern):
        raise OmtwarpError("a Pattern is for the sphere: a torus takes circles, checker or a picture that repeats")
    return texture_torus(result, image, pattern, look.size).image


def combinations(points: Floats, corners: Floats) -> Floats:
    """Return the matrix of points in triangles as combinations of their corners.

    Args:
        points: shape [T, 3, 3], three points for each triangle.
        corners: shape [T, 3, 3].

    Returns:
        Shape [T, 3, 3]: a row for each point, which sums to 1.
    """
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    square = np.maximum((normal * normal).sum(axis=1), TINY)[:, None]
    to = points - corners[:, None, 0]
    v = np.einsum("tij,tj->ti", np.cross(to, e2[:, None, :]), normal) / square
    w = np.einsum("tij,tj->ti", np.cross(e1[:, None, :], to), normal) / square
    v, w = np.clip(v, 0.0, 1.0), np.clip(w, 0.0, 1.0)
    return np.stack([1.0 - v - w, v, w], axis=2)
