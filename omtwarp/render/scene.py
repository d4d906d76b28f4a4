"""A surface with one appearance, in the form that the renderers take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.colors import colormap_table, parse_color
from omtwarp.errors import OmtwarpError
from omtwarp.mesh import arrays
from omtwarp.mesh.arrays import Bytes, Floats, Ints, cross, marked, normalised, norms, real_numbers, whole_numbers
from omtwarp.render.camera import Light, Shot
from omtwarp.texturing.image import PictureLike, as_bytes, read_image


@dataclass(eq=False)
class ScalarField:
    """A number per vertex or per face, shown through a colour map.

    Attributes:
        values: shape [V] or [F]; NaN is drawn grey.
        colormap: name of the colour map, see :func:`omtwarp.colors.colormap_table`.
        range: (low, high) values at the ends of the map; None takes the smallest and largest finite value.
        label: text at the colour bar.
        logarithmic: colours follow the logarithm of the values, as ratios want it; the range must be positive.
    """

    values: ArrayLike
    colormap: str = "viridis"
    range: tuple[float, float] | None = None
    label: str = ""
    logarithmic: bool = False

    def limits(self) -> tuple[float, float]:
        """Return the two values that the ends of the colour map stand for.

        Raises:
            OmtwarpError: there is no finite value, the range is empty, or a logarithmic range is not positive.
        """
        part = 1e-3  # by which the range of a constant is widened both ways, relative to it
        values = numbers_of(self.values, "the scalar")
        if self.range is None:
            shown = values[np.isfinite(values) & (values > 0)] if self.logarithmic else values[np.isfinite(values)]
            if shown.size == 0:
                kind = "positive finite" if self.logarithmic else "finite"
                raise OmtwarpError(f"the scalar has no {kind} value among {values.size}: there is nothing to colour")
            low, high = float(shown.min()), float(shown.max())
            if low == high:  # a constant sits in the middle of the map
                step = abs(low) * part or part
                low, high = (low / (1 + part), high * (1 + part)) if self.logarithmic else (low - step, high + step)
        else:
            low, high = real_numbers(self.range, "the scalar range", (2,), finite=False).tolist()
        if not (np.isfinite(low) and np.isfinite(high) and low < high) or (self.logarithmic and low <= 0):
            kind = "0 < low < high" if self.logarithmic else "low < high"
            raise OmtwarpError(f"the scalar range ({low:g}, {high:g}) must have {kind}")
        return low, high

    def normalised(self) -> Floats:
        """Scale values to [0, 1] between the limits of the colour map; NaN stays."""
        low, high = self.limits()
        values = numbers_of(self.values, "the scalar")
        if self.logarithmic:
            with np.errstate(divide="ignore", invalid="ignore"):
                values = np.log(values)
            low, high = np.log(low), np.log(high)
        return np.clip((values - low) / (high - low), 0.0, 1.0)


def numbers_of(values: ArrayLike, name: str) -> Floats:
    """Return values to be drawn as float64; truth values count as 0 and 1.

    Args:
        values: an array of any shape.
        name: what to call it in a message.

    Raises:
        OmtwarpError: the values are complex, text or objects.
    """
    return real_numbers(values, name, None, finite=False, truths=True)


@dataclass(eq=False)
class Arrows:
    """A vector field on a surface.

    Attributes:
        vectors: shape [V, 3] at the vertices or [F, 3] at the centres of the faces, in the surface's units.
        count: about how many arrows to draw; they are thinned out evenly over the surface.
        color: any colour.
        length: length of the longest arrow as a part of the surface's radius.
        uniform: draw all arrows equally long, to show directions alone.
    """

    vectors: ArrayLike
    count: int = 350
    color: str | ArrayLike = "#c2183a"
    length: float = 0.16
    uniform: bool = False


@dataclass(frozen=True, eq=False)
class SurfaceMaterial:
    """How the triangles of one material of a surface look.

    Attributes:
        image: a picture as :class:`SurfaceView` takes it, looked up by the surface's ``uv``; None for one colour.
        color: any colour; a factor on the picture where there is one. None is white with a picture, and clay without.
        colors: at the surface's vertices, shape [V, 3], in place of one colour where there is no picture.
    """

    image: PictureLike | None = None
    color: str | ArrayLike | None = None
    colors: ArrayLike | None = None


@dataclass(eq=False)
class SurfaceView:
    """A surface and how it looks: plain, with an image (``sphere`` or ``uv``), ``colors``, a ``scalar``, ``materials``.

    Attributes:
        vertices: shape [V, 3], any unit.
        faces: shape [F, 3], counter-clockwise seen from outside.
        image: a picture, a file, PIL image or [height, width, 3 or 4] bytes (or numbers in [0, 1]); row 0 is its top.
        sphere: unit vectors, shape [V, 3]: the image is equirectangular (longitude atan2(y, x) grows to the right
            from -π, latitude π/2 on top) and looked up anew at every pixel, so that neither seam nor pole shows.
        uv: texture coordinates, shape [V, 2] or per corner [F, 3, 2]; (0, 0) is the image's bottom left; it repeats to
            the right, and upwards where coordinates leave [0, 1] there.
        colors: RGB per vertex [V, 3] or per face [F, 3]; bytes, or numbers in [0, 1].
        scalar: a number per vertex or per face with its colour map.
        color: the colour where nothing else is given (None: clay), and a factor on an image (None: white).
        materials: several appearances, of which ``face_material`` gives every triangle one.
        face_material: number of the material of every triangle, shape [F].
        up: axis that points upwards in pictures; None is guessed from the shape (:mod:`omtwarp.render.subject`).
        front: axis that points at the viewer in the front view; None is guessed where ``up`` is, and otherwise +z, or
            -y where z is up.
        smooth: interpolate normals across faces; they are averaged over all vertices at the same place, so that the
            copies along a texture's seam do not show.
        edges: draw the triangles' edges.
        arrows: a vector field drawn on the surface.
        caption: text under the picture in a sheet.

    Raises:
        OmtwarpError: an array has the wrong shape, an index is out of range, or two appearances are given.
    """

    vertices: ArrayLike
    faces: ArrayLike
    image: PictureLike | None = None
    sphere: ArrayLike | None = None
    uv: ArrayLike | None = None
    colors: ArrayLike | None = None
    scalar: ScalarField | None = None
    color: str | ArrayLike | None = None
    materials: Sequence[SurfaceMaterial] | None = None
    face_material: ArrayLike | None = None
    up: str | None = None
    front: str | None = None
    smooth: bool = True
    edges: bool = False
    arrows: Arrows | None = None
    caption: str = ""

    def __post_init__(self) -> None:
        self.vertices = real_numbers(self.vertices, "vertices", (None, 3))
        self.faces = whole_numbers(self.faces, "faces", (None, 3), below=len(self.vertices)).astype(np.int32)
        if not len(self.faces):
            raise OmtwarpError(f"nothing to draw: {len(self.vertices)} vertices and no faces")
        count, triangles = len(self.vertices), len(self.faces)
        given = [name for name in ("image", "colors", "scalar", "materials") if getattr(self, name) is not None]
        if len(given) > 1:
            raise OmtwarpError(f"a surface has one appearance, but {' and '.join(given)} were given")
        if self.image is not None and (self.sphere is None) == (self.uv is None):
            raise OmtwarpError("an image needs either points on the sphere (sphere=) or texture coordinates (uv=)")
        if self.image is not None:
            self.image = np.ascontiguousarray(as_bytes(read_image(self.image))[..., :3])
        if self.materials is not None:
            which = whole_numbers(self.face_material, "face_material", (triangles,), below=len(self.materials))
            self.face_material = which
        if self.sphere is not None:
            self.sphere = _checked("sphere", self.sphere, [(count, 3)])
            arrays.require_unit_length(self.sphere, "the sphere")
        if self.uv is not None:
            self.uv = _checked("uv", self.uv, [(count, 2), (triangles, 3, 2)])
        if self.colors is not None:
            colors = numbers_of(self.colors, "colors")[..., :3]
            scale = 255.0 if np.issubdtype(np.asarray(self.colors).dtype, np.integer) else 1.0
            self.colors = _checked("colors", np.clip(colors / scale, 0.0, 1.0), [(count, 3), (triangles, 3)])
        if self.scalar is not None:
            if not isinstance(self.scalar, ScalarField):
                self.scalar = ScalarField(self.scalar)
            shape = np.shape(self.scalar.values)
            if shape not in ((count,), (triangles,)):
                raise OmtwarpError(
                    f"a scalar needs a number per vertex ({count}) or per face ({triangles}), not the shape {shape}"
                )


@dataclass(eq=False, kw_only=True)
class Appearance:
    """What triangles look like, by values at vertices [V, C], faces [F, C] or corners [F, 3, C].

    Attributes:
        kind: ``"color"``, ``"uv"`` or ``"sphere"``: what ``value`` means.
        value: an sRGB colour, (u, v), or a point of the sphere.
        image: uint8 [H, W, 3] sRGB for the two looked-up kinds, row 0 on top.
        tint: sRGB factor on the image.
        repeat: the image repeats to the right (sphere, textures) or ends at its border (colour maps).
        repeat_rows: it repeats upwards too.
        mipmaps: average over the area of a pixel; off for colour maps, which hold no picture.
    """

    kind: str
    value: NDArray
    image: Bytes | None = None
    tint: Sequence[float] = (1.0, 1.0, 1.0)
    repeat: bool = True
    repeat_rows: bool = False
    mipmaps: bool = True


@dataclass(eq=False, kw_only=True)
class Part(Appearance):
    """One set of triangles as both renderers take it; picklable, single precision (it only ever becomes pixels).

    Arrays are converted to that; ``value`` becomes float32 [N, 3], with 0 behind u and v.

    Attributes:
        positions: float32 [N, 3], normalised: centred at the origin, farthest point at distance 1.
        normals: float32 [N, 3], unit.
        faces: int32 [F, 3], indices into the N rows.
        edges: draw the triangles' edges; needs N = 3F, corner k of face f in row 3f + k.
    """

    positions: NDArray[np.floating]
    normals: NDArray[np.floating]
    faces: NDArray[np.integer]
    edges: bool = False

    def __post_init__(self) -> None:
        self.value = np.pad(self.value, ((0, 0), (0, 3 - self.value.shape[1])))
        for name in ("positions", "normals", "value"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name), dtype=np.float32))
        self.faces = np.ascontiguousarray(self.faces, dtype=np.int32)


@dataclass(frozen=True)
class Wireframe:
    """Edges drawn over the surface.

    Attributes:
        color: any colour.
        width: pixels.
        opacity: 0 to 1.
    """

    color: str | ArrayLike = "#10151c"
    width: float = 1.1
    opacity: float = 0.75


@dataclass(eq=False)
class RenderJob:
    """Everything a renderer needs for a set of pictures of one scene.

    Attributes:
        parts: triangles, each part with an image of its own or without.
        shots: one per picture.
        width: pixels.
        height: pixels.
        light: the lights.
        samples: samples along each side of a pixel that the renderer takes on top of its own antialiasing.
        wireframe: how edges are drawn, for parts that ask for them.
        one_each: shot k shows part k alone; the parts share one image, the first one's.
    """

    parts: list[Part]
    shots: list[Shot]
    width: int
    height: int
    light: Light
    samples: int = 1
    wireframe: Wireframe = field(default_factory=Wireframe)
    one_each: bool = False


def welded_normals(vertices: Floats, faces: Ints) -> Floats:
    """Return the unit normals per vertex, shape [V, 3], equal at vertices that lie at the same place.

    The weights are those of Max (1999), "Weights for computing vertex normals from facet normals": exact on a mesh
    inscribed in a sphere, and independent of how the surface is cut into triangles elsewhere.
    """
    group, members = weld(vertices)
    ends = vertices[members][group[faces]]
    sides = np.roll(ends, -1, axis=1) - ends
    normal = cross(sides[:, 0], ends[:, 2] - ends[:, 0])
    squares = np.einsum("fkj,fkj->fk", sides, sides)
    weighted = normal[:, None] / np.maximum(squares * np.roll(squares, 1, axis=1), np.finfo(float).tiny)[..., None]
    normals = normalised(arrays.summed(weighted.reshape(-1, 3), group[faces].ravel(), len(members)))
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals[group]


def weld(vertices: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Number the distinct places: the place of every vertex [V], and one vertex of every place."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    new = np.ones(len(vertices), dtype=bool)
    new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    group = np.empty(len(vertices), dtype=np.intp)
    group[order] = np.cumsum(new) - 1
    return group, order[new]


def centred(view: SurfaceView, whole: SurfaceView | None = None) -> Floats:
    """Return the vertices around the origin, the farthest that is drawn at distance 1, shape [V, 3].

    Args:
        view: the surface.
        whole: what it is a part of, whose drawn vertices count; itself by default.
    """
    every, faces = _arrays(whole or view)
    used = every[marked(len(every), faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    centre = low / 2 + high / 2
    extent = max(float((high / 2 - low / 2).max()), np.finfo(float).tiny)
    radius = extent * float(norms((used - centre) / extent).max())
    return (_arrays(view)[0] - centre) / (radius if radius > 0 else 1.0)


def drawn_points(view: SurfaceView) -> Floats:
    """Return the drawn vertices, centred, for framing."""
    vertices, faces = _arrays(view)
    return centred(view)[marked(len(vertices), faces)]


def build_parts(view: SurfaceView, edges: bool = False) -> list[Part]:
    """Convert a surface to the renderers' form: one part, or one for every material that is used."""
    if view.materials is None:
        return [_build_part(view, edges)]
    _, faces = _arrays(view)
    which, parts = np.asarray(view.face_material), []
    for number in np.unique(which):
        material, of_it = view.materials[number], which == number
        image, uv = material.image, view.uv
        if image is None or uv is None:
            image = uv = None
        elif np.ndim(uv) == 3:
            uv = np.asarray(uv)[of_it]
        colors = material.colors if image is None else None
        alone = replace(view, faces=faces[of_it], image=image, uv=uv, materials=None, face_material=None, colors=colors)
        parts.append(_build_part(replace(alone, color=material.color), edges, view))
    return parts


