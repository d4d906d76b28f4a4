"""Pictures on a mesh's own texture coordinates and materials, transfer between meshes, and coordinates alone."""

from importlib import import_module
from typing import Any

_HOMES = {"BAKES": "bakes", "paint": "painter", "transfer_texture": "transfer", "unwrap_uv": "unwrap"}

__all__ = ["BAKES", "paint", "transfer_texture", "unwrap_uv"]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
