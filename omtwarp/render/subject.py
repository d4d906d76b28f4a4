"""Conversion of a file, a trimesh mesh or a finished map to a :class:`SurfaceView`."""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeAlias, TypeGuard, cast, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from omtwarp.colors import to_srgb
from omtwarp.errors import OmtwarpError
from omtwarp.mesh.arrays import Bytes, HasTriangles
from omtwarp.render.scene import SurfaceMaterial, SurfaceView
from omtwarp.texturing.image import PictureLike
from omtwarp.texturing.materials import WHITE

if TYPE_CHECKING:  # a picture of triangles loads neither Warp nor SciPy, which these need
    import trimesh

    from omtwarp.maps.torus_map import TorusMap
    from omtwarp.texturing.painted import PaintedMesh


@runtime_checkable
class FinishedMap(HasTriangles, Protocol):
    """A surface with its final and its conformal map, such as a :class:`omtwarp.MapResult`."""

    @property
    def sphere(self) -> ArrayLike:
        """Images of the vertices, shape [V, 3]."""

    @property
    def conformal(self) -> ArrayLike | None:
        """Images of the vertices by the conformal map, shape [V, 3]."""


@runtime_checkable
class _Textured(HasTriangles, Protocol):
    uv: ArrayLike
    image: Picture


Picture: TypeAlias = PictureLike
Subject: TypeAlias = "str | os.PathLike[str] | HasTriangles | SurfaceView | tuple[ArrayLike, ArrayLike]"


def is_torus_map(subject: object) -> TypeGuard[TorusMap]:
    """Return whether a subject is a map to a torus."""
    return _is_a(subject, "omtwarp.maps.torus_map", "TorusMap")


def _is_painted(subject: object) -> TypeGuard[PaintedMesh]:
    """Return whether a subject is a mesh with materials."""
    return _is_a(subject, "omtwarp.texturing.painted", "PaintedMesh")


def _is_a(subject: object, module: str, name: str) -> bool:
    """Return whether a subject is of a class, of which one exists only where its module is loaded."""
    return module in sys.modules and isinstance(subject, getattr(sys.modules[module], name))


def as_surface_view(subject: Subject, image: Picture | None = None) -> SurfaceView:
    """Make a view of a file, a ``trimesh.Trimesh``, a ``MapResult``, ``TexturedSurface``, (vertices, faces) or a view.

    Args:
        subject: what to look at. Textures, texture coordinates and colours of files and trimesh meshes are kept.
        image: equirectangular picture (file, PIL image or array) for a subject that has points on the sphere.

    Raises:
        OmtwarpError: the subject cannot be read or is nothing that can be drawn.
    """
    if isinstance(subject, SurfaceView):
        view = subject
    elif isinstance(subject, (str, os.PathLike)):
        path = Path(subject)
        if path.suffix.lower() == ".npz":
            from omtwarp.maps.torus_map import read_map

            found = read_map(path)
            return torus_view(found, image) if is_torus_map(found) else map_view(cast(FinishedMap, found), image)
        view = _file_view(path)
    elif is_torus_map(subject):
        return torus_view(subject, image)
    elif isinstance(subject, FinishedMap):
        return map_view(subject, image)
    elif hasattr(subject, "visual") and hasattr(subject, "faces"):
        view = _from_trimesh(cast("trimesh.Trimesh", subject))
    elif _is_painted(subject):
        view = painted_view(subject)
    elif isinstance(subject, (tuple, list)) and len(subject) == 2:
        view = SurfaceView(*subject)
    elif isinstance(subject, _Textured):
        view = SurfaceView(subject.vertices, subject.faces, image=subject.image, uv=subject.uv)
    elif isinstance(subject, HasTriangles):
        view = SurfaceView(subject.vertices, subject.faces)
    else:
        raise OmtwarpError(
            f"cannot draw a {type(subject).__name__}: "
            "give a mesh file, a trimesh mesh, a map, (vertices, faces) or a SurfaceView"
        )
    if image is not None:
        if view.sphere is None:
            raise OmtwarpError(
                "an image was given, but this subject has no points on the sphere to look it up: give a map"
            )
        view = replace(view, image=image, uv=None, colors=None, scalar=None)
    return view


def map_view(
    result: FinishedMap, image: Picture | None = None, *, which: str = "optimal", on: str = "surface", caption: str = ""
) -> SurfaceView:
    """Return a view of a finished map: the surface or its sphere, with an image carried over by the map.


    Args:
        result: has ``vertices``, ``faces``, ``sphere`` and ``conformal``.
        image: equirectangular picture; None draws a checker of 24 by 12 cells, tinted by longitude.
        which: ``"optimal"`` (the final map) or ``"conformal"``.
        on: ``"surface"`` or ``"sphere"``.
        caption: text for a sheet.

    Raises:
        OmtwarpError: a choice is unknown, or the map has no such stage.
    """
    if which not in ("optimal", "conformal") or on not in ("surface", "sphere"):
        raise OmtwarpError(f"unknown view ('{which}', '{on}'): use optimal or conformal, and surface or sphere")
    sphere = result.sphere if which == "optimal" else result.conformal
    if sphere is None:
        raise OmtwarpError(f"this map has no {which} stage to show")
    picture = checker_image() if image is None else image
    if on == "sphere":
        return SurfaceView(sphere, result.faces, image=picture, sphere=sphere, up="z", front="+x", caption=caption)
    return SurfaceView(result.vertices, result.faces, image=picture, sphere=sphere, caption=caption)


