"""Pictures of surfaces, maps and fields without a display: pyrender through EGL, or a Warp ray caster."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omtwarp.render.camera import Camera as Camera, Light as Light
    from omtwarp.render.films import film as film
    from omtwarp.render.pictures import comparison as comparison, preview as preview, sheet as sheet
    from omtwarp.render.scene import (
        Arrows as Arrows,
        ScalarField as ScalarField,
        SurfaceView as SurfaceView,
        Wireframe as Wireframe,
    )
    from omtwarp.render.subject import as_surface_view as as_surface_view, map_view as map_view

_NAMES = {
    "camera": ["Camera", "Light"],
    "films": ["film"],
    "pictures": ["comparison", "preview", "sheet"],
    "scene": ["Arrows", "ScalarField", "SurfaceView", "Wireframe"],
    "subject": ["as_surface_view", "map_view"],
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}
__all__ = list(_HOMES)


def __getattr__(name: str) -> object:
    # The drawing process imports this package too, and must not load what it does not use.
    if name in _HOMES:
        return getattr(importlib.import_module(f"omtwarp.render.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'omtwarp.render' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
