"""A mesh with materials, and texture coordinates at the corners of its triangles."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.files.output import as_path
from omtwarp.mesh.arrays import WELD, Bytes, Floats, Ints, listed, real_numbers, whole_numbers
from omtwarp.mesh.origins import Origins
from omtwarp.mesh.read import compressed, seam_copies
from omtwarp.mesh.surface import plane_areas, unit_normals, vertex_normals
from omtwarp.mesh.write import write_mesh
from omtwarp.options import TextureFormat
from omtwarp.texturing.export import (
    Material,
    Model,
    Part,
    corner_tangents,
    export,
    format_for,
    linear,
    split_corners,
    uv_of_corners,
)
from omtwarp.texturing.image import as_bytes

if TYPE_CHECKING:
    import trimesh
    from PIL.Image import Image

    from omtwarp.texturing.atlas import Atlas
    from omtwarp.texturing.seams import Unwrapped

# Of the extent of the mesh: corners of two copies of a mesh that are farther apart are not the same corner.
SAME_PLACE = 1e-5
ELSEWHERE = "the map's vertices are not where the mesh's are: it is a map of another mesh"


def corners_of(faces: ArrayLike, count: int) -> Ints:
    """Return the corners of triangles as int32, shape [F, 3].

    Raises:
        OmtwarpError: numbers that are not whole, or not among so many vertices.
    """
    return whole_numbers(faces, "faces", (None, 3), below=count).astype(np.int32)


@dataclass(frozen=True, eq=False)
class SphereLayout:
    """How a texture is laid out on a surface, by its map to the sphere.

    Attributes:
        cut: the surface, divided along the charts of the texture.
        atlas: how the sphere is laid out on the picture.
        rotation: the texture's rotation on the sphere, shape [3, 3].
        vertices, faces: the surface before, shapes [V, 3] and [F, 3].
        sampled: returns the colours of a picture at the surface's vertices, shape [V, channels].
    """

    cut: Unwrapped
    atlas: Atlas
    rotation: Floats
    vertices: Floats
    faces: Ints
    sampled: Callable[[Bytes], NDArray[np.generic]]


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """A triangle mesh with its texture coordinates and materials.

    Attributes:
        vertices: float64, shape [V, 3]; not doubled along seams.
        faces: int32, shape [F, 3].
        uv: texture coordinates of every corner, float64, shape [F, 3, 2], v up; NaN where a triangle has none, None
            where no triangle has any. They may leave [0, 1]: the picture repeats.
        materials: at least one.
        face_material: number of the material of every triangle, int32, shape [F].
        vertex_colors: sRGB and opacity at the vertices, uint8, shape [V, 4]; None where the file has none.
        notes: decisions made while reading, in words.
        wraps: whether pictures repeat to the right.
        wraps_rows: whether they repeat upwards.
        source_files: files that an export must not replace.
        objects: names of object and group of an OBJ file, empty ones for none.
        face_object: number of these of every triangle, int32, shape [F]; None where there are none.
        normals: unit vectors at the vertices, shape [V, 3]; None for those of the triangles around each.
        layout: of a texture that was made through a map to the sphere; the vertices of the surface come first, those
            that divide triangles along the texture's charts follow.

    Raises:
        OmtwarpError: the arrays do not belong together.

    Example:
        >>> import omtwarp
        >>> ball = omtwarp.shapes.icosphere(4)
        >>> halves = (ball.vertices[ball.faces].mean(axis=1)[:, 2] > 0).astype(int)
        >>> red, blue = omtwarp.Material("red", (1, 0, 0, 1)), omtwarp.Material("blue", (0, 0, 1, 1))
        >>> omtwarp.PaintedMesh(ball.vertices, ball.faces, materials=(red, blue), face_material=halves)
        PaintedMesh(162 vertices, 320 faces without texture coordinates, 2 materials)
    """

    vertices: Floats
    faces: Ints
    uv: Floats | None = None
    materials: tuple[Material, ...] = (Material(),)
    face_material: Ints | None = None
    vertex_colors: Bytes | None = None
    notes: tuple[str, ...] = ()
    wraps: bool = True
    wraps_rows: bool = True
    source_files: tuple[Path, ...] = field(default=(), repr=False)
    objects: tuple[tuple[str, str], ...] = ()
    face_object: Ints | None = None
    normals: Floats | None = None
    layout: SphereLayout | None = None

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "vertices", real_numbers(self.vertices, "vertices", (None, 3), finite=False))
        put(self, "faces", corners_of(self.faces, len(self.vertices)))
        put(self, "materials", tuple(listed(self.materials, "materials", "omtwarp.Material", Material)))
        count = len(self.faces)
        if self.uv is not None:
            put(self, "uv", uv_of_corners(self.uv, self.faces))
        given = np.zeros(count) if self.face_material is None else self.face_material
        materials = whole_numbers(given, "materials of triangles", (count,), below=len(self.materials))
        put(self, "face_material", materials.astype(np.int32))
        if self.face_object is not None and np.shape(self.face_object) != (count,):
            raise OmtwarpError(f"objects of {len(self.face_object)} triangles given for {count}")

    def __repr__(self) -> str:
        without, several = "out" * (self.uv is None), "s" * (len(self.materials) != 1)
        mesh = f"{len(self.vertices)} vertices, {len(self.faces)} faces with{without} texture coordinates"
        return f"{type(self).__name__}({mesh}, {len(self.materials)} material{several})"

    @property
    def material_of(self) -> Ints:
        """Number of the material of every triangle, shape [F]."""
        assert self.face_material is not None  # of __post_init__
        return self.face_material

    @property
    def image(self) -> Bytes:
        """The picture of the first material, uint8, shape [H, W, 3] or, where something is transparent, [H, W, 4].

        Raises:
            OmtwarpError: it has none.
        """
        picture = self.materials[0].picture
        if picture is None:
            raise OmtwarpError(f"the material '{self.materials[0].name}' has no picture")
        return picture

    def pil(self) -> Image:
        """Return the picture of the first material as a PIL image."""
        from PIL import Image

        return Image.fromarray(self.image)

    def trimesh(self) -> trimesh.Trimesh:
        """Return the mesh, cut along the seams of its texture, as a :class:`trimesh.Trimesh` with its material.

        Vertices keep their numbers; copies of those on seams follow.

        Raises:
            OmtwarpError: there are several materials, or there is no picture.
        """
        import trimesh

        if len(self.materials) > 1:
            raise OmtwarpError(f"a trimesh.Trimesh has one material, the mesh {len(self.materials)}: export it")
        material, (rows, vertex, uv) = self.materials[0], self.split()
        factor = np.rint(255 * linear(np.array(material.color))).astype(int).tolist()
        factors = {"metallicFactor": material.metallic, "roughnessFactor": material.roughness, "name": material.name}
        look = trimesh.visual.material.PBRMaterial(baseColorFactor=factor, baseColorTexture=self.pil(), **factors)
        normals, visual = self.unit_normals()[vertex], trimesh.visual.TextureVisuals(uv=uv, material=look)
        return trimesh.Trimesh(self.vertices[vertex], rows, vertex_normals=normals, visual=visual, process=False)

    def split(self) -> tuple[Ints, Ints, Floats]:
        """Cut the mesh along the seams of its texture, so that every vertex has one pair of coordinates.

        Returns:
            The faces, shape [F, 3], the vertex that each new one is, shape [N], first the vertices in their order, and
            the coordinates, shape [N, 2].

        Raises:
            OmtwarpError: some triangles, or all, have no texture coordinates.
        """
        return split_corners(self.faces, self._known_uv(), len(self.vertices))

    def require_uv(self, name: str = "the mesh") -> Floats:
        """Return the texture coordinates of every corner, shape [F, 3, 2], on which a picture can be drawn.

        Raises:
            OmtwarpError: some triangles, or all, have no texture coordinates, or all have no area in them, as where
                each takes the colour of one texel.
        """
        uv = self._known_uv(name)
        if not plane_areas(uv).any():
            raise OmtwarpError(f"{name}: it has no texture coordinates that give a face an area; leave out uv='own'")
        return uv

    def _known_uv(self, name: str = "the mesh") -> Floats:
        """Return the texture coordinates of every corner, shape [F, 3, 2].

        Raises:
            OmtwarpError: some triangles, or all, have no texture coordinates.
        """
        if self.uv is None:
            raise OmtwarpError(f"{name}: no texture coordinates in it; leave out uv='own' to lay out new ones")
        missing = ~np.isfinite(self.uv).all(axis=(1, 2))
        if missing.any():
            text = f"{missing.sum()} of {len(self.faces)} faces have no texture coordinates"
            raise OmtwarpError(f"{name}: {text}, first face {missing.argmax()}")
        return self.uv

    def on(
        self,
        vertices: ArrayLike,
        faces: ArrayLike,
        face_origin: ArrayLike | None = None,
        origins: Origins | None = None,
    ) -> Self:
        """Transfer coordinates and materials to a repaired, welded, divided or renumbered copy of the mesh.

        Corners are matched by their positions.

        Args:
            vertices: of the copy, shape [W, 3].
            faces: of the copy, shape [G, 3].
            face_origin: the triangle of this mesh that each of the copy was, -1 for a new one, shape [G]; by default
                that with its corners at the same places, in any order. New triangles get the first material,
                and coordinates of neighbouring triangles.
            origins: say which triangles of the copy are parts of one, as those of an exact map are.

        Raises:
            OmtwarpError: the copy's triangles are not where this mesh's are.
        """
        points, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int32)
        # A mesh of as many triangles, as unwrapping makes of a map, is divided as the copy is
        whole = triangles if origins is None or len(self.faces) >= len(triangles) else origins.whole_faces(triangles)
        origin = self._same_triangles(points, whole) if face_origin is None else np.asarray(face_origin)
        kept = np.flatnonzero(origin >= 0)
        here, there = points[whole[kept]], self.vertices[self.faces[origin[kept]]]
        apart = np.linalg.norm(here[:, :, None] - there[:, None, :], axis=3)
        corner = apart.argmin(axis=2)
        if len(kept) and apart.min(axis=2).max() > (SAME_PLACE if face_origin is None else WELD) * self._extent:
            raise OmtwarpError(ELSEWHERE)
        materials, objects = (
            None if known is None else np.where(origin >= 0, known[origin], 0).astype(np.int32)
            for known in (self.face_material, self.face_object)
        )
        part = np.flatnonzero((whole != triangles).any(axis=1)[kept])
        sides, inside = here[part, 1:] - here[part, :1], points[triangles[kept[part]]] - here[part, :1]
        share = np.round(8.0 * (inside @ np.linalg.pinv(sides))) / 8.0  # sides are halved alone
        share = np.concatenate([1.0 - share.sum(axis=2, keepdims=True), share], axis=2)

        uv = colors = None
        if self.uv is not None:
            own, at_vertex = self.uv[origin[kept, None], corner], np.full((len(points), 2), np.nan)
            own[part] = share @ own[part]
            at_vertex[triangles[kept]] = own
            uv = at_vertex[triangles]
            uv[kept] = own
        if self.vertex_colors is not None:
            shown = self.vertex_colors[self.faces[origin[kept, None], corner]]
            shown[part] = np.rint(share @ shown[part])
            colors = np.full((len(points), 4), 255, dtype=np.uint8)
            colors[triangles[kept]] = shown
        moved = replace(self, vertices=points, faces=triangles, uv=uv, face_material=materials, face_object=objects)
        return replace(moved, vertex_colors=colors, normals=None, layout=None)

    def export(
        self, path: str | os.PathLike[str], *, keep: Iterable[Path | None] = (), texture_format: str = TextureFormat.PNG
    ) -> list[Path]:
        """Write the mesh with its materials.

        ``.glb`` holds a primitive for every material, its pictures embedded; ``.obj`` is written with its ``.mtl`` and
        a ``.png`` for every picture in the same folder; ``.ply``, for a mesh of one material with a picture, holds the
        vertices and faces of the surface, undivided, with the picture's colour at every vertex.

        Args:
            path: the file to write. The files of an ``.obj`` take its name where that is free or taken by them already,
                and another name (``NAME-texture.png``) where the package did not write the file of that name.
            keep: more files that must not be replaced.
            texture_format: ``png``, or ``webp`` in a ``.glb``: the same texels in fewer bytes, for viewers that
                read the extension ``EXT_texture_webp``.

        Returns:
            The files written, the named one last.

        Raises:
            OmtwarpError: another suffix, or a place that cannot be written to. No file is left half written.
        """
        suffix, drawn = as_path(path).suffix.lower(), self.materials[0].picture is not None
        if suffix == ".ply" and drawn and len(self.materials) == 1:
            format_for(".ply", texture_format)
            surface = self.layout or self
            channels = zip(("red", "green", "blue", "alpha"), self.colors_at_vertices().T, strict=True)
            write_mesh(path, surface.vertices, surface.faces, beside=dict(channels))
            return [as_path(path)]
        normals = self.unit_normals()
        parts = [self._part(int(number), normals) for number in np.unique(self.material_of)]
        model = Model(self.vertices, normals, parts, self.vertex_colors, (self.wraps, self.wraps_rows), self.objects)
        return export(path, model, (*keep, *self.source_files), texture_format)

    def colors_at_vertices(self) -> Bytes:
        """Return red, green, blue and alpha of the first picture at the surface's vertices, uint8, shape [V, 4]."""
        if self.layout is None:
            place = np.zeros((len(self.vertices), 2))
            place[self.faces] = self._known_uv()
            size = self.image.shape[1::-1]
            at = np.floor(place * (1.0, -1.0) % 1.0 * size).astype(np.int64)
            column, row = np.minimum(at, np.subtract(size, 1)).T
            values: NDArray = self.image[row, column]
        else:
            values = self.layout.sampled(self.image)
        colors = np.full((len(values), 4), 255, dtype=np.uint8)
        colors[:, : values.shape[1]] = as_bytes(values)
        return colors

    def unit_normals(self) -> Floats:
        """Return the normals at the vertices, shape [V, 3]: those given, or the mean of the triangles around each."""
        return unit_normals(vertex_normals(self.vertices, self.faces)) if self.normals is None else self.normals

    def _part(self, number: int, normals: Floats) -> Part:
        """Return the triangles of one material; corners that agree in all attributes share a row."""
        material, of_it = self.materials[number], self.material_of == number
        belongs = None if self.face_object is None else self.face_object[of_it]
        used, local = np.unique(self.faces[of_it], return_inverse=True)
        corners = local.reshape(-1, 3).astype(np.int32)
        if self.uv is None or not np.isfinite(self.uv[of_it]).all():
            return Part(material, corners, used, belongs=belongs)
        values = self.uv[of_it]
        if material.normal_picture is not None and material.own_tangents:
            tangents = corner_tangents(self.vertices, self.faces[of_it], values, normals)
            values = np.concatenate([values, tangents], axis=2)
        rows, vertex, values = split_corners(corners, values, len(used))
        turned = values[:, 2:] if values.shape[1] > 2 else None
        return Part(material, rows, used[vertex], values[:, :2], turned, belongs)

    @property
    def _extent(self) -> float:
        """Return the largest side of the box around the mesh."""
        return float(np.ptp(self.vertices, axis=0).max(initial=0.0))

    def _same_triangles(self, points: Floats, triangles: Ints) -> Ints:
        """Return, for each triangle of a copy, this mesh's triangle in the same place, shape [G].

        Raises:
            OmtwarpError: a triangle of the copy has no triangle of this mesh in its place.
        """
        if len(triangles) == len(self.faces):  # in the same order, mostly
            if np.abs(points[triangles] - self.vertices[self.faces]).max(initial=0.0) <= SAME_PLACE * self._extent:
                return np.arange(len(triangles), dtype=np.int32)
        places, number = np.unique(points + 0.0, axis=0, return_inverse=True)
        from scipy.spatial import cKDTree

        distance, nearest = cKDTree(places).query(self.vertices)
        unused = len(places)  # index of vertices that are not in the copy
        here = np.where(distance <= SAME_PLACE * self._extent, nearest, unused)[self.faces]
        if (here == unused).all():
            raise OmtwarpError(ELSEWHERE)
        keys, wanted = np.sort(here, axis=1), np.sort(number.reshape(-1)[triangles], axis=1)
        key = np.unique(np.concatenate([keys, wanted]), axis=0, return_inverse=True)[1].reshape(-1)
        place = np.full(int(key.max(initial=-1)) + 1, -1, dtype=np.int32)
        place[key[: len(keys)][::-1]] = np.arange(len(keys), dtype=np.int32)[::-1]  # the first of several wins
        origin = place[key[len(keys) :]]
        lost = origin < 0
        if lost.any():
            raise OmtwarpError(
                f"{lost.sum()} of the map's {len(triangles)} faces are not in the mesh, first face {lost.argmax()}: "
                "give the mesh that was mapped, or, for one that a texture's seams cut, leave out the map"
            )
        return origin


def joined_seams(mesh: PaintedMesh) -> PaintedMesh:
    """Join vertices of boundaries that lie at the same place, as formats double them along seams of a texture.

    Faces keep their numbers and corners; vertices keep their order, without copies.
    """
    number = seam_copies(mesh.vertices, mesh.faces) if len(mesh.faces) else None
    if number is None:
        return mesh
    stays, after = compressed(number)
    notes = (*mesh.notes, f"joined {len(stays) - int(stays.sum())} copies of vertices along seams")
    colors = None if mesh.vertex_colors is None else mesh.vertex_colors[stays]
    points, faces = mesh.vertices[stays], after[mesh.faces].astype(np.int32)
    return replace(mesh, vertices=points, faces=faces, vertex_colors=colors, notes=notes)


def as_painted(mesh: object) -> PaintedMesh:
    """Return a mesh with its coordinates and materials, the argument itself.

    Raises:
        OmtwarpError: it is none, but a file's name, or a mesh without coordinates and materials.
    """
    if not isinstance(mesh, PaintedMesh):
        raise OmtwarpError(f"expected a PaintedMesh, got {type(mesh).__name__}: read it with read_painted_mesh")
    return mesh