def smooth_parts(face_count: int) -> int:
    """Return the number of parts into which each edge of a mesh is divided to show its map smooth."""
    # Smooth faces, parts that triangles are divided into: at 1024 x 1024 pixels one covers six or so
    # Most parts, that an edge is divided into: with eight, a quarter circle is drawn to 0.5 % of its radius
    return int(np.clip(np.sqrt(150_000 / face_count), 1, 8))


def _build_part(view: SurfaceView, edges: bool = False, whole: SurfaceView | None = None) -> Part:
    """Build a part of a surface in the form that renderers take; ``whole`` is the surface it is a part of.

    Corners are given their own rows only where something differs between the faces around a vertex: per-face colours,
    per-corner coordinates, flat shading, or edges.
    """
    vertices, faces = _arrays(view)
    positions = centred(view, whole)
    look = _look_of(view)
    value = look.value
    normals = welded_normals(positions, _arrays(whole or view)[1]) if view.smooth else None
    of_faces = value.ndim == 2 and len(value) == len(faces) != len(vertices)
    if of_faces or value.ndim == 3 or normals is None or edges:  # every corner gets a row of its own
        flat = faces.ravel()
        if value.ndim == 2:
            value = np.repeat(value, 3, axis=0) if of_faces else value[flat]
        value, positions = value.reshape(len(flat), -1), positions[flat]
        if normals is None:
            a, b, c = (positions[k::3] for k in range(3))
            normals = np.repeat(normalised(cross(b - a, c - a)), 3, axis=0)
        else:
            normals = normals[flat]
        faces = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
    elif look.kind == "sphere" and (parts := smooth_parts(len(faces))) > 1:
        # Between the vertices the image is sampled through the smooth map.
        from omtwarp.texturing.smooth import smooth_map

        divided = smooth_map(vertices, faces, value, parts)
        positions, faces, value = divided.weights @ positions, divided.faces, divided.sphere
        normals = normalised(divided.weights @ normals)
    return Part(positions=positions, normals=normals, faces=faces, edges=edges, **vars(look) | {"value": value})


