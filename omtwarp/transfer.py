"""Transfer of a texture from one surface to another, point by point through their maps to the sphere."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from omtwarp.alignment import align
from omtwarp.device.policy import resolve_device
from omtwarp.device.start import wp
from omtwarp.errors import OmtwarpError, OmtwarpWarning, check_word, truth
from omtwarp.maps.result import MapResult
from omtwarp.mesh.arrays import Floats, SphereMap
from omtwarp.options import AtlasLike, CoordinatesLike
from omtwarp.resampling import SpherePoints, as_points
from omtwarp.spheres import mesh_grid
from omtwarp.texturing.atlas import SIZE, Atlas, make_atlas
from omtwarp.texturing.baking import PADDING, bake_materials, bake_to_uv, own_at_parts, picture_source, sphere_layout
from omtwarp.texturing.export import Material
from omtwarp.texturing.image import as_bytes, without_full_opacity
from omtwarp.texturing.painted import PaintedMesh, as_painted
from omtwarp.texturing.seams import unwrap
from omtwarp.texturing.textured import as_map

Map = SphereMap | tuple[ArrayLike, ArrayLike, ArrayLike]


def transfer_texture(
    mesh: PaintedMesh,
    result: Map,
    other: Map,
    *,
    onto: PaintedMesh | None = None,
    uv: CoordinatesLike = "own",
    aligned: bool = False,
    mirror: bool = False,
    atlas: AtlasLike = "cube",
    size: int | None = None,
    device: str | None = "auto",
) -> PaintedMesh:
    """Transfer the texture of one surface to another, each mapped to the sphere.

    The other map is rotated until the two surfaces' features agree best (:func:`omtwarp.align`), or the surfaces lie as
    they do in space where they have none, which a warning says; then each point of the
    other surface takes the colour of the point that lies at the same place of the sphere. Colours come from all
    materials of the mesh, or from its vertices where they have none.

    Args:
        mesh: the mesh with the texture (:func:`omtwarp.read_painted_mesh`).
        result: its map: a :class:`~omtwarp.MapResult`, anything with ``vertices``, ``faces`` and ``sphere``, or the
            three as a tuple.
        other: the map of the surface that gets the texture, in the same forms.
        onto: the other mesh, to get the texture in its own coordinates and keep its names of objects.
        uv: ``own``, or ``atlas`` for new coordinates, as without ``onto``.
        aligned: the two maps are aligned already and are not rotated.
        mirror: try the mirror image of the other surface too, for a left and a right part.
        atlas: as in :func:`omtwarp.texture`, for new coordinates.
        size: width of the picture in texels; 2048 by default.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Returns:
        The other surface with the texture; ``.export("name.glb")`` writes it.

    Raises:
        OmtwarpError: a mesh without colours, or a map of another mesh.

    Example:
        >>> import omtwarp
        >>> surface = omtwarp.shapes.blob(seed=3, sphere=320)
        >>> result = omtwarp.map_to_sphere(surface, until="conformal", device="cpu")
        >>> painted = omtwarp.paint(result, omtwarp.unwrap_uv(result), pattern="checker", size=96)
        >>> same = omtwarp.transfer_texture(painted, result, result, size=96)
        >>> same.materials[0].picture.shape
        (64, 96, 3)
    """
    check_word("texture coordinates", uv, ("own", "atlas"))
    where = resolve_device(device)
    vertices, faces, sphere = as_map(result)
    there, triangles, points = as_map(other)
    source = as_painted(mesh).on(vertices, faces, origins=getattr(result, "origins", None))
    plain = all(material.picture is None for material in source.materials)
    if plain and len(source.materials) == 1 and source.vertex_colors is None:
        raise OmtwarpError("nothing to transfer: the mesh has neither a picture nor colours")
    if not truth(aligned, "aligned"):
        moving, fixed = _points(other), _points(result)
        # Equal faces alone do not make vertices correspond: two subdivided spheres have them.
        same = np.array_equal(moving.grid.triangles, fixed.grid.triangles) and np.allclose(there, vertices)
        alignment = align(moving, fixed, by="vertices" if same else "features", mirror=mirror, check=False)
        if alignment.method == "places":
            text = (
                "a surface has no features to align by, as a ball has none: colours keep their directions in space "
                "(their places on the sphere with aligned=True)"
            )
            warnings.warn(text, OmtwarpWarning, stacklevel=2)
        points = alignment.sphere
    layout = make_atlas(atlas, size if size is not None else SIZE)
    picture = _on_sphere(source, sphere, layout, where)
    own = None if onto is None else as_painted(onto).on(there, triangles, origins=getattr(other, "origins", None))
    if own is not None and uv == "own":
        coordinates = own.require_uv("the mesh that gets the texture")
        baked = bake_to_uv(
            picture_source(picture, layout, where), points, triangles, coordinates, size=size or SIZE, padding=PADDING,
            device=where,
        )  # fmt: skip
        if picture[..., 3].min() == 1.0:
            baked[..., 3] = 1.0  # also where nothing is
        material = _material(source, baked)
        return replace(own, uv=coordinates, materials=(material,), face_material=None, vertex_colors=None, notes=())
    cut = unwrap(points, triangles, layout)
    objects, numbers = ((), None) if own is None else (own.objects, own.face_object)
    return PaintedMesh(
        cut.weights @ there, cut.faces, cut.uv, (_material(source, picture),), wraps_rows=False, objects=objects,
        face_object=None if numbers is None else numbers[cut.source_face],
    )  # fmt: skip


def _points(result: Map) -> SpherePoints:
    if isinstance(result, MapResult):
        return as_points(result, "the map")  # with what fills its holes
    vertices, faces, sphere = as_map(result)
    return SpherePoints(mesh_grid(sphere, faces, "the map"), vertices)


def _on_sphere(mesh: PaintedMesh, sphere: Floats, atlas: Atlas, where: wp.Device) -> NDArray[np.float32]:
    """Return a mesh's colours on the picture of an atlas, sRGB and opacity from 0 to 1, float32 [H, W, 4]."""
    cut = unwrap(sphere, mesh.faces, atlas)
    layout, part = sphere_layout(cut, atlas, sphere, where)
    own = None if mesh.uv is None else np.nan_to_num(own_at_parts(cut, mesh.faces, mesh.uv))[part]
    given = mesh.vertex_colors
    colors = None if given is None else (cut.weights @ (given / 255.0))[cut.faces][part]
    return bake_materials(layout, own, mesh.material_of[cut.source_face][part], mesh.materials, colors, -1)


def _material(mesh: PaintedMesh, picture: NDArray[np.float32]) -> Material:
    """Make a material of the transferred picture, as rough and metallic as the mesh's most common material."""
    common = mesh.materials[int(np.bincount(mesh.material_of).argmax())].on_other_coordinates()
    texels = without_full_opacity(as_bytes(picture))
    return Material("transferred", picture=texels, metallic=common.metallic, roughness=common.roughness)
