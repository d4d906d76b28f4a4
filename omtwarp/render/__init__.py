"""Pictures of surfaces, maps and fields without a display: pyrender through EGL, or a Warp ray caster."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from omtwarp.render.camera import Camera, Light
    from omtwarp.render.films import film
    from omtwarp.render.pictures import comparison, preview, sheet
    from omtwarp.render.scene import Arrows, ScalarField, SurfaceView, Wireframe
    from omtwarp.render.subject import as_surface_view, map_view

_HOMES = {
    "Arrows": "scene",
    "Camera": "camera",
    "Light": "camera",
    "ScalarField": "scene",
    "SurfaceView": "scene",
    "Wireframe": "scene",
    "as_surface_view": "subject",
    "comparison": "pictures",
    "film": "films",
    "map_view": "subject",
    "preview": "pictures",
    "sheet": "pictures",
}
__all__ = [
    "Arrows",
    "Camera",
    "Light",
    "ScalarField",
    "SurfaceView",
    "Wireframe",
    "as_surface_view",
    "comparison",
    "film",
    "map_view",
    "preview",
    "sheet",
]


def __getattr__(name: str) -> object:
    # The drawing process imports this package too, and must not load what it does not use.
    if name in _HOMES:
        return getattr(importlib.import_module(f"omtwarp.render.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'omtwarp.render' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted(__all__)