def _look_of(view: SurfaceView) -> Appearance:
    """Return the appearance of a surface without materials: its image, its scalar, its colours, or one colour."""
    outside = 1e-6  # of a picture's height: coordinates that exceed it by less are rounded, not repeated
    if view.image is not None:
        picture = cast(Bytes, view.image)  # as the view itself has made it
        tint = parse_color("white" if view.color is None else view.color).tolist()
        if view.sphere is not None:
            return Appearance(kind="sphere", value=np.asarray(view.sphere), image=picture, tint=tint)
        value = np.asarray(view.uv)
        # Tiling upwards is rare; without it the top row must not be filtered with the bottom one.
        repeat_rows = bool(value[..., 1].min() < -outside or value[..., 1].max() > 1.0 + outside)
        return Appearance(kind="uv", value=value, image=picture, tint=tint, repeat_rows=repeat_rows)
    if view.scalar is not None:
        image, value = _scalar_lookup(view.scalar)
        return Appearance(kind="uv", value=value, image=image, repeat=False, mipmaps=False)
    if view.colors is not None:
        return Appearance(kind="color", value=np.asarray(view.colors))
    color = parse_color((0.80, 0.79, 0.77) if view.color is None else view.color)  # clay, in sRGB
    return Appearance(kind="color", value=np.broadcast_to(color, (len(_arrays(view)[0]), 3)))


