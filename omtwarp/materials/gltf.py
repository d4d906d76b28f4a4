"""Meshes with several materials as binary glTF 2.0: a primitive for every material, every picture embedded once."""

from __future__ import annotations

import numpy as np

from omtwarp.materials.base import Floats, Ints, Material, PaintedArrays, linear
from omtwarp.materials.tangents import corner_tangents
from omtwarp.options import TextureFormat
from omtwarp.texturing.gltf import GltfFile, flipped_rows, single_precision
from omtwarp.texturing.textured import vertex_normals

# For coordinates of materials that have no picture: a file's checkers and some programs take coordinates that nothing
# refers to for a mistake, or drop them. White leaves the material's colour as it is.
BLANK = np.full((1, 1, 3), 255, dtype=np.uint8)


def glb_bytes(mesh: PaintedArrays, texture_format: TextureFormat = TextureFormat.PNG) -> bytes:
    """Write a mesh with its materials as a binary glTF 2.0 file.

    Raises:
        OmtwarpError: positions are too large for single precision.
    """
    file = GltfFile(True, mesh.wraps_rows, texture_format)
    normals = vertex_normals(mesh.vertices, mesh.faces)
    normals = np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0, normals, (0.0, 0.0, 1.0))
    primitives: list[dict[str, object]] = []
    materials: list[dict[str, object]] = []
    for number in np.unique(mesh.material_of):
        material = mesh.materials[number]
        of_it = np.flatnonzero(mesh.material_of == number)
        uv = None if mesh.uv is None else mesh.uv[of_it]
        if uv is not None and not np.isfinite(uv).all():
            uv = None
        tangents = None
        if uv is not None and material.normal_picture is not None and material.own_tangents:
            tangents = corner_tangents(mesh.vertices, mesh.faces[of_it], uv, normals)
        primitives.append(_primitive(file, mesh, mesh.faces[of_it], uv, normals, tangents))
        materials.append(_material(material, file, uv is not None))
    return file.content(primitives, materials)


def _primitive(
    file: GltfFile, mesh: PaintedArrays, faces: Ints, uv: Floats | None, normals: Floats, tangents: Floats | None
) -> dict[str, object]:
    """Return the attributes and indices of triangles; corners that agree in all attributes share a row."""
    columns = [faces.reshape(-1, 1).astype(np.float64)]
    columns += [] if uv is None else [uv.reshape(-1, 2)]
    columns += [] if tangents is None else [tangents.reshape(-1, 4)]
    _, first, inverse = np.unique(np.concatenate(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    vertex = faces.ravel()[first]
    attributes = {
        "POSITION": file.accessor(single_precision(mesh.vertices[vertex], "positions"), bounds=True),
        "NORMAL": file.accessor(normals[vertex].astype(np.float32)),
    }
    if uv is not None:
        attributes["TEXCOORD_0"] = file.accessor(flipped_rows(uv.reshape(-1, 2)[first]))
    if tangents is not None:
        attributes["TANGENT"] = file.accessor(tangents.reshape(-1, 4)[first].astype(np.float32))
    if mesh.vertex_colors is not None:
        attributes["COLOR_0"] = file.accessor(linear(mesh.vertex_colors[vertex] / 255.0).astype(np.float32))
    return {"attributes": attributes, "indices": file.accessor(inverse.reshape(-1).astype(np.uint32))}


def _material(material: Material, file: GltfFile, with_uv: bool) -> dict[str, object]:
    """Convert a material to glTF's JSON, with pictures only where the mesh has texture coordinates.

    A material without pictures gets a white texel, so that the coordinates belong to something.
    """
    color = linear(np.array(material.color))
    surface: dict[str, object] = {
        "baseColorFactor": [float(x) for x in color],
        "metallicFactor": material.metallic,
        "roughnessFactor": material.roughness,
    }
    entry: dict[str, object] = {
        "name": material.name,
        "pbrMetallicRoughness": surface,
        "alphaMode": "OPAQUE" if material.opaque else "BLEND",
        "doubleSided": material.two_sided,
    }
    if any(material.emission):
        entry["emissiveFactor"] = list(material.emission)
    if not with_uv:
        return entry
    if material.plain:
        surface["baseColorTexture"] = file.texture(BLANK, "blank")
    for place, slot, picture, ending in (
        (surface, "baseColorTexture", material.picture, "color"),
        (surface, "metallicRoughnessTexture", material.roughness_picture, "roughness"),
        (entry, "normalTexture", material.normal_picture, "normal"),
        (entry, "occlusionTexture", material.occlusion_picture, "occlusion"),
        (entry, "emissiveTexture", material.emission_picture, "emission"),
    ):
        if picture is not None:
            place[slot] = file.texture(picture, f"{material.name}-{ending}")
    return entry


__all__ = ["glb_bytes"]
