"""A surface's pattern, materials and bakes on the texture coordinates of its mesh, or on an atlas."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError, OmtwarpWarning, check_word, naming
from omtwarp.files.output import as_path
from omtwarp.maps.domains import is_torus_map
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, Ints, SphereMap, listed, real_number
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.polygons import grid_shares, grid_triangles
from omtwarp.mesh.surface import MeshLike, as_triangles, plane_areas, triangle_areas, vertex_normals
from omtwarp.options import AtlasLike, CoordinatesLike, KeepLike, PatternLike, ProjectionLike
from omtwarp.texturing import bakes, baking, image as pictures
from omtwarp.texturing.atlas import SIZE, check_size, make_atlas, width_of
from omtwarp.texturing.baking import PADDING, Picture, Source
from omtwarp.texturing.export import WHITE, Material, corner_tangents
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.painted import PaintedMesh, as_painted
from omtwarp.texturing.patterns import Pattern, pattern as by_name
from omtwarp.texturing.seams import shares_of_corners
from omtwarp.texturing.smooth import smooth_map
from omtwarp.texturing.textured import MapLike, as_map, check_projection, spheres_of, texture
from omtwarp.texturing.unwrap import pack_rows


def paint(
    result: SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike],
    mesh: PaintedMesh | None = None,
    image: PictureLike | None = None,
    *,
    pattern: PatternLike | Pattern | None = None,
    uv: CoordinatesLike = "own",
    keep: KeepLike | None = None,
    opacity: float | None = None,
    bake: Sequence[str | os.PathLike[str]] = (),
    detail: MeshLike | None = None,
    projection: ProjectionLike = "equirectangular",
    atlas: AtlasLike = "cube",
    rotate: ArrayLike | str | None = None,
    size: int | None = None,
    device: str | None = "auto",
) -> PaintedMesh:
    """Texture a mesh through its map in its own texture coordinates, over or under its own materials, with bakes.

    A map to a torus takes ``circles``, ``checker`` or a picture that repeats both ways, as for :func:`omtwarp.texture`.
    Of parts with a sphere each, the atlases lie side by side on one square picture, in proportion to the parts' areas.

    With own coordinates every material of the mesh keeps its name and properties and gets a picture of its own; with an
    atlas, all materials share one picture. Coordinates outside [0, 1] repeat the picture. Where triangles overlap on
    the picture, as mirrored halves do, the first one gets the texel, and a warning says for which share of the picture.

    Args:
        result: a :class:`~omtwarp.MapResult`, anything with ``vertices``, ``faces`` and
            ``sphere``, or the three as a tuple.
        mesh: the mesh that was mapped, with coordinates and materials (:func:`omtwarp.read_painted_mesh`); needed for
            own coordinates and for ``keep``.
        image: an equirectangular picture, as :func:`omtwarp.texture` takes it.
        pattern: a pattern, as :func:`omtwarp.texture` takes it. With neither, and nothing to bake: circles.
        uv: ``own`` or ``atlas``.
        keep: ``over`` lays the pattern over the mesh's materials, ``under`` the materials over the pattern; None leaves
            the materials' colours out. The layers are put together by Porter and Duff's "over" in linear light.
        opacity: with ``keep``, of the upper layer, from 0 to 1, times its own; 0.5 by default.
        bake: ``normal``, ``ao``, ``curvature``, ``area``, or files of numbers at the vertices. Ambient occlusion goes
            to the material's occlusion; normals of ``detail`` to its normal map, in tangent space; curvature (of the
            mean, 1 / length unit), area (on the sphere over that on the surface) and data become the colour, through a
            colour map, and so do normals without ``detail``, in the mesh's axes. Only one bake may become the colour.
        detail: a finer mesh of the same surface in the same place, for ``normal``: (vertices, faces), or anything that
            has both; one that lies elsewhere is warned of.
        projection: of the image, as in :func:`omtwarp.texture`.
        atlas: which one, as in :func:`omtwarp.texture`, without own coordinates.
        rotate: turns the pattern on the sphere, as in :func:`omtwarp.texture`.
        size: width of the pictures in texels; by default that of the material's own picture, times a whole number so
            that a small one has up to 2048; or 2048.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Returns:
        The mesh with its materials; ``.export("name.glb")`` writes it.

    Raises:
        OmtwarpError: no texture coordinates, another mesh than the one that was mapped, an unknown option, or more than
            one bake that would be the colour.

    Example:
        >>> import numpy as np, omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> result = omtwarp.map_to_sphere(surface, until="conformal", device="cpu")
        >>> mesh = omtwarp.unwrap_uv(result)
        >>> painted = omtwarp.paint(result, mesh, pattern="checker", bake=["ao"], size=128)
        >>> painted.materials[0].picture.shape, painted.materials[0].occlusion_picture is None
        ((128, 128, 3), False)
    """
    if image is not None and pattern is not None:
        raise OmtwarpError("both an image and a pattern were given: a texture is made from one of them")
    check_options(uv, keep, opacity, atlas)
    check_projection(projection, image)
    if mesh is None and (uv == "own" or keep is not None):
        raise OmtwarpError("own texture coordinates and materials are kept from a mesh: give the one that was mapped")
    torus = result if is_torus_map(result) else None
    if torus is not None:
        vertices, faces, sphere, parts = torus.vertices, torus.faces, torus.vertices, None
        on_map = plane_areas(torus.corners @ torus.lattice)
    else:
        vertices, faces, sphere = as_map(result)
        parts, on_map = spheres_of(result), triangle_areas(sphere, faces)
    bakes_given = [bake] if isinstance(bake, str | os.PathLike) else listed(bake, "bake", "names of bakes and files")
    names = tuple(str(as_path(name)) for name in bakes_given)
    color = color_among(names, detail is not None, pattern, image, keep)
    if image is None and pattern is None and (keep is not None or not names):
        pattern = "circles"
    fine = None if detail is None else _in_place(detail, vertices)
    size = width_of(size)
    stored = result if isinstance(result, MapResult) else None
    origins, structure = (None, None) if stored is None else (stored.origins, stored.report.get("structure"))
    painting = _Painting(
        vertices, faces, sphere, torus, parts, on_map, origins, structure,
        None if mesh is None else as_painted(mesh).on(vertices, faces, origins=origins),
        keep, 0.5 if opacity is None else opacity, names, color, fine,
        image, pattern, projection, atlas, rotate, size, resolve_device(device),
    )  # fmt: skip
    return painting.on_own_coordinates() if uv == "own" else painting.on_atlas()


def _in_place(detail: MeshLike, vertices: Floats) -> tuple[Floats, Ints]:
    """Return vertices and faces of a detailed mesh; warn where it is elsewhere than a coarser one's vertices.

    Raises:
        OmtwarpError: the detail is no mesh.
    """
    from scipy.spatial import cKDTree

    with naming("detail"):
        fine = as_triangles(detail)
    apart = float(cKDTree(fine[0]).query(vertices)[0].mean() / np.ptp(vertices, axis=0).max())
    if apart > 0.1:
        text = f"the detail lies elsewhere, {apart:.1f} times the mesh's size away: give both the same units and axes"
        warnings.warn(text, OmtwarpWarning, stacklevel=3)
    return fine


def check_options(uv: str, keep: str | None, opacity: float | None, atlas: str) -> None:
    """Refuse values that the options of :func:`paint` have not, and options without effect.

    Raises:
        OmtwarpError: an option cannot be taken.
    """
    check_word("texture coordinates", uv, ("own", "atlas"))
    check_word("way to keep materials", keep or "under", ("over", "under"))
    if opacity is not None and not 0.0 <= real_number(opacity, "opacity") <= 1.0:
        raise OmtwarpError(f"the opacity is {opacity}: give a number from 0 to 1")
    if opacity is not None and keep is None:
        raise OmtwarpError("an opacity is for materials that are kept: keep them, or leave the opacity out")
    if uv == "own" and atlas != "cube":
        raise OmtwarpError("an atlas is for new texture coordinates: leave it out, or the mesh's own")


def color_among(names: Sequence[str], detailed: bool, pattern: object, image: object, keep: object) -> str | None:
    """Return the bake that becomes the colour, if any.

    Args:
        names: of the bakes that were asked for.
        detailed: whether normals are those of a finer mesh.
        pattern, image, keep: what else becomes the colour, as :func:`paint` takes it; None for none.

    Raises:
        OmtwarpError: the bakes do not go together.
    """
    if detailed and "normal" not in names:
        raise OmtwarpError("a detailed mesh is given, and no normals are baked: add bake=['normal']")
    colors = [name for name in names if name != "ao" and not (name == "normal" and detailed)]
    if len(colors) > 1:
        raise OmtwarpError(f"{' and '.join(colors)} would both be the colour: bake one at a time")
    others = {"the pattern": pattern, "the picture": image, "the materials that are kept, with a pattern,": keep}
    other = next((other for other, given in others.items() if given is not None), None)
    if colors and other:
        raise OmtwarpError(f"{colors[0]} and {other} would both be the colour: leave one out")
    return colors[0] if colors else None


@dataclass(frozen=True)
class _Sheet:
    """A surface on one picture.

    Attributes:
        mesh: with one material.
        source_face: triangle of the surface that each of the mesh is, or is a part of, shape [K].
        weights: the corners as combinations of that triangle's corners, shape [K, 3, 3]; None where they are the same.
    """

    mesh: PaintedMesh
    source_face: NDArray
    weights: Floats | None


def _sheet(made: PaintedMesh) -> _Sheet:
    """Return a textured surface as a sheet."""
    if made.layout is None:
        return _Sheet(made, np.arange(len(made.faces)), None)
    cut = made.layout.cut
    return _Sheet(made, cut.source_face, shares_of_corners(cut, made.layout.faces))


@dataclass
class _Painting:
    """The surface that is painted, with its map, and how.

    Attributes:
        vertices, faces: the surface, shapes [V, 3] and [F, 3].
        sphere: its map to the sphere, shape [V, 3], unless it goes to a torus.
        torus: its map to a torus, or None.
        parts: the sphere of every triangle where there are several, shape [F].
        on_map: areas of the triangles' images, shape [F].
        origins: what the surface's vertices are in the input, where they are not its own.
        structure: the part of the brain that the surface is, where its file said it.
        own: the mesh with the coordinates and materials that it has, or None.
        keep, opacity: how the materials are kept.
        names: of the bakes.
        color: the bake that becomes the colour, if any.
        detail: vertices and faces of a finer mesh.
        image, pattern: what is drawn; None for bakes alone.
        projection, atlas, rotate, size: of the texture, as :func:`omtwarp.texture` takes them.
        where: the device.
    """

    vertices: Floats
    faces: Ints
    sphere: Floats
    torus: MapResult | None
    parts: NDArray[np.intp] | None
    on_map: Floats
    origins: Origins | None
    structure: str | None
    own: PaintedMesh | None
    keep: str | None
    opacity: float
    names: tuple[str, ...]
    color: str | None
    detail: tuple[Floats, Ints] | None
    image: PictureLike | None
    pattern: PatternLike | Pattern | None
    projection: ProjectionLike
    atlas: AtlasLike
    rotate: ArrayLike | str | None
    size: int | None
    where: wp.Device

    @property
    def drawn(self) -> bool:
        """Whether there is a picture or a pattern."""
        return self.image is not None or self.pattern is not None

    def on_own_coordinates(self) -> PaintedMesh:
        """Paint the mesh's materials in the coordinates that it has."""
        assert self.own is not None  # checked before
        mesh = self.own
        which, tiled = baking.tiled_copies(mesh.require_uv())
        if self.rotate is not None and not self.drawn:
            raise OmtwarpError("rotate turns pictures and patterns, and none is drawn on own coordinates: leave it out")
        if isinstance(self.rotate, str):
            raise OmtwarpError(f"rotate '{self.rotate}': give degrees or a matrix for own texture coordinates")
        tangents = self._tangents(mesh)
        draw = self._drawn() if self.drawn else None
        materials = []
        doubled = 0.0
        for number, material in enumerate(mesh.materials):
            mine = np.flatnonzero(mesh.material_of[which] == number)
            if not len(mine):
                materials.append(material)
                continue
            extent = _extent(material, self.size)
            color = None if draw is None else pictures.with_opacity(draw(which[mine], tiled[mine], extent))
            doubled = max(doubled, baking.overlap(tiled[mine], *extent, self.where))
            target = bakes.Target(self.vertices, self.faces, tiled[mine], which[mine], None, extent, self.where)
            if color is not None and self.keep is not None:
                inside = baking.covered(tiled[mine], extent, device=self.where)[..., None]
                base = self._base(color, mesh, which[mine], tiled[mine], material, extent)
                color = np.where(inside, self._together(color, base), base)
            at = None if tangents is None else tangents[which[mine]]
            materials.append(self._finish(material, color, target, at))
        if doubled > 0.002:  # rounding gives less
            text = (
                f"texture coordinates overlap: {100 * doubled:.1f} % of the texels lie in more than one triangle "
                "(mirrored parts?), and show what the first one has there"
            )
            warnings.warn(text, OmtwarpWarning, stacklevel=3)
        painted = self.drawn or self.color is not None  # the colours at the vertices would tint the new picture
        return replace(mesh, materials=tuple(materials), vertex_colors=None if painted else mesh.vertex_colors)

    def _drawn(self) -> Callable[[NDArray, Floats, tuple[int, int]], Picture]:
        """Return what draws the pattern on triangles, shape [T], with coordinates [T, 3, 2], on a picture of a size."""
        if self.torus is not None:
            own, shown = self.torus.corners, Material(picture=self._textured(self.torus, None).image)

            def on_torus(which: NDArray, uv: Floats, size: tuple[int, int]) -> Picture:
                layout = baking.Layout(uv, *size, self.where, PADDING)
                one = np.zeros(len(which), dtype=np.int32)
                return baking.bake_materials(layout, own[which], one, (shown,), None, PADDING)

            return on_torus
        turn = pictures.rotation_matrix(cast(ArrayLike | None, self.rotate))
        # Most triangles that a mesh is divided into for smooth lines; those of larger meshes are small on the picture
        parts = next((n for n in (4, 2) if n * n * len(self.faces) <= 400_000), 1)
        smooth = smooth_map(self.vertices, self.faces, self.sphere, parts)

        def on_sphere(which: NDArray, uv: Floats, size: tuple[int, int]) -> Picture:
            corners = grid_shares(smooth.parts)[grid_triangles(smooth.parts)]
            faces = smooth.faces.reshape(-1, len(corners), 3)[which].reshape(-1, 3)
            finer = np.einsum("pkc,tcj->tpkj", corners, uv).reshape(-1, 3, 2)
            source: Source = by_name(self.pattern or "circles") if self.image is None else self.image
            return baking.bake_to_uv(
                source, smooth.sphere, faces, finer, size=size, rotation=turn, projection=self.projection,
                padding=PADDING, device=self.where,
            )  # fmt: skip

        return on_sphere

    def _base(
        self, like: NDArray, mesh: PaintedMesh, which: NDArray, tiled: Floats, material: Material, size: tuple[int, int]
    ) -> NDArray[np.float32]:
        """Return a material's own colours on its own coordinates."""
        if material.picture is None and mesh.vertex_colors is not None:
            colors = mesh.vertex_colors[mesh.faces[which]] / 255.0
            layout = baking.Layout(tiled, *size, self.where, PADDING)
            return baking.bake_materials(layout, None, np.zeros(len(tiled), np.int32), (material,), colors, PADDING)
        color, picture = np.array(material.color, dtype=np.float32), material.picture
        if picture is None:
            return np.broadcast_to(color, like.shape)
        if picture.shape[1::-1] != size:
            picture = pictures.resized(picture, *size)
        return baking.tinted(pictures.with_opacity(pictures.as_floats(picture)), color)

    def _together(self, pattern: NDArray[np.float32], base: NDArray[np.float32]) -> NDArray[np.float32]:
        return baking.over(*((pattern, base) if self.keep == "over" else (base, pattern)), self.opacity)

    def _tangents(self, mesh: PaintedMesh) -> Floats | None:
        """Return the tangents at a mesh's corners where a normal map is asked for, shape [F, 3, 4]."""
        if self.detail is None:
            return None
        assert mesh.uv is not None
        return corner_tangents(mesh.vertices, mesh.faces, mesh.uv, vertex_normals(mesh.vertices, mesh.faces))

    def _finish(
        self, material: Material, color: NDArray[np.float32] | None, target: bakes.Target, tangents: Floats | None
    ) -> Material:
        """Complete a material by its new colour and the bakes that were asked for."""
        finished = material
        if color is not None:
            finished = replace(material, picture=pictures.without_full_opacity(pictures.as_bytes(color)), color=WHITE)
        elif self.color == "normal":
            finished = replace(material, picture=bakes.object_normals(target), color=WHITE)
        elif self.color is not None:
            finished = replace(material, picture=bakes.colored(*self._numbers(self.color), target), color=WHITE)
        if "ao" in self.names:
            finished = replace(finished, occlusion_picture=bakes.occlusion(target))
        if self.detail is not None and tangents is not None:
            normals = bakes.detail_normals(target, tangents, self.detail)
            finished = replace(finished, normal_picture=normals, own_tangents=True)
        return finished

    def _numbers(self, what: str) -> tuple[Floats, str | bakes.LabelTable, float, float]:
        """Return numbers at vertices by the name of a quantity or file, their colour map and the values at its ends."""
        if what not in ("curvature", "area"):
            values, table = bakes.data_in(Path(what), len(self.vertices), self.origins, self.structure)
            return values, table or "viridis", float(np.nanmin(values)), float(np.nanmax(values))
        if what == "area":
            # Least range, of a binary logarithm: a map that keeps areas to round-off still has a range of colours
            values, least = np.log2(bakes.area_ratio(self.vertices, self.faces, self.on_map, self.parts)), 1e-9
        else:
            values, least = bakes.mean_curvature(self.vertices, self.faces), 0.0
        # Per cent of the vertices whose curvature or area the colours distinguish; few corners have far more
        most = max(float(np.percentile(np.abs(values), 95.0)), least)
        return values, "coolwarm", -most, most

    def on_atlas(self) -> PaintedMesh:
        """Lay the surface out on one picture, which all of its materials share."""
        if self.torus is not None:
            sheet = _sheet(self._textured(self.torus, self.size))
        elif self.parts is not None:
            sheet = self._parts_side_by_side(self.parts)
        else:
            sheet = _sheet(self._textured((self.vertices, self.faces, self.sphere), self.size))
        mesh = self._mesh_of(sheet)
        uv, picture = sheet.mesh.require_uv(), sheet.mesh.image
        which, uv = baking.tiled_copies(uv) if mesh.wraps_rows else (np.arange(len(uv)), uv)
        height, width = picture.shape[:2]
        face, weights = sheet.source_face[which], None if sheet.weights is None else sheet.weights[which]
        target = bakes.Target(self.vertices, self.faces, uv, face, weights, (width, height), self.where)
        color = pictures.with_opacity(pictures.as_floats(picture)) if self.drawn else None
        if color is not None and self.keep is not None and self.own is not None:
            color = self._together(color, self._atlas_base(self.own, target))
        tangents = self._tangents(mesh)
        materials = [material.on_other_coordinates() for material in mesh.materials]
        shared = self._finish(materials[0], color, target, None if tangents is None else tangents[which])
        common = ("color", "picture", "occlusion_picture", "normal_picture", "own_tangents")
        look = {name: getattr(shared, name) for name in common}
        return replace(mesh, materials=tuple(replace(material, **look) for material in materials))

    def _textured(self, result: MapLike, size: int | None) -> PaintedMesh:
        """Return the texture of a map, with a picture of one colour where there are bakes alone."""
        if isinstance(self.pattern, Pattern) and is_torus_map(result):
            raise OmtwarpError("a Pattern is for the sphere: a torus takes circles, checker or a picture that repeats")
        plain = None if self.drawn or is_torus_map(result) else np.zeros((16, 32, 3), dtype=np.uint8)
        return texture(
            result, self.image if plain is None else plain, pattern=self.pattern, projection=self.projection,
            atlas=self.atlas, rotate=self.rotate, size=SIZE if size is None and plain is not None else size,
            smooth=plain is None, device=str(self.where),
        )  # fmt: skip

    def _parts_side_by_side(self, parts: NDArray[np.intp]) -> _Sheet:
        """Lay out parts, each on the atlas of its own sphere, on a square picture in proportion to their areas.

        Args:
            parts: the sphere of every triangle, shape [F].

        Raises:
            OmtwarpError: the picture is too small for so many parts.
        """
        # Texels around the atlas of a part: bilinear samples see them at the third mip level yet, as the least gutters.
        gap = 8
        # Widths of atlases of parts are multiples of so many texels, which every atlas takes, and at least two of them.
        step, fewest = 48, 2
        (side,) = check_size(SIZE if self.size is None else self.size)
        one = make_atlas(self.atlas, fewest * step)
        height = one.height / one.width
        least = np.array([one.width, one.height])
        sizes = np.sqrt(np.bincount(parts, triangle_areas(self.vertices, self.faces)))[:, None] * [1.0, height]
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
            used, own = np.unique(self.faces[mine], return_inverse=True)
            sheet = _sheet(self._textured((self.vertices[used], own.reshape(-1, 3), self.sphere[used]), width))
            image = sheet.mesh.image
            high, across = image.shape[:2]
            if picture is None:
                picture = np.zeros((side, side, image.shape[2]), dtype=np.uint8)
                picture[:] = np.rint(image.mean(axis=(0, 1)))
            aside, none = (gap - 1, gap - 1), (0, 0)
            drawn = np.pad(image, (none, aside, none), "wrap" if one.wraps else "edge")
            drawn = np.pad(drawn, (aside, none, none), "edge")
            row, column = side - int(bottom[part]) - high - gap + 1, int(left[part]) - gap + 1
            picture[row : row + drawn.shape[0], column : column + drawn.shape[1]] = drawn
            uv = (sheet.mesh.require_uv() * (across, high) + (left[part], bottom[part])) / side
            drawn_parts.append(_Sheet(replace(sheet.mesh, uv=uv), mine[sheet.source_face], sheet.weights))
        meshes = [sheet.mesh for sheet in drawn_parts]
        before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        faces = np.concatenate([mesh.faces + at for mesh, at in zip(meshes, before[:-1], strict=True)])
        vertices, uv = (np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in ("vertices", "uv"))
        columns = ([getattr(sheet, name) for sheet in drawn_parts] for name in ("source_face", "weights"))
        source, weights = map(np.concatenate, columns)
        whole = PaintedMesh(vertices, faces, uv, (Material("texture", picture=picture),), wraps_rows=False)
        return _Sheet(whole, source, weights)

    def _mesh_of(self, sheet: _Sheet) -> PaintedMesh:
        """Return the mesh of a sheet, with the materials that are kept."""
        own, source = self.own, sheet.source_face
        # A light grey, on which ambient occlusion shows
        materials = (Material("texture", (0.8, 0.8, 0.8, 1.0)),) if own is None or self.keep is None else own.materials
        mesh, number = sheet.mesh, None if len(materials) == 1 or own is None else own.material_of[source]
        made = PaintedMesh(mesh.vertices, mesh.faces, mesh.uv, materials, number, wraps_rows=mesh.wraps_rows)
        if own is None:
            return made
        object_of = None if own.face_object is None else own.face_object[source]
        return replace(made, source_files=own.source_files, objects=own.objects, face_object=object_of)

    def _atlas_base(self, own: PaintedMesh, target: bakes.Target) -> NDArray[np.float32]:
        """Return the colours that a mesh's own materials have on its atlas."""
        layout = baking.Layout(target.uv, *target.size, self.where)
        at = None if own.uv is None else own.uv[target.face]
        if at is not None:
            at = np.nan_to_num(at if target.weights is None else np.einsum("tij,tjc->tic", target.weights, at))
        colors = None if own.vertex_colors is None else target.spread(own.vertex_colors / 255.0)
        return baking.bake_materials(layout, at, own.material_of[target.face], own.materials, colors, -1)


def _extent(material: Material, size: int | None) -> tuple[int, int]:
    """Choose the width and height of a material's new picture.

    Without a size that is asked for, they are those of its own picture, times a whole number where that is small.
    """
    if material.picture is None:
        return (size or SIZE, size or SIZE)
    height, width = material.picture.shape[:2]
    if size is None:
        times = max(SIZE // max(width, height), 1)
        return (times * width, times * height)
    return (size, max(round(size * height / width), 1))