def _arrays(view: SurfaceView) -> tuple[Floats, Ints]:
    return view.vertices, view.faces  # type: ignore[return-value]


def _checked(name: str, values: ArrayLike, shapes: list[tuple[int, ...]]) -> Floats:
    array = numbers_of(values, name)
    if array.shape not in shapes:
        wanted = " or ".join(str(list(shape)) for shape in shapes)
        raise OmtwarpError(f"{name} needs the shape {wanted}, not {list(array.shape)}")
    return real_numbers(array, name, None)


def _scalar_lookup(scalar: ScalarField) -> tuple[Bytes, Floats]:
    """Return the colour map as an image with a grey row for NaN below, and coordinates into it."""
    table = colormap_table(str(scalar.colormap))
    image = np.stack([table, np.full_like(table, 150)])
    t = scalar.normalised()
    missing = np.isnan(t)
    size = len(table)
    u = (np.where(missing, 0.5, t) * (size - 1) + 0.5) / size  # from the middle of the first texel to that of the last
    return image, np.column_stack([u, np.where(missing, 0.25, 0.75)])


def arrow_part(view: SurfaceView, arrows: Arrows) -> Part | None:
    """Convert a field's arrows to the renderers' form; None where the field is zero everywhere.

    Raises:
        OmtwarpError: the field has the wrong shape or a value that is not finite.
    """
    vertices, faces = np.asarray(view.vertices), np.asarray(view.faces)
    vectors = _checked("arrows", arrows.vectors, [(len(vertices), 3), (len(faces), 3)])  # per vertex, or per face
    positions = centred(view)
    normals = welded_normals(positions, faces)
    if len(vectors) != len(vertices):
        positions = positions[faces].mean(axis=1)
        normals = normalised(normals[faces].mean(axis=1))
    lengths = norms(vectors)
    longest = lengths.max(initial=0.0)
    if longest == 0.0:
        return None
    chosen = _thin_out(positions, max(int(arrows.count), 1))
    chosen = chosen[lengths[chosen] > 0.02 * longest]  # shorter ones would be dots
    chosen = chosen if chosen.size else np.array([int(np.argmax(lengths))])
    way = vectors[chosen] / lengths[chosen][:, None]
    size = np.full(len(chosen), arrows.length) if arrows.uniform else arrows.length * lengths[chosen] / longest
    # Lifted off the surface by the shaft's thickness, so that they are not hidden in it.
    feet = positions[chosen] + 0.012 * normals[chosen]
    return _solid_arrows(feet, way, normals[chosen], size, arrows.length, parse_color(arrows.color))


