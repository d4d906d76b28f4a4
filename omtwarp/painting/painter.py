"""A surface's pattern, materials and bakes on the texture coordinates of its mesh, or on an atlas."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError, OmtwarpWarning
from omtwarp.materials.base import WHITE, Bytes, Floats, Ints, Material
from omtwarp.materials.painted import PaintedMesh
from omtwarp.materials.tangents import corner_tangents
from omtwarp.mesh.arrays import TINY
from omtwarp.painting import bakes
from omtwarp.painting.texels import PADDING, bake_materials, covered, over, overlap, tiled_copies, tinted
from omtwarp.texturing.baking import Layout, bake_to_uv
from omtwarp.texturing.image import PictureLike, as_bytes, as_floats, read_image
from omtwarp.texturing.patterns import PATTERNS, Pattern
from omtwarp.texturing.projection import rotation_matrix
from omtwarp.texturing.smooth import SmoothMap, grid_points, grid_triangles, smooth_map
from omtwarp.texturing.textured import SphereMap, TexturedSurface, as_map, require_one_picture, texture, vertex_normals

SIZE = 2048
"""Texels of a side of a picture for own coordinates where the material has none whose size could be taken."""

OPACITY = 0.5
"""Of the upper layer where a pattern and a material are laid over one another: half of each shows."""

OVERLAP = 0.002
"""Part of the covered texels in more than one triangle above which a warning says so; rounding gives less."""

MOST_DIVIDED = 400_000
"""Triangles up to which a mesh is divided for smooth lines; those of larger meshes are small on the picture."""

NEUTRAL = (0.8, 0.8, 0.8, 1.0)
"""Colour of a mesh that has no material, on which ambient occlusion shows: a light grey."""


def paint(
    result: SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike],
    mesh: PaintedMesh | None = None,
    image: PictureLike | None = None,
    *,
    pattern: str | Pattern | None = None,
    uv: str = "own",
    keep: str | None = None,
    opacity: float = OPACITY,
    bake: Sequence[str | os.PathLike[str]] = (),
    detail: tuple[ArrayLike, ArrayLike] | None = None,
    projection: str = "equirectangular",
    atlas: str = "cube",
    rotate: ArrayLike | str | None = None,
    size: int | None = None,
    device: str | None = "auto",
) -> PaintedMesh:
    """Texture a mesh through its map in its own texture coordinates, over or under its own materials, with bakes.

    With own coordinates every material of the mesh keeps its name and properties and gets a picture of its own; with an
    atlas, all materials share one picture. Coordinates outside [0, 1] repeat the picture. Where triangles overlap on
    the picture, as mirrored halves do, the first one gets the texel, and a warning says for which share of the picture.

    One function, as it is checks of options and two calls.

    Args:
        result: a :class:`~omtwarp.MapResult`, anything with ``vertices``, ``faces`` and ``sphere``, or the three as a
            tuple.
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
    if uv not in ("own", "atlas"):
        raise OmtwarpError(f"unknown texture coordinates '{uv}': use own or atlas")
    if keep not in (None, "over", "under"):
        raise OmtwarpError(f"unknown way to keep materials '{keep}': use over or under")
    if not 0.0 <= opacity <= 1.0:
        raise OmtwarpError(f"the opacity is {opacity}: give a number from 0 to 1")
    if image is not None and pattern is not None:
        raise OmtwarpError("both an image and a pattern were given: a texture is made from one of them")
    if mesh is None and (uv == "own" or keep is not None):
        raise OmtwarpError("own texture coordinates and materials are kept from a mesh: give the one that was mapped")
    if uv == "atlas" and (bake or keep is not None):
        require_one_picture(result)
    vertices, faces, sphere = as_map(result)
    wanted = _Wanted.of(bake, detail, image is not None or pattern is not None or keep is not None)
    own = None if mesh is None else mesh.on(vertices, faces)
    job = _Job(vertices, faces, sphere, own, wanted, keep, opacity, resolve_device(device))
    source = image if image is not None else pattern
    if source is None and (keep is not None or not wanted.names):
        source = "circles"
    if uv == "own":
        assert own is not None  # checked above
        return job.on_own_coordinates(source, projection, rotate, size)
    return job.on_atlas(source, projection, atlas, rotate, size)


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
            raise OmtwarpError("a detailed mesh is given, and no normals are baked: add --bake normal")
        colors = [name for name in names if name != "ao" and not (name == "normal" and fine is not None)]
        if len(colors) > 1:
            raise OmtwarpError(f"{' and '.join(colors)} would both be the colour: bake one at a time")
        if colors and colored:
            raise OmtwarpError(f"{colors[0]} and the pattern or picture would both be the colour: leave one out")
        return _Wanted(names, colors[0] if colors else None, fine)


