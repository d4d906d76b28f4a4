"""Meshes with several materials as binary glTF 2.0: a primitive for every material, every picture embedded once."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from omtwarp.errors import OmtwarpError
from omtwarp.materials.base import Bytes, Floats, Ints, Material, PaintedArrays, linear
from omtwarp.materials.tangents import corner_tangents
from omtwarp.texturing.export import (
    ARRAY_BUFFER,
    CLAMP,
    ELEMENT_ARRAY_BUFFER,
    FLOAT,
    LINEAR,
    LINEAR_MIPMAP_LINEAR,
    REPEAT,
    UNSIGNED_INT,
    png_bytes,
)
from omtwarp.texturing.textured import vertex_normals

_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}


class _Binary:
    """The binary part of a file, with the views and accessors into it."""

    def __init__(self) -> None:
        self.blob = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, target: int | None = None) -> int:
        """Append bytes and return the number of their view."""
        self.blob.extend(b"\0" * (-len(self.blob) % 4))
        entry: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(content)}
        if target is not None:
            entry["target"] = target
        self.views.append(entry)
        self.blob.extend(content)
        return len(self.views) - 1

    def accessor(self, array: NDArray, bounds: bool = False) -> int:
        """Append rows of numbers, float32 or uint32 indices, and return the number of their accessor."""
        indices = array.dtype == np.uint32
        entry: dict[str, Any] = {
            "bufferView": self.view(array.tobytes(), ELEMENT_ARRAY_BUFFER if indices else ARRAY_BUFFER),
            "componentType": UNSIGNED_INT if indices else FLOAT,
            "count": len(array),
            "type": _KINDS[1 if array.ndim == 1 else array.shape[1]],
        }
        if bounds:
            entry["min"] = [float(x) for x in array.min(axis=0)]
            entry["max"] = [float(x) for x in array.max(axis=0)]
        self.accessors.append(entry)
        return len(self.accessors) - 1


def glb_bytes(mesh: PaintedArrays) -> bytes:
    """Write a mesh with its materials as a binary glTF 2.0 file.

    Raises:
        OmtwarpError: positions that single precision does not hold.
    """
    largest = float(np.abs(mesh.vertices).max(initial=0.0))
    if largest > np.finfo(np.float32).max:
        raise OmtwarpError(
            f"cannot write positions up to {largest:.3g} as GLB, which holds 32-bit numbers: scale the mesh down"
        )
    binary = _Binary()
    normals = vertex_normals(mesh.vertices, mesh.faces)
    normals = np.where(np.linalg.norm(normals, axis=1, keepdims=True) > 0, normals, (0.0, 0.0, 1.0))
    pictures = _Pictures(binary, mesh.wraps_rows)
    primitives: list[dict[str, Any]] = []
    materials: list[dict[str, Any]] = []
    for number in np.unique(mesh.material_of):
        material = mesh.materials[number]
        of_it = np.flatnonzero(mesh.material_of == number)
        uv = None if mesh.uv is None else mesh.uv[of_it]
        if uv is not None and not np.isfinite(uv).all():
            uv = None
        tangents = None
        if uv is not None and material.normal_picture is not None and material.own_tangents:
            tangents = corner_tangents(mesh.vertices, mesh.faces[of_it], uv, normals)
        primitives.append(
            {
                "attributes": {},
                "material": len(materials),
                "mode": 4,
                **_primitive(binary, mesh, mesh.faces[of_it], uv, normals, tangents),
            }
        )
        materials.append(_material(material, pictures, uv is not None))
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "omtwarp"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "surface"}],
        "meshes": [{"name": "surface", "primitives": primitives}],
        "materials": materials,
        "accessors": binary.accessors,
        "bufferViews": binary.views,
    }
    if pictures.images:
        document |= {"textures": pictures.textures, "samplers": [pictures.sampler], "images": pictures.images}
    binary.blob.extend(b"\0" * (-len(binary.blob) % 4))
    document["buffers"] = [{"byteLength": len(binary.blob)}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    blob = bytes(binary.blob)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(blob))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob


def _primitive(
    binary: _Binary, mesh: PaintedArrays, faces: Ints, uv: Floats | None, normals: Floats, tangents: Floats | None
) -> dict[str, Any]:
    """The attributes and indices of triangles, with one row for every different corner."""
    columns = [faces.reshape(-1, 1).astype(np.float64)]
    columns += [] if uv is None else [uv.reshape(-1, 2)]
    columns += [] if tangents is None else [tangents.reshape(-1, 4)]
    _, first, inverse = np.unique(np.concatenate(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    vertex = faces.ravel()[first]
    attributes = {
        "POSITION": binary.accessor(mesh.vertices[vertex].astype(np.float32), bounds=True),
        "NORMAL": binary.accessor(normals[vertex].astype(np.float32)),
    }
    if uv is not None:
        # glTF's texture coordinates have their origin at the top left.
        rows = uv.reshape(-1, 2)[first] * (1.0, -1.0) + (0.0, 1.0)
        attributes["TEXCOORD_0"] = binary.accessor(rows.astype(np.float32))
    if tangents is not None:
        attributes["TANGENT"] = binary.accessor(tangents.reshape(-1, 4)[first].astype(np.float32))
    if mesh.vertex_colors is not None:
        attributes["COLOR_0"] = binary.accessor(linear(mesh.vertex_colors[vertex] / 255.0).astype(np.float32))
    return {"attributes": attributes, "indices": binary.accessor(inverse.reshape(-1).astype(np.uint32))}


class _Pictures:
    """Pictures of a file, each embedded once however many materials share it."""

    def __init__(self, binary: _Binary, wraps_rows: bool):
        self._binary = binary
        self._known: dict[int, int] = {}
        self.images: list[dict[str, Any]] = []
        self.textures: list[dict[str, Any]] = []
        self.sampler = {
            "magFilter": LINEAR,
            "minFilter": LINEAR_MIPMAP_LINEAR,
            "wrapS": REPEAT,
            "wrapT": REPEAT if wraps_rows else CLAMP,
        }

    def texture(self, picture: Bytes, name: str) -> dict[str, int]:
        """Embed a picture and return how a material refers to it."""
        if id(picture) not in self._known:
            self._known[id(picture)] = len(self.images)
            view = self._binary.view(png_bytes(picture))
            self.images.append({"bufferView": view, "mimeType": "image/png", "name": name})
            self.textures.append({"sampler": 0, "source": len(self.images) - 1})
        return {"index": self._known[id(picture)], "texCoord": 0}


def _material(material: Material, pictures: _Pictures, with_uv: bool) -> dict[str, Any]:
    """A material in the words of glTF; its pictures only where there are coordinates to look them up."""
    color = linear(np.array(material.color))
    surface: dict[str, Any] = {
        "baseColorFactor": [float(x) for x in color],
        "metallicFactor": material.metallic,
        "roughnessFactor": material.roughness,
    }
    entry: dict[str, Any] = {
        "name": material.name,
        "pbrMetallicRoughness": surface,
        "alphaMode": "OPAQUE" if material.opaque else "BLEND",
        "doubleSided": material.two_sided,
    }
    if any(material.emission):
        entry["emissiveFactor"] = list(material.emission)
    if not with_uv:
        return entry
    for place, slot, picture, ending in (
        (surface, "baseColorTexture", material.picture, "color"),
        (surface, "metallicRoughnessTexture", material.roughness_picture, "roughness"),
        (entry, "normalTexture", material.normal_picture, "normal"),
        (entry, "occlusionTexture", material.occlusion_picture, "occlusion"),
        (entry, "emissiveTexture", material.emission_picture, "emission"),
    ):
        if picture is not None:
            place[slot] = pictures.texture(picture, f"{material.name}-{ending}")
    return entry


__all__ = ["glb_bytes"]