def _thin_out(points: Floats, count: int) -> NDArray[np.intp]:
    """Return the indices of about ``count`` points spread evenly.

    There is one for each occupied cell of a grid of suitable width.
    """
    base = 100_003  # a prime above the number of cells along an axis, which are 4000 at most
    if len(points) <= count:
        return np.arange(len(points))

    def occupied(width: float) -> NDArray[np.intp]:
        cells = np.floor((points + 2.0) / width).astype(np.int64)
        keys = (cells[:, 0] * base + cells[:, 1]) * base + cells[:, 2]
        # Of the points in a cell the one nearest its middle, so that neighbours keep their distance.
        offset = np.abs((points + 2.0) / width - cells - 0.5).max(axis=1)
        order = np.lexsort((offset, keys))
        return order[np.unique(keys[order], return_index=True)[1]]

    # Of the width of cells in radii: 2000 to 1 in powers of two, to 0.003 %
    narrow, wide = 1e-3, 2.0
    for _ in range(18):
        middle = np.sqrt(narrow * wide)
        narrow, wide = (middle, wide) if len(occupied(middle)) > count else (narrow, middle)
    return np.sort(occupied(wide))


def _solid_arrows(feet: Floats, way: Floats, normal: Floats, size: Floats, longest: float, color: Floats) -> Part:
    """Return a round shaft and a cone for every arrow."""
    from trimesh import creation

    sides = 8  # of an arrow's shaft and head: at the size of an arrow, corners are invisible
    across = 1e-6  # sine: an arrow that stands on the surface at right angles to within this takes another side
    side = cross(normal, way)
    weak = norms(side) < across
    side[weak] = cross(way[weak], np.eye(3)[np.argmin(np.abs(way[weak]), axis=1)])
    side = normalised(side)
    over = cross(way, side)
    # Thickness grows with the square root of the length: short arrows stay visible, long ones slim.
    thick = 0.045 * longest * np.sqrt(size / longest)
    head = np.minimum(0.45 * size, 5.5 * thick)
    frames = np.stack([side, over, way], axis=1)
    shaft, cone = creation.cylinder(1.0, 1.0, sections=sides), creation.cone(1.0, 1.0, sections=sides)
    shaft.apply_translation([0.0, 0.0, 0.5])
    places, facings = [], []
    for solid, radius, start, height in (
        (shaft, thick, 0.0 * size, size - head),
        (cone, 2.4 * thick, size - head, head),
    ):
        stretch, shift = np.stack([radius, radius, height], axis=1)[:, None], start[:, None, None] * way[:, None]
        places.append(feet[:, None] + shift + (solid.triangles.reshape(-1, 3) * stretch) @ frames)
        facings.append(normalised(np.repeat(solid.face_normals, 3, axis=0) / stretch) @ frames)
    positions, normals = (np.concatenate(parts, axis=1).reshape(-1, 3) for parts in (places, facings))
    faces = np.arange(len(positions)).reshape(-1, 3)
    value = np.broadcast_to(color, positions.shape)
    return Part(positions=positions, normals=normals, faces=faces, kind="color", value=value)
