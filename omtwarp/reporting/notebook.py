"""Maps in notebooks: an interactive view that needs no network, pictures, and viewers of other programs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack, cast

import numpy as np

from omtwarp.errors import installed
from omtwarp.maps.domains import is_torus_map
from omtwarp.maps.result import MapResult
from omtwarp.render import Camera, SurfaceView, preview
from omtwarp.render.pictures import PreviewOptions
from omtwarp.render.subject import map_view, torus_view
from omtwarp.reporting.markup import data_uri, fill_page, html
from omtwarp.reporting.scene import make_scene, page_with_view, viewer_section
from omtwarp.reporting.stages import stages_of
from omtwarp.texturing.adaptive import rasterize

if TYPE_CHECKING:
    import polyscope
    import pyvista
    from PIL.Image import Image

PATTERN = "circles"


def notebook_view(result: MapResult) -> str:
    """Make the HTML of a map for a notebook: a picture, and over it an interactive view where scripts may run.

    The view is a page of its own in a frame that may run the two scripts in it, by their hashes, and load nothing.
    A notebook that is not trusted, or that is shown where there are no frames, keeps the picture.

    Args:
        result: a map to the sphere, or any other map of a surface, of which there is the picture alone.
    """
    height = 460  # pixels of the view
    caption = html("<p style='margin:.3em 0;font-size:90%'>{}</p>", repr(result))
    if is_torus_map(result):
        return str(html('<div><img alt="{}" src="{}">{}</div>', repr(result), data_uri(plot(result), "webp"), caption))
    stages = stages_of(result)
    poster = data_uri(plot(result, transparent=True, size=(640, 360), camera=Camera(margin=0.03)), "webp")
    # A notebook holds all of its outputs: the surface is simplified above this many triangles, and its texture has this
    # many texels along each of six faces.
    most_faces, face_texels = 20_000, 256
    scene = make_scene(result, stages, PATTERN, most_faces=most_faces, texels=face_texels)
    view = viewer_section(stages, poster, repr(result), PATTERN.capitalize())
    page = page_with_view("notebook.html", scene, title=repr(result), view=view)
    return str(fill_page("frame.html", height=height, name=repr(result), poster=poster, page=page, caption=caption))


def plot(result: MapResult, *, pattern: str = PATTERN, **options: Unpack[PreviewOptions]) -> Image:
    """Draw a map; see :meth:`omtwarp.maps.Displayable.plot`."""
    picture_width = 1024  # texels around the sphere of the texture of still pictures
    options.setdefault("size", (640, 480))
    image = options.pop("image", None)
    if options.get("scalar") is not None:
        return cast("Image", preview(SurfaceView(result.vertices, result.faces), **options))
    if is_torus_map(result):
        return cast("Image", preview(torus_view(result, image, pattern=pattern), **options))
    shown = map_view(result, rasterize(pattern, picture_width) if image is None else image)
    return cast("Image", preview(shown, **options))


def to_pyvista(result: MapResult) -> pyvista.PolyData:
    """Make PyVista's mesh of a map; see :meth:`omtwarp.maps.Displayable.to_pyvista`."""
    with installed("PyVista is not installed", "viewers"):
        import pyvista
    mesh = pyvista.PolyData.from_regular_faces(np.asarray(result.vertices), np.asarray(result.faces))
    for name in ("sphere", "conformal", "moser", "transported", "coordinates"):
        if (values := getattr(result, name, None)) is not None:
            mesh.point_data[name] = np.array(values)
    for name, values in _distortions(result).items():
        mesh.cell_data[name] = values
    return mesh


def to_polyscope(result: MapResult, name: str = "surface") -> polyscope.SurfaceMesh:
    """Register a map with Polyscope; see :meth:`omtwarp.maps.Displayable.to_polyscope`."""
    with installed("Polyscope is not installed", "viewers"):
        import polyscope
    if not polyscope.is_initialized():
        polyscope.init()
    vertices, faces = np.asarray(result.vertices), np.asarray(result.faces)
    shown = polyscope.register_surface_mesh(name, vertices, faces)
    meshes = [shown]
    if not is_torus_map(result):
        scale = 0.5 * float(np.ptp(vertices, axis=0).max())
        places = scale * np.asarray(result.sphere) + (vertices.mean(axis=0) + (2.5 * scale, 0.0, 0.0))
        meshes.append(polyscope.register_surface_mesh(f"{name}'s sphere", places, faces))
    for quantity, values in _distortions(result).items():
        for mesh in meshes:
            mesh.add_scalar_quantity(quantity, values, defined_on="faces", enabled=quantity == "area_ratio")
    return shown


def _distortions(result: MapResult) -> dict[str, np.ndarray]:
    measured = result.distortion()
    return {"area_ratio": np.array(measured.area_ratio), "angle": np.array(measured.face_angle)}
