"""A surface's pattern, materials and bakes on the texture coordinates of its mesh, or on an atlas."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.maps.result import StoredMap
from omtwarp.maps.torus_map import TorusMap
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.surface import plane_areas, triangle_areas, vertex_normals
from omtwarp.options import AtlasLike, CoordinatesLike, KeepLike, PatternLike, ProjectionLike
from omtwarp.texturing import bakes
from omtwarp.texturing.baking import (
    PADDING,
    Layout,
    Picture,
    bake_materials,
    bake_to_uv,
    covered,
    over,
    overlap,
    tiled_copies,
    tinted,
)
from omtwarp.texturing.image import PictureLike, as_bytes, as_floats, read_image
from omtwarp.texturing.materials import WHITE, Bytes, Floats, Ints, Material, corner_tangents
from omtwarp.texturing.painted import PaintedMesh
from omtwarp.texturing.patterns import Pattern
from omtwarp.texturing.projection import rotation_matrix
from omtwarp.texturing.sheets import SIZE, Look, Sheet, sheet_of_parts, sphere_sheet, torus_picture, torus_sheet
from omtwarp.texturing.smooth import SmoothMap, grid_points, grid_triangles, smooth_map
from omtwarp.texturing.textured import SphereMap, as_map, spheres_of

OPACITY = 0.5
"""Of the upper layer where a pattern and a material are laid over one another: half of each shows."""

OVERLAP = 0.002
"""Part of the covered texels in more than one triangle above which a warning says so; rounding gives less."""


def paint(
    result: SphereMap | TorusMap | tuple[ArrayLike, ArrayLike, ArrayLike],
    mesh: PaintedMesh | None = None,
    image: PictureLike | None = None,
    *,
    pattern: PatternLike | Pattern | None = None,
    uv: CoordinatesLike = "own",
    keep: KeepLike | None = None,
    opacity: float = OPACITY,
    bake: Sequence[str | os.PathLike[str]] = (),
    detail: tuple[ArrayLike, ArrayLike] | None = None,
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
        result: a :class:`~omtwarp.MapResult`, a :class:`~omtwarp.TorusMap`, anything with ``vertices``, ``faces`` and
            ``sphere``, or the three as a tuple.
        mesh: the mesh that was mapped, with coordinates and materials (:func:`omtwarp.read_painted_mesh`); needed for
            own coordinates and for ``keep``.
        image: an equirectangular picture, as :func:`omtwarp.texture` takes it.
        pattern: a pattern, as :func:`omtwarp.texture` takes it. With neither, and nothing to bake: circles.
        uv: ``own`` or ``atlas``.
        keep: ``over`` lays the pattern over the mesh's materials, ``under`` the materials over the pattern; None leaves
            the materials' colours out. The layers are put together by Porter and Duff's "over" in linear light.
        opacity: of the upper layer, from 0 to 1, times its own.
        bake: ``normal``, ``ao``, ``curvature``, ``area``, or files of numbers at the vertices. Ambient occlusion goes
            to the material's occlusion; normals of ``detail`` to its normal map, in tangent space; curvature (of the
            mean, 1 / length unit), area (on the sphere over that on the surface) and data become the colour, through a
            colour map, and so do normals without ``detail``, in the mesh's axes. Only one bake may become the colour.
        detail: vertices and faces of a finer mesh of the same surface in the same place, for ``normal``.
        projection: of the image, as in :func:`omtwarp.texture`.
        atlas: which one, as in :func:`omtwarp.texture`.
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
    _check_options(uv, keep, opacity, mesh)
    torus = result if isinstance(result, TorusMap) else None
    if isinstance(result, TorusMap):
        vertices, faces, sphere, parts = result.vertices, result.faces, result.vertices, None
        on_map = plane_areas(result.corners @ result.lattice)
    else:
        vertices, faces, sphere = as_map(result)
        parts, on_map = spheres_of(result), triangle_areas(sphere, faces)
    wanted = _Wanted.of(bake, detail, image is not None or pattern is not None or keep is not None)
    own = None if mesh is None else mesh.on(vertices, faces)
    stored = result if isinstance(result, StoredMap) else None
    origins, structure = (None, None) if stored is None else (stored.origins, stored.report.get("structure"))
    job = _Job(
        vertices, faces, sphere, torus, parts, on_map, origins, structure, own, wanted, keep, opacity,
        resolve_device(device),
    )  # fmt: skip
    source = image if image is not None else pattern
    if source is None and (keep is not None or not wanted.names):
        source = "circles"
    look = Look(source, projection, atlas, rotate, size, job.where)
    return job.on_own_coordinates(look) if uv == "own" else job.on_atlas(look)


def _check_options(uv: str, keep: str | None, opacity: float, mesh: PaintedMesh | None) -> None:
    """Refuse unknown options, and those that a mesh is needed for where there is none.

    Raises:
        OmtwarpError: an option cannot be taken.
    """
    if uv not in ("own", "atlas"):
        raise OmtwarpError(f"unknown texture coordinates '{uv}': use own or atlas")
    if keep not in (None, "over", "under"):
        raise OmtwarpError(f"unknown way to keep materials '{keep}': use over or under")
    if not 0.0 <= opacity <= 1.0:
        raise OmtwarpError(f"the opacity is {opacity}: give a number from 0 to 1")
    if mesh is None and (uv == "own" or keep is not None):
        raise OmtwarpError("own texture coordinates and materials are kept from a mesh: give the one that was mapped")


@dataclass(frozen=True)
class _Wanted:
    """The bakes that were asked for.

    Attributes:
        names: all of them.
        color: the one that becomes the colour, if any.
        detail: vertices and faces of the finer mesh.
    """

    names: tuple[str, ...]
    color: str | None
    detail: tuple[Floats, Ints] | None

    @staticmethod
    def of(
        bake: Iterable[str | os.PathLike[str]], detail: tuple[ArrayLike, ArrayLike] | None, colored: bool
    ) -> _Wanted:
        names = tuple(os.fspath(name) for name in bake)
        fine = None
        if detail is not None:
            fine = (np.asarray(detail[0], dtype=np.float64), np.ascontiguousarray(detail[1], dtype=np.int32))
        if fine is not None and "normal" not in names:
            raise OmtwarpError("a detailed mesh is given, and no normals are baked: add bake=['normal']")
        colors = [name for name in names if name != "ao" and not (name == "normal" and fine is not None)]
        if len(colors) > 1:
            raise OmtwarpError(f"{' and '.join(colors)} would both be the colour: bake one at a time")
        if colors and colored:
            raise OmtwarpError(f"{colors[0]} and the pattern or picture would both be the colour: leave one out")
        return _Wanted(names, colors[0] if colors else None, fine)


@dataclass
class _Job:
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
        wanted: the bakes.
        keep, opacity: how the materials are kept.
        where: the device.
    """

    vertices: Floats
    faces: Ints
    sphere: Floats
    torus: TorusMap | None
    parts: NDArray[np.intp] | None
    on_map: Floats
    origins: Origins | None
    structure: str | None
    own: PaintedMesh | None
    wanted: _Wanted
    keep: str | None
    opacity: float
    where: wp.Device

    def on_own_coordinates(self, look: Look) -> PaintedMesh:
        """Paint the mesh's materials in the coordinates that it has."""
        assert self.own is not None  # checked before
        mesh = self.own
        uv = mesh.require_uv()
        which, tiled = tiled_copies(uv)
        if isinstance(look.rotate, str):
            raise OmtwarpError(f"rotate '{look.rotate}': give degrees or a matrix for own texture coordinates")
        tangents = self._tangents(mesh)
        draw = None if look.source is None else self._drawn(look)
        materials = []
        doubled = 0.0
        for number, material in enumerate(mesh.materials):
            mine = np.flatnonzero(mesh.material_of[which] == number)
            if not len(mine):
                materials.append(material)
                continue
            extent = _extent(material, look.size)
            layers = None if draw is None else _with_opacity(draw(which[mine], tiled[mine], extent))
            doubled = max(doubled, overlap(tiled[mine], *extent, self.where))
            target = self._target(tiled[mine], which[mine], extent)
            at = None if tangents is None else tangents[which[mine]]
            color = None
            if layers is not None:
                color = layers
                if self.keep is not None:
                    inside = covered(tiled[mine], extent, device=self.where)[..., None]
                    base = self._base(layers, mesh, which[mine], tiled[mine], material, extent)
                    color = np.where(inside, self._together(layers, base), base)
            materials.append(self._finish(material, color, target, at))
        if doubled > OVERLAP:
            text = (
                f"texture coordinates overlap: {100 * doubled:.1f} % of the texels lie in more than one triangle "
                "(mirrored parts?), and show what the first one has there"
            )
            warnings.warn(text, OmtwarpWarning, stacklevel=3)
        return replace(mesh, materials=tuple(materials))

    def _drawn(self, look: Look) -> Callable[[NDArray, Floats, tuple[int, int]], Picture]:
        """Return what draws the pattern on triangles, shape [T], with coordinates [T, 3, 2], on a picture of a size."""
        # Triangles up to which a mesh is divided for smooth lines; those of larger meshes are small on the picture.
        most_divided = 400_000
        if self.torus is not None:
            own, shown = self.torus.corners, Material(picture=torus_picture(self.torus, replace(look, size=None)))

            def on_torus(which: NDArray, uv: Floats, size: tuple[int, int]) -> Picture:
                layout = Layout(uv, *size, self.where, PADDING)
                one = np.zeros(len(which), dtype=np.int32)
                return bake_materials(layout, own[which], one, (shown,), None, PADDING)

            return on_torus
        turn = rotation_matrix(cast(ArrayLike | None, look.rotate))
        parts = next((n for n in (4, 2) if n * n * len(self.faces) <= most_divided), 1)
        smooth = smooth_map(self.vertices, self.faces, self.sphere, parts)

        def on_sphere(which: NDArray, uv: Floats, size: tuple[int, int]) -> Picture:
            faces, finer = _divided(smooth, which, uv)
            assert look.source is not None
            return bake_to_uv(
                look.source, smooth.sphere, faces, finer, size=size, rotation=turn, projection=look.projection,
                padding=PADDING, device=self.where,
            )  # fmt: skip

        return on_sphere

    def _base(
        self, like: NDArray, mesh: PaintedMesh, which: NDArray, tiled: Floats, material: Material, size: tuple[int, int]
    ) -> NDArray[np.float32]:
        """Return a material's own colours on its own coordinates."""
        if material.picture is None and mesh.vertex_colors is not None:
            colors = mesh.vertex_colors[mesh.faces[which]] / 255.0
            layout = Layout(tiled, *size, self.where, PADDING)
            return bake_materials(layout, None, np.zeros(len(tiled), np.int32), (material,), colors, PADDING)
        flat = np.broadcast_to(np.array(material.color, np.float32), like.shape)
        if material.picture is None:
            return flat
        return tinted(_resized(material.picture, size), np.array(material.color, dtype=np.float32))

    def _together(self, pattern: NDArray[np.float32], base: NDArray[np.float32]) -> NDArray[np.float32]:
        if self.keep == "over":
            return over(pattern, base, self.opacity)
        return over(base, pattern, self.opacity)

    def _target(self, uv: Floats, which: NDArray, size: tuple[int, int]) -> bakes.Target:
        normals = vertex_normals(self.vertices, self.faces)
        weights = np.broadcast_to(np.eye(3), (len(which), 3, 3))
        return bakes.Target(
            uv, self.vertices[self.faces[which]], normals[self.faces[which]], which, weights, size, self.where
        )

    def _tangents(self, mesh: PaintedMesh) -> Floats | None:
        """Return the tangents at a mesh's corners where a normal map is asked for, shape [F, 3, 4]."""
        if self.wanted.detail is None:
            return None
        assert mesh.uv is not None
        return corner_tangents(mesh.vertices, mesh.faces, mesh.uv, vertex_normals(mesh.vertices, mesh.faces))

    def _finish(
        self, material: Material, color: NDArray[np.float32] | None, target: bakes.Target, tangents: Floats | None
    ) -> Material:
        """Complete a material by its new colour and the bakes that were asked for."""
        wanted = self.wanted
        if color is not None:
            finished = replace(material, picture=_opaque_if_it_is(as_bytes(color)), color=WHITE)
        elif wanted.color == "normal":
            finished = replace(material, picture=bakes.object_normals(target), color=WHITE)
        elif wanted.color is not None:
            where = self.on_map, self.parts, self.origins, self.structure
            number = bakes.scalar(wanted.color, self.vertices, self.faces, *where)
            finished = replace(material, picture=number.picture(target, self.faces), color=WHITE)
        else:
            finished = material
        if "ao" in wanted.names:
            finished = replace(finished, occlusion_picture=bakes.occlusion(target, self.vertices, self.faces))
        if wanted.detail is not None and tangents is not None:
            normals = bakes.detail_normals(target, tangents, wanted.detail)
            finished = replace(finished, normal_picture=normals, own_tangents=True)
        return finished

    def on_atlas(self, look: Look) -> PaintedMesh:
        """Lay the surface out on one picture, which all of its materials share."""
        if self.torus is not None:
            sheet = torus_sheet(self.torus, look)
        elif self.parts is not None:
            sheet = sheet_of_parts(self.vertices, self.faces, self.sphere, self.parts, look)
        else:
            sheet = sphere_sheet(self.vertices, self.faces, self.sphere, look)
        mesh = self._mesh_of(sheet)
        which, uv = tiled_copies(sheet.uv) if sheet.repeats else (np.arange(len(sheet.faces)), sheet.uv)
        points = sheet.vertices[sheet.faces[which]]
        face, weights = sheet.source_face[which], sheet.weights[which]
        target = bakes.Target(uv, points, sheet.normals[which], face, weights, sheet.size, self.where)
        color = None if sheet.picture is None else _with_opacity(as_floats(sheet.picture))
        if color is not None and self.keep is not None and self.own is not None:
            color = self._together(color, self._atlas_base(self.own, target))
        tangents = self._tangents(mesh)
        shared = self._finish(mesh.materials[0], color, target, None if tangents is None else tangents[which])
        return replace(
            mesh,
            materials=tuple(
                replace(
                    material,
                    color=shared.color,
                    picture=shared.picture,
                    occlusion_picture=shared.occlusion_picture,
                    normal_picture=shared.normal_picture,
                    own_tangents=shared.own_tangents,
                    roughness_picture=None,
                    emission_picture=None,
                )
                for material in mesh.materials
            ),
        )

    def _mesh_of(self, sheet: Sheet) -> PaintedMesh:
        """Return the mesh of a sheet, with the materials that are kept."""
        own, source = self.own, sheet.source_face
        # A light grey, on which ambient occlusion shows
        materials = (Material("texture", (0.8, 0.8, 0.8, 1.0)),) if own is None or self.keep is None else own.materials
        return PaintedMesh(
            sheet.vertices,
            sheet.faces,
            sheet.uv,
            materials,
            None if len(materials) == 1 or own is None else own.material_of[source],
            wraps_rows=sheet.repeats,
            source_files=() if own is None else own.source_files,
            objects=() if own is None else own.objects,
            face_object=None if own is None or own.face_object is None else own.face_object[source],
        )

    def _atlas_base(self, own: PaintedMesh, target: bakes.Target) -> NDArray[np.float32]:
        """Return the colours that a mesh's own materials have on its atlas."""
        layout = Layout(target.uv, *target.size, self.where)
        at = None if own.uv is None else np.einsum("tij,tjc->tic", target.weights, own.uv[target.face])
        colors = None if own.vertex_colors is None else target.spread(own.vertex_colors / 255.0, self.faces)
        at = None if at is None else np.nan_to_num(at)
        return bake_materials(layout, at, own.material_of[target.face], own.materials, colors, -1)


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