def torus_view(
    result: TorusMap,
    image: Picture | None = None,
    *,
    which: str = "optimal",
    on: str = "surface",
    pattern: str = "circles",
) -> SurfaceView:
    """Return a view of a map to a torus: the surface, or the ring torus, with a picture that repeats both ways.

    Args:
        result: the map.
        image: the picture; a pattern where there is none.
        which: ``"optimal"`` (the final map) or ``"conformal"``.
        on: ``"surface"`` or ``"torus"``, the ring torus.
        pattern: ``circles`` or ``checker``.

    Raises:
        OmtwarpError: a choice is unknown.
    """
    if which not in ("optimal", "conformal") or on not in ("surface", "torus"):
        raise OmtwarpError(f"unknown view ('{which}', '{on}'): use optimal or conformal, and surface or torus")
    shown = result if which == "optimal" else replace(result, coordinates=result.conformal)
    from omtwarp.texturing.textured import texture_torus

    cut = texture_torus(shown, image, None if image is not None else pattern)
    places = cut.vertices if on == "surface" else shown.ring()[cut.welded]
    return SurfaceView(places, cut.faces, image=cut.image, uv=cut.uv, up=None if on == "surface" else "z")


def checker_image() -> Bytes:
    """Return an equirectangular checker whose dark cells go around the colour wheel with longitude, uint8 [H, W, 3]."""
    columns, rows, cell = 24, 12, 64  # fields around the equator and from pole to pole, and texels along each
    column, row = (np.arange(count * cell) // cell for count in (columns, rows))
    turn = 2.0 * np.pi * column / columns
    dark = np.stack([0.33 + 0.22 * np.cos(turn + shift) for shift in (0.4, -1.9, 2.6)], axis=-1)
    light = np.array([0.96, 0.94, 0.90])
    chosen = ((row[:, None] + column[None, :]) % 2)[..., None]
    return np.rint(255.0 * np.where(chosen == 1, light, dark[None])).astype(np.uint8)


def _file_view(path: Path) -> SurfaceView:
    """Return a view of a mesh file; of one with several materials, every triangle in its own."""
    from omtwarp.texturing.read import read_painted_mesh

    return painted_view(read_painted_mesh(path))


def painted_view(mesh: PaintedMesh) -> SurfaceView:
    """Return a view of a mesh with materials; of colours at the vertices alone where no material has an appearance."""
    plain = all(material.picture is None and material.color == WHITE for material in mesh.materials)
    if plain:
        return SurfaceView(mesh.vertices, mesh.faces, colors=mesh.vertex_colors)
    materials = []
    for number, material in enumerate(mesh.materials):
        image, uv = material.picture, mesh.uv
        known = uv is not None and np.isfinite(uv[mesh.material_of == number]).all()
        color = None if material.color[:3] == WHITE[:3] else material.color[:3]
        materials.append(SurfaceMaterial(image if known else None, color))
    uv = None if mesh.uv is None else np.nan_to_num(mesh.uv)
    if not any(material.image is not None for material in materials):
        uv = None
    return SurfaceView(mesh.vertices, mesh.faces, uv=uv, materials=materials, face_material=mesh.material_of)


def _from_trimesh(mesh: trimesh.Trimesh) -> SurfaceView:
    from trimesh.visual import ColorVisuals, TextureVisuals  # heavy, and loaded by whoever has a mesh of trimesh's

    vertices, faces, visual = np.asarray(mesh.vertices), np.asarray(mesh.faces), mesh.visual
    kind = getattr(visual, "kind", None)
    if kind == "texture" and isinstance(visual, TextureVisuals):
        material, uv = visual.material, visual.uv
        picture = getattr(material, "baseColorTexture", None)
        if picture is None:
            picture = getattr(material, "image", None)
        factor = getattr(material, "baseColorFactor", None)
        color = None if factor is None else _factor(factor)
        if picture is not None and uv is not None and len(uv) == len(vertices):
            return SurfaceView(vertices, faces, image=picture, uv=np.asarray(uv)[:, :2], color=color)
        return SurfaceView(vertices, faces, color=color)
    if kind == "vertex" and isinstance(visual, ColorVisuals):
        return SurfaceView(vertices, faces, colors=np.asarray(visual.vertex_colors))
    if kind == "face" and isinstance(visual, ColorVisuals):
        return SurfaceView(vertices, faces, colors=np.asarray(visual.face_colors))
    return SurfaceView(vertices, faces)


def _factor(factor: ArrayLike) -> tuple[float, float, float] | None:
    """Return the sRGB colour of a glTF material's factor, which is linear; None for white."""
    values = np.asarray(factor)
    scaled = values / 255.0 if np.issubdtype(values.dtype, np.integer) else values.astype(np.float64)
    red, green, blue = (float(channel) for channel in to_srgb(scaled[:3]))
    return None if (red, green, blue) == (1.0, 1.0, 1.0) else (red, green, blue)
