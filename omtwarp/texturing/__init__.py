"""Textures on surfaces through their maps to the sphere: patterns, atlases, baking and export.

Names are looked up when they are used, so that importing the package does not start Warp.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "TexturedSurface": "textured",
    "texture": "textured",
    "pattern": "patterns",
    "rasterize": "rasterizing",
    "Pattern": "patterns",
    "PATTERNS": "patterns",
    "make_atlas": "atlas",
    "ATLASES": "atlas",
    "unwrap": "seams",
    "bake": "baking",
    "bake_to_uv": "baking",
    "bake_vertex_values": "baking",
    "VertexValues": "baking",
    "sample": "baking",
    "resample": "baking",
    "cell_areas": "areas",
    "uv_to_sphere": "baking",
    "read_image": "image",
    "direction_to_image": "projection",
    "image_to_direction": "projection",
    "rotation_matrix": "projection",
}

__all__ = [
    "ATLASES",
    "PATTERNS",
    "Pattern",
    "TexturedSurface",
    "VertexValues",
    "bake",
    "bake_to_uv",
    "bake_vertex_values",
    "cell_areas",
    "direction_to_image",
    "image_to_direction",
    "make_atlas",
    "pattern",
    "rasterize",
    "read_image",
    "resample",
    "rotation_matrix",
    "sample",
    "texture",
    "unwrap",
    "uv_to_sphere",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
