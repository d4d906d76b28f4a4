"""Pictures of surfaces, maps and fields without a display: pyrender through EGL, or a Warp ray caster."""

from typing import TYPE_CHECKING

from omtwarp import _at_first_use

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

# The drawing process imports this package too, and must not load what it does not use.
__all__, __getattr__, __dir__ = _at_first_use(__name__)