def _with_opacity(picture: NDArray[np.generic]) -> NDArray[np.float32]:
    """Add an opacity of 1 to a picture that has none."""
    values = picture.astype(np.float32, copy=False)
    if values.shape[2] == 4:
        return values
    return np.concatenate([values[..., :3], np.ones((*values.shape[:2], 1), np.float32)], axis=2)


def _opaque_if_it_is(picture: Bytes) -> Bytes:
    """Drop the opacity of a picture that is opaque."""
    return np.ascontiguousarray(picture[..., :3]) if picture[..., 3].min() == 255 else picture


def _resized(picture: Bytes, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return a picture in another size with an opacity channel, values from 0 to 1."""
    from PIL import Image

    if picture.shape[1::-1] != size:
        picture = np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))
    return _with_opacity(as_floats(read_image(picture)))


def _divided(smooth: SmoothMap, which: NDArray, uv: Floats) -> tuple[Ints, Floats]:
    """Return the parts of triangles that a smooth map divides, as vertices of that map, and their coordinates.

    Args:
        smooth: the divided map.
        which: numbers of the triangles, shape [T].
        uv: coordinates of their corners, shape [T, 3, 2].

    Returns:
        Shapes [T n², 3] and [T n², 3, 2]: the picture of a triangle is divided as the triangle is.
    """
    points = grid_points(smooth.parts)
    share = np.column_stack([smooth.parts - points.sum(axis=1), points]) / smooth.parts
    corners = share[grid_triangles(smooth.parts)]
    faces = smooth.faces.reshape(-1, len(corners), 3)[which]
    return faces.reshape(-1, 3), np.einsum("pkc,tcj->tpkj", corners, uv).reshape(-1, 3, 2)
