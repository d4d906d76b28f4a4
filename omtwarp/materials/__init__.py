"""Meshes with texture coordinates and materials of their own: reading, keeping and writing them."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omtwarp.materials.base import Material as Material
    from omtwarp.materials.painted import PaintedMesh as PaintedMesh
    from omtwarp.materials.read import read_painted_mesh as read_painted_mesh


_HOMES = {
    "Material": "base",
    "PaintedMesh": "painted",
    "read_painted_mesh": "read",
}

__all__ = ["Material", "PaintedMesh", "read_painted_mesh"]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
