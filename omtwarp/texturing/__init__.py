"""Textures and materials of meshes: patterns, atlases, baking, transfer, own coordinates, reading and export.

Names are imported at their first use, so that importing the package does not start Warp.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omtwarp.texturing.adaptive import rasterize as rasterize
    from omtwarp.texturing.atlas import ATLASES as ATLASES
    from omtwarp.texturing.atlas import make_atlas as make_atlas
    from omtwarp.texturing.bakes import BAKES as BAKES
    from omtwarp.texturing.baking import VertexValues as VertexValues
    from omtwarp.texturing.baking import bake as bake
    from omtwarp.texturing.baking import bake_to_uv as bake_to_uv
    from omtwarp.texturing.baking import bake_vertex_values as bake_vertex_values
    from omtwarp.texturing.baking import sample as sample
    from omtwarp.texturing.image import direction_to_image as direction_to_image
    from omtwarp.texturing.image import read_image as read_image
    from omtwarp.texturing.image import rotation_matrix as rotation_matrix
    from omtwarp.texturing.materials import Material as Material
    from omtwarp.texturing.painted import PaintedMesh as PaintedMesh
    from omtwarp.texturing.painter import paint as paint
    from omtwarp.texturing.patterns import Pattern as Pattern
    from omtwarp.texturing.patterns import pattern as pattern
    from omtwarp.texturing.read import read_painted_mesh as read_painted_mesh
    from omtwarp.texturing.seams import unwrap as unwrap
    from omtwarp.texturing.textured import TexturedSurface as TexturedSurface
    from omtwarp.texturing.textured import texture as texture
    from omtwarp.texturing.unwrap import unwrap_uv as unwrap_uv


_HOMES = {
    "Material": "materials",
    "PaintedMesh": "painted",
    "read_painted_mesh": "read",
    "TexturedSurface": "textured",
    "texture": "textured",
    "pattern": "patterns",
    "rasterize": "adaptive",
    "Pattern": "patterns",
    "make_atlas": "atlas",
    "ATLASES": "atlas",
    "unwrap": "seams",
    "bake": "baking",
    "bake_to_uv": "baking",
    "bake_vertex_values": "baking",
    "VertexValues": "baking",
    "sample": "baking",
    "read_image": "image",
    "direction_to_image": "image",
    "rotation_matrix": "image",
    "BAKES": "bakes",
    "paint": "painter",
    "unwrap_uv": "unwrap",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
