"""A surface with a texture, from its map to the sphere."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.errors import OmtwarpError, check_word, truth
from omtwarp.files.output import as_path
from omtwarp.maps.domains import is_torus_map
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Bytes, Floats, Ints, SphereMap, real_number, real_numbers
from omtwarp.mesh.surface import as_faces, as_unit_vectors, unit_normals, vertex_normals
from omtwarp.options import AtlasLike, PatternLike, ProjectionLike, ProjectionName
from omtwarp.texturing import atlas as layouts, image as pictures
from omtwarp.texturing.adaptive import BentLook, bake_bytes
from omtwarp.texturing.atlas import Equirectangular
from omtwarp.texturing.bakes import least_visible_meridian
from omtwarp.texturing.baking import Look, sample
from omtwarp.texturing.export import Material
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.painted import PaintedMesh, SphereLayout
from omtwarp.texturing.patterns import Pattern, pattern as by_name
from omtwarp.texturing.seams import unwrap
from omtwarp.texturing.smooth import smooth_curves

MapLike: TypeAlias = SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike]
"""A surface and its map, in any of the forms that public functions take."""


def texture(
    result: SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike],
    image: PictureLike | None = None,
    *,
    pattern: PatternLike | Pattern | None = None,
    projection: ProjectionLike = "equirectangular",
    atlas: AtlasLike = "cube",
    rotate: ArrayLike | str | None = None,
    seam_longitude: float | str = 180.0,
    size: int | tuple[int, int] | str | None = None,
    smooth: bool = True,
    device: str | None = "auto",
) -> PaintedMesh:
    """Texture a surface through its map to the sphere (section 5 of the paper).

    Args:
        result: a :class:`~omtwarp.MapResult`, anything with ``vertices``, ``faces`` and ``sphere``, or the three
            as a tuple. The texture of a map to a torus repeats both ways.
        image: a path, a PIL image or an array [H, W, 3]; its left and right borders are longitude -180 and 180 degrees,
            its top is the north pole (+z).
        pattern: ``circles``, ``puzzle``, ``globe`` or ``checker``, or a
            :class:`~omtwarp.texturing.patterns.Pattern`.
            With neither image nor pattern: circles of equal size, which show at a glance whether areas are preserved.
        projection: of the image: ``equirectangular``, or ``sinusoidal`` for the paper's correction of the longitude by
            cos(latitude), for pictures that were not made for a sphere.
        atlas: layout of the texture: ``cube`` (six charts, sharp everywhere), ``octahedral`` (one square), or
            ``equirectangular``, which keeps an equirectangular image as it is, to the byte, but is blurred next to the
            poles by viewers without anisotropic filtering.
        rotate: turns the texture on the sphere: yaw, or yaw, pitch and roll in degrees, or a rotation matrix [3, 3];
            ``auto`` turns it about the poles so that its left and right borders are least visible.
        seam_longitude: degrees (of the texture) at which the equirectangular atlas is cut, 180 being the image's own
            borders; ``auto`` takes the meridian that is shortest and most hidden on the surface.
        size: width of the texture in texels, or (width, height) for the equirectangular and the cube atlas. A cube
            atlas of a width that is a power of two is a square, of another one 3 : 2; (width, width / 2) works too.
            ``auto`` takes the least power of two, up to 8192, at which no texel covers more than 1.5 pixels of a
            picture of 1024 x 1024 that the surface fills. By default one with about as many texels as the image, or
            for a pattern that of ``auto``, up to 4096.
        smooth: make the map smooth between the vertices, and filter oscillations from one vertex to the next, so that
            lines of the texture have no corners at the edges of large triangles. The texture is then made for this mesh
            alone, and its lines in the picture are bent. False leaves the map linear on triangles; so does an image
            that is kept to the byte.
        device: ``auto``, ``cpu`` or ``cuda:N``, for the baking.

    Returns:
        The textured surface; ``.export("name.glb")`` writes it.

    Raises:
        OmtwarpError: an unusable image, map or option.

    Example:
        >>> import omtwarp
        >>> result = omtwarp.map_to_sphere(omtwarp.shapes.blob(seed=3, sphere=320), until="conformal", device="cpu")
        >>> textured = omtwarp.texture(result, pattern="checker", size=128)
        >>> [path.name for path in textured.export("checker.glb")]
        ['checker.glb']
    """
    if image is not None and pattern is not None:
        raise OmtwarpError("both an image and a pattern were given: a texture is made from one of them")
    if is_torus_map(result):
        if isinstance(size, (str, tuple)):
            raise OmtwarpError(f"texture size '{size}': a map to a torus takes a width in texels")
        if (projection, atlas, rotate, seam_longitude) != ("equirectangular", "cube", None, 180.0):
            raise OmtwarpError("projection, atlas, rotation and seam are for textures on the sphere: leave them out")
        return texture_torus(result, image, pattern, layouts.width_of(size))
    vertices, faces, sphere = as_map(result)
    check_projection(projection, image)
    rotation = _rotation(rotate, vertices, faces, sphere)
    seam = _seam(seam_longitude, atlas, vertices, faces, sphere @ rotation)
    picture = None if image is None else pictures.read_image(image)
    if isinstance(size, str) or size is None:
        size = _chosen_size(size, picture, atlas, vertices, faces, sphere)
    source = by_name(pattern or "circles") if picture is None else picture
    layout, texels = layouts.make_atlas(atlas, size, seam=seam), None
    if isinstance(layout, Equirectangular) and projection == "equirectangular" and picture is not None:
        if picture.shape[:2] == (layout.height, layout.width):
            # A seam that is moved by whole columns shifts the picture by as many, its bytes unchanged.
            columns = round((seam - np.pi) / (2.0 * np.pi) * layout.width)
            layout = Equirectangular(layout.width, layout.height, np.pi + 2.0 * np.pi * columns / layout.width)
            texels = np.roll(pictures.as_bytes(picture), -columns, axis=1)
    # Where a line turns by a quarter of a radian at an edge, and the next is 12 texels on, a smooth curve lies within
    # 0.25 x 12 / 8 of a texel of it: smaller triangles need none.
    bends = truth(smooth, "smooth") and np.sqrt(layout.row_lengths.sum() / len(faces)) >= 12.0
    # NumPy and kernels let go of the interpreter in long operations: two threads take two thirds of the time of one.
    with ThreadPoolExecutor(1) as aside:
        cutting = aside.submit(unwrap, sphere, faces, layout, rotation=rotation)
        if texels is None:
            where = resolve_device(device)
            look = Look(layout, where)
            if bends:
                look = BentLook(smooth_curves(vertices, faces, sphere), layout, cutting, rotation, where)
            texels = bake_bytes(source, look, projection=projection)
        cut = cutting.result()
    sampled = partial(sample, directions=sphere @ rotation, atlas=layout, device="cpu")
    materials = (Material("texture", picture=np.ascontiguousarray(pictures.without_full_opacity(texels))),)
    made = PaintedMesh(cut.weights @ vertices, cut.faces, cut.uv, materials, wraps=layout.wraps, wraps_rows=False)
    normals = unit_normals(cut.weights @ vertex_normals(vertices, faces))
    whole = SphereLayout(cut, layout, rotation, vertices, faces, sampled)
    return replace(made, source_files=_named(image), normals=normals, layout=whole)


def check_projection(projection: str, image: object) -> None:
    """Refuse a projection that pictures have not, and one without a picture.

    Args:
        projection: as of :func:`texture`.
        image: the picture, in any form; None for none.

    Raises:
        OmtwarpError: the projection cannot be taken.
    """
    check_word("projection", projection, ProjectionName)
    if image is None and projection != "equirectangular":
        raise OmtwarpError(f"projection='{projection}' is for an image, and none is given: leave it out")


def _chosen_size(
    asked: str | None, picture: NDArray | None, atlas: AtlasLike, vertices: Floats, faces: Ints, sphere: Floats
) -> int | tuple[int, int] | None:
    """Return the size of a texture where none is given in texels: that of the picture, or one that looks sharp.

    Raises:
        OmtwarpError: neither a number nor ``auto`` was given.
    """
    if asked is None and picture is not None:
        return _natural_size(picture, atlas)
    if asked not in (None, "auto"):
        raise OmtwarpError(f"texture size '{asked}': give texels, or auto")
    # Larger where that is asked for than where nothing was said
    limit = layouts.LARGEST_UNASKED if asked is None else layouts.LARGEST_SIZE
    return layouts.sharp_size(vertices, faces, sphere, layouts.make_atlas(atlas).name, limit)[0]


def texture_torus(
    result: MapResult, image: PictureLike | None, pattern: str | Pattern | None, size: int | None = None
) -> PaintedMesh:
    """Texture a surface with a picture that closes up both ways on its torus, cut where the coordinates jump."""
    if image is None:
        picture = torus_pattern(str(pattern or "circles"), result.lattice, size)
    else:
        picture = pictures.as_bytes(pictures.read_image(image))
        if size is not None:
            picture = pictures.resized(picture, size, max(round(size * picture.shape[0] / picture.shape[1]), 1))
    coordinates, wraps, faces = result.coordinates, result.wraps, result.faces
    whole = wraps - np.floor((coordinates[faces] + wraps).min(axis=1, keepdims=True))
    materials, files = (Material("texture", picture=picture),), _named(image)
    return PaintedMesh(result.vertices, faces, coordinates[faces] + whole, materials, source_files=files)


def _named(image: PictureLike | None) -> tuple[Path, ...]:
    """Return the file of a picture that is given by its name."""
    return (as_path(image),) if isinstance(image, str | os.PathLike) else ()


def torus_pattern(name: str, lattice: Floats, size: int | None = None) -> Bytes:
    """Return a picture of a flat torus: u to the right along the first lattice vector, v upwards along the second.

    Args:
        name: ``circles``, all of one size and round on the torus, or ``checker``.
        lattice: the two vectors, as rows, shape [2, 2].
        size: width in texels; by default such that the picture has about two million. Where the width is a power of
            two, as by default, the height is the nearest one too.

    Returns:
        uint8, shape [H, W, 3].

    Raises:
        OmtwarpError: another pattern, or a size that is too large.
    """
    if name not in ("circles", "checker"):
        raise OmtwarpError(f"the pattern '{name}' is for the sphere: a torus takes circles or checker")
    along = np.linalg.norm(lattice, axis=1)
    ratio = float(along[1] / along[0])
    # Texels, of a pattern, as many as a pattern 2048 wide has on the sphere
    wide = _nearest_power(np.sqrt((1 << 21) / ratio)) if size is None else size
    high = _nearest_power(wide * ratio) if wide.bit_count() == 1 else round(wide * ratio)
    width, height = layouts.check_size((max(wide, 16), max(high, 16)))
    u = (np.arange(width) + 0.5) / width
    v = 1.0 - (np.arange(height) + 0.5) / height
    tint = np.stack([0.33 + 0.22 * np.cos(2.0 * np.pi * v[:, None] + shift) for shift in (0.4, -1.9, 2.6)], axis=-1)
    share = _checks(lattice, u, v) if name == "checker" else _circles(lattice, u, v)
    light = np.array([0.96, 0.94, 0.90])  # sRGB between the circles, and of every other field
    return np.rint(255.0 * (light + share[..., None] * (tint - light))).astype(np.uint8)


def _nearest_power(number: float) -> int:
    """Return the power of two whose ratio to a positive number is nearest to 1."""
    return 2 ** max(round(float(np.log2(number))), 0)


def _checks(lattice: Floats, u: Floats, v: Floats) -> Floats:
    """Draw a checker: 1 on its dark cells, which are as nearly square as even numbers allow, shape [H, W]."""
    checks = 6  # fields along the shorter lattice vector, an even number so that the picture closes up
    along = np.linalg.norm(lattice, axis=1)
    columns, rows = (max(2, 2 * round(checks / 2 * float(side / along.min()))) for side in along)
    return ((np.floor(rows * v)[:, None] + np.floor(columns * u)[None, :]) % 2.0).astype(np.float64)


def _circles(lattice: Floats, u: Floats, v: Floats) -> Floats:
    """Draw circles: 1 inside, 0 outside and between the two at their rims, shape [H, W]."""
    area = abs(float(np.linalg.det(lattice)))
    first = float(np.linalg.norm(lattice[0]))
    # Circles, as many as the sphere's pattern has
    apart = np.sqrt(2.0 / np.sqrt(3.0) * area / 162)
    columns = max(1, round(first / apart))
    rows = max(2, 2 * round(area / first / (apart * np.sqrt(3.0) / 2.0) / 2.0))
    offsets = np.array([(j, i) for j in range(-2, 3) for i in np.arange(-2.0, 2.5, 0.5)])
    offsets = offsets[(offsets[:, 1] % 1.0 == 0.5) == (offsets[:, 0] % 2.0 == 1.0)]
    steps = np.stack([offsets[:, 1] / columns, offsets[:, 0] / rows], axis=1) @ lattice
    lengths = np.linalg.norm(steps, axis=1)
    least = float(lengths[lengths > 0.0].min())
    # Coverage: the share of the torus that circles cover
    radius = min(float(np.sqrt(0.56 * area / (columns * rows * np.pi))), 0.46 * least)
    texel = np.sqrt(area / (len(u) * len(v)))
    nearest = np.full((len(v), len(u)), np.inf)
    row = np.round(v * rows)
    for shift in range(-1, 2):
        j = row + shift
        half = 0.5 * (j % 2.0)
        for more in range(-1, 2):
            i = np.round(u[None, :] * columns - half[:, None]) + half[:, None] + more
            du, dv = u[None, :] - i / columns, (v - j / rows)[:, None]
            x, y = du * lattice[0, 0] + dv * lattice[1, 0], du * lattice[0, 1] + dv * lattice[1, 1]
            np.minimum(nearest, np.hypot(x, y), out=nearest)
    return np.clip(0.5 + (radius - nearest) / texel, 0.0, 1.0)


def _rotation(rotate: ArrayLike | str | None, vertices: Floats, faces: Ints, sphere: Floats) -> Floats:
    """Return the matrix of the texture's rotation.

    ``auto`` turns its left and right borders, at longitude 180 degrees, to the least visible meridian.
    """
    if not isinstance(rotate, str):
        return pictures.rotation_matrix(rotate)
    if rotate != "auto":
        raise OmtwarpError(f"rotate '{rotate}': give degrees, a matrix, or auto")
    return pictures.rotation_matrix(np.rad2deg(least_visible_meridian(vertices, faces, sphere)) - 180.0)


def as_map(result: SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike]) -> tuple[Floats, Ints, Floats]:
    """Return the vertices [V, 3], faces [F, 3] and unit vectors [V, 3] of a map in any of its forms.

    Raises:
        OmtwarpError: the argument is no map, or some of its points are off the unit sphere.
    """
    parts: tuple[ArrayLike, ...]
    if isinstance(result, (tuple, list)) and len(result) == 3:
        parts = tuple(result)
    else:
        try:
            parts = (result.vertices, result.faces, result.sphere)  # type: ignore[union-attr]
        except AttributeError as error:
            if isinstance(error, OmtwarpError):
                raise  # it is a map, to another domain
            raise OmtwarpError(
                f"cannot use a {type(result).__name__}: give a result of map_to_sphere, or vertices, faces and sphere"
            ) from error
    vertices = real_numbers(parts[0], "vertices", (None, 3))
    return vertices, as_faces(parts[1], len(vertices)), as_unit_vectors(parts[2], len(vertices))


def _seam(given: float | str, atlas: str, vertices: Floats, faces: Ints, sphere: Floats) -> float:
    """Return the longitude of the seam in radians, pi for an atlas without one."""
    if str(atlas) != "equirectangular" and given != 180.0:
        raise OmtwarpError("a seam is for the equirectangular atlas: take that, or leave the seam out")
    if isinstance(given, str):
        if given != "auto":
            raise OmtwarpError(f"seam longitude '{given}': give degrees, or auto")
        return least_visible_meridian(vertices, faces, sphere)
    degrees = (real_number(given, "seam longitude in degrees, or auto") + 180.0) % 360.0 - 180.0
    return np.pi if degrees in (-180.0, 180.0) else float(np.deg2rad(degrees))


def spheres_of(result: object) -> NDArray[np.intp] | None:
    """Return the number of every face's sphere, shape [F], where each part of a map has one of its own; else None."""
    part = getattr(result, "part", None)
    if part is None or getattr(result, "cap_centres", None) is not None:
        return None
    distinct, number = np.unique(part, return_inverse=True)
    return number if len(distinct) > 1 else None


def domains_of(result: object, count: int) -> NDArray[np.intp]:
    """Return the number of the domain that every face has, shape [F]: zeros, but with parts that have one each."""
    number = spheres_of(result)
    return np.zeros(count, dtype=np.intp) if number is None else number


def _natural_size(picture: NDArray, atlas: str) -> int | tuple[int, int] | None:
    """Return the size of a texture whose texels are about as large as those of the image."""
    # Of the picture's width. Octahedral textures then have as many texels, 0.56 widths squared beside 0.5; three cells
    # of a cube map without their gutters as many along the equator as three quarters of the picture.
    share = 0.75 if atlas == "octahedral" else 0.75 * 12.0 / 11.0
    height, width = picture.shape[:2]
    if atlas == "equirectangular":
        return (width, height) if min(width, height) >= 16 else (max(width, 64), max(height, 32))
    # Most side, texels of a picture's own size: what browsers and game engines load (WebGL 2)
    return layouts.picture_size(share * width, atlas, 16384)[0]
