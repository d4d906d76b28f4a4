"""Pictures on a mesh's own texture coordinates and materials, transfer between meshes, and coordinates alone."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omtwarp.painting.bakes import BAKES as BAKES
    from omtwarp.painting.painter import paint as paint
    from omtwarp.painting.transfer import transfer_texture as transfer_texture
    from omtwarp.painting.unwrap import unwrap_uv as unwrap_uv


_HOMES = {"BAKES": "bakes", "paint": "painter", "transfer_texture": "transfer", "unwrap_uv": "unwrap"}

__all__ = list(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