@dataclass
class _Job:
    """The surface that is painted, with its map, and how."""

    vertices: Floats
    faces: Ints
    sphere: Floats
    own: PaintedMesh | None
    wanted: _Wanted
    keep: str | None
    opacity: float
    where: wp.Device

    def on_own_coordinates(
        self, source: PictureLike | Pattern | None, projection: str, rotate: ArrayLike | str | None, size: int | None
    ) -> PaintedMesh:
        assert self.own is not None
        mesh = self.own
        uv = mesh.require_uv()
        which, tiled = tiled_copies(uv)
        if isinstance(rotate, str):
            raise OmtwarpError(f"rotate '{rotate}': give degrees or a matrix for own texture coordinates")
        turn = rotation_matrix(rotate)
        tangents = self._tangents(mesh)
        parts = next((n for n in (4, 2) if n * n * len(self.faces) <= MOST_DIVIDED), 1)
        smooth = smooth_map(self.vertices, self.faces, self.sphere, parts)
        materials = []
        doubled = 0.0
        for number, material in enumerate(mesh.materials):
            mine = np.flatnonzero(mesh.material_of[which] == number)
            if not len(mine):
                materials.append(material)
                continue
            extent = _extent(material, size)
            layers = None
            if source is not None:
                faces, finer = _divided(smooth, which[mine], tiled[mine])
                baked = bake_to_uv(
                    source, smooth.sphere, faces, finer, size=extent, rotation=turn, projection=projection,
                    padding=PADDING, device=self.where,
                )  # fmt: skip
                layers = _with_opacity(baked)
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
            found = replace(material, picture=_opaque_if_it_is(as_bytes(color)), color=WHITE)
        elif wanted.color == "normal":
            found = replace(material, picture=bakes.object_normals(target), color=WHITE)
        elif wanted.color is not None:
            number = bakes.scalar(wanted.color, self.vertices, self.faces, self.sphere)
            found = replace(material, picture=number.picture(target, self.faces), color=WHITE)
        elif self.own is None:
            found = replace(material, color=NEUTRAL)
        else:
            found = material
        if "ao" in wanted.names:
            found = replace(found, occlusion_picture=bakes.occlusion(target, self.vertices, self.faces))
        if wanted.detail is not None and tangents is not None:
            normals = bakes.detail_normals(target, tangents, wanted.detail)
            found = replace(found, normal_picture=normals, own_tangents=True)
        return found

    def on_atlas(
        self,
        source: PictureLike | Pattern | None,
        projection: str,
        atlas: str,
        rotate: ArrayLike | str | None,
        size: int | None,
    ) -> PaintedMesh:
        image, pattern = (None, source) if isinstance(source, Pattern) else (source, None)
        if isinstance(image, str) and image in PATTERNS:
            image, pattern = None, image
        if source is None:  # only the atlas's coordinates are needed: a picture of one colour is the fastest
            image = np.zeros((16, 32, 3), dtype=np.uint8)
        layout_size = SIZE if size is None and source is None else size
        made = texture(
            (self.vertices, self.faces, self.sphere), image, pattern=pattern, projection=projection, atlas=atlas,
            rotate=rotate, size=layout_size, device=str(self.where),
        )  # fmt: skip
        mesh = self._atlas_mesh(made)
        assert mesh.uv is not None
        target = bakes.Target(
            mesh.uv,
            made.vertices[made.faces],
            made.normals[made.faces],
            made.source_face,
            _weights(made.vertices[made.faces], self.vertices[self.faces[made.source_face]]),
            (made.image.shape[1], made.image.shape[0]),
            self.where,
        )
        color = None if source is None else _with_opacity(as_floats(made.image))
        if color is not None and self.keep is not None and self.own is not None:
            color = self._together(color, self._atlas_base(self.own, mesh, target))
        shared = self._finish(mesh.materials[0], color, target, self._tangents(mesh))
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

    def _atlas_mesh(self, made: TexturedSurface) -> PaintedMesh:
        """Return the mesh of an atlas, its vertices joined along the seams, with the materials that are kept."""
        first = np.zeros(int(made.welded.max()) + 1, dtype=np.int64)
        first[made.welded[::-1]] = np.arange(len(made.welded))[::-1]
        materials = (Material("texture"),) if self.own is None or self.keep is None else self.own.materials
        numbers = None if len(materials) == 1 else np.asarray(self.own.material_of if self.own else 0)[made.source_face]
        return PaintedMesh(
            made.vertices[first],
            made.welded[made.faces].astype(np.int32),
            made.uv[made.faces],
            materials,
            numbers,
            wraps_rows=False,
            source_files=() if self.own is None else self.own.source_files,
        )

    def _atlas_base(self, own: PaintedMesh, mesh: PaintedMesh, target: bakes.Target) -> NDArray[np.float32]:
        """Return the colours that a mesh's own materials have on its atlas."""
        assert mesh.uv is not None
        layout = Layout(mesh.uv, *target.size, self.where)
        at = None if own.uv is None else np.einsum("tij,tjc->tic", target.weights, own.uv[target.face])
        colors = None if own.vertex_colors is None else target.spread(own.vertex_colors / 255.0, self.faces)
        at = None if at is None else np.nan_to_num(at)
        return bake_materials(layout, at, mesh.material_of, own.materials, colors, -1)


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


def _weights(points: Floats, corners: Floats) -> Floats:
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


__all__ = ["SIZE", "paint"]
