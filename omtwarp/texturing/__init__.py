"""Textures and materials of meshes: patterns, atlases, baking, transfer, own coordinates, reading and export.

Names are imported at their first use, so that importing the package does not start Warp.
"""

from typing import TYPE_CHECKING

from omtwarp import _at_first_use

if TYPE_CHECKING:
    from omtwarp.texturing.adaptive import rasterize as rasterize
    from omtwarp.texturing.atlas import ATLASES as ATLASES, make_atlas as make_atlas
    from omtwarp.texturing.bakes import BAKES as BAKES
    from omtwarp.texturing.baking import (
        VertexValues as VertexValues,
        bake as bake,
        bake_to_uv as bake_to_uv,
        bake_vertex_values as bake_vertex_values,
        sample as sample,
    )
    from omtwarp.texturing.export import Material as Material
    from omtwarp.texturing.image import (
        direction_to_image as direction_to_image,
        read_image as read_image,
        rotation_matrix as rotation_matrix,
    )
    from omtwarp.texturing.painted import PaintedMesh as PaintedMesh
    from omtwarp.texturing.painter import paint as paint
    from omtwarp.texturing.patterns import Pattern as Pattern, pattern as pattern
    from omtwarp.texturing.read import read_painted_mesh as read_painted_mesh
    from omtwarp.texturing.seams import unwrap as unwrap
    from omtwarp.texturing.textured import texture as texture
    from omtwarp.texturing.unwrap import unwrap_uv as unwrap_uv

__all__, __getattr__, __dir__ = _at_first_use(__name__)
